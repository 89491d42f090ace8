"""Places and fields of view as a map draws them: latitude and longitude, computed on the ellipsoid."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.lens.mounting import Origin
from kcal.locate.geodesy import enu_to_geodetic
from kcal.locate.region import Ring, near
from kcal.locate.tabulate import Viewpoint

_RIM_POINTS = 60


def map_places(enu: Tensor, origin: Origin) -> Ring:
    """Latitude and longitude in degrees of places (N, 3) in meters east, north, up of the origin.

    Longitudes lie within half a turn of the origin's: beyond ±180 across the antimeridian.

    Example:
        >>> lat, lon = map_places(torch.tensor([[0.0, 0.0, 0.0]]), Origin(lat=19.0, lon=72.9, height=0.0))[0]
        >>> round(lat, 9), round(lon, 9)
        (19.0, 72.9)
    """
    geodetic = enu_to_geodetic(enu.detach().cpu().double(), origin).tolist()
    return [(lat, near(lon, origin.lon)) for lat, lon, _ in geodetic]


def camera_place(camera: Viewpoint, origin: Origin) -> tuple[float, float]:
    """Latitude and longitude in degrees of a camera, its longitude within half a turn of the origin's."""
    return camera.geodetic[0], near(camera.geodetic[1], origin.lon)


def level_rim(foot: tuple[float, float, float], azimuths_deg: Tensor, reach: float) -> Tensor:
    """Places (N, 3) in meters east, north, up at a distance from a foot, in directions clockwise from north."""
    angle = torch.deg2rad(azimuths_deg)
    rim = torch.stack([angle.sin(), angle.cos(), torch.zeros_like(angle)], -1) * reach
    return rim + torch.tensor(foot, dtype=torch.float64)


def field_azimuths(camera: Viewpoint, count: int = _RIM_POINTS) -> Tensor | None:
    """Azimuths (count,) in degrees from the left end of a camera's field of view to its right end, without a jump.

    None if the lens model has no ray there.
    """
    if camera.azimuths_deg is None:
        return None
    first, last = camera.azimuths_deg
    return torch.linspace(first, first + (last - first) % 360, count, dtype=torch.float64)


def field_of_view(camera: Viewpoint, origin: Origin, reach: float) -> Ring | None:
    """Outline of what a camera sees, up to a distance in meters: its foot and an arc; None if it is not known."""
    sweep = field_azimuths(camera)
    if sweep is None:
        return None
    foot = torch.tensor([camera.enu], dtype=torch.float64)
    return map_places(torch.cat([foot, level_rim(camera.enu, sweep, reach)]), origin)
