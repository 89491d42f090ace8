"""Find a point of the left image in the right one: correlation along the epipolar line, then least squares.

For each distance along the left pixel's ray, the patch around it is projected into the right image through both lenses
and the rig, as a plane facing the left camera. Where it correlates best, a least-squares fit of shift, contrast and
brightness refines it (W. Förstner 1982; F. Ackermann, "Digital image correlation", 1984). The fit is free in both
directions, so its distance from the epipolar line shows whether the match, and the rig, can be trusted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.corners.filters import as_gray, filtered, gaussian_kernel
from kcal.errors import InputError
from kcal.lens.rig import StereoRig

_SPACING = 0.5  # pixels between the places tried on the line
_MAX_PLACES = 4000
_IMAGE_BLUR = 0.8  # pixels, of both images: bilinear samples of it are good to 0.005 px
_MAX_ITERATIONS = 15
_CONVERGED = 1e-4  # pixels
RIVAL_DISTANCE = 3.0  # pixels from which two places count as different matches
_MAX_PROJECTED = 1 << 18  # points projected at a time, which bounds the memory


class MatchStatus(IntEnum):
    """Whether a point or an object was matched, or why not; the last two are of objects only (`ObjectDisparity`)."""

    GOOD = 0
    NO_RAY = 1  # the pixel is not finite, or the left lens has no ray there
    OUTSIDE = 2  # the patch leaves the left image, or all places that could correspond are outside the right one
    FLAT = 3  # the patch has no texture
    NO_MATCH = 4  # no place on the line correlates well enough
    AMBIGUOUS = 5  # another place correlates nearly as well
    NOT_CONVERGED = 6  # the fit did not converge
    OFF_LINE = 7  # the fit is too far from the epipolar line
    OCCLUDED = 8  # most of what is in the box differs between the images
    SATURATED = 9  # too much of the object is at the brightest gray level


class Matches(NamedTuple):
    """Points matched in the right image.

    Args:
        pixels: (N, 2) float64 in the right image; NaN where `status` is not `MatchStatus.GOOD`.
        covariance: (N, 2, 2) px², from the residuals of the fit; NaN where not good. Too small by up to half where
            noise is as strong as texture, because the image's slopes are then noisy too.
        status: (N,) int64 of `MatchStatus`.
        score: (N,) best normalized correlation along the line, -1 to 1; NaN where none was computed.
        off_line: (N,) px, distance from the epipolar line; NaN where the fit gave none.
    """

    pixels: Tensor
    covariance: Tensor
    status: Tensor
    score: Tensor
    off_line: Tensor


@dataclass(frozen=True, kw_only=True)
class MatchOptions:
    """Options of `match_points`.

    Args:
        half: the patch has (2 half + 1)² pixels.
        nearest: smallest searched distance in front of the left camera, meters; 10 baselines if None.
        min_score: smallest accepted normalized correlation.
        max_rival: largest accepted ratio of another place's score to the best one.
        max_off_line: largest accepted distance from the epipolar line, pixels.

    Raises:
        InputError: a value out of range.
    """

    half: int = 10
    nearest: float | None = None
    min_score: float = 0.8
    max_rival: float = 0.95
    max_off_line: float = 2.0

    def __post_init__(self) -> None:
        if not 2 <= self.half <= 100:
            raise InputError(f"match option half={self.half}: 2 to 100 pixels are needed")
        if self.nearest is not None and not 0 < self.nearest < math.inf:
            raise InputError(f"match option nearest={self.nearest}: a positive distance in meters is needed")
        if not 0 < self.min_score < 1 or not 0 < self.max_rival <= 1 or not self.max_off_line > 0:
            raise InputError("match options: min_score and max_rival lie between 0 and 1, max_off_line is positive")


class BlurredWindow(NamedTuple):
    """A part of a blurred image: large images are blurred only where they are searched.

    Attributes:
        values: (h, w) gray levels.
        corner: (2,) pixel of its first value.
        size: (2,) width and height of the whole image.
    """

    values: Tensor
    corner: Tensor
    size: tuple[int, int]


class PatchMatch(NamedTuple):
    """What became of one patch; the fields are those of `Matches`."""

    status: MatchStatus
    score: float = math.nan
    off_line: float = math.nan
    pixel: Tensor | float = math.nan
    covariance: Tensor | float = math.nan


@torch.no_grad()
def match_points(
    rig: StereoRig, left: Tensor, right: Tensor, pixels_left: Tensor, options: MatchOptions | None = None
) -> Matches:
    """Find in the right image what is at given pixels of the left one.

    Args:
        rig: the calibrated cameras.
        left: (H, W) gray levels of the left camera.
        right: (H, W) gray levels of the right camera.
        pixels_left: (N, 2).
        options: see `MatchOptions`.

    Returns:
        Pixels of the right image with covariance, status and correlation. A point that cannot be matched raises
        nothing: read `status`.

    Raises:
        InputError: images that do not fit the cameras or are not finite, or pixels of another shape.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(400, 400), center=(79.5, 59.5), size=(160, 120))
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> image = torch.rand(15, 20, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        >>> left = torch.nn.functional.interpolate(image[None, None], scale_factor=8, mode="bicubic")[0, 0]
        >>> found = match_points(rig, left, left.roll(-12, 1), torch.tensor([[80.0, 60.0]]))  # disparity 12 px: 33 m
        >>> [round(value, 2) for value in found.pixels[0].tolist()], MatchStatus(int(found.status[0])).name
        ([68.0, 60.0], 'GOOD')
    """
    options = options or MatchOptions()
    pixels = as_points("pixels_left", pixels_left, 2)
    if pixels.ndim != 2:
        raise InputError(f"pixels_left: shape (N, 2) is needed, got {tuple(pixels.shape)}")
    for word, image, camera in (("left", left, rig.left), ("right", right, rig.right)):
        if not isinstance(image, Tensor) or image.dtype.is_floating_point:
            as_gray(f"{word} image", image)
        if tuple(image.shape) != (camera.size[1], camera.size[0]):
            raise InputError(
                f"{word} image {tuple(image.shape)}: the {word} camera needs (H, W) = {camera.size[::-1]}; is it the "
                "right file?"
            )
    numbers = torch.full((len(pixels), 8), math.nan, dtype=torch.float64)
    found = Matches(
        numbers[:, :2],
        numbers[:, 2:6].unflatten(1, (2, 2)),
        torch.zeros(len(pixels), dtype=torch.int64),
        numbers[:, 6],
        numbers[:, 7],
    )
    for row, pixel in enumerate(pixels):
        match = _match_one(rig, left, right, pixel, options)
        found.status[row], found.score[row], found.off_line[row] = int(match.status), match.score, match.off_line
        found.pixels[row], found.covariance[row] = match.pixel, match.covariance
    return found


def _match_one(rig: StereoRig, left: Tensor, right: Tensor, pixel: Tensor, options: MatchOptions) -> PatchMatch:
    half = options.half
    axis = torch.arange(-half, half + 1, dtype=torch.float64)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    patch = pixel + torch.stack([x, y], -1).reshape(-1, 2)
    normalized, valid = rig.left.normalize(patch)
    middle = len(patch) // 2
    if not bool(valid[middle]):
        return PatchMatch(MatchStatus.NO_RAY)
    window = blurred_window(left, patch)
    if not bool(valid.all()) or not bool(_has_room(patch, window).all()):
        return PatchMatch(MatchStatus.OUTSIDE)
    template = sample_window(window, patch)
    if not float(template.std()) > 1e-6 * max(1.0, float(template.abs().max())):
        return PatchMatch(MatchStatus.FLAT)

    directions = torch.cat([normalized, torch.ones_like(normalized[:, :1])], -1) @ rig.right_from_left_rotation.T
    nearest = options.nearest if options.nearest is not None else 10.0 * float(rig.baseline)

    def projected(inverse_depth: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (C, K, 2) in the right image of directions (K, 3) at inverse depths (C,), and whether they exist."""
        return rig.right.project(points + inverse_depth[:, None, None] * rig.right_from_left_translation)

    ends, seen = projected(torch.tensor([0.0, 1.0 / nearest], dtype=torch.float64), directions[middle : middle + 1])
    length = float(torch.linalg.vector_norm(ends[1] - ends[0])) if bool(seen.all()) else 2.0 * max(rig.right.size)
    count = min(max(3, math.ceil(length / _SPACING) + 1), _MAX_PLACES)
    inverse_depths = torch.linspace(0.0, 1.0 / nearest, count, dtype=torch.float64)
    line, scores = [], []
    path, seen = projected(inverse_depths, directions[middle : middle + 1])
    # Lenses and perspective may stretch the patch.
    window = blurred_window(right, path[seen], 3 * half)
    for part in inverse_depths.split(max(1, _MAX_PROJECTED // len(patch))):
        where, visible = projected(part, directions)
        usable = (visible & _has_room(where, window)).all(-1)
        line.append(where[:, middle])
        scores.append(torch.where(usable, patch_correlation(sample_window(window, where), template), -torch.inf))
    places, score = torch.cat(line), torch.cat(scores)
    best = int(score.argmax())
    top = float(score[best])
    if top == -math.inf:
        return PatchMatch(MatchStatus.OUTSIDE)
    if not top >= options.min_score:
        return PatchMatch(MatchStatus.NO_MATCH, top)
    if _has_rival(places, score, best, options.max_rival):
        return PatchMatch(MatchStatus.AMBIGUOUS, top)
    where = projected(inverse_depths[best : best + 1], directions)[0][0]
    along = places[min(best + 1, count - 1)] - places[max(best - 1, 0)]
    return fit_shift(window, template, where, torch.nn.functional.normalize(along, dim=0), top, options)


def fit_shift(
    right: BlurredWindow, template: Tensor, where: Tensor, tangent: Tensor, score: float, options: MatchOptions
) -> PatchMatch:
    """Fit the shift of the projected patch by least squares, with a contrast and a brightness of its own."""
    shift = torch.zeros(2, dtype=torch.float64)
    for _ in range(_MAX_ITERATIONS):
        moved = where + shift
        if not bool(_has_room(moved, right).all()):
            return PatchMatch(MatchStatus.OUTSIDE, score)
        values = sample_window(right, moved)
        slope = (
            torch.stack([sample_window(right, moved + d) - sample_window(right, moved - d) for d in torch.eye(2)], -1)
            / 2.0
        )
        # right(moved + s) = gain * template + offset, linear in s, gain and offset.
        design = torch.cat([slope, -template[:, None], -torch.ones_like(template)[:, None]], -1)
        solution = torch.linalg.lstsq(design, -values[:, None], driver="gelsd").solution[:, 0]
        step = float(torch.linalg.vector_norm(solution[:2]))
        shift = shift + solution[:2] * min(1.0, 1.0 / max(step, 1e-12))
        if step < _CONVERGED:
            break
    if step >= 10 * _CONVERGED:
        return PatchMatch(MatchStatus.NOT_CONVERGED, score)
    # Only the part across the line counts: along it, the search stopped at the nearest of its places.
    off = abs(float(tangent[0] * shift[1] - tangent[1] * shift[0]))
    if off > options.max_off_line:
        return PatchMatch(MatchStatus.OFF_LINE, score, off)
    covariance = _shift_covariance(design, values + design @ solution)
    return PatchMatch(MatchStatus.GOOD, score, off, where[len(where) // 2] + shift, covariance)


def _shift_covariance(design: Tensor, residual: Tensor) -> Tensor:
    """Covariance of the shift, which allows for the correlation of neighboring pixels' noise by the blur.

    The estimate is A n with A = (JᵀJ)⁻¹Jᵀ. Blurred white noise has the covariance s² B Bᵀ, so A's rows are blurred
    once more, and the residual's variance is s² times the sum of the kernel's squares.
    """
    size = math.isqrt(len(design))
    estimator = torch.linalg.pinv(design)[:2].reshape(2, 1, size, size)
    kernel = _blur_kernel()
    beyond = 2 * (len(kernel) // 2)
    blurred = torch.nn.functional.conv2d(estimator, kernel.reshape(1, 1, 1, -1), padding=(0, beyond))
    blurred = torch.nn.functional.conv2d(blurred, kernel.reshape(1, 1, -1, 1), padding=(beyond, 0)).reshape(2, -1)
    share = float(kernel.square().sum()) ** 2  # of the noise's variance that the blur leaves, and of independent pixels
    freedom = max(1.0 - design.shape[1] / (len(design) * share), 0.2)
    noise = residual.square().mean() / (share * freedom)
    return noise * blurred @ blurred.T


def _has_rival(places: Tensor, score: Tensor, best: int, share: float) -> bool:
    """Whether another peak on the line is nearly as high."""
    inner = score[1:-1]
    peak = torch.zeros_like(score, dtype=torch.bool)
    peak[1:-1] = (inner >= score[:-2]) & (inner >= score[2:])
    away = torch.linalg.vector_norm(places - places[best], dim=-1) > RIVAL_DISTANCE
    return bool((peak & away & (score > share * score[best])).any())


def patch_correlation(samples: Tensor, template: Tensor) -> Tensor:
    """Normalized correlation (C,) of samples (C, K) with a template (K,)."""
    a = samples - samples.mean(-1, keepdim=True)
    b = template - template.mean()
    norm = torch.linalg.vector_norm(a, dim=-1) * torch.linalg.vector_norm(b)
    return (a @ b) / norm.clamp_min(1e-12)  # never divide by zero


def blurred_window(image: Tensor, where: Tensor, beyond: int = 0) -> BlurredWindow:
    """The part of a blurred image around positions (..., 2), with room for samples and their slopes."""
    size = image.shape[1], image.shape[0]
    kernel = _blur_kernel()
    room = len(kernel) // 2 + 3 + beyond
    spots = where.reshape(-1, 2)
    low = [0, 0] if not len(spots) else [math.floor(float(v)) - room for v in spots.amin(0)]
    high = [1, 1] if not len(spots) else [math.ceil(float(v)) + room + 1 for v in spots.amax(0)]
    left, top = (min(max(v, 0), most - 1) for v, most in zip(low, size, strict=True))
    right, bottom = (max(min(v, most), start + 1) for v, most, start in zip(high, size, (left, top), strict=True))
    values = filtered(image[top:bottom, left:right].to(torch.float64), kernel, kernel)
    return BlurredWindow(values, torch.tensor([left, top], dtype=torch.float64), size)


def _has_room(where: Tensor, image: BlurredWindow) -> Tensor:
    """Whether positions leave room for a sample and its slope."""
    width, height = image.size
    x, y = where.unbind(-1)
    inside = (x >= 1) & (y >= 1) & (x <= width - 2) & (y <= height - 2)
    # The blur repeats the window's edge: only inside it are values those of the whole image.
    reach = len(_blur_kernel()) // 2
    local = where - image.corner
    low = torch.where(image.corner > 0, reach, 0)
    end = torch.tensor(image.values.shape[::-1]) - 1
    high = torch.where(image.corner + end < torch.tensor([width - 1, height - 1]), end - reach, end)
    return inside & ((local >= low) & (local <= high)).all(-1)


def sample_window(image: BlurredWindow, where: Tensor) -> Tensor:
    """Bilinear samples at (..., 2)."""
    size = torch.tensor([max(image.values.shape[1] - 1.0, 1.0), max(image.values.shape[0] - 1.0, 1.0)]).double()
    grid = (2.0 * (where - image.corner) / size - 1.0).reshape(1, 1, -1, 2)
    values = torch.nn.functional.grid_sample(
        image.values[None, None], grid, mode="bilinear", padding_mode="border", align_corners=True
    )
    return values.reshape(where.shape[:-1])


def _blur_kernel() -> Tensor:
    return gaussian_kernel(_IMAGE_BLUR, math.ceil(3.5 * _IMAGE_BLUR))
