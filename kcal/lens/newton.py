"""Newton's method in two unknowns, for the inverse of a lens: one step, and when to stop."""

from __future__ import annotations

import torch
from torch import Tensor

# Residual on the plane of the lens that counts as solved: 1e-13 is 2e-10 px at f = 2000 px, just above rounding.
TOLERANCE = 1e-13

# ∂x/∂x, ∂x/∂y, ∂y/∂x, ∂y/∂y of a map of the plane, or their counterparts of its inverse; each (..., N).
Jacobian = tuple[Tensor, ...]


def inverse_jacobian(jacobian: Jacobian) -> Jacobian:
    """Invert 2x2 matrices."""
    a, b, d, e = jacobian
    scale = torch.addcmul(a * e, b, d, value=-1.0).reciprocal()
    opposite = -scale
    return e * scale, b * opposite, d * opposite, a * scale


def newton_step(x: Tensor, y: Tensor, error_x: Tensor, error_y: Tensor, inverse: Jacobian) -> tuple[Tensor, Tensor]:
    """Move x, y (..., N) by the inverse Jacobian times the error, in fused operations."""
    a, b, d, e = inverse
    return (
        torch.addcmul(torch.addcmul(x, b, error_y, value=-1.0), a, error_x, value=-1.0),
        torch.addcmul(torch.addcmul(y, d, error_x, value=-1.0), e, error_y, value=-1.0),
    )


def squared_tolerance(goal_x: Tensor, goal_y: Tensor) -> Tensor:
    """Largest squared residual (..., N) of a solution, relative to 1 + |goal|²."""
    return torch.addcmul(torch.addcmul(goal_x.new_ones(()), goal_x, goal_x), goal_y, goal_y) * TOLERANCE**2


def is_solved(error_x: Tensor, error_y: Tensor, goal_x: Tensor, goal_y: Tensor) -> Tensor:
    """Whether residuals (..., N) are zero to rounding; False for NaN."""
    return torch.addcmul(error_x * error_x, error_y, error_y) <= squared_tolerance(goal_x, goal_y)
