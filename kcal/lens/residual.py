"""A small smooth correction of the distorted plane: what a real lens does beside its formula.

After the lens terms, tilt included, a point of the plane is at d. The residual field moves it, d → d + r(d), and the
intrinsics follow. r is a network of Gaussian units on regular grids, one grid per width l (Broomhead and Lowe 1988):

    r(d) = Σ_ij w_ij e(x; x_i, l) e(y; y_j, l),   e(x; c, l) = exp(-(x - c)² / 2 l²)

It is smooth to any order, zero for zero weights, and vanishes within a few widths of the outermost unit. Because a
Gaussian of two variables is a product, a grid of n x m units costs n + m exponentials per point and one matrix product.
r is linear in the weights, so a fit with Gaussian priors on them is linear least squares.

The slope of r must stay below `LARGEST_SLOPE` everywhere, which is checked. Then d + r(d) is one-to-one on the whole
plane (Banach), the parametric lens keeps its valid region, and the inverse always exists.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from kcal.checks import Float64Module, as_points, require_finite
from kcal.errors import InputError
from kcal.lens.newton import Jacobian, inverse_jacobian, is_solved, newton_step
from kcal.lens.tracing import is_differentiated, known_true, may_branch

# Distance between the units of a grid, in widths. Denser units are nearly redundant.
SPACING = 0.8
# Of r, everywhere: above 1 the inverse might not be unique, and close to 1 it is hard to find.
LARGEST_SLOPE = 0.5
# Steps of the inverse: in compiled graphs; with the first Jacobian; of Newton's method at most; of the contraction,
# which halves the error at least, at most.
_FIXED, _CHORD, _NEWTON, _CONTRACTIONS = 4, 4, 12, 60
# The largest values of Σ_i |e|, Σ_i |e'| and Σ_i |e''| anywhere on an endless grid of width one.
_SUMS = (3.14, 2.58, 3.11)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldScale:
    """A grid of Gaussian units of one width; lengths are on the distorted plane, in focal lengths.

    Args:
        width: l of each unit.
        left: x of the first column of units.
        top: y of the first row.
        columns: number of columns.
        rows: number of rows.
    """

    width: float
    left: float
    top: float
    columns: int
    rows: int

    def __post_init__(self) -> None:
        if not (0 < self.width < math.inf and math.isfinite(self.left) and math.isfinite(self.top)):
            raise InputError(f"field scale: width must be positive and all numbers finite, got {self}")
        if min(self.columns, self.rows) < 1:
            raise InputError(f"field scale: {self.columns} x {self.rows} units; at least one each is needed")

    @property
    def count(self) -> int:
        """Number of units."""
        return self.columns * self.rows

    def places(self) -> tuple[list[float], list[float]]:
        """Coordinates x of the columns and y of the rows."""
        step = SPACING * self.width
        return [self.left + i * step for i in range(self.columns)], [self.top + j * step for j in range(self.rows)]


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldGrid:
    """The units of a residual field: grids, each of its own width.

    Example:
        >>> grid = FieldGrid.covering((-1.0, -0.6), (1.0, 0.6), widths=[0.5, 0.25])
        >>> [(s.columns, s.rows) for s in grid.scales], grid.count
        ([(6, 4), (11, 7)], 101)
    """

    scales: tuple[FieldScale, ...] = ()

    @classmethod
    def covering(cls, low: Sequence[float], high: Sequence[float], widths: Sequence[float]) -> FieldGrid:
        """Grids that cover the rectangle from `low` to `high` (x, y) and are centered on it."""
        scales = []
        for width in widths:
            step = SPACING * width
            counts = [math.ceil((b - a) / step) + 1 for a, b in zip(low, high, strict=True)]
            starts = [0.5 * (a + b - step * (n - 1)) for a, b, n in zip(low, high, counts, strict=True)]
            scales.append(FieldScale(width=width, left=starts[0], top=starts[1], columns=counts[0], rows=counts[1]))
        return cls(scales=tuple(scales))

    @property
    def count(self) -> int:
        """Number of units of all widths."""
        return sum(scale.count for scale in self.scales)

    def scale_weights(self, weights: Tensor) -> list[Tensor]:
        """Split weights (2, K) into one tensor (2, columns, rows) per scale."""
        parts = weights.split([scale.count for scale in self.scales], -1)
        return [part.unflatten(-1, (s.columns, s.rows)) for s, part in zip(self.scales, parts, strict=True)]


class Field(NamedTuple):
    """A residual field for the functions below: the units, and their weights (2, K) along x and y."""

    grid: FieldGrid
    weights: Tensor


class Corrected(NamedTuple):
    """Corrected points d + r(d) as x, y (..., N), and their Jacobian by d, or () if it was not asked for."""

    x: Tensor
    y: Tensor
    point: Jacobian


def _gaussians(z: Tensor, places: Sequence[float], width: float) -> tuple[Tensor, Tensor]:
    """e(z; c, l) along one axis at z (..., N) for units at `places`, (..., M, N), and -e' / e."""
    # As tensors: ONNX would write plain numbers as float32.
    inverse = torch.tensor(1.0 / width, dtype=z.dtype, device=z.device)
    scaled = torch.tensor([place / width for place in places], dtype=z.dtype, device=z.device)
    t = (z * inverse)[..., None, :] - scaled[:, None]
    return torch.exp(-0.5 * (t * t)), t * inverse


def correct_components(x: Tensor, y: Tensor, field: Field, *, slopes: bool = True) -> Corrected:
    """Move points of the distorted plane by a residual field.

    Args:
        x: (..., N).
        y: (..., N).
        field: one field; its weights have no batch dimensions.
        slopes: whether `Corrected.point` is needed.
    """
    if not field.grid.scales:
        one, zero = torch.ones_like(x), torch.zeros_like(x)
        return Corrected(x, y, (one, zero, zero, one) if slopes else ())
    parts = []
    for scale, weights in zip(field.grid.scales, field.grid.scale_weights(field.weights), strict=True):
        columns, rows = scale.places()
        across, across_rate = _gaussians(x, columns, scale.width)
        down, down_rate = _gaussians(y, rows, scale.width)
        matrix = weights.transpose(-1, -2).flatten(0, 1)
        # One product for both components: (2 rows, columns) times (..., columns, N).
        along = (matrix @ across).unflatten(-2, (2, scale.rows))
        part = [(along * down[..., None, :, :]).sum(-2)]
        if slopes:
            turned = (matrix @ (across * across_rate)).unflatten(-2, (2, scale.rows))
            part.append(-(turned * down[..., None, :, :]).sum(-2))
            part.append(-(along * (down * down_rate)[..., None, :, :]).sum(-2))
        parts.append(part)
    moved, *rates = (sum(terms[1:], terms[0]) for terms in zip(*parts, strict=True))
    point: Jacobian = ()
    if slopes:
        (a, d), (b, e) = rates[0].unbind(-2), rates[1].unbind(-2)
        point = (1.0 + a, b, d, 1.0 + e)
    return Corrected(x + moved[..., 0, :], y + moved[..., 1, :], point)


def field_basis(x: Tensor, y: Tensor, grid: FieldGrid) -> Tensor:
    """Values (..., K, N) of all units at points (..., N): the derivatives of r by the weights, the same for x and y."""
    out = []
    for scale in grid.scales:
        columns, rows = scale.places()
        across, _ = _gaussians(x, columns, scale.width)
        down, _ = _gaussians(y, rows, scale.width)
        out.append((across[..., :, None, :] * down[..., None, :, :]).flatten(-3, -2))
    return torch.cat(out, -2) if out else x.new_zeros((*x.shape[:-1], 0, x.shape[-1]))


@torch.no_grad()
def field_bounds(field: Field) -> tuple[float, float]:
    """Upper bounds of a field's displacement and of its slope (Frobenius norm) on the whole plane.

    The bounds are rigorous and some percent above the largest values: each scale is evaluated on nodes an eighth of a
    width apart, and its second derivatives bound the change in between.
    """
    largest = steepest = 0.0
    flat, bent, sharp = _SUMS
    for scale, weights in zip(field.grid.scales, field.grid.scale_weights(field.weights.detach()), strict=True):
        step = scale.width / 8
        axes = []
        for places in scale.places():
            # Six widths beyond the outermost unit, Gaussians are zero to 1e-8.
            margin = 6.0 * scale.width
            count = math.ceil((places[-1] - places[0] + 2.0 * margin) / step) + 1
            nodes = places[0] - margin + step * torch.arange(count, dtype=weights.dtype, device=weights.device)
            axes.append(_gaussians(nodes, places, scale.width))
        (across, across_rate), (down, down_rate) = axes
        value, by_x, by_y = (
            torch.einsum("aij,im,jn->amn", weights, a, b)
            for a, b in ((across, down), (across * across_rate, down), (across, down * down_rate))
        )
        heaviest = weights.abs().amax((-1, -2))
        curve = float((heaviest * math.sqrt(2.0 * (sharp * flat) ** 2 + 2.0 * bent**4)).norm()) / scale.width**2
        # Half a diagonal to the nearest node; beyond the outermost nodes the field only decreases.
        away = step / math.sqrt(2.0)
        slope = float((by_x.square() + by_y.square()).sum(0).max().sqrt()) + away * curve
        largest += float(value.square().sum(0).max().sqrt()) + away * slope
        steepest += slope
    return largest, steepest


def undo_components(x: Tensor, y: Tensor, field: Field) -> tuple[Tensor, Tensor, Tensor]:
    """Solve d + r(d) = (x, y) for d.

    Newton's method, with the first Jacobian kept for some steps; where it strays, the contraction d = goal - r(d),
    which always converges. Compiled and exported graphs take a fixed number of full Newton steps. The last two steps
    stay in the autograd graph, as in `kcal.lens.inverse.undistort`.

    Args:
        x: (..., N) finite.
        y: (..., N) finite.
        field: a field whose slope stays below `LARGEST_SLOPE`.

    Returns:
        x and y of d, and (..., N) whether they solve the equation to rounding, which is always true for such a field
        except in a graph of fixed steps.
    """
    if not field.grid.scales:
        return x, y, torch.ones_like(x, dtype=torch.bool)
    with torch.no_grad():
        solve = _undo_eagerly if may_branch(x, y, field.weights) else _undo_in_fixed_steps
        found_x, found_y, solved = solve(x, y, field)
    if is_differentiated(x, y, field.weights):
        for _ in range(2):
            found_x, found_y = _field_step(found_x, found_y, x, y, field)
    return found_x, found_y, solved


def _field_step(x: Tensor, y: Tensor, goal_x: Tensor, goal_y: Tensor, field: Field) -> tuple[Tensor, Tensor]:
    here = correct_components(x, y, field)
    return newton_step(x, y, here.x - goal_x, here.y - goal_y, inverse_jacobian(here.point))


def _undo_eagerly(goal_x: Tensor, goal_y: Tensor, field: Field) -> tuple[Tensor, Tensor, Tensor]:
    x, y = goal_x, goal_y
    solved = torch.zeros_like(goal_x, dtype=torch.bool)
    inverse: Jacobian = ()
    for trial in range(_NEWTON + _CONTRACTIONS):
        if trial == _NEWTON:
            x, y = torch.where(solved, x, goal_x), torch.where(solved, y, goal_y)
        fresh = trial == 0 or _CHORD <= trial < _NEWTON
        here = correct_components(x, y, field, slopes=fresh)
        error_x, error_y = here.x - goal_x, here.y - goal_y
        solved = is_solved(error_x, error_y, goal_x, goal_y)
        if known_true(solved):
            break
        inverse = inverse_jacobian(here.point) if fresh else inverse
        x, y = newton_step(x, y, error_x, error_y, inverse) if trial < _NEWTON else (x - error_x, y - error_y)
    return x, y, solved


def _undo_in_fixed_steps(goal_x: Tensor, goal_y: Tensor, field: Field) -> tuple[Tensor, Tensor, Tensor]:
    x, y = goal_x, goal_y
    for _ in range(_FIXED):
        x, y = _field_step(x, y, goal_x, goal_y, field)
    here = correct_components(x, y, field, slopes=False)
    return x, y, is_solved(here.x - goal_x, here.y - goal_y, goal_x, goal_y)


class FieldResidual(Float64Module):
    """A residual field as a module: a network of Gaussian units on the distorted plane.

    Convention: coordinates and corrections lie on the plane after the lens terms, in focal lengths, y down. Float64,
    whatever the module is cast to. The weights do not require gradients until asked. Zero weights are the identity.

    Args:
        grid: the units.
        weights: (2, K) of the units, along x and y; zero if not given.

    Raises:
        InputError: weights of another shape or not finite, or a field whose slope exceeds 0.5 somewhere and that
            might not be invertible.

    Example:
        >>> grid = FieldGrid.covering((-1.0, -0.6), (1.0, 0.6), widths=[0.5])
        >>> weights = torch.zeros(2, grid.count, dtype=torch.float64)
        >>> weights[0, 20] = 0.01
        >>> field = FieldResidual(grid, weights)
        >>> point = torch.tensor([[0.1, 0.2], [30.0, 0.0]], dtype=torch.float64)
        >>> moved = field(point)
        >>> bool((moved[0, 0] > 0.1) & (moved[0, 0] < 0.11)), moved[1].tolist()
        (True, [30.0, 0.0])
    """

    weights: Tensor

    def __init__(self, grid: FieldGrid, weights: Tensor | None = None) -> None:
        super().__init__()
        self.grid = grid
        if weights is None:
            weights = torch.zeros(2, grid.count, dtype=torch.float64)
        weights = as_points("field weights", weights, grid.count)
        if weights.shape != (2, grid.count):
            raise InputError(f"field weights: shape (2, {grid.count}) is needed, got {tuple(weights.shape)}")
        require_finite("field weights", weights)
        self.weights = nn.Parameter(weights.detach().clone(), requires_grad=False)
        self.check()

    @property
    def field(self) -> Field:
        """Units and weights, for the functions of this module."""
        return Field(self.grid, self.weights)

    def bounds(self) -> tuple[float, float]:
        """Upper bounds of the displacement, in focal lengths, and of the slope; see `field_bounds`."""
        return field_bounds(self.field)

    def check(self) -> None:
        """Raise `InputError` if the slope exceeds 0.5 somewhere; call it after changing the weights in place."""
        _, steepest = self.bounds()
        if not steepest <= LARGEST_SLOPE:
            raise InputError(
                f"residual field: its slope reaches {steepest:.3g}, and above {LARGEST_SLOPE} it might not be "
                "invertible; use smaller weights or wider units"
            )

    def forward(self, distorted: Tensor) -> Tensor:
        """Move points d (..., N, 2) of the distorted plane to d + r(d)."""
        distorted = as_points("distorted", distorted, 2)
        moved = correct_components(distorted[..., 0], distorted[..., 1], self.field, slopes=False)
        return torch.stack([moved.x, moved.y], -1)

    def extra_repr(self) -> str:
        """Units of each width and the largest displacement, for `repr`."""
        grids = ", ".join(f"{s.columns}x{s.rows} of {s.width:.3g}" for s in self.grid.scales)
        return f"units {grids or 'none'}, moves at most {self.bounds()[0]:.3g}"

    def _load_from_state_dict(self, *args: Any, **kwargs: Any) -> None:
        super()._load_from_state_dict(*args, **kwargs)
        self.check()
