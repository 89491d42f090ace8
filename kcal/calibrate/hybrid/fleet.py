"""What cameras of one type have in common, learned from each other: first amplitudes, then the lens itself.

Each camera's data are a Gaussian of its unknowns x: hyperparameters near their best, or lens coefficients.
Over the cameras x is normal with unknown mean and spread, found by expectation maximization (empirical Bayes: Efron
and Morris 1973). What the next camera may expect has the spread of Student's t, as a variance from few samples asks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.hybrid.evidence import Quadratic, negative_log_evidence
from kcal.calibrate.hybrid.families import LEADING_UNKNOWNS, Hyperprior, PriorFamilies
from kcal.gaussian import Gaussian, numbered
from kcal.lens.hybrid_terms import HybridForm

# Fewer tell no spread.
LEAST_CAMERAS = 4
_ITERATIONS = 50
# One camera more, that deviates by this share of the typical spread, keeps the spread above zero.
_LEAST_SPREAD = 0.1
# Focal lengths of one type of camera, relative.
_FOCAL = 0.05


class LensPrior(NamedTuple):
    """What is known of a camera's lens before it is calibrated.

    Attributes:
        form: constants of the lens.
        focal: F₀, pixels.
        unknowns: (L,) focal length, principal point, coefficients; the focal length of the rows too where pixels are
            not square.
    """

    form: HybridForm
    focal: float
    unknowns: Hyperprior

    @property
    def square(self) -> bool:
        """Whether pixels are square."""
        return len(self.unknowns.mean) == LEADING_UNKNOWNS + len(self.form.modes)

    def families(self, usual: PriorFamilies) -> PriorFamilies:
        """Priors with this lens, and the board of others."""
        own = torch.arange(len(usual.mean)) < len(self.unknowns.mean)
        mean, log_unit = usual.mean.clone(), usual.log_unit.clone()
        mean[own], log_unit[own] = self.unknowns.mean, self.unknowns.sd.log()
        amplitude, decay = (torch.where(own, -1, index) for index in (usual.amplitude, usual.decay))
        return PriorFamilies(mean, log_unit, amplitude, decay, usual.degree)


def hyper_likelihood(data: Quadratic, families: PriorFamilies, h: Tensor, variance: float) -> Gaussian:
    """What the data of a camera say about its hyperparameters, near h (H,); the noise is maximized over.

    Args:
        data: of the camera.
        families: its priors.
        h: of largest evidence.
        variance: of the noise there.
    """
    _, gradient, bend = negative_log_evidence(data, families, np.append(h.numpy(), math.log(variance)))
    hessian = torch.from_numpy(bend)
    information = hessian[:-1, :-1] - torch.outer(hessian[:-1, -1], hessian[-1, :-1]) / hessian[-1, -1]
    slope = torch.from_numpy(gradient[:-1])
    # Far from where the data say anything the likelihood bends the wrong way: nothing is known there.
    values, vectors = torch.linalg.eigh(information)
    root, vectors = values[values > 0].sqrt()[:, None], vectors[:, values > 0].T
    rows = torch.cat([root * vectors, (vectors @ slope)[:, None] / root], 1)
    return Gaussian(numbered("amplitude", len(h)), h, rows)


def fleet_priors(cameras: Sequence[Gaussian], typical: Hyperprior) -> tuple[Hyperprior, list[Hyperprior]]:
    """The prior of the next camera of a type, and that of each camera from all others.

    Args:
        cameras: that are known.
        typical: what is expected of any camera.
    """
    unit, count = typical.sd, len(cameras)
    products = torch.stack([camera.placed(camera.slots, typical.mean).products for camera in cameras])
    information, vector = products[:, :-1, :-1] * unit[:, None] * unit, -products[:, :-1, -1] * unit
    # In units of the typical spread, about the typical mean.
    mean, variance = torch.zeros_like(unit), torch.ones_like(unit)
    for _ in range(_ITERATIONS):
        covariance = torch.linalg.inv(information + torch.diag(1.0 / variance))
        each = torch.einsum("gij,gj->gi", covariance, vector + mean / variance)
        mean = each.sum(0) / (count + variance)
        squares = (each - mean).square() + covariance.diagonal(dim1=1, dim2=2)
        variance = ((_LEAST_SPREAD**2 + squares.sum(0)) / count).clamp_max(1.0)

    def prior(total: Tensor, squares: Tensor, count: int) -> Hyperprior:
        if count < LEAST_CAMERAS - 1:
            return typical
        variance = ((_LEAST_SPREAD**2 + squares) / count).clamp_max(1.0)
        # Variance of Student's t of `count` degrees of freedom; the mean is known from `count` cameras.
        wide = (variance * (1.0 + 1.0 / count) * count / (count - 2.0)).clamp_max(1.0)
        return typical._replace(mean=typical.mean + unit * total / (count + variance), sd=unit * wide.sqrt())

    without = [prior(each.sum(0) - x, squares.sum(0) - s, count - 1) for x, s in zip(each, squares, strict=True)]
    return prior(each.sum(0), squares.sum(0), count), without


def typical_lens(form: HybridForm, families: PriorFamilies, h: Tensor, square: bool) -> Hyperprior:
    """What is expected of a lens with these amplitudes, from a type of which no other camera is known.

    Args:
        form: constants of the lens.
        families: priors that belong to these.
        h: (H,).
        square: whether pixels are square.
    """
    count = LEADING_UNKNOWNS + len(form.modes) + (0 if square else 1)
    mean, sd = families.mean[:count].clone(), families.deviation(h)[:count].clone()
    sd[0] = _FOCAL * mean[0]
    if not square:
        sd[-1] = _FOCAL * mean[-1]
    return Hyperprior(mean, sd)
