"""The base projections: image radius by angle off the axis, with one shape number from pinhole to fisheye and beyond.

    m(θ; s) = tan(√s θ) / √s,   for s < 0: tanh(√-s θ) / √-s

in focal lengths. s = 1 is the pinhole, 1/4 the stereographic and 0 the equidistant projection. m' = 1 + s m². All that
is needed are ratios that are smooth on the axis, written in q = s θ² or in u = s m²:

    T(q) = m / θ,   A(u) = θ / m,   G(u) = (A(u) (1 + u) - 1) / (2 u),   ∂m/∂s = m³ G(u)
"""

from __future__ import annotations

import torch
from torch import Tensor

# Where |q| or |u| is below this, the series are exact to rounding and the closed forms cancel.
_SMALL = 0.02
_TAN = (1.0, 1 / 3, 2 / 15, 17 / 315, 62 / 2835, 1382 / 155925, 21844 / 6081075, 929569 / 638512875)
_ARCTAN = tuple((-1.0) ** k / (2 * k + 1) for k in range(9))
# (A(u)(1 + u) - 1) / (2 u) from A's series: coefficients of u^k are (a_k + a_(k+1)) / 2.
_GROWTH = tuple(0.5 * (_ARCTAN[k] + _ARCTAN[k + 1]) for k in range(8))
# The tangent grows without bound towards π/2: beyond this angle √s θ the projection is not used.
STEEPEST = 1.5


def _series(coefficients: tuple[float, ...], t: Tensor) -> Tensor:
    # As a tensor: ONNX would write plain numbers as float32.
    *rest, value = torch.tensor(coefficients, dtype=t.dtype, device=t.device).unbind()
    for coefficient in reversed(rest):
        value = torch.addcmul(coefficient, value, t)
    return value


def radius_over_angle(q: Tensor) -> Tensor:
    """T(q) = m / θ for q = s θ²; the tangent is held at its value at `STEEPEST`."""
    slow = q.abs() < _SMALL
    root = torch.sqrt(torch.where(slow, 1.0, q).abs())
    closed = torch.where(q > 0, torch.tan(root.clamp(max=STEEPEST)), torch.tanh(root)) / root
    return torch.where(slow, _series(_TAN, torch.where(slow, q, 0.0)), closed)


def angle_over_radius(u: Tensor) -> Tensor:
    """A(u) = θ / m for u = s m²; NaN for u ≤ -1, where no angle has that radius."""
    slow = u.abs() < _SMALL
    root = torch.sqrt(torch.where(slow, 1.0, u).abs())
    closed = torch.where(u > 0, torch.atan(root), torch.atanh(torch.where(u < 0, root, 0.0))) / root
    return torch.where(slow, _series(_ARCTAN, torch.where(slow, u, 0.0)), closed)


def growth_by_shape(u: Tensor) -> tuple[Tensor, Tensor]:
    """G(u) and its derivative: how the radius grows with the shape, ∂m/∂s = m³ G(s m²)."""
    slow = u.abs() < _SMALL
    near, far = torch.where(slow, u, 0.0), torch.where(slow, 1.0, u)
    ratio = angle_over_radius(far)
    value = (ratio * (1.0 + far) - 1.0) / (2.0 * far)
    slope = (0.5 * ratio - 1.5 * value) / far
    by_u = tuple(k * c for k, c in enumerate(_GROWTH))[1:]
    return torch.where(slow, _series(_GROWTH, near), value), torch.where(slow, _series(by_u, near), slope)
