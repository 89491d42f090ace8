"""What errors of matches have in common: overlapping patches, and one thing in several pairs.

The fit of a match tells what noise does to it. What remains, of interpolation and of edges that are no plane, shows in
how far matches lie off their epipolar lines, and most of it is the same whenever the same thing is seen in the same
light: it is no smaller after a hundred pairs. Both parts are learned from the matches themselves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from kcal.lens.rig import StereoRig

# Pixels across a patch, as it is compared in `kcal.scene.refine`.
PATCH = 15.0
# Pixels of sway of a mast between pairs, of disparity and of place within which two matches are of one thing.
_SWAY, _SAME_DISPARITY, _SAME_PLACE = 8.0, 1.5, 1.5
# Errors off the epipolar lines beyond so many standard deviations are wrong matches, and tell nothing of the others.
_WRONG = 5.0
# Pairs of matches of one thing without which nothing is learned: then all that is not noise counts as common.
_FEWEST = 50
# Degree of the polynomial that takes errors of lenses out, which are known from elsewhere and smooth.
_DEGREE = 4
# The floor under variances that is tried, px².
_FLOORS = [0.0, *np.geomspace(1e-5, 0.04, 25).tolist()]


@torch.no_grad()
def with_common_errors(
    rigs: Sequence[StereoRig], pixels: Sequence[Tensor], covariance: Sequence[Tensor]
) -> list[Tensor]:
    """Covariances (M, 2, 2) of matches of some pairs with which they may be counted as if they were independent.

    The sum of a match's covariances with itself and with all others replaces its own: neighbors have nearly the same
    effect on a pose, and so its variance is right.

    Args:
        rigs: as each pair makes it.
        pixels: (M, 2, 2) left and right of each pair.
        covariance: (M, 2, 2) px² of the right pixels by noise alone.
    """
    places, stated = torch.cat(list(pixels)), torch.cat(list(covariance))
    if not len(places):
        return list(covariance)
    found = [_off_line(*one) for one in zip(rigs, pixels, covariance, strict=True)]
    error, sigma = (torch.cat(part) for part in zip(*found, strict=True))
    pair = torch.repeat_interleave(torch.tensor([len(own) for own in pixels]))
    error = _without_lenses(error, sigma, places[:, 0])
    good = error.abs() < _WRONG * sigma
    scale, floor = _error_variance(error[good], sigma[good])
    total = scale * stated + floor * torch.eye(2, dtype=torch.float64)
    z = torch.where(good, error / (scale * sigma.square() + floor).sqrt(), torch.nan)
    still = places[:, 0] - _shifts(places, pair)[pair]
    tree = cKDTree(still.numpy())
    near = torch.from_numpy(tree.query_pairs(PATCH, p=math.inf, output_type="ndarray")).long()
    same_time = pair[near[:, 0]] == pair[near[:, 1]]
    apart = still[near[:, 0]] - still[near[:, 1]]
    overlap = (1.0 - apart.abs() / PATCH).clamp_min(0.0).prod(1)
    # Only things at one distance have their texture and its errors in common at two times.
    disparity = places[:, 1] - places[:, 0]
    alike = ((disparity[near[:, 0]] - disparity[near[:, 1]]).abs() < _SAME_DISPARITY).all(1)
    common = _common_share(z, near[~same_time & alike], overlap[~same_time & alike])
    shared = torch.where(same_time, overlap, torch.where(alike, common * overlap, 0.0))
    count = torch.ones(len(places), dtype=torch.float64)
    for side in (0, 1):
        count.index_add_(0, near[:, side], shared)
    return list((count[:, None, None] * total).split([len(own) for own in pixels]))


def _off_line(rig: StereoRig, pixels: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (M,) by which right pixels are off their epipolar lines, and the standard deviations of that."""
    rays, _ = rig.left.unproject(pixels[:, 0])
    normal = torch.linalg.cross(rig.right_from_left_translation.expand_as(rays), rays @ rig.right_from_left_rotation.T)

    def off(at: Tensor) -> Tensor:
        found: Tensor = (rig.right.unproject(at)[0] * normal).sum(-1)
        return found

    steps = 0.1 * torch.eye(2, dtype=torch.float64)
    here = off(pixels[:, 1])
    slope = torch.stack([off(pixels[:, 1] + step) - here for step in steps], -1) / 0.1
    length = torch.linalg.vector_norm(slope, dim=-1)
    across = slope / length[:, None]
    return here / length, (across[:, None] @ covariance @ across[..., None])[:, 0, 0].sqrt()


def _without_lenses(error: Tensor, sigma: Tensor, pixels: Tensor) -> Tensor:
    """Errors without what is smooth over the image."""
    at = (pixels - pixels.mean(0)) / pixels.std(0).clamp_min(1e-6)
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    columns = torch.stack([at[:, 0] ** i * at[:, 1] ** j for i, j in powers], -1)
    good = (error.abs() < _WRONG * sigma).nonzero()[:, 0]
    if len(good) < 4 * len(powers):
        return error
    weight = 1.0 / (sigma[good] + sigma.median())
    fit = torch.linalg.lstsq(columns[good] * weight[:, None], (error[good] * weight)[:, None], driver="gelsd").solution
    return error - (columns @ fit)[:, 0]


def _error_variance(error: Tensor, sigma: Tensor) -> tuple[float, float]:
    """Scale and floor of variances scale σ² + floor, not below σ²: the likeliest for Gaussian errors."""
    if len(error) < _FEWEST:
        return 1.0, 0.0
    best = (math.inf, 1.0, 0.0)
    for floor in _FLOORS:
        shape = sigma.square() + floor
        scale = max(float((error.square() / shape).mean()), 1.0 if floor == 0.0 else 0.0)
        cost = float((torch.log(scale * shape) + error.square() / (scale * shape)).mean())
        best = min(best, (cost, scale, scale * floor))
    return best[1:]


def _shifts(places: Tensor, pair: Tensor) -> Tensor:
    """(P, 2) pixels by which each pair's left pixels are shifted against the first one's, as most matches have it."""
    count = int(pair[-1]) + 1
    found = torch.zeros(count, 2, dtype=torch.float64)
    first = places[pair == 0]
    # Disparity is a coordinate in which matches of one thing are as near as that.
    as_far = _SWAY / _SAME_DISPARITY
    tree = cKDTree(torch.cat([first[:, 0], as_far * (first[:, 1] - first[:, 0])], 1).numpy())
    for k in range(1, count):
        own = places[pair == k]
        near = tree.query_ball_point(torch.cat([own[:, 0], as_far * (own[:, 1] - own[:, 0])], 1).numpy(), _SWAY)
        index = [(i, j) for i, some in enumerate(near) for j in some]
        if len(index) < _FEWEST:
            continue
        mine, theirs = torch.tensor(index).unbind(1)
        moved = own[mine, 0] - first[theirs, 0]
        votes = cKDTree(moved.numpy()).query_ball_point(moved.numpy(), 1.0, return_length=True)
        inside = torch.linalg.vector_norm(moved - moved[int(votes.argmax())], dim=-1) < _SAME_PLACE
        found[k] = moved[inside].median(0).values
    return found


def _common_share(z: Tensor, near: Tensor, overlap: Tensor) -> float:
    """Share of the variance that matches of one thing at two times have in common, from their errors' products."""
    same = overlap > (1.0 - _SAME_PLACE / PATCH) ** 2
    product = (z[near[same, 0]] * z[near[same, 1]]).nan_to_num(0.0)
    used = ~z[near[same]].isnan().any(1)
    if int(used.sum()) < _FEWEST:
        return 1.0
    return float((product[used].sum() / overlap[same][used].sum()).clamp(0.0, 1.0))
