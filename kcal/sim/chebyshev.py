"""Tabulate smooth functions of a pixel as sums of Chebyshev polynomials, exact to rounding, with derivatives."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from kcal.sim.rectangle import PixelRectangle


def nodes(degree: int) -> Tensor:
    """(degree + 1,) Chebyshev points of the first kind on [-1, 1]."""
    return torch.cos(math.pi * (torch.arange(degree + 1, dtype=torch.float64) + 0.5) / (degree + 1))


@dataclass(frozen=True, eq=False)
class ChebyshevTable:
    """K functions on a rectangle of pixels; see `tabulate`.

    Args:
        window: the rectangle.
        coefficients: (degree + 1, K, degree + 1), of x and of y.
    """

    window: PixelRectangle
    coefficients: Tensor

    def values(self, pixels: Tensor) -> Tensor:
        """Return the values (N, K) at pixels (N, 2)."""
        across, down = (self._basis(pixels, axis)[0] for axis in (0, 1))
        return self._sum(across, down)

    def with_slopes(self, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return values (N, K), and their derivatives by x and by y, per pixel."""
        (across, across_slope), (down, down_slope) = (self._basis(pixels, axis) for axis in (0, 1))
        left, left_slope = (basis @ self.coefficients.flatten(1) for basis in (across, across_slope))
        left, left_slope = (value.unflatten(-1, self.coefficients.shape[1:]) for value in (left, left_slope))
        sums = [
            (part @ basis[..., None])[..., 0] for part, basis in ((left, down), (left_slope, down), (left, down_slope))
        ]
        return sums[0], sums[1], sums[2]

    def _sum(self, across: Tensor, down: Tensor) -> Tensor:
        left = (across @ self.coefficients.flatten(1)).unflatten(-1, self.coefficients.shape[1:])
        return (left @ down[..., None])[..., 0]

    def _basis(self, pixels: Tensor, axis: int) -> tuple[Tensor, Tensor]:
        """Chebyshev polynomials (N, degree + 1) along an axis, and their derivatives per pixel."""
        start, extent = (self.window.left, self.window.width) if axis == 0 else (self.window.top, self.window.height)
        half = 0.5 * (extent - 1)
        t = (pixels[:, axis] - start) / half - 1
        degree = len(self.coefficients) - 1
        values, slopes = [torch.ones_like(t), t], [torch.zeros_like(t), torch.ones_like(t)]
        for _ in range(degree - 1):
            values.append(2 * t * values[-1] - values[-2])
            slopes.append(2 * values[-2] + 2 * t * slopes[-1] - slopes[-2])
        return torch.stack(values[: degree + 1], -1), torch.stack(slopes[: degree + 1], -1) / half


def tabulate(function: Callable[[Tensor], Tensor], window: PixelRectangle, degree: int) -> ChebyshevTable:
    """Interpolate a function of pixels, (N, 2) to (N, K), over a window at Chebyshev points.

    Example:
        >>> table = tabulate(lambda pixels: torch.exp(pixels / 100), PixelRectangle(-10, -10, 120, 80), 12)
        >>> [round(value, 9) for value in table.values(torch.tensor([[50.0, 20.0]]).double())[0].tolist()]
        [1.648721271, 1.221402758]
    """
    t = nodes(degree)
    x = window.left + 0.5 * (window.width - 1) * (t + 1)
    y = window.top + 0.5 * (window.height - 1) * (t + 1)
    grid = torch.stack(torch.meshgrid(x, y, indexing="ij"), -1)
    sampled = function(grid.reshape(-1, 2)).unflatten(0, grid.shape[:2])
    order = torch.arange(degree + 1, dtype=torch.float64)
    # The discrete cosine transform: T_j at node i is cos(j θ_i).
    angles = math.pi * (order + 0.5) / (degree + 1)
    transform = torch.cos(order[:, None] * angles) * (2.0 / (degree + 1))
    transform[0] *= 0.5
    coefficients = torch.einsum("ai,ijk,bj->akb", transform, sampled, transform)
    return ChebyshevTable(window, coefficients.contiguous())
