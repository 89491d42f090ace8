"""Kalibr's omni-radtan lens: a ray on the unit sphere, seen from a point xi behind its center, then radial terms.

It holds lenses of any width that Kalibr's pinhole models cannot. OpenCV's `omnidir` is the same lens. kcal has none
such: one that is read becomes a hybrid lens, and the note says how far it is from it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from kcal.io.foreign import named_camera
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.fitted_hybrid import hybrid_through

Array = NDArray[np.float64]
NAME = "omni-radtan"
# Starts of xi: a pinhole, a fisheye, and between them.
_STARTS = (0.0, 1.0, 2.0)
# Typical sizes of xi, and of the four coefficients of the distortion.
_SCALES = (0.1, 0.1, 0.1, 0.01, 0.01)
# Columns and rows of pixels through which a hybrid lens is laid, and those between them on which it is compared.
_GRID, _BETWEEN = (49, 37), (64, 48)
_MOST_XI = 100.0
# Pixels beyond which a lens does not stand for another.
_FAR = 0.5


def project_omni(values: Array, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Pixels (N, 2) of rays (N, 3), and whether a ray is in front of the point of view.

    Args:
        values: xi, fu, fv, pu, pv, k1, k2, p1, p2, as Kalibr orders them.
        rays: of any length.
    """
    xi, fu, fv, pu, pv, k1, k2, p1, p2 = values
    depth = rays[:, 2] + xi * np.linalg.norm(rays, axis=1)
    ahead = depth > 1e-9
    x, y = (rays[:, :2] / np.where(ahead, depth, 1.0)[:, None]).T
    r2 = x * x + y * y
    radial = 1.0 + k1 * r2 + k2 * r2 * r2
    across = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    down = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return np.stack([fu * across + pu, fv * down + pv], 1), ahead


def fit_omni(rays: Array, pixels: Array, focal: float) -> Array:
    """The nine numbers of the lens that comes nearest to pixels (N, 2) of rays (N, 3).

    Args:
        rays: of the camera.
        pixels: where it sees them.
        focal: its focal length, for a start, px.
    """
    from scipy.optimize import least_squares

    def errors(values: Array) -> Array:
        return (project_omni(values, rays)[0] - pixels).ravel()

    middle, found = pixels.mean(0), []
    for xi in _STARTS:
        length = focal * (1.0 + xi)
        start = np.array([xi, length, length, *middle, 0.0, 0.0, 0.0, 0.0])
        scales = [_SCALES[0], focal, focal, 0.1 * focal, 0.1 * focal, *_SCALES[1:]]
        found.append(least_squares(errors, start, x_scale=scales, max_nfev=200))
    best = min(found, key=lambda one: one.cost if math.isfinite(one.cost) else math.inf)
    return np.asarray(best.x, dtype=np.float64)


def omni_camera(name: str, values: Sequence[float], size: tuple[int, int]) -> tuple[Camera, str]:
    """The hybrid camera that comes nearest to such a lens over the image, and a note on how near.

    Args:
        name: of the camera.
        values: xi, fu, fv, pu, pv, k1, k2, p1, p2.
        size: (width, height).

    Raises:
        ValueError: a lens that no hybrid lens follows.
    """
    xi, fu, fv, pu, pv, *lens = map(float, values)
    if not -1.0 < xi < _MOST_XI:
        raise ValueError(f"{name}: xi is {xi:g}; from -1 to {_MOST_XI:g} is possible")
    inner = named_camera(name, (fu, fv, pu, pv), size, "opencv4", lens)

    def lines(grid: tuple[int, int]) -> tuple[torch.Tensor, torch.Tensor]:
        pixels = inner.grid(*grid).reshape(-1, 2)
        plane, seen = inner.normalize(pixels)
        square = plane.square().sum(-1)
        root = 1.0 + (1.0 - xi * xi) * square
        along = (xi + root.clamp_min(0.0).sqrt()) / (square + 1.0)
        rays = torch.cat([plane * along[:, None], (along - xi)[:, None]], -1)
        good = seen & (root > 0)
        return rays[good], pixels[good]

    rays, pixels = lines(_GRID)
    if len(rays) < _GRID[0] * _GRID[1] // 4:
        raise ValueError(f"{name}: this omni lens has no ray for most of the image")
    camera, _ = hybrid_through(rays, pixels, size)
    camera.calibration = CameraCalibration(name=name)
    rays, pixels = lines(_BETWEEN)
    seen, shown = camera.project_rays(rays)
    error = (seen - pixels)[shown].norm(dim=-1)
    rms, most = float(error.square().mean().sqrt()), float(error.max())
    if not most < _FAR:
        raise ValueError(f"{name}: no lens of kcal follows this omni lens: the nearest is {most:.2g} px off")
    covered = float(len(rays) / (_BETWEEN[0] * _BETWEEN[1]))
    rest = "" if covered == 1.0 else f"; {1.0 - covered:.1%} of the image has no ray"
    return camera, f"{name}: {NAME} became kcal's hybrid lens, RMS {rms:.2g} px, at most {most:.2g} px{rest}"
