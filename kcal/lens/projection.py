"""Project points to pixels by the chain pinhole, lens, intrinsics, with its closed-form Jacobian.

Camera parameters are one vector (..., 5 + P): fx, fy, cx, cy, skew, then the lens coefficients:

    x = X / Z, y = Y / Z;  (x_D, y_D) = distortion(x, y);  u = fx x_D + skew y_D + cx,  v = fy y_D + cy

(Eq. 1 to 4 of the paper). Skew is γ of Eq. 3; `cv2.fisheye` stores it as alpha = skew / fx. Fisheyes and hybrid lenses
replace the first step (`kcal.lens.plane`), and rays of hybrid lenses start at their entrance pupil (`kcal.lens.pupil`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.dispatch import may_overwrite
from kcal.lens.distortion import as_columns, distort_components
from kcal.lens.model import LensModel
from kcal.lens.plane import plane_with_slopes
from kcal.lens.pupil import entrance_pupil
from kcal.lens.zernike import unbind_last

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
        plane: (..., 2, N) places on which the terms of a hybrid lens act (`kcal.lens.plane`); None for other lenses.
    """

    pixels: Tensor
    by_point: Tensor
    by_camera: Tensor
    regular: Tensor
    by_meter: Tensor | None = None
    plane: Tensor | None = None

    def of(self, chosen: slice) -> Projection:
        """The same of some along the first dimension, which all have."""
        meter, plane = (None if each is None else each[chosen] for each in (self.by_meter, self.plane))
        pixels, by_point, by_camera, regular = (each[chosen] for each in self[:4])
        return Projection(pixels, by_point, by_camera, regular, meter, plane)


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
    pupil = entrance_pupil(X, Y, Z, parameters[..., offset:], meter) if model.hybrid else None
    if pupil:
        Z = Z - pupil.depth
    x, y, x_X, x_Y, y_Y, x_Z, y_Z = plane_with_slopes(X, Y, Z, model)
    plane = torch.stack([x, y], -2) if model.hybrid and wanted is not None else None
    lens_wanted = [i - offset for i in wanted or () if i >= offset]
    lens = distort_components(x, y, parameters[..., offset:], model, lens_wanted)
    fx, fy, _, _, skew = unbind_last(parameters[..., :offset])
    regular = lens.positive & (lens.determinant > 0)
    if pupil:
        regular = regular & pupil.found
    pixels = torch.stack(to_pixels(lens.x, lens.y, parameters), -2)
    if not model.wide:
        regular = regular & (Z > 0)
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

    by_meter = None
    if pupil:
        by_depth = by_point[..., 2, :, :]
        by_meter = -by_depth * pupil.by_meter(parameters[..., offset:])[..., None, :]
        moved = torch.stack(torch.broadcast_tensors(*pupil.by_point(X, Y, Z)), -2)[..., None, :]
        by_point = by_point - by_depth[..., None, :, :] * moved
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
        for place, rate in enumerate(pupil.by_coefficients(), offset + 1):
            if place in wanted:
                by_camera[..., list(wanted).index(place), :, :] = -by_depth * rate[..., None, :]
    return Projection(pixels, by_point, by_camera, regular, by_meter, plane)
