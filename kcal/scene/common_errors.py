"""Errors of matches: beside their epipolar lines, and what those of several matches have in common."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from kcal.calibrate.rig.source import Effect
from kcal.lens.pose import side_axes
from kcal.lens.rig import Rig
from kcal.scene.refine import HALF

# How far matches lie off their epipolar lines, and what turns and shifts of the rig change in that.


class LineErrors(NamedTuple):
    """Matches (M,) beside their epipolar lines in the right image.

    Attributes:
        off: pixels by which right pixels are off.
        across: (M, 2) unit vectors of the right image across the lines.
        slopes: (M, 5) by how much `off` changes with the rig: px per radian of its turns about the right camera's axes,
            and per share of the baseline of a shift along both axes across it.
    """

    off: Tensor
    across: Tensor
    slopes: Tensor

    def sigma(self, covariance: Tensor) -> Tensor:
        """Standard deviations (M,) of `off`, by covariances (M, 2, 2) px² of right pixels."""
        return (self.across[:, None] @ covariance @ self.across[..., None])[:, 0, 0].sqrt()


def line_errors(rig: Rig, pixels: Tensor) -> LineErrors:
    """Matches (M, 2, 2), left and right pixels, beside their epipolar lines.

    What is off has slopes of its own, which a pose does not use: slopes are those on the line.
    """
    left = rig.left.unproject(pixels[:, 0])[0] @ rig.right_from_left_rotation.T
    shift = rig.right_from_left_translation.expand_as(left)
    normal = torch.linalg.cross(shift, left)
    right = rig.right.unproject(pixels[:, 1])[0]
    steps = 0.1 * torch.eye(2, dtype=torch.float64)
    moved = torch.stack([rig.right.unproject(pixels[:, 1] + step)[0] for step in steps], -1)
    slope = (normal[..., None] * (moved - right[..., None])).sum(-2) / 0.1
    per_px = torch.linalg.vector_norm(slope, dim=-1, keepdim=True)
    # right · (shift x left) is what is off: a turn adds turn x left to left, a shift adds to shift.
    turned = -torch.linalg.cross(torch.linalg.cross(right, shift), left)
    axes = rig.baseline * torch.cat(side_axes(rig.right_from_left_translation[None] / rig.baseline))
    shifted = torch.linalg.cross(left, right) @ axes.T
    slopes = torch.cat([turned, shifted], 1) / per_px
    return LineErrors((right * normal).sum(-1) / per_px[:, 0], slope / per_px, slopes)


# What errors of matches have in common: overlapping patches, and one point in several pairs.
#
# The fit of a match tells what noise does to it. What remains shows in how far matches lie off their epipolar lines,
# and most of it is the same whenever the same thing is seen in the same light: it is no smaller after a hundred pairs.
# It comes from edges before something farther away, of which a patch holds another part in each image. Both parts are
# learned from the matches themselves, for classes of how much of a patch fits.

PATCH = 2.0 * HALF + 1.0  # pixels across
# Pixels of sway of a mast between pairs, of disparity and of place within which two matches are of one point.
_SWAY, _SAME_DISPARITY, _SAME_PLACE = 8.0, 1.5, 1.5
# Errors off the epipolar lines beyond so many standard deviations are wrong matches, and tell nothing of the others.
WRONG = 5.0
# Pairs of matches of one point without which nothing is learned: then all that is not noise counts as common.
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
    # Only points at one distance are the same.
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
    noise = scale[:, None, None] * stated + floor[:, None, None] * torch.eye(2, dtype=torch.float64)
    counted = (total / variance)[:, None, None] * noise
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
    # Disparity is a coordinate in which matches of one point are as near as that.
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
    """Share of the variance that matches of one point at two times have in common, from their errors' products."""
    if len(same) < _FEWEST:
        return 1.0
    product = error[same].prod(1) / variance[same].prod(1).sqrt()
    return float((product.sum() / overlap.sum()).clamp(0.0, 1.0))


# What errors of all matches have in common: parts that are smooth over the image, thousandths of a pixel.
#
# The ground before the mast, a row of hills, the height of the sun: what matches are off by leans a little with their
# place in the image. Between two matches that is next to nothing, but no number of matches makes it smaller. It changes
# pitch, roll and where the cameras stand, and hardly yaw: so it is an unknown of the adjustment, not a part of each
# match's σ, which would widen all of them alike.

# px across the lines of each of three errors, at the image's borders: the likeliest on 13 terrains at 960 x 540 (yaw's
# seeds 400-412; one and three pairs of a minute, and ten of a day of two of them). With the 20 of 430-449 χ² of the
# relative rotation, which should be 3, is 3.1 and 2.2 from one and three pairs, and 2.8 from ten; without them 4.1, 3.3
# and 6.9. Products and squares of both coordinates, which would change yaw, have no part in it.
_SMOOTH_PX = 0.0035
_NAMES = tuple(f"errors that matches share, {part}" for part in ("everywhere", "by columns", "by rows"))


def smooth_effects(pixels: Tensor, across: Tensor, size: tuple[int, int]) -> tuple[Effect, ...]:
    """Three errors: one everywhere, and one each that grows linearly from the middle of the left image to its borders.

    Args:
        pixels: (M, 2, 2) left and right.
        across: (M, 2) unit vectors of the right image across the lines.
        size: width and height of the left image.
    """
    place = 2.0 * pixels[:, 0] / torch.tensor(size) - 1.0
    amounts = torch.stack([torch.ones_like(place[:, 0]), *place.T])
    # Half of it in each image: matches tell the difference alone.
    sides = torch.tensor([-0.5, 0.5], dtype=torch.float64)[:, None] * across[:, None]
    shifts = _SMOOTH_PX * amounts[..., None, None] * sides
    return tuple(Effect(name=name, shift=shift) for name, shift in zip(_NAMES, shifts, strict=True))


# What errors of matches have in common farther than a patch: those of neighbors are a little alike.
#
# A hill, a row of houses or the ground before the mast has slopes and edges of one kind, and the errors that they make
# lean to one side. Between two matches that is next to nothing (some 2 % of their variance within 60 pixels), and in a
# pose from hundreds of them a quarter to a third of its variance.

# Share of the root of an image's pixels within which matches are neighbors, 45 px of 960 x 540: of 30, 45, 60, 80 and
# 120 px tried on 26 terrains, the farthest whose ratio of independent errors scatters as little (0.17); from 60 px on
# it scatters by 0.26, and tells no more.
_NEAR = 1.0 / 16.0


@torch.no_grad()
def pose_variance_ratio(
    lines: Sequence[LineErrors], pixels: Sequence[Tensor], covariance: Sequence[Tensor], size: tuple[int, int]
) -> float:
    """How many times larger the variance of a relative pose is than matches counted as independent make it.

    The variance of weighted least squares with errors that neighbors share (Conley 1999, with one weight for all that
    are near) over its value if none were shared. Both are of what a fit leaves, in which errors of lenses, which are
    known from elsewhere and smooth over the image, are absent; and both are summed over the five parameters of a
    relative pose, in units of their variances. The ratio counts as 1 at least. Smooth errors of matches, which no
    residual shows, are not in it (`smooth_effects`).

    Args:
        lines: of each pair, by the rig as its matches make it.
        pixels: (M, 2, 2) left and right of each pair.
        covariance: (M, 2, 2) px² of the right pixels, with which they are counted.
        size: width and height of the left image.
    """
    error, slope = (torch.cat([getattr(one, part) for one in lines]) for part in ("off", "slopes"))
    sigma = torch.cat([one.sigma(own) for one, own in zip(lines, covariance, strict=True)])
    places = torch.cat([one[:, 0] for one in pixels])
    good = error.abs() < WRONG * sigma
    error, slope, sigma, places = error[good], slope[good], sigma[good], places[good]
    smooth = smooth_columns(places)
    if len(error) < 4 * (smooth.shape[1] + slope.shape[1]):
        return 1.0
    slope = slope / sigma[:, None]
    fitted, singular_values, _ = torch.linalg.svd(torch.cat([slope, smooth / sigma[:, None]], 1), full_matrices=False)
    fitted = fitted[:, singular_values > 1e-9 * singular_values[0]]
    score = error / sigma
    score = score - fitted @ (fitted.T @ score)
    variance, singular = torch.linalg.inv_ex(slope.T @ slope)
    # Where matches leave a pose open, there is nothing to compare.
    if singular or not bool((variance.diagonal() > 0).all()):
        return 1.0
    weight = slope @ variance / variance.diagonal().sqrt()
    # A match with itself once, with each neighbor twice: in i, j and in j, i.
    near = _NEAR * math.sqrt(math.prod(size))
    i, j = torch.from_numpy(cKDTree(places.numpy()).query_pairs(near, output_type="ndarray")).long().T
    both = 2.0 * (weight[i] * weight[j]).sum(-1)
    alone = weight.square().sum(-1)
    real = (alone * score.square()).sum() + (both * score[i] * score[j]).sum()
    # The residuals of independent errors have the covariance 1 - fitted fittedᵀ.
    expected = (alone * (1.0 - fitted.square().sum(-1))).sum() - (both * (fitted[i] * fitted[j]).sum(-1)).sum()
    ratio = float(real / expected)
    return max(1.0, ratio) if math.isfinite(ratio) and expected > 0.0 else 1.0
