"""What the field of a hybrid lens is made of: features with weights, whose prior widths the evidence of the views sets.

Three kinds exist: `kcal.lens.zernike.ZernikeModes`, the default, `kcal.lens.gaussian_modes.GaussianModes` and
`kcal.lens.network_modes.NetworkModes`. All can be compared and hashed. They are constants of a fit, which finds the
weights; only the inside of a network may be trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor


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
