"""How large each family of unknowns may be, told by the data: amplitudes and noise that maximize the evidence.

Near a solution residuals are linear in lens and board (`kcal.calibrate.hybrid.quadratic`), poses eliminated. With
Gaussian priors of variances D(h) the unknowns can be integrated out, and

    -2 ln p(data | h, σ²) = ν ln σ² + rss/σ² + |y|² + ln |I + √D K √D / σ²|,   x = √D y at its best,

is minimized over the hyperparameters h (log amplitudes and decays) and the noise, together with a broad log-normal
prior on h (type-II maximum likelihood, MacKay 1992; restricted maximum likelihood, Patterson and Thompson 1971).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.hybrid.families import Hyperprior, PriorFamilies, typical_hyperprior
from kcal.calibrate.hybrid.quadratic import Quadratic, ViewData
from kcal.calibrate.problem.readout import LARGEST, MEDIAN, SMALLEST, SPREAD
from kcal.calibrate.problem.views import LEAST_NOISE

# Nats by which motions must raise the evidence to be taken for real.
WORTH = 3.0
# To the maximum, not to wherever rounding lets the steps become small: 1e-2 of ln amplitude is 5e-3 sigma.
_EXACTLY = {"maxiter": 200, "ftol": 1e-12, "gtol": 1e-4, "maxcor": 20}
_ROUGHLY = {"maxiter": 200, "ftol": 1e-6, "gtol": 0.05, "maxcor": 20}
# ln σ² beyond which numbers overflow.
_HIGHEST = 300.0


def negative_log_evidence(data: Quadratic, families: PriorFamilies, v: np.ndarray) -> tuple[float, np.ndarray]:
    """The negative logarithm of the evidence of v = (h, ln σ²), (H + 1,), and its gradient; infinite beyond numbers."""
    found = _posterior(data, families, v[:-1], v[-1])
    if found is None:
        return math.inf, np.zeros_like(v)
    return found.value, np.append(found.by_h, found.by_noise)


class _Best(NamedTuple):
    """-ln p, and the best lens and board: δ (S,), and in units of their priors y (S,); what derivatives need."""

    value: float
    step: np.ndarray
    y: np.ndarray
    deviation: np.ndarray
    rss: float
    root: Tensor


class _Posterior(NamedTuple):
    """-ln p, its derivatives by h (H,) and ln σ², and the posterior: δ (S,) and F (S, S), FᵀF its covariance."""

    value: float
    by_h: np.ndarray
    by_noise: float
    step: np.ndarray
    factor: Tensor


def _best(data: Quadratic, families: PriorFamilies, h: np.ndarray, log_variance: float) -> _Best | None:
    """None where priors are too wide for the precision of numbers, or noise is beyond them."""
    if not log_variance < _HIGHEST:
        return None
    K, g = data.K.numpy(), data.g.numpy()
    s2 = math.exp(log_variance)
    d = families.deviation(torch.from_numpy(h)).numpy()
    A = torch.from_numpy(K * d[:, None] * (d / s2))
    A.diagonal().add_(1.0)
    root, info = torch.linalg.cholesky_ex(A)
    if int(info):
        return None
    # The solution in units of the priors.
    y = np.divide(data.at.numpy(), d, out=np.zeros_like(d), where=d > 0)
    change = torch.cholesky_solve(torch.from_numpy(d * g / s2 - y)[:, None], root)[:, 0].numpy()
    y, step = y + change, d * change
    rss = data.c - 2 * g @ step + step @ (K @ step)
    value = 0.5 * (data.freedom * log_variance + rss / s2 + y @ y) + float(root.diagonal().log().sum())
    return _Best(value, step, y, d, rss, root)


def _posterior(data: Quadratic, families: PriorFamilies, h: np.ndarray, log_variance: float) -> _Posterior | None:
    """None where priors are too wide for the precision of numbers."""
    best = _best(data, families, h, log_variance)
    if best is None:
        return None
    inverse = torch.linalg.solve_triangular(best.root, torch.eye(len(best.y), dtype=best.root.dtype), upper=False)
    kept = inverse.square().sum(0)
    y = torch.from_numpy(best.y)
    by_h = families.pulled(torch.from_numpy(h), 0.5 * (1.0 - y * y - kept)).numpy()
    by_noise = 0.5 * (data.freedom - (len(y) - float(kept.sum())) - best.rss * math.exp(-log_variance))
    return _Posterior(best.value, by_h, by_noise, best.step, inverse * torch.from_numpy(best.deviation))


class Maximum(NamedTuple):
    """Where the evidence is largest.

    Attributes:
        h: (H,) hyperparameters of the modes.
        log_ratio: (4,) logarithms of the motions' standard deviations over the noise; () where views stand still.
        variance: of the noise.
        loss: the negative logarithm of the evidence.
    """

    h: Tensor
    log_ratio: np.ndarray
    variance: float
    loss: float


def maximize_evidence(
    data: ViewData,
    families: PriorFamilies,
    h: Tensor,
    variance: float,
    hyperprior: Hyperprior | None = None,
    log_ratio: np.ndarray | None = None,
    tempering: float = 1.0,
    rough: bool = False,
) -> Maximum:
    """The hyperparameters and the noise variance of largest evidence.

    Args:
        data: what the views say.
        families: the priors.
        h: start.
        variance: start.
        hyperprior: of h; the typical one of the default field if not given.
        log_ratio: start, for views that moved while they were read.
        tempering: by which the data count less.
        rough: end within some hundredths of a nat, for data that will change.
    """
    prior = hyperprior or typical_hyperprior()
    ratios = np.zeros(0) if log_ratio is None else log_ratio
    count = len(prior.mean)
    log_variance = math.log(variance)
    bounds = hyper_bounds(prior, len(ratios), log_variance)
    # Here, because SciPy takes long to load.
    from scipy.optimize import minimize as lbfgs

    found = lbfgs(
        EvidenceLoss(data, families, prior, tempering),
        np.concatenate([h.numpy(), ratios, [log_variance]]),
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options=_ROUGHLY if rough else _EXACTLY,
    )
    at = found.x
    return Maximum(torch.from_numpy(at[:count].copy()), at[count:-1].copy(), math.exp(at[-1]), float(found.fun))


def hyper_bounds(prior: Hyperprior, motions: int, log_variance: float) -> list[tuple[float, float | None]]:
    """Bounds of v = (h, logarithms of the ratios of motions, ln σ²), near a variance of the noise."""
    mean, sd = prior.mean.numpy(), prior.sd.numpy()
    most = mean + 5 * sd if prior.most is None else np.minimum(mean + 5 * sd, prior.most.numpy())
    bounds: list[tuple[float, float | None]] = [*zip(mean - 5 * sd, most, strict=True)]
    bounds += [(math.log(SMALLEST) - 0.5 * log_variance, math.log(LARGEST) - 0.5 * log_variance)] * motions
    # The last bound is open: where all are closed, L-BFGS-B makes its first trial at the bounds.
    return [*bounds, (max(log_variance - 8, 2.0 * math.log(LEAST_NOISE)), None)]


class EvidenceLoss:
    """The negative logarithm of evidence and hyperprior of v = (h, logarithms of ratios of motions, ln σ²).

    Args:
        data: what the views say.
        families: the priors.
        prior: of h.
        tempering: by which the data count less.
    """

    def __init__(self, data: ViewData, families: PriorFamilies, prior: Hyperprior, tempering: float) -> None:
        self._data, self._families, self._tempering = data, families, tempering
        self._mean, self._sd = prior.mean.numpy(), prior.sd.numpy()
        self._worst = -math.inf

    def value(self, v: np.ndarray) -> float:
        """Without the gradient, at half the cost; infinite beyond numbers."""
        h, ratio, log_variance = self._parts(v)
        integrated = self._data.integrated(ratio)
        best = _best(integrated.data.tempered(self._tempering), self._families, h, log_variance)
        return math.inf if best is None else best.value + self._beside(v, integrated.log_determinant)

    def __call__(self, v: np.ndarray) -> tuple[float, np.ndarray]:
        """The value and its gradient; large beyond numbers."""
        h, ratio, log_variance = self._parts(v)
        integrated = self._data.integrated(ratio)
        tempered = integrated.data.tempered(self._tempering)
        found = _posterior(tempered, self._families, h, log_variance)
        if found is None:
            # Priors are far too wide for this precision, or a first step was far too long: worse than any trial before,
            # so that a shorter step follows.
            return (1e30 if math.isinf(self._worst) else self._worst + 1.0), np.zeros_like(v)
        value = found.value + self._beside(v, integrated.log_determinant)
        self._worst = max(self._worst, value)
        z, w = self._scaled(v)
        slopes = integrated.slopes(found.step, found.factor, math.exp(log_variance), self._tempering)
        by_noise = found.by_noise + 0.5 * float(w.sum()) / SPREAD
        return value, np.concatenate([found.by_h + z / self._sd, slopes + w / SPREAD, [by_noise]])

    def _parts(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        count = len(self._mean)
        return v[:count], v[count:-1], float(v[-1])

    def _scaled(self, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances from the means of the hyperprior, in its standard deviations."""
        h, ratio, log_variance = self._parts(v)
        # The prior of the motions' amplitudes is about these, not about their ratios to the noise.
        return (h - self._mean) / self._sd, (ratio + 0.5 * log_variance - math.log(MEDIAN)) / SPREAD

    def _beside(self, v: np.ndarray, log_determinant: float) -> float:
        z, w = self._scaled(v)
        return 0.5 * (float(z @ z) + log_determinant / self._tempering + float(w @ w))


def evidence_of_motion(data: ViewData, best: Maximum, families: PriorFamilies, tempering: float) -> float:
    """By how much motions raise the logarithm of the evidence (nats), all other amplitudes as they are."""
    log_variance = math.log(best.variance)
    moving = data.integrated(best.log_ratio)
    losses = []
    for quadratic, determinant in ((data.still, 0.0), (moving.data, moving.log_determinant)):
        found = _best(quadratic.tempered(tempering), families, best.h.numpy(), log_variance)
        losses.append(math.inf if found is None else found.value + 0.5 * determinant / tempering)
    return losses[0] - losses[1]
