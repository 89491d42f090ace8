"""Gradients through a solution."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.solve.lm import LevenbergMarquardt, LMOptions

TIMES = torch.linspace(0.0, 2.0, 9, dtype=torch.float64)


def decay(x: Tensor, observed: Tensor) -> Tensor:
    """An exponential with an offset, fitted to nine observations: residuals remain, so that JᵀJ is not the Hessian."""
    return x[0] * torch.exp(-x[1] * TIMES) + x[2] - observed


def observations(*batch: int) -> Tensor:
    generator = torch.Generator().manual_seed(2)
    noise = torch.randn((*batch, len(TIMES)), generator=generator, dtype=torch.float64)
    return 2.0 * torch.exp(-1.3 * TIMES) + 0.5 + 0.2 * noise


START = torch.tensor([1.0, 1.0, 0.0], dtype=torch.float64)


class TestGradient:
    def test_against_refits(self) -> None:
        solver = LevenbergMarquardt(decay, LMOptions(tolerance=1e-16))
        # Central differences of whole refits, each of which stops some 1e-8 from its minimum: a step of 1e-3 makes that
        # 1e-5, and its own curvature adds about as much.
        assert torch.autograd.gradcheck(
            lambda observed: solver(START, observed).x,
            (observations().requires_grad_(True),),
            eps=1e-3,
            atol=5e-5,
            rtol=5e-5,
        )

    def test_in_a_batch_as_alone(self) -> None:
        solver = LevenbergMarquardt(decay)
        observed = observations(4).requires_grad_(True)
        (together,) = torch.autograd.grad(solver(START.expand(4, 3), observed).x[:, 1].sum(), observed)
        for i in range(4):
            one = observations(4)[i].requires_grad_(True)
            (alone,) = torch.autograd.grad(solver(START, one).x[1], one)
            # The batch multiplies in another order.
            torch.testing.assert_close(together[i], alone, rtol=1e-9, atol=1e-12)

    def test_the_value_is_the_solution_to_the_last_bit(self) -> None:
        observed = observations()
        plain = LevenbergMarquardt(decay)(START, observed)
        assert not plain.x.requires_grad
        carried = LevenbergMarquardt(decay)(START, observed.requires_grad_(True))
        assert torch.equal(carried.x, plain.x)

    def test_none_where_it_did_not_converge(self) -> None:
        observed = observations().requires_grad_(True)
        result = LevenbergMarquardt(decay, LMOptions(max_iterations=1))(START, observed)
        assert not bool(result.converged)
        (gradient,) = torch.autograd.grad(result.x.sum(), observed)
        assert torch.equal(gradient, torch.zeros_like(gradient))

    def test_none_without_grad(self) -> None:
        with torch.no_grad():
            assert not LevenbergMarquardt(decay)(START, observations().requires_grad_(True)).x.requires_grad


class TestBackward:
    def test_unrolled_steps_agree_with_the_implicit_gradient(self) -> None:
        """Steps that go on after convergence make the derivative converge too."""
        observed = observations(2).requires_grad_(True)
        options = LMOptions(tolerance=1e-18)
        gradients = []
        for backward in ("implicit", "unroll"):
            x = LevenbergMarquardt(decay, options, backward=backward)(START.expand(2, 3), observed).x
            gradients.append(torch.autograd.grad(x[:, 1].sum(), observed)[0])
        torch.testing.assert_close(gradients[1], gradients[0], rtol=1e-4, atol=1e-6)

    def test_one_unrolled_step_is_the_derivative_of_that_step(self) -> None:
        solver = LevenbergMarquardt(decay, LMOptions(max_iterations=1), backward="unroll")
        start = START.clone().requires_grad_(True)
        assert torch.autograd.gradcheck(
            lambda x, observed: solver(x, observed).x, (start, observations().requires_grad_(True)), atol=1e-6
        )

    def test_none(self) -> None:
        observed = observations().requires_grad_(True)
        result = LevenbergMarquardt(decay, backward="none")(START, observed)
        assert not result.x.requires_grad
        assert torch.equal(result.x, LevenbergMarquardt(decay)(START, observed).x)

    def test_refuses_other_words(self) -> None:
        with pytest.raises(InputError, match="implicit, unroll or none"):
            LevenbergMarquardt(decay, backward="explicit")
