"""What cameras of one type have in common is learned from them."""

from __future__ import annotations

import math

import numpy as np
import torch
from standing_views import quadratic, standing

from kcal.calibrate.hybrid.cameras_fit import fleet_priors, hyper_likelihood
from kcal.calibrate.hybrid.evidence import maximize_evidence, negative_log_evidence
from kcal.calibrate.hybrid.families import Hyperprior, PriorFamilies
from kcal.gaussian import Gaussian

F64 = torch.float64
TYPICAL = Hyperprior(torch.tensor([0.0, -7.0], dtype=F64), torch.tensor([1.5, 2.0], dtype=F64))


def cameras(count: int, information: float, seed: int) -> tuple[list[Gaussian], torch.Tensor]:
    """Cameras whose h scatter by .2 about (2, -9), each known to 1 / √information."""
    generator = torch.Generator().manual_seed(seed)
    true = torch.tensor([2.0, -9.0], dtype=F64) + 0.2 * torch.randn(count, 2, generator=generator, dtype=F64)
    seen = true + torch.randn(count, 2, generator=generator, dtype=F64) / math.sqrt(information)
    sigma = torch.full((2,), 1.0 / math.sqrt(information), dtype=F64)
    return [Gaussian.independent((0, 1), h, sigma) for h in seen], true


def test_many_cameras_tell_their_type() -> None:
    told, true = cameras(100, 25.0, 1)
    found, each = fleet_priors(told, TYPICAL)
    torch.testing.assert_close(found.mean, true.mean(0), rtol=0, atol=0.1)
    # The spread of the cameras (.2), not that of their noisy estimates (.28).
    assert bool((found.sd > 0.16).all() & (found.sd < 0.25).all())
    # Without itself each knows nearly as much.
    assert bool((torch.stack([prior.mean for prior in each]) - found.mean).abs().max() < 0.01)


def test_few_cameras_are_wide() -> None:
    """Five predict the sixth: over many draws its distance is as large as said, not smaller; three tell no spread."""
    squares = []
    for seed in range(100):
        told, true = cameras(6, 1e4, seed)
        found, _ = fleet_priors(told[:5], TYPICAL)
        squares.append(((true[5] - found.mean) / found.sd).square())
    assert 0.5 < float(torch.stack(squares).mean()) < 1.3
    for prior in fleet_priors(cameras(2, 1e4, 0)[0], TYPICAL)[1]:
        assert prior is TYPICAL


def test_blind_cameras_tell_nothing() -> None:
    blind = Gaussian((0, 1), torch.zeros(2, dtype=F64), torch.zeros(0, 3, dtype=F64))
    found, _ = fleet_priors([blind] * 6, TYPICAL)
    torch.testing.assert_close(found.mean, TYPICAL.mean, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.sd, TYPICAL.sd, rtol=1e-6, atol=0)


def test_likelihood_of_hyperparameters() -> None:
    """At the maximum of the posterior the likelihood's slope is against the hyperprior's, and its Hessian is right."""
    generator = torch.Generator().manual_seed(3)
    count = 40
    index = torch.arange(count) % 2
    none = torch.full((count,), -1)
    zero = torch.zeros(count, dtype=F64)
    families = PriorFamilies(zero, zero, index, none, zero)
    x = torch.exp(TYPICAL.mean + 1.0)[index] * torch.randn(count, generator=generator, dtype=F64)
    A = 100.0 * torch.randn(300, count, generator=generator, dtype=F64)
    target = A @ x + 0.1 * torch.randn(300, generator=generator, dtype=F64)
    data = quadratic(A, target, zero)
    h, variance = TYPICAL.mean, 0.02
    for _ in range(3):
        h, _, variance, _ = maximize_evidence(standing(data), families, h, variance, TYPICAL)
    found = hyper_likelihood(data, families, h, variance)
    # Of a spread known from n draws the log has information 2 n.
    told = found.placed(found.slots, h).products
    torch.testing.assert_close(told.diagonal()[:2], torch.full((2,), 40.0, dtype=F64), rtol=0.35, atol=0)
    slope = told[:2, 2]
    torch.testing.assert_close(slope, (TYPICAL.mean - h) / TYPICAL.sd.square(), rtol=0, atol=0.05)
    at = np.append(h.numpy(), math.log(variance))
    value = negative_log_evidence(data, families, at)[0]
    step = np.array([0.1, 0.0, 0.0])
    there = negative_log_evidence(data, families, at + step)[0]
    predicted = 0.1 * float(slope[0]) + 0.005 * float(told[0, 0])
    assert abs(there - value - predicted) < 0.05
