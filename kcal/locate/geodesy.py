"""The Earth as an ellipsoid, and coordinates on it."""

from __future__ import annotations

import math

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from kcal.checks import as_points, require_finite
from kcal.errors import InputError
from kcal.lens.projection import angle_over_distance
from kcal.lens.rig import Origin

# WGS84 in closed form: geodetic, Earth-centered (ECEF) and local east-north-up coordinates, in torch, differentiable.
#
# ECEF coordinates are millions of meters: float64 resolves 1e-9 m of them, float32 half a meter, so everything here is
# float64. Geodetic coordinates are latitude, longitude in degrees and meters above the ellipsoid, in this order.

# Semi-major axis in meters and flattening of WGS84 (NIMA TR8350.2).
SEMI_MAJOR = 6378137.0
FLATTENING = 1.0 / 298.257223563
SEMI_MINOR = SEMI_MAJOR * (1.0 - FLATTENING)
# First and second eccentricity, squared.
_E2 = FLATTENING * (2.0 - FLATTENING)
_E2_SECOND = _E2 / (1.0 - _E2)
# Bowring's formula starts from an error of latitude of 1e-3 rad at most; each pass multiplies it by about 1e-6 near
# the ground: one is good to a nanometer there, the second to heights of satellites.
_PASSES = 2
# Meters from the Earth's axis: closer points are at a pole, where a longitude has no gradient.
_AT_POLE = 1e-6
# Not `rad2deg` and `deg2rad`, whose factors ONNX files have in float32.
_DEGREES, _RADIANS = 180.0 / math.pi, math.pi / 180.0


def geodetic_to_ecef(geodetic: Tensor) -> Tensor:
    """Latitude, longitude (degrees), ellipsoidal height (meters) (..., 3) to ECEF meters (..., 3).

    Source: EPSG method 9602.

    Example:
        >>> geodetic_to_ecef(torch.tensor([0.0, 90.0, 10.0])).round(decimals=6).abs().tolist()
        [0.0, 6378147.0, 0.0]
    """
    lat, lon, height = as_points("geodetic", geodetic, 3).unbind(-1)
    lat, lon = lat * _RADIANS, lon * _RADIANS
    sine, cosine = torch.sin(lat), torch.cos(lat)
    normal = SEMI_MAJOR / torch.sqrt(1.0 - _E2 * sine * sine)
    level = (normal + height) * cosine
    return torch.stack([level * torch.cos(lon), level * torch.sin(lon), ((1.0 - _E2) * normal + height) * sine], -1)


def ecef_to_geodetic(ecef: Tensor) -> Tensor:
    """ECEF meters (..., 3) to latitude, longitude (degrees, -180 to 180), ellipsoidal height (meters).

    Bowring's formula, twice: no iteration, no branch, and finite gradients at the poles too (a longitude has none
    there). Good to a nanometer from 10 km below the ellipsoid to the height of satellites; not meant for the Earth's
    core.

    Source: Bowring (1976), Survey Review 23 (181), 323-327.

    Example:
        >>> place = torch.tensor([19.07, 72.87, 14.0], dtype=torch.float64)
        >>> bool(torch.allclose(ecef_to_geodetic(geodetic_to_ecef(place)), place, rtol=1e-14))
        True
    """
    x, y, z = as_points("ecef", ecef, 3).unbind(-1)
    lat, lon, distance = _angles(x, y, z)
    sine, cosine = torch.sin(lat), torch.cos(lat)
    # p cos φ + z sin φ - a √(1 - e² sin² φ) needs no division by a cosine that is zero at the poles.
    height = distance * cosine + z * sine - SEMI_MAJOR * torch.sqrt(1.0 - _E2 * sine * sine)
    return torch.stack([lat * _DEGREES, lon * _DEGREES, height], -1)


def latitude_longitude(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
    """The same of coordinates that are given one by one, without the height, degrees."""
    lat, lon, _ = _angles(x, y, z)
    return lat * _DEGREES, lon * _DEGREES


def _angles(x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Latitude and longitude in radians, and the distance from the Earth's axis."""
    squared = x * x + y * y
    off_axis = squared > _AT_POLE**2
    distance = torch.sqrt(torch.where(off_axis, squared, _AT_POLE**2))
    lon = arc_tangent(torch.where(off_axis, y, 0.0), torch.where(off_axis, x, 1.0))
    # As sine and cosine of the parametric latitude: tangents are infinite at the poles.
    up, out = z * SEMI_MAJOR, distance * SEMI_MINOR
    for _ in range(_PASSES):
        length = torch.sqrt(up * up + out * out)
        sine, cosine = up / length, out / length
        above = z + _E2_SECOND * SEMI_MINOR * sine**3
        beside = distance - _E2 * SEMI_MAJOR * cosine**3
        up, out = above * SEMI_MINOR, beside * SEMI_MAJOR
    return arc_tangent(above, beside), lon, distance


def arc_tangent(y: Tensor, x: Tensor) -> Tensor:
    """`torch.atan2` of float64; in exported graphs by square roots and a series, exact to rounding.

    Runtimes of ONNX have no arc tangent in float64.

    Example:
        >>> one = torch.ones(1, dtype=torch.float64)
        >>> torch.rad2deg(arc_tangent(one, -one)).tolist()
        [135.0]
    """
    if not torch.compiler.is_exporting():
        return torch.atan2(y, x)
    # Of the half-plane x > 0, so that nothing cancels; the other one is its mirror image.
    ahead = y * angle_over_distance(torch.zeros_like(y), y, x.abs())
    half_turn = y.new_tensor(math.pi)
    return torch.where(x < 0, torch.where(y < 0, -half_turn, half_turn) - ahead, ahead)


def ecef_from_enu_rotation(lat_deg: float, lon_deg: float) -> Tensor:
    """(3, 3) float64: the columns are east, north and up at a place, in ECEF axes.

    Example:
        >>> ecef_from_enu_rotation(0.0, 0.0).tolist()
        [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    """
    lat, lon = math.radians(lat_deg), math.radians(lon_deg)
    sp, cp, sl, cl = math.sin(lat), math.cos(lat), math.sin(lon), math.cos(lon)
    rows = [[-sl, -sp * cl, cp * cl], [cl, -sp * sl, cp * sl], [0.0, cp, sp]]
    return torch.tensor(rows, dtype=torch.float64) + 0.0


def mean_radius(lat_deg: float) -> float:
    """Gaussian mean radius √(M N) of the ellipsoid at a latitude, meters."""
    sine = math.sin(math.radians(lat_deg))
    return SEMI_MINOR / (1.0 - _E2 * sine * sine)


# From the rig to the Earth: the cameras' attitude, and east-north-up to WGS84 latitude, longitude and height.
#
# Conventions, all of them pinned by tests:
#
# * ENU: x east, y north, z up, tangent to the WGS84 ellipsoid at the origin, meters. Up is not height: at 5 km the
#   ellipsoid has fallen 1.96 m below the tangent plane, and the conversion here accounts for it.
# * Heights are ellipsoidal (WGS84, what GNSS receivers call HAE), not above mean sea level; the two differ by up to
#   100 m (`kcal.locate.tabulate` has the difference where a geoid grid is at hand).
# * Refraction of light is part of `Localizer`, not of this module: 0.26 m of height at 5 km in standard air.
# * Headings count clockwise from true north, not from magnetic or grid north
#   (`kcal.locate.tabulate` converts the latter).
# * Order is latitude, longitude, height everywhere but in GeoJSON.


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

    Source: EPSG methods 9836 (topocentric) and 9602 (geocentric).

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
    lat, lon, height = ecef_to_geodetic(enu @ ecef_from_enu.mT + ecef_of_origin).unbind(-1)
    return torch.stack([lat, torch.where(lon >= 180.0, lon - 360.0, lon), height], -1)


def geodetic_to_enu(geodetic: Tensor | ArrayLike, origin: Origin) -> Tensor:
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
    if str(getattr(geodetic, "dtype", "")).endswith("float32"):
        raise InputError("geodetic: float64 is needed; float32 has already rounded degrees by up to a meter")
    require_finite("geodetic", checked)
    if bool((checked[..., 0].abs() > 90).any()):
        raise InputError("geodetic: a latitude is outside -90 to 90; the order is latitude, longitude, height")
    rotation, translation = anchor(origin, checked.device)
    return (geodetic_to_ecef(checked) - translation) @ rotation
