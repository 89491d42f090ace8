"""What errors of matches have in common: overlapping patches, and one thing in several pairs.

The fit of a match tells what noise does to it. What remains shows in how far matches lie off their epipolar lines, and
most of it is the same whenever the same thing is seen in the same light: it is no smaller after a hundred pairs. It
comes from patches that look different in both images: ground at a slant, whose blur is another one in each, and edges
before something farther away. Before the ground these even have a direction: its texture, seen from above, runs away
from the middle of the image, and where it meets an edge that stands upright, a corner appears that goes up or down as
the camera moves. Both parts are learned from the matches themselves, for classes of slant and of misfit, and matches
far worse than the others of their class count less.
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
# Degrees of freedom of Student's distribution that are tried; the last one is as good as Gaussian.
_TAILS = (2.0, 3.0, 4.0, 6.0, 10.0, 30.0, 1000.0)
# Pairs of matches of one thing without which nothing is learned: then all that is not noise counts as common.
_FEWEST = 50
# Classes of slant and, in each, of misfit.
_SLANTS, _MISFITS = 2, 2
# Degree of the polynomial that takes errors of lenses out, which are known from elsewhere and smooth.
_DEGREE = 4
# The floor under variances that is tried, px².
_FLOORS = (0.0, *np.geomspace(1e-5, 0.04, 13).tolist())
# Rounds of lenses and variances in turn, and steps to the likeliest scale.
_ROUNDS, _STEPS = 4, 12


@torch.no_grad()
def with_common_errors(
    rigs: Sequence[StereoRig],
    pixels: Sequence[Tensor],
    covariance: Sequence[Tensor],
    slant: Sequence[Tensor],
    misfit: Sequence[Tensor],
) -> list[Tensor]:
    """Covariances (M, 2, 2) of the matches of some pairs with which they may be counted as if they were independent.

    Patches that look the same in both images are good to the noise; what is seen at a slant has errors of its own,
    which stay as long as the light does. So the variance beyond noise, and the part of it that pairs have in common,
    are learned for classes of slant and misfit (`_learned`). A match counts with the sum of its covariances with itself
    and with all others, each weighted as it will be: neighbors have nearly the same effect on a pose, and so its
    variance is right.

    Args:
        rigs: as each pair makes it.
        pixels: (M, 2, 2) left and right of each pair.
        covariance: (M, 2, 2) px² of the right pixels by noise alone.
        slant: (M,) see `kcal.scene.refine.RefinedMatches`.
        misfit: (M,) likewise.
    """
    places, stated = torch.cat(list(pixels)), torch.cat(list(covariance))
    if not len(places):
        return list(covariance)
    found = [off_line(*one) for one in zip(rigs, pixels, covariance, strict=True)]
    off, sigma = (torch.cat(part) for part in zip(*found, strict=True))
    pair = torch.repeat_interleave(torch.tensor([len(own) for own in pixels]))
    kind = _classes(slant, misfit)
    still = places[:, 0] - _shifts(places, pair)[pair]
    near = torch.from_numpy(cKDTree(still.numpy()).query_pairs(PATCH, p=math.inf, output_type="ndarray")).long()
    same_time = pair[near[:, 0]] == pair[near[:, 1]]
    apart = (still[near[:, 0]] - still[near[:, 1]]).abs()
    overlap = (1.0 - apart / PATCH).clamp_min(0.0).prod(1)
    # Only things at one distance are the same.
    disparity = places[:, 1] - places[:, 0]
    alike = (disparity[near[:, 0]] - disparity[near[:, 1]]).abs().amax(1) < _SAME_DISPARITY
    same = ~same_time & alike & (apart < _SAME_PLACE).all(1)
    repeats = torch.ones(len(places), dtype=torch.float64)
    for side in (0, 1):
        repeats.index_add_(0, near[:, side], overlap)
    shape, influence, variance, share = _learned(off, sigma, places[:, 0], kind, repeats)
    common = torch.zeros_like(variance)
    for one in kind.unique():
        own = kind == one
        both = same & own[near].all(1)
        common[own] = _common_share(influence, variance, near[both], overlap[both])
    common = common * variance
    weight = 1.0 / (common + (variance - common) / len(pixels))
    part = overlap * torch.where(same_time[:, None], variance[near], common[near]).prod(1).sqrt()
    total = variance * weight
    for side in (0, 1):
        total.index_add_(0, near[:, side], part * weight[near[:, 1 - side]])
    total = total / weight
    # As if all directions were as much worse as the one across the epipolar line.
    floor = (shape - sigma.square()).clamp_min(0.0)[:, None, None] * torch.eye(2, dtype=torch.float64)
    counted = (total / (share * torch.maximum(shape, sigma.square())))[:, None, None] * (stated + floor)
    return list(counted.split([len(own) for own in pixels]))


def _classes(slant: Sequence[Tensor], misfit: Sequence[Tensor]) -> Tensor:
    """(M,) number of the class of slant and, within it, of misfit, each with as many."""
    # Contrast, and so misfit, depends on the light.
    beside = torch.cat([own / own.median().clamp_min(1e-9) if len(own) else own for own in misfit])
    most = max(1, sum(map(len, slant)) // (len(slant) * _FEWEST))
    slants = max(1, min(_SLANTS, most // _MISFITS))
    kind = _by_size(torch.cat(list(slant)), slants)
    found = torch.zeros_like(kind)
    for one in range(slants):
        own = kind == one
        found[own] = one * _MISFITS + _by_size(beside[own], min(_MISFITS, most // slants))
    return found


def _by_size(value: Tensor, count: int) -> Tensor:
    """(N,) number of the class of a value, each of some classes with as many."""
    if not len(value):
        return torch.zeros(0, dtype=torch.long)
    return torch.bucketize(value, value.quantile(torch.arange(1, count, dtype=torch.float64) / count))


def off_line(rig: StereoRig, pixels: Tensor, covariance: Tensor) -> tuple[Tensor, Tensor]:
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


def _learned(off: Tensor, sigma: Tensor, pixels: Tensor, kind: Tensor, repeats: Tensor) -> tuple[Tensor, ...]:
    """What errors (M,) of all classes tell: their variance, influence on a robust solution, its variance, and weights.

    Some matches are far worse than others and cannot be told from them beforehand: patches with an edge before
    something farther away, whose errors even have a direction in common. So errors have Student's distribution, and a
    match counts by the weight that this gives it. The influence of an error on such a solution is bounded, and its mean
    square is the variance that counts (P. Huber, "Robust Statistics", 1981, section 6.3); nothing has to be cut off.

    Args:
        off: px off the epipolar lines.
        sigma: by noise.
        pixels: (M, 2) left ones.
        kind: class.
        repeats: patches that tell the same, each by how much of it, with itself.
    """
    shape, weight, influence, variance = sigma.square(), torch.ones_like(sigma), off.clone(), sigma.square()
    for _ in range(_ROUNDS):
        error, leverage = _without_lenses(off, weight / shape, pixels)
        # What was taken out of the image with the lenses was in part these errors (J. MacKinnon and H. White 1985).
        widened = (1.0 - leverage * repeats).clamp_min(0.5).rsqrt()
        for one in kind.unique():
            own = kind == one
            if int(own.sum()) < _FEWEST:
                continue
            shape[own], tail = _error_variance(error[own], sigma[own])
            ratio = error[own].square() / shape[own]
            share = (tail + 1.0) / (tail + ratio)
            # The mean slope of the influence is what keeps a solution where it is.
            slope = (share * (tail - ratio) / (tail + ratio)).mean().clamp_min(0.1)
            bounded = share * error[own] / slope * widened[own]
            influence[own] = bounded
            moment = bounded.square() / shape[own]
            # A variance that few things tell is not sure; a solution that leans on the class that happened to come out
            # small is worse than it says by twice the relative variance of it.
            things = len(moment) / repeats[own].mean()
            unsure = (moment.square().mean() / moment.mean().square() - 1.0) / things
            # Errors that happen to be smaller than noise are not known to stay so.
            variance[own] = shape[own] * moment.mean().clamp_min(1.0) * (1.0 + 2.0 * unsure)
            weight[own] = share / share.mean()
    return shape, influence, variance, weight


def _without_lenses(error: Tensor, weight: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Errors without what is smooth over the image, and the leverage of each in telling that."""
    at = (pixels - pixels.mean(0)) / pixels.std(0).clamp_min(1e-6)
    powers = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    if len(error) < 4 * len(powers):
        return error, torch.zeros_like(error)
    root = weight.sqrt()[:, None]
    columns = torch.stack([at[:, 0] ** i * at[:, 1] ** j for i, j in powers], -1) * root
    basis = torch.linalg.qr(columns)[0]
    return error - (basis @ (basis.T @ (error[:, None] * root)) / root)[:, 0], basis.square().sum(1)


def _error_variance(error: Tensor, sigma: Tensor) -> tuple[Tensor, float]:
    """Squared scales (M,) and degrees of freedom of Student's distribution that make errors likeliest.

    The squares are a multiple of σ² + floor, and not below σ².
    """
    tails = torch.tensor(_TAILS, dtype=torch.float64).repeat(len(_FLOORS))[:, None]
    floor = torch.tensor(_FLOORS, dtype=torch.float64).repeat_interleave(len(_TAILS))[:, None]
    shape, square = sigma.square() + floor, error.square()
    least = (sigma.square() / shape).amax(1, keepdim=True)
    scale = torch.maximum(least, (0.45 * error.abs().median()) ** 2 / shape.median(1, keepdim=True).values)
    for _ in range(_STEPS):
        scale = ((tails + 1.0) * square / (tails * shape + square / scale)).mean(1, keepdim=True)
        scale = torch.maximum(scale, least)
    likelihood = (
        torch.lgamma(0.5 * (tails + 1.0)) - torch.lgamma(0.5 * tails) - 0.5 * torch.log(tails * scale * shape)
        - 0.5 * (tails + 1.0) * torch.log1p(square / (tails * scale * shape))
    ).mean(1)  # fmt: skip
    best = int(likelihood.argmax())
    return (scale * shape)[best], float(tails[best])


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
