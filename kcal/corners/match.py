"""Find a point of the left image in the right one, and points again in a later image of the same camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.checks import as_points, require_finite
from kcal.corners.images import Gray, to_8bit
from kcal.corners.patches import (
    ImageWindows,
    Peak,
    as_gray,
    filtered,
    fit_shifts,
    gaussian_kernel,
    grid_of,
    has_samples,
    highest_peak,
    image_windows,
    is_textured,
    sample,
    weighted_correlation,
)
from kcal.errors import InputError
from kcal.lens.rig import Rig
from kcal.opencv import cv2
from kcal.texts import brief, briefly

# Find a point of the left image in the right one: correlation along the epipolar line, then least squares.
#
# For each distance along the left pixel's ray, the patch around it is projected into the right image through both
# lenses and the rig, as a plane facing the left camera. Where it correlates best, a least-squares fit of shift,
# contrast and brightness refines it (W. Förstner 1982; F. Ackermann, "Digital image correlation", 1984). The fit is
# free in both directions, so its distance from the epipolar line shows whether the match, and the rig, can be trusted.

_SPACING = 0.5  # pixels between the places tried on the line
_MAX_PLACES = 4000
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


@briefly
class Matches(NamedTuple):
    """Points matched in the right image.

    Args:
        pixels: (N, 2) float64 in the right image; NaN where `status` is not `MatchStatus.GOOD`.
        covariance: (N, 2, 2) px², from the residuals of the fit; NaN where not good.
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


class PatchMatch(NamedTuple):
    """What became of one patch; the fields are those of `Matches`."""

    status: MatchStatus
    score: float = math.nan
    off_line: float = math.nan
    pixel: Tensor | float = math.nan
    covariance: Tensor | float = math.nan


@torch.no_grad()
def match_points(
    rig: Rig, left: Tensor, right: Tensor, pixels_left: Tensor, options: MatchOptions | None = None
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
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
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
    return joined([_match_one(rig, left, right, pixel, options) for pixel in pixels])


def joined(found: Sequence[PatchMatch]) -> Matches:
    """Join the matches of patches into one record."""
    numbers = torch.full((len(found), 8), math.nan, dtype=torch.float64)
    status = torch.tensor([int(match.status) for match in found], dtype=torch.int64)
    matches = Matches(numbers[:, :2], numbers[:, 2:6].unflatten(1, (2, 2)), status, numbers[:, 6], numbers[:, 7])
    for row, match in enumerate(found):
        matches.score[row], matches.off_line[row] = match.score, match.off_line
        matches.pixels[row], matches.covariance[row] = match.pixel, match.covariance
    return matches


def _match_one(rig: Rig, left: Tensor, right: Tensor, pixel: Tensor, options: MatchOptions) -> PatchMatch:
    half = options.half
    patch = pixel + grid_of((half, half), pixel.device)
    normalized, valid = rig.left.normalize(patch.flatten(0, 1))
    middle = len(normalized) // 2
    if not bool(valid[middle]):
        return PatchMatch(MatchStatus.NO_RAY)
    template = textured_patch(left, patch) if bool(valid.all()) else MatchStatus.OUTSIDE
    if isinstance(template, MatchStatus):
        return PatchMatch(template)
    directions = torch.cat([normalized, torch.ones_like(normalized[:, :1])], -1) @ rig.right_from_left_rotation.T
    nearest = options.nearest if options.nearest is not None else 10.0 * float(rig.baseline)

    def projected(inverse_depth: Tensor, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (C, K, 2) in the right image of directions (K, 3) at inverse depths (C,), and whether they exist."""
        return rig.right.project(points + inverse_depth[:, None, None] * rig.right_from_left_translation)

    ends, seen = projected(torch.tensor([0.0, 1.0 / nearest], dtype=torch.float64), directions[middle : middle + 1])
    length = float(torch.linalg.vector_norm(ends[1] - ends[0])) if bool(seen.all()) else 2.0 * max(rig.right.size)
    count = min(max(3, math.ceil(length / _SPACING) + 1), _MAX_PLACES)
    inverse_depths = torch.linspace(0.0, 1.0 / nearest, count, dtype=torch.float64)
    line, seen = projected(inverse_depths, directions[middle : middle + 1])
    places = line[:, 0]
    inside = seen[:, 0] & ((places >= 0) & (places <= torch.tensor(rig.right.size))).all(-1)
    if not bool(inside.any()):
        return PatchMatch(MatchStatus.OUTSIDE)
    # Lenses and perspective may stretch the patch.
    window = image_windows(right, beside(places[inside], 3 * half)[None], 0, math.inf)
    scores = []
    for part in inverse_depths.split(max(1, _MAX_PROJECTED // len(directions))):
        where, visible = projected(part, directions)
        where, visible = where.unflatten(1, template.shape), visible.unflatten(1, template.shape)
        usable = visible & has_samples(window, where[None])[0]
        samples = sample(window, where[None])[0]
        scores.append(weighted_correlation(template[None], torch.ones_like(template)[None], samples, usable)[:, 0, 0])
    peak = highest_peak(torch.cat(scores)[None, None], places[None])
    best = int(peak.number)
    where = projected(inverse_depths[best : best + 1], directions)[0][0].unflatten(0, template.shape)
    along = places[min(best + 1, count - 1)] - places[max(best - 1, 0)]
    return fit_peak(window, template, where, torch.nn.functional.normalize(along, dim=0), peak, options)


def beside(places: Tensor, distance: float) -> Tensor:
    """(2, 2) the corners of a box around places (N, 2) with room on all sides."""
    return torch.stack([places.amin(0) - distance, places.amax(0) + distance])


def textured_patch(image: Tensor, patch: Tensor) -> Tensor | MatchStatus:
    """The blurred gray levels (h, w) at positions (h, w, 2), or why there are none to match."""
    window = image_windows(image, patch[None], 0, math.inf)
    if not bool(has_samples(window, patch[None]).all()):
        return MatchStatus.OUTSIDE
    template = sample(window, patch[None])
    return template[0] if bool(is_textured(template, torch.ones_like(template))) else MatchStatus.FLAT


def fit_peak(
    right: ImageWindows, template: Tensor, where: Tensor, tangent: Tensor, peak: Peak, options: MatchOptions
) -> PatchMatch:
    """Judge the best place of one patch, and fit its shift from positions (h, w, 2) with contrast and brightness."""
    score = float(peak.score)
    if score <= -1.0:
        return PatchMatch(MatchStatus.OUTSIDE)
    if not score >= options.min_score:
        return PatchMatch(MatchStatus.NO_MATCH, score)
    if bool(peak.rival > options.max_rival * peak.score):
        return PatchMatch(MatchStatus.AMBIGUOUS, score)
    slopes = torch.eye(2, dtype=torch.float64).expand(1, *template.shape, 2, 2)
    weight, wanted = torch.ones_like(template)[None], torch.ones(1, dtype=torch.bool)
    # All pixels count: robust weights would let the background outvote a thin cross before it.
    fit = fit_shifts(template[None], right, where[None], slopes, weight, wanted, robust=False)
    if not bool(fit.converged):
        return PatchMatch(MatchStatus.NOT_CONVERGED, score)
    shift = fit.shift[0]
    if not bool(has_samples(right, (where + shift)[None]).all()):
        return PatchMatch(MatchStatus.OUTSIDE, score)
    # Only the part across the line counts: along it, the search stopped at the nearest of its places.
    off = abs(float(tangent[0] * shift[1] - tangent[1] * shift[0]))
    if off > options.max_off_line:
        return PatchMatch(MatchStatus.OFF_LINE, score, off)
    return PatchMatch(MatchStatus.GOOD, score, off, where[len(where) // 2, len(where) // 2] + shift, fit.covariance[0])


# Find points of an image again in a later image of the same camera, which may have moved a little.


@torch.no_grad()
def find_again(
    before: Tensor, after: Tensor, pixels: Tensor, reach: int = 40, options: MatchOptions | None = None
) -> Matches:
    """Find what was at given pixels of one image in another one of the same camera.

    The patch around each pixel is correlated with every place within `reach`, and the best place is refined by least
    squares, as in `match_points`. Light may have changed; scale and direction may not.

    Args:
        before: (H, W) gray levels of the old image.
        after: (H, W) of the new one.
        pixels: (N, 2) in the old image.
        reach: pixels by which objects may have moved along each axis.
        options: `half`, `min_score` and `max_rival` of `MatchOptions`.

    Returns:
        Pixels of the new image with covariance, status and correlation; `off_line` is 0 where one was found.

    Raises:
        InputError: images of unlike sizes, or pixels of another shape.

    Example:
        >>> image = torch.rand(15, 20, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        >>> before = torch.nn.functional.interpolate(image[None, None], scale_factor=8, mode="bicubic")[0, 0]
        >>> found = find_again(before, before.roll((-5, 3), (0, 1)), torch.tensor([[80.0, 60.0]]))
        >>> [round(value, 2) for value in found.pixels[0].tolist()]
        [83.0, 55.0]
    """
    options = options or MatchOptions()
    pixels = as_points("pixels", pixels, 2)
    if pixels.ndim != 2 or before.ndim != 2 or before.shape != after.shape:
        raise InputError(
            f"pixels (N, 2) and two images of one size are needed, got {tuple(pixels.shape)}, {tuple(before.shape)} "
            f"and {tuple(after.shape)}"
        )
    return joined([_found_again(before, after, pixel, reach, options) for pixel in pixels])


def _found_again(before: Tensor, after: Tensor, pixel: Tensor, reach: int, options: MatchOptions) -> PatchMatch:
    if not bool(torch.isfinite(pixel).all()):
        return PatchMatch(MatchStatus.NO_RAY)
    patch = pixel + grid_of((options.half,) * 2, pixel.device)
    template = textured_patch(before, patch)
    if isinstance(template, MatchStatus):
        return PatchMatch(template)
    wide = pixel + grid_of((options.half + reach,) * 2, pixel.device)
    window = image_windows(after, wide[None], 0, math.inf)
    usable = has_samples(window, wide[None])
    scores = weighted_correlation(template[None], torch.ones_like(template)[None], sample(window, wide[None]), usable)
    peak = highest_peak(scores, grid_of((reach,) * 2, pixel.device))
    return fit_peak(window, template, patch + peak.place[0], torch.zeros(2, dtype=torch.float64), peak, options)


# Keypoints of an image with descriptors, and the rough relative pose of two cameras from them, by OpenCV.

# Contrast of a keypoint on a scale on which OpenCV's default is 0.04: least-squares matching tells what is too faint.
_CONTRAST = 0.015
_SEED = 1


class Keypoints(NamedTuple):
    """Keypoints of an image, N of them, strongest first.

    Attributes:
        pixels: (N, 2) float64.
        descriptors: (N, 128) float32 of unit length: square roots of SIFT's (R. Arandjelović and A. Zisserman 2012).
    """

    pixels: Tensor
    descriptors: Tensor

    def at(self, which: Tensor) -> Keypoints:
        """The keypoints at these indices."""
        return Keypoints(self.pixels[which], self.descriptors[which])


def keypoints(image: Gray, most: int) -> Keypoints:
    """The strongest keypoints of an image (D. Lowe 2004), one at each place.

    Args:
        image: (H, W) gray levels.
        most: number at most.
    """
    found, descriptors = cv2.SIFT_create(contrastThreshold=_CONTRAST).detectAndCompute(to_8bit(image), None)  # type: ignore[attr-defined]
    if not found:
        return Keypoints(torch.zeros(0, 2, dtype=torch.float64), torch.zeros(0, 128))
    pixels = np.array([point.pt for point in found], np.float64)
    order = np.argsort([-point.response for point in found], kind="stable")
    # One place may have several orientations.
    _, first = np.unique(pixels[order].round(1), axis=0, return_index=True)
    kept = order[np.sort(first)][:most]
    root = np.sqrt(descriptors[kept] / np.maximum(descriptors[kept].sum(1, keepdims=True), 1e-9))
    return Keypoints(torch.from_numpy(pixels[kept]), torch.from_numpy(root))


def pose_between(first: Tensor, second: Tensor, tolerance: float) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation (3, 3) and unit translation (3,) second_from_first of most of N pairs of rays, and which (N,) these are.

    Args:
        first: (N, 3) rays of one camera, N at least 5.
        second: (N, 3) of the other.
        tolerance: radians that a ray may be off its epipolar plane.
    """
    plane = [np.ascontiguousarray((rays[:, :2] / rays[:, 2:]).numpy()) for rays in (first, second)]
    cv2.setRNGSeed(_SEED)
    matrix, inside = cv2.findEssentialMat(plane[0], plane[1], np.eye(3), cv2.USAC_MAGSAC, 0.9999, tolerance, 5000)
    nothing = torch.zeros(len(first), dtype=torch.bool)
    if matrix is None or matrix.shape != (3, 3):
        return torch.eye(3, dtype=torch.float64), torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64), nothing
    mask: npt.NDArray[np.uint8] = (np.asarray(inside) > 0).astype(np.uint8)
    _, rotation, shift, ahead = cv2.recoverPose(matrix, plane[0], plane[1], np.eye(3), mask=mask)
    return tuple(torch.from_numpy(np.asarray(part)) for part in (rotation, shift[:, 0], ahead[:, 0] > 0))  # type: ignore[return-value]


# Refine single points by eye on an enlarged crop (the paper's Section 4.3), or automatically where edges meet.

FACTOR = 10
HALF = 12  # pixels on each side of the point that are cropped
MAX_POINT_MOVE = 3.0  # pixels
_WINDOW = 4.0  # pixels: sigma of the weight of gradients around the point
_GRADIENT_BLUR = 0.7  # pixels
_MAX_ITERATIONS = 20
_CONVERGED = 1e-4  # pixels
_MIN_ROUNDNESS = 0.02  # smaller over larger eigenvalue of the gradients' scatter; nearly 0 for a single straight edge


@dataclass(frozen=True, kw_only=True)
class Enlarged:
    """A crop of an image, enlarged.

    Args:
        patch: (h * factor, w * factor) gray levels, bilinear.
        left: column of the image at which the crop begins.
        top: row at which it begins.
        factor: of enlargement.
    """

    patch: Tensor
    left: int
    top: int
    factor: int

    def to_image(self, marks: Tensor) -> Tensor:
        """Convert positions (..., 2) on the patch to pixels of the image.

        The *edges* of pixels coincide, not their centers: pixel x of the image covers [x - 0.5, x + 0.5], which is
        `factor` pixels of the patch. So u = (x + 0.5) / factor - 0.5 + left. Dividing by a factor of 10 alone would be
        wrong by 0.45 px.

        Example:
            >>> view = enlarge(torch.rand(40, 40), torch.tensor([20.0, 10.0]), half=4)
            >>> view.to_image(torch.tensor([[4.5, 4.5]])).tolist()  # the middle of the patch's first ten pixels
            [[16.0, 6.0]]
        """
        corner = torch.tensor([self.left, self.top], dtype=torch.float64)
        return (as_points("marks", marks, 2) + 0.5) / self.factor - 0.5 + corner

    def from_image(self, pixels: Tensor) -> Tensor:
        """Convert pixels (..., 2) of the image to positions on the patch; the inverse of `to_image`."""
        corner = torch.tensor([self.left, self.top], dtype=torch.float64)
        return (as_points("pixels", pixels, 2) - corner + 0.5) * self.factor - 0.5


@dataclass(frozen=True, kw_only=True)
class RefinedPoint:
    """A point refined to a fraction of a pixel.

    Args:
        pixel: (2,) float64.
        covariance: (2, 2) px², from how closely the edges meet in one point. An upper bound: blur rounds a corner,
            so that no edge points exactly at it.
    """

    __repr__ = brief

    pixel: Tensor
    covariance: Tensor


def enlarge(image: Tensor, pixel: Tensor, half: int = HALF, factor: int = FACTOR) -> Enlarged:
    """Crop an image around a pixel and enlarge it bilinearly, for marking by eye.

    Args:
        image: (H, W) gray levels.
        pixel: (2,) middle of the crop. The crop stays inside the image and is smaller at its border.
        half: pixels of the crop on each side of the middle one.
        factor: of enlargement.

    Raises:
        InputError: an image that is not (H, W) or not finite, a pixel outside it, or `half` or `factor` below 1.

    Example:
        >>> enlarge(torch.rand(40, 40), torch.tensor([20.3, 10.0])).patch.shape
        torch.Size([230, 250])
    """
    image = as_gray("image", image)
    pixel = as_points("pixel", pixel, 2)
    require_finite("pixel", pixel)
    if pixel.shape != (2,) or half < 1 or factor < 1:
        raise InputError(f"pixel {tuple(pixel.shape)}, half {half}, factor {factor}: (2,) and at least 1 are needed")
    height, width = image.shape
    column, row = (int(value) for value in pixel.round().tolist())
    if not (0 <= column < width and 0 <= row < height):
        raise InputError(f"pixel ({float(pixel[0]):g}, {float(pixel[1]):g}) is outside the image of {width}x{height}")
    left, top = max(column - half, 0), max(row - half, 0)
    crop = image[top : row + half + 1, left : column + half + 1]
    # align_corners=False is the half-pixel rule: edges coincide.
    patch = torch.nn.functional.interpolate(crop[None, None], scale_factor=factor, mode="bilinear", align_corners=False)
    return Enlarged(patch=patch[0, 0], left=left, top=top, factor=factor)


def refine_point(image: Tensor, pixel: Tensor) -> RefinedPoint:
    """Move a roughly marked corner (of a roof, a mast, a board) to where its edges meet.

    On a crop enlarged ten times, it finds the point at which all nearby edges point: W. Förstner and E. Gülch, "A fast
    operator for detection and precise location of distinct points, corners and centers of circular features", 1987.
    For corners of checkerboards `kcal.corners.erf.erf_saddle` is several times more accurate.

    Args:
        image: (H, W) gray levels.
        pixel: (2,) within about 2 px of the corner and at least 5 px inside the image.

    Returns:
        The corner and its covariance.

    Raises:
        InputError: a pixel near or outside the image's border, a place without a corner (flat, or one straight edge),
            several corners close together, or a corner more than 3 px away.

    Example:
        >>> x = torch.arange(40.0, dtype=torch.float64)
        >>> image = 100 * torch.outer(torch.sigmoid(2 * (x - 17.3)), torch.sigmoid(2 * (x - 20.6)))
        >>> [round(value, 1) for value in refine_point(image, torch.tensor([20.0, 18.0])).pixel.tolist()]
        [20.7, 17.4]
    """
    view = enlarge(image, pixel)
    start = view.from_image(pixel)
    height, width = view.patch.shape
    factor = view.factor
    room = torch.minimum(start, torch.tensor([width - 1.0, height - 1.0]) - start).min()
    if float(room) < 5 * factor:
        raise InputError("the point is within 5 px of the image's border: no room to refine it; mark another point")
    gradient = _gradients(view.patch, _GRADIENT_BLUR * factor)
    axes = (torch.arange(side, dtype=torch.float64) for side in (width, height))
    where = torch.stack(torch.meshgrid(*axes, indexing="xy"), -1)
    scatter = gradient[..., :, None] * gradient[..., None, :]
    place = start
    for _ in range(_MAX_ITERATIONS):
        weight = torch.exp(-0.5 * ((where - place) / (_WINDOW * factor)).square().sum(-1))
        normal = (weight[..., None, None] * scatter).sum((0, 1))
        eigenvalues = torch.linalg.eigvalsh(normal)
        if not float(eigenvalues[0]) > _MIN_ROUNDNESS * float(eigenvalues[1]):
            raise InputError("no corner here: the image is flat or a single straight edge; mark another point")
        right = (weight[..., None] * (scatter @ where[..., None])[..., 0]).sum((0, 1))
        moved = torch.linalg.solve(normal, right)
        step = float(torch.linalg.vector_norm(moved - place))
        place = moved
        if float(torch.linalg.vector_norm(place - start)) > MAX_POINT_MOVE * factor:
            raise InputError(f"the nearest corner is more than {MAX_POINT_MOVE:g} px away; mark the point more closely")
        if step < _CONVERGED * factor:
            break
    else:
        raise InputError("the point does not converge: several corners are close together; mark another point")
    miss = (gradient * (where - place)).sum(-1)
    # Neighboring pixels of the patch are interpolated: only one in factor² is an independent measurement.
    effective = weight.sum() / factor**2
    noise = (weight * miss.square()).sum() / weight.sum() * effective / (effective - 2.0).clamp_min(1.0)
    covariance = noise * factor**2 * torch.linalg.inv(normal)
    return RefinedPoint(pixel=view.to_image(place), covariance=covariance / factor**2)


def _gradients(patch: Tensor, sigma: float) -> Tensor:
    """Derivatives (H, W, 2) along x and y of a patch (H, W) after a Gaussian blur."""
    reach = round(4 * sigma)
    smooth = gaussian_kernel(sigma, reach)
    slope = torch.arange(-reach, reach + 1, dtype=torch.float64) * smooth / sigma**2
    return torch.stack([filtered(patch, slope, smooth), filtered(patch, smooth, slope)], -1)
