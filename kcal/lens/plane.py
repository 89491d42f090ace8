"""Map points to the plane on which the lens terms act, the first stage of a camera, and back to rays.

A perspective lens works on x = X / Z, y = Y / Z, the plane z = 1. A fisheye works on the plane of angles: a point at
angle θ from the optical axis lies at distance θ from the origin, in the same direction as (X, Y),

    (x, y) = θ / ρ · (X, Y),  ρ = √(X² + Y²),  θ = atan2(ρ, Z)

so that points beside and behind the camera have a place too (Kannala and Brandt, 2006). For θ / ρ, the angle is halved
four times, tan(θ/2) = ρ / (R + Z) and tan(φ/2) = tan φ / (1 + √(1 + tan² φ)), and a series does the rest. This is
exact to rounding, smooth on the axis, and uses only operations that every runtime has in float64.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.lens.model import LensModel

_HALVINGS = 4
# Series of arctan t / t in t², for t up to tan(180° / 16) = 0.199.
_ARCTAN = [(-1.0) ** n / (2 * n + 1) for n in range(12)]
# Where ρ² / Z² or θ² is below this, the series below are exact to rounding.
_SERIES_LIMIT = 0.01
# 2 d/dt of the series of arctan: the derivative of θ / ρ by ρ, near the axis.
_ARCTAN_SLOPE = [(-1.0) ** n * 2 * n / (2 * n + 1) for n in range(1, 10)]
_SINC = [(-1.0) ** n / math.factorial(2 * n + 1) for n in range(7)]
_COS = [(-1.0) ** n / math.factorial(2 * n) for n in range(7)]


def largest_radius(model: LensModel) -> float:
    """Largest distance of a point from the origin of the plane: tan 89°, or 179° in radians for a fisheye."""
    return math.radians(179.0) if model.fisheye else math.tan(math.radians(89.0))


def _series(coefficients: list[float], t: Tensor) -> Tensor:
    # As a tensor: ONNX would write plain numbers as float32.
    *rest, value = torch.tensor(coefficients, dtype=t.dtype, device=t.device).unbind()
    for coefficient in reversed(rest):
        value = torch.addcmul(coefficient, value, t)
    return value


def _angle_over_distance(X: Tensor, Y: Tensor, Z: Tensor) -> Tensor:
    """θ / ρ."""
    square = X * X + Y * Y
    # tan(angle) / ρ of the half angle, the quarter, ...
    ratio = (torch.sqrt(square + Z * Z) + Z).reciprocal()
    for _ in range(_HALVINGS - 1):
        ratio = ratio / (1.0 + torch.sqrt(1.0 + square * ratio * ratio))
    return 2.0**_HALVINGS * ratio * _series(_ARCTAN, square * ratio * ratio)


def plane_from_points(X: Tensor, Y: Tensor, Z: Tensor, model: LensModel) -> tuple[Tensor, Tensor]:
    """Map points of the camera frame to (x, y) on the plane of `model`; every tensor is (..., N).

    Perspective points must lie in front of the camera; fisheye points must not lie on the axis behind it.

    Example:
        >>> X, Y, Z = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 2.0]], dtype=torch.float64).T
        >>> plane_from_points(X, Y, Z, LensModel(fisheye=True))[0].tolist()  # 90° to the right, and straight ahead
        [1.5707963267948966, 0.0]
    """
    if not model.fisheye:
        inverse = Z.reciprocal()
        return X * inverse, Y * inverse
    ratio = _angle_over_distance(X, Y, Z)
    return ratio * X, ratio * Y


def plane_with_slopes(X: Tensor, Y: Tensor, Z: Tensor, model: LensModel) -> tuple[Tensor, ...]:
    """As `plane_from_points`, with the derivatives: x, y, ∂x/∂X, ∂x/∂Y = ∂y/∂X, ∂y/∂Y, ∂x/∂Z, ∂y/∂Z."""
    if not model.fisheye:
        inverse = Z.reciprocal()
        x, y = X * inverse, Y * inverse
        return x, y, inverse, torch.zeros_like(x), inverse, -x * inverse, -y * inverse
    ratio = _angle_over_distance(X, Y, Z)
    square = X * X + Y * Y
    by_distance = (square + Z * Z).reciprocal()
    # h is the derivative of θ / ρ by ρ, divided by ρ; near the axis the difference would cancel.
    near = (square < _SERIES_LIMIT * Z * Z) & (Z > 0)
    depth = torch.where(near, Z, 1.0)
    series = _series(_ARCTAN_SLOPE, torch.where(near, square / (depth * depth), 0.0)) / (depth * depth * depth)
    h = torch.where(near, series, (Z * by_distance - ratio) / torch.where(near, 1.0, square))
    cross = X * Y * h
    return (
        ratio * X, ratio * Y, ratio + X * X * h, cross, ratio + Y * Y * h, -X * by_distance, -Y * by_distance,
    )  # fmt: skip


def rays_from_plane(x: Tensor, y: Tensor, model: LensModel) -> tuple[Tensor, Tensor, Tensor]:
    """Map points (x, y) of the plane to the three components of a ray of length one; every tensor is (..., N).

    Example:
        >>> x, y = torch.tensor([[0.75, 0.0]], dtype=torch.float64).T
        >>> [round(float(c), 12) for c in rays_from_plane(x, y, LensModel())]
        [0.6, 0.0, 0.8]
    """
    square = x * x + y * y
    if not model.fisheye:
        z = torch.sqrt(1.0 + square).reciprocal()
        return x * z, y * z, z
    near = square < _SERIES_LIMIT
    t = torch.where(near, square, 0.0)
    angle = torch.sqrt(torch.where(near, 1.0, square))
    sinc = torch.where(near, _series(_SINC, t), torch.sin(angle) / angle)
    return x * sinc, y * sinc, torch.where(near, _series(_COS, t), torch.cos(angle))
