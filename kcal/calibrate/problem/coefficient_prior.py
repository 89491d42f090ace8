"""A weak Gaussian prior that keeps lens coefficients small unless the data ask for more."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import torch

from kcal.calibrate.problem.priors import GaussianPrior
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS, parameter_names

# Radius from which on coefficients are of order one for any lens: 45 degrees off the axis.
_FARTHEST = 1.0
# Decentering, prism and tilt are errors of assembly: with a width of 0.3 and corners out to 36 degrees, 0.8 degrees.
_ASSEMBLY = 1.0 / 30.0


@dataclasses.dataclass(frozen=True)
class CoefficientPrior:
    """Each coefficient's standard deviation lets its term shift the outermost corner by a share of its radius.

    Args:
        width: that share for radial terms, numerator and denominator alike; a thirtieth of it for decentering, prism
            and tilt.
        reach: radius of the outermost corner on the plane of `kcal.lens.plane`.
    """

    width: float
    reach: float

    def term(self, model: LensModel, noise: float, without: Collection[str] = ()) -> GaussianPrior:
        """The prior with mean zero as residuals, in proportion to corners with `noise` pixels.

        Example:
            >>> model = LensModel.named("opencv4")  # k1 k2 p1 p2
            >>> sigma = 1.0 / CoefficientPrior(0.3, 0.5).term(model, noise=1.0).weight
            >>> [round(float(value), 6) for value in sigma]
            [1.2, 4.8, 0.02, 0.02]
        """
        r, names = min(self.reach, _FARTHEST), parameter_names(model)
        shift: dict[int, float] = {}
        for orders in (model.numerator_index, model.denominator_index):
            shift |= {i: r ** (2 * j + 2) for j, i in enumerate(orders)}
        for orders in model.prism_index if model.prism else ():
            shift |= {i: r ** (2 * j + 1) / _ASSEMBLY for j, i in enumerate(orders)}
        # Tangential and tilt terms grow with the square of the radius.
        shift |= {i: r / _ASSEMBLY for i in range(model.size) if i not in shift}
        offset = len(INTRINSICS)
        index = [offset + i for i in sorted(shift) if names[offset + i] not in without]
        weight = torch.tensor([noise * shift[i - offset] / self.width for i in index], dtype=torch.float64)
        return GaussianPrior(torch.tensor(index, dtype=torch.long), torch.zeros_like(weight), weight)


def is_overparameterized(model: LensModel) -> bool:
    """Whether a lens model has coefficients that are nearly redundant."""
    return model.denominator > 0 or model.prism > 0 or model.tilt
