"""How much errors of a raster, and its cells, change its horizon, because a horizon is the highest of many heights.

Errors that are independent of the terrain raise it: the highest of many wrong heights is more often one that is too
high. Cells blunt a crest that is sharper than they are, and lower it: cells of twice the size tell by how much. How
much a raster has of either, it does not say. So the horizon is not corrected: what errors of the stated size change is
one standard deviation of what all columns have in common, and what cells change is one of each crest.
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
    """A horizon with `raised`, by errors of the raster's heights on average, and `blunted`, by its cells.

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
    blunted = _blunted(rays, raster, horizon.azimuth[some])
    raised, lowered = (np.interp(horizon.azimuth, horizon.azimuth[some], one) for one in (rise, blunted))
    return horizon._replace(raised=raised, blunted=lowered * horizon.distance)


def _blunted(rays: TerrainRays, raster: Raster, azimuth: Floats) -> Floats:
    """(A,) by how much higher, as a slope, a horizon stands than with cells of twice the size."""
    rows, columns = (side // 2 for side in raster.heights.shape)
    heights = raster.heights[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean((1, 3))
    a, b, c, d, e, f = (0.5 * value for value in raster.to_cell)
    coarse = Raster(heights, (a, b, c, d, e, f), raster.into, 2.0 * raster.cell_m)
    distance, tops = sample_distances(raster, rays), []
    for one in (rays, TerrainRays(coarse, rays.eye, rays.refraction)):
        slope, _, _ = one.seen(one.along(azimuth), distance)
        tops.append(np.where(np.isfinite(slope), slope, -np.inf).max(1))
    known = np.isfinite(tops[0]) & np.isfinite(tops[1])
    sharp, blunt = (np.where(known, one, 0.0) for one in tops)
    return sharp - blunt
