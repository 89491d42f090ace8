"""Several cameras at once: one call for all of them where they have the same kind of lens, as those of a rig do.

For some hundred pixels, starting an operation takes longer than the operation itself, so that two cameras in one call
cost little more than one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.camera import Camera, pixels_to_plane
from kcal.lens.camera_like import AdaptedCamera
from kcal.lens.inverse import PreparedInverse
from kcal.lens.plane import rays_from_plane
from kcal.lens.projection import Projection, project_components
from kcal.lens.region import Region


def stackable(cameras: Sequence[Camera]) -> bool:
    """Whether cameras have one lens model and may be computed as one batch."""
    first = cameras[0]
    if not all(isinstance(camera, Camera) for camera in cameras):
        return False
    # Those of a hybrid lens have polynomials of their own.
    return not first.model.hybrid and all(
        camera.model == first.model
        and camera.params.shape == first.params.shape[-1:]
        and camera.valid_cuts.shape == first.valid_cuts.shape
        for camera in cameras
    )


class CameraStack(NamedTuple):
    """C cameras, and what they have together if they are `stackable`.

    Attributes:
        cameras: C of them.
        values: (C, 5 + P) their parameters; None where each is computed alone.
        ready: their inverses.
    """

    cameras: Sequence[Camera]
    values: Tensor | None
    ready: PreparedInverse | None


def camera_stack(cameras: Sequence[Camera]) -> CameraStack:
    """Put cameras together, once for many calls while they stay as they are."""
    if not stackable(cameras):
        return CameraStack(cameras, None, None)
    regions = zip(*(camera.valid_region for camera in cameras), strict=True)
    ready = PreparedInverse(
        Region(*(torch.stack(parts) for parts in regions)), torch.stack([camera.inverse_start for camera in cameras])
    )
    return CameraStack(cameras, torch.stack([camera.values for camera in cameras]), ready)


def unproject_each(cameras: Sequence[Camera] | CameraStack, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (..., C, N, 2) of C cameras to unit rays (..., C, N, 3), and valid (..., C, N); see `Camera.unproject`.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
        >>> rays, valid = unproject_each([camera, camera], torch.tensor([[[320.0, 240.0]], [[320.0, 240.0]]]))
        >>> rays[1].tolist(), valid.tolist()
        ([[0.0, 0.0, 1.0]], [[True], [True]])
    """
    stack = cameras if isinstance(cameras, CameraStack) else camera_stack(cameras)
    if stack.values is None or stack.ready is None:
        found = [camera.unproject(pixels[..., number, :, :]) for number, camera in enumerate(stack.cameras)]
        return torch.stack([rays for rays, _ in found], -3), torch.stack([valid for _, valid in found], -2)
    model = stack.cameras[0].model
    x, y, valid = pixels_to_plane(pixels, stack.values, model, stack.ready)
    return torch.stack(rays_from_plane(x, y, model), -1), valid


def project_each(
    cameras: Sequence[Camera], points: Tensor, wanted: Sequence[Sequence[int]], meter: Tensor
) -> list[Projection]:
    """Project points (..., C, 3, N), each camera's own, with derivatives; see `project_components`."""
    if not stackable(cameras):
        return [
            camera.projection(points[..., number, :, :])
            if isinstance(camera, AdaptedCamera)
            else project_components(points[..., number, :, :], camera.values, camera.model, wanted[number], meter)
            for number, camera in enumerate(cameras)
        ]
    values = torch.stack([camera.values for camera in cameras])
    pixels, by_point, by_camera, regular, *_ = project_components(points, values, cameras[0].model, wanted[0])
    return [
        Projection(*parts)
        for parts in zip(pixels.unbind(-3), by_point.unbind(-4), by_camera.unbind(-4), regular.unbind(-2), strict=True)
    ]


def project_stack(stack: CameraStack, points: Tensor, wanted: Sequence[Sequence[int]], meter: Tensor) -> Projection:
    """As `project_each`, with all cameras in one axis before those of `Projection`; fewer wanted ones end in zeros."""
    if stack.values is not None:
        return project_components(points, stack.values, stack.cameras[0].model, wanted[0])
    most = max(map(len, wanted))
    each = project_each(stack.cameras, points, wanted, meter)
    columns = [
        torch.nn.functional.pad(one.by_camera, (0, 0, 0, 0, 0, most - len(own)))
        for one, own in zip(each, wanted, strict=True)
    ]
    rates = None
    if any(one.by_meter is not None for one in each):
        rates = torch.stack(
            [torch.zeros_like(one.pixels) if one.by_meter is None else one.by_meter for one in each], -3
        )
    return Projection(
        torch.stack([one.pixels for one in each], -3),
        torch.stack([one.by_point for one in each], -4),
        torch.stack(columns, -4),
        torch.stack([one.regular for one in each], -2),
        rates,
    )
