"""Attitude from skylines in simulation: errors over their σ, coverage, what trees and wrong statements do.

Images of a sky over a terrain whose height is known everywhere, for absolute attitude from skylines.

The terrain is a sum of smooth random fields, so that the true horizon of every column of an image is computed from the
heights themselves, and a raster of them has whatever cells and errors are asked for.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from dataclasses import dataclass
from statistics import NormalDist
from typing import Any, NamedTuple

import numpy as np
import pyproj
import torch
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from torch import Tensor

from kcal import Camera, KcalError, MeasuredPosition, Origin, RigData, calibrate_camera, solve_rig
from kcal.calibrate.rig.result import RigResult
from kcal.lens.pose import step_rows
from kcal.lens.projection import project_components
from kcal.locate import enu_from_cam, enu_to_geodetic
from kcal.locate.ground import Raster
from kcal.rig import RasterError, SkylineImage, skyline_attitude, skyline_source
from kcal.sim.captures import drawn_lens
from kcal.sim.coast import exposed, smooth_noise
from kcal.sim.raytrace import SURVEILLANCE
from kcal.sim.truth import TruthLens
from scripts.shared.captures import as_camera, capture
from scripts.shared.page import NOT_KEPT, Kept, Lines, section, timed

EARTH = 6_371_000.0
# Meters: wavelength of each field of a terrain, and its share of the height; the first have ridges.
_WAVES = tuple((wave, (wave / 5_000.0) ** 0.9) for wave in (7_000.0, 3_100.0, 1_500.0, 700.0, 330.0, 150.0, 70.0, 40.0))
_RIDGED = 3
_SKY = 190.0


@dataclass(frozen=True, kw_only=True)
class Hills:
    """A terrain.

    Args:
        seed: of its shape.
        relief: meters: about the height of its hills.
        level: meters above the ellipsoid.
        clear: meters around the origin in which it is level, where a camera stands.
        far: meters from the origin at which the hills end before a plain, so that nothing beyond is seen.
        trees: meters: height of woods that no raster of the ground has.
        woods: share of the terrain with trees.
    """

    seed: int
    relief: float = 500.0
    level: float = 200.0
    clear: float = 1_500.0
    far: float = 13_000.0
    trees: float = 0.0
    woods: float = 0.0

    def ground(self, east: Floats, north: Floats) -> Floats:
        """Meters above the ellipsoid."""
        random = np.random.default_rng([self.seed, 11])
        total = np.zeros(np.broadcast(east, north).shape)
        for number, (wave, share) in enumerate(_WAVES):
            dx, dy, turn = *random.uniform(0.0, 250.0, 2), random.uniform(0.0, math.pi)
            across, along = math.cos(turn), math.sin(turn)
            x, y = (east * across + north * along) / wave + dx, (north * across - east * along) / wave + dy
            value = smooth_noise(x, y, 1)
            if number < _RIDGED:
                value = 0.7 - 2.0 * np.sqrt(np.square(value) + 0.002)
            total = total + share * value
        away = np.hypot(east, north)
        rise = np.clip(away / self.clear - 1.0, 0.0, None)
        fall = 1.0 / (1.0 + np.exp(np.clip((away - self.far) / 300.0, -50.0, 50.0)))
        return self.level + self.relief * (1.0 + total) * fall * rise / (1.0 + rise)

    def seen(self, east: Floats, north: Floats) -> Floats:
        """Meters above the ellipsoid of what stands there, trees included."""
        ground = self.ground(east, north)
        if not self.trees:
            return ground
        random = np.random.default_rng([self.seed, 13])
        dx, dy = random.uniform(0.0, 250.0, 2)
        where = smooth_noise(east / 700.0 + dx, north / 700.0 + dy, 2)
        # Values of the noise spread by about a third.
        wood = 1.0 / (1.0 + np.exp(-40.0 * (where - 0.33 * NormalDist().inv_cdf(1.0 - self.woods))))
        return ground + self.trees * wood * (1.0 + 0.15 * smooth_noise(east / 9.0, north / 9.0, 2))


@dataclass(frozen=True, kw_only=True)
class HillWeather:
    """How clear the air is, and how an image is taken.

    Args:
        haze: meters in which a contrast falls to 1/e.
        refraction: coefficient k of light.
        clouds: share of their contrast.
        noise: sigma of the sensor's noise, gray levels.
        blur: sigma of the optics' blur, px.
        light: of 1 by day.
        seed: of clouds and noise.
    """

    haze: float = 15_000.0
    refraction: float = 0.13
    clouds: float = 0.4
    noise: float = 1.5
    blur: float = 0.7
    light: float = 1.0
    seed: int = 0


class Skyline(NamedTuple):
    """What a camera sees of a terrain.

    Attributes:
        image: (H, W) gray levels.
        azimuth: (A,) radians.
        elevation: (A,) radians of the true horizon, refracted.
        distance: (A,) meters to it.
    """

    image: NDArray[np.uint8]
    azimuth: Floats
    elevation: Floats
    distance: Floats


def skyline_image(
    hills: Hills,
    lens: TruthLens | Camera,
    enu_from_cam: Tensor,
    eye: Floats,
    air: HillWeather,
    *,
    farthest: float = 20_000.0,
) -> Skyline:
    """Render a terrain as a camera sees it.

    Args:
        hills: the terrain, whose heights are above a sphere that touches the plane of `eye` at its origin.
        lens: the camera.
        enu_from_cam: (3, 3) its attitude.
        eye: (3,) east, north and height above the sphere, meters.
        air: the weather.
        farthest: meters at which the terrain ends.

    Example:
        >>> from kcal.sim.captures import drawn_lens
        >>> look = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]).double()  # to the north
        >>> from kcal.sim.raytrace import SURVEILLANCE
        >>> lens = drawn_lens(SURVEILLANCE, 1.0, 1, focal_mm=4.64, scale=0.25)
        >>> seen = skyline_image(Hills(seed=1), lens, look, np.array([0.0, 0, 220]), HillWeather(), farthest=5e3)
        >>> seen.image.shape, bool(seen.elevation.max() > 0.02)
        ((270, 480), True)
    """
    azimuth, elevation = _pixel_angles(lens, enu_from_cam)
    low, high = float(azimuth.min()), float(azimuth.max())
    table = np.linspace(low, high, 2 * azimuth.shape[1])
    distance, slope = _sampled_slopes(hills, eye, table, air, farthest)
    tops = np.maximum.accumulate(slope, 1)
    top, far = _exact_tops(hills, eye, table, distance, slope, air)
    # Height over the horizon in pixels, by its slope in the image.
    above = elevation - np.interp(azimuth, table, top)
    steep = np.hypot(*np.gradient(above))
    share = np.clip(0.5 + above / np.maximum(steep, 1e-9), 0.0, 1.0)
    random = np.random.default_rng([air.seed, 17])
    sky = _sky_light(azimuth, elevation, air, random.uniform(0.0, 200.0))
    land = _land(hills, eye, azimuth, elevation, table, distance, tops, sky, air)
    light = air.light * (share * sky + (1.0 - share) * land)
    return Skyline(exposed(light, air.blur, air.noise, random), table, top, far)


def _pixel_angles(lens: TruthLens | Camera, enu_from_cam: Tensor) -> tuple[Floats, Floats]:
    """(H, W) azimuth, without a jump, and elevation of every pixel, from a grid of them."""
    width, height = lens.size
    x, y = (np.linspace(0.0, size - 1.0, max(size // 12, 24)) for size in (width, height))
    grid = torch.from_numpy(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
    rays, valid = lens.unproject(grid)
    if not bool(valid.all()):
        raise ValueError("a lens that covers its image is needed")
    heading = rays @ enu_from_cam.T
    ahead = enu_from_cam[:, 2]
    middle = math.atan2(float(ahead[0]), float(ahead[1]))
    azimuth = torch.atan2(heading[:, 0], heading[:, 1]) - middle
    azimuth = torch.remainder(azimuth + math.pi, 2.0 * math.pi) - math.pi
    elevation = torch.atan2(heading[:, 2], torch.hypot(heading[:, 0], heading[:, 1]))
    columns, rows = np.arange(width), np.arange(height)
    found = [
        RectBivariateSpline(y, x, part.numpy().reshape(len(y), len(x)))(rows, columns) for part in (azimuth, elevation)
    ]
    return found[0] + middle, found[1]


def _sampled_slopes(
    hills: Hills, eye: Floats, azimuth: Floats, air: HillWeather, farthest: float
) -> tuple[Floats, Floats]:
    """Distances (S,) and the tangent of the elevation (A, S) of the terrain there."""
    distance = np.concatenate([np.geomspace(30.0, 1_500.0, 80)[:-1], np.arange(1_500.0, farthest, 12.0)])
    return distance, _slope_at(hills, eye, azimuth[:, None], distance, air)


def _slope_at(hills: Hills, eye: Floats, azimuth: Floats, distance: Floats, air: HillWeather) -> Floats:
    east, north = eye[0] + distance * np.sin(azimuth), eye[1] + distance * np.cos(azimuth)
    radius = EARTH + hills.seen(east, north)
    turn = distance / EARTH
    level, up = radius * np.sin(turn), radius * np.cos(turn) - EARTH - eye[2]
    slope: Floats = up / level + air.refraction * level / (2.0 * EARTH)
    return slope


def _exact_tops(
    hills: Hills, eye: Floats, azimuth: Floats, distance: Floats, slope: Floats, air: HillWeather
) -> tuple[Floats, Floats]:
    """Elevation of the horizon and meters to it, from samples a meter apart around the highest ones."""
    best = slope.argmax(1)
    off = np.linspace(-14.0, 14.0, 29)
    near = np.maximum(distance[best][:, None] + off, 1.0)
    fine = _slope_at(hills, eye, azimuth[:, None], near, air)
    pick = np.arange(len(azimuth)), fine.argmax(1)
    return np.arctan(fine[pick]), near[pick]


def _sky_light(azimuth: Floats, elevation: Floats, air: HillWeather, place: float) -> Floats:
    steep = np.maximum(elevation, 0.01) + 0.05
    cloud = smooth_noise(0.4 / steep + place, azimuth / (0.3 + 0.0 * steep) + 3.0, 4)
    return _SKY - 60.0 * np.clip(elevation, 0.0, 1.0) + 45.0 * air.clouds * cloud


def _land(
    hills: Hills, eye: Floats, azimuth: Floats, elevation: Floats, table: Floats, distance: Floats, tops: Floats,
    sky: Floats, air: HillWeather,
) -> Floats:  # fmt: skip
    """(H, W) gray levels of the ground: textured, and the more of the sky's brightness the farther it is."""
    column = np.clip(np.rint(np.interp(azimuth, table, np.arange(len(table)))).astype(int), 0, len(table) - 1)
    far = np.empty(azimuth.shape)
    tangent = np.tan(elevation)
    order = np.argsort(column, axis=None, kind="stable")
    cuts = np.searchsorted(column.ravel()[order], np.arange(len(table) + 1))
    flat, tangents = far.ravel(), tangent.ravel()
    for number in range(len(table)):
        some = order[cuts[number] : cuts[number + 1]]
        # Pixels that are half sky show of the ground what stands highest.
        hit = np.searchsorted(tops[number], np.minimum(tangents[some], tops[number, -1]))
        flat[some] = distance[hit]
    far = flat.reshape(far.shape)
    east, north = eye[0] + far * np.sin(azimuth), eye[1] + far * np.cos(azimuth)
    texture = smooth_noise(east / 60.0, north / 60.0, 3) + smooth_noise(azimuth / 0.004, elevation / 0.004, 2)
    clear = np.exp(-far / air.haze)
    return (80.0 + 22.0 * texture) * clear + sky * (1.0 - clear)


HERE = (47.0, 11.0)
# Meters: above the ground, and how far the terrain and its rasters go.
MAST, FARTHEST, REACH = 12.0, 11_000.0, 12_000.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ground:
    """A raster as it is given to kcal.

    Args:
        cell: meters.
        error: as its errors are drawn, and as they are stated.
        place: meters, sigma of the camera's measured place, east and north; half as much again upward.
        trees: meters, height of woods on a third of the terrain that the raster does not have.
    """

    cell: float
    error: RasterError
    place: float = 0.5
    trees: float = 0.0

    @property
    def place_sigma(self) -> Floats:
        """(3,) meters."""
        return self.place * np.array([1.0, 1.0, 1.5])


class Site(NamedTuple):
    """A camera before a terrain, as it is in truth.

    Attributes:
        hills: the terrain.
        angles: heading, pitch and roll, degrees.
        eye: (3,) meters east, north, height.
        air: the weather, refraction included.
    """

    hills: Hills
    angles: tuple[float, float, float]
    eye: Floats
    air: HillWeather


@functools.lru_cache(8)
def lens_of(number: int) -> TruthLens:
    """A traced surveillance lens, f 800 px, 960 x 540."""
    return drawn_lens(SURVEILLANCE, 1.0, number, focal_mm=4.64, scale=0.5)


@functools.lru_cache(8)
def exact_camera(number: int) -> Camera:
    """The lens itself as a camera of kcal."""
    return as_camera(lens_of(number))


def site_of(seed: int, trees: float = 0.0) -> Site:
    """A site of a seed: terrain, attitude, air."""
    random = np.random.default_rng([seed, 5])
    hills = Hills(seed=seed, relief=float(random.uniform(250, 600)), far=9_500.0, trees=trees, woods=0.33)
    angles = float(random.uniform(0, 360)), float(random.uniform(-1, 4)), float(random.uniform(-1.5, 1.5))
    nowhere = np.zeros(1)
    eye = np.array([0.0, 0.0, float(hills.ground(nowhere, nowhere)[0]) + MAST])
    air = HillWeather(
        haze=float(random.uniform(8_000, 30_000)),
        refraction=0.13 + 0.1 * float(random.standard_normal()),
        clouds=float(random.uniform(0.0, 0.8)),
        noise=float(random.uniform(0.7, 2.5)),
        seed=seed,
    )
    return Site(hills, angles, eye, air)


def picture(site: Site, lens: TruthLens, seed: int = 0) -> Skyline:
    """An image; another seed is another moment with other clouds and noise."""
    air = dataclasses.replace(site.air, seed=site.air.seed + 1000 * seed)
    return skyline_image(site.hills, lens, enu_from_cam(*site.angles), site.eye, air, farthest=FARTHEST)


def raster_of(hills: Hills, ground: Ground, seed: int) -> Raster:
    """Heights in cells, with drawn errors: alike over the correlation length, and of all heights together."""
    bare = dataclasses.replace(hills, trees=0.0)
    return _raster(bare, ground.cell, ground.error, seed)


@functools.lru_cache(2)
def _raster(bare: Hills, cell: float, error: RasterError, seed: int) -> Raster:
    count = int(2 * REACH / cell)
    x: Floats = (-REACH + cell * (np.arange(count) + 0.5)).astype(np.float64)
    heights = np.stack([bare.ground(x, np.full(count, -y)) for y in x])
    # Cells have the mean of what is in them: to second order, by how each differs from its neighbors.
    edge = np.pad(heights, 1, mode="edge")
    heights += (edge[2:, 1:-1] + edge[:-2, 1:-1] + edge[1:-1, 2:] + edge[1:-1, :-2] - 4.0 * heights) / 24.0
    random = np.random.default_rng([seed, 23])
    heights += error.sigma * _alike(count, error.correlation / cell, random)
    heights += error.offset * random.standard_normal()
    return raster_around(heights, cell)


def raster_around(heights: Floats, cell: float) -> Raster:
    """A raster of square cells around `HERE`, from north to south."""
    into = pyproj.Transformer.from_crs("EPSG:4326", level_system(), always_xy=True)
    middle = 0.5 * len(heights)
    return Raster(heights, (1 / cell, 0.0, middle, 0.0, -1 / cell, middle), into, cell)


def level_system() -> pyproj.CRS:
    """Meters east and north of `HERE`."""
    return pyproj.CRS.from_proj4(f"+proj=aeqd +lat_0={HERE[0]} +lon_0={HERE[1]} +datum=WGS84 +units=m")


def _alike(count: int, correlation: float, random: np.random.Generator) -> Floats:
    """(count, count) standard normals with the correlation exp(-d / correlation), d in cells, by their spectrum."""
    off = np.minimum(np.arange(count), count - np.arange(count))
    kernel = np.exp(-np.hypot(off[:, None], off) / correlation)
    root = np.sqrt(np.maximum(np.fft.rfft2(kernel).real, 0.0))
    found: Floats = np.fft.irfft2(root * np.fft.rfft2(random.standard_normal((count, count))), (count, count))
    return found


def measured_place(site: Site, ground: Ground, seed: int) -> Origin:
    """Where GNSS says that the camera is."""
    random = np.random.default_rng([seed, 29])
    off = ground.place_sigma * random.standard_normal(3)
    origin = Origin(lat=HERE[0], lon=HERE[1], height=float(site.eye[2]))
    lat, lon, height = enu_to_geodetic(torch.from_numpy(off)[None], origin)[0].tolist()
    return Origin(lat=lat, lon=lon, height=height)


def angle_errors(found: tuple[float, float, float], site: Site) -> Floats:
    """(3,) degrees."""
    off = np.array(found) - np.array(site.angles)
    wrapped: Floats = (off + 180.0) % 360.0 - 180.0
    return wrapped


def true_directions(site: Site, lens: TruthLens, pixels: Tensor) -> Tensor:
    """(N, 3) unit vectors east, north, up in which pixels see."""
    rays, _ = lens.unproject(pixels)
    return rays @ enu_from_cam(*site.angles).T


Floats = NDArray[np.float64]
NATIONAL = RasterError(sigma=1.0, correlation=150.0, offset=0.5)
GROUNDS = {
    "20 m cells, 1 m RMS": Ground(cell=20.0, error=NATIONAL),
    "30 m cells, 2 m RMS (the default)": Ground(cell=30.0, error=RasterError()),
    "20 m, 1 m; place ± 3 m": Ground(cell=20.0, error=NATIONAL, place=3.0),
    "20 m, 1 m; woods of 12 m on a third, not in the raster": Ground(cell=20.0, error=NATIONAL, trees=12.0),
}
LENSES, FOCAL = 3, 800.0
_FAR = 1e9


def alone(_: str, seed: int, *, grounds: tuple[str, ...]) -> dict[str, Any]:
    """Errors and sigmas of heading, pitch, roll of one image before each raster; what was said where it was refused."""
    found: dict[str, Any] = {}
    number = seed % LENSES
    pictures = {}
    for name in grounds:
        ground = GROUNDS[name]
        site = site_of(seed, ground.trees)
        if ground.trees not in pictures:
            pictures[ground.trees] = picture(site, lens_of(number)).image
        raster = raster_of(site.hills, ground, seed)
        place = measured_place(site, ground, seed)
        try:
            seen, spent = timed(
                skyline_attitude, pictures[ground.trees], exact_camera(number), place, raster,
                place_sigma=tuple(ground.place_sigma.tolist()), error=ground.error,
            )  # fmt: skip
        except KcalError as error:
            found[name] = str(error)
            continue
        off = angle_errors((seen.heading_deg, seen.pitch_deg, seen.roll_deg), site)
        raster_share = [float(value) for value in seen.shares["raster"]]
        found[name] = [*off.tolist(), *seen.sigma_deg.tolist(), *raster_share, spent, float(seen.used.mean())]
    return found


CASES = ("left", "right against left")


def rigs(kind: str, seed: int, views: int) -> dict[str, Any]:
    """Errors and sigmas of where calibrated cameras look, in pixels: (across, up) at three pixels of the skyline."""
    ground = Ground(cell=20.0, error=NATIONAL, place=0.02)
    site = site_of(seed)
    numbers = 2 * (seed % 2), 2 * (seed % 2) + 1
    cameras = _calibrated(numbers[0], views), _calibrated(numbers[1], views)
    heading = math.radians(site.angles[0])
    aside = 10.0 * np.array([math.cos(heading), -math.sin(heading), 0.0])
    sites = site, site._replace(eye=site.eye + aside, angles=(site.angles[0] + 0.3, *site.angles[1:]))
    raster = raster_of(site.hills, ground, seed)
    sigma = torch.from_numpy(np.stack([ground.place_sigma] * 2))
    off = torch.from_numpy(np.random.default_rng([seed, 31]).standard_normal((2, 3)))
    centers = torch.from_numpy(np.stack([np.zeros(3), aside])) + sigma * off
    images = [
        SkylineImage(name=CASES[side], camera=side, image=picture(sites[side], lens_of(number), side).image)
        for side, number in enumerate(numbers)
    ]
    places = tuple(MeasuredPosition(camera=c, point=centers[c], sigma=sigma[c]) for c in (0, 1))
    origin = Origin(lat=HERE[0], lon=HERE[1], height=float(site.eye[2]))
    try:
        source, _ = skyline_source(images, cameras, raster, origin, centers, sigma, error=ground.error)
        result = solve_rig(RigData(cameras=cameras, names=("left", "right"), positions=places, skyline=source))
    except KcalError as error:
        return dict.fromkeys(CASES, str(error))
    (left, off_left), (right, off_right) = (_pointing(result, c, sites[c], numbers[c]) for c in (0, 1))
    return {
        CASES[0]: [*off_left.tolist(), *_sigmas(result, left).tolist()],
        CASES[1]: [*(off_right - off_left).tolist(), *_sigmas(result, right - left).tolist()],
    }


@functools.cache
def _calibrated(number: int, views: int) -> Camera:
    """A lens calibrated by views of a printed board with corners of 0.1 px."""
    return calibrate_camera(capture(lens_of(number), views, 0.1, number)).camera


def _pointing(result: RigResult, c: int, site: Site, number: int) -> tuple[torch.Tensor, Floats]:
    """(6, S) and (6,) px: where a camera sees the true directions of three pixels, across and down, less these."""
    problem, state = result._solution.problem, result._solution.state
    posed = problem.posed(state)[c]
    width, height = posed.camera.size
    pixels = torch.tensor([[share * width, 0.45 * height] for share in (0.15, 0.5, 0.85)]).double()
    toward = true_directions(site, lens_of(number), pixels)
    turned = _FAR * posed.rotation @ toward.T
    wanted = range(len(posed.parameters))
    seen = project_components(turned, posed.parameters, posed.camera.model, wanted)
    rows = torch.zeros(6, problem.shared_size).double()
    rows[:, : posed.by_unknown.shape[1]] = seen.by_camera.flatten(1).T @ posed.by_unknown
    assert posed.turn is not None
    rows[:, posed.turn] += step_rows(seen.by_point, turned)[:3].flatten(1).T
    return rows, (seen.pixels - pixels.T).flatten().numpy()


def _sigmas(result: RigResult, rows: torch.Tensor) -> Floats:
    found: Floats = result._solution.variances(rows).sqrt().numpy()
    return found


@section("skyline.md", "alone", seeds=range(1), grounds=tuple(GROUNDS)[1:2])
def told_alone(kept: Kept = NOT_KEPT, seeds: range = range(30), grounds: tuple[str, ...] = tuple(GROUNDS)) -> Lines:
    work = functools.partial(alone, grounds=grounds)
    records = kept.records([("alone", seed) for seed in seeds], work, lambda _: "done")
    yield [
        "raster", "RMS error of heading / pitch / roll, °", "median σ", "error over σ", "truth in the 95 %",
        "of the heading's variance the raster's", "columns used", "refused", "CPU s",
    ]  # fmt: skip
    for name in grounds:
        trials = [one[name] for one in records if one["key"][0] == "alone"]
        good = np.array([trial for trial in trials if not isinstance(trial, str)])
        error, sigma = good[:, :3], good[:, 3:6]
        ratio = error / sigma
        yield [
            name, _three(np.sqrt((error**2).mean(0)), 4), _three(np.median(sigma, 0), 4),
            _three(np.sqrt((ratio**2).mean(0)), 2), _three(100 * (np.abs(ratio) < 1.96).mean(0), 0) + " %",
            f"{100 * good[:, 6].mean():.0f} %", f"{100 * good[:, 10].mean():.0f} %", len(trials) - len(good),
            f"{np.median(good[:, 9]):.1f}",
        ]  # fmt: skip


@section("skyline.md", "rigs", seeds=range(1), views=8)
def told_rigs(kept: Kept = NOT_KEPT, seeds: range = range(30), views: int = 30) -> Lines:
    records = kept.records([("rigs", seed, views) for seed in seeds], rigs, lambda _: "done")
    yield ["which way", "RMS error across / up, °", "RMS σ", "error over σ", "truth in the 95 %", "refused"]
    degree = math.degrees(1.0 / FOCAL)
    for name in CASES:
        trials = [one[name] for one in records if one["key"][0] == "rigs"]
        good = np.array([trial for trial in trials if not isinstance(trial, str)]).reshape(-1, 2, 2, 3)
        error, sigma = good[:, 0].transpose(1, 0, 2).reshape(2, -1), good[:, 1].transpose(1, 0, 2).reshape(2, -1)
        ratio = error / sigma
        yield [
            name, _three(degree * np.sqrt((error**2).mean(1)), 4), _three(degree * np.sqrt((sigma**2).mean(1)), 4),
            _three(np.sqrt((ratio**2).mean(1)), 2), _three(100 * (np.abs(ratio) < 1.96).mean(1), 0) + " %",
            len(trials) - len(good),
        ]  # fmt: skip


def _three(values: Floats, digits: int) -> str:
    return " / ".join(f"{value:.{digits}f}" for value in values)
