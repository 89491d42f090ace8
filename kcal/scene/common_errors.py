"""What errors of matches have in common: overlapping patches, and one thing in several pairs.

The fit of a match tells what noise does to it. What remains shows in how far matches lie off their epipolar lines, and
most of it is the same whenever the same thing is seen in the same light: it is no smaller after a hundred pairs. It
comes from edges before something farther away, of which a patch holds another part in each image. Both parts are
learned from the matches themselves, for classes of how much of a patch fits.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from kcal.scene.line_errors import LineErrors
from kcal.scene.refine import HALF

PATCH = 2.0 * HALF + 1.0  # pixels across
# Pixels of sway of a mast between pairs, of disparity and of place within which two matches are of one thing.
_SWAY, _SAME_DISPARITY, _SAME_PLACE = 8.0, 1.5, 1.5
# Errors off the epipolar lines beyond so many standard deviations are wrong matches, and tell nothing of the others.
WRONG = 5.0
# Pairs of matches of one thing without which nothing is learned: then all that is not noise counts as common.
_FEWEST = 50
# Classes of how much of a patch fits. By quarters, errors beyond noise are 0.11, 0.09, 0.02 and 0.03 px (two terrains).
_CLASSES = 4
# Degree of the polynomial that takes errors of lenses out, which are known from elsewhere and smooth.
_DEGREE = 4
# The floor under variances that is tried, px².
_FLOORS = [0.0, *np.geomspace(1e-5, 0.04, 25).tolist()]


@torch.no_grad()
def with_common_errors(
    lines: Sequence[LineErrors], pixels: Sequence[Tensor], covariance: Sequence[Tensor], share: Sequence[Tensor]
) -> list[Tensor]:
    """Covariances (M, 2, 2) of the matches of some pairs with which they may be counted as if they were independent.

    Patches that fit as a whole are good to the noise; those that fit in part have errors of their own, which stay as
    long as the light does. So the variance beyond noise, and the part of it that pairs have in common, are learned
    for several classes of that share. A match counts with the sum of its covariances with itself and with all
    others, each weighted as it will be: neighbors have nearly the same effect on a pose, and so its variance is right.

    Args:
        lines: of each pair, by the rig as its matches make it.
        pixels: (M, 2, 2) left and right of each pair.
        covariance: (M, 2, 2) px² of the right pixels by noise alone.
        share: (M,) see `kcal.scene.refine.RefinedMatches`.
    """
    places, stated = torch.cat(list(pixels)), torch.cat(list(covariance))
    if not len(places):
        return list(covariance)
    off = torch.cat([one.off for one in lines])
    sigma = torch.cat([one.sigma(own) for one, own in zip(lines, covariance, strict=True)])
    pair = torch.repeat_interleave(torch.tensor([len(own) for own in pixels]))
    kind = _classes(torch.cat(list(share)), len(pixels))
    scale, floor, common = (torch.zeros(len(places), dtype=torch.float64) for _ in range(3))
    variance = sigma.square()
    # What is smooth over the image is told best by those that turn out to be good.
    for _ in range(2):
        error = _without_lenses(off, variance.sqrt(), places[:, 0])
        good = error.abs() < WRONG * sigma
        for one in kind.unique():
            own = kind == one
            scale[own], floor[own] = _error_variance(error[own & good], sigma[own & good])
        variance = scale * sigma.square() + floor
    still = places[:, 0] - _shifts(places, pair)[pair]
    near = torch.from_numpy(cKDTree(still.numpy()).query_pairs(PATCH, p=math.inf, output_type="ndarray")).long()
    same_time = pair[near[:, 0]] == pair[near[:, 1]]
    apart = (still[near[:, 0]] - still[near[:, 1]]).abs()
    overlap = (1.0 - apart / PATCH).clamp_min(0.0).prod(1)
    # Only things at one distance are the same.
    disparity = places[:, 1] - places[:, 0]
    alike = (disparity[near[:, 0]] - disparity[near[:, 1]]).abs().amax(1) < _SAME_DISPARITY
    same = ~same_time & alike & (apart < _SAME_PLACE).all(1) & good[near].all(1)
    for one in kind.unique():
        own = kind == one
        both = same & own[near].all(1)
        common[own] = _common_share(error, variance, near[both], overlap[both])
    common = common * variance
    weight = 1.0 / (common + (variance - common) / len(pixels))
    part = overlap * torch.where(same_time[:, None], variance[near], common[near]).prod(1).sqrt()
    total = variance * weight
    for side in (0, 1):
        total.index_add_(0, near[:, side], part * weight[near[:, 1 - side]])
    total = total / weight
    counted = (total / variance)[:, None, None] * (
        scale[:, None, None] * stated + floor[:, None, None] * torch.eye(2, dtype=torch.float64)
    )
    return list(counted.split([len(own) for own in pixels]))


def _classes(share: Tensor, pairs: int) -> Tensor:
    """(M,) number of the class, each with as many."""
    count = max(1, min(_CLASSES, len(share) // (pairs * _FEWEST)))
    edges = share.quantile(torch.arange(1, count, dtype=torch.float64) / count)
    return torch.bucketize(share, edges)


def smooth_columns(pixels: Tensor) -> Tensor:
    """(M, K) powers of places (M, 2), which errors of lenses are made of."""
    at = pixels - pixels.mean(0)
    at = at / at.square().mean(0).sqrt().clamp_min(1e-6)
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    return torch.stack([at[:, 0] ** i * at[:, 1] ** j for i, j in powers], -1)


def _without_lenses(error: Tensor, sigma: Tensor, pixels: Tensor) -> Tensor:
    """Errors without what is smooth over the image."""
    columns = smooth_columns(pixels)
    good = (error.abs() < WRONG * sigma).nonzero()[:, 0]
    if len(good) < 4 * columns.shape[1]:
        return error
    weight = 1.0 / sigma[good]
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


def _common_share(error: Tensor, variance: Tensor, same: Tensor, overlap: Tensor) -> float:
    """Share of the variance that matches of one thing at two times have in common, from their errors' products."""
    if len(same) < _FEWEST:
        return 1.0
    product = error[same].prod(1) / variance[same].prod(1).sqrt()
    return float((product.sum() / overlap.sum()).clamp(0.0, 1.0))
