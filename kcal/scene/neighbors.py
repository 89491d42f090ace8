"""What errors of matches have in common farther than a patch: those of neighbors are a little alike.

A hill, a row of houses or the ground before the mast has slopes and edges of one kind, and the errors that they make
lean to one side. Between two matches that is next to nothing (some 2 % of their variance within 60 pixels), and in a
pose from hundreds of them a quarter to a third of its variance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from kcal.scene.common_errors import WRONG, smooth_columns
from kcal.scene.line_errors import LineErrors

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
    residual shows, are not in it (`kcal.scene.smooth_errors`).

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
