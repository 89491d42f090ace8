"""Project points to pixels by the chain pupil, plane, lens, intrinsics, with its closed-form Jacobian."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.dispatch import is_differentiated, is_traced, known_true, may_overwrite
from kcal.lens.model import LensModel, angle_over_radius, as_columns, distort_components, radius_over_angle, series
from kcal.lens.zernike import unbind_last

# Map points to the plane on which the lens terms act, the first stage of a camera, and back to rays.
#
# A perspective lens works on x = X / Z, y = Y / Z, the plane z = 1. A fisheye works on the plane of angles: a point at
# angle θ from the optical axis lies at distance θ from the origin, in the same direction as (X, Y),
#
#     (x, y) = θ / ρ · (X, Y),  ρ = √(X² + Y²),  θ = atan2(ρ, Z)
#
# so that points beside and behind the camera have a place too (Kannala and Brandt, 2006). For θ / ρ, the angle is
# halved four times, tan(θ/2) = ρ / (R + Z) and tan(φ/2) = tan φ / (1 + √(1 + tan² φ)), and a series does the rest. This
# is exact to rounding, smooth on the axis, and uses only operations that every runtime has in float64. Where nothing is
# differentiated or exported, atan2 takes a third of the operations.
#
# A hybrid lens works on the plane of its base projection, where that point lies at the distance
# m(θ). Its points are those of the camera frame minus the start of their rays.

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
    return _angle_over_root(X * X + Y * Y, Z)


def _angle_over_root(square: Tensor, Z: Tensor) -> Tensor:
    """θ / ρ of points at the depth Z, by ρ²."""
    if not (is_traced() or is_differentiated(square, Z)):
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


# Find where on the optical axis the ray to a point starts: the entrance pupil of the hybrid lens.
#
# Seen from the front, the entrance pupil of a real lens moves along the axis with the angle. The ray at the angle θ
# starts at (0, 0, d) with
#
#     d = ζ₁ θ² + ζ₂ θ⁴,   θ = atan2(ρ, Z - d),   ρ = √(X² + Y²)
#
# in meters: such a camera is not central (Gennery 2006; mrcal's tour of noncentral projection). θ is the angle of the
# ray itself, so that all points of a ray have the same pixel. The equation is solved by Newton's method, which takes
# one step from d = 0 for points at long range and two at 1 m. For points at infinity the pupil has no effect.
#
# Behind a flat port (`HybridForm.port`) rays start on the port's normal a = (p, q, 1) / |(p, q, 1)| instead of the
# optical axis, at a d with d = ζ₁ θ² + ζ₂ θ⁴ + ζ₃ θ⁶, where θ is the angle to a and ρ the distance from it: light that
# a plane refracts stays in the plane of its direction and the normal, so that all rays meet the normal through the lens
# (Treibitz et al., "Flat refractive geometry", 2012).

# Meters at which a point is as good as infinitely far: an entrance pupil has no effect there. Scaling by a power of two
# rounds nothing.
FAR = 2.0**40
# Newton's steps at most, and where all points take the same number. Points at long range need one, those at 1 m two,
# and those at some five times the movement of the pupil all.
_STEPS = 5
# A step below this, relative to the distance, leaves an error of rounding: errors are squared at each step.
_LAST_STEP = 1e-6


class Pupil(NamedTuple):
    """Where rays start, and what its derivatives need; every tensor is (..., N).

    Attributes:
        depth: d, meters.
        found: whether the equation is solved. For points about as close as the pupil moves it has no unique solution.
        square: θ² of the ray.
        rate: derivative of ζ₁ θ² + ζ₂ θ⁴ by d, divided by ρ².
        gain: 1 / (1 - rate ρ²), the derivative of the solution by a shift of the right side.
        meter: what a meter measures in the units of the points.
        axis: on which rays start, and the distance along it of the points, (4, ..., N); None: the optical axis.
    """

    depth: Tensor
    found: Tensor
    square: Tensor
    rate: Tensor
    gain: Tensor
    meter: Tensor | float
    axis: tuple[Tensor, ...] | None = None

    def moved(self, X: Tensor, Y: Tensor, Z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Points less the start of their rays."""
        if self.axis is None:
            return X, Y, Z - self.depth
        a, b, c, _ = self.axis
        return X - self.depth * a, Y - self.depth * b, Z - self.depth * c

    def along(self, by_point: Tensor) -> Tensor:
        """(..., 2, N) derivatives along the axis, of those by points (..., 3, 2, N)."""
        if self.axis is None:
            return by_point[..., 2, :, :]
        return sum(by_point[..., i, :, :] * each[..., None, :] for i, each in enumerate(self.axis[:3]))  # type: ignore[return-value]

    def by_point(self, X: Tensor, Y: Tensor, Z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Derivatives of the depth by X, Y and Z of the point."""
        slope = self.rate * self.gain
        if self.axis is None:
            rise = slope * (Z - self.depth)
            return rise * X, rise * Y, -slope * (X * X + Y * Y)
        a, b, c, ahead = self.axis
        rise, turn = slope * (ahead - self.depth), self._by_turn(X, Y, Z)
        return rise * X + turn * a, rise * Y + turn * b, rise * Z + turn * c

    def _by_turn(self, X: Tensor, Y: Tensor, Z: Tensor) -> Tensor:
        """Derivative of the depth by the distance along the axis, of points that stay as far away."""
        assert self.axis is not None
        whole = X * X + Y * Y + Z * Z
        return -self.rate * self.gain * (whole - self.axis[3] * self.depth)

    def by_coefficients(self, X: Tensor, Y: Tensor, Z: Tensor, by_point: Tensor) -> list[Tensor]:
        """(..., 2, N) derivatives of pixels by ζ₁, ζ₂, and where there is a port by ζ₃, p, q.

        `by_point` (..., 3, 2, N) has those by the moved points.
        """
        along, rates = self.along(by_point), [self.meter * self.gain * self.square]
        for _ in range(1 if self.axis is None else 2):
            rates.append(rates[-1] * self.square)
        columns = [-along * rate[..., None, :] for rate in rates]
        if self.axis is not None:
            *axis, ahead = self.axis
            turn = self._by_turn(X, Y, Z)
            for i, value in enumerate((X, Y)):
                # The axis turns by (e - a aᵢ) c for p or q.
                depth, share = turn * (value - ahead * axis[i]), self.depth * axis[i]
                moved = self.depth[..., None, :] * by_point[..., i, :, :] + (depth - share)[..., None, :] * along
                columns.append(-axis[2][..., None, :] * moved)
        return columns

    def by_meter(self, coefficients: Tensor) -> Tensor:
        """Derivative of the depth by what a meter measures, of points that stay as they are."""
        return self.gain * pupil_depth(self.square, coefficients, self.axis is not None)


def pupil_depth(square: Tensor, coefficients: Tensor, port: bool = False) -> Tensor:
    """D of rays with given θ² (..., N), for a hybrid lens (..., P)."""
    return _depth_and_slope(square, coefficients, port)[0]


def _depth_and_slope(square: Tensor, coefficients: Tensor, port: bool) -> tuple[Tensor, Tensor]:
    """D, and its derivative by θ²."""
    if not port:
        first, second = unbind_last(coefficients[..., 1:3])
        return (first + second * square) * square, first + 2.0 * second * square
    first, second, third = unbind_last(coefficients[..., 1:4])
    slope = first + (2.0 * second + 3.0 * third * square) * square
    return (first + (second + third * square) * square) * square, slope


_About = tuple[Tensor, Tensor, tuple[Tensor, ...] | None]


def about_axis(X: Tensor, Y: Tensor, Z: Tensor, coefficients: Tensor, port: bool) -> _About:
    """ρ² of points (..., N) and their distance along the axis, and `Pupil.axis`, for a hybrid lens (..., P)."""
    if not port:
        return X * X + Y * Y, Z, None
    p, q = unbind_last(coefficients[..., 4:6])
    c = torch.rsqrt(1.0 + p * p + q * q)
    a, b = p * c, q * c
    ahead = a * X + b * Y + c * Z
    across = (X - ahead * a).square() + (Y - ahead * b).square() + (Z - ahead * c).square()
    return across, ahead, torch.broadcast_tensors(a, b, c, ahead)


def ray_starts(
    X: Tensor, Y: Tensor, Z: Tensor, coefficients: Tensor, meter: Tensor | float = 1.0, *, port: bool = False
) -> Pupil:
    """Find where the rays to points start, for a hybrid lens (..., P): depth and found, (..., N), and on which axis.

    Points and depth are in units of which a meter is `meter` (..., N). At infinity that is 0, and the pupil stays.

    Two of Newton's steps are in the autograd graph; at a solution these have its exact first and second derivatives.
    """
    about = about_axis(X, Y, Z, coefficients, port)
    with torch.no_grad():
        depth = torch.zeros_like(about[1])
        for _ in range(_STEPS):
            wanted, pupil = _pupil_at(about, coefficients, depth, meter)
            step = (wanted - depth) * pupil.gain
            depth = depth + step
            found = pupil.found & (step * step <= _LAST_STEP**2 * (X * X + Y * Y + Z * Z))
            if known_true(found):
                break
    if is_differentiated(X, Y, Z, coefficients, meter if isinstance(meter, Tensor) else None):
        for _ in range(2):
            wanted, pupil = _pupil_at(about, coefficients, depth, meter)
            depth = depth + (wanted - depth) * pupil.gain
    return pupil._replace(depth=depth, found=found)


def ray_origins(rays: Tensor, coefficients: Tensor, port: bool) -> Tensor:
    """Where rays (..., N, 3) of any length start, (..., N, 3), for a hybrid lens (..., P)."""
    X, Y, Z = rays.unbind(-1)
    across, ahead, axis = about_axis(X, Y, Z, coefficients, port)
    ratio = _angle_over_root(across, ahead)
    depth = pupil_depth(ratio * ratio * across, coefficients, port)
    zero = torch.zeros_like(depth)
    return torch.stack([zero, zero, depth] if axis is None else [depth * each for each in axis[:3]], -1)


def entrance_pupil(
    X: Tensor, Y: Tensor, Z: Tensor, coefficients: Tensor, meter: Tensor | float = 1.0, *, port: bool = False
) -> Pupil:
    """As `ray_starts`, with what closed-form derivatives need."""
    found = ray_starts(X, Y, Z, coefficients, meter, port=port)
    about = about_axis(X, Y, Z, coefficients, port)
    return _pupil_at(about, coefficients, found.depth, meter)[1]._replace(found=found.found)


def _pupil_at(about: _About, coefficients: Tensor, depth: Tensor, meter: Tensor | float) -> tuple[Tensor, Pupil]:
    """The right side of the equation for a ray that starts at `depth`, to points of `about_axis`."""
    across, ahead, axis = about
    below = ahead - depth
    ratio = _angle_over_root(across, below)
    square = ratio * ratio * across
    value, slope = _depth_and_slope(square, coefficients, axis is not None)
    # θ² grows by 2 θ ρ / R² with d.
    rate = 2.0 * meter * slope * ratio / (across + below * below)
    gain = (1.0 - rate * across).reciprocal()
    return meter * value, Pupil(depth, gain > 0, square, rate, gain, meter, axis)


# Project points to pixels by the chain pinhole, lens, intrinsics, with its closed-form Jacobian.
#
# Camera parameters are one vector (..., 5 + P): fx, fy, cx, cy, skew, then the lens coefficients:
#
#     x = X / Z, y = Y / Z;  (x_D, y_D) = distortion(x, y);  u = fx x_D + skew y_D + cx,  v = fy y_D + cy
#
# (Eq. 1 to 4 of the paper). Skew is γ of Eq. 3; `cv2.fisheye` stores it as alpha = skew / fx. Fisheyes and hybrid
# lenses replace the first step, and rays of hybrid lenses start at their entrance pupil.

INTRINSICS = ("fx", "fy", "cx", "cy", "skew")


def parameter_names(model: LensModel) -> tuple[str, ...]:
    """Names of the camera parameters in storage order."""
    return (*INTRINSICS, *model.names)


class Projection(NamedTuple):
    """Pixels and their derivatives; the last two dimensions of each are (2, N): all u, then all v.

    Attributes:
        pixels: (..., 2, N).
        by_point: (..., 3, 2, N), by X, Y, Z of the point in the camera frame.
        by_camera: (..., C, 2, N), by the wanted camera parameters.
        regular: (..., N), in front of the camera (for a fisheye: anywhere), before any pole, and not folded
            (det J > 0).
        by_meter: (..., 2, N), by `meter`; None for a lens without a moving pupil.
        plane: (..., 2, N) places on which the terms of a hybrid lens act; None for other lenses.
    """

    pixels: Tensor
    by_point: Tensor
    by_camera: Tensor
    regular: Tensor
    by_meter: Tensor | None = None
    plane: Tensor | None = None

    def of(self, chosen: slice) -> Projection:
        """The same of some along the first dimension, which all have."""
        return Projection(*(None if each is None else each[chosen] for each in self))  # type: ignore[arg-type]


def to_pixels(x: Tensor, y: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
    """Map distorted coordinates (..., N) to pixels: the last stage."""
    fx, fy, cx, cy, skew = unbind_last(parameters[..., : len(INTRINSICS)])
    return torch.addcmul(torch.addcmul(cx, skew, y), fx, x), torch.addcmul(cy, fy, y)


def from_pixels(u: Tensor, v: Tensor, parameters: Tensor) -> tuple[Tensor, Tensor]:
    """The inverse of `to_pixels`."""
    fx, fy, cx, cy, skew = unbind_last(parameters[..., : len(INTRINSICS)])
    y = (v - cy) / fy
    return (u - cx - skew * y) / fx, y


def project_components(
    points: Tensor,
    parameters: Tensor,
    model: LensModel,
    wanted: Sequence[int] | None = None,
    meter: Tensor | float = 1.0,
) -> Projection:
    """Project points given as (..., 3, N), with derivatives by the point and the wanted camera parameters.

    Args:
        points: (..., 3, N) in the camera frame, meters, or in units of which a meter is `meter`.
        parameters: (..., 5 + P), broadcast against the leading shape of `points`.
        model: the lens model.
        wanted: indices of the camera parameters of `by_camera`; None: no derivatives, `by_point` and `by_camera` are
            empty.
        meter: (..., N) of homogeneous points, which are a point times its inverse distance: that inverse distance.
            Only an entrance pupil that moves depends on it.
    """
    X, Y, Z = points[..., 0, :], points[..., 1, :], points[..., 2, :]
    offset = len(INTRINSICS)
    pupil, moved = None, (X, Y, Z)
    if model.hybrid:
        pupil = entrance_pupil(X, Y, Z, parameters[..., offset:], meter, port=model.hybrid.port)
        moved = pupil.moved(X, Y, Z)
    x, y, x_X, x_Y, y_Y, x_Z, y_Z = plane_with_slopes(*moved, model)
    plane = torch.stack([x, y], -2) if model.hybrid and wanted is not None else None
    lens_wanted = [i - offset for i in wanted or () if i >= offset]
    lens = distort_components(x, y, parameters[..., offset:], model, lens_wanted)
    fx, fy, _, _, skew = unbind_last(parameters[..., :offset])
    regular = lens.positive & (lens.determinant > 0)
    if pupil:
        regular = regular & pupil.found
    pixels = torch.stack(to_pixels(lens.x, lens.y, parameters), -2)
    if not model.wide:
        regular = regular & (Z > 0)  # Such a lens has no pupil.
    empty = pixels.new_zeros((*pixels.shape[:-2], 0, *pixels.shape[-2:]))
    if wanted is None:
        return Projection(pixels, empty, empty, regular)

    a, b, d, e = lens.point
    ux, uy, vx, vy = fx * a + skew * d, fx * b + skew * e, fy * d, fy * e
    if model.wide:
        columns = [
            ux * x_X + uy * x_Y, vx * x_X + vy * x_Y, ux * x_Y + uy * y_Y, vx * x_Y + vy * y_Y,
            ux * x_Z + uy * y_Z, vx * x_Z + vy * y_Z,
        ]  # fmt: skip
    else:
        ux, uy, vx, vy = ux * x_X, uy * x_X, vx * x_X, vy * x_X
        columns = [ux, vx, uy, vy, -(ux * x + uy * y), -(vx * x + vy * y)]
    by_point = torch.stack(torch.broadcast_tensors(*columns), -2).unflatten(-2, (3, 2))

    by_meter, by_moved = None, by_point
    if pupil:
        by_depth = pupil.along(by_moved)
        by_meter = -by_depth * pupil.by_meter(parameters[..., offset:])[..., None, :]
        rise = torch.stack(torch.broadcast_tensors(*pupil.by_point(X, Y, Z)), -2)[..., None, :]
        by_point = by_moved - by_depth[..., None, :, :] * rise
    if not wanted:
        return Projection(pixels, by_point, empty, regular, by_meter, plane)

    zero, one = torch.zeros_like(lens.x), torch.ones_like(lens.x)
    intrinsic = [(lens.x, zero), (zero, lens.y), (one, zero), (zero, one), (lens.y, zero)]
    across, along, down = (value[..., None] if value.ndim else value for value in (fx, skew, fy))
    if may_overwrite(skew) and not bool(skew.any()):
        # In one pass, because there may be hundreds of columns.
        focal = torch.stack([across, down], -2) if across.ndim else torch.stack([across, down])[:, None]
        by_lens = lens.coefficients * focal
    else:
        du, dv = lens.coefficients.unbind(-2)
        by_lens = torch.stack([torch.addcmul(across * du, along, dv), down * dv], -2)
    # In the order of `wanted`: intrinsics come first as a rule.
    first = as_columns([intrinsic[i] for i in wanted if i < offset], pixels[..., 0, :])
    whole = pixels.shape[:-2]
    by_camera = torch.cat([part.expand(*whole, -1, -1, -1) for part in (first, by_lens)], -3)
    order = sorted(range(len(wanted)), key=lambda k: wanted[k] >= offset)
    if order != list(range(len(wanted))):
        by_camera = by_camera[..., [order.index(k) for k in range(len(wanted))], :, :]
    if pupil:
        for place, column in enumerate(pupil.by_coefficients(X, Y, Z, by_moved), offset + 1):
            if place in wanted:
                by_camera[..., list(wanted).index(place), :, :] = column
    return Projection(pixels, by_point, by_camera, regular, by_meter, plane)
