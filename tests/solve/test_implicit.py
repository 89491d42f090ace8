"""Gradients through a solution."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

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


class Weighed(nn.Module):
    """w (x - d - b): its minimum is a mean, whose derivatives are known."""

    def __init__(self) -> None:
        super().__init__()
        self.w = nn.Parameter(torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64))
        self.register_buffer("b", torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64))

    def forward(self, x: Tensor, d: Tensor) -> Tensor:
        return self.w * (x[0] - d - self.b)  # type: ignore[operator]


class TestWeightsOfAResidual:
    start, data = torch.zeros(1).double(), torch.tensor([0.0, 1.0, 2.0], dtype=torch.float64)

    def exact(self) -> dict[str, Tensor]:
        module = Weighed()
        w, moved = module.w.detach(), self.data + module.b
        x = (w**2 * moved).sum() / (w**2).sum()
        return {"residual.w": 2 * w * (moved - x) / (w**2).sum(), "residual.b": w**2 / (w**2).sum()}

    @pytest.mark.parametrize("backward", ["implicit", "unroll"])
    @pytest.mark.parametrize("batch", [(), (7,)])
    def test_an_optimizer_sees_them(self, backward: str, batch: tuple[int, ...]) -> None:
        """Found: no gradient at all while no data required one."""
        solver = LevenbergMarquardt(Weighed(), backward=backward)  # type: ignore[arg-type]
        solver(self.start.expand(*batch, 1), self.data.expand(*batch, 3)).x.mean().backward()
        (weight,) = solver.parameters()
        torch.testing.assert_close(weight.grad, self.exact()["residual.w"])

    @pytest.mark.parametrize("transform", [torch.func.jacrev, torch.func.jacfwd])
    @pytest.mark.parametrize("name", ["residual.w", "residual.b"])
    def test_functional(self, transform: Callable[..., Callable[..., Tensor]], name: str) -> None:
        solver = LevenbergMarquardt(Weighed())

        def solution(value: Tensor) -> Tensor:
            return torch.func.functional_call(solver, {name: value}, (self.start, self.data)).x[0]

        torch.testing.assert_close(transform(solution)(solver.state_dict()[name]), self.exact()[name])

    def test_closures(self) -> None:
        w = Weighed().w.detach().requires_grad_()
        solver = LevenbergMarquardt(lambda x, d: w * (x[0] - d - Weighed().b))
        (found,) = torch.autograd.grad(solver(self.start, self.data).x.sum(), w)
        torch.testing.assert_close(found, self.exact()["residual.w"])

    def test_what_is_not_asked_for_is_not_computed(self) -> None:
        solver = LevenbergMarquardt(Weighed().requires_grad_(False))
        assert not solver(self.start, self.data).x.requires_grad
        with torch.no_grad():
            assert not LevenbergMarquardt(Weighed())(self.start, self.data).x.requires_grad

    def test_vmap_is_refused(self) -> None:
        solver = LevenbergMarquardt(Weighed())
        with pytest.raises(InputError, match="leading dimensions"):
            torch.func.vmap(lambda data: solver(self.start, data).x)(self.data.expand(2, 3))
        with pytest.raises(InputError, match="leading dimensions"):
            torch.func.vmap(lambda w: torch.func.functional_call(solver, {"residual.w": w}, (self.start, self.data)).x)(
                torch.ones(2, 3).double()
            )
