"""Cameras of any kind: what a rig, a localizer and `Undistort` ask of one, and one call for several."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from torch import Tensor, nn
from torch.func import jvp

from kcal.checks import Float64Module, as_tensor
from kcal.dispatch import is_differentiated, is_traced, may_branch
from kcal.errors import InputError
from kcal.lens.camera import Camera, pixels_to_plane
from kcal.lens.inverse import PreparedInverse
from kcal.lens.projection import FAR, Projection, project_components, rays_from_plane
from kcal.lens.region import Region
from kcal.texts import brief

# `CameraLike`: what a rig, a localizer and `Undistort` ask of a camera; `AdaptedCamera` answers the rest for it.


@runtime_checkable
class CameraLike(Protocol):
    """A camera of any make: of kcal, baked (`LookupCamera`), or of your own.

    Its rays start at the origin of the camera frame: x right, y down, z forward; pixel (0, 0) is the center of the
    first pixel. Everything is float64. `Rig`, localizers and `Undistort` take one. What needs
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
    """A camera without parameters is asked for something that only parameters tell."""


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
        return torch.where(valid[:, None], pixel, 0.5 * (self.params.new_tensor(self.size) - 1.0))[0]

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
        """Raise `MissingParameterError` for attributes that only cameras with parameters have."""
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


def check_single(names: Sequence[str], cameras: Sequence[Camera], what: str) -> None:
    """Raise `InputError` if one of the cameras of a rig is a batch of cameras."""
    for name, camera in zip(names, cameras, strict=True):
        if camera.params.ndim != 1:
            lead = tuple(camera.params.shape[:-1])
            raise InputError(f"{what}: single cameras are needed; {name} is a batch of {lead}: give one rig for each")


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
    region = Region(*map(torch.stack, zip(*(camera.valid_region for camera in cameras), strict=True)))
    ready = PreparedInverse(region, torch.stack([camera.inverse_start for camera in cameras]))
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


# Where the axis of the cameras goes in pixels, derivatives by point and by camera, and validity.
_CAMERAS = (-3, -4, -4, -2)


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
    found = project_components(points, values, cameras[0].model, wanted[0])
    return list(map(Projection, *(part.unbind(axis) for part, axis in zip(found[:4], _CAMERAS, strict=True))))


def project_stack(stack: CameraStack, points: Tensor, wanted: Sequence[Sequence[int]], meter: Tensor) -> Projection:
    """As `project_each`, with all cameras in one axis before those of `Projection`; fewer wanted ones end in zeros."""
    if stack.values is not None:
        return project_components(points, stack.values, stack.cameras[0].model, wanted[0])
    most = max(map(len, wanted))
    each = [
        one._replace(by_camera=torch.nn.functional.pad(one.by_camera, (0, 0, 0, 0, 0, most - len(own))))
        for one, own in zip(project_each(stack.cameras, points, wanted, meter), wanted, strict=True)
    ]
    rates = None
    if any(one.by_meter is not None for one in each):
        moved = [torch.zeros_like(one.pixels) if one.by_meter is None else one.by_meter for one in each]
        rates = torch.stack(moved, -3)
    columns = zip(*(one[:4] for one in each), strict=True)
    pixels, by_point, by_camera, regular = map(torch.stack, columns, _CAMERAS)
    return Projection(pixels, by_point, by_camera, regular, rates)


# The ray of every pixel: as the `forward` of a module, and for renderers that take rays in place of a camera model.

# `Unproject`: `Camera.unproject` as the `forward` of a module, for pipelines, `torch.export` and ONNX.


class LearnedStart(Protocol):
    """A module that guesses the inverse of a lens, such as `kcal.nets.InverseNet`."""

    def guess(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return roughly undistorted coordinates for distorted ones (..., N)."""
        ...


class Unproject(nn.Module):
    """Map pixels to rays: `Camera.unproject` as a module.

    The module of the other direction is `Camera` itself. Compiled and exported graphs take a fixed number of Newton
    steps for every point. The few pixels next to a fold that have not converged by then are not valid there, although
    an eager call may find their rays.

    `kcal.io.lookup_file.save_onnx` writes the module as ONNX.

    Args:
        camera: the camera, kept as a submodule, or a `CameraLike`.
        start: for a `Camera`, a trained `InverseNet`; its guess is where Newton's method starts. It affects run time
            only.

    Example:
        >>> import torch
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1])
        >>> rays, valid = Unproject(camera)(torch.tensor([[320.0, 240.0]]))
        >>> rays.tolist(), valid.tolist()
        ([[0.0, 0.0, 1.0]], [True])
    """

    __repr__ = brief

    def __init__(self, camera: Camera | CameraLike, start: LearnedStart | None = None) -> None:
        super().__init__()
        if start is not None and not isinstance(camera, Camera):
            raise InputError("start: it begins Newton's method of kcal's own lenses; leave it out for another camera")
        self.camera: Camera = as_camera(camera)
        self.start = start

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Map pixels (..., N, 2) to rays (..., N, 3) of length one, and valid (..., N)."""
        return self.camera.unproject(pixels, **({} if self.start is None else {"start": self.start.guess}))


# The ray of every pixel, for renderers that take rays in place of a camera model: gsplat, splatting and NeRFs.
#
# gsplat from 1.6 on takes `rays` (..., C, H, W, 6) in the world's frame: where each pixel's ray starts, and its
# direction (gsplat issues 718, 801 and 1035; `rasterization(..., rays=..., with_eval3d=True, with_ut=True,
# packed=False)`). So any lens can be rendered, an entrance pupil that moves included. Pixels without a ray have zeros.

# Pixels computed at a time, so that temporary values stay small for any image.
_BAND = 1 << 18


class CameraRays(Float64Module):
    """Rays of all pixels of one or several cameras, in the cameras' frames or in the world's.

    Row v and column u of the result are the ray through the center of pixel (u, v). Rays are kept and made anew when a
    camera changes, and at each call while one is differentiated.

    Args:
        cameras: one camera, or several with images of one size.

    Raises:
        InputError: no camera, batches of cameras, or images of several sizes.

    Example:
        >>> camera = Camera.build(focal=(50, 50), center=(31.5, 23.5), size=(64, 48), coefficients=[-0.1])
        >>> rays = CameraRays(camera)()
        >>> rays.shape, rays.dtype
        (torch.Size([1, 48, 64, 6]), torch.float32)
        >>> viewmats = torch.eye(4).repeat(5, 1, 1, 1)  # five poses of the camera, world to camera
        >>> CameraRays(camera)(viewmats).shape
        torch.Size([5, 1, 48, 64, 6])
    """

    depths: Tensor
    directions: Tensor
    mask: Tensor

    def __init__(self, cameras: Camera | Sequence[Camera]) -> None:
        super().__init__()
        several = [cameras] if isinstance(cameras, Camera) else list(cameras)
        if not several or any(camera.params.ndim != 1 for camera in several):
            raise InputError("rays: one or several single cameras are needed, no batch")
        if len({camera.size for camera in several}) > 1:
            sizes = ", ".join(f"{width}x{height}" for width, height in (camera.size for camera in several))
            raise InputError(f"rays: images of one size are needed in one array, got {sizes} px; write one file each")
        self.cameras = nn.ModuleList(several)
        with torch.no_grad():
            for name, value in zip(("depths", "directions", "mask"), self._measured(), strict=True):
                self.register_buffer(name, value.detach(), persistent=False)
        self._made_from = self._fingerprints()

    def _measured(self) -> tuple[Tensor, ...]:
        return tuple(map(torch.stack, zip(*(_pixel_rays(camera) for camera in self.cameras), strict=True)))

    def _fingerprints(self) -> list[str]:
        return [camera.fingerprint for camera in self.cameras]  # type: ignore[misc]

    def _current(self) -> tuple[Tensor, ...]:
        """Depths, directions and mask: kept ones, unless a camera is differentiated, mapped, or has changed."""
        if is_differentiated(self) or not (is_traced() or may_branch(*self.cameras.parameters())):
            return self._measured()
        if not is_traced() and self._made_from != self._fingerprints():
            # Rays that are kept serve differentiated calls, too.
            with torch.inference_mode(False), torch.no_grad():
                self.depths, self.directions, self.mask = self._measured()
            self._made_from = self._fingerprints()
        return self.depths, self.directions, self.mask

    def forward(self, viewmats: Tensor | None = None, dtype: torch.dtype = torch.float32) -> Tensor:
        """Rays as (..., C, H, W, 6): origin, then direction of length one.

        Args:
            viewmats: (..., C, 4, 4) camera_from_world, as gsplat has it; the cameras' own frames if not given.
            dtype: of the result; moved to the world in float64 and rounded once.

        Raises:
            InputError: matrices of another shape, or whose left part is no rotation.
        """
        depths, directions, mask = self._current()
        zero = torch.zeros_like(depths)
        origins = torch.stack([zero, zero, depths], -1)
        rays = torch.cat([origins, directions], -1)
        if viewmats is not None:
            count, viewmats = len(self.cameras), as_tensor("viewmats", viewmats)
            if viewmats.shape[-3:] != (count, 4, 4):
                raise InputError(f"viewmats: shape (..., {count}, 4, 4) is needed, got {tuple(viewmats.shape)}")
            rotation, translation = viewmats[..., :3, :3].double(), viewmats[..., :3, 3].double()
            off = (rotation @ rotation.mT - torch.eye(3).to(rotation)).abs() > 1e-5
            if not is_traced() and may_branch(off) and bool(off.any()):
                raise InputError("viewmats: the left part of a matrix is no rotation; scales belong into the scene")
            turn, shift = rotation[..., None, None, :, :], translation[..., None, None, :]
            # Row vectors times R are Rᵀ v: from the camera to the world.
            rays = torch.cat([(part[..., None, :] @ turn)[..., 0, :] for part in (origins - shift, directions)], -1)
        return torch.where(mask[..., None], rays, 0.0).to(dtype)


@torch.no_grad()
def ray_error(camera: Camera, rays: Tensor, near: float = 1.0) -> float:
    """Largest distance in pixels between a pixel and the image of its ray, at `near` meters and far away.

    Args:
        camera: a single camera.
        rays: (H, W, 6) in its frame, of any precision; zeros for pixels without a ray.
        near: meters.

    Example:
        >>> camera = Camera.build(focal=(50, 50), center=(31.5, 23.5), size=(64, 48), coefficients=[-0.1])
        >>> ray_error(camera, CameraRays(camera)()[0]) < 1e-5
        True
    """
    if rays.numel() != camera.size[0] * camera.size[1] * 6:
        raise InputError(
            f"rays: shape {(*camera.size[::-1], 6)} of this camera's image is needed, got {tuple(rays.shape)}"
        )
    flat, pixels = rays.double().reshape(-1, 6), camera.grid(*camera.size).reshape(-1, 2)
    origin, direction = flat.split(3, -1)
    there = direction.abs().sum(-1) > 0
    worst = 0.0
    for at in (near, FAR):
        seen, valid = camera.project(origin + at * direction)
        apart = torch.where(valid, (seen - pixels).norm(dim=-1), math.inf)[there]
        worst = max(worst, float(apart.max()) if len(apart) else 0.0)
    return worst


def _pixel_rays(camera: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Depth of the start (H, W), direction (H, W, 3) and mask (H, W)."""
    width, height = camera.size
    parts = []
    for pixels in camera.grid(width, height).flatten(0, 1).split(_BAND):
        rays, valid = camera.unproject(pixels)
        parts.append((camera.ray_origins(rays)[:, 2], rays, valid))
    depth, rays, valid = (torch.cat(each) for each in zip(*parts, strict=True))
    return depth.reshape(height, width), rays.reshape(height, width, 3), valid.reshape(height, width)
