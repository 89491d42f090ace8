"""Compare a calibrated camera with the true lens at infinity, where errors matter at long range."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.pose import rotation_between, rotation_from_vector
from kcal.sim.captures import LensLike

_TURN_STEPS = 4
_TURN_NUDGE = 1e-6  # radians, for central differences


class InfinityError(NamedTuple):
    """Difference of a camera from the truth at infinity, after the best rotation.

    Attributes:
        rms: sqrt(mean ‖e‖²) over the image, pixels.
        maximum: largest ‖e‖, pixels.
        rotation: (3, 3) camera_from_truth: the turn of the camera frame, which no board determines and no rig needs.
        pixels: (rows, columns, 2) where it was measured.
        errors: (rows, columns, 2) pixel at which the camera sees what the truth sees at `pixels`, minus that pixel;
            NaN where the camera does not see it.
        valid: share of `pixels` that the camera sees.
    """

    rms: float
    maximum: float
    rotation: Tensor
    pixels: Tensor
    errors: Tensor
    valid: float


@torch.no_grad()
def error_at_infinity(camera: LensLike, truth: LensLike, *, columns: int = 49, rows: int = 28) -> InfinityError:
    """Measure over the whole image how far a camera's pixels of distant points are from the true ones.

    Each pixel of a grid has a true direction. The camera projects these directions after the rotation that makes the
    RMS smallest. This is mrcal's projection difference with its
    implied rotation fitted at infinity (mrcal.secretsauce.org/differencing.html).

    Args:
        camera: the calibrated camera: a `Camera`, or anything that projects.
        truth: the true lens: anything that unprojects.
        columns: of the grid, whose outermost pixels are the image's.
        rows: of the grid.

    Raises:
        InputError: images of different sizes, or a camera that sees none of the directions.

    Example:
        >>> from kcal import Camera
        >>> truth = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480))
        >>> camera = Camera.build(focal=(800, 800), center=(329.5, 239.5), size=(640, 480))
        >>> found = error_at_infinity(camera, truth)  # a shifted center is a rotation, nearly
        >>> round(found.rms, 2), round(found.maximum, 2), found.valid
        (0.62, 1.52, 1.0)
    """
    if tuple(camera.size) != tuple(truth.size):
        raise InputError(f"images of {tuple(camera.size)} and {tuple(truth.size)}: the same size is needed")
    width, height = truth.size
    x = torch.linspace(0, width - 1, columns, dtype=torch.float64)
    y = torch.linspace(0, height - 1, rows, dtype=torch.float64)
    pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)
    rays, known = truth.unproject(pixels.reshape(-1, 2))
    seen_rays, seen = camera.unproject(pixels.reshape(-1, 2))
    both = known & seen
    if int(both.sum()) < 3:
        raise InputError("error_at_infinity: the camera and the truth have no rays in common")
    rotation = rotation_between(rays[both], seen_rays[both])
    flat = pixels.reshape(-1, 2)
    errors, valid = _errors_after_turn(camera, flat, rays, known, rotation)
    for _ in range(_TURN_STEPS):
        used = valid
        slopes = []
        for axis in torch.eye(3, dtype=torch.float64):
            ends = [
                _errors_after_turn(camera, flat, rays, known, rotation_from_vector(s * _TURN_NUDGE * axis) @ rotation)
                for s in (1, -1)
            ]
            used = used & ends[0][1] & ends[1][1]
            slopes.append((ends[0][0] - ends[1][0]) / (2 * _TURN_NUDGE))
        jacobian = torch.stack([slope[used].reshape(-1) for slope in slopes], -1)
        step = torch.linalg.lstsq(jacobian, -errors[used].reshape(-1, 1)).solution[:, 0]
        rotation = rotation_from_vector(step) @ rotation
        errors, valid = _errors_after_turn(camera, flat, rays, known, rotation)
    length = torch.linalg.vector_norm(errors[valid], dim=-1)
    return InfinityError(
        rms=float(torch.sqrt((length**2).mean())),
        maximum=float(length.max()),
        rotation=rotation,
        pixels=pixels,
        errors=torch.where(valid[:, None], errors, torch.nan).reshape(pixels.shape),
        valid=float(valid.double().mean()),
    )


def _errors_after_turn(
    camera: LensLike, pixels: Tensor, rays: Tensor, known: Tensor, rotation: Tensor
) -> tuple[Tensor, Tensor]:
    found, valid = camera.project((rays @ rotation.T) * 1e9)
    return found - pixels, valid & known
