"""A field that is the last layer of a small network: position in, correction out (Eq. 11 and Fig. 8 of the paper).

    f = Σ_k w_k tanh(a_k x + b_k y + c_k),   likewise g with weights of its own

The hidden layer is fixed: random features (Rahimi and Recht 2007), or one trained beforehand. So the field is linear in
the weights of the last layer. They get Gaussian priors whose widths the evidence sets, as the weights of every field
do.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Self

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.field_modes import UnitModes, WeightPrior, vector_columns

# Random features: |(a, b)| from one to eight, uniform in its logarithm. At eight, tanh rises within a quarter radius.
_LOWEST, _OCTAVES = 1.0, 3.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class NetworkModes(UnitModes):
    """The features of a fixed hidden layer on the unit disc (`kcal.lens.field_modes.FieldModes`).

    The weights along x come first, then those along y. Their prior has one amplitude, and one decay per octave of the
    features' steepness |(a, b)|.

    Args:
        hidden: (a, b, c) of each feature.

    Attributes:
        names: "n3x" is the weight along x of feature 3.

    Raises:
        InputError: no feature, or one with numbers that are not finite or that does not depend on the place.

    Example:
        >>> modes = NetworkModes.random(40, seed=1)
        >>> len(modes), modes.names[0], modes.names[-1]
        (80, 'n0x', 'n39y')
        >>> modes == NetworkModes.random(40, seed=1)
        True
    """

    hidden: tuple[tuple[float, float, float], ...]

    # Computed once: compilers cannot trace lazily computed attributes.
    names: tuple[str, ...] = dataclasses.field(init=False, repr=False, compare=False)
    _layer: Tensor = dataclasses.field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        hidden = tuple((float(a), float(b), float(c)) for a, b, c in self.hidden)
        if not hidden or not all(math.isfinite(a + b + c) and math.hypot(a, b) > 1e-6 for a, b, c in hidden):
            raise InputError("network modes: at least one feature is needed, and each must depend on the place")
        object.__setattr__(self, "hidden", hidden)
        object.__setattr__(self, "names", tuple(f"n{k}{axis}" for axis in "xy" for k in range(len(hidden))))
        object.__setattr__(self, "_layer", torch.tensor(hidden, dtype=torch.float64))

    @classmethod
    def random(cls, count: int = 60, seed: int = 0) -> Self:
        """Draw features whose bends cross the disc in random directions."""
        draw = torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        steep = _LOWEST * torch.exp2(_OCTAVES * draw[:, 0])
        angle = 2.0 * math.pi * draw[:, 1]
        rows = torch.stack([steep * torch.cos(angle), steep * torch.sin(angle), steep * (2.0 * draw[:, 2] - 1.0)], 1)
        return cls(hidden=tuple((a, b, c) for a, b, c in rows.tolist()))

    @property
    def hyperprior(self) -> tuple[tuple[float, float, float], ...]:
        """See `FieldModes`: amplitude, and decay per octave."""
        return (math.log(1e-3), 2.0, math.inf), (math.log(1.0), 0.7, math.inf)

    @property
    def weight_priors(self) -> tuple[WeightPrior, ...]:
        """See `FieldModes`."""
        octaves = [math.log2(math.hypot(a, b) / _LOWEST) for a, b, _ in self.hidden]
        return tuple(WeightPrior(0, 1, octave) for octave in 2 * octaves)

    def _features(self, x: Tensor, y: Tensor) -> Tensor:
        """(..., K, N)."""
        a, b, c = (part[:, None] for part in self._layer.to(x).unbind(-1))
        return torch.tanh(a * x[..., None, :] + b * y[..., None, :] + c)

    def columns(self, x: Tensor, y: Tensor) -> Tensor:
        """See `FieldModes`."""
        return vector_columns(self._features(x, y).movedim(-2, 0))

    def field(self, weights: Tensor, x: Tensor, y: Tensor, slopes: bool = True) -> tuple[Tensor, ...]:
        """See `FieldModes`."""
        both, values = weights.unflatten(-1, (2, -1)), self._features(x, y)
        moved = (both @ values).unbind(-2)
        if not slopes:
            return moved
        bend = 1.0 - values * values
        a, b, _ = self._layer.to(x).unbind(-1)
        (f_x, g_x), (f_y, g_y) = (((both * slope) @ bend).unbind(-2) for slope in (a, b))
        return (*moved, f_x, f_y, g_x, g_y)
