"""The horizon of a terrain from one place: how high it stands in each azimuth, and how far away.

Along each azimuth the ground is sampled in half cells. Places of samples are smooth functions of the distance, so they
are computed exactly in a few distances and joined by a polynomial; heights are the raster's own, interpolated between
the middles of its cells, not those of a second grid.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from kcal.errors import InputError
from kcal.lens.mounting import REFRACTION, Origin
from kcal.locate.ellipsoid import geodetic_to_ecef, mean_radius
from kcal.locate.geodesy import anchor, place_enu
from kcal.locate.raster import Raster

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Distances between which places are joined by a polynomial: within 200 km that errs by less than a millimeter.
_NODES = 14
# Samples of the ground that are held at a time.
_SAMPLES = 3_000_000
# Meters: nothing on the Earth is a horizon beyond.
_FARTHEST = 300_000.0
# Cells: the ground nearer than this is no horizon, and one whose highest sample is as near to the raster's end as
# this is cut off by it.
_NEAREST, _EDGE = 2.0, 2.0
# Samples between two half cells, where the highest one has been found.
_FINE = 16


class Horizon(NamedTuple):
    """The horizon from an eye, in east, north, up of that eye.

    Attributes:
        azimuth: (A,) radians clockwise from north, increasing.
        elevation: (A,) radians at which it is seen, light being bent; NaN where nothing is known.
        distance: (A,) level meters to it.
        point: (A, 3) meters, where it truly stands.
        known: (A,) whether it is one: not where the raster ends before it falls away, or has cells without a height on
            the way.
        reach: (A,) meters to which the raster is known.
        doubtful: (A,) whether ground as high as the raster's highest, just beyond `reach`, would stand above it.
        raised: (A,) radians by which errors of the raster change it on average; see `kcal.skyline.raised`.
        blunted: (A,) meters by which it stands lower in a raster with cells of twice the size.
    """

    azimuth: Floats
    elevation: Floats
    distance: Floats
    point: Floats
    known: Bools
    reach: Floats
    doubtful: Bools
    raised: Floats
    blunted: Floats


def terrain_horizon(raster: Raster, eye: Origin, azimuth: Floats, *, refraction: float = REFRACTION) -> Horizon:
    """Find how high the horizon of a terrain stands in some azimuths.

    Args:
        raster: of heights above the ellipsoid, from `kcal.locate.terrain`.
        eye: where the camera is.
        azimuth: (A,) radians clockwise from north, increasing.
        refraction: coefficient k: light from the level distance d comes from k d² / 2R too high.

    Raises:
        InputError: the eye is outside the raster, or below its ground.

    Example:
        >>> heights = np.zeros((600, 600))  # a plain at sea level, in cells of 0.002 degrees
        >>> raster = Raster(heights, (500, 0, -2700, 0, -500, 22800), None, 157.0)
        >>> seen = terrain_horizon(raster, Origin(lat=45.0, lon=6.0, height=50.0), np.array([0.0]))
        >>> seen.elevation.round(4).tolist(), (seen.distance / 1000).round().tolist(), seen.known.tolist()
        ([-0.0037], [27.0], [True])
    """
    ground = float(raster(*(torch.tensor([value], dtype=torch.float64) for value in (eye.lat, eye.lon)))[0])
    if math.isnan(ground):
        raise InputError(
            f"the raster has no height at the camera's place ({eye.lat:.5f}, {eye.lon:.5f}); give one that reaches "
            "all around the camera"
        )
    if eye.height < ground - _depth(raster):
        raise InputError(
            f"the camera stands {ground - eye.height:.1f} m below the raster's ground; is its height above the "
            "ellipsoid, as the raster's is? The height of the geoid (--geoid) is added to a raster of heights above "
            "the sea"
        )
    rays = TerrainRays(raster, eye, refraction)
    distance = sample_distances(raster, rays)
    parts = []
    each = max(_SAMPLES // len(distance), 1)
    for begin in range(0, len(azimuth), each):
        parts.append(_highest(rays, azimuth[begin : begin + each], distance))
    elevation, far, point, known, reach = (np.concatenate(part) for part in zip(*parts, strict=True))
    highest = float(np.nanmax(raster.heights))
    curve = (1.0 - refraction) / (2.0 * rays.radius)
    beyond = np.arctan((highest - eye.height) / reach - curve * reach)
    nothing = np.zeros(len(azimuth))
    return Horizon(azimuth, elevation, far, point, known, reach, known & (beyond > elevation), nothing, nothing)


def sample_distances(raster: Raster, rays: TerrainRays) -> Floats:
    """(S,) meters, half a cell apart, at which the ground is sampled."""
    step = 0.5 * raster.cell_m
    return np.arange(_NEAREST * raster.cell_m, rays.farthest + step, step)


def _depth(raster: Raster) -> float:
    """Meters by which a place may be below the raster's ground: on a slope of one, a quarter of a cell."""
    return max(5.0, 0.25 * raster.cell_m)


class TerrainRays:
    """Heights, places and slopes along azimuths from an eye."""

    def __init__(self, raster: Raster, eye: Origin, refraction: float) -> None:
        self.raster, self.eye = raster, eye
        self.radius = mean_radius(eye.lat)
        self.bending = refraction / (2.0 * self.radius)
        self.farthest = min(_farthest(raster, eye), _FARTHEST)
        self._place = anchor(eye)
        self._nodes = 0.5 * self.farthest * (1.0 - np.cos(math.pi * (np.arange(_NODES) + 0.5) / _NODES))

    def along(self, azimuth: Floats) -> Floats:
        """(A, 8, K) at the nodes: column, row, foot on the ellipsoid (3) and its normal (3), axes of the eye."""
        aim = np.stack([np.sin(azimuth), np.cos(azimuth)], -1)
        level = aim[:, None] * self._nodes[:, None]
        drop = -self.eye.height - np.square(self._nodes) / (2.0 * self.radius)
        enu = torch.from_numpy(np.concatenate([level, np.broadcast_to(drop[:, None], (*level.shape[:2], 1))], -1))
        geodetic = place_enu(enu, *self._place)
        lat, lon = geodetic[..., 0], geodetic[..., 1]
        rotation, center = self._place
        foot, above = (
            (geodetic_to_ecef(torch.stack([lat, lon, torch.full_like(lat, height)], -1)) - center) @ rotation
            for height in (0.0, 1000.0)
        )
        cells = np.stack(self.raster.cells(lat.numpy(), lon.numpy()), -1)
        return np.moveaxis(np.concatenate([cells, foot.numpy(), (above - foot).numpy() / 1000.0], -1), 1, 2)

    def joined(self, nodes: Floats, distance: Floats) -> Floats:
        """Values (A, V, K) at the nodes, at distances (S,) of all azimuths or (A, S) of each: (A, V, S)."""
        weight = _chebyshev_weights(self._nodes, distance)
        return nodes @ weight if weight.ndim == 2 else np.einsum("avk,aks->avs", nodes, weight)

    def seen(self, nodes: Floats, distance: Floats) -> tuple[Floats, Floats, Floats]:
        """Elevation as a slope (A, S), level distance (A, S) and height over the ellipsoid at distances."""
        column, row, *_ = np.moveaxis(self.joined(nodes[:, :2], distance), 1, 0)
        height = self.raster.between(column, row)
        point = self.points(nodes, distance, height)
        level = np.hypot(point[..., 0], point[..., 1])
        return point[..., 2] / level + self.bending * level, level, height

    def points(self, nodes: Floats, distance: Floats, height: Floats) -> Floats:
        """(A, S, 3) where heights at distances stand, east, north, up of the eye."""
        place = self.joined(nodes[:, 2:], distance)
        return np.moveaxis(place[:, :3] + height[:, None] * place[:, 3:], 1, 2)


def _farthest(raster: Raster, eye: Origin) -> float:
    """Meters to the raster's farthest corner."""
    rows, columns = raster.heights.shape
    a, b, c, d, e, f = raster.to_cell
    corner = np.array([[0, 0], [columns, 0], [0, rows], [columns, rows]], dtype=np.float64)
    xy = np.linalg.solve([[a, b], [d, e]], (corner - [c, f]).T)
    lon, lat = xy if raster.into is None else map(np.asarray, raster.into.transform(xy[0], xy[1], direction="INVERSE"))
    if not (np.isfinite(lon).all() and np.isfinite(lat).all()):
        return _FARTHEST
    geodetic = torch.from_numpy(np.stack([lat, lon, np.full(4, eye.height)], -1))
    return float(torch.linalg.vector_norm(geodetic_to_ecef(geodetic) - geodetic_to_ecef(eye.geodetic), dim=-1).max())


def _chebyshev_weights(nodes: Floats, at: Floats) -> Floats:
    """Weights (..., K, S) of values at Chebyshev nodes for the polynomial through them, at places (..., S)."""
    count = len(nodes)
    factor = (-1.0) ** np.arange(count) * np.sin(math.pi * (np.arange(count) + 0.5) / count)
    off = at[..., None, :] - nodes[:, None]
    part = factor[:, None] / np.where(off == 0.0, 1e-9, off)
    found: Floats = part / part.sum(-2, keepdims=True)
    return found


def _highest(rays: TerrainRays, azimuth: Floats, distance: Floats) -> tuple[Floats, Floats, Floats, Bools, Floats]:
    """Elevation, level distance, point, whether it is a horizon, and reach of the raster, of some azimuths."""
    nodes, step = rays.along(azimuth), distance[1] - distance[0]
    slope, _, _ = rays.seen(nodes, distance)
    there = np.isfinite(slope)
    best = np.where(there, slope, -np.inf).argmax(-1)
    some = there.any(-1)
    # The last sample that is known; between there and the eye all should be.
    last = np.where(some, len(distance) - 1 - there[:, ::-1].argmax(-1), 0)
    gap = np.where(there.all(-1), len(distance), (~there).argmax(-1))
    known = some & (gap > best) & (best < last - 2 * _EDGE)
    fine = distance[best][:, None] + step * np.linspace(-1.0, 1.0, 2 * _FINE + 1)
    near, level, height = rays.seen(nodes, fine)
    top = np.where(np.isfinite(near), near, -np.inf).argmax(-1)
    pick = np.arange(len(azimuth)), top
    point = rays.points(nodes, fine, height)[pick]
    elevation = np.where(some, np.arctan(near[pick]), np.nan)
    reach = np.where(gap < len(distance), distance[np.maximum(np.minimum(gap, last + 1) - 1, 0)], distance[-1])
    return elevation, level[pick], point, known, reach
