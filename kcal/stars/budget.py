"""How many stars a camera will see, how well, and what range error follows: before anyone climbs the mast.

A photometric model, not a measurement: it is probably a magnitude too cautious.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kcal.errors import InputError
from kcal.stars.sky import EARTH_RATE, StarCatalog

# Electrons a second and cm² of a star of magnitude 0: silicon, 400 to 900 nm, behind color filters and glass.
_ELECTRONS = 1.0e6
_READ, _DARK = 2.0, 1.0  # electrons, and electrons a second, of a pixel
_PSF, _LEAST_SIGMA = 1.0, 0.05  # px
_LEAST_SIGNAL = 7.0
_EXTINCTION = 0.25  # magnitudes for each thickness of the atmosphere
_ARCSECONDS = 206265.0
# Strips of the image, each with its own altitude, and the lowest altitude at which stars are used, degrees.
_STRIPS, _LOWEST = 9, 5.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class NightPlan:
    """A camera and its exposure under a sky.

    Args:
        focal_px: focal length.
        size: of the image, px.
        aperture_mm: diameter of the entrance pupil: the focal length over the f-number.
        seconds: exposure.
        sky_magnitude: brightness of a square second of arc: 21.5 dark, 20.5 rural, 18 suburb.
        altitude_deg: of the middle of the image; 0: level, so that half of it sees the ground.

    Example:
        >>> NightPlan(focal_px=1600, size=(1920, 1080), aperture_mm=2.9).seconds
        1.0
    """

    focal_px: float
    size: tuple[int, int]
    aperture_mm: float
    seconds: float = 1.0
    sky_magnitude: float = 20.5
    altitude_deg: float = 0.0

    def __post_init__(self) -> None:
        if not (self.focal_px > 0 and min(self.size) > 0 and self.aperture_mm > 0 and self.seconds > 0):
            raise InputError("night: focal length, size, aperture and exposure must be positive")
        if not (0 <= self.altitude_deg <= 90 and 10 <= self.sky_magnitude <= 23):
            raise InputError("night: an altitude of 0 to 90 degrees and a sky of magnitude 10 to 23 are needed")


class PlannedStars(NamedTuple):
    """How many stars a plan shows, and how well they tell the relative yaw.

    Attributes:
        stars: in an image, on average over the sky.
        faintest: magnitude.
        sigma_px: of a star along an axis, median.
        trail_px: by which a star on the equator moves during the exposure.
        yaw_sigma: radians, of the relative yaw from one pair of images.
    """

    stars: float
    faintest: float
    sigma_px: float
    trail_px: float
    yaw_sigma: float

    def range_share(self, distance: float, baseline: float, pairs: int = 1, clock_sigma: float = 0.0) -> float:
        """Standard deviation of a range over the range: from stars and the clock; lens and marks come on top."""
        angle = math.hypot(self.yaw_sigma / math.sqrt(pairs), EARTH_RATE * clock_sigma)
        return distance / baseline * angle


def planned_stars(plan: NightPlan) -> PlannedStars:
    """How many stars of the catalogue an image will show, and how well they determine the relative yaw.

    Example:
        >>> found = planned_stars(NightPlan(focal_px=1600, size=(1920, 1080), aperture_mm=2.9))
        >>> 20 < found.stars < 120
        True
    """
    catalog = StarCatalog.bundled()
    magnitude = np.sort(catalog.magnitude)
    pixel = _ARCSECONDS / plan.focal_px
    trail = 15.04 * plan.seconds / pixel
    width, height = plan.size
    # The solid angle of the image, of a lens without distortion.
    half = width / 2 / plan.focal_px, height / 2 / plan.focal_px
    share = math.asin(half[0] * half[1] / math.hypot(1, half[0]) / math.hypot(1, half[1])) / math.pi / _STRIPS
    stars, weight, faintest = 0.0, 0.0, -math.inf
    sigmas: list[NDArray[np.float64]] = []
    for strip in range(_STRIPS):
        up = math.degrees(math.atan(half[1] * (1 - (2 * strip + 1) / _STRIPS)))
        altitude = min(plan.altitude_deg + up, 90.0)
        if altitude < _LOWEST:
            continue
        air = 1.0 / (math.sin(math.radians(altitude)) + 0.50572 * (altitude + 6.07995) ** -1.6364)
        signal, sigma = _signal(plan, magnitude, air, pixel, trail)
        seen = signal > _LEAST_SIGNAL
        stars += share * float(seen.sum())
        weight += share * float((sigma[seen] ** -2.0).sum())
        faintest = max(faintest, float(magnitude[seen].max(initial=-math.inf)))
        sigmas.append(sigma[seen])
    if not stars:
        return PlannedStars(0.0, -math.inf, math.nan, trail, math.inf)
    # Of a pair: both cameras' noise.
    yaw = math.sqrt(2.0 / weight) / plan.focal_px
    return PlannedStars(stars, faintest, float(np.median(np.concatenate(sigmas))), trail, yaw)


def _signal(
    plan: NightPlan, magnitude: NDArray[np.float64], air: float, pixel: float, trail: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Signal over noise, and the sigma of a center along an axis, px."""
    area = math.pi / 4 * (plan.aperture_mm / 10) ** 2
    star = _ELECTRONS * area * plan.seconds * 10 ** (-0.4 * (magnitude + _EXTINCTION * air))
    sky = _ELECTRONS * area * plan.seconds * 10 ** (-0.4 * (plan.sky_magnitude - 5 * math.log10(pixel)))
    along = math.hypot(_PSF, trail / math.sqrt(12))
    pixels = 4 * math.pi * _PSF * along
    signal = star / np.sqrt(star + pixels * (sky + _DARK * plan.seconds + _READ**2))
    # Image motion in a small aperture.
    seeing = 2.0 * air**0.6 / math.sqrt(1 + plan.seconds / 0.1) / pixel
    return signal, np.sqrt(_LEAST_SIGMA**2 + (1.2 * along / signal) ** 2 + seeing**2)
