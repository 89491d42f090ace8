"""Stations: rigs of any number of cameras on the Earth, from files and from pairs, and how each of them stands."""

from __future__ import annotations

from pathlib import Path

from torch import Tensor

from kcal.files import read_bytes
from kcal.lens.rig import Rig
from kcal.locate.localizer import Localizer
from kcal.locate.mounting import attitude, station_mounting
from kcal.strict_json import MOST_BYTES, read_json


def names_of_rig(path: str | Path) -> tuple[str, ...]:
    """Names of the cameras of a rig file, without reading more than that; left and right of a file of two."""
    path = Path(path)
    content = read_json(read_bytes(path, MOST_BYTES), str(path))
    names = content.get("names") if isinstance(content, dict) else None
    return tuple(map(str, names)) if isinstance(names, list) else ("left", "right")


def stations_of(rig: Rig) -> Rig:
    """A rig whose errors are those of each camera's pose (`Rig.root`): one of two cameras is changed into that.

    The frame is then east, north, up of the left camera if the rig says where it stands, and the left camera's
    otherwise.

    Example:
        >>> from kcal.rig import planned_rig
        >>> two = stations_of(planned_rig())
        >>> two.names, two.center.round(decimals=6).abs().tolist()
        (('left', 'right'), [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    """
    return Localizer(rig, weights="all").rig


def station_stands(rig: Rig, camera: int) -> tuple[tuple[float, ...], tuple[float, ...], Tensor | None]:
    """Place, then heading, pitch and roll (degrees), and their covariance, of a camera.

    The place is latitude, longitude, height where the rig has an origin, otherwise meters of its frame, whose axes are
    taken as east, north and up.
    """
    if rig.origin is not None:
        stands = station_mounting(rig, camera)
        place = (stands.origin.lat, stands.origin.lon, stands.origin.height)
        return place, (stands.heading_deg, stands.pitch_deg, stands.roll_deg), stands.covariance
    half = None if rig.root is None else rig.root[:, rig.pose_columns(camera)]
    covariance = None if half is None else half.T @ half
    return tuple(rig.center[camera].tolist()), attitude(rig.rotation[camera].T), covariance
