"""The same thing in the other image: correlation along the epipolar line, then least squares to a part of a pixel.

For every distance along the left pixel's ray, the patch round it is carried into the right image through both lenses
and the rig, as a plane facing the left camera. Where it correlates best, a least-squares fit of shift, contrast and
brightness refines it (W. Förstner 1982; F. Ackermann, "Digital image correlation", 1984) in both directions: how far
the result lies off the epipolar line says whether it, and the rig, can be trusted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError
from kcal.lens.rig import StereoRig

_STEP = 0.5  # pixels between the places tried
_MOST = 4000  # places
_BLUR = 0.8  # pixels, of both images: bilinear samples of it are good to 0.005 px
_REPEATS = 15
_STILL = 1e-4  # pixels
_RIVAL = 3.0  # pixels between two places from which they are rivals
_CHUNK = 1 << 18  # points projected at a time


class MatchStatus(IntEnum):
    """What became of a point."""

    GOOD = 0
    NO_RAY = 1  # the pixel is not finite, or the left lens has no ray there
    OUTSIDE = 2  # the patch leaves the left image, or all that could correspond lies outside the right one
    FLAT = 3  # too little structure to tell where
    NO_MATCH = 4  # nothing along the line correlates well enough
    AMBIGUOUS = 5  # another place correlates nearly as well
    RESTLESS = 6  # the fit did not settle
    OFF_LINE = 7  # the fit left the epipolar line by more than it may


class Matches(NamedTuple):
    """Points found in the right image.

    Args:
        pixels: (N, 2) float64 in the right image; NaN where `status` is not `MatchStatus.GOOD`.
        covariance: (N, 2, 2) px², from the noise that the fit left; NaN where not good. Too small by up to half where
            noise is as strong as texture, because the image's slopes are noisy too.
        status: (N,) int64 of `MatchStatus`.
        score: (N,) best normalized correlation along the line, -1 to 1; NaN where none was computed.
        off_line: (N,) px, distance from the epipolar line, NaN where not good.
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
        nearest: meters, nearest distance in front of the left camera that is searched; 10 baselines if None.
        min_score: normalized correlation that is needed.
        max_rival: share of the best score that another place may have.
        max_off_line: pixels.

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
            raise InputError("match option half: 2 to 100 pixels are needed")
        if self.nearest is not None and not 0 < self.nearest < math.inf:
            raise InputError("match option nearest: a positive distance in meters is needed")
        if not 0 < self.min_score < 1 or not 0 < self.max_rival <= 1 or not self.max_off_line > 0:
            raise InputError("match options: min_score and max_rival lie between 0 and 1, max_off_line is positive")


class _Found(NamedTuple):
    status: MatchStatus
    pixel: Tensor | None = None
    covariance: Tensor | None = None
    score: float = math.nan
    off_line: float = math.nan


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
        pixels of the right image with covariance, status and correlation. Nothing is raised for a point that cannot
        be matched: read `status`.

    Raises:
        InputError: images that do not fit the cameras, pixels of a wrong shape.

    Example:
        >>> from kcal.lens.camera import Camera
        >>> camera = Camera.build(focal=(400, 400), center=(79.5, 59.5), size=(160, 120))
        >>> rig = StereoRig(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> image = torch.rand(15, 20, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        >>> left = torch.nn.functional.interpolate(image[None, None], scale_factor=8, mode="bicubic")[0, 0]
        >>> found = match_points(rig, left, left.roll(-12, 1), torch.tensor([[80.0, 60.0]]))  # disparity 12 px: 33 m
        >>> [round(value, 2) for value in found.pixels[0].tolist()]
        [68.0, 60.0]
    """
    options = options or MatchOptions()
    pixels = as_points("pixels_left", pixels_left, 2)
    if pixels.ndim != 2:
        raise InputError(f"pixels_left: shape (N, 2) is needed, got {tuple(pixels.shape)}")
    for word, image, camera in (("left", left, rig.left), ("right", right, rig.right)):
        if tuple(image.shape) != (camera.size[1], camera.size[0]):
            raise InputError(
                f"{word} image {tuple(image.shape)}: the {word} camera needs (H, W) = {camera.size[::-1]}; is it the "
                "right file?"
            )
    images = _blur(left), _blur(right)
    found = [_match(rig, *images, pixel, options) for pixel in pixels]
    nowhere = torch.full((2,), math.nan, dtype=torch.float64)
    nothing = torch.full((2, 2), math.nan, dtype=torch.float64)

    def stacked(values: list[Tensor], shape: tuple[int, ...]) -> Tensor:
        return torch.stack(values) if values else torch.zeros(shape, dtype=torch.float64)

    return Matches(
        stacked([nowhere if one.pixel is None else one.pixel for one in found], (0, 2)),
        stacked([nothing if one.covariance is None else one.covariance for one in found], (0, 2, 2)),
        torch.tensor([int(one.status) for one in found], dtype=torch.int64),
        torch.tensor([one.score for one in found], dtype=torch.float64),
        torch.tensor([one.off_line for one in found], dtype=torch.float64),
    )


def _match(rig: StereoRig, left: Tensor, right: Tensor, pixel: Tensor, options: MatchOptions) -> _Found:
    half = options.half
    axis = torch.arange(-half, half + 1, dtype=torch.float64)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    patch = pixel + torch.stack([x, y], -1).reshape(-1, 2)
    normalized, valid = rig.left.normalize(patch)
    middle = len(patch) // 2
    if not bool(valid[middle]):
        return _Found(MatchStatus.NO_RAY)
    if not bool(valid.all()) or not bool(_within(patch, left).all()):
        return _Found(MatchStatus.OUTSIDE)
    template = _sample(left, patch)
    if not float(template.std()) > 1e-6 * max(1.0, float(template.abs().max())):
        return _Found(MatchStatus.FLAT)

    directions = torch.cat([normalized, torch.ones_like(normalized[:, :1])], -1) @ rig.right_from_left_rotation.T
    nearest = options.nearest if options.nearest is not None else 10.0 * float(rig.baseline)

    def carried(inverse_depth: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Directions (K, 3) at 1 / z (C,) in the right image: (C, K, 2), and whether they are there."""
        moved = points + inverse_depth[:, None, None] * rig.right_from_left_translation
        return rig.right.project(moved)

    ends, seen = carried(torch.tensor([0.0, 1.0 / nearest], dtype=torch.float64), directions[middle : middle + 1])
    length = float(torch.linalg.vector_norm(ends[1] - ends[0])) if bool(seen.all()) else 2.0 * max(rig.right.size)
    count = min(max(3, math.ceil(length / _STEP) + 1), _MOST)
    inverse_depths = torch.linspace(0.0, 1.0 / nearest, count, dtype=torch.float64)
    line, scores = [], []
    for part in inverse_depths.split(max(1, _CHUNK // len(patch))):
        where, visible = carried(part, directions)
        usable = (visible & _within(where, right)).all(-1)
        correlation = _correlation(_sample(right, where), template)
        line.append(where[:, middle])
        scores.append(torch.where(usable, correlation, -torch.inf))
    places, score = torch.cat(line), torch.cat(scores)
    best = int(score.argmax())
    top = float(score[best])
    if top == -math.inf:
        return _Found(MatchStatus.OUTSIDE)
    if not top >= options.min_score:
        return _Found(MatchStatus.NO_MATCH, score=top)
    if _has_rival(places, score, best, options.max_rival):
        return _Found(MatchStatus.AMBIGUOUS, score=top)
    where = carried(inverse_depths[best : best + 1], directions)[0][0]
    return _refine(right, template, where, middle, _tangent(places, best), top, options)


def _refine(
    right: Tensor, template: Tensor, where: Tensor, middle: int, tangent: Tensor, score: float, options: MatchOptions
) -> _Found:
    """Shift of the carried patch by least squares, with contrast and brightness of its own."""
    shift = torch.zeros(2, dtype=torch.float64)
    step = math.inf
    for _ in range(_REPEATS):
        moved = where + shift
        if not bool(_within(moved, right).all()):
            return _Found(MatchStatus.OUTSIDE, score=score)
        values = _sample(right, moved)
        slope = torch.stack([_sample(right, moved + d) - _sample(right, moved - d) for d in torch.eye(2)], -1) / 2.0
        # right(moved + s) = gain * template + offset, linear in s, gain and offset.
        design = torch.cat([slope, -template[:, None], -torch.ones_like(template)[:, None]], -1)
        solution = torch.linalg.lstsq(design, -values[:, None], driver="gelsd").solution[:, 0]
        step = float(torch.linalg.vector_norm(solution[:2]))
        shift = shift + solution[:2] * min(1.0, 1.0 / max(step, 1e-12))
        if step < _STILL:
            break
    if step >= 10 * _STILL:
        return _Found(MatchStatus.RESTLESS, score=score)
    residual = values + design @ solution
    covariance = _covariance(design, residual)
    # Across the line only: along it the search stops at the nearest of its places.
    off = abs(float(tangent[0] * shift[1] - tangent[1] * shift[0]))
    if off > options.max_off_line:
        return _Found(MatchStatus.OFF_LINE, score=score, off_line=off)
    return _Found(MatchStatus.GOOD, where[middle] + shift, covariance, score, off)


def _covariance(design: Tensor, residual: Tensor) -> Tensor:
    """Of the shift, allowing for the blur that makes neighbors' noise alike.

    The estimate is A n with A = (JᵀJ)⁻¹Jᵀ; blurred white noise has the covariance s² B Bᵀ, so A's rows are blurred
    once more, and the residual's variance is s² times the sum of the kernel's squares.
    """
    size = math.isqrt(len(design))
    estimator = torch.linalg.pinv(design)[:2].reshape(2, 1, size, size)
    kernel = _kernel()
    reach = len(kernel) // 2
    spread = torch.nn.functional.conv2d(estimator, kernel.reshape(1, 1, 1, -1), padding=(0, 2 * reach))
    spread = torch.nn.functional.conv2d(spread, kernel.reshape(1, 1, -1, 1), padding=(2 * reach, 0))
    blurred = spread.reshape(2, -1)
    share = float(kernel.square().sum()) ** 2  # of the noise's variance that the blur leaves
    # Of the residuals too only so many are independent.
    freedom = max(1.0 - design.shape[1] / (len(design) * share), 0.2)
    noise = residual.square().mean() / (share * freedom)
    return noise * blurred @ blurred.T


def _has_rival(places: Tensor, score: Tensor, best: int, share: float) -> bool:
    """Whether a peak elsewhere on the line is nearly as high."""
    inner = score[1:-1]
    peak = torch.zeros_like(score, dtype=torch.bool)
    peak[1:-1] = (inner >= score[:-2]) & (inner >= score[2:])
    away = torch.linalg.vector_norm(places - places[best], dim=-1) > _RIVAL
    return bool((peak & away & (score > share * score[best])).any())


def _tangent(places: Tensor, best: int) -> Tensor:
    low, high = max(best - 1, 0), min(best + 1, len(places) - 1)
    return torch.nn.functional.normalize(places[high] - places[low], dim=0)


def _correlation(samples: Tensor, template: Tensor) -> Tensor:
    """Normalized correlation (C,) of samples (C, K) with a template (K,)."""
    a = samples - samples.mean(-1, keepdim=True)
    b = template - template.mean()
    norm = torch.linalg.vector_norm(a, dim=-1) * torch.linalg.vector_norm(b)
    return (a @ b) / norm.clamp_min(1e-12)


def _within(where: Tensor, image: Tensor) -> Tensor:
    """Whether positions have room for a sample and its slope."""
    x, y = where.unbind(-1)
    height, width = image.shape
    return (x >= 1) & (y >= 1) & (x <= width - 2) & (y <= height - 2)


def _sample(image: Tensor, where: Tensor) -> Tensor:
    """Bilinear samples at (..., 2)."""
    size = torch.tensor([image.shape[1] - 1.0, image.shape[0] - 1.0], dtype=torch.float64)
    grid = (2.0 * where / size - 1.0).reshape(1, 1, -1, 2)
    values = torch.nn.functional.grid_sample(
        image[None, None], grid, mode="bilinear", padding_mode="border", align_corners=True
    )
    return values.reshape(where.shape[:-1])


def _kernel() -> Tensor:
    reach = math.ceil(3.5 * _BLUR)
    offset = torch.arange(-reach, reach + 1, dtype=torch.float64)
    weights = torch.exp(-0.5 * (offset / _BLUR) ** 2)
    return weights / weights.sum()


def _blur(image: Tensor) -> Tensor:
    kernel = _kernel()
    reach = len(kernel) // 2
    padded = torch.nn.functional.pad(image.to(torch.float64)[None, None], (reach,) * 4, mode="replicate")
    rows = torch.nn.functional.conv2d(padded, kernel.reshape(1, 1, 1, -1))
    result: Tensor = torch.nn.functional.conv2d(rows, kernel.reshape(1, 1, -1, 1))[0, 0]
    return result
