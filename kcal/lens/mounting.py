"""`Origin` and `Mounting`: where a camera stands on the Earth and where it looks, as plain numbers."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from kcal.errors import InputError


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

    @property
    def geodetic(self) -> Tensor:
        """(3,) float64: latitude, longitude, height."""
        return torch.tensor([self.lat, self.lon, self.height], dtype=torch.float64)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Mounting:
    """How the left camera of a rig stands, and how well that is known.

    Args:
        origin: place of the camera's projection center.
        heading_deg: azimuth of the optical axis, degrees clockwise from true north.
        pitch_deg: elevation of the optical axis, degrees, positive up.
        roll_deg: degrees, positive clockwise as seen from behind the camera.
        covariance: (6, 6) of east, north, up (meters) and of turns about these axes (radians), all at the camera; None:
            exact.
        link: (P, 6) covariance of the rig's P quantities, in the order of `RigCovariance`, with these six; None:
            independent.

    Example:
        >>> Mounting(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0).pitch_deg
        0.0
    """

    origin: Origin
    heading_deg: float
    pitch_deg: float = 0.0
    roll_deg: float = 0.0
    covariance: Tensor | None = None
    link: Tensor | None = None
