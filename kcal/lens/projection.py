"""Project points to pixels by the chain pinhole, lens, intrinsics, with its closed-form Jacobian.

Camera parameters are one vector (..., 5 + P): fx, fy, cx, cy, skew, then the lens coefficients:

    x = X / Z, y = Y / Z;  (x_D, y_D) = distortion(x, y);  u = fx x_D + skew y_D + cx,  v = fy y_D + cy

(Eq. 1 to 4 of the paper). A residual field (`kcal.lens.residual`) moves (x_D, y_D) before the last step. Skew is γ of
Eq. 3; `cv2.fisheye` stores it as alpha = skew / fx. A fisheye replaces the first step (`kcal.lens.plane`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.distortion import Distorted, distort_components, unbind_last
from kcal.lens.model import LensModel
from kcal.lens.plane import plane_with_slopes
from kcal.lens.residual import Field, correct_components

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
    """

    pixels: Tensor
    by_point: Tensor
    by_camera: Tensor
    regular: Tensor


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
    field: Field | None = None,
) -> Projection:
    """Project points given as (..., 3, N), with derivatives by the point and the wanted camera parameters.

    Args:
        points: (..., 3, N) in the camera frame, meters.
        parameters: (..., 5 + P), broadcast against the leading shape of `points`.
        model: the lens model.
        wanted: indices of the camera parameters of `by_camera`; None: no derivatives, `by_point` and `by_camera` are
            empty.
        field: a residual field after the lens, or None.
    """
    X, Y, Z = points[..., 0, :], points[..., 1, :], points[..., 2, :]
    x, y, x_X, x_Y, y_Y, x_Z, y_Z = plane_with_slopes(X, Y, Z, model)
    offset = len(INTRINSICS)
    lens_wanted = [i - offset for i in wanted or () if i >= offset]
    lens = distort_components(x, y, parameters[..., offset:], model, lens_wanted)
    fx, fy, _, _, skew = unbind_last(parameters[..., :offset])
    regular = lens.positive & (lens.determinant > 0)
    if field is not None:
        # The field is one-to-one, so it neither makes nor removes folds.
        lens = _with_field(lens, field)
    pixels = torch.stack(to_pixels(lens.x, lens.y, parameters), -2)
    if not model.fisheye:
        regular = regular & (Z > 0)
    if wanted is None:
        empty = pixels.new_zeros((*pixels.shape[:-2], 0, *pixels.shape[-2:]))
        return Projection(pixels, empty, empty, regular)

    a, b, d, e = lens.point
    ux, uy, vx, vy = fx * a + skew * d, fx * b + skew * e, fy * d, fy * e
    if model.fisheye:
        columns = [
            ux * x_X + uy * x_Y, vx * x_X + vy * x_Y, ux * x_Y + uy * y_Y, vx * x_Y + vy * y_Y,
            ux * x_Z + uy * y_Z, vx * x_Z + vy * y_Z,
        ]  # fmt: skip
    else:
        ux, uy, vx, vy = ux * x_X, uy * x_X, vx * x_X, vy * x_X
        columns = [ux, vx, uy, vy, -(ux * x + uy * y), -(vx * x + vy * y)]
    by_point = torch.stack(torch.broadcast_tensors(*columns), -2).unflatten(-2, (3, 2))

    zero, one = torch.zeros_like(lens.x), torch.ones_like(lens.x)
    intrinsic = [(lens.x, zero), (zero, lens.y), (one, zero), (zero, one), (lens.y, zero)]
    lens_columns = iter(lens.coefficients)
    flat: list[Tensor] = []
    for i in wanted:
        if i < offset:
            flat.extend(intrinsic[i])
        else:
            du, dv = next(lens_columns)
            flat.extend((fx * du + skew * dv, fy * dv))
    if flat:
        by_camera = torch.stack(torch.broadcast_tensors(*flat), -2).unflatten(-2, (len(wanted), 2))
    else:
        by_camera = pixels.new_zeros((*pixels.shape[:-2], 0, *pixels.shape[-2:]))
    return Projection(pixels, by_point, by_camera, regular)


def _with_field(lens: Distorted, field: Field) -> Distorted:
    """The lens followed by the field: positions, and derivatives by the chain rule."""
    moved = correct_components(lens.x, lens.y, field)
    p, q, r, t = moved.point
    a, b, d, e = lens.point
    return lens._replace(
        x=moved.x,
        y=moved.y,
        point=(p * a + q * d, p * b + q * e, r * a + t * d, r * b + t * e),
        coefficients=[(p * du + q * dv, r * du + t * dv) for du, dv in lens.coefficients],
    )
