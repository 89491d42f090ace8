"""Residuals of the shared parameters alone: Gaussian priors, and barriers before folds and poles of a lens."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Hashable, Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS
from kcal.lens.tracing import plain_on_host

# d ln r_D / d ln r is 1 for a pinhole, 0 where a lens folds, and large before a pole. Between these bounds there is no
# cost; a fisheye lens at 80 degrees off the axis still has 0.15.
_LOWEST_SLOPE, _HIGHEST_SLOPE = 0.1, 8.0
# A coefficient of r^2j above this to the power j, with r in units of the radius, bends the lens within a fifth of the
# radius, where few corners are.
_SHARPEST = 30.0
# Radii at which the slope is checked: denser than a pole and a zero that nearly cancel.
_KNOTS = 96


class Term(Protocol):
    """Residuals of the camera's parameters and the board's warp, in pixels like all others."""

    def rows(self, values: Tensor) -> Tensor:
        """Derivatives and residuals.

        Args:
            values: (..., 5 + P + 2), the camera's parameters and the two numbers of the warp.

        Returns:
            (..., 5 + P + 2 + 1, Q): derivatives of Q residuals by each value; last the residuals, NaN where the
            values are not a lens. Q may be 0 where there is no cost.
        """
        ...

    @property
    def alike(self) -> Hashable:
        """Terms of different problems for which this is equal can be joined into one of a batch."""
        ...

    def joined(self, others: Sequence[Any], shape: tuple[int, ...]) -> Term:
        """The term of a batch of some shape whose elements have these terms, all alike."""
        ...

    def to(self, device: torch.device) -> Term:
        """The same on a device."""
        ...

    def select(self, elements: Tensor) -> Term:
        """The term of some elements (K,) of a batch."""
        ...


@dataclasses.dataclass(frozen=True)
class GaussianPrior:
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
        residual = (values[..., self.index] - self.mean) * self.weight
        return torch.cat([derivative.expand(*values.shape[:-1], -1, -1), residual[..., None, :]], -2)

    @property
    def alike(self) -> Hashable:
        """See `Term.alike`."""
        return "prior", tuple(self.index.tolist()), tuple(self.mean.tolist())

    def joined(self, others: Sequence[GaussianPrior], shape: tuple[int, ...]) -> GaussianPrior:
        """See `Term.joined`."""
        weight = torch.stack([other.weight for other in others])
        return dataclasses.replace(self, weight=weight.reshape(*shape, -1))

    def to(self, device: torch.device) -> GaussianPrior:
        """See `Term.to`."""
        return GaussianPrior(self.index.to(device), self.mean.to(device), self.weight.to(device))

    def select(self, elements: Tensor) -> GaussianPrior:
        """See `Term.select`."""
        return self if self.weight.ndim == 1 else dataclasses.replace(self, weight=self.weight[elements])


class FoldBarrier:
    """A smooth barrier before lenses whose radial term folds or meets a pole within a radius.

    With q = d ln r_D / d ln r the residuals are weight · ln(q₀ / q) below q₀, weight · ln(q / q₁) above q₁, and zero
    between. So lenses that are regular by a margin are not changed at all, and lenses beyond the barrier have no cost
    (NaN). The barrier is low and wide, because at a steep one a solver rejects half its steps and hardly converges.
    Further residuals limit coefficients so large that they shape the lens only next to its axis, where there are hardly
    any data: without them these diverge together with the focal length.

    Args:
        model: the lens model.
        radius: up to which the lens must be regular, on the plane of `kcal.lens.plane`; for a batch (B,).
        weight: pixels; a third of a corner's noise is enough; for a batch (B,).
    """

    def __init__(self, model: LensModel, radius: float | Tensor, weight: float | Tensor) -> None:
        offset = len(INTRINSICS)
        self._model = model
        self._top = [offset + i for i in model.numerator_index]
        self._bottom = [offset + i for i in model.denominator_index]
        self._radius = torch.as_tensor(radius, dtype=torch.float64)
        self._weight = torch.as_tensor(weight, dtype=torch.float64)[..., None]
        device = self._radius.device
        shares = torch.linspace(0.0, 1.0, _KNOTS + 1, dtype=torch.float64, device=device)[1:]
        s = (shares * self._radius[..., None]) ** 2
        highest = max(model.numerator, model.denominator)
        orders = torch.arange(1, highest + 1, dtype=torch.float64, device=device)[:, None]
        self._powers = s[..., None, :] ** orders
        self._sharpness = (self._radius[..., None] ** 2 / _SHARPEST) ** orders[:, 0]
        # s d/ds of the same.
        self._slopes = orders * self._powers

    @property
    def alike(self) -> Hashable:
        """See `Term.alike`."""
        return "fold barrier", self._model

    def joined(self, others: Sequence[FoldBarrier], shape: tuple[int, ...]) -> FoldBarrier:
        """See `Term.joined`."""
        radius = torch.stack([other._radius for other in others]).reshape(shape)
        return FoldBarrier(self._model, radius, torch.stack([other._weight[0] for other in others]).reshape(shape))

    def to(self, device: torch.device) -> FoldBarrier:
        """See `Term.to`."""
        return FoldBarrier(self._model, self._radius.to(device), self._weight[..., 0].to(device))

    def select(self, elements: Tensor) -> FoldBarrier:
        """See `Term.select`."""
        if self._radius.ndim == 0:
            return self
        return FoldBarrier(self._model, self._radius[elements], self._weight[elements, 0])

    def rows(self, values: Tensor) -> Tensor:
        """See `Term.rows`."""
        host = plain_on_host(values)
        if host and self._is_zero(values.numpy()):
            return values.new_zeros((*values.shape[:-1], values.shape[-1] + 1, 0))
        count, over = len(self._top), len(self._bottom)
        top, bottom = self._powers[..., :count, :], self._powers[..., :over, :]
        top_slopes, bottom_slopes = self._slopes[..., :count, :], self._slopes[..., :over, :]
        a, b = values[..., None, self._top], values[..., None, self._bottom]
        n, d = 1.0 + (a @ top)[..., 0, :], 1.0 + (b @ bottom)[..., 0, :]
        turn_n, turn_d = (a @ top_slopes)[..., 0, :] / n, (b @ bottom_slopes)[..., 0, :] / d
        q = 1.0 + 2.0 * (turn_n - turn_d)
        scale = torch.cat([self._sharpness[..., :count], self._sharpness[..., :over]], -1)
        sharp = torch.cat([a, b], -1)[..., 0, :] * scale
        lens = (n > 0) & (d > 0) & (q > 0)
        zero = (lens & (q >= _LOWEST_SLOPE) & (q <= _HIGHEST_SLOPE)).all() & (sharp.abs() <= 1.0).all()
        if not host and bool(zero):
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

    def _is_zero(self, values: npt.NDArray[np.float64]) -> bool:
        """Whether all residuals of all these lenses are zero, which is the usual case; NumPy finds out quickly."""
        count, over = len(self._top), len(self._bottom)
        powers, orders = self._powers.numpy(), np.arange(1, 1 + max(count, over))
        a, b = values[..., None, self._top], values[..., None, self._bottom]
        with np.errstate(all="ignore"):
            n, d = 1.0 + a @ powers[..., :count, :], 1.0 + b @ powers[..., :over, :]
            turn_n = ((a * orders[:count]) @ powers[..., :count, :]) / n
            q = 1.0 + 2.0 * (turn_n - ((b * orders[:over]) @ powers[..., :over, :]) / d)
            inside = (n > 0) & (d > 0) & (q >= _LOWEST_SLOPE) & (q <= _HIGHEST_SLOPE)
            sharpness = self._sharpness.numpy()[..., None, :]
            limited = np.abs(a) * sharpness[..., :count] <= 1.0, np.abs(b) * sharpness[..., :over] <= 1.0
        return bool(inside.all() and all(part.all() for part in limited))
