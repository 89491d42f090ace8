"""Cameras of kornia from camera parameters, and back; exact, or refused.

A lens without coefficients is a `kornia.geometry.camera.PinholeCamera`; k1 to k6, p1 and p2 are the Brown-Conrady
model of `kornia.sensors.camera`, and `fisheye4` is its Kannala-Brandt model. Both libraries have integer pixel centers
and the same axes, so that no number is converted.
"""

from __future__ import annotations

from typing import Any

import torch
from kornia.geometry.camera import PinholeCamera
from kornia.image import ImageSize
from kornia.sensors.camera import CameraModel, CameraModelType
from kornia.sensors.camera.distortion_model import AffineTransform, BrownConradyTransform, KannalaBrandtK3Transform
from kornia.sensors.camera.projection_model import Z1Projection
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.camera_parameters import CameraParameters
from kcal.lens.model import PRESETS, LensModel

_BROWN_CONRADY = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# Presets of the same order of coefficients, by kornia's class of distortion.
_MODELS = {AffineTransform: "pinhole", BrownConradyTransform: "opencv8", KannalaBrandtK3Transform: "fisheye4"}


def kornia_camera(camera: CameraParameters) -> Any:
    """The camera as a class of kornia; see `Camera.to_kornia`."""
    values = camera.values
    width, height = camera.size
    lens = dict(zip(camera.model.names, camera.coefficients.unbind(-1), strict=True))
    used = {name for name, value in lens.items() if bool((value != 0).any())}
    if not used and not camera.model.wide:
        matrix = camera.matrix.reshape(-1, 3, 3)
        count = len(matrix)
        intrinsics = torch.eye(4).to(matrix).repeat(count, 1, 1)
        intrinsics[:, :3, :3] = matrix
        pose = torch.eye(4).to(matrix).repeat(count, 1, 1)
        return PinholeCamera(
            intrinsics, pose, torch.full((count,), height, device=matrix.device),
            torch.full((count,), width, device=matrix.device),
        )  # fmt: skip
    if values.ndim != 1:
        raise InputError(
            "to_kornia: kornia's lens models apply a batch of parameters to points, not to cameras; convert the "
            "cameras one by one"
        )
    fisheye = camera.model == PRESETS["fisheye4"]
    if not (fisheye or (used <= set(_BROWN_CONRADY) and not camera.model.wide)) or bool(values[4] != 0):
        raise InputError(
            f"to_kornia: no camera of kornia holds this {camera.model} lens"
            f"{' with skew' if bool(values[4] != 0) else ''}. Fit one that it holds, with its misfit stated: "
            "kcal.lens.refit_camera(camera, 'opencv8').camera, or undistort the images first"
        )
    zero = values.new_zeros(())
    names = camera.model.names if fisheye else _BROWN_CONRADY
    kind = CameraModelType.KANNALA_BRANDT_K3 if fisheye else CameraModelType.BROWN_CONRADY
    numbers = torch.cat([values[:4], torch.stack([lens.get(name, zero) for name in names])])
    return CameraModel(ImageSize(height, width), kind, numbers)


def parameters_from_kornia(camera: Any) -> tuple[Tensor, tuple[int, int], LensModel]:
    """Parameters, size and model of a camera of kornia; see `Camera.from_kornia`."""
    if isinstance(camera, PinholeCamera):
        matrix = camera.camera_matrix.to(torch.float64)
        if matrix.ndim != 3:
            raise InputError(f"from_kornia: intrinsics (B, 4, 4) are needed, got {tuple(camera.intrinsics.shape)}")
        if not torch.equal(camera.extrinsics, torch.eye(4).to(camera.extrinsics).expand_as(camera.extrinsics)):
            raise InputError(
                "from_kornia: this camera has a pose, which a Camera does not keep; take it from `camera.extrinsics`, "
                "and give a PinholeCamera whose extrinsics are the identity"
            )
        values = torch.stack([matrix[:, i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2), (0, 1))], -1)
        size = _one_size(camera.width, camera.height)
        return values[0] if len(values) == 1 else values, size, PRESETS["pinhole"]
    distortion, projection = getattr(camera, "distortion", None), getattr(camera, "projection", None)
    if type(distortion) not in _MODELS or not isinstance(projection, Z1Projection):
        raise InputError(f"from_kornia: a perspective or Kannala-Brandt camera of kornia is needed, got {camera!r}")
    model = LensModel.named(_MODELS[type(distortion)])
    given = camera.params.to(torch.float64)
    order = _BROWN_CONRADY if isinstance(distortion, BrownConradyTransform) else model.names
    lens = [given[..., 4 + order.index(name)] for name in model.names]
    values = torch.cat([given[..., :4], torch.stack([torch.zeros_like(given[..., 0]), *lens], -1)], -1)
    return values, _one_size(camera.image_size.width, camera.image_size.height), model


def posed_pinholes(left: CameraParameters, right: CameraParameters, turn: Tensor, shift: Tensor) -> tuple[Any, Any]:
    """Cameras of a rig, and their poses in the first one's frame; see `Rig.to_kornia`."""
    made = kornia_camera(left), kornia_camera(right)
    for word, camera in zip(("left", "right"), made, strict=True):
        if not isinstance(camera, PinholeCamera):
            raise InputError(
                f"to_kornia: the {word} camera has a lens, and kornia's cameras with one have no pose; undistort the "
                "images, and give the rig of `StereoRectification`, or convert each camera by itself"
            )
    pose = torch.cat([turn, shift[:, None]], 1)
    pose = torch.cat([pose, pose.new_tensor([[0.0, 0.0, 0.0, 1.0]])])[None]
    return made[0], PinholeCamera(made[1].intrinsics, pose, made[1].height, made[1].width)


def unposed_pinhole(camera: Any) -> tuple[Any, Tensor]:
    """A single posed camera of kornia without its pose, and the pose (4, 4) in float64; see `Rig.from_kornia`."""
    if not isinstance(camera, PinholeCamera) or camera.extrinsics.shape != (1, 4, 4):
        found = tuple(camera.extrinsics.shape) if isinstance(camera, PinholeCamera) else type(camera).__name__
        raise InputError(f"from_kornia: a PinholeCamera with extrinsics (1, 4, 4) is needed, got {found}")
    still = torch.eye(4).to(camera.extrinsics)[None]
    return PinholeCamera(camera.intrinsics, still, camera.height, camera.width), camera.extrinsics[0].double()


def _one_size(width: Any, height: Any) -> tuple[int, int]:
    widths, heights = (torch.as_tensor(value).flatten() for value in (width, height))
    if not (bool((widths == widths[0]).all()) and bool((heights == heights[0]).all())):
        raise InputError("from_kornia: cameras of one image size are needed; convert them one by one")
    return int(widths[0]), int(heights[0])
