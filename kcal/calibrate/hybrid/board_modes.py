"""How a printed board differs from the one that was ordered: smooth modes of bending and of print errors.

With a, b = ±1 at the outermost corners, bending is a sum of Legendre products L_i(a) L_j(b) of degree 2 to 4 in z; the
print errs in the plane by stretch (a, 0), shear (b, 0), and products of degree 2 and 3 in x and y. The products ab, of
which the lengths of opposite sides differ, have an amplitude of their own: views hardly tell them from a decentered
lens, and other modes do not say how large they are. Degree 1 in z is a turn of the board, and what is left of degree
1 in the plane is its scale and a turn.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

BENDING, STRETCH, PRINT, TRAPEZOID = range(4)
# Of modes whose amplitudes have a prior of their own.
KNOWN = -1


class BoardModes(NamedTuple):
    """The modes of one board.

    Attributes:
        shapes: (B, 3, N) displacement of each corner by a mode of amplitude one.
        unit: (B,) meters; amplitudes of a family are this times the same number.
        family: (B,) `BENDING`, `STRETCH` (with shear), `PRINT` or `TRAPEZOID`; `KNOWN` where the unit is
            the standard deviation.

    Example:
        >>> grid = torch.cartesian_prod(torch.arange(7.0), torch.arange(6.0)).double()
        >>> modes = board_modes(torch.cat([grid, torch.zeros(42, 1).double()], 1))
        >>> modes.family.bincount().tolist(), float(modes.unit.max())  # twelve of bending; the extent is 6
        ([12, 2, 12, 2], 6.0)
    """

    shapes: Tensor
    unit: Tensor
    family: Tensor

    @property
    def heights(self) -> Tensor:
        """(12, N) meters of the corners by which a board bends in a view: a quarter as much with each degree."""
        factor = self.unit**2 / self.unit.max()
        return (factor[:, None] * self.shapes[:, 2])[self.family == BENDING]


def board_modes(points: Tensor) -> BoardModes:
    """The 28 modes of a board.

    Args:
        points: (N, 3) meters, z = 0.

    Example:
        >>> grid = torch.cartesian_prod(torch.arange(7.0), torch.arange(6.0)).double()
        >>> modes = board_modes(torch.cat([grid, torch.zeros(42, 1).double()], 1))
        >>> modes.shapes.shape
        torch.Size([28, 3, 42])
    """
    low, high = points[:, :2].amin(0), points[:, :2].amax(0)
    a, b = ((2.0 * points[:, :2] - low - high) / (high - low)).unbind(-1)
    extent = float((high - low).max())

    def legendre(x: Tensor) -> list[Tensor]:
        return [torch.ones_like(x), x, (3 * x**2 - 1) / 2, (5 * x**3 - 3 * x) / 2, (35 * x**4 - 30 * x**2 + 3) / 8]

    left, right = legendre(a), legendre(b)
    zero = torch.zeros_like(a)
    shapes: list[Tensor] = []
    unit: list[float] = []
    family: list[int] = []
    for degree in (2, 3, 4):
        for i in range(degree + 1):
            shapes.append(torch.stack([zero, zero, left[i] * right[degree - i]]))
            unit.append(0.5 ** (degree - 2))
            family.append(BENDING)
    for plane in (a, b):
        shapes.append(torch.stack([plane, zero, zero]))
        unit.append(1.0)
        family.append(STRETCH)
    for degree in (2, 3):
        for i in range(degree + 1):
            product = left[i] * right[degree - i]
            shapes += [torch.stack([product, zero, zero]), torch.stack([zero, product, zero])]
            unit += [0.5 ** (degree - 1)] * 2
            family += [TRAPEZOID if i == 1 == degree - i else PRINT] * 2
    return BoardModes(torch.stack(shapes), extent * torch.tensor(unit, dtype=points.dtype), torch.tensor(family))


def undetermined_modes(points: Tensor) -> Tensor:
    """(7, 3, N) displacements that cameras cannot tell: shifts in x, y, z, two tilts, a turn, and the scale.

    Args:
        points: (N, 3) meters, z = 0.
    """
    x, y = (points[:, :2] - points[:, :2].mean(0)).unbind(-1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    modes = [(one, zero, zero), (zero, one, zero), (zero, zero, one), (zero, zero, x), (zero, zero, y)]
    return torch.stack([torch.stack(mode) for mode in [*modes, (-y, x, zero), (x, y, zero)]])
