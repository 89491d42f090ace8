"""From the rig to the Earth: the cameras' attitude, and east-north-up to WGS84 latitude, longitude and height.

Conventions, all of them pinned by tests:

* ENU: x east, y north, z up, tangent to the WGS84 ellipsoid at the origin, meters. Up is not height: at 5 km the
  ellipsoid has fallen 1.96 m below the tangent plane, and the conversion here accounts for it.
* Heights are ellipsoidal (WGS84, what GNSS receivers call HAE), not above mean sea level; the two differ by up to
  100 m (`kcal.locate.datum` has the difference where a geoid grid is at hand).
* Refraction of light is part of `StereoLocalizer`, not of this module: 0.26 m of height at 5 km in standard air.
* Headings count clockwise from true north, not from magnetic or grid north (`kcal.locate.datum` converts the latter).
* Order is latitude, longitude, height everywhere but in GeoJSON.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.checks import as_points, require_finite
from kcal.errors import InputError
from kcal.lens.mounting import Origin
from kcal.locate.ellipsoid import ecef_from_enu_rotation, ecef_to_geodetic, geodetic_to_ecef


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
