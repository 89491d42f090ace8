"""From a night image to named stars and the camera's attitude, among the stars and on the Earth."""

from __future__ import annotations

import dataclasses
import datetime
import math
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.mounting import Origin
from kcal.lens.pose import vector_from_rotation
from kcal.locate.mounting import attitude
from kcal.stars.attitude import Attitude, field_angle, fit_attitude, refraction_doubt
from kcal.stars.catalog import StarCatalog
from kcal.stars.detect import DetectedStars, detect_stars
from kcal.stars.identification import identify, turn_between
from kcal.stars.sky import (
    EARTH_RATE,
    LOWEST_ALTITUDE,
    UNKNOWN_DUT1_SIGMA,
    Air,
    celestial_directions,
    observed_directions,
    pole_in_enu,
    refraction_sigma,
)
from kcal.threads import in_one_thread

# px: how well calibrated lenses are known at infinity, at least where an attitude is first looked for.
_LENS_PX = 2.5
# Share of the gray levels above which a background is that of a day.
_DAY = 0.5
# Degrees of roll beyond which a camera rather has a wrong place or time than that it lies on its side.
_ON_ITS_SIDE = 45.0


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

    time: datetime.datetime | None = None
    origin: Origin | None = None
    air: Air | None = None
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
        return math.hypot(self.time_sigma, UNKNOWN_DUT1_SIGMA if self.dut1 is None else 0.0)

    def directions(self, catalog: StarCatalog, air: Air | None = None) -> NDArray[np.float64]:
        """(N, 3) in which the stars are seen: east, north, up if time and place are known."""
        if self.time is None or self.origin is None:
            return celestial_directions(catalog, self.time)
        return observed_directions(catalog, self.time, self.origin, air or self.known_air, self.dut1 or 0.0)

    @property
    def known_air(self) -> Air:
        """The air, standard where nothing was said."""
        assert self.origin is not None
        return self.air or Air.at_height(self.origin.height)

    def by_air(self, catalog: StarCatalog, index: NDArray[np.int64]) -> list[tuple[str, NDArray[np.float64]]]:
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
    """The stars of one image, named, and how the camera looks.

    Args:
        detected: all stars of the image.
        view: when and where.
        attitude: rotation from the frame of `directions` and what belongs to it.
        directions: (M, 3) of the catalogue: east, north, up if `on_earth`, otherwise celestial.
        on_earth: whether the attitude is that on the Earth.
        covariance: (3, 3) of the attitude about that frame's axes, rad², with clock, UT1 and air.
        warnings: what to doubt.
    """

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
    image: NDArray[Any] | DetectedStars, camera: Camera, view: SkyView | None = None, catalog: StarCatalog | None = None
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
    view, catalog = view or SkyView(), catalog or StarCatalog.bundled()
    if not isinstance(image, tuple) and image.shape != camera.size[::-1]:
        raise InputError(
            f"the image has {image.shape[1]}x{image.shape[0]} pixels, the camera {camera.size[0]}x{camera.size[1]}"
        )
    found = image if isinstance(image, tuple) else detect_stars(image)
    _refuse_no_night(found)
    rays, valid = camera.unproject(torch.from_numpy(found.pixels))
    direction = (rays / rays.norm(dim=-1, keepdim=True)).numpy()[valid.numpy()]
    reach, field = _reach(camera), field_angle(camera)
    named = identify(direction, reach, catalog=catalog, field=field)
    if named is None:
        if identify(direction * [-1.0, 1.0, 1.0], reach, catalog=catalog, field=field) is not None:
            raise InputError("the image is mirrored: its stars have names only from left to right; mirror it back")
        raise InputError(
            f"{len(found.pixels)} points of light, which no stars of the catalogue explain: too few of them are "
            "stars, the camera file is of another lens, or clouds cover most of the sky"
        )
    celestial = celestial_directions(catalog, view.time)
    sky = fit_attitude(found.pixels, found.sigma, celestial, catalog.magnitude, camera, named.rotation)
    if sky is None:
        raise InputError("fewer than three stars stand alone; the attitude cannot be fitted")
    if not view.on_earth:
        return NamedStars(
            detected=found, view=view, attitude=sky, directions=celestial, on_earth=False, covariance=sky.covariance,
            warnings=(),
        )  # fmt: skip
    return _on_earth(found, view, catalog, camera, sky, celestial)


def _on_earth(
    found: DetectedStars, view: SkyView, catalog: StarCatalog, camera: Camera, sky: Attitude, celestial: Any
) -> NamedStars:
    there = view.directions(catalog)
    index = sky.star[sky.star >= 0]
    low = there[index, 2] < math.sin(LOWEST_ALTITUDE)
    below = int((there[index, 2] < math.sin(math.radians(-1.0))).sum())
    if below > 0.2 * len(index):
        text = (
            f"the stars are named, but {below} of {len(index)} would stand below the horizon there and then: place or "
            "time is wrong; the attitude is that among the stars"
        )
        return NamedStars(
            detected=found, view=view, attitude=sky, directions=celestial, on_earth=False, covariance=sky.covariance,
            warnings=(text,),
        )  # fmt: skip
    # Refraction near the horizon is not known well enough: lower stars are put where no camera sees a star.
    usable = np.where(there[:, 2:] > math.sin(LOWEST_ALTITUDE), there, [0.0, 0.0, -1.0])
    start = sky.rotation.numpy() @ turn_between(there[index], celestial[index])
    scale = float(camera.params[0])
    blurred = np.hypot(found.sigma, scale * float(refraction_sigma(np.arcsin(there[index, 2])).mean()))
    on_ground = fit_attitude(found.pixels, blurred, usable, catalog.magnitude, camera, start)
    if on_ground is None:
        raise InputError(
            f"{int(low.sum())} of {len(index)} named stars are lower than 5°, where refraction is not known well "
            "enough, and fewer than three are left: tilt the camera up, or leave the place out"
        )
    used = on_ground.star[on_ground.star >= 0]
    covariance = on_ground.covariance + _by_clock(view) + _by_air(view, catalog, used)
    _, _, roll = attitude(on_ground.rotation.T)
    doubts = [
        f"the camera would be rolled by {roll:.0f}°: unless it lies on its side, place or time is wrong"
    ] * (abs(roll) > _ON_ITS_SIDE)  # fmt: skip
    part = _part(catalog, used)
    vacuum = view.directions(part, Air(hectopascal=0.0))
    sigma = blurred[on_ground.star >= 0]
    doubt = refraction_doubt(on_ground, sigma, torch.from_numpy(there[used]), torch.from_numpy(vacuum), camera)
    if doubt is not None:
        doubts.append(doubt)
    return NamedStars(
        detected=found, view=view, attitude=on_ground, directions=there, on_earth=True, covariance=covariance,
        warnings=tuple(doubts),
    )  # fmt: skip


def _by_clock(view: SkyView) -> Tensor:
    assert view.origin is not None
    turn = torch.from_numpy(pole_in_enu(view.origin.lat) * EARTH_RATE * view.clock_sigma)
    return torch.outer(turn, turn)


def _by_air(view: SkyView, catalog: StarCatalog, index: NDArray[np.int64]) -> Tensor:
    known, total = view.directions(_part(catalog, index)), torch.zeros(3, 3, dtype=torch.float64)
    for _, shift in view.by_air(catalog, index):
        turn = vector_from_rotation(torch.from_numpy(turn_between(known, known + shift)))
        total = total + torch.outer(turn, turn)
    return total


def _part(catalog: StarCatalog, index: NDArray[np.int64]) -> StarCatalog:
    columns = {field.name: getattr(catalog, field.name)[index] for field in dataclasses.fields(catalog)}
    return StarCatalog(**columns)


def _reach(camera: Camera) -> float:
    """Radians of a pixel of error in the lens: by the camera's own rays in the middle of the image."""
    middle = torch.tensor([(camera.size[0] - 1) / 2, (camera.size[1] - 1) / 2], dtype=torch.float64)
    rays, _ = camera.unproject(torch.stack([middle, middle + torch.tensor([1.0, 0.0], dtype=torch.float64)]))
    rays = rays / rays.norm(dim=-1, keepdim=True)
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
