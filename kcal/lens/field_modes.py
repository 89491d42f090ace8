"""What the field of a hybrid lens is made of: features with weights; Gaussian units of several widths are some."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from kcal.errors import InputError

# What the field of a hybrid lens is made of: features with weights, whose prior widths the evidence of the views sets.
#
# Three kinds exist: `kcal.lens.zernike.ZernikeModes`, the default, `GaussianModes` and
# `kcal.lens.network_modes.NetworkModes`. All can be compared and hashed. They are constants of a fit, which finds the
# weights; only the inside of a network may be trained.


class WeightPrior(NamedTuple):
    """The prior width of a weight, in radii of the disc: exp(h[amplitude] - exp(h[decay]) degree).

    Attributes:
        amplitude: index of a hyperparameter of the modes; None: pixels are square, and the width says how surely.
        decay: index of another one; None: there is none.
        degree: how fine the feature is.
    """

    amplitude: int | None
    decay: int | None
    degree: float


class FieldModes(Protocol):
    """Features of a field on the unit disc, each a smooth displacement (f, g) of the place (x, y).

    Attributes:
        names: of the weights.
        radial_names: names of those whose field is symmetric about the axis.
        hyperprior: mean, standard deviation and largest value of the natural logarithm of each hyperparameter.
        weight_priors: of each weight.
        peaks: largest displacement by each feature on the disc, to order of magnitude.
    """

    @property
    def names(self) -> tuple[str, ...]: ...  # noqa: D102

    @property
    def radial_names(self) -> frozenset[str]: ...  # noqa: D102

    @property
    def hyperprior(self) -> tuple[tuple[float, float, float], ...]: ...  # noqa: D102

    @property
    def weight_priors(self) -> Sequence[WeightPrior]: ...  # noqa: D102

    @property
    def peaks(self) -> Sequence[float]: ...  # noqa: D102

    def __len__(self) -> int:
        """Number of weights."""

    def columns(self, x: Tensor, y: Tensor) -> Tensor:
        """Evaluate each feature at places (x, y) (..., N) of the unit disc: (M, 2, ..., N)."""

    def fill_columns(self, out: Tensor, x: Tensor, y: Tensor, scale: Tensor) -> None:
        """Write `columns` times a scale (..., 2, N) into memory (M, ..., 2, N); nothing is differentiated."""

    def field(self, weights: Tensor, x: Tensor, y: Tensor, slopes: bool = True) -> tuple[Tensor, ...]:
        """Evaluate the weighted sum: the displacement (f, g), and if wanted its slopes f_x, f_y, g_x, g_y.

        Args:
            weights: (..., M), broadcast against the leading shape of the places.
            x: (..., N) places on the unit disc.
            y: (..., N).
            slopes: whether these are needed.

        Returns:
            Two or six tensors (..., N).
        """


class UnitModes:
    """What fields of scalar units have in common, which have one weight along x and one along y for each unit.

    Attributes:
        names: of the weights, those along x first.
    """

    names: tuple[str, ...]

    def __len__(self) -> int:
        """Number of weights."""
        return len(self.names)

    @property
    def radial_names(self) -> frozenset[str]:
        """See `FieldModes`: no unit is symmetric about the axis."""
        return frozenset()

    @property
    def peaks(self) -> tuple[float, ...]:
        """See `FieldModes`."""
        return (1.0,) * len(self)

    def columns(self, x: Tensor, y: Tensor) -> Tensor:
        """See `FieldModes`."""
        raise NotImplementedError

    def fill_columns(self, out: Tensor, x: Tensor, y: Tensor, scale: Tensor) -> None:
        """See `FieldModes`."""
        torch.mul(self.columns(x, y).movedim(1, -2), scale, out=out)


def vector_columns(values: Tensor) -> Tensor:
    """Columns (2 K, 2, ..., N) of K scalar units (K, ..., N) with weights along x, then with weights along y."""
    zero = torch.zeros_like(values)
    return torch.cat([torch.stack([values, zero], 1), torch.stack([zero, values], 1)])


# A field of Gaussian units of several widths: for structure that is local in the image.
#
#     f = Σ_k w_k e(x; x_k, l_k) e(y; y_k, l_k),   e(x; c, l) = exp(-(x - c)² / 2 l²),   likewise g, with other weights
#
# This is a network of radial basis functions (Broomhead and Lowe 1988). The units of one width stand on a square grid.
# Because a Gaussian of two variables is a product, a grid of n x n units costs 2 n exponentials per point and one
# matrix product.

# Distance between the units of a grid, in widths. Denser units are nearly redundant.
_SPACING = 0.8
# Units stand up to so many widths beyond the disc, where they still act inside.
_BEYOND = 0.5


class _Grid(NamedTuple):
    """Units of one width.

    Attributes:
        width: of each unit.
        places: (n,) of the columns, and likewise of the rows.
        number: of the unit at each point of the grid (n columns, n rows), flat; one past the last where there is none.
        points: (K,) the points that have a unit.
    """

    width: float
    places: Tensor
    number: Tensor
    points: Tensor


@dataclasses.dataclass(frozen=True, kw_only=True)
class GaussianModes(UnitModes):
    """Gaussian units on square grids over the unit disc (`FieldModes`).

    The weights along x come first, the widest units first, then those along y. Their prior has one amplitude, and one
    decay per octave of width.

    Args:
        widths: of the units, in radii of the disc, from wide to narrow.

    Attributes:
        names: "g0.3x" is the weight along x of the third unit of the first width.

    Raises:
        InputError: no width, or widths that do not decrease from at most 4 to at least 0.02.

    Example:
        >>> modes = GaussianModes(widths=(1.0, 0.5))
        >>> len(modes), modes.names[:2], modes.names[-1]
        (76, ('g0.0x', 'g0.1x'), 'g1.28y')
    """

    widths: tuple[float, ...] = (1.0, 0.5, 0.25)

    # Computed once: compilers cannot trace lazily computed attributes.
    names: tuple[str, ...] = dataclasses.field(init=False, repr=False, compare=False)
    _grids: tuple[_Grid, ...] = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        widths = tuple(float(width) for width in self.widths)
        falling = all(a > b for a, b in itertools.pairwise(widths))
        if not widths or not falling or not all(0.02 <= width <= 4.0 for width in widths):
            raise InputError(f"Gaussian modes: widths must decrease, from at most 4 to at least 0.02, got {widths}")
        grids = []
        for width in widths:
            step, limit = _SPACING * width, 1.0 + _BEYOND * width
            half = math.floor(limit / step)
            places = step * torch.arange(-half, half + 1, dtype=torch.float64)
            inside = (torch.hypot(places[:, None], places) <= limit).flatten()
            number = torch.where(inside, inside.cumsum(0) - 1, inside.sum())
            grids.append(_Grid(width, places, number, inside.nonzero()[:, 0]))
        names = [f"g{i}.{k}" for i, grid in enumerate(grids) for k in range(len(grid.points))]
        object.__setattr__(self, "widths", widths)
        object.__setattr__(self, "_grids", tuple(grids))
        object.__setattr__(self, "names", tuple(name + axis for axis in "xy" for name in names))

    @property
    def hyperprior(self) -> tuple[tuple[float, float, float], ...]:
        """See `FieldModes`: amplitude, and decay per octave."""
        return (math.log(1e-3), 2.0, math.inf), (math.log(1.5), 0.7, math.inf)

    @property
    def weight_priors(self) -> tuple[WeightPrior, ...]:
        """See `FieldModes`."""
        octaves = [math.log2(self.widths[0] / grid.width) for grid in self._grids for _ in grid.points]
        return tuple(WeightPrior(0, 1, octave) for octave in 2 * octaves)

    def columns(self, x: Tensor, y: Tensor) -> Tensor:
        """See `FieldModes`."""
        out = []
        for grid in self._grids:
            (across, _), (down, _) = (_gaussians(z, grid) for z in (x, y))
            units = across[..., :, None, :] * down[..., None, :, :]
            out.append(units.flatten(-3, -2)[..., grid.points.to(x.device), :])
        return vector_columns(torch.cat(out, -2).movedim(-2, 0))

    def field(self, weights: Tensor, x: Tensor, y: Tensor, slopes: bool = True) -> tuple[Tensor, ...]:
        """See `FieldModes`."""
        both = weights.unflatten(-1, (2, -1))
        parts: list[list[Tensor]] = []
        counts = [len(grid.points) for grid in self._grids]
        for grid, own in zip(self._grids, both.split(counts, -1), strict=True):
            (across, across_slope), (down, down_slope) = (_gaussians(z, grid) for z in (x, y))
            n = len(grid.places)
            # (2, rows, columns), so that one product serves both components.
            filled = torch.cat([own, torch.zeros_like(own[..., :1])], -1)[..., grid.number.to(own.device)]
            matrix = filled.unflatten(-1, (n, n)).transpose(-1, -2).flatten(-3, -2)
            along = (matrix @ across).unflatten(-2, (2, n))
            part = [(along * down[..., None, :, :]).sum(-2)]
            if slopes:
                turned = (matrix @ across_slope).unflatten(-2, (2, n))
                part += [(turned * down[..., None, :, :]).sum(-2), (along * down_slope[..., None, :, :]).sum(-2)]
            parts.append(part)
        value, *rates = (torch.stack(terms).sum(0) for terms in zip(*parts, strict=True))
        if not slopes:
            return value.unbind(-2)
        (f_x, g_x), (f_y, g_y) = (rate.unbind(-2) for rate in rates)
        return (*value.unbind(-2), f_x, f_y, g_x, g_y)


def _gaussians(z: Tensor, grid: _Grid) -> tuple[Tensor, Tensor]:
    """e(z; c, l) of places (..., N) along one axis, (..., n, N), and the derivative by z."""
    # As a tensor: ONNX would write a plain number as float32.
    inverse = torch.tensor(1.0 / grid.width, dtype=z.dtype, device=z.device)
    t = (z[..., None, :] - grid.places.to(z)[:, None]) * inverse
    value = torch.exp(-0.5 * (t * t))
    return value, -t * value * inverse
