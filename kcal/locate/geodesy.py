"""From the rig to the Earth: the cameras' attitude, and east-north-up to WGS84 latitude, longitude and height.

Conventions, all of them pinned by tests:

* ENU: x east, y north, z up, tangent to the WGS84 ellipsoid at the origin, meters. Up is not height: at 5 km the
  ellipsoid has fallen 1.96 m below the tangent plane, and the conversion here accounts for it.
* Heights are ellipsoidal (WGS84, what GNSS receivers call HAE), not above mean sea level; the two differ by up to
  100 m (`kcal.locate.datum` has the difference where a geoid grid is at hand).
* Refraction of light is an option (`lower_by_refraction`): 0.26 m of height at 5 km in standard air.
* Headings count clockwise from true north, not from magnetic or grid north (`kcal.locate.datum` converts the latter).
* Order is latitude, longitude, height everywhere but in GeoJSON.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from kcal.checks import as_points, require_finite
from kcal.errors import InputError
from kcal.locate.ellipsoid import ecef_from_enu_rotation, ecef_to_geodetic, geodetic_to_ecef, mean_radius


def enu_from_cam(heading_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Tensor:
    """Rotation that takes camera axes (x right, y down, z forward) to east, north, up.

    Starting from a level camera that looks north, it is turned clockwise (seen from above) by the heading, raised by
    the pitch about its own x axis, and then rolled about its own optical axis.

    Args:
        heading_deg: azimuth of the optical axis, degrees clockwise from true north.
        pitch_deg: elevation of the optical axis above the horizontal plane, degrees, positive up.
        roll_deg: degrees, positive clockwise as seen from behind the camera: the right side goes down.

    Returns:
        (3, 3) float64, the columns being the camera's right, down and forward axes in ENU.

    Raises:
        InputError: an angle that is not finite, a pitch beyond ±90, or a heading or roll beyond ±360.

    Example:
        >>> enu_from_cam(90.0)[:, 2].round(decimals=12).abs().tolist()
        [1.0, 0.0, 0.0]
    """
    for name, value, limit in (("heading", heading_deg, 360.0), ("pitch", pitch_deg, 90.0), ("roll", roll_deg, 360.0)):
        if not abs(value) <= limit:
            raise InputError(f"{name} {value}: degrees between -{limit:g} and {limit:g} are needed")
    heading, pitch, roll = (math.radians(value) for value in (heading_deg, pitch_deg, roll_deg))
    east, north = math.sin(heading), math.cos(heading)
    forward = (east * math.cos(pitch), north * math.cos(pitch), math.sin(pitch))
    right = (north, -east, 0.0)
    down = (east * math.sin(pitch), north * math.sin(pitch), -math.cos(pitch))
    columns = (
        [r * math.cos(roll) + d * math.sin(roll) for r, d in zip(right, down, strict=True)],
        [d * math.cos(roll) - r * math.sin(roll) for r, d in zip(right, down, strict=True)],
        forward,
    )
    return torch.tensor(columns, dtype=torch.float64).T


def azimuth_elevation(enu: Tensor) -> Tensor:
    """Azimuth (degrees clockwise from true north, 0 to 360) and elevation (degrees) of vectors (..., 3).

    Example:
        >>> azimuth_elevation(torch.tensor([-1.0, 0.0, 1.0])).round(decimals=6).tolist()
        [270.0, 45.0]
    """
    enu = as_points("enu", enu, 3)
    azimuth = torch.rad2deg(torch.atan2(enu[..., 0], enu[..., 1])) % 360.0
    elevation = torch.rad2deg(torch.atan2(enu[..., 2], torch.hypot(enu[..., 0], enu[..., 1])))
    return torch.stack([azimuth, elevation], -1)


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


def enu_to_geodetic(enu: Tensor, origin: Origin) -> Tensor:
    """Latitude, longitude (degrees) and ellipsoidal WGS84 height (meters) of ENU points, differentiable.

    Args:
        enu: (..., 3) meters.
        origin: where (0, 0, 0) is.

    Returns:
        (..., 3) float64 on the device of `enu`; longitudes in [-180, 180).

    Raises:
        InputError: wrong shape or dtype, or a value that is not finite.

    Source: EPSG methods 9836 (topocentric) and 9602 (geocentric), see `kcal.locate.ellipsoid`.

    Example:
        >>> origin = Origin(lat=0.0, lon=180.0, height=0.0)
        >>> enu_to_geodetic(torch.tensor([[1000.0, 0.0, 0.0]]), origin).round(decimals=4).tolist()
        [[0.0, -179.991, 0.0784]]
    """
    enu = as_points("enu", enu, 3)
    require_finite("enu", enu)
    return place_enu(enu, *anchor(origin, enu.device))


def anchor(origin: Origin, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Rotation (3, 3) and translation (3,) of ENU into ECEF."""
    return ecef_from_enu_rotation(origin.lat, origin.lon).to(device), geodetic_to_ecef(origin.geodetic).to(device)


def place_enu(enu: Tensor, ecef_from_enu: Tensor, ecef_of_origin: Tensor) -> Tensor:
    """ENU (..., 3) to latitude, longitude, height, given the `anchor`; no checks, so that it can be compiled."""
    geodetic = ecef_to_geodetic(enu @ ecef_from_enu.mT + ecef_of_origin)
    lat, lon, height = geodetic.unbind(-1)
    return torch.stack([lat, torch.where(lon >= 180.0, lon - 360.0, lon), height], -1)


def geodetic_to_enu(geodetic: Tensor, origin: Origin) -> Tensor:
    """ENU meters of (..., 3) latitude, longitude (degrees), ellipsoidal WGS84 height (meters); differentiable.

    Raises:
        InputError: wrong shape, less than float64 (a float32 degree is rounded by up to 0.8 m), a value that is
            not finite, or a latitude outside ±90.

    Example:
        >>> origin = Origin(lat=19.07, lon=72.87, height=14.0)
        >>> above = torch.tensor([[19.07, 72.87, 24.0]], dtype=torch.float64)
        >>> geodetic_to_enu(above, origin).abs().round(decimals=6).tolist()
        [[0.0, 0.0, 10.0]]
    """
    checked = as_points("geodetic", geodetic, 3)
    if geodetic.dtype != torch.float64:
        raise InputError(f"geodetic: float64 is needed; {geodetic.dtype} has already rounded degrees by up to a meter")
    require_finite("geodetic", checked)
    if bool((checked[..., 0].abs() > 90).any()):
        raise InputError("geodetic: a latitude is outside -90 to 90; the order is latitude, longitude, height")
    rotation, translation = anchor(origin, checked.device)
    return (geodetic_to_ecef(checked) - translation) @ rotation


# Share of the Earth's curvature by which light bends downward in standard air.
STANDARD_REFRACTION = 0.13


def lower_by_refraction(enu: Tensor, origin: Origin, coefficient: float = STANDARD_REFRACTION) -> Tensor:
    """Take the bending of light out of points (..., 3) found along straight lines of sight from the origin.

    Light that arrives level has come up a little: the target stands lower than it seems, by k d² / (2 R) with the
    horizontal distance d and the Earth's radius R. The coefficient k is 0.13 in standard air; over hot ground or cold
    water it may be anything from -1 to 1, so that this is a correction on average, not for the day.

    Example:
        >>> point = torch.tensor([5000.0, 0.0, 0.0], dtype=torch.float64)
        >>> round(lower_by_refraction(point, Origin(lat=19.0, lon=73.0, height=0.0))[2].item(), 3)
        -0.255
    """
    enu = as_points("enu", enu, 3)
    if not -2.0 <= coefficient <= 2.0:
        raise InputError(f"refraction {coefficient}: a coefficient such as 0.13 is needed, not beyond ±2")
    drop = coefficient / (2.0 * mean_radius(origin.lat)) * (enu[..., 0] ** 2 + enu[..., 1] ** 2)
    return torch.stack([enu[..., 0], enu[..., 1], enu[..., 2] - drop], -1)
