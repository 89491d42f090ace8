"""Stations: rigs of any number of cameras on the Earth, from files and from pairs, and how each of them stands."""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.files import read_bytes
from kcal.io.rig_file import CameraRigFile, RigFile
from kcal.lens.rig import REFRACTION, REFRACTION_SIGMA, Mounting, Origin, Rig, half_of_covariance
from kcal.locate.geodesy import enu_from_cam
from kcal.locate.localizer import StereoLocalizer
from kcal.locate.mounting import attitude, mounting_of
from kcal.locate.multi_localizer import MultiViewLocalizer
from kcal.strict_json import MOST_BYTES, read_json

# Errors of where a rig stands at most: place, attitude, refraction.
MOUNTING_ERRORS = 7


def load_camera_rig(path: str | Path) -> Rig:
    """Read any rig file: one of many cameras, or one of two, named left and right.

    Raises:
        FileError: missing, not JSON, another kind of file, or a field that is wrong; it names the path.

    Example:
        >>> import tempfile
        >>> from kcal import save_rig
        >>> from kcal.rig import planned_rig
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     load_camera_rig(save_rig(planned_rig(), Path(folder, "rig.json"))).names
        ('left', 'right')
    """
    path = Path(path)
    content = read_json(read_bytes(path, MOST_BYTES), str(path))
    if isinstance(content, dict) and content.get("version") == CameraRigFile.VERSION:
        return CameraRigFile.parse(content, str(path)).rig()
    return stations_of(RigFile.parse(content, str(path)).rig())


def names_of_rig(path: str | Path) -> tuple[str, ...]:
    """Names of the cameras of a rig file, without reading more than that; left and right of a file of two."""
    path = Path(path)
    content = read_json(read_bytes(path, MOST_BYTES), str(path))
    names = content.get("names") if isinstance(content, dict) else None
    return tuple(map(str, names)) if isinstance(names, list) else ("left", "right")


def stations_of(rig: Rig) -> Rig:
    """A stereo rig as a rig of two cameras, with all that is known of it.

    The frame is east, north, up of the left camera if the rig says where it stands, and the left camera's otherwise.

    Example:
        >>> from kcal.rig import planned_rig
        >>> two = stations_of(planned_rig())
        >>> two.names, two.center.round(decimals=6).abs().tolist()
        (('left', 'right'), [[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]])
    """
    stands = rig.mounting
    left = torch.eye(3, dtype=torch.float64)
    if stands is not None:
        left = enu_from_cam(stands.heading_deg, stands.pitch_deg, stands.roll_deg).T
    bent = (REFRACTION if stands.refraction is None else stands.refraction) if stands else 0.0
    joint = _joint_covariance(rig)
    half = None if joint is None else half_of_covariance(joint)
    return _two_stations(rig, left, None if stands is None else stands.origin, bent, half)


def stations_at(localize: StereoLocalizer, *, errors: int | None = None) -> MultiViewLocalizer:
    """The rig of a `StereoLocalizer` as a rig of two cameras, with where it stands and all that it includes.

    Args:
        localize: the rig, where it stands, and how well both are known.
        errors: how many shared errors the result has, some of them zero: a filter needs as many at every moment, and
            those of the calibration in the same order.

    Example:
        >>> from kcal import Origin
        >>> from kcal.rig import planned_rig
        >>> localize = StereoLocalizer(planned_rig(), origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
        >>> stations_at(localize).rig.names
        ('left', 'right')
    """
    rig, factor, stands = localize.rig, localize.calibration_factor, localize.mounting
    size, half = rig.left.values.shape[-1] + rig.right.values.shape[-1] + 6, None
    if factor is not None or stands is not None:
        left = localize.enu_from_rig
        half = left.new_zeros(0, size + 7)
        left_over = left.new_zeros(7, 7) if stands is None else stands
        if factor is not None:
            # What the mounting owes to the calibration's errors: factor · ofᵀ = link.
            of = left.new_zeros(7, factor.shape[1])
            if localize.link is not None:
                scale = torch.linalg.vector_norm(factor, dim=1, keepdim=True)
                unit = torch.where(scale > 0, scale, 1.0)
                of = torch.linalg.lstsq(factor / unit, localize.link / unit, driver="gelsd").solution.T
            half, left_over = torch.cat([factor, of]).T, left_over - of @ of.T
        own = half_of_covariance(left_over)
        half = torch.cat([half, torch.nn.functional.pad(own, (size, 0))])
        half = torch.nn.functional.pad(half, (0, 0, 0, max((errors or 0) - len(half), 0)))
    left = localize.enu_from_rig.T
    stations = _two_stations(rig, left, localize.origin, float(localize.refraction), half)
    return MultiViewLocalizer(stations, pixel_sigma=float(localize.pixel_sigma))


@torch.no_grad()
def _two_stations(rig: Rig, left: Tensor, origin: Origin | None, refraction: float, half: Tensor | None) -> Rig:
    """A stereo rig whose left camera is turned by `left` from the frame; halfᵀ half as in `_joint_covariance`."""
    shift = rig.right_from_left_translation
    left = left.to(shift)
    right = rig.right_from_left_rotation @ left
    apart = -right.T @ shift
    centers = torch.stack([torch.zeros_like(apart), apart])
    stations = Rig(
        [rig.left, rig.right], ("left", "right"), torch.stack([left, right]), center=centers, origin=origin,
        refraction=refraction,
    )  # fmt: skip
    if half is None:
        return stations
    size = half.shape[1] - 7
    half, by = half.to(shift), shift.new_zeros(stations.quantities, half.shape[1])
    lenses = size - 6
    by[:lenses, :lenses] = torch.eye(lenses).to(shift)
    turn, move, center, attitude = (slice(size + at, size + at + 3) for at in (-6, -3, 0, 3))
    still = torch.eye(3).to(shift)
    first, second = stations.pose_columns(0).start, stations.pose_columns(1).start
    by[first : first + 3, center], by[first + 3 : first + 6, attitude] = still, still
    by[second : second + 3, center] = still
    by[second : second + 3, attitude] = -_crossed(apart)
    by[second : second + 3, turn] = -right.T @ _crossed(shift)
    by[second : second + 3, move] = -right.T
    by[second + 3 : second + 6, attitude], by[second + 3 : second + 6, turn] = still, -right.T
    by[-1, -1] = 1.0
    stations.root = half @ by.T
    return stations


def _crossed(vector: Tensor) -> Tensor:
    """(3, 3) with `_crossed(v) @ w` = v × w."""
    x, y, z = vector.tolist()
    return vector.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _joint_covariance(rig: Rig) -> Tensor | None:
    """(P + 7, P + 7) of the calibration and the mounting of a rig; None where nothing is known."""
    known, stands = rig.covariance, rig.mounting
    if known is None and (stands is None or stands.covariance is None):
        return None
    size = rig.left.values.shape[-1] + rig.right.values.shape[-1] + 6
    whole = rig.right_from_left_translation.new_zeros(size + 7, size + 7)
    if known is not None:
        whole[:size, :size] = known.matrix
    if stands is not None:
        whole[-1, -1] = REFRACTION_SIGMA**2
        if stands.covariance is not None:
            count = len(stands.covariance)
            whole[size : size + count, size : size + count] = stands.covariance
            if stands.link is not None:
                whole[:size, size : size + count] = stands.link
                whole[size : size + count, :size] = stands.link.T
    return whole


def station_mounting(rig: Rig, camera: int) -> Mounting:
    """How a camera stands: place on the Earth, heading, pitch and roll at its own vertical, and how well that is known.

    Raises:
        InputError: a rig without an origin.

    Example:
        >>> from kcal import Camera, Origin
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), model="pinhole")
        >>> there = torch.tensor([[0.0, 50_000.0, 0.0]])  # north of the origin, where the Earth has curved away
        >>> rig = Rig([camera], ["tower"], enu_from_cam(90.0).T[None], center=there,
        ...                 origin=Origin(lat=45.0, lon=6.0, height=0.0))
        >>> stands = station_mounting(rig, 0)
        >>> round(stands.origin.height), round(stands.heading_deg, 3), round(stands.roll_deg, 3)
        (196, 90.0, 0.45)
    """
    if rig.origin is None:
        raise InputError("this rig has no place on the Earth: give it an origin")
    covariance = torch.zeros(7, 7, dtype=torch.float64)
    if rig.root is not None:
        own = torch.cat([rig.root[:, rig.pose_columns(camera)], rig.root[:, -1:]], 1)
        covariance = own.T @ own
    return mounting_of(
        rig.rotation[camera], rig.center[camera], covariance, rig.origin, refraction=float(rig.refraction)
    )


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
