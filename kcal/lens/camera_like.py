"""`CameraLike`: what a rig, a localizer and `Undistort` ask of a camera; `AdaptedCamera` answers the rest for it."""

from __future__ import annotations

import hashlib
from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.func import jvp

from kcal.checks import Float64Module
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.projection import Projection


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
