"""Bound smooth functions on intervals of the real line, with certainty: rounding is part of every bound.

A `Jet` encloses all functions whose value and slope at the center of an interval are known to within errors, and whose
second derivative is bounded on the whole interval. Sums and products of jets enclose those of the functions, so that a
formula in jets bounds the formula. Where terms cancel at the center they cancel in the bound, too, which plain interval
arithmetic cannot do; the bounds are exact to second order in the length of the interval.

Source: Moore, Kearfott and Cloud, Introduction to Interval Analysis (2009), Taylor forms.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

# Bounds the relative rounding of the value of each formula below, which sums at most 16 terms.
_ROUNDING = 32 * torch.finfo(torch.float64).eps
# Bounds are enlarged by this fraction before they decide, for the rounding of the bounds themselves.
_ENLARGED = 1.0 + 1e-9


@dataclasses.dataclass(frozen=True)
class Jet:
    """Functions on intervals; every tensor is (N,).

    Attributes:
        value: of the function at the center.
        slope: its derivative there.
        bend: bound of the absolute second derivative on the interval.
        value_error: bound of the error of `value`.
        slope_error: bound of the error of `slope`.
        half: half the length of the interval.
    """

    value: Tensor
    slope: Tensor
    bend: Tensor
    value_error: Tensor
    slope_error: Tensor
    half: Tensor

    def size(self) -> tuple[Tensor, Tensor]:
        """Bounds of the absolute value and of the absolute slope on the interval."""
        steepest = self.slope.abs() + self.slope_error + self.bend * self.half
        return self.value.abs() + self.value_error + steepest * self.half, steepest

    def __add__(self, other: Jet) -> Jet:
        value, slope = self.value + other.value, self.slope + other.slope
        return Jet(
            value,
            slope,
            self.bend + other.bend,
            self.value_error + other.value_error + _ROUNDING * value.abs(),
            self.slope_error + other.slope_error + _ROUNDING * slope.abs(),
            self.half,
        )

    def __neg__(self) -> Jet:
        return dataclasses.replace(self, value=-self.value, slope=-self.slope)

    def __sub__(self, other: Jet) -> Jet:
        return self + -other

    def __mul__(self, other: Jet) -> Jet:
        (a, a_slope), (b, b_slope) = self.size(), other.size()
        first, second = self.slope * other.value, self.value * other.slope
        value = self.value * other.value
        error = self.value.abs() * other.value_error + self.value_error * (other.value.abs() + other.value_error)
        slope_error = (
            (self.slope.abs() + self.slope_error) * other.value_error
            + self.slope_error * other.value.abs()
            + (other.slope.abs() + other.slope_error) * self.value_error
            + other.slope_error * self.value.abs()
        )
        return Jet(
            value,
            first + second,
            self.bend * b + 2.0 * a_slope * b_slope + other.bend * a,
            error + _ROUNDING * value.abs(),
            slope_error + _ROUNDING * (first.abs() + second.abs()),
            self.half,
        )

    def sign(self) -> Tensor:
        """1 where the function is positive on the whole interval, -1 where it is negative, 0 where neither is sure."""
        steepest = self.slope.abs() + self.slope_error + 0.5 * self.bend * self.half
        sure = self.value.abs() > (self.value_error + steepest * self.half) * _ENLARGED
        return torch.where(sure, torch.sign(self.value), 0.0)

    def falls(self) -> Tensor:
        """Where the function is certain to fall on the whole interval."""
        return -self.slope > (self.slope_error + self.bend * self.half) * _ENLARGED


class Span:
    """Intervals from `low` to `high` (N,), neither negative, with the powers of their centers and upper ends."""

    def __init__(self, low: Tensor, high: Tensor) -> None:
        self.half = (0.5 * (high - low) + _ROUNDING * high) * _ENLARGED
        center = 0.5 * (low + high)
        self._ends = center, center + self.half
        self._powers = [torch.ones_like(center)], [torch.ones_like(center)]

    def _power(self, which: int, power: int) -> Tensor:
        table = self._powers[which]
        while len(table) <= power:
            table.append(table[-1] * self._ends[which])
        return table[power]

    def polynomial(self, coefficients: Sequence[Tensor], powers: Sequence[int], constant: float = 0.0) -> Jet:
        """Bound a polynomial: a constant, and coefficients (N,) of powers of the variable."""
        magnitudes = [c.abs() for c in coefficients]

        def derivative(order: int, which: int, weights: Sequence[Tensor]) -> Tensor:
            total = torch.full_like(self.half, 0.0 if order else constant)
            for weight, power in zip(weights, powers, strict=True):
                if power >= order:
                    total = torch.addcmul(
                        total, weight, self._power(which, power - order), value=math.perm(power, order)
                    )
            return total

        bend = derivative(2, 0, coefficients).abs() + self.half * derivative(3, 1, magnitudes)
        return Jet(
            derivative(0, 0, coefficients),
            derivative(1, 0, coefficients),
            bend + _ROUNDING * derivative(2, 1, magnitudes),
            _ROUNDING * derivative(0, 1, magnitudes),
            _ROUNDING * derivative(1, 1, magnitudes),
            self.half,
        )
