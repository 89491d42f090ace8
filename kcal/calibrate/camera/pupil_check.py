"""Say what a fitted movement of the entrance pupil stands for, where it is larger than any lens has.

A hybrid lens may move its entrance pupil, and the views tell how far. Only near things show that, so that whatever
errs with the distance of the board can pass for it: a board of another size, one that bends from view to view, motion.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.pupil import pupil_depth

# Meters per square radian. Traced lenses of a few millimeters of focal length move by some 3 mm, and a full-frame lens
# of 150 degrees by 6 mm: ten times as much is no lens's.
_GLASS = 10 * 3e-3
# Meters. At small angles long lenses move by more than that rule says, and by less than this.
_LEAST = 10e-3
_SURE = 3.0


class CornerPupil(NamedTuple):
    """The entrance pupil of the image's farthest corner.

    Attributes:
        depth: meters by which it lies before that of the middle.
        sigma: its standard deviation.
        angle: of that corner off the optical axis, radians.
    """

    depth: float
    sigma: float
    angle: float


def corner_pupil(camera: Camera, covariance: Tensor) -> CornerPupil | None:
    """The entrance pupil of a hybrid camera; None for other lenses.

    Args:
        camera: the camera.
        covariance: (5 + P, 5 + P) of its parameters.
    """
    if not camera.model.hybrid:
        return None
    rays, valid = camera.unproject(camera.grid(17, 13).reshape(-1, 2))
    if not bool(valid.any()):
        return None
    angle = torch.acos(rays[valid][:, 2].clamp(-1.0, 1.0)).max()
    place = [camera.names.index(name) for name in ("pupil1", "pupil2")]
    slope = torch.stack([angle**2, angle**4])
    depth = pupil_depth(angle[None] ** 2, camera.params.detach()[5:])
    variance = slope @ covariance[place][:, place] @ slope
    return CornerPupil(float(depth[0]), math.sqrt(max(float(variance), 0.0)), float(angle))


def pupil_warnings(camera: Camera, covariance: Tensor) -> list[str]:
    """A warning where the entrance pupil moves by more than ten times what glass does, and by more than chance.

    Args:
        camera: the camera.
        covariance: (5 + P, 5 + P) of its parameters.
    """
    pupil = corner_pupil(camera, covariance)
    if pupil is None:
        return []
    most = max(_LEAST, _GLASS * pupil.angle**2)
    if not abs(pupil.depth) > max(most, _SURE * pupil.sigma):
        return []
    return [
        f"the fitted entrance pupil moves by {1e3 * abs(pupil.depth):.0f} mm, which no lens does ({1e3 * most:.0f} mm "
        f"at most, {math.degrees(pupil.angle):.0f}° off the axis): it stands for an error that changes with the "
        "board's distance, most likely a wrong size of the squares, a board that flexes, or motion; measure the "
        "squares, and photograph a stiff board with camera and board at rest"
    ]
