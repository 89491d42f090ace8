"""What became of marks: statuses, intervals of ranges, and what the rays of pixel pairs say before any noise."""

from __future__ import annotations

import enum
import math
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from kcal.checks import as_points, expanded, exportable
from kcal.dispatch import CHUNK, is_traced
from kcal.errors import DegenerateError, InputError
from kcal.lens.calibration import noise_of_marks
from kcal.lens.camera_like import unproject_each
from kcal.lens.rig import Rig
from kcal.locate.angular import EPIPOLE, triangulate_pairs
from kcal.texts import brief, briefly

# The 95 % interval of a range, from one over the range and its standard deviation.
#
# A range is skewed: at 5 km with 3.2 px of disparity, half a pixel too many puts a point 0.7 km nearer and half a pixel
# too few 0.9 km farther, and the far end is infinite once the disparity may be zero. A standard deviation of the range
# hides both. One over the range has nearly Gaussian errors, so its interval is carried over.

# Two-sided 95 % of a normal distribution.
QUANTILE = 1.959963984540054
# A parallax below this many standard deviations gives a bearing, but no range worth the name.
BEARING_SIGMAS = 3.0


def range_interval(inverse_range: Tensor, sigma: Tensor, known: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """The 95 % interval of the range, from the interval inverse_range ± 1.96 sigma.

    Args:
        inverse_range: (..., N) one over meters, negative where the rays diverge.
        sigma: (..., N) its standard deviation.
        known: (..., N) bool; where it is False the interval is 0 to infinity.

    Example:
        >>> f, baseline, disparity = 1600.0, 10.0, torch.tensor([3.2], dtype=torch.float64)
        >>> sigma = torch.tensor([0.5 / (f * baseline)], dtype=torch.float64)
        >>> low, high = range_interval(disparity / (f * baseline), sigma)
        >>> round(low.item(), 1), round(high.item(), 1)
        (3827.8, 7207.1)
    """
    ends = []
    for inverse, unknown in ((inverse_range + QUANTILE * sigma, 0.0), (inverse_range - QUANTILE * sigma, math.inf)):
        ahead = inverse > 0
        reach = torch.where(ahead, 1.0 / torch.where(ahead, inverse, 1.0), math.inf)
        ends.append(reach if known is None else torch.where(known, reach, unknown))
    return ends[0], ends[1]


# Radians. A smaller parallax is parallel for any camera: the point would be a billion baselines away.
_PARALLEL = 1e-9


class PositionStatus(enum.IntEnum):
    """Status of a located pixel pair. Only `OK` has a point; `PARALLEL` still has a bearing and a nearest range.

    CONTRADICTION, where all errors weigh: the views are not of one point, and which is wrong cannot be told.
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


def flagged(code: Tensor, *flags: tuple[Tensor, enum.IntEnum]) -> Tensor:
    """`code` (whole numbers) with a status where its condition is true; where several are, the last of them."""
    for condition, status in flags:
        code = torch.where(condition, code.new_full((), int(status)), code)
    return code


def checked_rig(rig: Rig, pixel_sigma: float | None) -> float:
    """The noise of marks as `noise_of_marks` decides it, after checking that the rig has a baseline."""
    sigma, _ = noise_of_marks(pixel_sigma, rig.calibration)
    if len(rig) < 2:
        raise InputError("a rig of two cameras or more is needed: one camera measures no range")
    apart = (rig.center - rig.center[0]).norm(dim=-1).amax()
    if not float(apart.detach()) > 0:
        raise DegenerateError("the rig's cameras stand in the same place: no range can be measured")
    return sigma


def checked_pairs(pixels_left: Tensor | ArrayLike, pixels_right: Tensor | ArrayLike, rig: Rig) -> tuple[Tensor, Tensor]:
    """Both as float64 (..., N, 2) on the rig's device, after checking types and shapes."""
    there = rig.right_from_left_translation
    left, right = as_points("pixels_left", pixels_left, 2, there), as_points("pixels_right", pixels_right, 2, there)
    if left.shape != right.shape or left.ndim < 2:
        raise InputError(
            "pixels_left and pixels_right: the same shape (..., N, 2) is needed, "
            f"got {tuple(left.shape)} and {tuple(right.shape)}"
        )
    return left, right


def checked_covariance(
    cov: Tensor | None, lead: tuple[int, ...], each: tuple[int, ...], like: Tensor | None = None
) -> Tensor | None:
    """(*lead, *each) float64 of covariances that broadcast to that; `each` ends with their rows and columns."""
    if cov is None:
        return None
    cov = as_points("cov", cov, each[-1], like)
    if cov.ndim < 2 or cov.shape[-2] != each[-1]:
        raise InputError(f"cov: shape (..., N, {', '.join(map(str, each))}) is needed, got {tuple(cov.shape)}")
    return expanded("cov", cov, (*lead, *each))


def checked_mask(mask: Tensor | ArrayLike, shape: tuple[int, ...], device: torch.device, name: str = "mask") -> Tensor:
    """A mask of bool, broadcast to a shape."""
    mask = torch.as_tensor(mask, device=device)
    if mask.dtype != torch.bool:
        raise InputError(f"{name}: bool is needed, got {mask.dtype}")
    return expanded(name, mask, shape)


def checked_views(
    pixels: Tensor | ArrayLike, seen: Tensor | ArrayLike | None, count: int, like: Tensor
) -> tuple[Tensor, Tensor]:
    """Pixels as float64 (..., N, V, 2) and which of them are seen, after checking types and shapes."""
    pixels = as_points("pixels", pixels, 2, like)
    if pixels.ndim < 3 or pixels.shape[-2] != count:
        raise InputError(f"pixels: shape (..., N, {count}, 2) is needed, got {tuple(pixels.shape)}")
    if seen is None:
        return pixels, torch.ones(pixels.shape[:-1], dtype=torch.bool, device=pixels.device)
    return pixels, checked_mask(seen, pixels.shape[:-1], pixels.device, "seen")


def joint_covariance(cov: Tensor) -> Tensor:
    """(..., 2 V, 2 V) of independent pixels with covariances (..., V, 2, 2)."""
    among = torch.eye(cov.shape[-3], dtype=cov.dtype, device=cov.device)
    return (cov[..., :, :, None, :] * among[:, None, :, None]).flatten(-2).flatten(-3, -2)


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
        rays: (..., N, 2, 3) unit rays of both cameras, each in its own frame.
        points: (..., N, 3) in the same frame, of `triangulate_pairs`; zeros where the rays do not meet ahead.
        status: (..., N) int8, codes of `PositionStatus`.
        along_baseline: (..., N) where a ray runs along the baseline, so that it meets the other everywhere on it.
    """

    rays: Tensor
    points: Tensor
    status: Tensor
    along_baseline: Tensor


def sight_lines(rig: Rig, pixels_left: Tensor, pixels_right: Tensor) -> SightLines:
    """Rays, closed-form points and statuses of float64 pixels, both (..., N, 2)."""
    rotation, translation = rig.right_from_left_rotation, rig.right_from_left_translation
    rays, seen = unproject_each((rig.left, rig.right), torch.stack([pixels_left, pixels_right], -3))
    rays_left, rays_right = rays.unbind(-3)
    inside = rig.left.inside(pixels_left) & rig.right.inside(pixels_right)
    finite = (torch.isfinite(pixels_left) & torch.isfinite(pixels_right)).all(-1)
    parallel, opposite, along_baseline = _epipolar(rays_left, rays_right @ rotation, -translation @ rotation)
    points, solved = triangulate_pairs(rays_left, rays_right, (rotation, translation))
    code = torch.full(rays_left.shape[:-1], int(PositionStatus.OK), dtype=torch.int8, device=rays_left.device)
    code = flagged(
        code,
        (parallel | along_baseline, PositionStatus.PARALLEL),
        ((opposite | ~(solved | parallel)) & ~along_baseline, PositionStatus.BEHIND),
        (~seen.all(-2), PositionStatus.OUTSIDE_LENS),
        (~inside, PositionStatus.OUTSIDE_IMAGE),
        (~finite, PositionStatus.NOT_FINITE),
    )
    return SightLines(rays.movedim(-3, -2), points, code, along_baseline)


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


def reprojection_errors(residual: Tensor) -> Tensor:
    """Residuals (..., 2 C, N) to distances in px (..., N, C), with a gradient of zero where there is no error."""
    squared = residual.unflatten(-2, (-1, 2)).square().sum(-2)
    some = squared > 0
    return torch.where(some, torch.sqrt(torch.where(some, squared, 1.0)), 0.0).mT


@exportable
class Localization(NamedTuple):
    """Result of `Localizer` for N points and V cameras; nothing in it is NaN, whatever went in. Look at `status` first.

    Attributes:
        enu: (..., N, 3) meters east, north, up of the origin, which of two cameras is the left one; in the rig's frame
            where it has no place on the Earth. Zeros unless the status is OK.
        covariance: (..., N, 3, 3) of `enu`, to first order; an infinite diagonal unless OK. At long range a position
            is skewed along the line of sight: quote the range interval.
        geodetic: (..., N, 3) latitude, longitude (degrees), ellipsoidal WGS84 height (meters); the origin unless OK,
            and zeros where the rig has no place on the Earth.
        range_low: (..., N) meters from the camera `anchor`, lower end of the 95 % interval.
        range_high: (..., N) upper end, infinite where the point may be at infinity. The interval is 0 to infinity
            where nothing is known, infinite at both ends where the rays diverge by more than the noise explains.
        status: (..., N) int8, codes of `PositionStatus`. BEARING_ONLY: the parallax is below three of its sigmas, so
            that a range would be noise, or one camera alone saw the point and its height is not known; PARALLEL: the
            lines of sight meet nowhere before the cameras. Both have a bearing and an interval. CONTRADICTION: the
            views are not of one point, and which is wrong cannot be told.
        bearing: (..., N, 3) unit vector in the frame of `enu`; zeros where nothing is known.
        inverse_range: (..., N) one over meters; negative where the rays diverge. Unlike the range its errors are
            Gaussian at any distance: the quantity for losses and filters.
        inverse_range_sigma: (..., N) its standard deviation; zero where nothing is known.
        reprojection: (..., N, V) distance in px between mark and reprojected point; zero where a view is not used.
        anchor: (..., N) int64, the first camera that saw the point: from where bearing and ranges count.
        used: (..., N, V) which views are part of the position.
        bad: (..., N, V) views that were left out because they contradict the others.
        misfit: (..., N, V) what leaving out each view changes, with all views: the root of the fall of χ² over two, in
            sigmas; 1 is typical. Of two views, either takes it all. It has no gradient.
    """

    enu: Tensor
    covariance: Tensor
    geodetic: Tensor
    range_low: Tensor
    range_high: Tensor
    status: Tensor
    bearing: Tensor
    inverse_range: Tensor
    inverse_range_sigma: Tensor
    reprojection: Tensor
    anchor: Tensor
    used: Tensor
    bad: Tensor
    misfit: Tensor

    def __repr__(self) -> str:
        return brief(self, status=status_counts(self.status))

    @property
    def range(self) -> Tensor:
        """(..., N) meters from the camera `anchor`; infinite unless the status is OK."""
        ok = self.status == int(PositionStatus.OK)
        return torch.where(ok, 1.0 / torch.where(ok, self.inverse_range, 1.0), torch.inf)


@briefly
class Sensitivity(NamedTuple):
    """Slopes of the range, infinite where there is no range; at long range they are valid for small errors only.

    Attributes:
        meters_per_pixel: (..., N) by a shift of one of the two marks in its worst direction.
        meters_per_degree: (..., N) by a turn of the right camera about its worst axis: relative yaw, for a rig whose
            cameras stand side by side.
    """

    meters_per_pixel: Tensor
    meters_per_degree: Tensor


def covariance_root(matrix: Tensor) -> Tensor:
    """(..., P, P) root with root rootᵀ = matrix, negative eigenvalues by rounding taken as zero."""
    values, vectors = torch.linalg.eigh(matrix)
    return vectors * values.clamp_min(0.0).sqrt()[..., None, :]
