"""Map points to the plane on which the lens terms act, the first stage of a camera, and back to rays.

A perspective lens works on x = X / Z, y = Y / Z, the plane z = 1. A fisheye works on the plane of angles: a point at
angle θ from the optical axis lies at distance θ from the origin, in the same direction as (X, Y),

    (x, y) = θ / ρ · (X, Y),  ρ = √(X² + Y²),  θ = atan2(ρ, Z)

so that points beside and behind the camera have a place too (Kannala and Brandt, 2006). For θ / ρ, the angle is halved
four times, tan(θ/2) = ρ / (R + Z) and tan(φ/2) = tan φ / (1 + √(1 + tan² φ)), and a series does the rest. This is
exact to rounding, smooth on the axis, and uses only operations that every runtime has in float64. Where
nothing is differentiated or exported, atan2 takes a third of the operations.

A hybrid lens works on the plane of its base projection (`kcal.lens.base_map`), where that point lies at the distance
m(θ). Its points are those of the camera frame minus the start of their rays (`kcal.lens.pupil`).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.dispatch import is_differentiated, is_traced
from kcal.lens.base_map import angle_over_radius, radius_over_angle, series
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
    """Largest distance of a point from the origin of the plane; tan 89° for perspective lenses, 179° for a fisheye."""
    if model.hybrid:
        return model.hybrid.reach
    return math.radians(179.0) if model.fisheye else math.tan(math.radians(89.0))


def angle_over_distance(X: Tensor, Y: Tensor, Z: Tensor) -> Tensor:
    """θ / ρ of points (..., N); infinite or NaN on the axis behind the camera."""
    square = X * X + Y * Y
    if not (is_traced() or is_differentiated(X, Y, Z)):
        distance = torch.sqrt(square)
        return torch.where(distance > 0, torch.atan2(distance, Z) / distance, Z.clamp(min=0.0).reciprocal())
    # tan(angle) / ρ of the half angle, the quarter, ...
    ratio = (torch.sqrt(square + Z * Z) + Z).reciprocal()
    for _ in range(_HALVINGS - 1):
        ratio = ratio / (1.0 + torch.sqrt(1.0 + square * ratio * ratio))
    return 2.0**_HALVINGS * ratio * series(_ARCTAN, square * ratio * ratio)


def plane_from_points(X: Tensor, Y: Tensor, Z: Tensor, model: LensModel) -> tuple[Tensor, Tensor]:
    """Map points of the camera frame to (x, y) on the plane of `model`; every tensor is (..., N).

    Perspective points must lie in front of the camera; fisheye points must not lie on the axis behind it.

    Example:
        >>> X, Y, Z = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 2.0]], dtype=torch.float64).T
        >>> plane_from_points(X, Y, Z, LensModel(fisheye=True))[0].tolist()  # 90° to the right, and straight ahead
        [1.5707963267948966, 0.0]
    """
    if not model.wide:
        inverse = Z.reciprocal()
        return X * inverse, Y * inverse
    ratio = angle_over_distance(X, Y, Z)
    if model.hybrid:
        ratio = ratio * radius_over_angle(model.hybrid.constants(X)[0] * ratio * ratio * (X * X + Y * Y))
    return ratio * X, ratio * Y


def plane_with_slopes(X: Tensor, Y: Tensor, Z: Tensor, model: LensModel) -> tuple[Tensor, ...]:
    """As `plane_from_points`, with the derivatives: x, y, ∂x/∂X, ∂x/∂Y = ∂y/∂X, ∂y/∂Y, ∂x/∂Z, ∂y/∂Z."""
    if not model.wide:
        inverse = Z.reciprocal()
        x, y = X * inverse, Y * inverse
        return x, y, inverse, torch.zeros_like(x), inverse, -x * inverse, -y * inverse
    ratio = angle_over_distance(X, Y, Z)
    square = X * X + Y * Y
    by_distance = (square + Z * Z).reciprocal()
    if model.hybrid:
        return _base_with_slopes(X, Y, Z, ratio, square, by_distance, model.hybrid.constants(X)[0])
    # h is the derivative of θ / ρ by ρ, divided by ρ; near the axis the difference would cancel.
    near = (square < _SERIES_LIMIT * Z * Z) & (Z > 0)
    depth = torch.where(near, Z, 1.0)
    nearby = series(_ARCTAN_SLOPE, torch.where(near, square / (depth * depth), 0.0)) / (depth * depth * depth)
    h = torch.where(near, nearby, (Z * by_distance - ratio) / torch.where(near, 1.0, square))
    cross = X * Y * h
    return (
        ratio * X, ratio * Y, ratio + X * X * h, cross, ratio + Y * Y * h, -X * by_distance, -Y * by_distance,
    )  # fmt: skip


def _base_with_slopes(
    X: Tensor, Y: Tensor, Z: Tensor, ratio: Tensor, square: Tensor, by_distance: Tensor, shape: Tensor
) -> tuple[Tensor, ...]:
    ratio = ratio * radius_over_angle(shape * ratio * ratio * square)
    # Along the direction across the axis the slope is m' Z / R², beside it m / ρ; on the axis both are equal.
    rate = (1.0 + shape * ratio * ratio * square) * by_distance
    inverse = torch.where(square > 0, square, 1.0).reciprocal()
    xx, xy, yy = X * X * inverse, X * Y * inverse, Y * Y * inverse
    difference = torch.where(square > 0, rate * Z - ratio, 0.0)
    return (
        ratio * X, ratio * Y, ratio + difference * xx, difference * xy, ratio + difference * yy, -rate * X, -rate * Y,
    )  # fmt: skip


def rays_from_plane(x: Tensor, y: Tensor, model: LensModel) -> tuple[Tensor, Tensor, Tensor]:
    """Map points (x, y) of the plane to the three components of a ray of length one; every tensor is (..., N).

    Example:
        >>> x, y = torch.tensor([[0.75, 0.0]], dtype=torch.float64).T
        >>> [round(float(c), 12) for c in rays_from_plane(x, y, LensModel())]
        [0.6, 0.0, 0.8]
    """
    square = x * x + y * y
    if not model.wide:
        z = torch.sqrt(1.0 + square).reciprocal()
        return x * z, y * z, z
    if model.hybrid:
        stretch = angle_over_radius(model.hybrid.constants(x)[0] * square)
        x, y, square = x * stretch, y * stretch, square * stretch * stretch
    near = square < _SERIES_LIMIT
    t = torch.where(near, square, 0.0)
    angle = torch.sqrt(torch.where(near, 1.0, square))
    sinc = torch.where(near, series(_SINC, t), torch.sin(angle) / angle)
    return x * sinc, y * sinc, torch.where(near, series(_COS, t), torch.cos(angle))
