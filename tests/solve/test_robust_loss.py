"""Robust losses: their values, and weights that are their derivatives."""

from __future__ import annotations

import math

import pytest
import torch

from kcal.errors import InputError
from kcal.solve.problem import RobustLoss

KINDS = ("huber", "cauchy", "tukey")


@pytest.mark.parametrize("kind", KINDS)
def test_weight_is_the_derivative_of_value(kind: str) -> None:
    squared = torch.tensor([0.0, 0.3, 2.2, 2.3, 90.0], dtype=torch.float64, requires_grad=True)
    loss = RobustLoss(kind=kind, scale=1.5)
    (slope,) = torch.autograd.grad(loss.value(squared).sum(), squared)
    torch.testing.assert_close(loss.weight(squared.detach()), slope, rtol=1e-12, atol=1e-14)
    assert loss.weight(torch.zeros(1)).item() == 1.0
    assert torch.autograd.gradcheck(loss.weight, squared)


@pytest.mark.parametrize(
    ("kind", "squared", "value", "weight"),
    [
        ("huber", 4.0, 4.0, 1.0),
        ("huber", 9.0, 8.0, 2.0 / 3.0),
        ("cauchy", 4.0, 4.0 * math.log(2.0), 0.5),
        ("cauchy", 12.0, 4.0 * math.log(4.0), 0.25),
        ("tukey", 1.0, 4.0 / 3.0 * (1.0 - 0.75**3), 0.75**2),
        ("tukey", 4.0, 4.0 / 3.0, 0.0),
        ("tukey", 400.0, 4.0 / 3.0, 0.0),
    ],
)
def test_known_values(kind: str, squared: float, value: float, weight: float) -> None:
    """For a scale of 2, worked out by hand."""
    loss, place = RobustLoss(kind=kind, scale=2.0), torch.tensor([squared], dtype=torch.float64)  # type: ignore[arg-type]
    assert loss.value(place).item() == pytest.approx(value, rel=1e-14)
    assert loss.weight(place).item() == pytest.approx(weight, rel=1e-14)


@pytest.mark.parametrize("kind", KINDS)
def test_small_residuals_count_fully_and_nan_stays(kind: str) -> None:
    loss = RobustLoss(kind=kind, scale=3.0)
    # The next term of each series is s²/c² at most.
    assert loss.value(torch.tensor([1e-6]).double()).item() == pytest.approx(1e-6, rel=1e-6)
    assert loss.value(torch.tensor([torch.nan])).isnan().all()
    assert loss.weight(torch.tensor([torch.nan])).isnan().all()


def test_huber_with_a_scale_of_one_unless_told_otherwise() -> None:
    assert RobustLoss() == RobustLoss(kind="huber", scale=1.0)


@pytest.mark.parametrize("wrong", [{"kind": "square"}, {"scale": 0.0}, {"scale": -1.0}, {"scale": math.inf}])
def test_what_cannot_be_is_refused(wrong: dict) -> None:
    with pytest.raises(InputError, match="robust loss"):
        RobustLoss(**wrong)
