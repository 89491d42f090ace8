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
    distance = sample_distances(raster, rays)
    slope, level = _seen_slopes(rays, horizon.azimuth[some], distance)
    blunt, _ = _seen_slopes(TerrainRays(raster.coarser, eye, error.refraction), horizon.azimuth[some], distance)
    lowered = _less(slope.max(1), blunt.max(1))
    # A draw differs from the horizon by errors within the top of a hill, whose samples need not be finer than a cell.
    distance, slope, level = distance[::2], slope[:, ::2], level[:, ::2]
    alike = math.exp(-(distance[1] - distance[0]) / error.correlation)
    random, total = np.random.default_rng(0), np.zeros(len(some))
    for _ in range(_DRAWS):
        noise = random.standard_normal(slope.shape)
        noise[:, 1:] *= math.sqrt(1.0 - alike**2)
        noise = error.sigma * lfilter([1.0], [1.0, -alike], noise, axis=1)
        total += (slope + noise / level).max(1)
    rise = np.maximum(_less(total / _DRAWS, slope.max(1)), 0.0)
    raised, blunted = (np.interp(horizon.azimuth, horizon.azimuth[some], one) for one in (rise, lowered))
    return horizon._replace(raised=raised, blunted=blunted * horizon.distance)


def _seen_slopes(rays: TerrainRays, azimuth: Floats, distance: Floats) -> tuple[Floats, Floats]:
    """Slopes (A, S) at which the ground is seen, -∞ where it is not known, and level distances, 1 there."""
    slope, level, _ = rays.seen(rays.along(azimuth), distance)
    known = np.isfinite(slope)
    return np.where(known, slope, -np.inf), np.where(known, level, 1.0)


def _less(one: Floats, other: Floats) -> Floats:
    """(A,) one less the other; 0 where either is not known."""
    known = np.isfinite(one) & np.isfinite(other)
    return np.where(known, one, 0.0) - np.where(known, other, 0.0)
