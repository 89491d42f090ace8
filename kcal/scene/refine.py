"""Refine matches to a fraction of a pixel, and tell by another time what stands still."""

from __future__ import annotations

import enum
import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.corners.patches import (
    ImageWindows,
    ObjectPlanes,
    ShiftFit,
    fit_shifts,
    grid_of,
    has_samples,
    highest_peak,
    image_windows,
    object_planes,
    plane_pixels,
    sample,
    warped_blur_windows,
    weighted_correlation,
)
from kcal.lens.camera import Camera
from kcal.lens.rig import Rig

# Refine matches to a fraction of a pixel: patches are compared through both lenses on one plane.
#
# On that plane (`kcal.corners.patches`) a flat piece of the scene differs between the images by a shift, and by a
# scale and a shear along the baseline, whatever its slope. These, contrast, brightness and its slope are fitted by
# least squares (A. Gruen, "Adaptive least squares correlation", 1985).
#
# Optics blur both images alike, and so blur ground at a slant differently. Once its shear is known, each image is
# blurred once more as the other one was.

# Steps of a patch from its middle. Of 7, 10 and 13 tried on four terrains, 10 leaves half of the variance across lines
# that 7 does, and three quarters at edges; 13 leaves two thirds of that, of 1.7 times as many pixels.
HALF = 10
# px: the least-squares fit ends that near to where it began, or it found something else.
_FARTHEST = 3.0
# px along the worst axis: beyond, there is too little texture.
_FAINTEST = 0.35
# Share of a patch that must fit: less stands before and behind an edge.
_LEAST_SHARE = 0.55
# How much longer or shorter a pixel is in the other image: below, blur is alike, and beyond, it is no patch of ground.
_LEAST_WARPED, _MOST_WARPED = 0.05, 2.5
# Pixels that a patch covers in an image at most: of windows that are cut out together, all are as large as the largest.
_WIDEST = 200.0
_AT_ONCE = 200  # a thousand take a quarter longer


class RefinedMatches(NamedTuple):
    """Matches of which the left pixel is given.

    Attributes:
        right: (M, 2) px.
        covariance: (M, 2, 2) px² of it.
        good: (M,) whether it was found.
        share: (M,) share of the weight of a patch's pixels that fits: the others are of something behind or before.
    """

    right: Tensor
    covariance: Tensor
    good: Tensor
    share: Tensor


@torch.no_grad()
def refine_matches(rig: Rig, images: tuple[Tensor, Tensor], left: Tensor, right: Tensor) -> RefinedMatches:
    """Find where the right image shows what the left one shows at `left` (M, 2), from about `right` (M, 2) on.

    Args:
        rig: roughly as it stands.
        images: (H, W) float32 gray levels of both cameras.
        left: px.
        right: px.
    """
    parts = [_refined_part(rig, images, a, b) for a, b in zip(left.split(_AT_ONCE), right.split(_AT_ONCE), strict=True)]
    return RefinedMatches(*(torch.cat(values) for values in zip(*parts, strict=True)))


def _refined_part(rig: Rig, images: tuple[Tensor, Tensor], left: Tensor, right: Tensor) -> RefinedMatches:
    planes = object_planes(rig, left, right, torch.zeros(len(left), dtype=torch.float64))
    turn = rig.right_from_left_rotation
    here, steps, seen = _patch(rig.left, planes, planes.left, None)
    there, slopes, shown = _patch(rig.right, planes, planes.right, turn)
    valid = planes.valid & seen & shown & (_span(here) < _WIDEST) & (_span(there) < _WIDEST)
    here = torch.where(valid[:, None, None, None], here, 0.0)
    there = torch.where(valid[:, None, None, None], there, 0.0)
    flat = there.flatten(1, 2)
    wide = torch.cat([flat - _FARTHEST, flat + _FARTHEST], 1)

    def fitted(first: ImageWindows, second: ImageWindows, at: slice | Tensor = slice(None)) -> ShiftFit:
        weight = (has_samples(first, here[at]) & has_samples(second, there[at])).double()
        whole = valid[at] & (weight.mean((1, 2)) > _LEAST_SHARE)
        return fit_shifts(sample(first, here[at]), second, there[at], slopes[at], weight, whole, sheared=True)

    fit = fitted(image_windows(images[0], here, 0, math.inf), image_windows(images[1], wide, 0, math.inf))
    which = fit.converged.nonzero()[:, 0]
    warp = _warps(steps[which, HALF, HALF], slopes[which, HALF, HALF], fit.shear[which])
    longest, shortest = torch.linalg.svdvals(warp).unbind(1)
    unlike = (longest < _MOST_WARPED) & (shortest > 1.0 / _MOST_WARPED)
    unlike &= torch.maximum(longest - 1.0, 1.0 - shortest) > _LEAST_WARPED
    which, warp = which[unlike], warp[unlike]
    if len(which):
        first = warped_blur_windows(images[0], here[which], torch.linalg.inv(warp))
        second = warped_blur_windows(images[1], wide[which], warp)
        better = zip(fit, fitted(first, second, which), strict=True)
        fit = ShiftFit(*(before.index_copy(0, which, after) for before, after in better))
    column = planes.right + planes.step[:, None] * fit.shift
    pixels, inside = plane_pixels(rig.right, planes, column[:, None], turn)
    middle = slopes[:, HALF, HALF]
    covariance = middle @ fit.covariance @ middle.mT
    worst = torch.linalg.eigvalsh(covariance.nan_to_num(1e6))[:, -1].sqrt()
    near = torch.linalg.vector_norm(pixels[:, 0] - right, dim=-1) < _FARTHEST
    good = valid & fit.converged & inside[:, 0] & near & (worst < _FAINTEST) & (fit.share > _LEAST_SHARE)
    return RefinedMatches(pixels[:, 0], covariance, good, fit.share)


def _span(pixels: Tensor) -> Tensor:
    """(M,) the longer side of what patches (M, h, w, 2) cover, px."""
    flat = pixels.flatten(1, 2)
    return (flat.amax(1) - flat.amin(1)).amax(1)


def _warps(left: Tensor, right: Tensor, shear: Tensor) -> Tensor:
    """(N, 2, 2) pixels of the right image by those of the left, from both by steps of a patch and its shear (N, 2)."""
    stretched = torch.eye(2, dtype=torch.float64).repeat(len(shear), 1, 1)
    stretched[:, 0] += shear
    return right @ stretched @ torch.linalg.inv(left)


def _patch(
    camera: Camera, planes: ObjectPlanes, middle: Tensor, rotation: Tensor | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Pixels (M, h, w, 2) of patches, their derivatives (M, h, w, 2, 2) by a step, and which have all of them.

    Nine places of a patch are projected; a parabola goes through them, since a lens hardly bends within a patch.
    """
    nodes = HALF * grid_of((1, 1), middle.device)
    column = middle[:, None, None] + planes.step[:, None, None, None] * nodes
    places, seen = plane_pixels(camera, planes, column, rotation)
    t = torch.arange(-HALF, HALF + 1, dtype=torch.float64) / HALF
    values = torch.stack([0.5 * t * (t - 1.0), 1.0 - t.square(), 0.5 * t * (t + 1.0)], 1)
    steps = torch.stack([t - 0.5, -2.0 * t, t + 0.5], 1) / HALF
    pixels = torch.einsum("ya,xb,nabk->nyxk", values, values, places)
    across = torch.einsum("ya,xb,nabk->nyxk", values, steps, places)
    down = torch.einsum("ya,xb,nabk->nyxk", steps, values, places)
    return pixels, torch.stack([across, down], -1), seen.all(-1).all(-1)


# Tell what stands still from what moves or changes, by images of the same rig at another time.

# Steps of a patch from its middle, and pixels by which masts may have swayed.
_HALF, SWAY = 7, 6
# Correlation of the same point in other light; of waves and of what came or went it is below.
SAME = 0.6
# Standard deviations, and px, by which the disparity of one point may differ between two times.
_SIGMAS, _SLACK = 5.0, 0.15


class Stillness(enum.IntEnum):
    """What another time says of a match."""

    STILL = 0
    NOT_THERE = 1
    ELSEWHERE = 2


@torch.no_grad()
def still_there(rig: Rig, image: Tensor, others: tuple[Tensor, Tensor], pixels: Tensor, covariance: Tensor) -> Tensor:
    """(M,) `Stillness` of matches, by a pair of images of another time.

    Args:
        rig: roughly as it stands.
        image: (H, W), the left one of the matches' own time.
        others: left and right of another time.
        pixels: (M, 2, 2) left and right.
        covariance: (M, 2, 2) px² of the right one.
    """
    status = torch.full((len(pixels),), int(Stillness.NOT_THERE))
    moved, score = whole_shifts(image, others[0], pixels[:, 0], pixels[:, 0])
    there = (score > SAME).nonzero()[:, 0]
    if not len(there):
        return status
    left = pixels[there, 0] + moved[there]
    found = refine_matches(rig, others, left, pixels[there, 1] + moved[there])
    # Turns of both cameras move both pixels; a change of what lies between these is one of range.
    change = (found.right - left) - (pixels[there, 1] - pixels[there, 0])
    change = change - change[found.good].median(0).values if bool(found.good.any()) else change
    sigma = (found.covariance + covariance[there]).diagonal(dim1=-2, dim2=-1).sqrt()
    still = (change.abs() <= _SIGMAS * sigma + _SLACK).all(-1)
    stays = torch.where(still, int(Stillness.STILL), int(Stillness.ELSEWHERE))
    status[there] = torch.where(found.good, stays, status[there])
    return status


def whole_shifts(before: Tensor, after: Tensor, here: Tensor, there: Tensor, sway: int = SWAY) -> tuple[Tensor, Tensor]:
    """Whole pixels (M, 2) by which patches of an image are off from where they are looked for, and their correlation.

    Args:
        before: (H, W) gray levels with the patches.
        after: (H, W) those of another time.
        here: (M, 2) middles of the patches.
        there: (M, 2) where they are looked for.
        sway: px to each side.
    """
    moves, scores = [], []
    small, wide = grid_of((_HALF, _HALF), before.device), grid_of((_HALF + sway,) * 2, before.device)
    for some, others in zip(here.split(1000), there.split(1000), strict=True):
        first, second = some[:, None, None] + small, others[:, None, None] + wide
        one, two = image_windows(before, first, 0, math.inf), image_windows(after, second, 0, math.inf)
        weight = has_samples(one, first).double()
        found = weighted_correlation(sample(one, first), weight, sample(two, second), has_samples(two, second))
        peak = highest_peak(found, grid_of((sway, sway), before.device))
        moves.append(peak.place)
        scores.append(peak.score)
    return torch.cat(moves), torch.cat(scores)
