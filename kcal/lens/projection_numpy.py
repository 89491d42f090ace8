"""Compute the chain of `kcal.lens.projection` with all derivatives in NumPy, for calibration on the CPU.

Calibration evaluates this chain some thousand times on a few thousand corners, where starting an operation of torch
takes longer than the operation itself. NumPy starts one several times faster. Derivatives are written straight into the
rows of the normal equations, each column of a polynomial from the one before. Tests hold the values to those of
`project_components`, which is used where gradients or another device are needed.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS

Array = npt.NDArray[np.float64]
# A number, or an array that broadcasts against the points.
Value = Any


def fill_rows(
    points: Array, parameters: Array, model: LensModel, wanted: dict[int, int], by_point: Array, by_camera: Array
) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
    """Project points and write the derivatives.

    Args:
        points: (..., 3, N) in the camera frame.
        parameters: (5 + P,), or broadcast against the leading shape of `points` with one more dimension of length one.
        model: the lens model; not a fisheye.
        wanted: maps each wanted parameter to its row in `by_camera`.
        by_point: (..., 3, 2, N), receives the derivatives by the point.
        by_camera: (..., C, 2, N), receives the derivatives by the camera parameters.

    Returns:
        u, v (..., N), and a mask (..., N) as `Projection.regular`.
    """
    X, Y, Z = points[..., 0, :], points[..., 1, :], points[..., 2, :]
    inverse_depth = 1.0 / Z
    x, y = X * inverse_depth, Y * inverse_depth
    values: list[Value] = (
        parameters.tolist() if parameters.ndim == 1 else [parameters[..., i, None] for i in range(parameters.shape[-1])]
    )
    fx, fy, cx, cy, skew = values[: len(INTRINSICS)]
    c = values[len(INTRINSICS) :]
    rows = {i - len(INTRINSICS): by_camera[..., k, :, :] for i, k in wanted.items()}

    s = x * x + y * y
    g, g_slope = _polynomial(s, [c[i] for i in model.numerator_index], 1.0)
    positive = Z > 0
    inverse: Value = 1.0
    if model.denominator:
        below, below_slope = _polynomial(s, [c[i] for i in model.denominator_index], 1.0)
        inverse = 1.0 / below
        g = g * inverse
        g_slope = (g_slope - g * below_slope) * inverse
        positive &= below > 0
    u, v = g * x, g * y
    # Derivatives of u, v by x, y: rates along the point, and what is on the diagonal.
    turn_x, turn_y, diagonal = g_slope * x, g_slope * y, g
    if model.prism:
        prism_x, prism_x_slope = _polynomial(s, [c[i] for i in model.prism_index[0]], 0.0)
        prism_y, prism_y_slope = _polynomial(s, [c[i] for i in model.prism_index[1]], 0.0)
        u += prism_x
        v += prism_y
        turn_x += prism_x_slope
        turn_y += prism_y_slope
    if model.tangential:
        p1, p2 = c[model.names.index("p1")], c[model.names.index("p2")]
        along = 2.0 * (p2 * x + p1 * y)
        u += p2 * s + along * x
        v += p1 * s + along * y
        turn_x += p2
        turn_y += p1
        diagonal = diagonal + along
        a, b = diagonal + 2.0 * (turn_x + p2) * x, 2.0 * (turn_x * y + p1 * x)
        d, e = 2.0 * (turn_y * x + p2 * y), diagonal + 2.0 * (turn_y + p1) * y
    else:
        a, b = diagonal + 2.0 * turn_x * x, 2.0 * turn_x * y
        d, e = 2.0 * turn_y * x, diagonal + 2.0 * turn_y * y

    # a, b, d, e: x_I and y_I by x and y; m: the pixel by x_I and y_I.
    m00: Value = fx
    m01: Value = skew
    m10: Value = 0.0
    m11: Value = fy
    x_out, y_out = u, v
    if model.tilt:
        x_out, y_out, (m00, m01, m10, m11), ahead = _tilt(u, v, c, model, (fx, fy, skew), rows)
        positive &= ahead
    ux, uy = m00 * a + m01 * d, m00 * b + m01 * e
    vx, vy = m10 * a + m11 * d, m10 * b + m11 * e
    regular = positive & ((ux * vy - uy * vx) * (fx * fy) > 0)
    ux, uy, vx, vy = ux * inverse_depth, uy * inverse_depth, vx * inverse_depth, vy * inverse_depth
    by_point[..., 0, 0, :], by_point[..., 0, 1, :] = ux, vx
    by_point[..., 1, 0, :], by_point[..., 1, 1, :] = uy, vy
    np.negative(ux * x + uy * y, out=by_point[..., 2, 0, :])
    np.negative(vx * x + vy * y, out=by_point[..., 2, 1, :])

    _write_lens_rows(rows, model, (x, y, s), (m00, m01, m10, m11), g, inverse)
    intrinsic = ((x_out, 0.0), (0.0, y_out), (1.0, 0.0), (0.0, 1.0), (y_out, 0.0))
    for i, (du, dv) in enumerate(intrinsic):
        if i in wanted:
            by_camera[..., wanted[i], 0, :], by_camera[..., wanted[i], 1, :] = du, dv
    return fx * x_out + (skew * y_out + cx), fy * y_out + cy, regular


def _polynomial(s: Array, coefficients: list[Value], constant: float) -> tuple[Value, Value]:
    """`kcal.lens.distortion.polynomial`."""
    if not coefficients:
        return constant + 0.0 * s, 0.0
    value, *rest = reversed(coefficients)
    slope: Value = 0.0
    for coefficient in rest:
        slope = value + slope * s
        value = coefficient + value * s
    return constant + value * s, value + slope * s


def _tilt(
    u: Array, v: Array, c: list[Value], model: LensModel, intrinsics: tuple[Value, Value, Value], rows: dict[int, Array]
) -> tuple[Array, Array, tuple[Array, Array, Array, Array], npt.NDArray[np.bool_]]:
    """Apply the tilt: coordinates, derivatives of the pixel by those before the tilt, mask of those before a pole.

    Derivatives by both angles are written to `rows`.
    """
    fx, fy, skew = intrinsics
    i, j = model.names.index("tau_x"), model.names.index("tau_y")
    cos_x, sin_x, cos_y, sin_y = np.cos(c[i]), np.sin(c[i]), np.cos(c[j]), np.sin(c[j])
    w = sin_y * u - (cos_y * sin_x) * v + cos_y * cos_x
    scale = 1.0 / w
    x, y = cos_x * u * scale, (cos_y * v - (sin_x * sin_y) * u) * scale
    if i in rows:
        w_rate = -cos_y * (cos_x * v + sin_x)
        _write_pixel_rate(
            rows[i], (-sin_x * u - x * w_rate) * scale, (-cos_x * sin_y * u - y * w_rate) * scale, intrinsics
        )
    if j in rows:
        w_rate = cos_y * u + sin_y * (sin_x * v - cos_x)
        y_rate = -sin_x * cos_y * u - sin_y * v
        _write_pixel_rate(rows[j], -x * w_rate * scale, (y_rate - y * w_rate) * scale, intrinsics)
    m10, m11 = -sin_y * (sin_x + y) * scale, cos_y * (1.0 + sin_x * y) * scale
    m00 = fx * ((cos_x - sin_y * x) * scale) + skew * m10
    m01 = fx * ((cos_y * sin_x) * x * scale) + skew * m11
    return x, y, (m00, m01, fy * m10, fy * m11), w > 0


def _write_pixel_rate(row: Array, x_rate: Array, y_rate: Array, intrinsics: tuple[Value, Value, Value]) -> None:
    fx, fy, skew = intrinsics
    row[..., 0, :] = fx * x_rate + skew * y_rate
    np.multiply(fy, y_rate, out=row[..., 1, :])


def _write_lens_rows(
    rows: dict[int, Array],
    model: LensModel,
    place: tuple[Array, Array, Array],
    outer: tuple[Value, Value, Value, Value],
    g: Array,
    inverse: Value,
) -> None:
    """Write the derivatives by all coefficients except the tilt's."""
    x, y, s = place
    m00, m01, m10, m11 = outer
    # Derivatives of the pixel by the ratio of the polynomials.
    u_radial, v_radial = m00 * x + m01 * y, m10 * x + m11 * y
    if model.tangential:
        double_x, double_y = 2.0 * x, 2.0 * y
        for name, rate, du, dv in (("p1", double_y, m01, m11), ("p2", double_x, m00, m10)):
            index = model.names.index(name)
            if index in rows:
                rows[index][..., 0, :] = du * s + rate * u_radial
                rows[index][..., 1, :] = dv * s + rate * v_radial
    u_start, v_start = u_radial * inverse * s, v_radial * inverse * s
    _write_powers(rows, model.numerator_index, (u_start, v_start), s)
    if model.denominator:
        _write_powers(rows, model.denominator_index, (-g * u_start, -g * v_start), s)
    if model.prism:
        for members, du, dv in zip(model.prism_index, (m00, m01), (m10, m11), strict=True):
            _write_powers(rows, members, (du * s, dv * s), s)


def _write_powers(rows: dict[int, Array], members: tuple[int, ...], start: tuple[Array, Array], s: Array) -> None:
    """Write the columns of a polynomial in s, each the one before times s."""
    if not all(i in rows for i in members):
        for order, i in enumerate(members):
            if i in rows:
                for k in range(2):
                    np.multiply(start[k], s**order, out=rows[i][..., k, :])
        return
    for k in range(2):
        before: Array = start[k]
        for order, i in enumerate(members):
            row = rows[i][..., k, :]
            np.multiply(before, s if order else 1.0, out=row)
            before = row
