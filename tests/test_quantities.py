"""Numbers as texts: two digits of the standard deviation, and a unit that fits."""

from __future__ import annotations

import math

import pytest

from kcal.quantities import length_text, length_unit, measured_length, measured_text, number_text, range_text


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (0.0832168, 2.17e-5, "0.083217"),
        (0.0832168, 2.17e-4, "0.08322"),
        (1983.4, 586.0, "1980"),
        (9.96, 0.996, "10.0"),
        (9.96, 0.0996, "9.96"),
        (-0.004, 0.5, "0.00"),
        (1.0, 3e5, "0"),
        (5.0, None, "5.00"),
        (5.0, 0.0, "5.00"),
        (5.0, math.inf, "5.00"),
        (0.0, None, "0"),
        (math.nan, 1.0, "–"),
        (-math.inf, None, "-∞"),
        (3.4567e-7, 2e-9, "3.457e-07"),
        (1e-9, 3e-7, "1e-09"),
    ],
)
def test_two_digits_of_sigma(value: float, sigma: float | None, text: str) -> None:
    assert number_text(value, sigma) == text


def test_a_sigma_is_never_written_as_zero() -> None:
    for power in range(-12, 9):
        spread = 2.2 * 10.0**power
        assert float(number_text(spread, spread)) == pytest.approx(spread)
        assert float(measured_text(1.0, spread).split(" ± ")[1]) == pytest.approx(spread)
    assert measured_text(1.0, 0.0) == "1.00 ± 0"


def test_units_fit_the_range() -> None:
    assert [length_text(one) for one in (0.4, 400.0, 4000.0, 40e3)] == ["400 mm", "400 m", "4000 m", "40.0 km"]
    assert [range_text(one) for one in (0.4, 400.0, 4000.0, 40e3)] == ["400 mm", "400 m", "4 km", "40 km"]
    assert measured_length(0.083217, 2.2e-5) == "83.217 ± 0.022 mm"
    assert measured_length(0.083217, None) == "83.2 mm"
    assert length_unit([0.3, math.inf, None]).name == "mm"
    assert length_unit([]).name == "m"
    assert (length_text(0.0), length_text(math.inf)) == ("0", "∞")
    assert length_text(-0.0012, sign=True) == "-1.20 mm"
