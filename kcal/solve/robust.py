"""Losses that grow more slowly than the square, so that a few wrong measurements cannot spoil a solution."""

from __future__ import annotations

import dataclasses
from typing import Literal

import torch
from torch import Tensor

from kcal.errors import InputError


@dataclasses.dataclass(frozen=True, kw_only=True)
class RobustLoss:
    """ρ(‖r‖²) in place of the squared length of a residual vector.

    With s = ‖r‖² and the scale c: Huber s up to c², then 2 c √s - c²; Cauchy c² ln(1 + s / c²); Tukey
    c² / 3 (1 - (1 - s / c²)³) up to c², then constant: residuals beyond have no influence at all, so the start must
    be near the solution. All equal s for small residuals. Every residual is multiplied by √ρ'(s) before a least-squares
    step, which has the gradient of the robust cost and its Hessian without the negative part (iteratively reweighted
    least squares; Triggs, McLauchlan, Hartley and Fitzgibbon 2000).

    Args:
        kind: "huber", "cauchy" or "tukey".
        scale: c, in the units of the residuals; about three times their noise.

    Example:
        >>> loss = RobustLoss(kind="huber", scale=1.0)
        >>> loss.value(torch.tensor([0.25, 4.0])).tolist(), loss.weight(torch.tensor([0.25, 4.0])).tolist()
        ([0.25, 3.0], [1.0, 0.5])
    """

    kind: Literal["huber", "cauchy", "tukey"] = "huber"
    scale: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in ("huber", "cauchy", "tukey"):
            raise InputError(f"robust loss: kind must be huber, cauchy or tukey, got {self.kind!r}")
        if not 0 < self.scale < float("inf"):
            raise InputError(f"robust loss: the scale must be positive, got {self.scale}")

    def value(self, squared: Tensor) -> Tensor:
        """ρ(s), elementwise and differentiable."""
        c2 = self.scale**2
        if self.kind == "huber":
            far = squared > c2
            return torch.where(far, 2.0 * self.scale * torch.where(far, squared, c2).sqrt() - c2, squared)
        if self.kind == "cauchy":
            return c2 * torch.log1p(squared / c2)
        kept = 1.0 - squared / c2
        # Not clamped, because NaN must stay NaN.
        return c2 / 3.0 * (1.0 - torch.where(kept < 0, 0.0, kept) ** 3)

    def weight(self, squared: Tensor) -> Tensor:
        """ρ'(s), elementwise and differentiable."""
        c2 = self.scale**2
        if self.kind == "huber":
            far = squared > c2
            return torch.where(far, self.scale * torch.where(far, squared, c2).rsqrt(), 1.0 + 0.0 * squared)
        if self.kind == "cauchy":
            return 1.0 / (1.0 + squared / c2)
        kept = 1.0 - squared / c2
        return torch.where(kept < 0, 0.0, kept) ** 2
