"""Residuals of the shared parameters alone: Gaussian priors, and barriers before folds and poles of a lens."""

from __future__ import annotations

import dataclasses
import math
from abc import ABC, abstractmethod

import torch
from torch import Tensor

from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS

# d ln r_D / d ln r is 1 for a pinhole, 0 where a lens folds, and large before a pole. Between these bounds there is no
# cost; a fisheye lens at 80 degrees off the axis still has 0.15.
_LOWEST_SLOPE, _HIGHEST_SLOPE = 0.1, 8.0
# A coefficient of r^2j above this to the power j, with r in units of the radius, bends the lens within a fifth of the
# radius, where few corners are.
_SHARPEST = 30.0
# Radii at which the slope is checked: denser than a pole and a zero that nearly cancel.
_KNOTS = 96


class Term(ABC):
    """Residuals of the camera's parameters and the board's amplitudes, in pixels like all others.

    Example:
        >>> class NearlySquare(Term):  # fx and fy differ by some 2 px; corners have 0.1 px of noise
        ...     def rows(self, values):
        ...         rows = values.new_zeros(*values.shape[:-1], values.shape[-1] + 1, 1)
        ...         rows[..., 0, 0], rows[..., 1, 0] = 0.1 / 2, -0.1 / 2
        ...         rows[..., -1, 0] = (values[..., 0] - values[..., 1]) * 0.1 / 2
        ...         return rows
        >>> round(float(NearlySquare().cost(torch.tensor([802.0, 800.0, 320.0, 240.0, 0.0]))), 6)  # ½ 0.1²
        0.005
    """

    @abstractmethod
    def rows(self, values: Tensor) -> Tensor:
        """Derivatives and residuals.

        Args:
            values: (..., 5 + P + B), the camera's parameters and the amplitudes of the board's modes.

        Returns:
            (..., 5 + P + B + 1, Q): derivatives of Q residuals by each value; last the residuals, NaN where the
            values are not a lens. Q may be 0 where there is no cost.
        """

    def cost(self, values: Tensor) -> Tensor:
        """(...) half the sum of squared residuals."""
        return 0.5 * self.rows(values)[..., -1, :].square().sum(-1)

    def add_to(self, total: Tensor, values: Tensor, slots: Tensor) -> None:
        """Add products of the rows to those of a problem.

        Args:
            total: (..., S + 1, S + 1) of derivatives by S unknowns, and residuals; changed in place.
            values: see `rows`.
            slots: (5 + P + B,) the number of each value's unknown; -1 where it is held.
        """
        rows, free = self.rows(values), (slots >= 0).nonzero()[:, 0]
        if rows.shape[-1]:
            by_unknown = rows.new_zeros(*total.shape[:-1], rows.shape[-1])
            by_unknown.index_add_(-2, slots[free], rows[..., free, :])
            by_unknown[..., -1, :] = rows[..., -1, :]
            total += by_unknown @ by_unknown.transpose(-1, -2)


@dataclasses.dataclass(frozen=True)
class GaussianPrior(Term):
    """A Gaussian prior on some values: residuals (value - mean) · weight.

    Args:
        index: which values, (Q,).
        mean: (Q,).
        weight: (Q,), or (B, Q) of a batch: noise of a corner (pixels) over the standard deviation of the prior.
    """

    index: Tensor
    mean: Tensor
    weight: Tensor

    def rows(self, values: Tensor) -> Tensor:
        """See `Term.rows`."""
        derivative = values.new_zeros((*self.weight.shape[:-1], values.shape[-1], len(self.index)))
        derivative[..., self.index, torch.arange(len(self.index), device=values.device)] = self.weight
        residual = self._residual(values)
        return torch.cat([derivative.expand(*values.shape[:-1], -1, -1), residual[..., None, :]], -2)

    def _residual(self, values: Tensor) -> Tensor:
        return (values[..., self.index] - self.mean) * self.weight

    def cost(self, values: Tensor) -> Tensor:
        """See `Term.cost`."""
        return 0.5 * self._residual(values).square().sum(-1)

    def add_to(self, total: Tensor, values: Tensor, slots: Tensor) -> None:
        """See `Term.add_to`; without the rows, of which there may be hundreds."""
        residual, place = self._residual(values), slots[self.index]
        free = (place >= 0).nonzero()[:, 0]
        place, weight = place[free], self.weight[..., free].expand(*total.shape[:-2], -1)
        gradient = weight * residual[..., free]
        total.diagonal(dim1=-2, dim2=-1).index_add_(-1, place, weight.square())
        total[..., -1].index_add_(-1, place, gradient)
        total[..., -1, :].index_add_(-1, place, gradient)
        total[..., -1, -1] += residual.square().sum(-1)


class FoldBarrier(Term):
    """A smooth barrier before lenses whose radial term folds or meets a pole within a radius.

    With q = d ln r_D / d ln r the residuals are weight · ln(q₀ / q) below q₀, weight · ln(q / q₁) above q₁, and zero
    between. So lenses that are regular by a margin are not changed at all, and lenses beyond the barrier have no cost
    (NaN). The barrier is low and wide, because at a steep one a solver rejects half its steps and hardly converges.
    Further residuals limit coefficients so large that they shape the lens only next to its axis, where there are hardly
    any data: without them these diverge together with the focal length.

    Args:
        model: the lens model.
        radius: up to which the lens must be regular, on the plane of `kcal.lens.plane`.
        weight: pixels; a third of a corner's noise is enough.
    """

    def __init__(self, model: LensModel, radius: float, weight: float) -> None:
        offset = len(INTRINSICS)
        self._top = [offset + i for i in model.numerator_index]
        self._bottom = [offset + i for i in model.denominator_index]
        self._weight = weight
        s = (torch.linspace(0.0, 1.0, _KNOTS + 1, dtype=torch.float64)[1:] * radius) ** 2
        orders = torch.arange(1, 1 + max(model.numerator, model.denominator), dtype=torch.float64)[:, None]
        self._powers = s**orders
        self._sharpness = (radius**2 / _SHARPEST) ** orders[:, 0]
        # s d/ds of the same.
        self._slopes = orders * self._powers

    def rows(self, values: Tensor) -> Tensor:
        """See `Term.rows`."""
        count, over = len(self._top), len(self._bottom)
        top, bottom = self._powers[:count], self._powers[:over]
        top_slopes, bottom_slopes = self._slopes[:count], self._slopes[:over]
        a, b = values[..., self._top], values[..., self._bottom]
        n, d = 1.0 + a @ top, 1.0 + b @ bottom
        turn_n, turn_d = (a @ top_slopes) / n, (b @ bottom_slopes) / d
        q = 1.0 + 2.0 * (turn_n - turn_d)
        scale = torch.cat([self._sharpness[:count], self._sharpness[:over]])
        sharp = torch.cat([a, b], -1) * scale
        lens = (n > 0) & (d > 0) & (q > 0)
        if bool((lens & (q >= _LOWEST_SLOPE) & (q <= _HIGHEST_SLOPE)).all() & (sharp.abs() <= 1.0).all()):
            return values.new_zeros((*values.shape[:-1], values.shape[-1] + 1, 0))
        low = q < 1.0
        excess = torch.where(low, math.log(_LOWEST_SLOPE) - torch.log(q), torch.log(q) - math.log(_HIGHEST_SLOPE))
        barrier = torch.where(lens, self._weight * excess.clamp_min(0.0), torch.nan)
        rate = torch.where(excess > 0, 2.0 * self._weight / q, 0.0) * torch.where(low, -1.0, 1.0)
        radial = [*self._top, *self._bottom]
        out = values.new_zeros((*values.shape[:-1], values.shape[-1] + 1, _KNOTS + len(radial)))
        by_top = (rate / n)[..., None, :] * (top_slopes - turn_n[..., None, :] * top)
        by_bottom = -(rate / d)[..., None, :] * (bottom_slopes - turn_d[..., None, :] * bottom)
        out[..., radial, :_KNOTS] = torch.cat([by_top, by_bottom], -2)
        beyond = (sharp.abs() - 1.0).clamp_min(0.0)
        slope = self._weight * torch.where(beyond > 0, scale * torch.sign(sharp), 0.0)
        out[..., radial, list(range(_KNOTS, _KNOTS + len(radial)))] = slope
        out[..., -1, :_KNOTS] = barrier
        out[..., -1, _KNOTS:] = self._weight * beyond
        return out
