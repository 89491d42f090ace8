"""Attitude of cameras from skylines and a raster of the terrain, how well it is known, and the rig data made of it."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import kcal.skyline.fit as fits
from kcal.calibrate.rig.marks import SkylineSource
from kcal.checks import variance_factor
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import vector_from_rotation
from kcal.lens.rig import Origin
from kcal.locate.geodesy import ecef_from_enu_rotation, enu_to_geodetic, mean_radius
from kcal.locate.ground import Raster
from kcal.locate.mounting import attitude
from kcal.skyline.horizon import (
    Border,
    Columns,
    Comparison,
    Horizon,
    RasterError,
    SkylineErrors,
    TerrainRays,
    columns_of,
    compare,
    sample_distances,
    sky_border,
    terrain_horizon,
)
from kcal.texts import brief
from kcal.threads import in_one_thread

# How much errors of a raster, and its cells, change its horizon, because a horizon is the highest of many heights.
#
# Errors that are independent of the terrain raise it: the highest of many wrong heights is more often one that is too
# high. Cells blunt a crest that is sharper than they are, and lower it: cells of twice the size tell by how much. How
# much a raster has of either, it does not say. So the horizon is not corrected: what errors of the stated size change
# is one standard deviation of what all columns have in common, and what cells change is one of each crest.

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
    # Here, because it takes long to load.
    from scipy.signal import lfilter

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
    """Slopes (A, S) at which the ground is seen, -∞ where it is not known, and horizontal distances, 1 there."""
    slope, level, _ = rays.seen(rays.along(azimuth), distance)
    known = np.isfinite(slope)
    return np.where(known, slope, -np.inf), np.where(known, level, 1.0)


def _less(one: Floats, other: Floats) -> Floats:
    """(A,) one less the other; 0 where either is not known."""
    known = np.isfinite(one) & np.isfinite(other)
    return np.where(known, one, 0.0) - np.where(known, other, 0.0)


Bools = NDArray[np.bool_]

# Degrees between azimuths all around, where headings are searched, and beyond the image where a skyline is fitted.
_AROUND, _BEYOND = 0.1, 1.5
# Share of the image's columns that must be clear, and of the clear ones that must agree with the raster.
_CLEAR, _AGREEING = 0.1, 0.5
# Degrees: a heading known worse is none; and headings as near as this are one.
_FLAT, _ONE = 0.5, 1.0
# χ² by which the second heading must fit worse: a thousand to one.
_CLEARLY = 2.0 * math.log(1000.0)
# Share of columns below the raster's skyline, beyond their errors, that a wrong border here and there explains.
_BELOW = 0.1
# So many other headings that fit as well are those of a flat horizon.
_MANY = 4
# Residuals may be larger than their sigmas say by this factor; beyond, the raster is not of this terrain.
_CONTRADICTS = 3.0
# Share of columns left out that is worth naming.
_LEFT_OUT = 0.15
# Share of directions without a horizon that is worth naming.
_OPEN = 0.1
# Meters above the raster's ground at which a camera's height is doubted.
_HIGH = 150.0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SkylineAttitude:
    """Attitude of a camera from a skyline.

    Args:
        rotation: (3, 3) the camera's axes from east, north, up at the camera.
        heading_deg: see `Mounting`.
        pitch_deg: see `Mounting`.
        roll_deg: see `Mounting`.
        sigma_deg: (3,) of heading, pitch and roll.
        covariance: (3, 3) rad², of a small turn of the camera about the axes east, north, up.
        shares: of the variances of heading, pitch and roll (3,) by where they come from: image, raster, refraction,
            position, lens.
        widened: by how much residuals are larger than their sigmas say, at least 1; the covariance has it.
        border: of the image.
        used: (W,) which columns agree with the raster and were used.
        expected: (W,) px, the raster's skyline in each clear column; NaN elsewhere.
        second_deg: heading of the next best explanation; NaN if there is none.
        second_worse: by how much its χ² is larger.
        warnings: what to know of it.
        fit: the columns used, in bins, and the covariance about the camera's axes.
    """

    __repr__ = brief

    rotation: Floats
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    sigma_deg: Floats
    covariance: Floats
    shares: dict[str, Floats]
    widened: float
    border: Border
    used: Bools
    expected: Floats
    second_deg: float
    second_worse: float
    warnings: tuple[str, ...]
    fit: fits.SkylineFit


@in_one_thread
def skyline_attitude(
    image: NDArray[np.generic],
    camera: Camera,
    place: Origin,
    raster: Raster,
    *,
    place_sigma: tuple[float, float, float] = (3.0, 3.0, 3.0),
    error: RasterError | None = None,
    heading: tuple[float, float] | None = None,
) -> SkylineAttitude:
    """Find the attitude of a camera from the border of sky and ground; no rough pose is needed.

    Args:
        image: (H, W) gray levels, by day.
        camera: which lens; errors of its calibration are part of the covariance.
        place: of the camera.
        raster: heights above the ellipsoid, from `kcal.locate.terrain`.
        place_sigma: meters, of the place, east, north and up.
        error: of the raster and of refraction.
        heading: a rough heading of the optical axis and the most it is off, degrees.

    Raises:
        InputError: an image of another size; no clear border of sky and ground; a raster that does not reach, or that
            contradicts the image.
        DegenerateError: the skyline is too flat to tell the heading, or several headings fit about equally well.

    Example:
        >>> camera = Camera.build(focal=(300, 300), center=(159.5, 99.5), size=(320, 200), model="pinhole")
        >>> skyline_attitude(np.zeros((100, 100)), camera, Origin(lat=47.0, lon=11.0, height=600.0), None)
        Traceback (most recent call last):
        kcal.errors.InputError: the image has 100 x 100 pixels, the camera 320 x 200: give an image of this camera
    """
    error = error or RasterError()
    around = functools.partial(horizon_around, raster, place, error)
    return attitude_against(around, image, camera, place, raster, place_sigma, error, heading)


def horizon_around(raster: Raster, place: Origin, error: RasterError) -> Horizon:
    """All directions from a place."""
    return terrain_horizon(raster, place, np.radians(np.arange(-180.0, 180.0, _AROUND)), refraction=error.refraction)


def attitude_against(
    horizon_there: Callable[[], Horizon], image: NDArray[np.generic], camera: Camera, place: Origin, raster: Raster,
    place_sigma: tuple[float, float, float], error: RasterError, heading: tuple[float, float] | None = None,
) -> SkylineAttitude:  # fmt: skip
    """Find the attitude like `skyline_attitude`, from a function that gives the horizon, which images may share."""
    shape = np.asarray(image).shape
    if shape != tuple(reversed(camera.size)):
        got = " x ".join(str(side) for side in reversed(shape))
        raise InputError(
            f"the image has {got} pixels, the camera {camera.size[0]} x {camera.size[1]}: give an image of this camera"
        )
    if not all(0.0 < sigma < math.inf for sigma in place_sigma):
        raise InputError(f"place_sigma {place_sigma}: three positive numbers of meters are needed")
    border = sky_border(image)
    columns = columns_of(border.row, border.sigma, camera)
    if len(columns.pixel) < max(_CLEAR * camera.size[0], 30):
        raise InputError(
            f"the border of sky and ground is clear in {len(columns.pixel)} of {camera.size[0]} columns only: the "
            "skyline must be in the image, by day, without fog, and without objects close by in front of it"
        )
    around = horizon_there()
    errors = SkylineErrors(error, np.array(place_sigma), fits.lens_errors(camera), mean_radius(place.lat))
    found = fits.candidates(columns, around, camera, errors, heading)
    horizon = terrain_horizon(raster, place, _azimuths(columns, found[0]), refraction=error.refraction)
    horizon = raised_horizon(horizon, raster, place, error)
    fit = fits.fit_rotation(columns, horizon, found[0].rotation, camera, errors)
    open_share = 1.0 - float(around.known.mean())
    gap = "" if open_share < _OPEN else (
        f". The raster has no horizon in {100 * open_share:.0f} % of the directions around the camera: it ends before "
        "the terrain falls away, or has cells without a height"
    )  # fmt: skip
    ground = raster(*torch.tensor([[place.lat], [place.lon]], dtype=torch.float64))
    above = place.height - float(ground[0])
    if fit is None:
        raise InputError(f"{_CONTRADICTED} no heading fits; {_cure(above)}{gap}")
    return _checked_attitude(fit, found, columns, horizon, border, camera, above, gap)


_CONTRADICTED = "the raster contradicts the image:"


def _cure(above: float) -> str:
    return (
        f"check the camera's place and height ({above:.0f} m above the raster's ground), the raster's heights "
        "(--geoid) and accuracy, and that the image shows a skyline by day"
    )


def _azimuths(columns: Columns, found: fits.Candidate) -> Floats:
    """Radians, increasing, two for each column of the image."""
    heading = columns.ray @ found.rotation
    middle = math.radians(found.heading)
    off = np.remainder(np.arctan2(heading[:, 0], heading[:, 1]) - middle + math.pi, 2.0 * math.pi) - math.pi
    step = 0.5 * float(np.median(np.abs(np.diff(off)) / np.diff(columns.pixel[:, 0])))
    beyond = math.radians(_BEYOND)
    return middle + np.arange(off.min() - beyond, off.max() + beyond, step)


def _checked_attitude(
    fit: fits.SkylineFit, found: list[fits.Candidate], columns: Columns, horizon: Horizon, border: Border,
    camera: Camera, above: float, gap: str,
) -> SkylineAttitude:  # fmt: skip
    """The attitude, unless something speaks against it; `above`: meters of the camera above the raster's ground."""
    heading, pitch, roll = attitude(torch.from_numpy(fit.rotation.T.copy()))
    widened = math.sqrt(variance_factor(fit.chi2, fit.freedom))
    turn = _angles_by_turn(fit.rotation)
    total = np.diag(turn @ fit.covariance @ turn.T)
    sigma = widened * np.sqrt(total)
    agreeing = float(fit.used.mean())
    few = f"{100 * agreeing:.0f} % of the skyline's clear columns agree in the best heading, {heading:.1f} degrees"
    below = (
        f"in {100 * fit.below:.0f} % of the columns its skyline is below the raster's, which nothing that grows or was"
    )
    large = f"residuals are {widened:.1f} times as large as their sigmas say"
    for wrong, text in (
        (agreeing < _AGREEING, few), (fit.below > _BELOW, f"{below} built explains"), (widened > _CONTRADICTS, large)
    ):  # fmt: skip
        if wrong:
            raise InputError(f"{_CONTRADICTED} {text}; {_cure(above)}{gap}")
    apart = [abs((one.heading - heading + 180.0) % 360.0 - 180.0) for one in found]
    others = [one for one, off in zip(found, apart, strict=True) if off > max(5.0 * sigma[0], _ONE)]
    worse = others[0].cost - found[0].cost if others else math.inf
    as_good = sum(one.cost - found[0].cost < _CLEARLY for one in others)
    if sigma[0] > _FLAT or as_good >= _MANY:
        why = f"its sigma is {sigma[0]:.2g} degrees" if sigma[0] > _FLAT else f"{as_good} others fit as well"
        raise DegenerateError(
            f"the skyline is too flat to tell the heading ({why}): a plain or the sea has one elevation all around; "
            "use landmarks or stars"
        )
    if as_good:
        raise DegenerateError(
            f"two headings explain the skyline about equally well: {heading:.1f} and {others[0].heading:.1f} degrees "
            f"(chi-squared differs by {worse:.1f}; {_CLEARLY:.0f} are needed): state a rough heading, or use an image "
            f"that shows more of the skyline{gap}"
        )
    expected = np.full(camera.size[0], np.nan)
    used = np.zeros(camera.size[0], dtype=np.bool_)
    at = columns.pixel[:, 0].astype(int)
    seen = compare(columns, horizon, fit.rotation, camera)
    # Down the column, as far as the skyline is from the border across it.
    upright = np.where(columns.sigma > 0, seen.sigma / columns.sigma, 1.0)
    expected[at] = np.where(seen.known, columns.pixel[:, 1] + seen.residual / np.maximum(upright, 0.05), np.nan)
    used[at] = fit.used
    back = fit.rotation.T
    return SkylineAttitude(
        rotation=fit.rotation,
        heading_deg=heading,
        pitch_deg=pitch,
        roll_deg=roll,
        sigma_deg=sigma,
        covariance=widened**2 * back @ fit.covariance @ back.T,
        shares={name: np.diag(turn @ part @ turn.T) / total for name, part in fit.parts.items()},
        widened=widened,
        border=border,
        used=used,
        expected=expected,
        second_deg=others[0].heading if others else math.nan,
        second_worse=worse,
        warnings=tuple(_attitude_warnings(fit, columns, horizon, above, widened)),
        fit=fit,
    )


def _angles_by_turn(rotation: Floats) -> Floats:
    """(3, 3) degrees of heading, pitch and roll by a turn about the camera's axes, rad."""
    step = 1e-6
    steps = np.concatenate([step * np.eye(3), -step * np.eye(3)])
    turned = [torch.from_numpy((fits.rotation_by(one) @ rotation).T.copy()) for one in steps]
    ends = np.stack([attitude(one) for one in turned], -1)
    found: Floats = ((ends[:, :3] - ends[:, 3:] + 180.0) % 360.0 - 180.0) / (2.0 * step)
    return found


def _attitude_warnings(
    fit: fits.SkylineFit, columns: Columns, horizon: Horizon, above: float, widened: float
) -> list[str]:
    found = []
    if above > _HIGH:
        found.append(
            f"the camera stands {above:.0f} m above the raster's ground; if its heights are above the sea, add the "
            "height of the geoid (--geoid)"
        )
    if widened > 1.0:
        found.append(
            f"residuals are {widened:.1f} times as large as their sigmas say; the covariance was widened: is the "
            "raster as accurate as stated?"
        )
    left_out = 1.0 - float(fit.used.mean())
    if left_out > _LEFT_OUT:
        found.append(
            f"{100 * left_out:.0f} % of the clear columns contradict the raster and are left out, as trees and "
            "buildings above a raster of the bare ground do; lower ones among the rest still pull the pitch down: a "
            "surface model, with what grows, is better"
        )
    heading = columns.ray[fit.used] @ fit.rotation
    near = np.searchsorted(horizon.azimuth, horizon.azimuth[0] + np.remainder(
        np.arctan2(heading[:, 0], heading[:, 1]) - horizon.azimuth[0], 2.0 * math.pi
    )).clip(0, len(horizon.azimuth) - 1)  # fmt: skip
    doubtful = float(horizon.doubtful[near].mean())
    if doubtful > 0.1:
        found.append(
            f"ground as high as the raster's highest, if it stood just beyond its end ({horizon.reach.min() / 1e3:.1f} "
            f"km away), would hide the horizon in {100 * doubtful:.0f} % of the columns; a larger raster would tell"
        )
    return found


# From images of the skyline by the cameras of a rig to what the rig is solved from.

# Of all residuals, in sigmas: what moves them by less says nothing.
_TELLS = 1e-2


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SkylineImage:
    """An image of the skyline.

    Args:
        name: of the image.
        camera: number of the camera that took it.
        image: (H, W) gray levels.
    """

    __repr__ = brief

    name: str
    camera: int
    image: NDArray[np.generic]


@in_one_thread
def skyline_source(
    images: Sequence[SkylineImage],
    cameras: Sequence[Camera],
    raster: Raster,
    origin: Origin,
    centers: Tensor,
    center_sigma: Tensor,
    *,
    error: RasterError | None = None,
) -> tuple[SkylineSource, list[SkylineAttitude]]:
    """Attitudes of a rig's cameras on the Earth from skylines, as one Gaussian for all images.

    Images of one camera at several times average the noise of the image; the errors of the raster and of refraction
    stay as they are, and are shared by cameras that look at the same terrain.

    Args:
        images: of one or more cameras.
        cameras: of the rig.
        raster: heights above the ellipsoid, from `kcal.locate.terrain`.
        origin: of the rig's frame.
        centers: (C, 3) meters, where the cameras were measured, in that frame; anything for those without images.
        center_sigma: (C, 3) meters.
        error: of the raster and of refraction.

    Returns:
        what `solve_rig` takes, and the attitude from each image alone.

    Raises:
        InputError: no images; what `skyline_attitude` refuses, with the image's name; images of one camera that
            contradict each other.
        DegenerateError: see `skyline_attitude`.

    Example:
        >>> camera = Camera.build(focal=(300, 300), center=(159.5, 99.5), size=(320, 200), model="pinhole")
        >>> here, place = Origin(lat=47.0, lon=11.0, height=600.0), torch.zeros(1, 3)
        >>> skyline_source([], [camera], None, here, place, place + 1.0)
        Traceback (most recent call last):
        kcal.errors.InputError: skyline: no images
    """
    error = error or RasterError()
    if not images:
        raise InputError("skyline: no images")
    seeing = sorted({image.camera for image in images})
    eyes = {c: Origin.at(enu_to_geodetic(centers[c][None].double(), origin)[0]) for c in seeing}
    around = {c: functools.cache(functools.partial(horizon_around, raster, eye, error)) for c, eye in eyes.items()}
    found = []
    for image in images:
        c, (east, north, up) = image.camera, center_sigma[image.camera].tolist()
        try:
            found.append(
                attitude_against(around[c], image.image, cameras[c], eyes[c], raster, (east, north, up), error)
            )
        except InputError as problem:
            raise type(problem)(f"{image.name}: {problem}") from problem
    return _joined(images, found, cameras, origin, eyes, centers, center_sigma, error), found


def _joined(
    images: Sequence[SkylineImage], found: Sequence[SkylineAttitude], cameras: Sequence[Camera], origin: Origin,
    eyes: dict[int, Origin], centers: Tensor, center_sigma: Tensor, error: RasterError,
) -> SkylineSource:  # fmt: skip
    """All images in the rig's frame, whitened together, and in as few rows as there are unknowns."""
    count, sizes = len(cameras), [camera.params.shape[-1] for camera in cameras]
    rotation, center = torch.full((count, 3, 3), math.nan).double(), torch.full((count, 3), math.nan).double()
    world = ecef_from_enu_rotation(origin.lat, origin.lon).numpy()
    world_from_eye = {c: world.T @ ecef_from_enu_rotation(eye.lat, eye.lon).numpy() for c, eye in eyes.items()}
    rows, residual, widened, image_of, seen_of = [], [], [], [], []
    begin = np.cumsum([6 * count, *sizes])
    for number, (image, one) in enumerate(zip(images, found, strict=True)):
        c, seen, turn = image.camera, one.fit.binned, world_from_eye[image.camera]
        here = torch.from_numpy(one.rotation @ turn.T)
        if not bool(torch.isfinite(rotation[c]).all()):
            rotation[c], center[c] = here, centers[c]
        part = np.zeros((len(seen.residual), int(begin[-1])))
        part[:, 3 * c : 3 * c + 3] = seen.by_turn
        part[:, 3 * (count + c) : 3 * (count + c) + 3] = seen.by_shift @ turn.T
        part[:, begin[c] : begin[c + 1]] = seen.by_lens
        # At the attitude of the camera's first image.
        off = vector_from_rotation(rotation[c] @ here.T).numpy()
        rows.append(part)
        residual.append(seen.residual + seen.by_turn @ off)
        widened += len(part) * [one.widened]
        image_of += len(part) * [number]
        seen_of.append(dataclasses.replace(seen, point=seen.point @ turn.T + centers[c].numpy()))
    together, number_of, times = Comparison.together(seen_of), np.array(image_of), np.array(widened)
    covariance = np.diag(np.square(together.sigma)) + fits.COMMON**2 * (number_of[:, None] == number_of)
    covariance += sum(fits.terrain_covariances(together, error, mean_radius(origin.lat)).values())
    root = np.linalg.cholesky(covariance * times[:, None] * times)
    white = np.linalg.solve(root, np.column_stack([np.concatenate(rows), np.concatenate(residual)]))
    # Only what moves by turns, and by what is not known of places and lenses, is kept: the rest says how well the
    # skylines fit, which each image has told.
    moves = [white[:, : 3 * count], white[:, 3 * count : 6 * count] * center_sigma.numpy().reshape(-1)]
    by_lens = np.split(white, begin, axis=1)[1:-1]
    moves += [own @ fits.lens_errors(camera) for own, camera in zip(by_lens, cameras, strict=True)]
    basis, size, _ = np.linalg.svd(np.column_stack(moves), full_matrices=False)
    compact = basis[:, size > _TELLS].T @ white
    return SkylineSource(
        cameras=tuple(image.camera for image in images),
        names=tuple(image.name for image in images),
        rotation=rotation,
        center=center,
        parameters=tuple(camera.params.detach() for camera in cameras),
        rows=torch.from_numpy(compact[:, :-1].copy()),
        residual=torch.from_numpy(compact[:, -1].copy()),
        columns=tuple(int(one.used.sum()) for one in found),
        rms_px=tuple(float(np.sqrt(np.mean(np.square(one.fit.binned.residual)))) for one in found),
        sigmas=tuple(math.sqrt(one.fit.chi2 / max(one.fit.freedom, 1)) for one in found),
    )
