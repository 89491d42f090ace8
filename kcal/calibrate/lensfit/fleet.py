"""What cameras of one type have in common: the amplitudes of their lenses, learned from each other.

Each camera's evidence is a likelihood of its hyperparameters h, taken as Gaussian about its maximum. Over the cameras
h is normal with unknown mean and spread, which are found by expectation maximization (empirical Bayes: Efron and
Morris 1973); the typical hyperprior counts as one more camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.lensfit.evidence import Hyperprior, PriorFamilies, Quadratic, negative_log_evidence

_ITERATIONS = 200


class HyperLikelihood(NamedTuple):
    """exp(-½ hᵀ information h + vectorᵀ h) of a camera's hyperparameters.

    Attributes:
        information: (H, H).
        vector: (H,).
    """

    information: Tensor
    vector: Tensor


def hyper_likelihood(data: Quadratic, families: PriorFamilies, h: Tensor, variance: float) -> HyperLikelihood:
    """What the data of a camera say about its hyperparameters, near h (H,); the noise is maximized over.

    Args:
        data: of the camera.
        families: its priors.
        h: of largest evidence.
        variance: of the noise there.
    """
    at = np.append(h.numpy(), math.log(variance))
    size, step = len(at), 0.02
    slopes = [
        negative_log_evidence(data, families, at + step * sign * row)[1] for row in np.eye(size) for sign in (1, -1)
    ]
    hessian = torch.from_numpy(np.stack([(a - b) / (2 * step) for a, b in zip(slopes[::2], slopes[1::2], strict=True)]))
    hessian = 0.5 * (hessian + hessian.T)
    information = hessian[:-1, :-1] - torch.outer(hessian[:-1, -1], hessian[-1, :-1]) / hessian[-1, -1]
    # Far from where the data say anything the likelihood bends the wrong way: nothing is known there.
    values, vectors = torch.linalg.eigh(information)
    information = (vectors * values.clamp_min(0.0)) @ vectors.T
    slope = torch.from_numpy(negative_log_evidence(data, families, at)[1][:-1])
    slope = (vectors * (values > 0)) @ (vectors.T @ slope)
    return HyperLikelihood(information, information @ h - slope)


def fleet_hyperprior(cameras: Sequence[HyperLikelihood], typical: Hyperprior) -> Hyperprior:
    """The hyperprior of one more camera of the same type.

    Args:
        cameras: that are known.
        typical: the hyperprior of cameras of any type, which counts as one camera.
    """
    if not cameras:
        return typical
    count = len(cameras) + 1
    information = torch.stack([camera.information for camera in cameras])
    vector = torch.stack([camera.vector for camera in cameras])
    mean, variance = typical.mean, typical.sd.square()
    for _ in range(_ITERATIONS):
        covariance = torch.linalg.inv(information + torch.diag(1.0 / variance))
        each = torch.einsum("gij,gj->gi", covariance, vector + mean / variance)
        mean = (typical.mean + each.sum(0)) / count
        spread = (each - mean).square() + covariance.diagonal(dim1=1, dim2=2)
        variance = (typical.sd.square() + (typical.mean - mean).square() + spread.sum(0)) / count
    # The mean itself is known from `count` cameras only.
    return Hyperprior(mean, (variance * (1.0 + 1.0 / count)).sqrt())
