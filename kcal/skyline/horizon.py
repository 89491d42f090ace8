"""The border of sky and ground in an image, the horizon of a terrain, errors of its raster, and how they compare."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import convolve1d, median_filter, uniform_filter1d
from scipy.special import erf

from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import step_rows
from kcal.lens.projection import FAR, project_components
from kcal.lens.rig import REFRACTION, REFRACTION_SIGMA, Origin, check_refraction
from kcal.locate.geodesy import anchor, geodetic_to_ecef, mean_radius, place_enu
from kcal.locate.ground import Raster

# The border of sky and ground in an image, column by column, between pixels and with standard deviations.
#
# A dynamic program finds the topmost sharp edge that goes through the whole image; soft edges, as those of most clouds,
# weigh little. In each column a blurred step is then fitted to a few pixels around it. Columns in which that is vague
# are left out, and so are those beside a jump of the border: a pole or a tree in front.

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# Rows of the two boxes whose means are compared, and columns over which they are smoothed.
_BOX, _ACROSS = 3, 5
# An edge counts half if its step is so many standard deviations, and so many gray levels in a range of 255.
_SURE, _LEAST_STEP = 6.0, 2.0
# Columns over which the noise is taken as even.
_EVEN = 31
# Of the dynamic program: what a row of change costs, most rows between neighbors, what a longer jump costs, and what it
# costs to leave an edge of full strength in the sky.
_SLOPE, _ROWS, _JUMP, _CROSSED = 0.02, 6, 2.0, 1.5
# Rows on each side of the edge to which a step is fitted, and steps of that fit.
_REACH, _STEPS = 6, 12
# px: blur (σ) with which a fit begins, and of an edge that is no longer one.
_BLUR, _VAGUE = 1.0, 4.0
# px: a border is used if its σ is below this, and if it was found no farther from where the program put it.
_MOST_SIGMA, _MOST_MOVE = 0.5, 2.5
# px between the borders of neighboring columns that are a jump, and columns beside one that are left out.
_BREAK, _BESIDE = 4.0, 3
# Columns of the running median with which a jump is compared.
_MEDIAN = 9
# px by which texture as strong as the step moves a border: of rendered hills in haze (scripts/check/skyline.py).
_TEXTURE = 4.5
# A border is an edge of the sky if above it texture is below this share of its own step.
_ROUGH = 0.5


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Border:
    """Where the sky ends in each column of an image.

    Args:
        row: (W,) px, integer in the middle of a pixel; NaN where it is not clear.
        sigma: (W,) px, along the column, of noise and of texture beside the border.
        step: (W,) gray levels from the ground to the sky.
        size: width and height of the image.
    """

    row: Floats
    sigma: Floats
    step: Floats
    size: tuple[int, int]

    @property
    def clear(self) -> Bools:
        """(W,) whether the border is clear."""
        return np.isfinite(self.row)


def sky_border(image: NDArray[np.generic]) -> Border:
    """Find the border of sky and ground.

    Args:
        image: (H, W) gray levels, 8 or 16 bits or floats.

    Raises:
        InputError: not an image of gray levels, or one of a single brightness.

    Example:
        >>> rows = np.arange(60)[:, None] - 31.3 - 0.05 * np.arange(80)
        >>> found = sky_border(120.0 - 60.0 * np.tanh(rows) + np.random.default_rng(1).normal(0, 1, (60, 80)))
        >>> bool(found.clear.all()), float(np.abs(found.row - 31.3 - 0.05 * np.arange(80)).max()) < 0.2
        (True, True)
    """
    gray = np.asarray(image)
    if gray.ndim != 2 or min(gray.shape) < 8 * _BOX:
        raise InputError(f"an image (H, W) of gray levels is needed, got the shape {gray.shape}")
    light = gray.astype(np.float64)
    if not np.isfinite(light).all():
        raise InputError("the image has gray levels that are not finite")
    full = float(np.ptp(light))
    if full <= 0.0:
        raise InputError("the image has one gray level everywhere: there is no sky and no ground in it")
    noise = _noise(light)
    step = _row_steps(light)
    path = _on_steepest(step, _best_path(_strength(step, noise, _LEAST_STEP / 255.0 * full)))
    return _refined_border(light, path, noise)


def _noise(light: Floats) -> Floats:
    """(W,) standard deviation of the noise of the smoother half of each column's pixels, as its neighbors smooth it."""
    off = np.sort(np.abs(light[1:-1] - 0.5 * (light[:-2] + light[2:])), axis=0)
    # The mean of the smaller half, which is sky mostly: of normal values it is 0.325 σ.
    own = off[: len(off) // 2].mean(0) / (0.325 * math.sqrt(1.5))
    # Rounding to gray levels leaves 0.29 of one, even where there is no noise.
    return np.maximum(uniform_filter1d(own, _EVEN, mode="nearest"), max(0.5 * float(np.median(own)), 0.29))


def _row_steps(light: Floats) -> Floats:
    """(H, W) gray levels by which the rows above a row differ from those from there on."""
    smooth = uniform_filter1d(light, _ACROSS, axis=1, mode="nearest")
    return convolve1d(smooth, np.repeat([1.0, -1.0], _BOX) / _BOX, axis=0, mode="nearest")


def _strength(step: Floats, noise: Floats, least: float) -> Floats:
    """(H, W) between 0 and 1: how surely there is an edge above a row."""
    spread = noise * math.sqrt(2.0 / (_BOX * _ACROSS))
    scale = np.maximum(_SURE * spread, least)
    found: Floats = np.square(step) / (np.square(step) + np.square(scale))
    found[: 2 * _BOX] = found[-2 * _BOX :] = 0.0
    return found


def _on_steepest(step: Floats, path: NDArray[np.int64]) -> NDArray[np.int64]:
    """A path that runs above strong edges, which all count alike, put onto the steepest row there."""
    rows = np.clip(path[:, None] + np.arange(-1, 2 * _BOX + 1), 0, len(step) - 1)
    value = np.abs(step[rows, np.arange(len(path))[:, None]])
    return rows[np.arange(len(path)), value.argmax(1)]


def _best_path(strength: Floats) -> NDArray[np.int64]:
    """(W,) the row of the border in each column, by dynamic programming from left to right."""
    rows, columns = strength.shape
    # Edges count as crossed from half of their full strength on: many rows of noise are none. An edge spreads over the
    # rows of a box, and an own edge is crossed in part.
    sure = np.maximum(2.0 * strength - 1.0, 0.0)
    above = np.cumsum(sure, 0) - sure
    own = np.zeros_like(strength)
    own[2 * _BOX :] = above[2 * _BOX :] - above[: -2 * _BOX]
    cost = _CROSSED / _BOX * (above - own) - strength
    shifts = np.arange(-_ROWS, _ROWS + 1)
    total, back = cost[:, 0], np.zeros((columns, rows), np.int64)
    everywhere = np.arange(rows)
    for column in range(1, columns):
        padded = np.pad(total, _ROWS, constant_values=np.inf)
        around = np.lib.stride_tricks.sliding_window_view(padded, 2 * _ROWS + 1) + _SLOPE * np.abs(shifts)
        pick = around.argmin(1)
        least, origin = around[everywhere, pick], everywhere + shifts[pick]
        far = int(total.argmin())
        jump = total[far] + _JUMP < least
        total = np.where(jump, total[far] + _JUMP, least) + cost[:, column]
        back[column] = np.where(jump, far, origin)
    path = np.empty(columns, np.int64)
    path[-1] = int(total.argmin())
    for column in range(columns - 1, 0, -1):
        path[column - 1] = back[column, path[column]]
    return path


def _refined_border(light: Floats, path: NDArray[np.int64], noise: Floats) -> Border:
    """A blurred step in each column around the path."""
    rows, columns = light.shape
    inside = (path >= 2 * _BOX + 1) & (path < rows - 2 * _BOX - 1)
    offset = np.arange(-_REACH, _REACH)
    at = (offset + 0.5).astype(np.float64)
    # An edge between the rows path - 1 and path stands at path - 0.5.
    index = np.clip(path[:, None] + offset, 0, rows - 1)
    value = light[index, np.arange(columns)[:, None]]
    blur: Floats = np.full(columns, _BLUR)
    for own_blur in (True, False):
        place, step, width, variance, left = _fit_steps(at, value, blur, own_blur=own_blur)
        good = inside & (np.abs(place) < _MOST_MOVE) & (np.abs(step) > _SURE * noise)
        if own_blur:
            # A lens has one blur, and a slanting edge a wider one.
            slope = np.gradient(median_filter(path.astype(np.float64), _MEDIAN, mode="nearest"))
            slant = np.sqrt(1.0 + np.square(slope))
            usual = float(np.median(width[good] / slant[good])) if good.any() else _BLUR
            vague = width > min(3.0 * usual, _VAGUE) * slant
            blur = np.clip(usual, 0.3, _VAGUE) * slant
    # Texture beside the border is no white noise: what it does to the fit is like a step of its own close by.
    texture = np.sqrt(np.maximum(np.square(left) - np.square(noise), 0.0))
    sigma = np.sqrt(variance * np.square(noise) + np.square(_TEXTURE * texture / np.maximum(np.abs(step), 1e-9)))
    # Above the border is sky: what differs there from one brightness is small beside the step.
    rough = np.std(light[np.clip(path[:, None] - np.arange(4, 4 + 2 * _REACH), 0, rows - 1),
                         np.arange(columns)[:, None]], axis=1)  # fmt: skip
    good &= ~vague & (sigma < _MOST_SIGMA) & (rough < _ROUGH * np.abs(step) + 2.0 * noise)
    row = path - 0.5 + place
    level = median_filter(row, _MEDIAN, mode="nearest")
    trend = np.abs(np.gradient(level))
    jump = np.abs(np.diff(row, prepend=row[0]))
    broken = (np.abs(row - level) > _BREAK + _MEDIAN * trend) | (jump > _BREAK + 2 * trend)
    good &= uniform_filter1d(broken.astype(np.float64), 2 * _BESIDE + 1, mode="nearest") < 0.5 / (2 * _BESIDE + 1)
    row, sigma = (np.where(good, values, np.nan) for values in (row, sigma))
    return Border(row=row, sigma=sigma, step=step, size=(columns, rows))


def _fit_steps(
    at: Floats, value: Floats, blur: Floats, *, own_blur: bool
) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Fit m - c erf((x - x0) / (√2 s)) to values (W, K) at places (K,): x0, step 2 c, s, variance of x0, residual.

    The variance is for residuals of one gray level; the residual is the root of their mean square.
    """
    count = 4 if own_blur else 3
    half = len(at) // 2
    middle = 0.5 * (value[:, :half].mean(1) + value[:, half:].mean(1))
    height = 0.5 * (value[:, :half].mean(1) - value[:, half:].mean(1))
    place, width = np.zeros(len(value)), blur.copy()
    for _ in range(_STEPS):
        z = (at - place[:, None]) / width[:, None]
        shape = erf(z / math.sqrt(2.0))
        bell = math.sqrt(2.0 / math.pi) * np.exp(-0.5 * np.square(z))
        by = [np.ones_like(z), -shape, height[:, None] * bell / width[:, None]]
        if own_blur:
            by.append(height[:, None] * bell * z / width[:, None])
        rows = np.stack(by, -1)
        off = value - middle[:, None] + height[:, None] * shape
        normal = rows.transpose(0, 2, 1) @ rows
        scale = np.sqrt(np.maximum(np.einsum("wii->wi", normal), 1e-9))
        normal = normal / (scale[:, :, None] * scale[:, None]) + 1e-6 * np.eye(count)
        step = np.linalg.solve(normal, (rows.transpose(0, 2, 1) @ off[..., None]) / scale[..., None])[..., 0] / scale
        middle, height = middle + step[:, 0], height + step[:, 1]
        place = np.clip(place + np.clip(step[:, 2], -1.0, 1.0), -_REACH, _REACH)
        if own_blur:
            width = np.clip(width + np.clip(step[:, 3], -0.5, 0.5), 0.3, 2.0 * _VAGUE)
    inverse = np.linalg.inv(normal)[:, 2, 2] / np.square(scale[:, 2])
    left = np.sqrt(np.square(off).sum(1) / max(len(at) - count, 1))
    return place, 2.0 * height, width, inverse, left


# The horizon of a terrain, errors of its raster, and how it compares with the border that an image shows.

# Errors that a skyline has beside the noise of the image: of the raster's heights, and of light's refraction.


@dataclasses.dataclass(frozen=True, kw_only=True)
class RasterError:
    """How well the heights of a raster, and the bending of light, are known.

    Errors of neighboring heights are alike: with the correlation exp(-d / `correlation`) over the distance d. So
    a hundred columns that look at one ridge are not a hundred measurements of it, and more images do not help.

    Args:
        sigma: meters, of a height. Copernicus GLO-30 states 4 m at 90 % for all its errors, 2.2 m with `offset`.
        correlation: meters.
        offset: meters, of all heights together: datum, geoid, the height of what grows there.
        refraction: coefficient k.
        refraction_sigma: its standard deviation.

    Raises:
        InputError: sigmas that are negative, or a correlation that is not positive.

    Example:
        >>> lidar = RasterError(sigma=0.3, correlation=50.0, offset=0.1)
        >>> lidar.heights(np.array([[0.0, 0, 0], [50.0, 0, 0]])).round(3).tolist()
        [[0.1, 0.043], [0.043, 0.1]]
    """

    sigma: float = 2.0
    correlation: float = 150.0
    offset: float = 1.0
    refraction: float = REFRACTION
    refraction_sigma: float = REFRACTION_SIGMA

    def __post_init__(self) -> None:
        for name in ("sigma", "offset"):
            if not 0.0 <= getattr(self, name) < np.inf:
                raise InputError(f"raster {name} {getattr(self, name)}: meters, not below 0, are needed")
        if not 0.0 < self.correlation < np.inf:
            raise InputError(f"raster correlation {self.correlation}: a positive number of meters is needed")
        check_refraction(self.refraction, self.refraction_sigma)

    def heights(self, points: Floats, blunted: Floats | float = 0.0) -> Floats:
        """(M, M) m², covariance of the raster's heights at places (M, 3) of one frame, meters.

        With `blunted` (M,) meters, by which cells lower a crest, that is one more standard deviation.
        """
        level = points[:, :2]
        apart = np.hypot(*(level[:, None] - level).transpose(2, 0, 1))
        own = np.hypot(np.broadcast_to(self.sigma, len(points)), blunted)
        return own[:, None] * own * np.exp(-apart / self.correlation) + self.offset**2

    def alike(self, distance: Floats, spacing: Floats) -> Floats:
        """(M,) how many columns share one error of the raster: columns `spacing` radians apart that see `distance`."""
        return np.maximum(2.0 * self.correlation / np.maximum(distance * spacing, 1e-9), 1.0)


class SkylineErrors(NamedTuple):
    """All errors of a skyline but the image's noise.

    Attributes:
        raster: of heights and refraction.
        place: (3,) meters, sigma of the camera's place, east, north, up.
        lens: (P, K) changes of the camera's parameters at one sigma of what its calibration does not know.
        radius: of the Earth, meters.
    """

    raster: RasterError
    place: Floats
    lens: Floats
    radius: float


# The horizon of a terrain from one place: how high it stands in each azimuth, and how far away.
#
# Along each azimuth the ground is sampled in half cells. Places of samples are smooth functions of the distance, so
# they are computed exactly in a few distances and joined by a polynomial; heights are the raster's own, interpolated
# between the middles of its cells, not those of a second grid.


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
        raised: (A,) radians by which errors of the raster change it on average; see `kcal.skyline.attitude`.
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
        refraction: coefficient k: light from the horizontal distance d comes from k d² / 2R too high.

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
    # On a slope of one, a place may be below the raster's ground by a quarter of a cell.
    if eye.height < ground - max(5.0, 0.25 * raster.cell_m):
        raise InputError(
            f"the camera stands {ground - eye.height:.1f} m below the raster's ground; is its height above the "
            "ellipsoid, as the raster's is? The height of the geoid (--geoid) is added to a raster of heights above "
            "the sea"
        )
    rays = TerrainRays(raster, eye, refraction)
    distance = sample_distances(raster, rays)
    each = max(_SAMPLES // len(distance), 1)
    parts = [_highest(rays, azimuth[i : i + each], distance) for i in range(0, len(azimuth), each)]
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


class TerrainRays:
    """Heights, places and slopes along azimuths from an eye."""

    def __init__(self, raster: Raster, eye: Origin, refraction: float) -> None:
        self.raster, self.eye = raster, eye
        self.radius = mean_radius(eye.lat)
        self.bending = refraction / (2.0 * self.radius)
        self.farthest = raster.farthest(geodetic_to_ecef(eye.geodetic), _FARTHEST)
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
        """Elevation as a slope (A, S), horizontal distance (A, S) and height over the ellipsoid at distances."""
        column, row, *_ = np.moveaxis(self.joined(nodes[:, :2], distance), 1, 0)
        height = self.raster.between(column, row)
        point = self.points(nodes, distance, height)
        level = np.hypot(point[..., 0], point[..., 1])
        return point[..., 2] / level + self.bending * level, level, height

    def points(self, nodes: Floats, distance: Floats, height: Floats) -> Floats:
        """(A, S, 3) where heights at distances stand, east, north, up of the eye."""
        place = self.joined(nodes[:, 2:], distance)
        return np.moveaxis(place[:, :3] + height[:, None] * place[:, 3:], 1, 2)


def _chebyshev_weights(nodes: Floats, at: Floats) -> Floats:
    """Weights (..., K, S) of values at Chebyshev nodes for the polynomial through them, at places (..., S)."""
    count = len(nodes)
    factor = (-1.0) ** np.arange(count) * np.sin(math.pi * (np.arange(count) + 0.5) / count)
    off = at[..., None, :] - nodes[:, None]
    part = factor[:, None] / np.where(off == 0.0, 1e-9, off)
    return part / part.sum(-2, keepdims=True)


def _highest(rays: TerrainRays, azimuth: Floats, distance: Floats) -> tuple[Floats, Floats, Floats, Bools, Floats]:
    """Elevation, horizontal distance, point, whether it is a horizon, and reach of the raster, of some azimuths."""
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


# Compare the border of an image with the horizon of a terrain: residuals in pixels and how they change.


class Columns(NamedTuple):
    """Clear columns of a border with their rays.

    Attributes:
        pixel: (N, 2).
        sigma: (N,) px, along the column.
        ray: (N, 3) unit vectors in the camera's axes.
    """

    pixel: Floats
    sigma: Floats
    ray: Floats

    def some(self, chosen: Bools | NDArray[np.int64]) -> Columns:
        """Some of them."""
        return Columns(*(part[chosen] for part in self))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Comparison:
    """Residuals of columns across the skyline, positive where the image's is above the raster's.

    Args:
        residual: (N,) px.
        sigma: (N,) px, of the image.
        by_turn: (N, 3) derivatives by a turn about the camera's axes, which comes after the rotation.
        by_elevation: (N,) by a higher horizon, px/rad.
        by_shift: (N, 3) by a camera that stands elsewhere, px/m, along east, north, up of the eye.
        by_lens: (N, P) by the parameters of the camera; none if they were not asked for.
        elevation: (N,) radians, of the horizon.
        distance: (N,) level meters to it.
        point: (N, 3) meters, where it stands from the eye.
        raised: (N,) radians by which errors of the raster change it on average.
        blunted: (N,) meters by which its cells may have lowered it.
        known: (N,) whether the raster has a horizon there.
    """

    residual: Floats
    sigma: Floats
    by_turn: Floats
    by_elevation: Floats
    by_shift: Floats
    by_lens: Floats
    elevation: Floats
    distance: Floats
    point: Floats
    raised: Floats
    blunted: Floats
    known: Bools

    @classmethod
    def together(cls, parts: Sequence[Comparison]) -> Comparison:
        """Columns of several images after each other, without derivatives by their lenses."""
        names = [field.name for field in dataclasses.fields(cls) if field.name != "by_lens"]
        found = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return cls(**found, by_lens=np.zeros((len(found["residual"]), 0)))

    def by_height(self) -> Floats:
        """(N,) by the raster's height there, px/m."""
        return self.by_elevation * np.square(np.cos(self.elevation)) / self.distance

    def by_refraction(self, radius: float) -> Floats:
        """(N,) by the coefficient of refraction, px, over the Earth's radius in meters."""
        return self.by_elevation * self.distance / (2.0 * radius)


def compare(columns: Columns, horizon: Horizon, rotation: Floats, camera: Camera, *, lens: bool = False) -> Comparison:
    """Compare borders with a horizon.

    Args:
        columns: of the border.
        horizon: in the axes of the eye.
        rotation: (3, 3) the camera's axes from east, north, up of the eye.
        camera: which lens.
        lens: also find derivatives by its parameters.
    """
    heading = columns.ray @ rotation
    step = horizon.azimuth[1] - horizon.azimuth[0]
    begin = horizon.azimuth[0]
    azimuth = begin + np.remainder(np.arctan2(heading[:, 0], heading[:, 1]) - begin, 2.0 * math.pi)
    at = (azimuth - begin) / step
    left = np.clip(np.floor(at), 0, len(horizon.azimuth) - 2).astype(int)
    share = at - left
    inside = (share >= 0.0) & (share <= 1.0)
    share = np.clip(share, 0.0, 1.0)
    elevation = (1.0 - share) * horizon.elevation[left] + share * horizon.elevation[left + 1]
    slope = (horizon.elevation[left + 1] - horizon.elevation[left]) / step
    near = left + (share > 0.5)
    known = inside & horizon.known[left] & horizon.known[left + 1] & np.isfinite(elevation)
    elevation = np.where(known, elevation, np.arcsin(np.clip(heading[:, 2], -1.0, 1.0)))
    slope = np.where(known, slope, 0.0)
    sine, cosine, low, up = np.sin(azimuth), np.cos(azimuth), np.cos(elevation), np.sin(elevation)
    toward = np.stack([sine * low, cosine * low, up])
    by_azimuth = np.stack([cosine * low, -sine * low, 0.0 * low])
    by_elevation = np.stack([-sine * up, -cosine * up, low])
    turned = torch.from_numpy(FAR * rotation @ toward)
    wanted = range(camera.params.shape[-1]) if lens else ()
    seen = project_components(turned, camera.params.detach(), camera.model, wanted)
    known &= seen.regular.numpy()
    off = columns.pixel.T - seen.pixels.numpy()
    # (3, 2, N) of pixels by a direction in east, north, up.
    by_toward = np.einsum("jk,jun->kun", FAR * rotation, seen.by_point.numpy())

    def moved(direction: Floats) -> Floats:
        return np.einsum("kun,kn->un", by_toward, direction)

    # Across the skyline as the camera sees it, and upwards.
    along, higher = moved(by_azimuth + slope * by_elevation), moved(by_elevation)
    across = np.stack([along[1], -along[0]]) / np.maximum(np.hypot(*along), 1e-12)
    across = across * np.where((across * higher).sum(0) < 0.0, -1.0, 1.0)

    def of(motion: Floats) -> Floats:
        return -np.einsum("...un,un->n...", motion, across)

    # A column's border has its error along the column.
    distance = np.where(known, horizon.distance[near], 1.0)
    # A camera farther in the east, north, up sees what stands still turned and lower, and what it nears higher.
    aside = (-cosine, sine, np.zeros_like(sine))
    risen = (low * up * sine, low * up * cosine, -np.square(low))
    shift = [(by_azimuth * a + by_elevation * e) / distance for a, e in zip(aside, risen, strict=True)]
    return Comparison(
        residual=(off * across).sum(0),
        sigma=columns.sigma * np.abs(across[1]),
        by_turn=of(step_rows(seen.by_point, turned)[:3].numpy()),
        by_elevation=of(higher),
        by_shift=np.stack([of(moved(one)) for one in shift], -1),
        by_lens=of(seen.by_camera.numpy()) if lens else np.zeros((len(azimuth), 0)),
        elevation=elevation,
        distance=distance,
        point=np.where(known[:, None], horizon.point[near], 0.0),
        raised=horizon.raised[near],
        blunted=horizon.blunted[near],
        known=known,
    )


def columns_of(row: Floats, sigma: Floats, camera: Camera) -> Columns:
    """Clear columns of a border (W,), those with a ray."""
    clear = np.isfinite(row)
    pixel = np.stack([np.flatnonzero(clear).astype(np.float64), row[clear]], -1)
    rays, valid = camera.unproject(torch.from_numpy(pixel))
    return Columns(pixel, sigma[clear], rays.numpy()).some(valid.numpy())
