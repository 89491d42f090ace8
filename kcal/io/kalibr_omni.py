"""Kalibr's omni-radtan lens: a ray on the unit sphere, seen from a point xi behind its center, then radial terms.

It holds lenses of any width that Kalibr's pinhole models cannot. kcal writes it and does not read it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
NAME = "omni-radtan"
# Starts of xi: a pinhole, a fisheye, and between them.
_STARTS = (0.0, 1.0, 2.0)
# Typical sizes of xi, and of the four coefficients of the distortion.
_SCALES = (0.1, 0.1, 0.1, 0.01, 0.01)


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
