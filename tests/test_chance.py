"""The χ² distribution: quantiles against published tables, and what follows from them."""

from __future__ import annotations

import pytest
import torch

from kcal.checks import beyond_chance, chi2_quantile, variance_factor


def test_quantiles_are_those_of_the_tables() -> None:
    """NIST/SEMATECH e-Handbook, 1.3.6.7.4, upper critical values: three decimals."""
    freedom = torch.tensor([1, 2, 5, 10, 100])
    table = [10.828, 13.816, 20.515, 29.588, 149.449]
    assert chi2_quantile(freedom, 0.999).tolist() == pytest.approx(table, abs=6e-4)
    assert chi2_quantile(freedom, 0.9).tolist() == pytest.approx([2.706, 4.605, 9.236, 15.987, 118.498], abs=6e-4)


def test_shapes_and_no_freedom() -> None:
    assert chi2_quantile(torch.zeros(2, 3), 0.9).tolist() == [[0.0] * 3] * 2
    assert chi2_quantile(4.0, 0.9).shape == ()
    assert chi2_quantile(torch.empty(0), 0.9).shape == (0,)
    between = [float(chi2_quantile(freedom, 0.9)) for freedom in (2, 2.5, 3)]
    assert between == sorted(between)


def test_what_chance_explains() -> None:
    assert not beyond_chance(29.5, 10)
    assert beyond_chance(29.6, 10)
    assert not beyond_chance(29.6, 0)
    assert variance_factor(29.5, 10) == 1.0
    assert variance_factor(29.6, 10) == pytest.approx(2.96)
    assert variance_factor(5.0, 0) == 1.0
