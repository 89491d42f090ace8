"""Prove where a lens has neither fold nor pole, by certain bounds on cells that cover the plane around its axis."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.model import LensModel

# Bound smooth functions on intervals of the real line, with certainty: rounding is part of every bound.
#
# A `Jet` encloses all functions whose value and slope at the center of an interval are known to within errors, and
# whose second derivative is bounded on the whole interval. Sums and products of jets enclose those of the functions, so
# that a formula in jets bounds the formula. Where terms cancel at the center they cancel in the bound, too, which plain
# interval arithmetic cannot do; the bounds are exact to second order in the length of the interval.
#
# Source: Moore, Kearfott and Cloud, Introduction to Interval Analysis (2009), Taylor forms.

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


# Prove where a lens has neither fold nor pole, on cells that cover the plane around its axis.
#
# Between two samples of a determinant any number of folds can hide: where the numerator and the denominator of the
# radial factor nearly cancel, a fold may be as narrow as rounding. So the determinant of the Jacobian is bounded on
# whole cells, intervals of the radius in a sector, and cells that are too large for a
# decision are cut in four.
#
# The tilt is one-to-one wherever it is regular and is left out. Times the third power of the radial denominator D(r²),
# the determinant at radius r and angle φ is, in complex numbers,
#
#     E = H N + D³ |Q|² + Re((D H Q + D² N (3 Q + P)) exp(-iφ)) + Re(D³ Q (2 Q + P) exp(-2iφ)),
#     H = N D + r (N' D - N D')
#
# with the radial numerator N(r²), Q = 2 r (p2 + i p1), and the derivative P by r of the prism terms.
#
# Where in every cell E is positive, or negative, or falls with the radius, E changes its sign at most once in each
# direction. The sign at a point then tells on which side of the fold the point lies.

# Sectors around a lens that is not symmetric, the narrowest that are told apart.
SECTORS = 1024
# A ring has four cells to begin with. A lens may have so many undecided cells; those farthest out are given up first.
_RINGS, _MOST_CELLS = 128, 512
# Cells are cut along the radius down to this fraction of it, and not below this radius.
_SHORTEST, _INNERMOST = 1e-8, 1e-12


class _Cells(NamedTuple):
    """Parts of the plane: radii from `low` to `high` in `width` sectors from the number `sector` on; each (N,)."""

    lens: Tensor
    low: Tensor
    high: Tensor
    sector: Tensor
    width: Tensor

    def take(self, where: Tensor) -> _Cells:
        return _Cells(*(value[where] for value in self))

    def in_four(self, across: Tensor) -> _Cells:
        """Cut each cell in four: its sectors where `across`, else its radii."""
        lens, low, high, sector, width = (value[:, None].expand(-1, 4) for value in self)
        part, across = torch.arange(4, device=low.device), across[:, None]
        start = torch.where(part == 0, low, low + (high - low) * (part / 4))
        end = torch.cat([start[:, 1:], high[:, :1]], 1)
        fewer = width // 4
        cut = (
            lens,
            torch.where(across, low, start),
            torch.where(across, high, end),
            torch.where(across, sector + part * fewer, sector),
            torch.where(across, fewer, width),
        )
        return _Cells(*(value.flatten() for value in cut))


def prove_regular(coefficients: Tensor, model: LensModel, reach: Tensor, disc: Tensor) -> tuple[Tensor, Tensor]:
    """Find how far a lens is proven to be regular.

    Args:
        coefficients: (B, P).
        model: the lens model; not a hybrid one.
        reach: (B, S) how far to prove it in each of the `SECTORS`, the first of which begins at the x axis; S = 1 for a
            radial model.
        disc: (B,) the radius up to which `positive` is asked for.

    Returns:
        positive (B,), the radius of the disc on which the determinant is proven to be positive, as far as asked for;
        and single (B, S), the radius up to which it is proven to change its sign at most once in each direction.
    """
    columns = coefficients.unbind(-1)

    def radial(places: Sequence[int], cells: _Cells, span: Span, factor: int) -> Jet:
        """1 + Σ c_k r^2k; or, with factor 1, r times its derivative."""
        powers = [2 * (k + 1) for k in range(len(places))]
        weights = [columns[i][cells.lens] * float(power**factor) for i, power in zip(places, powers, strict=True)]
        return span.polynomial(weights, powers, constant=1.0 - factor)

    def denominator(cells: _Cells, span: Span) -> Jet:
        return radial(model.denominator_index, cells, span, 0)

    def determinant(cells: _Cells, span: Span) -> Jet:
        numerator = radial(model.numerator_index, cells, span, 0)
        along, pole = numerator + radial(model.numerator_index, cells, span, 1), None
        if model.denominator:
            pole = denominator(cells, span)
            along = along * pole - numerator * radial(model.denominator_index, cells, span, 1)
        if model.radial:
            return along * numerator
        return _around(_waves(columns, model, cells, span, along, numerator, pole), cells)

    positive, single = _prove(determinant, reach, disc)
    if model.denominator:
        pole_positive, pole_single = _prove(denominator, reach.amax(-1, keepdim=True), disc)
        positive, single = torch.minimum(positive, pole_positive), torch.minimum(single, pole_single)
    return positive, single


def _waves(
    columns: Sequence[Tensor], model: LensModel, cells: _Cells, span: Span, along: Jet, numerator: Jet, pole: Jet | None
) -> tuple[Jet, ...]:
    """E as a constant, the factors of the cosine and sine of φ, and those of 2φ; `along` is H, `pole` is D."""
    zero = span.polynomial([], [])
    qx = qy = px = py = zero
    if model.tangential:
        p1, p2 = (columns[model.names.index(name)][cells.lens] for name in ("p1", "p2"))
        qx, qy = span.polynomial([2.0 * p2], [1]), span.polynomial([2.0 * p1], [1])
    if model.prism:
        powers = [2 * k + 1 for k in range(model.prism)]
        px, py = (
            span.polynomial([(n + 1.0) * columns[i][cells.lens] for i, n in zip(index, powers, strict=True)], powers)
            for index in model.prism_index
        )
    more_x, more_y = qx + qx + px, qy + qy + py
    first = along, numerator
    second = qx * qx + qy * qy, qx * more_x - qy * more_y, qx * more_y + qy * more_x
    if pole is not None:
        square = pole * pole
        cube = square * pole
        first = along * pole, numerator * square
        second = second[0] * cube, second[1] * cube, second[2] * cube
    once = (first[0] * q + first[1] * (q + more) for q, more in ((qx, more_x), (qy, more_y)))
    return (along * numerator + second[0], *once, *second[1:])


def _around(waves: tuple[Jet, ...], cells: _Cells) -> Jet:
    """Bound constant + a cos φ + b sin φ + c cos 2φ + d sin 2φ in all directions of each cell."""
    middle, half = (cells.sector + 0.5 * cells.width) * (2 * math.pi / SECTORS), cells.width * (math.pi / SECTORS)
    cosine, sine = torch.cos(middle), torch.sin(middle)
    factors = [torch.ones_like(half), cosine, sine, cosine * cosine - sine * sine, 2.0 * cosine * sine]
    rates = [torch.zeros_like(half), -sine, cosine, -2.0 * factors[4], 2.0 * factors[3]]
    sizes, steepest = zip(*(wave.size() for wave in waves), strict=True)

    def total(parts: Sequence[Tensor], weights: Sequence[Tensor | float]) -> Tensor:
        return sum((part * weight for part, weight in zip(parts, weights, strict=True)), torch.zeros_like(half))

    def error(errors: Sequence[Tensor], centers: Sequence[Tensor], bounds: Sequence[Tensor]) -> Tensor:
        """Of the jets, of rounding, and of other directions than the middle one, to second order."""
        own = total(errors, (1.0,) * 5) + total(bounds, (1e-15,) * 5)
        return own + half * total(centers, rates).abs() + 0.5 * half * half * total(bounds, (0.0, 1.0, 1.0, 4.0, 4.0))

    values, slopes = [wave.value for wave in waves], [wave.slope for wave in waves]
    return Jet(
        total(values, factors),
        total(slopes, factors),
        total([wave.bend for wave in waves], (1.0,) * 5),
        error([wave.value_error for wave in waves], values, sizes),
        error([wave.slope_error for wave in waves], slopes, steepest),
        waves[0].half,
    )


def _prove(bound: Callable[[_Cells, Span], Jet], reach: Tensor, disc: Tensor) -> tuple[Tensor, Tensor]:
    """Radii (B,) and (B, S) up to which a function is positive, and changes its sign at most once per direction."""
    lenses, sectors = reach.shape
    quarters, count = (4, sectors // 4) if sectors > 1 else (1, 1)
    # Evenly in angle, as for a pinhole.
    ends = reach.reshape(lenses * quarters, count).amax(-1, keepdim=True)
    steps = torch.linspace(0.0, 1.0, _RINGS + 1, dtype=torch.float64, device=reach.device)
    edges = torch.cat([torch.tan(torch.atan(ends) * steps[:-1]), ends], 1)
    row = torch.arange(len(ends), device=reach.device)[:, None].expand(-1, _RINGS).flatten()
    cells = _Cells(
        row // quarters,
        edges[:, :-1].flatten(),
        edges[:, 1:].flatten(),
        row % quarters * count,
        torch.full_like(row, count),
    )
    done: list[tuple[_Cells, Tensor, Tensor]] = []
    while len(cells.lens):
        span = Span(cells.low, cells.high)
        jet = bound(cells, span)
        sign, falls = jet.sign(), jet.falls()
        # Shorter cells do not help where the error comes from the width of the sector, or from rounding.
        wide = jet.value_error > (jet.slope.abs() + jet.bend * jet.half) * jet.half
        across = wide & (cells.width > 1)
        helps = (~wide | (jet.slope_error < jet.bend * jet.half)) & (cells.high > _INNERMOST)
        helps &= span.half > _SHORTEST * cells.high
        undecided = (sign == 0) & ~(falls & (cells.low >= disc[cells.lens])) & (across | helps)
        if int(undecided.sum()) > _MOST_CELLS * lenses:
            undecided &= cells.low <= cells.low[undecided].kthvalue(_MOST_CELLS * lenses).values
        done.append((cells.take(~undecided), sign[~undecided], falls[~undecided]))
        cells = cells.take(undecided).in_four(across[undecided])

    every, signs, falling = zip(*done, strict=True)
    cells = _Cells(*(torch.cat(each) for each in zip(*every, strict=True)))
    sign, falls = torch.cat(signs), torch.cat(falling)
    lowest = torch.where(sign <= 0, cells.low, torch.inf)
    positive = reach.amax(-1).scatter_reduce(0, cells.lens, lowest, "amin")
    # A sign can change from negative to positive only in cells that remained undecided.
    cells = cells.take((sign == 0) & ~falls)
    row = torch.repeat_interleave(cells.lens * sectors + cells.sector, cells.width)
    before = torch.repeat_interleave(cells.width.cumsum(0) - cells.width, cells.width)
    row = row + torch.arange(len(row), device=row.device) - before
    low = torch.repeat_interleave(cells.low, cells.width)
    return positive, reach.flatten().scatter_reduce(0, row, low, "amin").reshape(reach.shape)
