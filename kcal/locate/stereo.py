"""Pixel pairs of a stereo rig to points with errors: statuses, the most likely point, the interval of its range."""

from __future__ import annotations

import enum
import math
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from kcal.checks import as_points, exportable, scalar
from kcal.dispatch import CHUNK, is_differentiated, is_traced, known_true
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera_like import unproject_each
from kcal.lens.rig import StereoRig
from kcal.locate.angular import EPIPOLE, triangulate_pairs
from kcal.locate.max_likelihood import (
    PointFit,
    RelativeCamera,
    inverse_covariances,
    inverse_variance,
    most_likely,
    position_slope,
    symmetric,
)
from kcal.operation import Operations, shapes_of
from kcal.texts import brief

# The 95 % interval of a range, from one over the range and its standard deviation.
#
# A range is skewed: at 5 km with 3.2 px of disparity, half a pixel too many puts a point 0.7 km nearer and half a pixel
# too few 0.9 km farther, and the far end is infinite once the disparity may be zero. A standard deviation of the range
# hides both. One over the range has nearly Gaussian errors, so its interval is carried over.

# Two-sided 95 % of a normal distribution.
QUANTILE = 1.959963984540054
# A parallax below this many standard deviations gives a bearing, but no range worth the name.
BEARING_SIGMAS = 3.0


class RangeInterval(NamedTuple):
    """Ends of the 95 % interval in meters from the left camera, (..., N) each.

    Attributes:
        low: nearest range; infinite if the rays diverge by more than the noise explains.
        high: farthest range; infinite if the point may be at infinity.
    """

    low: Tensor
    high: Tensor


def range_interval(inverse_range: Tensor, sigma: Tensor, known: Tensor | None = None) -> RangeInterval:
    """The 95 % interval of the range, from the interval inverse_range ± 1.96 sigma.

    Args:
        inverse_range: (..., N) one over meters, negative where the rays diverge.
        sigma: (..., N) its standard deviation.
        known: (..., N) bool; where it is False the interval is 0 to infinity.

    Example:
        >>> f, baseline, disparity = 1600.0, 10.0, torch.tensor([3.2], dtype=torch.float64)
        >>> sigma = torch.tensor([0.5 / (f * baseline)], dtype=torch.float64)
        >>> interval = range_interval(disparity / (f * baseline), sigma)
        >>> round(interval.low.item(), 1), round(interval.high.item(), 1)
        (3827.8, 7207.1)
    """
    ends = []
    for inverse, unknown in ((inverse_range + QUANTILE * sigma, 0.0), (inverse_range - QUANTILE * sigma, math.inf)):
        ahead = inverse > 0
        reach = torch.where(ahead, 1.0 / torch.where(ahead, inverse, 1.0), math.inf)
        ends.append(reach if known is None else torch.where(known, reach, unknown))
    return RangeInterval(*ends)


# Pixel pairs of a stereo rig to points with errors: statuses, the most likely point, the interval of its range.
#
# `Triangulate` and `StereoLocalizer` share what is here.

# Radians. A smaller parallax is parallel for any camera: the point would be a billion baselines away.
_PARALLEL = 1e-9


class PositionStatus(enum.IntEnum):
    """What became of a pixel pair. Only `OK` comes with a point; `PARALLEL` still has a bearing and a nearest range.

    CONTRADICTION, of `MultiViewLocalizer`: the views are not of one point, and which is wrong cannot be told.
    """

    OK = 0
    OUTSIDE_LENS = 1
    BEHIND = 2
    PARALLEL = 3
    NOT_FINITE = 4
    OUTSIDE_IMAGE = 5
    BEARING_ONLY = 6
    MASKED = 7
    BAD_COVARIANCE = 8
    CONTRADICTION = 9


def status_counts(status: Tensor) -> str:
    """How many points have each status, for people: `5 OK, 2 PARALLEL`."""
    counts = Counter(status.flatten().tolist())
    return ", ".join(f"{number} {PositionStatus(code).name}" for code, number in sorted(counts.items())) or "no points"


def flag_positions(code: Tensor, condition: Tensor, status: PositionStatus) -> Tensor:
    """`code` (int8) with `status` where the condition is true."""
    return torch.where(condition, code.new_full((), int(status)), code)


def checked_rig(rig: StereoRig, pixel_sigma: float) -> float:
    """The sigma of the marks as a float, after checking that it is positive and that the rig has a baseline."""
    if not 1e-6 <= pixel_sigma <= 1e6:
        # Beyond, squares of it leave the range of float64, or the accuracy of the arithmetic.
        raise InputError(f"pixel_sigma: a positive number of pixels, 1e-6 to 1e6, is needed, got {pixel_sigma}")
    if not float(rig.baseline.detach()) > 0:
        raise DegenerateError("the rig's cameras stand in the same place: no range can be measured")
    return float(pixel_sigma)


def checked_pairs(
    pixels_left: Tensor | ArrayLike, pixels_right: Tensor | ArrayLike, rig: StereoRig
) -> tuple[Tensor, Tensor]:
    """Both as float64 (..., N, 2) on the rig's device, after checking types and shapes."""
    there = rig.right_from_left_translation
    left, right = as_points("pixels_left", pixels_left, 2, there), as_points("pixels_right", pixels_right, 2, there)
    if left.shape != right.shape or left.ndim < 2:
        raise InputError(
            "pixels_left and pixels_right: the same shape (..., N, 2) is needed, "
            f"got {tuple(left.shape)} and {tuple(right.shape)}"
        )
    return left, right


Tensors = TypeVar("Tensors", bound=tuple)


def piece_by_piece(
    locate: Callable[..., Tensors],
    first: Tensor,
    *others: Tensor | None,
    differentiated: bool,
    axis: int = -2,
    share: int = 1,
) -> Tensors:
    """Call `locate(first, *others)`, in pieces that fit the cache where nothing is traced or differentiated.

    Args:
        locate: returns a named tuple of tensors whose axis of points is that of the pixels.
        first: (..., N, 2) pixels, or with more axes.
        others: tensors (..., N, ...) with the same leading axes, or None.
        differentiated: then everything is done in one piece, because the graph would keep all pieces anyway.
        axis: of the points in `first`.
        share: how many times as much memory a point takes as a pair does.
    """
    axis = first.ndim + axis
    size = max(1, CHUNK // max(1, share * math.prod(first.shape[:axis])))
    if is_traced() or differentiated or first.shape[axis] <= size:
        return locate(first, *others)
    cut = [None if value is None else value.split(size, axis) for value in (first, *others)]
    count = math.ceil(first.shape[axis] / size)
    pieces = [locate(*(None if value is None else value[i] for value in cut)) for i in range(count)]
    return type(pieces[0])(*(torch.cat(values, axis) for values in zip(*pieces, strict=True)))


class SightLines(NamedTuple):
    """What the rays of pixel pairs say before any noise is considered.

    Attributes:
        rays_left: (..., N, 3) unit rays in the left camera's frame.
        points: (..., N, 3) in the same frame, of `triangulate_pairs`; zeros where the rays do not meet ahead.
        status: (..., N) int8, codes of `PositionStatus`.
        along_baseline: (..., N) where a ray runs along the baseline, so that it meets the other everywhere on it.
    """

    rays_left: Tensor
    points: Tensor
    status: Tensor
    along_baseline: Tensor


def sight_lines(rig: StereoRig, pixels_left: Tensor, pixels_right: Tensor) -> SightLines:
    """Rays, closed-form points and statuses of float64 pixels, both (..., N, 2)."""
    rotation, translation = rig.right_from_left_rotation, rig.right_from_left_translation
    rays, seen = unproject_each((rig.left, rig.right), torch.stack([pixels_left, pixels_right], -3))
    rays_left, rays_right = rays.unbind(-3)
    inside = rig.left.inside(pixels_left) & rig.right.inside(pixels_right)
    finite = (torch.isfinite(pixels_left) & torch.isfinite(pixels_right)).all(-1)
    parallel, opposite, along_baseline = _epipolar(rays_left, rays_right @ rotation, -translation @ rotation)
    points, solved = triangulate_pairs(rays_left, rays_right, (rotation, translation))
    code = torch.full(rays_left.shape[:-1], int(PositionStatus.OK), dtype=torch.int8, device=rays_left.device)
    for condition, status in (
        (parallel | along_baseline, PositionStatus.PARALLEL),
        ((opposite | ~(solved | parallel)) & ~along_baseline, PositionStatus.BEHIND),
        (~seen.all(-2), PositionStatus.OUTSIDE_LENS),
        (~inside, PositionStatus.OUTSIDE_IMAGE),
        (~finite, PositionStatus.NOT_FINITE),
    ):
        code = flag_positions(code, condition, status)
    return SightLines(rays_left, points, code, along_baseline)


@torch.no_grad()
def _epipolar(left: Tensor, right: Tensor, baseline: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of unit rays (..., N, 3) in the rig frame, in the plane of the left one and the baseline (left to right camera).

    Returns:
        (..., N) whether the rays are parallel or diverge; whether the right ray points to the other side of the
        baseline; and whether either runs along it.
    """
    axis = (baseline / torch.linalg.vector_norm(baseline)).expand_as(left)
    normal = torch.linalg.cross(axis, left)
    sine = torch.linalg.vector_norm(normal, dim=-1)
    left_ok = sine > EPIPOLE
    side = torch.linalg.cross(normal / torch.where(left_ok, sine, 1.0)[..., None], axis)
    cosine = (left * axis).sum(-1)
    along, across = (right * axis).sum(-1), (right * side).sum(-1)
    right_ok = torch.linalg.vector_norm(torch.linalg.cross(axis, right), dim=-1) > EPIPOLE
    # The right ray in the plane: the rest of it, the epipolar error, says nothing about the range.
    in_plane = left_ok & right_ok & (along * along + across * across > EPIPOLE**2)
    # Sine and cosine of the parallax, times the length of the right ray in the plane.
    upward, level = cosine * across - sine * along, cosine * along + sine * across
    parallel = (upward <= _PARALLEL * level) & ((level > 0) | (upward < 0))
    return parallel | ~in_plane, across <= 0, ~in_plane


class PairFit(NamedTuple):
    """The most likely points of pixel pairs.

    Attributes:
        fit: the optimum.
        scale: meters, the unit of `fit.inverse`.
        status: (..., N) int8, from `sight_lines` and what was given besides.
        usable: (..., N) which pairs have an optimum.
    """

    fit: PointFit
    scale: Tensor
    status: Tensor
    usable: Tensor

    @property
    def length(self) -> Tensor:
        """(..., N) of `fit.direction`."""
        # `vector_norm` takes twenty times as long along this axis.
        return self.fit.direction.square().sum(-2).sqrt()


def fit_pairs(
    rig: StereoRig,
    left: Tensor,
    right: Tensor,
    cov: Tensor | None = None,
    mask: Tensor | None = None,
    *,
    by_camera: bool = False,
    differentiated: bool = False,
) -> PairFit:
    """The most likely point of each pixel pair: in closed form first, then by `most_likely`.

    Args:
        rig: two cameras and their relative pose.
        left: (..., N, 2) float64 pixels.
        right: (..., N, 2).
        cov: (..., N, 4, 4) covariance of each pair's four coordinates; a variance of one if left out.
        mask: (..., N) bool; what is False is neither read nor differentiated.
        by_camera: see `most_likely`.
        differentiated: see `most_likely`.
    """
    finite = torch.isfinite(left + right).all(-1)
    wanted = finite if mask is None else finite & mask
    if not known_true(wanted):
        left = torch.where(wanted[..., None], left, rig.left.center.detach())
        right = torch.where(wanted[..., None], right, rig.right.center.detach())
    with torch.no_grad():
        lines = sight_lines(rig, left, right)
        weight, sound = inverse_covariances(cov)
        code = flag_positions(lines.status, ~sound, PositionStatus.BAD_COVARIANCE)
        code = flag_positions(code, ~finite, PositionStatus.NOT_FINITE)
        if mask is not None:
            code = flag_positions(code, ~mask, PositionStatus.MASKED)
        met = code == int(PositionStatus.OK)
        usable = met | ((code == int(PositionStatus.PARALLEL)) & ~lines.along_baseline)
        scale = rig.baseline.detach()
        distance = torch.where(met, torch.linalg.vector_norm(lines.points, dim=-1), 1.0)
        ahead = torch.where(met[..., None], lines.points / distance[..., None], lines.rays_left)
        start = torch.where(met, scale / distance, 0.0)
    if differentiated and cov is not None:
        weight, _ = inverse_covariances(cov)
    rotation, translation = rig.right_from_left_rotation, rig.right_from_left_translation
    still = torch.eye(3, dtype=torch.float64, device=rotation.device)
    cameras = (
        RelativeCamera(rig.left, still, torch.zeros_like(translation)),
        RelativeCamera(rig.right, rotation, translation),
    )
    pixels = torch.cat([left, right], -1).mT
    fit = most_likely(
        cameras, scale, (ahead, start), pixels, usable, weight, by_camera=by_camera, differentiated=differentiated
    )
    return PairFit(fit, scale, code, usable)


class InverseRange(NamedTuple):
    """One over the range, whose errors are Gaussian at any distance, and what follows from it; each (..., N).

    Attributes:
        value: one over meters from the left camera; zero unless usable.
        sigma: its standard deviation; zero where nothing is known.
        interval: the 95 % interval of the range, meters.
        weak: where the parallax is below three of its sigmas.
        status: int8: PARALLEL where the value is not positive.
    """

    value: Tensor
    sigma: Tensor
    interval: RangeInterval
    weak: Tensor
    status: Tensor


def inverse_range(found: PairFit, variance: Tensor, weak_status: PositionStatus) -> InverseRange:
    """Range and status of fitted pairs, given the variance (..., N) of `fit.inverse`.

    A pair that is `OK` and weak gets `weak_status`.
    """
    fit, scale, code, usable = found
    value = torch.where(usable, fit.inverse / (scale * found.length), 0.0)
    with torch.no_grad():
        known = torch.isfinite(variance) & (variance > 0) & usable
    sigma = torch.sqrt(torch.where(known, variance, 1.0)) / (scale * found.length)
    sigma = torch.where(known, sigma, 0.0)
    with torch.no_grad():
        weak = usable & (~known | (value < BEARING_SIGMAS * sigma))
        lost = usable & ~(value > 0)
        code = flag_positions(code, weak & (code == int(PositionStatus.OK)), weak_status)
        code = flag_positions(code, lost, PositionStatus.PARALLEL)
        # What the closed form put at infinity may have come back in front of the rig.
        code = flag_positions(code, usable & ~lost & ~weak, PositionStatus.OK)
    return InverseRange(value, sigma, range_interval(value, sigma, known), weak, code)


def range_where_ok(status: Tensor, inverse_range: Tensor) -> Tensor:
    """(..., N) one over `inverse_range`; infinite unless the status is OK."""
    ok = status == int(PositionStatus.OK)
    return torch.where(ok, 1.0 / torch.where(ok, inverse_range, 1.0), torch.inf)


def reprojection_errors(residual: Tensor) -> Tensor:
    """Residuals (..., 2 C, N) to distances in px (..., N, C), with a gradient of zero where there is no error."""
    squared = residual.unflatten(-2, (-1, 2)).square().sum(-2)
    some = squared > 0
    return torch.where(some, torch.sqrt(torch.where(some, squared, 1.0)), 0.0).mT


# `Triangulate`: pixel pairs of a stereo rig to points in the rig's own frame, without the Earth.


@exportable
class Triangulation(NamedTuple):
    """Result of `Triangulate`; no tensor contains NaN, whatever went in.

    Attributes:
        points: (..., N, 3) meters in the rig frame (the left camera's); zeros unless the status is OK.
        status: (..., N) int8, codes of `PositionStatus`; never BEARING_ONLY: see `bearing_only`.
        rays: (..., N, 3) unit vectors of the most likely direction from the left camera; its optical axis where the
            lens has no ray.
        reprojection: (..., N, 2) distance in px between mark and reprojected point, left and right; zeros unless OK.
        inverse_range: (..., N) one over meters from the left camera, negative where the rays diverge.
        inverse_range_sigma: (..., N) its standard deviation from the marks' noise; zero where nothing is known.
        range_low: (..., N) meters from the left camera, lower end of the 95 % interval of the marks' noise.
        range_high: (..., N) its upper end, infinite where the point may be at infinity. The interval is 0 to infinity
            unless the status is OK or PARALLEL.
        bearing_only: (..., N) true where the parallax is below three sigma: trust the bearing, not the range.
        covariance: (..., N, 3, 3) of `points` from the marks' noise, to first order; an infinite diagonal unless OK. At
            long range a point is skewed along the line of sight: quote the range interval.
    """

    points: Tensor
    status: Tensor
    rays: Tensor
    reprojection: Tensor
    inverse_range: Tensor
    inverse_range_sigma: Tensor
    range_low: Tensor
    range_high: Tensor
    bearing_only: Tensor
    covariance: Tensor = torch.empty(0)  # its place is the last: programs may build this result, or unpack it

    @property
    def range(self) -> Tensor:
        """(..., N) meters from the left camera; infinite unless the status is OK."""
        return range_where_ok(self.status, self.inverse_range)

    def __repr__(self) -> str:
        return brief(self, status=status_counts(self.status))


class Triangulate(Operations):
    """Locate pixel pairs in the rig frame: the positions of `StereoLocalizer`, without the Earth.

    The status of a pair is decided from the two rays before anything is divided: `NOT_FINITE` (NaN or infinite
    pixels), `OUTSIDE_IMAGE` (more than half a pixel outside), `OUTSIDE_LENS` (the lens model has no ray there),
    `BEHIND` (the rays' lines cross behind exactly one camera), `PARALLEL` (parallel or diverging rays: at or beyond
    infinity, or along the baseline), else `OK`. Points near infinity are `OK` with a wide range interval.

    There is no branch on values, so that the module compiles and exports. Geometry runs in float64 whatever the
    pixels' type; derivatives by the pixels are exact and finite, and zero for pairs that are not OK.

    Args:
        rig: two cameras and their relative pose; its covariance is not used.
        pixel_sigma: standard deviation of the marks, px along each axis. Covariance and range interval cover the marks'
            noise only; `StereoLocalizer` adds the errors of the calibration.

    Raises:
        InputError: a `pixel_sigma` that is not positive.
        DegenerateError: a rig without a baseline.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> left = torch.tensor([[960.0, 540.0]], dtype=torch.float64)
        >>> result = Triangulate(rig)(left, left - torch.tensor([3.2, 0.0], dtype=torch.float64))
        >>> round(result.points[0, 2].item(), 3), PositionStatus(int(result.status[0])).name
        (5000.0, 'OK')
    """

    results = shapes_of(
        Triangulation, points=(3,), status=torch.int8, rays=(3,), reprojection=(2,), bearing_only=torch.bool,
        covariance=(3, 3),
    )  # fmt: skip
    pixel_sigma: Tensor

    def __init__(self, rig: StereoRig, pixel_sigma: float = 0.3) -> None:
        super().__init__()
        self.register_buffer("pixel_sigma", scalar(checked_rig(rig, pixel_sigma), rig.right_from_left_translation))
        self.rig = rig

    def forward(self, pixels_left: Tensor, pixels_right: Tensor) -> Triangulation:
        """Triangulate matched pixels, both (..., N, 2), integer coordinates at pixel centers.

        Raises:
            InputError: not floating point, or shapes that are wrong or unlike.
        """
        left, right = checked_pairs(pixels_left, pixels_right, self.rig)
        if found := self.as_operation("forward", left, right):
            return Triangulation(*found)
        differentiated = is_differentiated(left, right, self)

        def triangulate(left: Tensor, right: Tensor) -> Triangulation:
            found = fit_pairs(self.rig, left, right, differentiated=differentiated)
            reach = inverse_range(
                found, self.pixel_sigma**2 * inverse_variance(found.fit, found.fit.covariance), PositionStatus.OK
            )
            ok = reach.status == int(PositionStatus.OK)
            depth = found.scale / torch.where(ok, found.fit.inverse, 1.0)
            slope = position_slope(found.fit, found.scale, ok)
            covariance = self.pixel_sigma**2 * (slope @ symmetric(found.fit.covariance) @ slope.mT)
            unknown = torch.diag(covariance.new_full((3,), torch.inf))
            return Triangulation(
                points=torch.where(ok[..., None], depth[..., None] * found.fit.direction.mT, 0.0),
                status=reach.status,
                rays=(found.fit.direction / found.length[..., None, :]).mT,
                reprojection=torch.where(ok[..., None], reprojection_errors(found.fit.residual), 0.0),
                inverse_range=reach.value,
                inverse_range_sigma=reach.sigma,
                range_low=reach.interval.low,
                range_high=reach.interval.high,
                bearing_only=reach.weak,
                covariance=torch.where(ok[..., None, None], covariance, unknown),
            )

        return piece_by_piece(triangulate, left, right, differentiated=differentiated)
