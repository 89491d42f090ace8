"""`Origin` and `Mounting`: where a camera stands on the Earth and where it looks, as plain numbers."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.texts import brief


@dataclasses.dataclass(frozen=True, kw_only=True)
class Origin:
    """Where ENU is anchored: for a rig the projection center of its left camera.

    Args:
        lat: geodetic latitude in degrees, -90 to 90.
        lon: longitude in degrees, -180 to 180.
        height: meters above the WGS84 ellipsoid, not above sea level.

    Raises:
        InputError: a value out of range; swapped latitude and longitude are named where they can be told.

    Example:
        >>> Origin.parse("-33.9, 151.2, 10")
        Origin(lat=-33.9, lon=151.2, height=10.0)
    """

    lat: float
    lon: float
    height: float

    def __post_init__(self) -> None:
        if not all(math.isfinite(value) for value in (self.lat, self.lon, self.height)):
            raise InputError(f"origin: latitude, longitude and height must be finite, got {self}")
        if abs(self.lat) > 90:
            hint = "; longitude came first? write LAT,LON,HEIGHT" if abs(self.lon) <= 90 else ""
            raise InputError(f"origin: latitude {self.lat:g} is outside -90 to 90{hint}")
        if abs(self.lon) > 180:
            hint = f"; write {self.lon - 360:g}" if 180 < self.lon <= 360 else ""
            raise InputError(f"origin: longitude {self.lon:g} is outside -180 to 180{hint}")
        if not -1000 <= self.height <= 100_000:
            raise InputError(f"origin: height {self.height:g} m is outside -1000 to 100000; meters are needed")

    @classmethod
    def parse(cls, text: str) -> Origin:
        """Read `"LAT,LON,HEIGHT"`: degrees, degrees, meters above the WGS84 ellipsoid.

        Raises:
            InputError: not three numbers, or a value out of range.
        """
        fields = text.split(",")
        try:
            values = [float(field) for field in fields]
        except ValueError:
            values = []
        if len(values) != 3:
            raise InputError(f"origin {text!r}: write three numbers LAT,LON,HEIGHT, for example 19.07,72.87,14")
        return cls(lat=values[0], lon=values[1], height=values[2])

    @classmethod
    def at(cls, geodetic: Tensor) -> Origin:
        """Of (3,) latitude, longitude, height."""
        lat, lon, height = geodetic.tolist()
        return cls(lat=lat, lon=lon, height=height)

    @property
    def geodetic(self) -> Tensor:
        """(3,) float64: latitude, longitude, height."""
        return torch.tensor([self.lat, self.lon, self.height], dtype=torch.float64)


# Gauss's coefficient of refraction, the mean over land by day. What is not known of it is the gradient of temperature:
# k = 503 p / T² (0.0342 + dT/dz) in hPa, K and K/m (Brunner 1984), so that 0.1 stands for ± 0.016 K/m. That suits lines
# of sight some ten meters above the ground; near it k varies by 1 and more (Hirt et al. 2010).
REFRACTION, REFRACTION_SIGMA = 0.13, 0.1


def check_refraction(refraction: float, sigma: float) -> None:
    """Raise `InputError` for a coefficient of refraction, or its standard deviation, that cannot be."""
    if not -2.0 <= refraction <= 2.0:
        raise InputError(f"refraction {refraction}: a coefficient such as 0.13 is needed, not beyond ±2")
    if not 0.0 <= sigma <= 2.0:
        raise InputError(f"refraction_sigma {sigma}: a number from 0 to 2 is needed, such as 0.1")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mounting:
    """How the left camera of a rig stands, how light was refracted when that was found, and how well both are known.

    Args:
        origin: place of the camera's projection center.
        heading_deg: azimuth of the optical axis, degrees clockwise from true north.
        pitch_deg: elevation of the optical axis, degrees, positive up.
        roll_deg: degrees, positive clockwise as seen from behind the camera.
        covariance: (7, 7) of east, north, up (meters), of turns about these axes (radians), all at the camera, and of
            the coefficient of refraction; (6, 6) where nothing was found of the last; None: exact.
        link: (P, 7) or (P, 6) covariance of the rig's P quantities, in the order of `RigCovariance`, with these; None:
            independent.
        refraction: coefficient k, see `StereoLocalizer`; None: nothing was found of it.

    Example:
        >>> Mounting(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0).pitch_deg
        0.0
    """

    __repr__ = brief

    origin: Origin
    heading_deg: float
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    covariance: Tensor | None = None
    link: Tensor | None = None
    refraction: float | None = None
