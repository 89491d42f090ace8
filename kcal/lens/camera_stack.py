"""Several cameras at once: one call for all of them where they have the same kind of lens, as those of a rig do.

For some hundred pixels, starting an operation takes longer than the operation itself, so that two cameras in one call
cost little more than one.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.lens.camera import Camera, pixels_to_plane
from kcal.lens.inverse import PreparedInverse
from kcal.lens.plane import rays_from_plane
from kcal.lens.projection import Projection, project_components
from kcal.lens.region import Region


def stackable(cameras: Sequence[Camera]) -> bool:
    """Whether cameras have one lens model and may be computed as one batch."""
    first = cameras[0]
    # Those of a hybrid lens have polynomials of their own.
    return not first.model.hybrid and all(
        camera.model == first.model
        and camera.params.shape == first.params.shape[-1:]
        and camera.valid_cuts.shape == first.valid_cuts.shape
        for camera in cameras
    )


def unproject_each(cameras: Sequence[Camera], pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Pixels (..., C, N, 2) of C cameras to unit rays (..., C, N, 3), and valid (..., C, N); see `Camera.unproject`.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
        >>> rays, valid = unproject_each([camera, camera], torch.tensor([[[320.0, 240.0]], [[320.0, 240.0]]]))
        >>> rays[1].tolist(), valid.tolist()
        ([[0.0, 0.0, 1.0]], [[True], [True]])
    """
    if not stackable(cameras):
        found = [camera.unproject(pixels[..., number, :, :]) for number, camera in enumerate(cameras)]
        return torch.stack([rays for rays, _ in found], -3), torch.stack([valid for _, valid in found], -2)
    regions = zip(*(camera.valid_region for camera in cameras), strict=True)
    ready = PreparedInverse(
        Region(*(torch.stack(parts) for parts in regions)), torch.stack([camera.inverse_start for camera in cameras])
    )
    values, model = torch.stack([camera.values for camera in cameras]), cameras[0].model
    x, y, valid = pixels_to_plane(pixels, values, model, ready)
    return torch.stack(rays_from_plane(x, y, model), -1), valid


def project_each(
    cameras: Sequence[Camera], points: Tensor, wanted: Sequence[Sequence[int]], meter: Tensor
) -> list[Projection]:
    """Project points (..., C, 3, N), each camera's own, with derivatives; see `project_components`."""
    if not stackable(cameras):
        return [
            project_components(points[..., number, :, :], camera.values, camera.model, wanted[number], meter)
            for number, camera in enumerate(cameras)
        ]
    values = torch.stack([camera.values for camera in cameras])
    pixels, by_point, by_camera, regular, _ = project_components(points, values, cameras[0].model, wanted[0])
    return [
        Projection(*parts)
        for parts in zip(pixels.unbind(-3), by_point.unbind(-4), by_camera.unbind(-4), regular.unbind(-2), strict=True)
    ]
