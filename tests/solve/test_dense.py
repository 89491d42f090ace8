"""Dense normal equations, made from a Jacobian and made from rows."""

from __future__ import annotations

import pytest
import torch

from kcal.solve.dense import DenseLinearization

GENERATOR = torch.Generator().manual_seed(3)
JACOBIAN = torch.randn(2, 9, 4, generator=GENERATOR, dtype=torch.float64) * torch.tensor([1e3, 1.0, 1e-3, 1.0])
RESIDUALS = torch.randn(2, 9, generator=GENERATOR, dtype=torch.float64)


def rows_of(jacobian: torch.Tensor, residuals: torch.Tensor) -> torch.Tensor:
    return torch.cat([jacobian, residuals[..., None]], -1).mT


@pytest.mark.parametrize("damping", [0.0, 1e-3, 10.0])
@pytest.mark.parametrize("idle", [False, True])
def test_rows_and_jacobian_give_the_same(damping: float, idle: bool) -> None:
    """Also where one parameter has no effect: it does not move."""
    jacobian = JACOBIAN.clone()
    jacobian[..., 1] *= 0.0 if idle else 1.0
    lam = torch.full((2,), damping + (1e-9 if idle else 0.0), dtype=torch.float64)
    plain, packed = DenseLinearization(RESIDUALS, jacobian), DenseLinearization.of_rows(rows_of(jacobian, RESIDUALS))
    torch.testing.assert_close(packed.cost, 0.5 * RESIDUALS.square().sum(-1), rtol=1e-14, atol=0)
    torch.testing.assert_close(packed.cost, plain.cost, rtol=1e-14, atol=0)
    (step,), decrease = packed.step(lam)
    (expected,), predicted = plain.step(lam)
    torch.testing.assert_close(step, expected, rtol=1e-12, atol=0)
    torch.testing.assert_close(decrease, predicted, rtol=1e-12, atol=0)
    assert bool((step[:, 1] == 0).all()) == idle


def test_the_undamped_step_is_that_of_least_squares() -> None:
    (step,), decrease = DenseLinearization.of_rows(rows_of(JACOBIAN, RESIDUALS)).step(torch.zeros(2).double())
    expected = torch.linalg.lstsq(JACOBIAN, -RESIDUALS[..., None]).solution[..., 0]
    torch.testing.assert_close(step, expected, rtol=1e-10, atol=0)
    left = RESIDUALS + (JACOBIAN @ step[..., None])[..., 0]
    torch.testing.assert_close(decrease, 0.5 * (RESIDUALS.square() - left.square()).sum(-1), rtol=1e-10, atol=0)


def test_blending_takes_elements_from_both() -> None:
    one, other = DenseLinearization(RESIDUALS, JACOBIAN), DenseLinearization(2.0 * RESIDUALS, JACOBIAN)
    both = one.blend(torch.tensor([True, False]), other)
    assert both.cost.tolist() == [other.cost[0].item(), one.cost[1].item()]
