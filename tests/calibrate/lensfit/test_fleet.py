"""What cameras of one type have in common is learned from them."""

from __future__ import annotations

import math

import numpy as np
import torch

from kcal.calibrate.lensfit.evidence import (
    Hyperprior,
    PriorFamilies,
    Quadratic,
    maximize_evidence,
    negative_log_evidence,
)
from kcal.calibrate.lensfit.fleet import HyperLikelihood, fleet_hyperprior, hyper_likelihood

F64 = torch.float64
TYPICAL = Hyperprior(torch.tensor([0.0, -7.0], dtype=F64), torch.tensor([1.5, 2.0], dtype=F64))


def cameras(count: int, information: float, seed: int) -> tuple[list[HyperLikelihood], torch.Tensor]:
    """Cameras whose h scatter by .2 about (2, -9), each known to 1 / √information."""
    generator = torch.Generator().manual_seed(seed)
    true = torch.tensor([2.0, -9.0], dtype=F64) + 0.2 * torch.randn(count, 2, generator=generator, dtype=F64)
    matrix = information * torch.eye(2, dtype=F64)
    seen = true + torch.randn(count, 2, generator=generator, dtype=F64) / math.sqrt(information)
    return [HyperLikelihood(matrix, matrix @ h) for h in seen], true


def test_many_cameras_tell_their_type() -> None:
    found = fleet_hyperprior(cameras(200, 25.0, 1)[0], TYPICAL)
    torch.testing.assert_close(found.mean, torch.tensor([2.0, -9.0], dtype=F64), rtol=0, atol=0.1)
    # The spread of the cameras, not that of their noisy estimates (.28), and a little of the typical one.
    assert bool((found.sd > 0.15).all() & (found.sd < 0.3).all())


def test_few_cameras_tell_little() -> None:
    """With one camera the spread stays near the typical one; with none, or with blind ones, nothing is learned."""
    one = fleet_hyperprior(cameras(1, 25.0, 2)[0], TYPICAL)
    assert bool((one.sd > 0.6 * TYPICAL.sd).all())
    assert bool(((one.mean - TYPICAL.mean).abs() > 0.5).all())
    assert fleet_hyperprior([], TYPICAL) is TYPICAL
    blind = fleet_hyperprior([HyperLikelihood(torch.zeros(2, 2, dtype=F64), torch.zeros(2, dtype=F64))] * 5, TYPICAL)
    torch.testing.assert_close(blind.mean, TYPICAL.mean, rtol=0, atol=1e-6)
    assert bool((blind.sd > 0.95 * TYPICAL.sd).all())


def test_likelihood_of_hyperparameters() -> None:
    """At the maximum of the posterior the likelihood's slope is against the hyperprior's, and its Hessian is right."""
    generator = torch.Generator().manual_seed(3)
    count = 40
    index = torch.arange(count) % 2
    none = torch.full((count,), -1)
    zero = torch.zeros(count, dtype=F64)
    families = PriorFamilies(zero, zero, index, none, zero)
    x = torch.exp(TYPICAL.mean + 1.0)[index] * torch.randn(count, generator=generator, dtype=F64)
    A = 3e4 * torch.randn(300, count, generator=generator, dtype=F64)
    target = A @ x + 0.1 * torch.randn(300, generator=generator, dtype=F64)
    data = Quadratic(A.T @ A, A.T @ target, float(target @ target), 300.0)
    h, variance, _ = maximize_evidence(*data, families, TYPICAL.mean, 0.02, TYPICAL)
    found = hyper_likelihood(data, families, h, variance)
    # Of a spread known from n draws the log has information 2 n.
    torch.testing.assert_close(found.information.diagonal(), torch.full((2,), 40.0, dtype=F64), rtol=0.35, atol=0)
    slope = found.information @ h - found.vector
    torch.testing.assert_close(slope, (TYPICAL.mean - h) / TYPICAL.sd.square(), rtol=0, atol=0.1)
    at = np.append(h.numpy(), math.log(variance))
    value = negative_log_evidence(data, families, at)[0]
    step = np.array([0.1, 0.0, 0.0])
    there = negative_log_evidence(data, families, at + step)[0]
    predicted = 0.1 * float(slope[0]) + 0.005 * float(found.information[0, 0])
    assert abs(there - value - predicted) < 0.05
