"""Cameras of any kind: what a rig, a localizer and `Undistort` ask of one, and one call for several."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.func import jvp

from kcal.checks import Float64Module
from kcal.errors import InputError
from kcal.lens.camera import Camera, pixels_to_plane
from kcal.lens.inverse import PreparedInverse
from kcal.lens.projection import Projection, project_components, rays_from_plane
from kcal.lens.region import Region

# `CameraLike`: what a rig, a localizer and `Undistort` ask of a camera; `AdaptedCamera` answers the rest for it.


@runtime_checkable
class CameraLike(Protocol):
    """A camera of any make: of kcal, baked (`LookupCamera`), or of your own.

    Its rays start at the origin of the camera frame: x right, y down, z forward; pixel (0, 0) is the center of the
    first pixel. Everything is float64. `StereoRig`, `CameraRig`, localizers and `Undistort` take one. What needs
    parameters is refused: saving, exporting, freeing, error bars of the lens, which counts as exact.

    Example:
        >>> from kcal.lens.baking import bake
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> isinstance(bake(camera), CameraLike), isinstance(camera, CameraLike)
        (True, True)
    """

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of the image in pixels."""

    def project(self, points_cam: Tensor, /) -> tuple[Tensor, Tensor]:
        """Map points (..., N, 3) to pixels (..., N, 2), and valid (..., N); of any distance along a ray alike."""

    def unproject(self, pixels: Tensor, /) -> tuple[Tensor, Tensor]:
        """Map pixels (..., N, 2) to rays (..., N, 3) of length one, and valid (..., N)."""

    def inside(self, pixels: Tensor, /) -> Tensor:
        """Whether pixels (..., N, 2) lie in the image, (..., N)."""


class MissingParameterError(InputError, AttributeError):
    """A camera that is known by its projection alone is asked for what only parameters tell."""


class AdaptedCamera(Float64Module):
    """A `CameraLike` with what rigs and localizers ask besides, found from its projection.

    Args:
        camera: to adapt; a module is kept as a submodule, so that gradients reach its weights.

    Raises:
        InputError: not a `CameraLike`.
        MissingParameterError: for attributes that only a `Camera` has.

    Example:
        >>> from kcal.lens.baking import bake
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> seen = AdaptedCamera(bake(camera))
        >>> [round(value, 6) for value in seen.center.tolist()]
        [320.0, 240.0]
        >>> seen.focal
        Traceback (most recent call last):
        kcal.lens.camera_like.MissingParameterError: a LookupCamera has no focal: only its projection is known
    """

    params: Tensor
    calibration = None
    # Points beside the camera are asked for; the camera says whether they are valid.
    wide = True

    def __init__(self, camera: CameraLike) -> None:
        super().__init__()
        if not isinstance(camera, CameraLike):
            raise InputError(f"a camera has size, project, unproject and inside; got {type(camera).__name__}")
        self.camera = camera
        self.size = (int(camera.size[0]), int(camera.size[1]))
        state = list(camera.state_dict().values()) if isinstance(camera, nn.Module) else []
        # Only for type, device and batch: there are no parameters.
        self.register_buffer("params", torch.zeros(5, dtype=torch.float64, device=state[0].device if state else None))

    @property
    def values(self) -> Tensor:
        """(0,): no parameters."""
        return self.params[:0]

    @property
    def center(self) -> Tensor:
        """(2,) the pixel of the optical axis; the middle of the image if the axis has none."""
        pixel, valid = self.camera.project(self.params.new_tensor([[0.0, 0.0, 1.0]]))
        middle = 0.5 * (self.params.new_tensor(self.size) - 1.0)
        return torch.where(valid[:, None], pixel, middle)[0]

    @property
    def fingerprint(self) -> str:
        """Twelve hex digits that change with the weights of a module."""
        state = self.camera.state_dict() if isinstance(self.camera, nn.Module) else {}
        text = repr((type(self.camera).__name__, self.size, {name: part.tolist() for name, part in state.items()}))
        return hashlib.sha256(text.encode()).hexdigest()[:12]

    def project(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """See `CameraLike`; also for directions (`project_rays`)."""
        return self.camera.project(points_cam)

    project_rays = forward = project

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """See `CameraLike`."""
        return self.camera.unproject(pixels)

    def inside(self, pixels: Tensor) -> Tensor:
        """See `CameraLike`."""
        return self.camera.inside(pixels)

    def ray_origins(self, rays: Tensor) -> Tensor:
        """Zeros (..., N, 3)."""
        return torch.zeros_like(rays)

    grid, covers_image = Camera.grid, Camera.covers_image

    def projection(self, points: Tensor) -> Projection:
        """As `kcal.lens.projection.project_components`, of points (..., 3, N), with slopes in forward mode."""

        def pixels(points: Tensor) -> tuple[Tensor, Tensor]:
            found, valid = self.camera.project(points.mT)
            return found.mT, valid

        found, valid = pixels(points)
        axes = torch.eye(3, dtype=points.dtype, device=points.device)[..., None]
        slopes = [jvp(lambda at: pixels(at)[0], (points,), (axis.expand_as(points),))[1] for axis in axes]
        empty = found.new_zeros((*found.shape[:-2], 0, *found.shape[-2:]))
        return Projection(found, torch.stack(slopes, -3), empty, valid)

    def __getattr__(self, name: str) -> Any:
        """What is missing."""
        try:
            return super().__getattr__(name)
        except AttributeError:
            if name.startswith("_"):
                raise
            kind = type(self.__dict__.get("camera") or self._modules.get("camera")).__name__
            raise MissingParameterError(f"a {kind} has no {name}: only its projection is known") from None


def as_camera(camera: Any) -> Any:
    """A camera as it is, and any other `CameraLike` adapted."""
    return camera if isinstance(camera, Camera | AdaptedCamera) else AdaptedCamera(camera)


# Several cameras at once: one call for all of them where they have the same kind of lens, as those of a rig do.
#
# For some hundred pixels, starting an operation takes longer than the operation itself, so that two cameras in one call
# cost little more than one.


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
