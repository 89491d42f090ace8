"""Tell what stands still from what moves or changes, by images of the same rig at another time."""

from __future__ import annotations

import enum
import math

import torch
from torch import Tensor

from kcal.corners.patch_correlation import highest_peak, weighted_correlation
from kcal.corners.patch_windows import grid_of, has_samples, image_windows, sample
from kcal.lens.rig import StereoRig
from kcal.scene.refine import refine_matches

# Steps of a patch from its middle, and pixels by which masts may have swayed.
_HALF, SWAY = 7, 6
# Correlation of the same thing in other light; of waves and of what came or went it is below.
SAME = 0.6
# Standard deviations, and px, by which the disparity of one thing may differ between two times.
_SIGMAS, _SLACK = 5.0, 0.15


class Stillness(enum.IntEnum):
    """What another time says of a match."""

    STILL = 0
    NOT_THERE = 1
    ELSEWHERE = 2


@torch.no_grad()
def still_there(
    rig: StereoRig, image: Tensor, others: tuple[Tensor, Tensor], pixels: Tensor, covariance: Tensor
) -> Tensor:
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
    stays = torch.where(
        (change.abs() <= _SIGMAS * sigma + _SLACK).all(-1), int(Stillness.STILL), int(Stillness.ELSEWHERE)
    )
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
