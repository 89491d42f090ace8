"""Stations: rigs of any number of cameras on the Earth, from files and from pairs, and how each of them stands."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from kcal.errors import FileError, InputError
from kcal.gaussian import half_of_covariance
from kcal.lens.camera import Camera
from kcal.lens.pose import enu_from_cam
from kcal.lens.rig import REFRACTION, REFRACTION_SIGMA, Mounting, Origin, Rig
from kcal.locate.geodesy import ecef_from_enu_rotation, geodetic_to_enu
from kcal.locate.localizer import Localizer
from kcal.locate.mounting import attitude, station_mounting
from kcal.locate.survey import EARTH, place_sigma, refuse_exchanged
from kcal.locate.tables import TableRow, read_rows


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
    """Place, then heading, pitch and roll (degrees), and their covariance (6, 6) in meters and radians, of a camera.

    The place is latitude, longitude, height where the rig has an origin, otherwise meters of its frame, whose axes are
    taken as east, north and up.
    """
    if rig.origin is not None:
        stands = station_mounting(rig, camera)
        place = (stands.origin.lat, stands.origin.lon, stands.origin.height)
        angles, covariance = (stands.heading_deg, stands.pitch_deg, stands.roll_deg), stands.covariance
    else:
        half = None if rig.root is None else rig.root[:, rig.pose_columns(camera)]
        covariance = None if half is None else half.T @ half
        place, angles = tuple(rig.center[camera].tolist()), attitude(rig.rotation[camera].T)
    if covariance is not None:
        # Straight down, heading and roll are one turn.
        by = torch.block_diag(torch.eye(3).double(), torch.linalg.pinv(_axes(*angles)))
        covariance = by @ covariance[:6, :6] @ by.T
    return place, angles, covariance


def _axes(heading_deg: float, pitch_deg: float, roll_deg: float) -> Tensor:
    """(3, 3) columns: the axes about which heading, pitch and roll turn a camera: down, to its right, and ahead."""
    level, forward = enu_from_cam(heading_deg), enu_from_cam(heading_deg, pitch_deg, roll_deg)[:, 2]
    return torch.stack([level[:, 1], level[:, 0], forward], 1)


# Stations of which the pose is known beforehand: no landmarks are needed.


def stated_mounting(
    origin: Origin,
    *,
    heading_deg: tuple[float, float],
    pitch_deg: tuple[float, float],
    roll_deg: tuple[float, float] = (0.0, 0.0),
    sigma_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Mounting:
    """The mounting of a camera from measured position and angles, each with its standard deviation.

    Args:
        origin: its place.
        heading_deg: azimuth of the optical axis from true north at the camera, and its sigma, degrees.
        pitch_deg: elevation of the optical axis above the horizon there, likewise.
        roll_deg: likewise; positive clockwise as seen from behind the camera.
        sigma_m: of the place, east, north and up.

    Raises:
        InputError: an angle out of range, or a sigma that is negative or not finite.

    Example:
        >>> place = Origin(lat=46.0, lon=7.0, height=2100.0)
        >>> drone = stated_mounting(place, heading_deg=(90.0, 1.0), pitch_deg=(-30.0, 0.5))
        >>> drone.covariance[3:, 3:].diagonal().sqrt().rad2deg().round(decimals=6).tolist()
        [0.0, 0.5, 1.0]
    """
    (heading, pitch, roll), sigma_deg = zip(heading_deg, pitch_deg, roll_deg, strict=True)
    sigma = torch.tensor([*sigma_m, *map(math.radians, sigma_deg)], dtype=torch.float64)
    if not bool((sigma.isfinite() & (sigma >= 0)).all()):
        raise InputError("a station: sigmas must be finite and not negative")
    by = torch.block_diag(torch.eye(3).double(), _axes(heading, pitch, roll)) * sigma
    return Mounting(origin=origin, heading_deg=heading, pitch_deg=pitch, roll_deg=roll, covariance=by @ by.T)


# Columns of a table of known poses.
_STAND_COLUMNS = ("name", *EARTH, "sigma", "sigma_up", "heading", "heading_sigma", "pitch", "pitch_sigma", "roll",
                  "roll_sigma")  # fmt: skip
_STAND_HEADER = "name,lat,lon,height,sigma,heading,heading_sigma,pitch,pitch_sigma"


def read_stands(path: str | Path, names: Sequence[str] | None = None) -> dict[str, Mounting]:
    """How cameras stand, from a table `name,lat,lon,height,sigma,heading,heading_sigma,pitch,pitch_sigma`.

    Degrees, meters above the WGS84 ellipsoid, meters; `sigma_up` is that of the height where it differs. Without `roll`
    a camera is level, known as well as its pitch.

    Args:
        path: CSV.
        names: of the cameras; None: all lines of the table.

    Raises:
        FileError: see `kcal.locate.tables.read_rows`; a value out of range, no sigma, or a camera without a line.
    """
    rows = {row.name: row for row in read_rows(path, _STAND_HEADER, _STAND_COLUMNS, _STAND_HEADER.split(",")[1:])}
    degrees = [[row.number(column, "decimal degrees") for column in EARTH[:2]] for row in rows.values()]
    refuse_exchanged([*rows.values()], torch.tensor(degrees, dtype=torch.float64))
    found = {}
    for name in rows if names is None else names:
        if name not in rows:
            raise FileError(f"{path}: no line is named {name!r}; a line for each camera is needed, named as its file")
        row = rows[name]
        lat, lon = (row.number(column, "decimal degrees") for column in EARTH[:2])
        pitch = _stated_angle(row, "pitch")
        roll = _stated_angle(row, "roll") if row.cells.get("roll") else (0.0, pitch[1])
        try:
            place = Origin(lat=lat, lon=lon, height=row.number("height", "a number in meters"))
            found[name] = stated_mounting(
                place, heading_deg=_stated_angle(row, "heading"), pitch_deg=pitch, roll_deg=roll,
                sigma_m=place_sigma(row, "place"),
            )  # fmt: skip
        except InputError as error:
            raise FileError(f"{row.where}: {error}") from None
    return found


def _stated_angle(row: TableRow, name: str) -> tuple[float, float]:
    sigma = row.positive(f"{name}_sigma")
    if sigma is None:
        raise FileError(f"{row.where}: {name}_sigma is empty; write how well it is known, degrees")
    return row.number(name, "a number in degrees"), sigma


def station_rig(
    cameras: Mapping[str, Camera],
    stands: Sequence[Mounting],
    *,
    refraction: float = REFRACTION,
    refraction_sigma: float = REFRACTION_SIGMA,
) -> Rig:
    """The rig of cameras whose mountings are known: the inverse of `station_mounting`.

    North and up are those at each camera: 60 km apart they differ by half a degree, which is 500 m at that distance.
    Errors of the cameras' poses are independent of each other. Errors of one lens at several places are the same at
    each.

    Args:
        cameras: each with its name; one or more.
        stands: how each stands, with errors as `stated_mounting` gives them; the rig's frame is east, north, up at the
            first one.
        refraction: coefficient of refraction of light.
        refraction_sigma: its standard deviation.

    Raises:
        InputError: no camera, or not one stand for each.

    Example:
        >>> from kcal import Localizer
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> place = Origin(lat=46.0, lon=7.0, height=1600.0)
        >>> above = stated_mounting(place, heading_deg=(0.0, 1.0), pitch_deg=(-45.0, 1.0))
        >>> seen = Localizer(station_rig({"drone": camera}, [above]))(
        ...     torch.tensor([[[960.0, 540.0]]]), height=torch.tensor([600.0])
        ... )
        >>> round(float(seen.range[0]), 1)
        1414.3
    """
    if not cameras or len(cameras) != len(stands):
        raise InputError(f"{len(cameras)} cameras and {len(stands)} places of cameras: one for each is needed")
    origin = stands[0].origin
    ecef_from_frame = ecef_from_enu_rotation(origin.lat, origin.lon)
    local_from_frame = [ecef_from_enu_rotation(one.origin.lat, one.origin.lon).T @ ecef_from_frame for one in stands]
    looks = [enu_from_cam(one.heading_deg, one.pitch_deg, one.roll_deg) for one in stands]
    rotation = [look.T @ turn for look, turn in zip(looks, local_from_frame, strict=True)]
    center = geodetic_to_enu(torch.stack([one.origin.geodetic for one in stands]), origin)
    rig = Rig(
        [*cameras.values()], [*cameras], torch.stack(rotation), center=center, origin=origin, refraction=refraction
    )
    rows = [rig.with_errors(refraction=refraction_sigma)]
    for camera, (own, stand, turn) in enumerate(zip(cameras.values(), stands, local_from_frame, strict=True)):
        if stand.covariance is not None:
            both = torch.block_diag(turn, turn)
            half = half_of_covariance(both.T @ stand.covariance[:6, :6] @ both)
            rows.append(half.new_zeros(len(half), rig.quantities))
            rows[-1][:, rig.pose_columns(camera)] = half
        everywhere = [number for number, other in enumerate(cameras.values()) if other is own]
        known = None if own.calibration is None else own.calibration.covariance
        if known is not None and everywhere[0] == camera:
            half = half_of_covariance(known)
            rows.append(half.new_zeros(len(half), rig.quantities))
            for number in everywhere:
                first = sum(rig.sizes[:number])
                rows[-1][:, first : first + len(known)] = half
    rig.root = torch.cat(rows)
    return rig
