"""Compute the distortion of Eq. 4 and Eq. 10, for any orders, with closed-form derivatives.

Convention: `normalized` points are (x, y) on the plane z = 1 of the camera, y down. The terms apply in this order:

    s = x² + y²,  g = (1 + k1 s + k2 s² + ...) / (1 + k4 s + k5 s² + ...)
    x_I = g x + 2 p1 x y + p2 (s + 2 x²) + s1 s + s2 s² + ...
    y_I = g y + p1 (s + 2 y²) + 2 p2 x y + s3 s + s4 s² + ...
    x_D = cos τx x_I / w,  y_D = (cos τy y_I - sin τx sin τy x_I) / w,
    w = sin τy x_I - cos τy sin τx y_I + cos τy cos τx

The last two lines are OpenCV's tilted-sensor homography multiplied out. Sources: the paper's Eq. 4 and 10; OpenCV's
camera-calibration documentation for the tilt. A fisheye uses g alone, on points whose distance from the origin is the
angle from the axis (`kcal.lens.projection`): the model of Kannala and Brandt (2006) in the form of `cv2.fisheye`.

Coordinates are separate tensors (..., N), because these loops are bound by memory and so touch each number once.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.hybrid_terms import hybrid_terms
from kcal.lens.model import LensModel
from kcal.lens.zernike import unbind_last


class Distorted(NamedTuple):
    """Distorted coordinates with what validity and derivatives need; tensors are (..., N).

    `coefficients` (..., K, 2, N) are the derivatives of x and y by the K coefficients that were asked for. `point` is
    the Jacobian ∂x/∂x, ∂x/∂y, ∂y/∂x, ∂y/∂y, or () if it was not asked for. `positive` is true before any pole: where
    both the radial denominator and the tilt's w are positive.
    """

    x: Tensor
    y: Tensor
    point: tuple[Tensor, ...]
    coefficients: Tensor
    positive: Tensor

    @property
    def determinant(self) -> Tensor:
        """Determinant of the Jacobian: positive before the lens folds."""
        a, b, d, e = self.point
        return torch.addcmul(a * e, b, d, value=-1.0)


def polynomial(s: Tensor, coefficients: Sequence[Tensor], constant: float, slopes: bool) -> tuple[Tensor, Tensor]:
    """Evaluate constant + c1 s + c2 s² + ... by Horner's rule; its derivative by s is zero unless asked for."""
    if not coefficients:
        return torch.full_like(s, constant), torch.zeros_like(s)
    value, *rest = reversed(coefficients)
    slope = torch.zeros_like(value)
    for coefficient in rest:
        if slopes:
            slope = torch.addcmul(value, slope, s)
        value = torch.addcmul(coefficient, value, s)
    # value is (p - constant) / s here.
    return constant + value * s, torch.addcmul(value, slope, s) if slopes else slope


def distort_components(
    x: Tensor,
    y: Tensor,
    coefficients: Tensor,
    model: LensModel,
    wanted: Sequence[int] = (),
    *,
    slopes: bool = True,
) -> Distorted:
    """Distort separate coordinates x, y (..., N), with the derivatives that are asked for.

    Args:
        x: (..., N) coordinates on the plane z = 1; for a fisheye, on the plane of angles.
        y: (..., N).
        coefficients: (..., P) in the order of `model.names`, broadcast against the leading shape of x.
        model: the lens model.
        wanted: indices of the coefficients by which `Distorted.coefficients` are derivatives, in that order.
        slopes: whether `Distorted.point` is needed; leaving it out saves a third of the work.
    """
    if model.hybrid:
        return Distorted(*hybrid_terms(x, y, coefficients, model.hybrid, wanted, slopes))
    c = unbind_last(coefficients)
    xx, xy, yy = x * x, x * y, y * y
    s = xx + yy

    g, g_slope = polynomial(s, [c[i] for i in model.numerator_index], 1.0, slopes)
    inverse, positive = torch.ones_like(s), torch.ones_like(s, dtype=torch.bool)
    if model.denominator:
        denominator, denominator_slope = polynomial(s, [c[i] for i in model.denominator_index], 1.0, slopes)
        inverse, positive = denominator.reciprocal(), denominator > 0
        g = g * inverse
        if slopes:
            g_slope = (g_slope - g * denominator_slope) * inverse
    u, v = g * x, g * y
    point: tuple[Tensor, ...] = ()
    if slopes:
        double = 2.0 * g_slope
        cross = double * xy
        point = (torch.addcmul(g, double, xx), cross, cross, torch.addcmul(g, double, yy))
    if model.prism:
        prism_x, prism_x_slope = polynomial(s, [c[i] for i in model.prism_index[0]], 0.0, slopes)
        prism_y, prism_y_slope = polynomial(s, [c[i] for i in model.prism_index[1]], 0.0, slopes)
        u, v = u + prism_x, v + prism_y
        if slopes:
            rates = ((prism_x_slope, x), (prism_x_slope, y), (prism_y_slope, x), (prism_y_slope, y))
            point = tuple(torch.addcmul(rate, r, z, value=2.0) for rate, (r, z) in zip(point, rates, strict=True))
    if model.tangential:
        p1, p2 = c[model.names.index("p1")], c[model.names.index("p2")]
        p1x, p1y, p2x, p2y = p1 * x, p1 * y, p2 * x, p2 * y
        # p1 s + 2 y (p1 y + p2 x) is p1 (s + 2 y²) + 2 p2 x y, and likewise for x.
        shear = 2.0 * (p1y + p2x)
        u = torch.addcmul(torch.addcmul(u, p2, s), x, shear)
        v = torch.addcmul(torch.addcmul(v, p1, s), y, shear)
        if slopes:
            a, b, d, e = point
            # By the product rule: shear + 2 p2 x + 2 p2 x and so on.
            turn = 2.0 * (p2y + p1x)
            a, e = torch.add(a + shear, p2x, alpha=4.0), torch.add(e + shear, p1y, alpha=4.0)
            point = (a, b + turn, d + turn, e)

    columns = _coefficient_columns(x, y, s, xx, xy, yy, g, inverse, model, wanted)
    if not model.tilt:
        return Distorted(u, v, point, as_columns([pair for pair in columns if pair is not None], u), positive)

    tau_x, tau_y = c[model.names.index("tau_x")], c[model.names.index("tau_y")]
    cos_x, sin_x, cos_y, sin_y = torch.cos(tau_x), torch.sin(tau_x), torch.cos(tau_y), torch.sin(tau_y)
    w = sin_y * u - (cos_y * sin_x) * v + cos_y * cos_x
    scale = w.reciprocal()
    x_tilted = cos_x * u * scale
    y_tilted = (cos_y * v - (sin_x * sin_y) * u) * scale
    if slopes:
        # The 2x2 Jacobian of the homography, times the one before it.
        m00, m01 = (cos_x - sin_y * x_tilted) * scale, (cos_y * sin_x) * x_tilted * scale
        m10, m11 = -sin_y * (sin_x + y_tilted) * scale, cos_y * (1.0 + sin_x * y_tilted) * scale
        a, b, d, e = point
        point = (m00 * a + m01 * d, m00 * b + m01 * e, m10 * a + m11 * d, m10 * b + m11 * e)
    by_angle = (
        {
            "tau_x": (-sin_x * u, -cos_x * sin_y * u, -cos_y * (cos_x * v + sin_x)),
            "tau_y": (torch.zeros_like(u), -sin_x * cos_y * u - sin_y * v, cos_y * u + sin_y * (sin_x * v - cos_x)),
        }
        if wanted
        else {}
    )
    tilted = []
    for index, pair in zip(wanted, columns, strict=True):
        if pair is None:
            x_rate, y_rate, w_rate = by_angle[model.names[index]]
            tilted.append(((x_rate - x_tilted * w_rate) * scale, (y_rate - y_tilted * w_rate) * scale))
        else:
            du, dv = pair
            tilted.append((m00 * du + m01 * dv, m10 * du + m11 * dv))
    return Distorted(x_tilted, y_tilted, point, as_columns(tilted, x_tilted), positive & (w > 0))


def as_columns(pairs: Sequence[tuple[Tensor, Tensor]], like: Tensor) -> Tensor:
    """Pairs of tensors that broadcast against (..., N) as one (..., K, 2, N)."""
    if not pairs:
        return like.new_zeros((*like.shape[:-1], 0, 2, like.shape[-1]))
    flat = torch.broadcast_tensors(*(part for pair in pairs for part in pair))
    return torch.stack(flat, -2).unflatten(-2, (len(pairs), 2))


def _coefficient_columns(
    x: Tensor,
    y: Tensor,
    s: Tensor,
    xx: Tensor,
    xy: Tensor,
    yy: Tensor,
    g: Tensor,
    inverse: Tensor,
    model: LensModel,
    wanted: Sequence[int],
) -> list[tuple[Tensor, Tensor] | None]:
    """Derivatives by the wanted coefficients, before the tilt; None stands for a tilt angle."""
    if not wanted:
        return []
    powers = [s]
    while len(powers) < max(model.numerator, model.denominator, model.prism):
        powers.append(powers[-1] * s)
    zero = torch.zeros_like(s)
    x_radial, y_radial = x * inverse, y * inverse
    table: dict[int, tuple[Tensor, Tensor]] = {}
    for j, i in enumerate(model.numerator_index):
        if i in wanted:
            table[i] = (x_radial * powers[j], y_radial * powers[j])
    for j, i in enumerate(model.denominator_index):
        if i in wanted:
            ratio = -g * powers[j]
            table[i] = (x_radial * ratio, y_radial * ratio)
    for j, i in enumerate(model.prism_index[0]):
        table[i] = (powers[j], zero)
    for j, i in enumerate(model.prism_index[1]):
        table[i] = (zero, powers[j])
    if model.tangential:
        table[model.names.index("p1")] = (2.0 * xy, s + 2.0 * yy)
        table[model.names.index("p2")] = (s + 2.0 * xx, 2.0 * xy)
    return [table.get(i) for i in wanted]


def check_coefficients(coefficients: Tensor, model: LensModel) -> Tensor:
    """Return the coefficients as float64 (..., P), after checking that P fits the model."""
    coefficients = torch.as_tensor(coefficients)
    if coefficients.ndim < 1 or coefficients.shape[-1] != model.size:
        raise InputError(
            f"coefficients: shape (..., {model.size}) is needed for {model}, got {tuple(coefficients.shape)}"
        )
    return coefficients.to(torch.float64)
