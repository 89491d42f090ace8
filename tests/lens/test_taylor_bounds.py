"""Bounds of functions that are known to within errors: every function is within them, and none is far within."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from kcal.lens.region import Jet, Span

HALF = 0.5


def number(value: float) -> Tensor:
    return torch.tensor([value], dtype=torch.float64)


def jet(value: float, slope: float, bend: float, value_error: float, slope_error: float) -> Jet:
    return Jet(*(number(part) for part in (value, slope, bend, value_error, slope_error, HALF)))


FIRST, SECOND = jet(2.0, -3.0, 1.5, 0.25, 0.5), jet(-1.0, 0.75, 2.0, 0.125, 0.0625)


def members(one: Jet) -> list[tuple[float, float, float]]:
    """Value, slope and second derivative of parabolas at the ends of what a jet encloses."""
    value, slope, bend = float(one.value), float(one.slope), float(one.bend)
    signs = itertools.product((-1.0, 1.0), repeat=3)
    return [(value + a * float(one.value_error), slope + b * float(one.slope_error), c * bend) for a, b, c in signs]


TIMES = torch.linspace(-HALF, HALF, 21, dtype=torch.float64)


def test_size_is_the_largest_value_and_slope() -> None:
    for one in (FIRST, SECOND):
        value, slope = (float(part) for part in one.size())
        steepest = max(abs(b + c * t) for _, b, c in members(one) for t in (-HALF, HALF))
        assert slope == pytest.approx(steepest)
        largest = max(float((a + b * TIMES + 0.5 * c * TIMES**2).abs().max()) for a, b, c in members(one))
        assert largest <= value <= largest + 0.5 * float(one.bend) * HALF**2 + 1e-12


@pytest.mark.parametrize("kind", ["sum", "difference", "product"])
def test_functions_of_two_are_enclosed(kind: str) -> None:
    """At the center within the errors, with the largest reached; nowhere more bent than stated."""
    found = {"sum": FIRST + SECOND, "difference": FIRST - SECOND, "product": FIRST * SECOND}[kind]
    values, slopes, bends = [], [], []
    for (a, da, dda), (b, db, ddb) in itertools.product(members(FIRST), members(SECOND)):
        first, second = a + da * TIMES + 0.5 * dda * TIMES**2, b + db * TIMES + 0.5 * ddb * TIMES**2
        if kind == "product":
            values.append(a * b)
            slopes.append(da * b + a * db)
            bends.append(float((dda * second + 2 * (da + dda * TIMES) * (db + ddb * TIMES) + ddb * first).abs().max()))
        else:
            sign = 1.0 if kind == "sum" else -1.0
            values.append(a + sign * b)
            slopes.append(da + sign * db)
            bends.append(abs(dda + sign * ddb))
    off = max(abs(value - float(found.value)) for value in values)
    assert off <= float(found.value_error) <= 1.01 * off
    off = max(abs(slope - float(found.slope)) for slope in slopes)
    assert off <= float(found.slope_error) <= 1.1 * off
    assert max(bends) <= float(found.bend) <= 1.5 * max(bends)
    assert float(found.half) == HALF


def test_rounding_is_part_of_the_errors() -> None:
    exact = [jet(3.0, 5.0, 0.0, 0.0, 0.0), jet(7.0, 11.0, 0.0, 0.0, 0.0)]
    eps = torch.finfo(torch.float64).eps
    for found, value, slope in ((exact[0] + exact[1], 10.0, 16.0), (exact[0] * exact[1], 21.0, 3 * 11 + 5 * 7.0)):
        assert eps * value < float(found.value_error) < 100 * eps * value
        assert eps * slope < float(found.slope_error) < 100 * eps * slope


def test_signs_that_are_sure() -> None:
    """The smallest value is 2 - .25 - (3 + .5) / 2 - 1.5 / 8 for the first: below zero."""
    assert float(FIRST.sign()) == 0.0
    for value, sign in ((2.19, 1.0), (2.18, 0.0), (-2.18, 0.0), (-2.19, -1.0)):
        assert float(jet(value, -3.0, 1.5, 0.25, 0.5).sign()) == sign
    # From -3 it rises to -3 + .5 + 1.5 / 2 at the ends.
    for slope, falls in ((-1.26, True), (-1.25, False), (1.26, False)):
        assert bool(jet(0.0, slope, 1.5, 0.0, 0.5).falls()) == falls


def test_polynomials_on_an_interval() -> None:
    """1 - 2 x + 3 x^3 from 1 to 1.5: value, slope and second derivative at the center, the last everywhere."""
    span = Span(number(1.0), number(1.5))
    found = span.polynomial([number(-2.0), number(3.0)], [1, 3], 1.0)
    x = 1.25
    assert float(found.value) == pytest.approx(1 - 2 * x + 3 * x**3, rel=1e-12)
    assert float(found.slope) == pytest.approx(-2 + 9 * x**2, rel=1e-12)
    assert float(found.half) == pytest.approx(0.25, rel=1e-8)
    # 18 x is largest at the upper end.
    assert float(found.bend) == pytest.approx(18 * 1.5, rel=1e-8)
    assert float(found.bend) > 18 * 1.5
    eps = torch.finfo(torch.float64).eps
    assert eps * 16 < float(found.value_error) < 1000 * eps * 16
    assert eps * 20 < float(found.slope_error) < 1000 * eps * 20
    nothing = span.polynomial([], [], 4.0)
    assert (float(nothing.value), float(nothing.slope), float(nothing.bend)) == (4.0, 0.0, 0.0)
