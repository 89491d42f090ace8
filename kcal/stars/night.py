"""From a night image to named stars and the camera's attitude, among the stars and on the Earth."""

from __future__ import annotations

import dataclasses
import datetime
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

import kcal.stars.sky as night_sky
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import fit_turn, seen_turned, vector_from_rotation
from kcal.lens.projection import FAR
from kcal.lens.rig import Origin
from kcal.lens.uncertainty import turns_like
from kcal.locate.mounting import attitude
from kcal.stars.detect import DetectedStars, detect_stars
from kcal.stars.sky import identify, turn_between
from kcal.texts import brief
from kcal.threads import in_one_thread

# How a camera looks, from the named stars of one image: rotation, residuals of every star, and covariance.

Floats = NDArray[np.float64]

# A star is left out if its residual is more than so many times its sigma, which is widened where all are.
_CUT = 5.0
# px: stars are named within this distance first, while attitude and lens are rough.
_ROUGH = 4.0
# px: the sigma of the most disturbed star that is still worth naming.
_LEAST_REACH = 1.0
# Standard deviations by which refraction must differ from that of place and time, and px by which a good lens errs.
_SURE, _LENS = 5.0, 0.04
# px: another star of the catalog that is nearer, and not fainter by more magnitudes, pulls a star's center.
_CROWDED, _FAINTER = 6.0, 2.5


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Attitude:
    """Attitude of a camera relative to the stars.

    Args:
        rotation: (3, 3) camera from the frame of the directions.
        covariance: (3, 3) of a small turn of the camera about the axes of that frame, rad², from noise of the marks.
        star: (N,) index in the catalog of each star of the image; -1 for stars without a name or left out.
        residual: (N, 2) projected minus seen, px; NaN for those.
        rms_px: root of the mean squared residual along an axis.
        widened: by how much residuals are larger than their sigmas say, at least 1; the covariance has it.
    """

    rotation: Tensor
    covariance: Tensor
    star: NDArray[np.int64]
    residual: Floats
    rms_px: float
    widened: float

    @property
    def count(self) -> int:
        """How many stars are named and used."""
        return int((self.star >= 0).sum())


def fit_attitude(
    pixels: Floats, sigma: Floats, directions: Floats, magnitude: Floats, camera: Camera, rotation: Floats
) -> Attitude | None:
    """Name all stars of an image from a first attitude, and fit the attitude to them.

    Args:
        pixels: (N, 2) stars of the image.
        sigma: (N,) of each along an axis, px.
        directions: (M, 3) unit vectors of the catalog, in any frame.
        magnitude: (M,).
        camera: which lens.
        rotation: (3, 3) camera from that frame, to begin with.

    Returns:
        None if fewer than three stars have a name.
    """
    turn = torch.from_numpy(np.ascontiguousarray(rotation))
    everywhere = torch.from_numpy(directions)
    star, reach = np.full(len(pixels), -1), np.full(len(pixels), _ROUGH)
    least = math.cos(min(_half_field(camera) + 0.01, math.pi))
    weights, target = torch.from_numpy(1.0 / sigma), torch.from_numpy(pixels).T
    for attempt in range(12):
        before = star
        star = _names_at(pixels, reach, everywhere, magnitude, camera, turn, least)
        known = torch.from_numpy(star >= 0)
        if int(known.sum()) < 3:
            return None
        there, weight, seen = FAR * everywhere[star[star >= 0]], weights[known], target[:, known]

        def look(
            rotation: Tensor, _: Tensor, there: Tensor = there, weight: Tensor = weight, seen: Tensor = seen
        ) -> tuple[Tensor, Tensor]:
            pixels, rows = seen_turned(camera, there, rotation)
            return (rows[:3] * weight).flatten(1).T, ((pixels - seen) * weight).flatten()

        turn = fit_turn(turn, look, steps=3).rotation
        white, error = look(turn, turn[0])
        scale = max(float(error.reshape(2, -1).norm(dim=0).median()) / 1.18, 1.0)
        reach = np.maximum(_CUT * scale * sigma, min(_LEAST_REACH, _CUT * scale * float(np.median(sigma))))
        if attempt > 1 and np.array_equal(before, star):
            break
    off = (error.reshape(2, -1) / weight).T.numpy()
    residual = np.full(pixels.shape, np.nan)
    residual[star >= 0] = off
    chi2 = float(((off / sigma[star >= 0, None]) ** 2).sum())
    widened = max(math.sqrt(chi2 / (2 * len(off) - 3)), 1.0)
    own = torch.linalg.inv(white.T @ white) * widened**2
    return Attitude(
        rotation=turn,
        covariance=turn.T @ own @ turn,
        star=star,
        residual=residual,
        rms_px=float(np.sqrt((off**2).mean())),
        widened=widened,
    )


def refraction_doubt(seen: Attitude, sigma: Floats, refracted: Tensor, straight: Tensor, camera: Camera) -> str | None:
    """Whether stars are refracted as they would be at the place and time that were given; None if they are.

    Args:
        seen: the attitude on the Earth, with its N named stars.
        sigma: (N,) of these, px.
        refracted: (N, 3) directions in which they would be seen there and then.
        straight: (N, 3) likewise without air.
        camera: which lens.
    """
    at, rows = seen_turned(camera, FAR * refracted, seen.rotation)
    without, _ = seen_turned(camera, FAR * straight, seen.rotation)
    weight = torch.from_numpy(1.0 / sigma) / seen.widened
    pattern = (at - without) * weight
    turns = (rows[:3] * weight).flatten(1)
    own = pattern.flatten() - turns.T @ torch.linalg.lstsq(turns.T, pattern.flatten()[:, None]).solution[:, 0]
    residual = torch.from_numpy(seen.residual[seen.star >= 0]).T * weight
    length = float(own.norm())
    if length == 0.0:
        return None
    # The residual is projected minus seen: seen refraction is (1 - excess) of what was assumed.
    excess = float(own @ residual.flatten()) / length**2
    moved = abs(excess) * float((own.reshape(2, -1) / weight).square().mean().sqrt())
    if abs(excess) * length < _SURE or moved < _LENS:
        return None
    return (
        f"refraction is {1.0 - excess:.2f} ± {1.0 / length:.2f} times what it would be there and then: the stars stand "
        f"{'lower' if excess < 0 else 'higher'} than place and time say; one of them is wrong, or the lens"
    )


def _names_at(
    pixels: Floats, reach: Floats, directions: Tensor, magnitude: Floats, camera: Camera, rotation: Tensor, least: float
) -> NDArray[np.int64]:
    """(N,) the star of the catalog at each pixel; -1 for none, or where another star pulls it.

    Stars whose cosine from the optical axis is at least `least` may be in the image.
    """
    ahead = np.flatnonzero((directions @ rotation[2] > least).numpy())
    seen, valid = camera.project(FAR * (directions[ahead] @ rotation.T))
    ahead, places = ahead[valid.numpy()], seen[valid].numpy()
    star = np.full(len(pixels), -1)
    if not len(ahead):
        return star
    tree = cKDTree(places)
    distance, nearest = tree.query(pixels)
    back = cKDTree(pixels).query(places)[1]
    pairs = tree.query_pairs(_CROWDED, output_type="ndarray")
    alone = np.ones(len(ahead), bool)
    for first, second in ((pairs[:, 0], pairs[:, 1]), (pairs[:, 1], pairs[:, 0])):
        alone[first[magnitude[ahead[second]] < magnitude[ahead[first]] + _FAINTER]] = False
    good = (distance < reach) & (back[nearest] == np.arange(len(pixels))) & alone[nearest]
    star[good] = ahead[nearest[good]]
    return star


def field_angle(camera: Camera) -> float:
    """Radians between the directions of opposite corners of the image, by the camera itself."""
    return 2.0 * _half_field(camera)


def _half_field(camera: Camera) -> float:
    width, height = camera.size
    across, down = (width - 1.0) / 8, (height - 1.0) / 8
    border = [(i * across, j * down) for i in range(9) for j in range(9) if i in (0, 8) or j in (0, 8)]
    rays, valid = camera.unproject(torch.tensor(border, dtype=torch.float64))
    if not bool(valid.any()):
        rays, valid = camera.unproject(camera.grid(9, 9).reshape(-1, 2))
    return min(float(torch.arccos(rays[valid, 2].clamp(-1, 1)).max()), math.pi)


# From a night image to named stars and the camera's attitude, among the stars and on the Earth.

# px: how well calibrated lenses are known at infinity, at least where an attitude is first looked for.
_LENS_PX = 2.5
# Share of the gray levels above which a background is that of a day.
_DAY = 0.5
# Degrees of roll beyond which a camera rather has a wrong place or time than that it lies on its side.
_ON_ITS_SIDE = 45.0
_TWILIGHT = -4.0  # degrees: with the Sun higher, cameras see no stars but the brightest


@dataclasses.dataclass(frozen=True, kw_only=True)
class SkyView:
    """When and where images of the sky were taken.

    Args:
        time: with a zone; None: stars are named, and the attitude is that among the stars.
        origin: the camera's place on the Earth; None: likewise.
        air: there, for refraction; standard air if left out.
        dut1: UT1 - UTC in seconds; None: not known, which adds 8 seconds of arc to the sigma of the heading.
        time_sigma: of the camera's clock, seconds; one second is 15 seconds of arc.

    Example:
        >>> SkyView(time_sigma=-1.0)
        Traceback (most recent call last):
        kcal.errors.InputError: time_sigma -1.0: seconds, not below 0, are needed
    """

    __repr__ = brief

    time: datetime.datetime | None = None
    origin: Origin | None = None
    air: night_sky.Air | None = None
    dut1: float | None = None
    time_sigma: float = 0.1

    def __post_init__(self) -> None:
        if not 0 <= self.time_sigma < math.inf:
            raise InputError(f"time_sigma {self.time_sigma}: seconds, not below 0, are needed")
        if self.origin is not None and self.time is None:
            raise InputError("a place without a time tells no heading; give the time as well")

    @property
    def on_earth(self) -> bool:
        """Whether time and place are known."""
        return self.time is not None and self.origin is not None

    @property
    def clock_sigma(self) -> float:
        """Seconds: of the camera's clock and of UT1 - UTC together."""
        return math.hypot(self.time_sigma, night_sky.UNKNOWN_DUT1_SIGMA if self.dut1 is None else 0.0)

    def directions(self, catalog: night_sky.StarCatalog, air: night_sky.Air | None = None) -> NDArray[np.float64]:
        """(N, 3) in which the stars are seen: east, north, up if time and place are known."""
        if self.time is None or self.origin is None:
            return night_sky.celestial_directions(catalog, self.time)
        return night_sky.observed_directions(catalog, self.time, self.origin, air or self.known_air, self.dut1 or 0.0)

    @property
    def known_air(self) -> night_sky.Air:
        """The air, standard where nothing was said."""
        assert self.origin is not None
        return self.air or night_sky.Air.at_height(self.origin.height)

    def by_air(self, catalog: night_sky.StarCatalog, index: NDArray[np.int64]) -> list[tuple[str, NDArray[np.float64]]]:
        """By how much stars (N, 3) shift for one sigma of the air's temperature and of its pressure."""
        some, known, air = _part(catalog, index), self.directions(_part(catalog, index)), self.known_air
        warmer = dataclasses.replace(air, celsius=min(air.celsius + air.celsius_sigma, 60.0))
        denser = dataclasses.replace(air, hectopascal=min(air.hectopascal + air.hectopascal_sigma, 1100.0))
        return [
            ("the air's temperature", self.directions(some, warmer) - known),
            ("the air's pressure", self.directions(some, denser) - known),
        ]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class NamedStars:
    """The named stars of one image, and the camera's attitude.

    Args:
        detected: all stars of the image.
        view: when and where.
        attitude: rotation from the frame of `directions` and what belongs to it.
        directions: (M, 3) of the catalog: east, north, up if `on_earth`, otherwise celestial.
        on_earth: whether the attitude is that on the Earth.
        covariance: (3, 3) of the attitude about that frame's axes, rad², with clock, UT1 and air; under this lens
            (`turn_by_lens`).
        warnings: what to doubt.
    """

    __repr__ = brief

    detected: DetectedStars
    view: SkyView
    attitude: Attitude
    directions: NDArray[np.float64]
    on_earth: bool
    covariance: Tensor
    warnings: tuple[str, ...]

    @property
    def heading_pitch_roll(self) -> tuple[float, float, float] | None:
        """Degrees, of the camera on the Earth; None where place or time are not known."""
        return attitude(self.attitude.rotation.T) if self.on_earth else None

    @property
    def right_ascension_declination(self) -> tuple[float, float] | None:
        """Degrees of the optical axis among the stars (J2000); None on the Earth."""
        if self.on_earth:
            return None
        x, y, z = self.attitude.rotation[2].tolist()
        return math.degrees(math.atan2(y, x)) % 360.0, math.degrees(math.asin(z))

    @property
    def sigma_deg(self) -> tuple[float, float, float]:
        """One sigma of small turns about the frame's axes, degrees; about east, north and up on the Earth."""
        east, north, up = self.covariance.diagonal().sqrt().rad2deg().tolist()
        return east, north, up


@in_one_thread
def name_stars(
    image: NDArray[Any] | DetectedStars,
    camera: Camera,
    view: SkyView | None = None,
    catalog: night_sky.StarCatalog | None = None,
) -> NamedStars:
    """Name the stars of a night image without knowing where the camera looks, and find its attitude.

    Args:
        image: (H, W) gray levels, or its stars.
        camera: calibrated.
        view: when and where; both are needed for the attitude on the Earth.
        catalog: the stars; kcal's own if left out.

    Raises:
        InputError: an image of another size, of the day, with the lens cap on, without stars, mirrored, or one whose
            stars have no name; a place or time that cannot be.

    Example:
        >>> name_stars(np.full((480, 640), 5, np.uint8), Camera.build(focal=(800, 800), center=(319.5, 239.5),
        ...            size=(640, 480), model="pinhole"))
        Traceback (most recent call last):
        kcal.errors.InputError: no stars: the image is dark all over; is the lens cap on, or the exposure too short?
    """
    view, catalog = view or SkyView(), catalog or night_sky.StarCatalog.bundled()
    if not isinstance(image, tuple) and image.shape != camera.size[::-1]:
        raise InputError(
            f"the image has {image.shape[1]}x{image.shape[0]} pixels, the camera {camera.size[0]}x{camera.size[1]}"
        )
    found = image if isinstance(image, tuple) else detect_stars(image)
    _refuse_no_night(found)
    rays, valid = camera.unproject(torch.from_numpy(found.pixels))
    direction = rays[valid].numpy()
    reach, field = _reach(camera), field_angle(camera)
    named = identify(direction, reach, catalog=catalog, field=field)
    if named is None:
        if identify(direction * [-1.0, 1.0, 1.0], reach, catalog=catalog, field=field) is not None:
            raise InputError("the image is mirrored: its stars have names only from left to right; mirror it back")
        raise InputError(
            f"{len(found.pixels)} points of light, which no stars of the catalog explain: too few of them are "
            "stars, the camera file is of another lens, or clouds cover most of the sky"
        )
    celestial = night_sky.celestial_directions(catalog, view.time)
    sky = fit_attitude(found.pixels, found.sigma, celestial, catalog.magnitude, camera, named.rotation)
    if sky is None:
        raise InputError("fewer than three stars stand alone; the attitude cannot be fitted")
    named_stars = NamedStars(
        detected=found, view=view, attitude=sky, directions=celestial, on_earth=False, covariance=sky.covariance,
        warnings=(),
    )  # fmt: skip
    return _on_earth(named_stars, catalog, camera) if view.on_earth else named_stars


def _on_earth(among: NamedStars, catalog: night_sky.StarCatalog, camera: Camera) -> NamedStars:
    """The same with the attitude on the Earth."""
    found, view, sky = among.detected, among.view, among.attitude
    there = view.directions(catalog)
    index = sky.star[sky.star >= 0]
    low = there[index, 2] < math.sin(night_sky.LOWEST_ALTITUDE)
    below = int((there[index, 2] < math.sin(math.radians(-1.0))).sum())
    if below > 0.2 * len(index):
        text = (
            f"the stars are named, but {below} of {len(index)} would stand below the horizon there and then: place or "
            "time is wrong; the attitude is that among the stars"
        )
        return dataclasses.replace(among, warnings=(text,))
    # Refraction near the horizon is not known well enough: lower stars are put where no camera sees a star.
    usable = np.where(there[:, 2:] > math.sin(night_sky.LOWEST_ALTITUDE), there, [0.0, 0.0, -1.0])
    start = sky.rotation.numpy() @ turn_between(there[index], among.directions[index])
    scale = float(camera.params[0])
    blurred = np.hypot(found.sigma, scale * float(night_sky.refraction_sigma(np.arcsin(there[index, 2])).mean()))
    on_ground = fit_attitude(found.pixels, blurred, usable, catalog.magnitude, camera, start)
    if on_ground is None:
        raise InputError(
            f"{int(low.sum())} of {len(index)} named stars are lower than 5°, where refraction is not known well "
            "enough, and fewer than three are left: tilt the camera up, or leave the place out"
        )
    used = on_ground.star[on_ground.star >= 0]
    covariance = on_ground.covariance + _by_clock(view) + _by_air(view, catalog, used)
    _, _, roll = attitude(on_ground.rotation.T)
    assert view.time is not None
    sun = math.degrees(math.asin(view.directions(night_sky.sun_at(view.time))[0, 2]))
    day = f"the Sun would stand at {sun:+.0f}° there and then: place or time is wrong"
    rolled = f"the camera would be rolled by {roll:.0f}°: unless it lies on its side, place or time is wrong"
    part = _part(catalog, used)
    vacuum = view.directions(part, night_sky.Air(hectopascal=0.0))
    sigma = blurred[on_ground.star >= 0]
    doubt = refraction_doubt(on_ground, sigma, torch.from_numpy(there[used]), torch.from_numpy(vacuum), camera)
    told = tuple(filter(None, (day if sun > _TWILIGHT else None, rolled if abs(roll) > _ON_ITS_SIDE else None, doubt)))
    return dataclasses.replace(
        among, attitude=on_ground, directions=there, on_earth=True, covariance=covariance, warnings=told
    )


def turn_by_lens(camera: Camera, pixels: Floats) -> float:
    """How far errors of the lens may turn an attitude from stars at pixels (N, 2): one sigma, degrees.

    An error of the principal point looks like a turn of the camera; where pixels look stays the same. 0 if the camera
    has no error bars.
    """
    known = None if camera.calibration is None else camera.calibration.known(camera.params.detach())
    if known is None:
        return 0.0
    wanted = [index for index, slot in enumerate(known.slots) if slot >= 0]
    half = known.by_parameter(known.half())[:, wanted]
    turns = turns_like(camera, torch.from_numpy(pixels), wanted) @ half.T
    return math.degrees(float(turns.norm(dim=1).max()))


def _by_clock(view: SkyView) -> Tensor:
    assert view.origin is not None
    turn = torch.from_numpy(night_sky.pole_in_enu(view.origin.lat) * night_sky.EARTH_RATE * view.clock_sigma)
    return torch.outer(turn, turn)


def _by_air(view: SkyView, catalog: night_sky.StarCatalog, index: NDArray[np.int64]) -> Tensor:
    known, total = view.directions(_part(catalog, index)), torch.zeros(3, 3, dtype=torch.float64)
    for _, shift in view.by_air(catalog, index):
        turn = vector_from_rotation(torch.from_numpy(turn_between(known, known + shift)))
        total = total + torch.outer(turn, turn)
    return total


def _part(catalog: night_sky.StarCatalog, index: NDArray[np.int64]) -> night_sky.StarCatalog:
    columns = {field.name: getattr(catalog, field.name)[index] for field in dataclasses.fields(catalog)}
    return night_sky.StarCatalog(**columns)


def _reach(camera: Camera) -> float:
    """Radians of a pixel of error in the lens: by the camera's own rays in the middle of the image."""
    middle = torch.tensor([(camera.size[0] - 1) / 2, (camera.size[1] - 1) / 2], dtype=torch.float64)
    rays, _ = camera.unproject(torch.stack([middle, middle + torch.tensor([1.0, 0.0], dtype=torch.float64)]))
    return _LENS_PX * float((rays[0] - rays[1]).norm())


def _refuse_no_night(found: DetectedStars) -> None:
    if len(found.pixels) >= 4:
        return
    count = f"{len(found.pixels)} stars only" if len(found.pixels) else "no stars"
    if found.background > _DAY:
        raise InputError(f"{count}: the image is bright as day; expose less, or by night")
    left_out = ", ".join(f"{number} {reason}" for reason, number in found.left_out.items())
    if left_out:
        raise InputError(f"{count} ({left_out} were left out): clouds, or not the night sky")
    raise InputError(f"{count}: the image is dark all over; is the lens cap on, or the exposure too short?")


# Whether the times of night images can be right, from a camera that stands still.
#
# What no image tells: a place or a clock that is wrong by the same in all images, where they look high up and
# refraction (`refraction_doubt`) says little of the altitude. Landmarks or a compass tell it then.

# Standard deviations beyond which chance explains nothing.
_SURE_TIMES = 5.0
# Degrees by which a mast may bend between two images.
_BENDS = 0.02


def clock_doubts(images: Sequence[NamedStars]) -> list[tuple[int, str]]:
    """Images whose camera stands otherwise than in the first one by a turn about the Earth's axis, as by a wrong time.

    A camera that is moved by hand hardly ever turns about that axis alone.

    Returns:
        number of the image, and what to tell.

    Example:
        >>> clock_doubts([])
        []
    """
    found = []
    on_earth = [number for number, image in enumerate(images) if image.on_earth]
    for number in on_earth[1:]:
        first, other = images[on_earth[0]], images[number]
        assert first.view.origin is not None
        turn = vector_from_rotation(first.attitude.rotation.T @ other.attitude.rotation)
        pole = torch.from_numpy(night_sky.pole_in_enu(first.view.origin.lat))
        about = float(turn @ pole)
        beside = float((turn - about * pole).norm())
        spread = first.attitude.covariance + other.attitude.covariance
        aside = _SURE_TIMES * math.sqrt(float(spread.trace())) + math.radians(_BENDS)
        along = _SURE_TIMES * math.sqrt(float(pole @ spread @ pole)) + math.radians(_BENDS)
        if abs(about) > along and beside < aside:
            seconds = about / night_sky.EARTH_RATE
            found.append((
                number,
                f"the camera would have turned about the Earth's axis by {math.degrees(about):+.3f}° since the first "
                f"image, as if one of the two times were wrong by {abs(seconds):.0f} s ({abs(seconds) / 3600:.2f} h)",
            ))  # fmt: skip
    return found
