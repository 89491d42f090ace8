"""Patches of both images on one plane: a virtual camera that looks at each object, with its columns along the baseline.

On this plane the same object at any distance appears at the same row in both images, whatever lenses the cameras have
and however they are turned; only its column differs. One step of the plane is about one pixel of the left image, or
2^level pixels for large objects, whose images are blurred by as much before.
"""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.corners.filters import gaussian_kernel
from kcal.lens.camera import Camera
from kcal.lens.rig import StereoRig

# Steps, of both images: as in `kcal.corners.match`, where bilinear samples of it are good to 0.005 px.
IMAGE_BLUR = 0.8
# Slope of the left image is measured over this many radians on each side.
_SMALL = 1e-4


class ObjectPlanes(NamedTuple):
    """The virtual cameras of N objects.

    Attributes:
        axes: (N, 3, 3) rows x (along the baseline), y, z of each plane in the left camera's frame.
        left: (N, 2) where the left anchor's ray meets the plane z = 1.
        right: (N, 2) where the right anchor's ray does.
        step: (N,) size of one step on that plane.
        valid: (N,) whether both rays exist and cross the baseline.
    """

    axes: Tensor
    left: Tensor
    right: Tensor
    step: Tensor
    valid: Tensor


def object_planes(rig: StereoRig, left: Tensor, right: Tensor, level: Tensor) -> ObjectPlanes:
    """Planes for anchors (N, 2) in both images, with steps of about 2^level (N,) pixels of the left image."""
    rotation = rig.right_from_left_rotation
    along = -(rotation.T @ rig.right_from_left_translation)
    along = along / torch.linalg.vector_norm(along)
    rays, seen_left = rig.left.unproject(left)
    others, seen_right = rig.right.unproject(right)
    others = others @ rotation
    across = rays - (rays @ along)[:, None] * along
    length = torch.linalg.vector_norm(across, dim=-1)
    # Along the baseline there is no parallax.
    sound = length > 0.05
    ahead = across / torch.where(sound, length, 1.0)[:, None]
    x = along.expand_as(ahead)
    axes = torch.stack([x, torch.linalg.cross(ahead, x), ahead], 1)
    depth = (others * ahead).sum(-1)
    valid = seen_left & seen_right & sound & (depth > 0.05)
    plane = torch.stack([(rays @ along) / torch.where(sound, length, 1.0), torch.zeros_like(length)], -1)
    safe = torch.where(valid, depth, 1.0)[:, None]
    other = torch.stack([others @ along, (others * axes[:, 1]).sum(-1)], -1) / safe
    made = ObjectPlanes(axes, plane, other, torch.ones_like(length), valid)
    sides = torch.tensor([[-_SMALL, 0.0], [_SMALL, 0.0]], dtype=torch.float64, device=left.device)
    pixels, _ = plane_pixels(rig.left, made, plane[:, None] + sides)
    slope = torch.linalg.vector_norm(pixels[:, 1] - pixels[:, 0], dim=-1) / (2.0 * _SMALL)
    return made._replace(step=2.0**level / slope.clamp_min(1e-9))


def plane_pixels(
    camera: Camera, planes: ObjectPlanes, places: Tensor, rotation: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Pixels (N, ..., 2) of places (N, ..., 2) on the planes, and valid; `rotation`: of the right camera."""
    rays = torch.cat([places, torch.ones_like(places[..., :1])], -1).flatten(1, -2) @ planes.axes
    if rotation is not None:
        rays = rays @ rotation.T
    pixels, valid = camera.project_rays(rays.flatten(0, 1))
    return pixels.reshape(places.shape), valid.reshape(places.shape[:-1])


def plane_places(camera: Camera, planes: ObjectPlanes, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Places (N, 2) on the planes that the left camera's pixels (N, 2) show, and valid."""
    rays, seen = camera.unproject(pixels)
    x, y, z = (planes.axes @ rays[..., None])[..., 0].unbind(-1)
    valid = seen & (z > 0.05)
    return torch.stack([x, y], -1) / torch.where(valid, z, 1.0)[:, None], valid


def grid_of(half: tuple[int, int], device: torch.device) -> Tensor:
    """(2 half_y + 1, 2 half_x + 1, 2) whole steps x, y around zero."""
    x, y = (torch.arange(-side, side + 1, dtype=torch.float64, device=device) for side in half)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


class ImageWindows(NamedTuple):
    """Blurred parts of one image, one for each object.

    Attributes:
        values: (N, h, w) blurred gray levels.
        saturated: (N, h, w) share of saturated pixels there.
        corner: (N, 2) pixel of the first value of each.
        size: (width, height) of the whole image.
        level: of blur.
    """

    values: Tensor
    saturated: Tensor
    corner: Tensor
    size: tuple[int, int]
    level: int

    def at(self, which: Tensor) -> Self:
        """Those of the objects at some places."""
        return self._replace(
            values=self.values[which], saturated=self.saturated[which], corner=self.corner[which]
        )  # fmt: skip


def image_windows(image: Tensor, pixels: Tensor, level: int, brightest: float) -> ImageWindows:
    """Windows that cover pixels (N, ..., 2) of an image (H, W) with room for blur and slopes; edges repeat."""
    height, width = image.shape
    kernel = gaussian_kernel(IMAGE_BLUR * 2**level, 3 * 2**level).to(image.device)
    reach = len(kernel) // 2
    flat = pixels.detach().flatten(1, -2)
    # One more for the slopes' steps, and one for bilinear samples.
    low = (flat.amin(1) - reach - 2**level - 1).floor().long()
    count = int((flat.amax(1) - low).amax().ceil()) + reach + 2**level + 2
    steps = torch.arange(min(count, 3 * max(width, height)), device=image.device)
    columns, rows = ((low[:, i : i + 1] + steps).clamp(0, side - 1) for i, side in enumerate((width, height)))
    raw = image[rows[:, :, None], columns[:, None, :]].to(torch.float64)
    # Without a brightest level nothing is saturated.
    parts = [raw] if math.isinf(brightest) else [raw, (raw.detach() >= brightest).double()]
    blurred = torch.nn.functional.conv2d(torch.cat(parts)[:, None], kernel.reshape(1, 1, 1, -1))
    blurred = torch.nn.functional.conv2d(blurred, kernel.reshape(1, 1, -1, 1))[:, 0]
    values, saturated = blurred.chunk(2) if len(parts) == 2 else (blurred, torch.zeros_like(blurred))
    return ImageWindows(values, saturated, low + float(reach), (width, height), level)


def sample(windows: ImageWindows, pixels: Tensor, *, saturated: bool = False) -> Tensor:
    """Bilinear samples (N, ...) at pixels (N, ..., 2) of the full image."""
    values = windows.saturated if saturated else windows.values
    last = pixels.new_tensor([values.shape[2] - 1, values.shape[1] - 1])
    lead = (len(pixels), *[1] * (pixels.ndim - 2), 2)
    scale = 2.0 / last
    place = torch.addcmul(-scale * windows.corner.reshape(lead) - 1.0, pixels, scale)
    found = torch.nn.functional.grid_sample(
        values[:, None], place.reshape(len(pixels), 1, -1, 2), padding_mode="border", align_corners=True
    )
    return found.reshape(pixels.shape[:-1])


def has_samples(windows: ImageWindows, pixels: Tensor) -> Tensor:
    """(N, ...) where a sample and its slope are of the image and not of its repeated edge."""
    margin = 2.0**windows.level
    x, y = pixels.unbind(-1)
    width, height = windows.size
    return (x >= margin) & (y >= margin) & (x <= width - 1 - margin) & (y <= height - 1 - margin)
