"""What a filter measures, and what all tracks share, in small matrices, many at once."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.camera_like import CameraStack, camera_stack, project_stack, unproject_each
from kcal.lens.pose import side_axes
from kcal.locate.angular import LIGHT_HORIZON, Found, baseline_axes, first_seen, meeting_points, triangulate_angular
from kcal.locate.views import CommonErrors, PosedCameras, sound_covariances
from kcal.texts import briefly

# Pixels of any subset of cameras as rows that are linear around where their lines of sight meet.
#
# A filter takes these in as they are: it needs no optimum, and neither a status nor a covariance of each point. A point
# is told from its anchor, the first camera that saw it, by a direction and an inverse distance, as in
# `kcal.locate.views`. What does not change from one time step to the next is prepared once (`known_views`).

# Meters at which a bearing of one camera is taken; what light bends elsewhere follows from it.
ALONE_M = 20_000.0


class KnownViews(NamedTuple):
    """C cameras and K errors that their marks have in common.

    Attributes:
        posed: as they stand.
        stack: of the cameras.
        middle: (C, 2) principal points, px.
        size: (C, 2) of the images, px.
        wide: (C, 1) bool: sees also beside and behind itself.
        up: (C, 3, 1) the vertical in each camera's axes; zeros where lines of sight are straight.
        matrices: (C, 3, 4) of `PosedCameras`.
        axes: (3, 3) of two cameras: the line between them and across; None for more.
        baseline: meters between the first camera and the last.
        moves: (C, 3 (K + 1), 5) what each error, and a larger k / 2R, makes of a point in a camera's axes, over its
            distance: by this point, by one over its distance, and by how much one of `up` it is lifted by bending.
        lens: for each camera the parameters that are not exact.
        by_lens: (C, K + 1, Q) their change by each error.
    """

    posed: PosedCameras
    stack: CameraStack
    middle: Tensor
    size: Tensor
    wide: Tensor
    up: Tensor
    matrices: Tensor
    axes: Tensor | None
    baseline: Tensor
    moves: Tensor
    lens: tuple[tuple[int, ...], ...]
    by_lens: Tensor


@torch.no_grad()
def known_views(posed: PosedCameras, common: CommonErrors | None) -> KnownViews:
    """Prepare cameras, and what is not known of them."""
    cameras, center = posed.cameras, posed.center
    count = len(cameras)
    exact = CommonErrors(tuple(() for _ in cameras), center.new_zeros(0, count, 6), center.new_zeros(0))
    lens, half, bending = exact if common is None else common
    half = torch.nn.functional.pad(half, (0, 0, 0, 0, 0, 1))
    bending = torch.cat([bending, bending.new_ones(1)])
    up = torch.zeros_like(center) if posed.up is None else (posed.rotation @ posed.up[..., None])[..., 0]
    by_center, turn = ((posed.rotation @ part[..., None])[..., 0] for part in (half[..., :3], half[..., 3:6]))
    still = torch.eye(3, dtype=center.dtype, device=center.device).expand(*turn.shape, 3)
    crossed = torch.linalg.cross(turn[..., None, :].expand_as(still), still).mT
    lifts = bending[:, None, None] * up
    moves = torch.cat([-crossed, -by_center[..., None], lifts[..., None]], -1).movedim(0, 1).flatten(1, 2)
    middle = torch.stack([camera.center.detach() for camera in cameras])
    size = center.new_tensor([camera.size for camera in cameras])
    wide = torch.tensor([[camera.model.wide] for camera in cameras], device=center.device)
    axes = baseline_axes(center[1] - center[0]) if count == 2 else None
    return KnownViews(
        posed, camera_stack(cameras), middle, size, wide, up[..., None], posed.matrices, axes,
        torch.linalg.vector_norm(center[-1] - center[0]), moves, lens, half[..., 6:].movedim(0, 1),
    )  # fmt: skip


def _whitening(covariance: Tensor, used: Tensor) -> Tensor:
    """(M, M, N) U⁻¹ of covariances U Uᵀ, U upper triangular; the identity for views that do not count, or none of them.

    So views that do not count have rows of zeros beside a noise of one.
    """
    still = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
    both = used[..., None].expand(-1, -1, 2).flatten(1)
    whole = torch.where(both[:, :, None] & both[:, None], covariance, still)
    mirrored = (whole - whole.mT).abs().amax((-2, -1)) <= 1e-6 * whole.abs().amax((-2, -1))
    lower, info = torch.linalg.cholesky_ex((0.5 * (whole + whole.mT)).flip(-2, -1))
    lower = torch.where((mirrored & (info == 0))[:, None, None], lower, still)
    inverse = torch.linalg.solve_triangular(lower, still, upper=False)
    return inverse.flip(-2, -1).movedim(0, -1)


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
    return (first.unsqueeze(2) * second).sum(1)


def outer(first: Tensor, second: Tensor) -> Tensor:
    """(R, C, ...) from vectors (R, ...) and (C, ...)."""
    return first.unsqueeze(1) * second


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


# Turn pixels of one time step into what a filter measures: rows of unit noise, with every error's effect on them.
#
# Where the lines of sight of the cameras that saw an object meet (`kcal.locate.views`) is told by three numbers: two
# across the line of sight of the first of them, and the inverse range from it. The pixels are nearly linear in them at
# any range. They are rows, whitened, so that those of cameras that saw nothing are zeros beside a noise of one and
# change nothing. One camera alone gives two rows: its inverse range is then that of the track.


class Sightings(NamedTuple):
    """N objects of one time step, seen by some of V cameras; the last axis counts them. M = 2 V rows of unit noise.

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


@torch.no_grad()
def sightings(
    known: KnownViews, pixels: Tensor, seen: Tensor, covariance: Tensor, time: Tensor, lasting_px: float = 0.0
) -> Sightings:
    """Measure objects of one time step.

    Args:
        known: from `known_views`, with the errors that a `Localizer` includes.
        pixels: (N, V, 2), and what follows: as in `ObjectViews`.
        seen: (N, V) bool.
        covariance: (N, 2 V, 2 V).
        time: (N, V) seconds.
        lasting_px: standard deviation along each axis of errors that stay as long as a target, in the marks of all
            cameras but the first.
    """
    posed, cameras = known.posed, len(known.middle)
    pixels = torch.where(seen[..., None], pixels, known.middle)
    blocks = covariance.unflatten(-1, (cameras, 2)).unflatten(-3, (cameras, 2)).diagonal(dim1=-4, dim2=-2)
    sound = sound_covariances(blocks.movedim(-1, 1))
    marks = pixels.movedim(0, 1)  # (C, N, 2)
    rays, valid = unproject_each(known.stack, marks)
    shifted = pixels + 0.5
    inside = ((shifted >= 0.0) & (shifted <= known.size)).all(-1)
    used = seen & valid.T & inside & sound
    count = used.sum(-1)
    alone = count == 1
    fitted = alone | ((count > 1) & ~(seen & ~sound).any(-1))
    anchor = first_seen(used).to(torch.int64).argmax(-1)
    in_frame = rays @ posed.rotation
    place = posed.center.T.index_select(1, anchor)
    ray = in_frame[anchor, torch.arange(len(anchor), device=anchor.device)].T
    if known.axes is not None:
        both = in_frame @ known.axes
        found = meeting_points(both[0], both[1], known.axes, known.baseline)
    elif cameras > 1:
        found = triangulate_angular(known.matrices, rays.movedim(0, 1), used)
    else:
        found = Found(torch.zeros_like(ray.T), torch.zeros_like(alone))
    away = torch.where(alone, ALONE_M * ray, found.points.T + (posed.center[0, :, None] - place))
    met = alone | (found.valid & (count > 1))
    away = torch.where(met, away, ray)
    nearness = away.square().sum(0).rsqrt()
    ahead, inverse = away * nearness, nearness * met
    first, second = (side.T for side in side_axes(ahead.T))

    # Axes of each camera: (C, 3, 3 columns, N), and what a larger inverse distance adds.
    turned = (posed.rotation @ torch.stack([first, second, ahead], 1).flatten(1)).unflatten(-1, (3, -1))
    shift = posed.rotation @ (place - posed.center[..., None])
    at = turned[:, :, 2] + inverse * shift
    along = (at * known.up).sum(1, keepdim=True)
    lift = (at.square().sum(1, keepdim=True) - along * along) / inverse.clamp_min(1.0 / LIGHT_HORIZON)
    at = at + (posed.bending * lift) * known.up
    counts = used.T & fitted
    good = counts & ((at[:, 2] > 1e-6) | known.wide)
    # The axis is a harmless stand-in.
    at = torch.where(good[:, None], at, at.new_tensor([[0.0], [0.0], [1.0]]))
    projected = project_stack(known.stack, at, known.lens, inverse)
    by_point, share = projected.by_point, counts.to(at.dtype)[:, None]
    columns = torch.cat([turned[:, :, :2], shift[:, :, None]], 2)
    jacobian = (columns[:, :, :, None] * by_point[:, :, None]).sum(1)  # (C, 3 columns, 2, N)
    if projected.by_meter is not None:
        jacobian = jacobian + torch.nn.functional.pad(projected.by_meter[:, None], (0, 0, 0, 0, 2, 0))
    point = torch.cat([at, inverse.expand_as(lift), lift], 1)
    moved = (known.moves @ point).unflatten(1, (-1, 3))  # (C, K + 1, 3, N)
    shared = (moved[:, :, :, None] * by_point[:, None]).sum(2)
    if known.by_lens.shape[-1]:
        shared = shared + (known.by_lens @ projected.by_camera.flatten(2)).unflatten(-1, (2, -1))
    white = _whitening(covariance, used)
    each = white.unflatten(1, (cameras, 2)).transpose(0, 1)  # (V, M, 2, N)
    late = (each[:, :, :, None] * (share[:, :, None] * jacobian).transpose(1, 2)[:, None]).sum(2)
    # Of the common errors, of what light bends, and of what is predicted beside what was measured.
    changes = torch.cat([shared, (projected.pixels - marks.mT)[:, None]], 1)
    changes = (share[:, :, None] * changes).transpose(1, 2).flatten(0, 1)
    shared, more, value = (-product(white, changes)).split([changes.shape[1] - 2, 1, 1], 1)
    if lasting_px:
        shared = torch.cat([shared, lasting_px * white[:, 2:]], 1)
    clock = time.T
    row = pixels[..., 1].T / known.size[:, 1:] - 0.5
    return Sightings(
        anchor=anchor,
        place=place,
        direction=ahead,
        inverse=inverse,
        by_ray=torch.stack([first, second, -inverse * ahead]),
        value=value[:, 0],
        late=late,
        shared=shared,
        bent=torch.where(alone, more[:, 0] / -ALONE_M, 0.0),
        time=torch.where(used.T, clock, clock.gather(0, anchor[None])),
        row=torch.where(used.T, row, 0.0),
        seen=used.T,
        alone=alone,
        usable=fitted,
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
    """Prior of a camera's clock relative to that of the first camera (the left one).

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


@briefly
class ClockEstimate(NamedTuple):
    """Estimate of a camera's clock relative to the first one's, from the tracks.

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
