"""How a printed board differs from the one that was ordered: smooth modes of bending and of print errors.

With a, b = ±1 at the outermost corners, bending is a sum of Legendre products L_i(a) L_j(b) of degree 2 to 4 in z; the
print errs in the plane by stretch (a, 0), shear (b, 0), and products of degree 2 and 3 in x and y. The products ab, of
which the lengths of opposite sides differ, have an amplitude of their own: views hardly tell them from a decentered
lens, and other modes do not say how large they are. Degree 1 in z is a turn of the board, and what is left of degree
1 in the plane is its scale and a turn.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.corners.board import Board
from kcal.gaussian import Gaussian, numbered
from kcal.lens.information import BOARD_SLOT

BENDING, STRETCH, PRINT, TRAPEZOID, CORNER = range(5)
# Of modes whose amplitudes have a prior of their own.
KNOWN = -1


class BoardModes(NamedTuple):
    """The modes of one board.

    Attributes:
        shapes: (B, 3, N) displacement of each corner by a mode of amplitude one.
        unit: (B,) meters; amplitudes of a family are this times the same number.
        family: (B,) `BENDING`, `STRETCH` (with shear), `PRINT` or `TRAPEZOID`; `KNOWN` where the unit is
            the standard deviation. `with_corners` has 2 N amplitudes more, of each corner in x, then in y: `CORNER`.

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
    def displaced(self) -> bool:
        """Whether each corner may be off its place beside the modes."""
        return len(self.unit) > len(self.shapes)

    def with_corners(self) -> BoardModes:
        """The same modes, and each corner displaced by itself in the board's plane: fixed errors of print and paper."""
        count, extent = 2 * self.shapes.shape[-1], float(self.unit.max())
        unit, family = self.unit.new_full((count,), extent), self.family.new_full((count,), CORNER)
        return self._replace(unit=torch.cat([self.unit, unit]), family=torch.cat([self.family, family]))

    def without_corners(self) -> BoardModes:
        """The modes alone."""
        return self._replace(unit=self.unit[: len(self.shapes)], family=self.family[: len(self.shapes)])

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
    products = [(degree, i, left[i] * right[degree - i]) for degree in (2, 3, 4) for i in range(degree + 1)]
    modes = [((zero, zero, product), 0.5 ** (degree - 2), BENDING) for degree, _, product in products]
    modes += [((plane, zero, zero), 1.0, STRETCH) for plane in (a, b)]
    for degree, i, product in products[: 3 + 4]:
        family, unit = TRAPEZOID if i == 1 == degree - i else PRINT, 0.5 ** (degree - 1)
        modes += [((product, zero, zero), unit, family), ((zero, product, zero), unit, family)]
    shapes, units, families = zip(*modes, strict=True)
    units_of = extent * torch.tensor(units, dtype=points.dtype)
    return BoardModes(torch.stack([torch.stack(shape) for shape in shapes]), units_of, torch.tensor(families))


def undetermined_modes(points: Tensor) -> Tensor:
    """(7, 3, N) displacements that cameras cannot tell: shifts in x, y, z, two tilts, a turn, and the scale.

    Args:
        points: (N, 3) meters, z = 0.
    """
    x, y = (points[:, :2] - points[:, :2].mean(0)).unbind(-1)
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    modes = [(one, zero, zero), (zero, one, zero), (zero, zero, one), (zero, zero, x), (zero, zero, y)]
    return torch.stack([torch.stack(mode) for mode in [*modes, (-y, x, zero), (x, y, zero)]])


# Find views whose corners were read from another end of the board.
#
# A board with an even number of columns + rows looks alike after half a turn, a square one with even counts after each
# quarter. A perfect board is the same from every end; a printed one is not: bending of odd degree and print errors of
# even degree change sign. So the evidence of a camera tells which of its views agree on one board.

# Nats that turned views must gain, beyond the choices that there were: by chance they do once in e^10 = 22,000 times.
# Measured: one turned view of a printed board gains 79 and more.
CLEAR = 10.0
# Random orders from which the search begins, beside the orders as read: half of all views turned is the worst case.
_STARTS = 12
_MOST_ROUNDS = 30


def turned_corners(values: Tensor, board: Board, turns: Tensor) -> Tensor:
    """Values of each view's corners (V, N, ...) in the order that is read after quarter turns (V,) of the board."""
    grid = torch.arange(board.corners).view(board.rows, board.columns)
    # Only turns of the board onto itself are asked for; others of a board that is not square have no order.
    orders = {k: torch.rot90(grid, k).flatten() for k in set(turns.tolist())}
    return torch.stack([view[orders[k]] for view, k in zip(values, turns.tolist(), strict=True)])


def turned_deviation(offsets: Tensor, board: Board, turns: int) -> Tensor:
    """(N, 2) or (N, 3) displacements of the corners after quarter turns of the board, from those before."""
    size = offsets.shape[-1]
    back = torch.linalg.matrix_power(_QUARTER[:size, :size], turns)
    return turned_corners(offsets[None], board, torch.tensor([turns]))[0] @ back.T


# The corner at the end of the first row comes first: x becomes -y, y becomes x.
_QUARTER = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def mode_turn(turns: int) -> Tensor:
    """(B, B) amplitudes of a board after quarter turns, from those before; shifts, turns and scale do not count.

    Example:
        >>> mode_turn(2).diagonal()[:5].tolist()  # bending of degree 2 stays, of degree 3 changes sign
        [1.0, 1.0, 1.0, -1.0, -1.0]
    """
    # Amplitudes refer to half the board's sides, so that any square board gives the same, and half turns any board.
    board = Board(columns=8, rows=8, square=2.0 / 7.0)
    order = turned_corners(torch.arange(board.corners)[None], board, torch.tensor([turns]))[0]
    back = torch.linalg.matrix_power(_QUARTER, turns)
    shapes = board_modes(board.points).shapes
    basis = torch.cat([shapes, undetermined_modes(board.points)]).flatten(1).T
    turned = torch.einsum("kl,bln->bkn", back, shapes[:, :, order]).flatten(1).T
    return torch.linalg.lstsq(basis, turned).solution[: len(shapes)].round()


def turned(message: Gaussian, turns: int) -> Gaussian:
    """What is said of a board and of whatever else, about the amplitudes after quarter turns of the board."""
    change = mode_turn(turns).T
    board = numbered(BOARD_SLOT, len(change))
    return message.replaced(board, change.new_zeros(len(change)), change, board)


def find_turns(rows: Tensor, board: Board, prior: Gaussian, lens_deviation: Tensor, variance: float) -> Tensor:
    """(V,) quarter turns of each view that bring all onto one board; none if that gains little.

    Lens, board and the orders are sought together: in turn, lens and board are solved for, and each view takes the
    order that fits best, from the orders as read and from random ones. All is linear, poses included.

    Args:
        rows: (V, S + 1, 2 N) derivatives by lens and board off the poses, and their absolute target, pixels.
        board: the board.
        prior: of the amplitudes of its modes.
        lens_deviation: (L,) of the lens's prior, whose mean is zero.
        variance: of residuals, px².
    """
    turns = board.quarter_turns
    views, size = len(rows), rows.shape[1]
    if len(turns) == 1:
        return torch.zeros(views, dtype=torch.long)
    lens = len(lens_deviation)
    mean, half = prior.mean_and_half()
    # Of (z, -1), with lens and board = affine functions of z, whose prior is a standard normal.
    affine = torch.zeros(size, size, dtype=rows.dtype)
    affine[range(lens), range(lens)] = lens_deviation
    affine[lens:-1, lens:-1], affine[lens:-1, -1], affine[-1, -1] = half.T, -mean, 1.0
    parts = []
    for turn in turns:
        # A view that is to be turned shows the board turned back.
        seen = affine.clone()
        seen[lens:-1] = mode_turn(turn).T @ affine[lens:-1]
        part = rows.transpose(1, 2) @ seen
        parts.append(part.transpose(1, 2) @ part / variance)
    forms = torch.stack(parts, 1)
    each = torch.arange(views)

    def fit(orders: Tensor) -> tuple[Tensor, float]:
        """Chi² of each view in each order (V, K) with lens and board at their best, and the log evidence."""
        total = forms[each, orders].sum(0)
        root = torch.linalg.cholesky(total[:-1, :-1] + torch.eye(size - 1, dtype=rows.dtype))
        z = torch.cholesky_solve(total[:-1, -1:], root)[:, 0]
        y = torch.cat([z, -torch.ones(1, dtype=rows.dtype)])
        value = float(z @ z) + float(y @ total @ y) + 2.0 * float(root.diagonal().log().sum())
        return torch.einsum("a,vkab,b->vk", y, forms, y), -0.5 * value

    as_read = torch.zeros(views, dtype=torch.long)
    generator = torch.Generator().manual_seed(0)
    best: tuple[float, Tensor] | None = None
    for start in range(1 + _STARTS):
        orders = torch.randint(len(turns), (views,), generator=generator) if start else as_read
        for _ in range(_MOST_ROUNDS):
            chi2, evidence = fit(orders)
            better = chi2.argmin(1)
            if torch.equal(better, orders):
                break
            orders = better
        if best is None or evidence > best[0]:
            best = evidence, orders
    assert best is not None
    evidence, orders = best
    found = torch.tensor(turns)[orders]
    if not bool(mean.any()):
        # All views turned alike are the same board, turned: most views stay as they were read.
        found = (found - found.mode().values) % 4
    count = int((found > 0).sum())
    choices = math.log(views + 1) + math.log(math.comb(views, count)) + count * math.log(len(turns) - 1)
    return found if evidence - fit(as_read)[1] > CLEAR + choices else as_read
