"""How much errors of a raster change its horizon on average, because a horizon is the highest of many heights.

Errors that are independent of the terrain raise it: the highest of many wrong heights is more often one that is too
high. A raster that is smoother than the terrain has its ridges too low instead. Which of both a raster is, it does not
say. So the horizon is not corrected; the change that errors of the stated size make is one standard deviation of what
all columns have in common.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from kcal.lens.mounting import Origin
from kcal.locate.raster import Raster
from kcal.skyline.horizon import Horizon, TerrainRays, sample_distances
from kcal.skyline.raster_error import RasterError

Floats = NDArray[np.float64]

# Azimuths for which errors are drawn, and draws for each.
_AZIMUTHS, _DRAWS = 96, 24


def raised_horizon(horizon: Horizon, raster: Raster, eye: Origin, error: RasterError) -> Horizon:
    """A horizon with its `raised`: radians by which errors of the raster's heights raise it on average.

    Args:
        horizon: from `terrain_horizon`.
        raster: it was found in.
        eye: where the camera is.
        error: of the raster; errors along a ray have the correlation exp(-d / `correlation`).
    """
    some = np.unique(np.linspace(0, len(horizon.azimuth) - 1, _AZIMUTHS).round().astype(int))
    rays = TerrainRays(raster, eye, error.refraction)
    # A draw differs from the horizon by errors within the top of a hill, whose samples need not be finer than a cell.
    distance = sample_distances(raster, rays)[::2]
    slope, level, _ = rays.seen(rays.along(horizon.azimuth[some]), distance)
    slope, level = np.where(np.isfinite(slope), slope, -np.inf), np.where(np.isfinite(level), level, 1.0)
    alike = math.exp(-(distance[1] - distance[0]) / error.correlation)
    random, total = np.random.default_rng(0), np.zeros(len(some))
    for _ in range(_DRAWS):
        noise = random.standard_normal(slope.shape)
        noise[:, 1:] *= math.sqrt(1.0 - alike**2)
        noise = error.sigma * lfilter([1.0], [1.0, -alike], noise, axis=1)
        total += (slope + noise / level).max(1)
    rise = np.maximum(total / _DRAWS - slope.max(1), 0.0)
    rise = np.where(np.isfinite(rise), rise, 0.0)
    return horizon._replace(raised=np.interp(horizon.azimuth, horizon.azimuth[some], rise))
