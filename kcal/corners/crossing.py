"""Two blurred edges that cross: the grey levels of four squares round a corner, and their derivatives.

A step edge blurred by a Gaussian is an error function of the distance from the edge. Two crossing edges blurred
together are E[sign(X₁) sign(X₂)] for two normal variables whose correlation is the cosine between the edges' normals:
the product of two error functions where they are perpendicular, plus Mehler's series in that correlation
(F. G. Mehler 1866; M. G. Kendall, "Proof of relations connected with the tetrachoric series", Biometrika 1941) where
they are not, as on a tilted board.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

NAMES = ("dx", "dy", "angle1", "angle2", "log_blur", "mean", "contrast", "ramp_x", "ramp_y", "bow")
_ORDER = 5  # of the series: what is left out is below 0.1 % of the contrast for edges 50° apart


def crossing(parameters: Tensor, where: Tensor, bend: Tensor) -> tuple[Tensor, Tensor]:
    """Grey levels of crossing edges and their Jacobian.

    Args:
        parameters: (..., 10): the centre (dx, dy) in pixels, the directions of both edges in radians, the logarithm of
            the blur's sigma in pixels, mean grey level, half the contrast (its sign says which squares are light),
            a ramp of illumination in grey levels a pixel, and by how much edges are lighter than the mean (a camera's
            tone curve bends the profile of a blurred edge).
        where: (..., K, 2) pixels at which the grey levels are wanted.
        bend: (..., 2) curvature of each edge, 1 / pixels, positive towards its normal (direction + 90°, x to y).

    Returns:
        levels (..., K) and their derivatives (..., 10, K).

    Example:
        >>> p = torch.tensor([0.0, 0.0, 0.0, math.pi / 2, 0.0, 128.0, 80.0, 0.0, 0.0, 0.0]).double()
        >>> where = torch.tensor([[0.0, 0.0], [5.0, 5.0], [-5.0, 5.0]]).double()
        >>> levels, _ = crossing(p, where, torch.zeros(2).double())
        >>> levels.round().tolist()
        [128.0, 48.0, 208.0]
    """
    dx, dy, angle1, angle2, log_blur, mean, contrast, ramp_x, ramp_y, bow = (
        value[..., None] for value in parameters.unbind(-1)
    )
    px, py = where.unbind(-1)
    x, y = px - dx, py - dy
    blur = log_blur.exp()
    scaled, by_x, by_y, by_angle = [], [], [], []
    for i, angle in enumerate((angle1, angle2)):
        curve = bend[..., i, None]
        cos, sin = angle.cos(), angle.sin()
        along, across = cos * x + sin * y, cos * y - sin * x
        scaled.append((across - 0.5 * curve * along**2) / blur)
        by_x.append((sin + curve * along * cos) / blur)
        by_y.append((-cos + curve * along * sin) / blur)
        by_angle.append(-along * (1.0 + curve * across) / blur)
    a, b = scaled
    rho = torch.cos(angle1 - angle2)
    sign, by_a, by_b, by_rho = _signs(a, b, rho)
    by_rho = by_rho * torch.sin(angle1 - angle2)
    slope = contrast - 2.0 * bow * sign
    by_a, by_b, by_rho = slope * by_a, slope * by_b, slope * by_rho
    edge = 1.0 - sign * sign
    one = torch.ones_like(sign)
    jacobian = torch.stack(
        [
            by_a * by_x[0] + by_b * by_x[1],
            by_a * by_y[0] + by_b * by_y[1],
            by_a * by_angle[0] - by_rho,
            by_b * by_angle[1] + by_rho,
            -by_a * a - by_b * b,
            one,
            sign,
            px * one,
            py * one,
            edge,
        ],
        -2,
    )
    return mean + contrast * sign + ramp_x * px + ramp_y * py + bow * edge, jacobian


def _signs(a: Tensor, b: Tensor, rho: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """E[sign(a + u) sign(b + v)] for standard normal u, v with correlation rho, and its derivatives by a, b, rho."""
    density_a, density_b = _density(a), _density(b)
    even_a, even_b = torch.erf(a * math.sqrt(0.5)), torch.erf(b * math.sqrt(0.5))
    # Density times Hermite polynomials of degree 0 to _ORDER; the derivative of one is minus the next.
    hermite_a, hermite_b = _hermite(a, density_a), _hermite(b, density_b)
    value = even_a * even_b
    by_a, by_b = 2.0 * density_a * even_b, 2.0 * density_b * even_a
    by_rho = torch.zeros_like(value)
    power = torch.full_like(rho, 4.0)
    for k in range(_ORDER):
        both = hermite_a[k] * hermite_b[k]
        by_rho = by_rho + power * both
        power = power * rho / (k + 1)
        value = value + power * both
        by_a = by_a - power * hermite_a[k + 1] * hermite_b[k]
        by_b = by_b - power * hermite_a[k] * hermite_b[k + 1]
    return value, by_a, by_b, by_rho


def _density(a: Tensor) -> Tensor:
    return torch.exp(-0.5 * a * a) * (1.0 / math.sqrt(2.0 * math.pi))


def _hermite(a: Tensor, density: Tensor) -> list[Tensor]:
    values = [density, a * density]
    for k in range(1, _ORDER):
        values.append(a * values[k] - k * values[k - 1])
    return values
