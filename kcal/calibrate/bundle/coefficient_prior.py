"""The weak knowledge that a lens is no wilder than it need be, as a Gaussian prior on its coefficients."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection

import torch

from kcal.calibrate.bundle.priors import Prior
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS, parameter_names

# Beyond 45 degrees coefficients are of order one whatever the lens.
_FARTHEST = 1.0
# Decentering, prism and tilt are faults of assembly: with a width of 0.3 and corners out to 36 degrees, 0.8 degrees.
_FAULT = 1.0 / 30.0


@dataclasses.dataclass(frozen=True)
class CoefficientPrior:
    """Each coefficient's standard deviation is such that its term shifts the outermost corner by a share of its radius.

    Args:
        width: that share for radial terms, numerator and denominator alike; a thirtieth of it for decentering, prism
            and tilt.
        reach: radius of the outermost corner on the plane of `kcal.lens.plane`.
    """

    width: float
    reach: float

    def prior(self, model: LensModel, noise: float, without: Collection[str] = ()) -> Prior:
        """As residuals beside corners of `noise` pixels; mean zero.

        Example:
            >>> model = LensModel.named("opencv4")  # k1 k2 p1 p2
            >>> sigma = 1.0 / CoefficientPrior(0.3, 0.5).prior(model, noise=1.0).weight
            >>> [round(float(value), 6) for value in sigma]
            [1.2, 4.8, 0.02, 0.02]
        """
        r, names = min(self.reach, _FARTHEST), parameter_names(model)
        shift: dict[int, float] = {}
        for orders in (model.numerator_index, model.denominator_index):
            shift |= {i: r ** (2 * j + 2) for j, i in enumerate(orders)}
        for orders in model.prism_index if model.prism else ():
            shift |= {i: r ** (2 * j + 1) / _FAULT for j, i in enumerate(orders)}
        # Tangential and tilt terms grow with the square of the radius.
        shift |= {i: r / _FAULT for i in range(model.size) if i not in shift}
        offset = len(INTRINSICS)
        index = [offset + i for i in sorted(shift) if names[offset + i] not in without]
        weight = torch.tensor([noise * shift[i - offset] / self.width for i in index], dtype=torch.float64)
        return Prior(torch.tensor(index, dtype=torch.long), torch.zeros_like(weight), weight)


def is_overparameterized(model: LensModel) -> bool:
    """Whether a lens model has coefficients that can do each other's work."""
    return model.denominator > 0 or model.prism > 0 or model.tilt
