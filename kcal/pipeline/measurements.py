"""What a filter measures, and what all tracks share, in small matrices, many at once."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.locate.multi_localizer import MultiViewLocalizer, common_errors, posed_cameras
from kcal.locate.views import ALONE_M, KnownViews, known_views, view_rows

# Small matrices, many at once: rows and columns are the first axes, and the last ones count the matrices.
#
# One operation then runs along many matrices, where `@` takes them one by one; a compiler makes loops over consecutive
# numbers of it.


def product(first: Tensor, second: Tensor) -> Tensor:
    """Of matrices (R, M, ...) and (M, C, ...).

    Example:
        >>> first, second = torch.rand(2, 3, 10), torch.rand(3, 4, 10)
        >>> torch.allclose(product(first, second).movedim(-1, 0), first.movedim(-1, 0) @ second.movedim(-1, 0))
        True
    """
    return (first[:, :, None] * second).sum(1)


def outer(first: Tensor, second: Tensor) -> Tensor:
    """(R, C, ...) from vectors (R, ...) and (C, ...)."""
    return first[:, None] * second


def congruent(slope: Tensor, covariance: Tensor) -> Tensor:
    """Slope covariance slopeᵀ: (R, R, ...) from (R, M, ...) and (M, M, ...)."""
    return product(product(slope, covariance), slope.transpose(0, 1))


def squared(root: Tensor) -> Tensor:
    """Root rootᵀ: (R, R, ...) from (R, M, ...)."""
    return product(root, root.transpose(0, 1))


def rooted(effect: Tensor, root: Tensor | None) -> Tensor:
    """Effect root: (R, M, ...) from (R, K, ...) and one root (K, M) for all; None: the identity."""
    return effect if root is None else torch.tensordot(effect, root, ([1], [0])).movedim(-1, 1)


class Eliminated(NamedTuple):
    """Gauss's elimination of symmetric positive S (R, R, ...) beside columns B (R, C, ...): S = L D Lᵀ.

    No rows are exchanged, which positive matrices do not need, whatever the units of their rows.

    Attributes:
        pivots: (R, ...) of D; positive, also where rounding left none.
        rows: (R, R, ...) of D Lᵀ, upper triangular.
        columns: (R, C, ...) L⁻¹ B.
    """

    pivots: Tensor
    rows: Tensor
    columns: Tensor


def eliminate(matrix: Tensor, columns: Tensor) -> Eliminated:
    """See `Eliminated`.

    Example:
        >>> done = eliminate(torch.tensor([[4.0, 2.0], [2.0, 3.0]])[..., None], torch.tensor([[2.0], [5.0]])[..., None])
        >>> done.pivots[:, 0].tolist(), done.columns[:, 0, 0].tolist()
        ([4.0, 2.0], [2.0, 4.0])
    """
    size = len(matrix)
    rest, upper, pivots = torch.cat([matrix, columns], 1), [], []
    for step in range(size):
        row = rest[0]
        pivots.append(row[step].clamp_min(1e-300))
        upper.append(row)
        if step < size - 1:
            below = rest[1:]
            rest = torch.addcmul(below, (below[:, step] / pivots[-1])[:, None], row, value=-1.0)
    whole = torch.stack(upper)
    return Eliminated(torch.stack(pivots), whole[:, :size], whole[:, size:])


def solved(done: Eliminated) -> Tensor:
    """(R, C, ...) S⁻¹ B."""
    size = len(done.rows)
    found = [done.columns[-1] / done.pivots[-1]]
    for step in range(size - 2, -1, -1):
        known = (done.rows[step, step + 1 :, None] * torch.stack(found)).sum(0)
        found.insert(0, (done.columns[step] - known) / done.pivots[step])
    return torch.stack(found)


def mahalanobis(covariance: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    """valueᵀ covariance⁻¹ value and the logarithm of the determinant, (...) each, from (R, R, ...) and (R, ...)."""
    done = eliminate(covariance, value[:, None])
    return (done.columns[:, 0].square() / done.pivots).sum(0), done.pivots.log().sum(0)


# Turn pixels of one moment into what a filter measures: rows of unit noise, with every error's effect on them.
#
# Where the lines of sight of the cameras that saw an object meet (`kcal.locate.views`) is told by three numbers: two
# across the line of sight of the first of them, and the inverse range from it. The pixels are nearly linear in them at
# any range. They are rows, whitened, so that those of cameras that saw nothing are zeros beside a noise of one and
# change nothing. One camera alone gives two rows: its inverse range is then that of the track.


class Sightings(NamedTuple):
    """N objects of one moment, seen by some of V cameras; the last axis of all counts them. M = 2 V rows of unit noise.

    The point is place + direction / inverse, in the rig's frame.

    Attributes:
        anchor: (N,) number of the first camera that saw it.
        place: (3, N) where that camera stands.
        direction: (3, N), of unit length to first order.
        inverse: (N,) one over meters; may be negative.
        by_ray: (3, 3, N) rows: change of (a, b, inverse) by a change of the ray that is proportional to `direction`.
        value: (M, N) measured minus predicted at that point.
        late: (V, M, 3, N) change of the rows by (a, b, inverse), for the pixels of each camera: how they move by rates
            of these if its mark is a second late.
        shared: (M, K, N) effect of K independent unit errors on the rows: of the calibration, and those that last.
        bent: (M, N) change of the predicted rows by a larger k / 2R, for each meter; of one camera alone.
        time: (V, N) seconds; that of the anchor where nothing was seen.
        row: (V, N) row of the mark, -0.5 at the top of the image to 0.5 at its bottom.
        seen: (V, N) bool.
        alone: (N,) bool: one camera saw it.
        usable: (N,) bool: the rays exist.
    """

    anchor: Tensor
    place: Tensor
    direction: Tensor
    inverse: Tensor
    by_ray: Tensor
    value: Tensor
    late: Tensor
    shared: Tensor
    bent: Tensor
    time: Tensor
    row: Tensor
    seen: Tensor
    alone: Tensor
    usable: Tensor

    def at(self, which: Tensor) -> Self:
        """The sightings at some places."""
        return type(self)(*(value.index_select(-1, which) for value in self))


def known_sightings(localize: MultiViewLocalizer) -> KnownViews:
    """What `sightings` needs of a rig; the calibration's errors are those that `localize` includes."""
    return known_views(posed_cameras(localize), common_errors(localize))


@torch.no_grad()
def sightings(
    known: KnownViews,
    pixels: Tensor,
    seen: Tensor,
    covariance: Tensor,
    time: Tensor,
    lasting_px: float = 0.0,
) -> Sightings:
    """Measure objects of one moment.

    Args:
        known: from `known_sightings`.
        pixels: (N, V, 2), and what follows: as in `ObjectViews`.
        seen: (N, V) bool.
        covariance: (N, 2 V, 2 V).
        time: (N, V) seconds.
        lasting_px: standard deviation along each axis of errors that stay as long as a target, in the marks of all
            cameras but the first.
    """
    rows = view_rows(known, pixels, seen, covariance)
    white, used, cameras = rows.white, rows.used, len(rows.used)
    each = white.unflatten(1, (cameras, 2)).transpose(0, 1)  # (V, M, 2, N)
    late = (each[:, :, :, None] * rows.jacobian.unflatten(0, (cameras, 2))[:, None]).sum(2)
    # Of the common errors, of the residual, and of what light bends.
    changes = torch.cat([rows.shared, rows.residual[:, None]], 1)
    shared, more, value = (-product(white, changes)).split([changes.shape[1] - 2, 1, 1], 1)
    if lasting_px:
        shared = torch.cat([shared, lasting_px * white[:, 2:]], 1)
    first, second = rows.sides
    clock = time.T
    row = pixels[..., 1].T / known.size[:, 1:] - 0.5
    return Sightings(
        anchor=rows.anchor,
        place=rows.place,
        direction=rows.direction,
        inverse=rows.inverse,
        by_ray=torch.stack([first, second, -rows.inverse * rows.direction]),
        value=value[:, 0],
        late=late,
        shared=shared,
        bent=torch.where(rows.alone, more[:, 0] / -ALONE_M, 0.0),
        time=torch.where(used, clock, clock.gather(0, rows.anchor[None])),
        row=torch.where(used, row, 0.0),
        seen=used,
        alone=rows.alone,
        usable=rows.fitted,
    )


class Anchored(NamedTuple):
    """Sightings in frames of tracks: x / z, y / z and 1 / z there.

    Attributes:
        place: (3, N) of the point around which rows are linear.
        value: (M, N) measured minus predicted there.
        late: (V, M, 3, N) rows by the three.
        shared: (M, K, N).
        ahead: (N,) bool: in front of the frame's plane.
    """

    place: Tensor
    value: Tensor
    late: Tensor
    shared: Tensor
    ahead: Tensor

    def at(self, which: Tensor) -> Self:
        """The sightings at some places."""
        return type(self)(*(value.index_select(-1, which) for value in self))


def anchored(
    seen: Sightings,
    frame: Tensor,
    home: Tensor,
    predicted: Tensor | None = None,
    bending: Tensor | None = None,
    k: float = 0.0,
) -> Anchored:
    """Express sightings in frames.

    Args:
        seen: N of them.
        frame: (3, 3, N) rotations from the rig's axes.
        home: (3, N) where the frames have their origins, in the rig's frame.
        predicted: (3, N) x / z, y / z, 1 / z of tracks: where one camera alone saw something, its range is theirs.
        bending: (K,) change of k / 2R by the first K shared errors.
        k: k / 2R.
    """
    apart = seen.place - home
    inverse, value, shared, direction = seen.inverse, seen.value, seen.shared, seen.direction
    if predicted is not None:
        ray = torch.cat([predicted[:2], torch.ones_like(predicted[:1])])
        line = (frame * ray[:, None]).sum(0) - predicted[2] * apart
        along = (line * direction).sum(0)
        there = torch.where(along > 0, predicted[2] / along.clamp_min(1e-12), 0.0).clamp_min(2e-6)
        inverse = torch.where(seen.alone, there, inverse)
        # Light bends more on a longer way.
        more = seen.bent * (torch.where(seen.alone, 1.0 / inverse, ALONE_M) - ALONE_M)
        value = value - k * more
        if bending is not None:
            rest = len(shared[0]) - len(bending)
            shared = shared - torch.nn.functional.pad(outer(more, bending[:, None]), (0, 0, 0, rest))
    ray = (frame * (direction + inverse * apart)).sum(1)
    length = ray.square().sum(0).sqrt()
    ahead = seen.usable & (ray[2] > 0.1 * length)
    axis = torch.eye(3, dtype=ray.dtype, device=ray.device)[2, :, None]
    ray = torch.where(ahead, ray, axis)
    depth = ray[2]
    # What a change of (x, y, 1 / z) makes of the ray, times z; and of (a, b, inverse).
    by_ray = product(seen.by_ray, torch.cat([frame[:2].transpose(0, 1), -apart[:, None]], 1))
    last = torch.zeros_like(by_ray)
    last[2, 2] = 1.0
    turn = depth * (by_ray + last)
    late = (seen.late[:, :, :, None] * turn).sum(2)
    return Anchored(torch.cat([ray[:2], inverse[None]]) / depth, value, late, shared, ahead)


# What all tracks share: errors of calibration, mounting and clocks, which more frames do not average away.
#
# A state's error is noise plus `shared @ b`, with the same unknown b for every track and frame: K independent errors of
# the calibration, and three of each clock but the first's. The filter's gain follows the noise alone, and the effect of
# b is carried along exactly. Two things follow: the covariance, noise + shared cov(b) sharedᵀ, never falls below the
# systematic part; and innovations tell what they know of b, the calibration included, which `SharedErrors` collects to
# estimate the clock.
#
# Source: Friedland, "Treatment of bias in recursive filtering" (1969); Schmidt (1966) for considered states.

# Offset, drift, slope over the rows.
CLOCK_TERMS = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class ClockPrior:
    """What is known of a camera's clock before any target moved, beside the clock of the first camera (the left one).

    Args:
        offset_s: seconds by which its images are later than their times say.
        offset_sigma_s: its standard deviation.
        drift_sigma: of the change of the offset, seconds per second.
        slope_sigma_s: of the difference between the bottom and the top row: two rolling shutters that are unlike.

    Raises:
        InputError: a value that is not finite, or a negative sigma.
    """

    offset_s: float = 0.0
    offset_sigma_s: float = 0.0
    drift_sigma: float = 0.0
    slope_sigma_s: float = 0.0

    def __post_init__(self) -> None:
        if not math.isfinite(self.offset_s) or not all(0 <= value < math.inf for value in self.sigmas):
            raise InputError("clock: a finite offset and finite sigmas, not negative, are needed")

    @property
    def sigmas(self) -> tuple[float, float, float]:
        """Of offset, drift and slope."""
        return self.offset_sigma_s, self.drift_sigma, self.slope_sigma_s


class ClockEstimate(NamedTuple):
    """What the tracks say of a camera's clock beside the first one's.

    Attributes:
        values: (3,) offset (s) at the time of the first frame, drift (s/s), slope (s from top to bottom).
        covariance: (3, 3); calibration errors are included.
        start: seconds, the time at which the drift counts from.
    """

    values: Tensor
    covariance: Tensor
    start: float

    def offset(self, time: float) -> tuple[float, float]:
        """The offset at a time, with its standard deviation: seconds."""
        row = self.values.new_tensor([1.0, time - self.start, 0.0])
        return float(row @ self.values), float((row @ self.covariance @ row).clamp_min(0).sqrt())


class SharedErrors:
    """What is known of b: the calibration's errors stay as they are, the clock's are estimated.

    b counts from `values` for the clock: after each `settle`, the best estimate of b is zero.

    Args:
        calibration: K, how many independent unit errors are not estimated: those of the calibration, and what lasts of
            errors in the marks.
        clocks: what is known of the clock of each camera but the first.
        device: of the tensors.
    """

    def __init__(self, calibration: int, clocks: Sequence[ClockPrior], device: torch.device | None = None) -> None:
        self.calibration = calibration
        # With clocks that are exact, there is nothing to estimate.
        self.estimated = any(any(clock.sigmas) for clock in clocks)
        sigmas = torch.tensor([clock.sigmas for clock in clocks], dtype=torch.float64, device=device)
        known = sigmas.flatten() if self.estimated else sigmas.new_zeros(0)
        self.scale = torch.cat([sigmas.new_ones(calibration), known])
        # Offset, drift and slope of each clock in turn.
        self.values = sigmas.new_tensor([[clock.offset_s, 0.0, 0.0] for clock in clocks]).flatten()
        size = len(self.scale)
        # In units of the prior's sigmas: a sigma of zero is no exception.
        self.information = torch.eye(size, dtype=torch.float64, device=device)
        self.score = torch.zeros(size, dtype=torch.float64, device=device)
        self.start: float | None = None
        self.root = torch.diag(self.scale)

    def add(self, effect: Tensor, innovation: Tensor, covariance: Tensor) -> None:
        """Collect independent innovations (M, N) = effect (M, K + Q, N) b + noise of the covariance (M, M, N)."""
        if not self.estimated:
            return
        scaled = effect * self.scale[:, None]
        white = solved(eliminate(covariance, torch.cat([scaled, innovation[:, None]], 1)))
        both = (scaled[:, :, None] * white[:, None]).sum((0, -1))
        self.information = self.information + both[:, :-1]
        self.score = self.score + both[:, -1]

    def settle(self) -> Tensor:
        """Move `values` to what was collected, and return the move (Q,); `root` is then that of what remains of b.

        The clock's error and the calibration's are correlated as in the joint posterior; the calibration keeps its
        prior, because its errors must not average away where the model of its errors is not exact.
        """
        k = self.calibration
        if not self.estimated:
            return self.values[:0]
        joint = torch.linalg.inv(self.information)
        move = joint @ self.score
        move[:k] = 0.0
        self.score = self.score - self.information @ move
        joint[:k, :k] = torch.eye(k).to(joint)
        values, vectors = torch.linalg.eigh(0.5 * (joint + joint.T))
        self.root = self.scale[:, None] * vectors * values.clamp_min(0.0).sqrt()
        change = (self.scale * move)[k:]
        self.values = self.values + change
        return change

    @property
    def mixing(self) -> Tensor | None:
        """`root`; None where it is the identity."""
        return self.root if self.estimated else None

    @property
    def corrected(self) -> Tensor:
        """(Q,) values of the clocks' errors that are estimated."""
        return self.values if self.estimated else self.values[:0]

    def clock_estimate(self, camera: int = 1) -> ClockEstimate:
        """The clock of a camera, from 1, as now known."""
        mine = slice(CLOCK_TERMS * (camera - 1), CLOCK_TERMS * camera)
        covariance = self.values.new_zeros(CLOCK_TERMS, CLOCK_TERMS)
        if self.estimated:
            part = self.root[self.calibration :][mine]
            covariance = part @ part.T
        return ClockEstimate(self.values[mine].clone(), covariance, self.start or 0.0)
