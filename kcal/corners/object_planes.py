"""Patches of both images on one plane: a virtual camera that looks at each object, with its columns along the baseline.

On this plane the same object at any distance appears at the same row in both images, whatever lenses the cameras have
and however they are turned; only its column differs. One step of the plane is about one pixel of the left image, or
2^level pixels for large objects, whose images are blurred by as much before.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.rig import StereoRig

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
    rays = torch.cat([places, torch.ones_like(places[..., :1])], -1).reshape(len(places), -1, 3) @ planes.axes
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
