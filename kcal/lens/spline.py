"""Tabulate smooth functions of two variables by uniform bicubic B-splines, twice continuously differentiable.

A spline is a table of coefficients c[j, i] of basis functions at origin + (i, j) · step. With t = (x - origin) / step,
i = floor(t) and f = t - i, the four basis functions i - 1 to i + 2 count along each axis, with the weights

    (1 - f)³ / 6,  (3 f³ - 6 f² + 4) / 6,  (-3 f³ + 3 f² + 3 f + 1) / 6,  f³ / 6

Coefficients are computed from values at the same places by a short filter, c = v - δ²v / 6 + δ⁴v / 36 along each axis
(de Boor's quasi-interpolant). Its error falls with the fourth power of the step like that of interpolation, which would
need a system of equations. It is also local: unknown values in one corner of a table do not spread.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_FILTER = (1 / 36, -10 / 36, 54 / 36, -10 / 36, 1 / 36)
# Values needed beyond the outermost cell on each side: one for the basis functions, two for the filter.
RINGS = 3
# How a cubic, whose fourth differences vanish, continues beyond its last four values.
_CUBIC_STEP = (4.0, -6.0, 4.0, -1.0)


class Spline(NamedTuple):
    """A bicubic B-spline and the cells in which it may be used.

    Attributes:
        coefficients: (K, rows + 3, columns + 3) for a grid of rows x columns cells.
        origin: (2,) x and y of the first basis function; the first cell begins one step farther.
        step: (2,) width and height of a cell.
        cells: (rows, columns) bool, which cells may be used.
    """

    coefficients: Tensor
    origin: Tensor
    step: Tensor
    cells: Tensor


def filter_nodes(values: Tensor) -> Tensor:
    """Compute coefficients (..., R - 4, C - 4) from values (..., R, C) at the same places."""
    rows, columns = values.shape[-2] - 4, values.shape[-1] - 4
    along = sum(weight * values[..., k : k + columns] for k, weight in enumerate(_FILTER))
    assert isinstance(along, Tensor)
    down = sum(weight * along[..., k : k + rows, :] for k, weight in enumerate(_FILTER))
    assert isinstance(down, Tensor)
    return down


def extend_nodes(values: Tensor, known: Tensor, rings: int = 2 * RINGS) -> tuple[Tensor, Tensor]:
    """Continue values (K, R, C) beyond where they are `known` (R, C), by cubics along rows and columns.

    Each ring takes the mean over those of the four directions that have four known values in a row. A corner needs as
    many rings as its two sides together.

    Returns:
        values and known, extended by up to `rings` nodes; zero where still not known.
    """
    values = torch.where(known, values, 0.0)
    for _ in range(rings):
        total, count = torch.zeros_like(values), torch.zeros(known.shape, dtype=values.dtype, device=values.device)
        for axis in (-2, -1):
            for way in (1, -1):
                four = [_shifted(values, known, axis, way * k) for k in (1, 2, 3, 4)]
                usable = four[0][1] & four[1][1] & four[2][1] & four[3][1]
                ahead = sum(weight * value for weight, (value, _) in zip(_CUBIC_STEP, four, strict=True))
                total, count = total + torch.where(usable, ahead, 0.0), count + usable
        new = ~known & (count > 0)
        values = torch.where(new, total / count.clamp(min=1.0), values)
        known = known | new
    return values, known


def _shifted(values: Tensor, known: Tensor, axis: int, by: int) -> tuple[Tensor, Tensor]:
    """Shift values and mask along an axis; what enters from the other side is not known."""
    count = known.shape[axis]
    place = torch.arange(count, device=known.device)
    fresh = (place - by >= 0) & (place - by < count)
    fresh = fresh if axis == -1 else fresh[:, None]
    return values.roll(by, axis), known.roll(by, axis) & fresh


def _basis_weights(f: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The four weights at fractions f of a cell."""
    g = 1.0 - f
    first, last = g * g * g, f * f * f
    # The other two by symmetry: 4 - 6 f² + 3 f³ and the same of g.
    second = 4.0 - 6.0 * (f * f) + 3.0 * last
    third = 4.0 - 6.0 * (g * g) + 3.0 * first
    return first / 6.0, second / 6.0, third / 6.0, last / 6.0


def evaluate_spline(spline: Spline, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Evaluate the spline: values (K, ...) at finite x, y (...), and (...) whether these lie in usable cells.

    Elsewhere the values are finite but meaningless.
    """
    rows, columns = spline.cells.shape
    u = (x - spline.origin[0]) / spline.step[0]
    v = (y - spline.origin[1]) / spline.step[1]
    # The far edge belongs to the last cell. Clamped positions have no gradient and are not valid.
    inside = (u >= 1.0) & (u <= columns + 1.0) & (v >= 1.0) & (v <= rows + 1.0)
    u, v = torch.clamp(u, 1.0, columns + 1.0), torch.clamp(v, 1.0, rows + 1.0)
    i = torch.clamp(torch.floor(u.detach()), max=columns)
    j = torch.clamp(torch.floor(v.detach()), max=rows)
    across, down = _basis_weights(u - i), _basis_weights(v - j)
    i, j = i.to(torch.int64) - 1, j.to(torch.int64) - 1
    width = columns + 3
    table = spline.coefficients.flatten(-2)
    first = j * width + i
    value = torch.zeros_like(x)
    for k, weight in enumerate(down):
        line = sum(table[:, first + (k * width + m)] * w for m, w in enumerate(across))
        value = value + weight * line
    return value, inside & spline.cells.flatten()[j * columns + i]
