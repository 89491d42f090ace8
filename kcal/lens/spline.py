"""Tables of smooth functions of two variables: uniform bicubic B-splines, twice continuously differentiable.

A spline is a table of coefficients c[j, i] whose bumps stand at origin + (i, j) · step. With t = (x - origin) / step,
i = floor(t) and f = t - i, the four bumps i - 1 to i + 2 count along each axis, by

    (1 - f)³ / 6,  (3 f³ - 6 f² + 4) / 6,  (-3 f³ + 3 f² + 3 f + 1) / 6,  f³ / 6

Coefficients come from values at the same places by a short filter instead of the system of equations that would
interpolate: c = v - δ²v / 6 + δ⁴v / 36 along each axis (de Boor's quasi-interpolant), which is as accurate to the
fourth power of the step, and local: what is not known in one corner of a table does not spread.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

# c = v - δ²v / 6 + δ⁴v / 36.
_FILTER = (1 / 36, -10 / 36, 54 / 36, -10 / 36, 1 / 36)
# Values needed beyond the outermost cell on each side: one for the bumps, two for the filter.
RINGS = 3
# Third differences vanish along a cubic: how it goes on beyond its last four values.
_AHEAD = (4.0, -6.0, 4.0, -1.0)


class Spline(NamedTuple):
    """A bicubic B-spline and where it may be used.

    Attributes:
        coefficients: (K, rows + 3, columns + 3) for a grid of rows x columns cells.
        origin: (2,) x and y of the first bump; the first cell begins one step farther.
        step: (2,) width and height of a cell.
        cells: (rows, columns) bool, which cells may be used.
    """

    coefficients: Tensor
    origin: Tensor
    step: Tensor
    cells: Tensor


def filter_nodes(values: Tensor) -> Tensor:
    """Coefficients (..., R - 4, C - 4) from values (..., R, C) at the bumps."""
    rows, columns = values.shape[-2] - 4, values.shape[-1] - 4
    along = sum(weight * values[..., k : k + columns] for k, weight in enumerate(_FILTER))
    assert isinstance(along, Tensor)
    down = sum(weight * along[..., k : k + rows, :] for k, weight in enumerate(_FILTER))
    assert isinstance(down, Tensor)
    return down


def extend_nodes(values: Tensor, known: Tensor, rings: int = 2 * RINGS) -> tuple[Tensor, Tensor]:
    """Continue values (K, R, C) beyond where they are `known` (R, C), by cubics along rows and columns.

    Each ring takes the mean over those of the four directions that have four known values in a row. A corner takes as
    many rings as both its sides together.

    Returns:
        values and known, grown by up to `rings` nodes; zero where still not known.
    """
    values = torch.where(known, values, 0.0)
    for _ in range(rings):
        total, count = torch.zeros_like(values), torch.zeros(known.shape, dtype=values.dtype, device=values.device)
        for axis in (-2, -1):
            for way in (1, -1):
                four = [_moved(values, known, axis, way * k) for k in (1, 2, 3, 4)]
                usable = four[0][1] & four[1][1] & four[2][1] & four[3][1]
                ahead = sum(weight * value for weight, (value, _) in zip(_AHEAD, four, strict=True))
                total, count = total + torch.where(usable, ahead, 0.0), count + usable
        new = ~known & (count > 0)
        values = torch.where(new, total / count.clamp(min=1.0), values)
        known = known | new
    return values, known


def _moved(values: Tensor, known: Tensor, axis: int, by: int) -> tuple[Tensor, Tensor]:
    """Values and mask moved along an axis, nothing coming round from the other side."""
    count = known.shape[axis]
    place = torch.arange(count, device=known.device)
    fresh = (place - by >= 0) & (place - by < count)
    fresh = fresh if axis == -1 else fresh[:, None]
    return values.roll(by, axis), known.roll(by, axis) & fresh


def _bumps(f: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The four weights at fractions f of a cell."""
    g = 1.0 - f
    first, last = g * g * g, f * f * f
    # The other two by symmetry: 4 - 6 f² + 3 f³ and the same of g.
    second = 4.0 - 6.0 * (f * f) + 3.0 * last
    third = 4.0 - 6.0 * (g * g) + 3.0 * first
    return first / 6.0, second / 6.0, third / 6.0, last / 6.0


def evaluate_spline(spline: Spline, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Values (K, ...) at x, y (...), and (...) whether they lie in cells that may be used.

    Elsewhere the values are finite and mean nothing. x and y must be finite.
    """
    rows, columns = spline.cells.shape
    u = (x - spline.origin[0]) / spline.step[0]
    v = (y - spline.origin[1]) / spline.step[1]
    # The far edge belongs to the last cell. Clamped positions have no gradient, and are not valid.
    inside = (u >= 1.0) & (u <= columns + 1.0) & (v >= 1.0) & (v <= rows + 1.0)
    u, v = torch.clamp(u, 1.0, columns + 1.0), torch.clamp(v, 1.0, rows + 1.0)
    i = torch.clamp(torch.floor(u.detach()), max=columns)
    j = torch.clamp(torch.floor(v.detach()), max=rows)
    across, down = _bumps(u - i), _bumps(v - j)
    i, j = i.to(torch.int64) - 1, j.to(torch.int64) - 1
    width = columns + 3
    table = spline.coefficients.flatten(-2)
    first = j * width + i
    value = torch.zeros_like(x)
    for k, weight in enumerate(down):
        line = sum(table[:, first + (k * width + m)] * w for m, w in enumerate(across))
        value = value + weight * line
    return value, inside & spline.cells.flatten()[j * columns + i]
