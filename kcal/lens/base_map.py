"""Map angles to image radii by the base projection of the hybrid lens: one formula from pinhole to fisheye and beyond.

A ray at the angle θ from the optical axis is seen at the distance m from the principal point, in focal lengths:

    m(θ; s) = tan(√s θ) / √s,   for s < 0: tanh(√-s θ) / √-s

The shape s is 1 for the pinhole, 1/4 for the stereographic and 0 for the equidistant projection (m = θ). The derivative
by θ is 1 + s m². The functions of this module are ratios that are smooth on the axis, in q = s θ² or u = s m²:

    T(q) = m / θ,   A(u) = θ / m,   G(u) = (A(u) (1 + u) - 1) / (2 u),   ∂m/∂s = m³ G(u)
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.dispatch import is_traced

# Where |q| or |u| is below this, the series are exact to rounding and the closed forms cancel.
_SMALL = 0.02
_TAN = (1.0, 1 / 3, 2 / 15, 17 / 315, 62 / 2835, 1382 / 155925, 21844 / 6081075, 929569 / 638512875)
_ARCTAN = tuple((-1.0) ** k / (2 * k + 1) for k in range(11))
# (A(u) (1 + u) - 1) / (2 u) from the series of A: the coefficient of u^k is (a_k + a_(k+1)) / 2.
_GROWTH = tuple(0.5 * (_ARCTAN[k] + _ARCTAN[k + 1]) for k in range(10))
# arctan x / x by powers of x², for x up to tan(90° / 8) = 0.199.
_ARCTAN_FAR = tuple((-1.0) ** k / (2 * k + 1) for k in range(12))
# Largest angle √|s| θ: the tangent grows without bound towards π/2, and tanh is almost flat beyond 3.
_STEEPEST, _FLATTEST = 1.5, 3.0
_WIDEST = math.radians(179.0)


def series(coefficients: Sequence[float], t: Tensor) -> Tensor:
    """Evaluate a polynomial with the coefficients of t⁰, t¹, ..."""
    # As a tensor: ONNX would write plain numbers as float32.
    *rest, value = torch.tensor(coefficients, dtype=t.dtype, device=t.device).unbind()
    for coefficient in reversed(rest):
        value = torch.addcmul(coefficient, value, t)
    return value


def largest_base_radius(shape: float) -> float:
    """Largest m that the projection is used for: that of 179°, or of 86° / √s where the tangent becomes too steep.

    Example:
        >>> round(largest_base_radius(0.0), 3), round(largest_base_radius(1.0), 3)
        (3.124, 13.808)
    """
    root = math.sqrt(abs(shape))
    # A little less than where `radius_over_angle` holds the tangent.
    limit = 0.999 * _STEEPEST if shape > 0 else _FLATTEST
    angle = min(_WIDEST, limit / root) if root else _WIDEST
    return float(radius_over_angle(torch.tensor(shape * angle * angle, dtype=torch.float64))) * angle


def radius_over_angle(q: Tensor) -> Tensor:
    """T(q) = m / θ for q = s θ²; the tangent is held beyond an angle √s θ of 86°."""
    slow = q.abs() < _SMALL
    root = torch.sqrt(torch.where(slow, 1.0, q).abs())
    closed = torch.where(q > 0, _tangent(root.clamp(max=_STEEPEST)), torch.tanh(root)) / root
    return torch.where(slow, series(_TAN, torch.where(slow, q, 0.0)), closed)


def angle_over_radius(u: Tensor) -> Tensor:
    """A(u) = θ / m for u = s m²; NaN for u ≤ -1, where no angle has that radius."""
    slow = u.abs() < _SMALL
    return torch.where(slow, series(_ARCTAN, torch.where(slow, u, 0.0)), _far(torch.where(slow, 1.0, u)))


def _far(u: Tensor) -> Tensor:
    """A(u) of u that are not small."""
    root = torch.sqrt(u.abs())
    return torch.where(u > 0, _arctangent(root), _artanh(torch.where(u < 0, root, 0.0))) / root


def growth_by_shape(u: Tensor) -> tuple[Tensor, Tensor]:
    """G(u) and its derivative: how the radius grows with the shape, ∂m/∂s = m³ G(s m²)."""
    slow = u.abs() < _SMALL
    near, far = torch.where(slow, u, 0.0), torch.where(slow, 1.0, u)
    ratio = _far(far)
    value = (ratio * (1.0 + far) - 1.0) / (2.0 * far)
    slope = (0.5 * ratio - 1.5 * value) / far
    by_u = tuple(k * c for k, c in enumerate(_GROWTH))[1:]
    return torch.where(slow, series(_GROWTH, near), value), torch.where(slow, series(by_u, near), slope)


# ONNX runtimes have none of these functions in float64.


def _tangent(x: Tensor) -> Tensor:
    return torch.sin(x) / torch.cos(x)


def _arctangent(x: Tensor) -> Tensor:
    """Halve the angle three times, then add the series: exact to rounding."""
    if not is_traced():
        return torch.atan(x)
    for _ in range(3):
        x = x / (1.0 + torch.sqrt(1.0 + x * x))
    return 8.0 * x * series(_ARCTAN_FAR, x * x)


def _artanh(x: Tensor) -> Tensor:
    return 0.5 * torch.log((1.0 + x) / (1.0 - x))
