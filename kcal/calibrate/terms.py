"""Least-squares terms on the shared parameters alone: bounds that keep folds and poles away, and Gaussian priors."""

from __future__ import annotations

import dataclasses
import math
from typing import Protocol

import torch
from torch import Tensor

from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS

# d ln r_D / d ln r is 1 for a pinhole, 0 where a lens folds and large before a pole. Between these bounds a lens costs
# nothing; a fisheye lens of 80 degrees off the axis still has 0.15.
_LOWEST_SLOPE, _HIGHEST_SLOPE = 0.1, 8.0
# A denominator or numerator whose coefficient of r^2j is above this to the power j, r in units of the radius, bends the
# lens within a fifth of the radius: nearer to the axis than corners can tell.
_SHARPEST = 30.0
# Radii at which the slope is looked at: closer together than a pole and a zero that all but cancel.
_KNOTS = 96


class Term(Protocol):
    """Residuals of the camera's parameters and the board's warp, in pixels like all others."""

    def rows(self, values: Tensor) -> Tensor:
        """Derivatives and residuals.

        Args:
            values: (..., 5 + P + 2), the camera's parameters and the two numbers of the warp.

        Returns:
            (..., 5 + P + 2 + 1, Q): derivatives of Q residuals by each value; last the residuals, NaN where there is
            no lens at all. Q may be 0 at values that no term minds.
        """
        ...


@dataclasses.dataclass(frozen=True)
class Prior:
    """Gaussian knowledge of some values: residuals (value - mean) · weight.

    Args:
        index: which values, (Q,).
        mean: (Q,).
        weight: (Q,) noise of a corner (pixels) over the prior's standard deviation.
    """

    index: Tensor
    mean: Tensor
    weight: Tensor

    def rows(self, values: Tensor) -> Tensor:
        """See `Term.rows`."""
        size = values.shape[-1]
        derivative = torch.zeros(size, len(self.index), dtype=values.dtype, device=values.device)
        derivative[self.index, torch.arange(len(self.index))] = self.weight
        residual = (values[..., self.index] - self.mean) * self.weight
        return torch.cat([derivative.expand(*values.shape[:-1], -1, -1), residual[..., None, :]], -2)


class RadialBound:
    """A smooth wall before a lens whose radial term folds or meets a pole within a radius.

    With q = d ln r_D / d ln r the residuals are weight · ln(q₀ / q) below q₀, weight · ln(q / q₁) above q₁, and zero
    between: lenses that are regular by a margin are not changed at all, and no lens beyond the wall has a cost. It is
    low and wide, because a solver that runs into a hard wall rejects half its steps and hardly converges. A second wall
    stands before coefficients so large that they only shape the lens next to its axis, where there is next to no data:
    these run away without it, and take the focal length with them.

    Args:
        model: the lens model.
        radius: up to which radius on the plane of `kcal.lens.plane` the lens must be regular.
        weight: pixels; a third of the noise of a corner does.
    """

    def __init__(self, model: LensModel, radius: float, weight: float) -> None:
        offset = len(INTRINSICS)
        self._top = [offset + i for i in model.numerator_index]
        self._bottom = [offset + i for i in model.denominator_index]
        self._weight = weight
        s = torch.linspace(0.0, radius, _KNOTS + 1, dtype=torch.float64)[1:] ** 2
        orders = torch.arange(1, max(model.numerator, model.denominator) + 1, dtype=torch.float64)[:, None]
        self._powers = s**orders
        self._sharpness = (radius**2 / _SHARPEST) ** orders[:, 0]
        # s d/ds of the same.
        self._slopes = orders * self._powers

    def rows(self, values: Tensor) -> Tensor:
        """See `Term.rows`."""
        top, bottom = self._powers[: len(self._top)], self._powers[: len(self._bottom)]
        top_slopes, bottom_slopes = self._slopes[: len(self._top)], self._slopes[: len(self._bottom)]
        a, b = values[..., self._top], values[..., self._bottom]
        n, d = 1.0 + a @ top, 1.0 + b @ bottom
        turn_n, turn_d = (a @ top_slopes) / n, (b @ bottom_slopes) / d
        q = 1.0 + 2.0 * (turn_n - turn_d)
        lens = (n > 0) & (d > 0) & (q > 0)
        low = q < 1.0
        sharp_a, sharp_b = a * self._sharpness[: len(self._top)], b * self._sharpness[: len(self._bottom)]
        sharp = torch.cat([sharp_a, sharp_b], -1)
        gentle = (lens & (q >= _LOWEST_SLOPE) & (q <= _HIGHEST_SLOPE)).all() & (sharp.abs() <= 1.0).all()
        if bool(gentle):
            return values.new_zeros((*values.shape[:-1], values.shape[-1] + 1, 0))
        excess = torch.where(low, math.log(_LOWEST_SLOPE) - torch.log(q), torch.log(q) - math.log(_HIGHEST_SLOPE))
        wall = torch.where(lens, self._weight * excess.clamp_min(0.0), torch.nan)
        rate = torch.where(excess > 0, 2.0 * self._weight / q, 0.0) * torch.where(low, -1.0, 1.0)
        radial = [*self._top, *self._bottom]
        out = values.new_zeros((*values.shape[:-1], values.shape[-1] + 1, _KNOTS + len(radial)))
        by_top, by_bottom = out[..., self._top, :], out[..., self._bottom, :]
        by_top[..., :_KNOTS] = (rate / n)[..., None, :] * (top_slopes - turn_n[..., None, :] * top)
        by_bottom[..., :_KNOTS] = -(rate / d)[..., None, :] * (bottom_slopes - turn_d[..., None, :] * bottom)
        out[..., self._top, :], out[..., self._bottom, :] = by_top, by_bottom
        beyond = (sharp.abs() - 1.0).clamp_min(0.0)
        scale = torch.cat([self._sharpness[: len(self._top)], self._sharpness[: len(self._bottom)]])
        slope = self._weight * torch.where(beyond > 0, scale * torch.sign(sharp), 0.0)
        out[..., radial, list(range(_KNOTS, _KNOTS + len(radial)))] = slope
        out[..., -1, :_KNOTS] = wall
        out[..., -1, _KNOTS:] = self._weight * beyond
        return out
