"""How large amplitudes are on the average, where views tell them only roughly.

The evidence is largest at one amplitude A of a family of modes; others explain the views nearly as well. A mode of
which the views say nothing then has the variance <A²>, the mean over what they leave. It is larger than that at the
maximum: with few views of a board its print errors may come out as next to none, and error bars of the lens are too
small with them (Kass and Steffey 1989 correct covariances for it). Measured: `docs/measured/ordinary.md`.

Each ln A is varied by itself, all others following along the Hessian of -ln p at the maximum.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from kcal.calibrate.hybrid.evidence import EvidenceLoss, Maximum, hyper_bounds
from kcal.calibrate.hybrid.families import Hyperprior, PriorFamilies
from kcal.calibrate.hybrid.quadratic import ViewData

# Where -ln p is taken, in standard deviations: the upper side has the long tail of <A²>.
_PLACES = np.arange(-2.25, 4.0, 0.75)
# Directions in which -ln p does not bend are followed by no more than this standard deviation.
_WIDEST = 2.0


def expected_maximum(
    data: ViewData, families: PriorFamilies, best: Maximum, hyperprior: Hyperprior, tempering: float = 1.0
) -> Maximum:
    """The maximum of the evidence with all amplitudes in use, those of motions too, replaced by √<A²>.

    Args:
        data: what the views say.
        families: the priors.
        best: where the evidence is largest.
        hyperprior: of the hyperparameters.
        tempering: by which the data counted less there.

    Raises:
        ArithmeticError: the evidence is beyond numbers at its maximum: nothing can be averaged.
    """
    count, log_variance = len(best.h), math.log(best.variance)
    used = families.amplitude
    which = [*used[used >= 0].unique().tolist(), *range(count, count + len(best.log_ratio))]
    loss = EvidenceLoss(data, families, hyperprior, tempering)
    at = np.concatenate([best.h.numpy(), best.log_ratio, [log_variance]])
    value, _, bend = loss(at)
    if not math.isfinite(value):
        raise ArithmeticError("the views contradict each other so far that the evidence of their lens is no number")
    found = expected_amplitudes(
        bend,
        loss.values,
        at,
        which,
        hyper_bounds(hyperprior, len(best.log_ratio), log_variance),
    )
    return best._replace(h=torch.from_numpy(found[:count].copy()), log_ratio=found[count:-1].copy())


def expected_amplitudes(
    bend: np.ndarray,
    values: Callable[[np.ndarray], np.ndarray],
    at: np.ndarray,
    which: list[int],
    bounds: list[tuple[float, float | None]],
) -> np.ndarray:
    """½ ln <A²> of some hyperparameters, and the others as they are.

    Args:
        bend: (H, H) the Hessian of -ln p.
        values: -ln p alone, (N,) of places (N, H).
        at: (H,) where it is smallest.
        which: numbers of the ln A.
        bounds: of all.

    Example:
        >>> def loss(v):  # ln A is normal, with a standard deviation of a half: <A²> = exp(2 · ¼)
        ...     return 2.0 * (v * v).sum(-1)
        >>> found = expected_amplitudes(4.0 * np.eye(2), loss, np.zeros(2), [0], [(-9.0, 9.0), (-9.0, None)])
        >>> [round(float(value), 2) for value in found]
        [0.25, 0.0]
    """
    covariance = _inverse(bend)
    found = at.copy()
    for i in which:
        sigma = math.sqrt(covariance[i, i])
        low, high = bounds[i]
        places = np.array([t for t in sigma * _PLACES if low <= at[i] + t <= (math.inf if high is None else high)])
        along = covariance[:, i] / covariance[i, i]
        losses = values(at + places[:, None] * along)
        share = np.exp(losses.min() - losses)
        found[i] += 0.5 * math.log(float(share @ np.exp(2.0 * places)) / float(share.sum()))
    return found


def _inverse(bend: np.ndarray) -> np.ndarray:
    """The inverse of the Hessian; where it does not bend upward, the widest."""
    values, vectors = np.linalg.eigh(bend)
    return np.asarray((vectors / np.maximum(values, _WIDEST**-2)) @ vectors.T)
