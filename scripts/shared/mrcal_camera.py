"""mrcal's splined lens as a camera that projects, so that one judge can take it.

The model is the documented one (mrcal.secretsauce.org/splined-models.html): u = 2 tan(θ/2) along the direction of the
point from the axis, q = f (u + Δu(u)) + c, and Δu a uniform cubic B-spline whose control points are the parameters,
row by row, both components of each side by side.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcal.corners.observations import Observations
from scripts.shared.held_out import held_out
from scripts.shared.mrcal_spline import splined
from scripts.shared.peer_lenses import fisheye

KNOTS = 8, 6
_STARTS = 1.0, 0.8, 1.25  # times the rough focal length: mrcal's first poses may be tilted the wrong way
_MARGIN = 1.5  # of the field of view: knots must reach beyond the image, whose center mrcal moves
_STEPS = 100


class SplinedCamera:
    """A lens of mrcal, from what `scripts/bench/peer_mrcal.py` prints."""

    def __init__(self, found: dict[str, Any], size: tuple[int, int], knots: tuple[int, int] = KNOTS) -> None:
        values = torch.tensor(found["intrinsics"], dtype=torch.float64)
        self.size, self._knots = size, knots
        self._focal, self._center = values[:2], values[2:4]
        self._control = values[4:].reshape(knots[1], knots[0], 2)
        self._spacing = float(found["knots"][1] - found["knots"][0])

    def _shift(self, u: Tensor) -> Tensor:
        """Δu (N, 2) at u (N, 2)."""
        total = torch.zeros_like(u)
        cells, weights = [], []
        for axis, count in enumerate(self._knots):
            place = u[:, axis] / self._spacing + 0.5 * (count - 1)
            cell = place.floor().clamp(1, count - 3)
            cells.append(cell.long())
            weights.append(_cubic(place - cell))
        for i in range(4):
            for j in range(4):
                control = self._control[cells[1] + i - 1, cells[0] + j - 1]
                total += (weights[1][i] * weights[0][j])[:, None] * control
        return total

    def project(self, points_cam: Tensor) -> tuple[Tensor, Tensor]:
        """Pixels (..., N, 2), and valid (..., N): not straight behind."""
        flat = points_cam.reshape(-1, 3)
        reach = flat.norm(dim=-1) + flat[:, 2]
        valid = reach > 1e-9 * flat.norm(dim=-1)
        u = 2.0 * flat[:, :2] / torch.where(valid, reach, 1.0)[:, None]
        pixels = self._focal * (u + self._shift(u)) + self._center
        return pixels.reshape(*points_cam.shape[:-1], 2), valid.reshape(points_cam.shape[:-1])

    def unproject(self, pixels: Tensor) -> tuple[Tensor, Tensor]:
        """Rays (..., N, 3) and valid (..., N), by iteration."""
        target = (pixels.reshape(-1, 2) - self._center) / self._focal
        u = target
        for _ in range(_STEPS):
            u = target - self._shift(u)
        quarter = 0.25 * u.square().sum(-1, keepdim=True)  # tan² of half the angle
        rays = torch.cat([u, 1.0 - quarter], -1) / (1.0 + quarter)
        valid = ((u + self._shift(u) - target).norm(dim=-1) * self._focal[0] < 0.1) & rays.isfinite().all(-1)
        return rays.reshape(*pixels.shape[:-1], 3), valid.reshape(pixels.shape[:-1])


def _cubic(x: Tensor) -> tuple[Tensor, ...]:
    """Weights of the four control points of a uniform cubic B-spline, x in the second of three cells."""
    return (1 - x) ** 3 / 6, (3 * x**3 - 6 * x**2 + 4) / 6, (-3 * x**3 + 3 * x**2 + 3 * x + 1) / 6, x**3 / 6


def splined_camera(seen: Observations, weight: Tensor) -> SplinedCamera:
    """Fit mrcal's spline to all views, started and dimensioned by OpenCV's fisheye: the best of three fits.

    Raises:
        subprocess.SubprocessError: mrcal failed.
        cv2.error: OpenCV failed.
    """
    rough = fisheye(seen)
    width, height = seen.image_size
    sides = torch.tensor([[0.0, 0.5 * height], [width - 1.0, 0.5 * height]], dtype=torch.float64)
    rays, valid = rough.unproject(sides)
    field = math.degrees(math.acos(max(-1.0, float(torch.linalg.vecdot(rays[0], rays[1])))))
    field = min(170, math.ceil(_MARGIN * field)) if bool(valid.all()) else 170
    cameras = []
    for factor in _STARTS:
        found = splined(
            f"SPLINED{KNOTS[0]}x{KNOTS[1]}", seen.pixels().numpy(), weight.numpy(), np.zeros(0, dtype=np.int64),
            size=seen.image_size, board=seen.board, focal=factor * float(rough.focal.detach()[0]), field_of_view=field,
            timeout=300,
        )  # fmt: skip
        cameras.append(SplinedCamera(found, seen.image_size))
    return min(cameras, key=lambda camera: held_out(camera, seen.board.points, seen.pixels(), weight).still)
