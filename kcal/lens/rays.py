"""The ray of every pixel: as the `forward` of a module, and for renderers that take rays in place of a camera model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from kcal.checks import Float64Module, as_tensor
from kcal.dispatch import is_differentiated, is_traced, may_branch
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.projection import FAR

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
        camera: the camera, kept as a submodule.
        start: a trained `InverseNet`; its guess is where Newton's method starts. It affects run time only.

    Example:
        >>> import torch
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1])
        >>> rays, valid = Unproject(camera)(torch.tensor([[320.0, 240.0]]))
        >>> rays.tolist(), valid.tolist()
        ([[0.0, 0.0, 1.0]], [True])
    """

    def __init__(self, camera: Camera, start: LearnedStart | None = None) -> None:
        super().__init__()
        self.camera = camera
        self.start = start

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Map pixels (..., N, 2) to rays (..., N, 3) of length one, and valid (..., N)."""
        return self.camera.unproject(pixels, start=None if self.start is None else self.start.guess)


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
            moved = (
                ((origins - shift)[..., None, :] @ turn)[..., 0, :],
                (directions[..., None, :] @ turn)[..., 0, :],
            )
            rays = torch.cat(moved, -1)
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
