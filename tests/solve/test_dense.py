"""Dense normal equations."""

from __future__ import annotations

import pytest
import torch

from kcal.solve.lm import DenseLinearization

GENERATOR = torch.Generator().manual_seed(3)
JACOBIAN = torch.randn(2, 9, 4, generator=GENERATOR, dtype=torch.float64) * torch.tensor([1e3, 1.0, 1e-3, 1.0])
RESIDUALS = torch.randn(2, 9, generator=GENERATOR, dtype=torch.float64)


@pytest.mark.parametrize("damping", [1e-9, 1e-3, 10.0])
def test_a_parameter_without_effect_does_not_move(damping: float) -> None:
    jacobian = JACOBIAN.clone()
    jacobian[..., 1] = 0.0
    plain = DenseLinearization(RESIDUALS, jacobian)
    torch.testing.assert_close(plain.cost, 0.5 * RESIDUALS.square().sum(-1), rtol=1e-14, atol=0)
    (step,), _ = plain.step(torch.full((2,), damping, dtype=torch.float64))
    assert bool((step[:, 1] == 0).all())
    assert bool((step[:, [0, 2, 3]] != 0).all())


def test_the_undamped_step_is_that_of_least_squares() -> None:
    (step,), decrease = DenseLinearization(RESIDUALS, JACOBIAN).step(torch.zeros(2).double())
    expected = torch.linalg.lstsq(JACOBIAN, -RESIDUALS[..., None]).solution[..., 0]
    torch.testing.assert_close(step, expected, rtol=1e-10, atol=0)
    left = RESIDUALS + (JACOBIAN @ step[..., None])[..., 0]
    torch.testing.assert_close(decrease, 0.5 * (RESIDUALS.square() - left.square()).sum(-1), rtol=1e-10, atol=0)


def test_blending_takes_elements_from_both() -> None:
    one, other = DenseLinearization(RESIDUALS, JACOBIAN), DenseLinearization(2.0 * RESIDUALS, JACOBIAN)
    both = one.blend(torch.tensor([True, False]), other)
    assert both.cost.tolist() == [other.cost[0].item(), one.cost[1].item()]
