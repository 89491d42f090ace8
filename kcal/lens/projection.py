"""Points in front of the camera to pixels: the chain pinhole, lens, intrinsics, and its closed-form Jacobian.

Camera parameters are one vector (..., 5 + P): fx, fy, cx, cy, skew, then the lens coefficients:

    x = X / Z, y = Y / Z;  (x_D, y_D) = distortion(x, y);  u = fx x_D + skew y_D + cx,  v = fy y_D + cy

(Eq. 1 to 4 of the paper). Skew is γ of Eq. 3.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.distortion import distort_components
from kcal.lens.model import LensModel

INTRINSICS = ("fx", "fy", "cx", "cy", "skew")


def parameter_names(model: LensModel) -> tuple[str, ...]:
    """Names of the camera parameters in storage order."""
    return (*INTRINSICS, *model.names)


class Projection(NamedTuple):
    """Pixels and their derivatives, each as tensors whose last two dimensions are (2, N): all u, then all v.

    Attributes:
        pixels: (..., 2, N).
        by_point: (..., 3, 2, N), by X, Y, Z of the point in the camera frame.
        by_camera: (..., C, 2, N), by the wanted camera parameters.
        regular: (..., N), in front of the camera, before any pole, and not folded over (det J > 0).
    """

    pixels: Tensor
    by_point: Tensor
    by_camera: Tensor
    regular: Tensor


def project_components(
    points: Tensor, parameters: Tensor, model: LensModel, wanted: Sequence[int] | None = None
) -> Projection:
    """Project points given as (..., 3, N), with derivatives by the point and the wanted camera parameters.

    Args:
        points: (..., 3, N) in the camera frame, metres.
        parameters: (..., 5 + P), broadcast against the leading shape of `points`.
        model: the lens model.
        wanted: indices of camera parameters for `by_camera`; None: no derivative at all is formed, and `by_point`
            and `by_camera` are empty.
    """
    X, Y, Z = points[..., 0, :], points[..., 1, :], points[..., 2, :]
    inverse = 1.0 / Z
    x, y = X * inverse, Y * inverse
    offset = len(INTRINSICS)
    lens_wanted = [i - offset for i in wanted or () if i >= offset]
    lens = distort_components(x, y, parameters[..., offset:], model, lens_wanted)
    fx, fy, cx, cy, skew = (parameters[..., i, None] for i in range(offset))
    pixels = torch.stack([fx * lens.x + skew * lens.y + cx, fy * lens.y + cy], -2)
    a, b, d, e = lens.point
    regular = lens.positive & (Z > 0) & (a * e - b * d > 0)
    if wanted is None:
        empty = pixels.new_zeros((*pixels.shape[:-2], 0, *pixels.shape[-2:]))
        return Projection(pixels, empty, empty, regular)

    ux, uy = (fx * a + skew * d) * inverse, (fx * b + skew * e) * inverse
    vx, vy = fy * d * inverse, fy * e * inverse
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
