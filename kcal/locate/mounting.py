"""From a camera's pose in a local frame to where it stands on the Earth and where it looks, and back."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.result import RigResult
from kcal.errors import InputError
from kcal.lens.rig import Mounting, Origin, Rig, RigCovariance, half_of_covariance
from kcal.locate.geodesy import ecef_from_enu_rotation, enu_to_geodetic
from kcal.threads import in_one_thread

# Errors of where a rig stands at most: place, attitude, refraction.
MOUNTING_ERRORS = 7


def attitude(enu_from_cam: Tensor) -> tuple[float, float, float]:
    """Heading, pitch and roll in degrees of a rotation (3, 3): the inverse of `kcal.locate.geodesy.enu_from_cam`.

    Example:
        >>> from kcal.locate import enu_from_cam
        >>> [round(angle, 9) for angle in attitude(enu_from_cam(200.0, -3.0, 1.5))]
        [200.0, -3.0, 1.5]
    """
    right, forward = enu_from_cam[:, 0].tolist(), enu_from_cam[:, 2].tolist()
    heading = math.atan2(forward[0], forward[1])
    level = math.hypot(forward[0], forward[1])
    pitch = math.atan2(forward[2], level)
    sine, cosine = math.sin(heading), math.cos(heading)
    beside = right[0] * cosine - right[1] * sine
    below = math.sin(pitch) * (right[0] * sine + right[1] * cosine) - math.cos(pitch) * right[2]
    return math.degrees(heading) % 360.0, math.degrees(pitch), math.degrees(math.atan2(below, beside))


def mounting_of(
    cam_from_enu: Tensor,
    center: Tensor,
    covariance: Tensor,
    origin: Origin,
    link: Tensor | None = None,
    refraction: float | None = None,
) -> Mounting:
    """How a camera with a pose in the frame of `origin` stands where it is.

    North and up at the camera are not those at the origin: a kilometer apart they differ by 0.01° (up), and by that
    times the tangent of the latitude (north).

    Args:
        cam_from_enu: (3, 3).
        center: (3,) meters.
        covariance: (6, 6) of the center and of turns of the camera, both about the frame's axes; (7, 7) with the
            coefficient of refraction.
        origin: of the frame.
        link: (P, 6) or (P, 7) covariance of anything else with these.
        refraction: the coefficient, if anything was found of it.

    Example:
        >>> from kcal.locate import enu_from_cam
        >>> there = mounting_of(enu_from_cam(35.0).T, torch.zeros(3).double(), torch.eye(6).double(),
        ...                     Origin(lat=19.07, lon=72.87, height=14.0))
        >>> round(there.heading_deg, 9), round(there.origin.height, 6)
        (35.0, 14.0)
    """
    lat, lon, height = enu_to_geodetic(center, origin).tolist()
    turn = ecef_from_enu_rotation(lat, lon).T @ ecef_from_enu_rotation(origin.lat, origin.lon)
    both = torch.block_diag(turn, turn, torch.eye(len(covariance) - 6, dtype=torch.float64))
    heading, pitch, roll = attitude(turn @ cam_from_enu.T)
    return Mounting(
        origin=Origin(lat=lat, lon=lon, height=height),
        heading_deg=heading,
        pitch_deg=pitch,
        roll_deg=roll,
        covariance=both @ covariance @ both.T,
        link=None if link is None else link @ both.T,
        refraction=refraction,
    )


@in_one_thread
def placed_rig(result: RigResult, origin: Origin) -> Rig:
    """The rig of a result with everything that is known of it: also its mounting, if the data determine it.

    Args:
        result: from `kcal.solve_rig`; its first camera is the left one.
        origin: of the frame in which landmarks and positions were given.

    Example:
        >>> from kcal import Landmarks, RigData, solve_rig
        >>> from kcal.locate import enu_from_cam
        >>> from kcal.rig import planned_rig
        >>> rig, generator = planned_rig(), torch.Generator().manual_seed(0)
        >>> points = torch.rand(12, 3, dtype=torch.float64, generator=generator) * 40 + torch.tensor([-20, -10, 60])
        >>> landmarks = Landmarks(names=tuple("abcdefghijkl"), points=points @ enu_from_cam(0.0).T,
        ...                       sigma=torch.full((12, 3), 0.01).double(), pixels=rig(points)[0])
        >>> data = RigData(cameras=(rig.left, rig.right), names=("left", "right"), landmarks=landmarks)
        >>> found = placed_rig(solve_rig(data), Origin(lat=19.07, lon=72.87, height=14.0))
        >>> round(found.mounting.heading_deg, 6) % 360.0, found.covariance is None
        (0.0, False)
    """
    rig = result.stereo()
    covariance = result.mounting_covariance(0)
    if result.absolute and bool(torch.isfinite(covariance).all()):
        rig.mounting = mounting_of(
            result.rotation[0], result.center[0], covariance, origin, result.mounting_link(), result.refraction
        )
    return rig


@in_one_thread
def mounting_covariance(
    *, origin_m: Sequence[float] = (0.0, 0.0, 0.0), attitude_deg: Sequence[float] = (0.0, 0.0, 0.0)
) -> Tensor:
    """(6, 6) covariance of how a rig stands: east, north, up of its origin, and small turns about these axes.

    Args:
        origin_m: one sigma of the left camera's position, meters east, north, up.
        attitude_deg: one sigma of turns about the east, north and up axes, degrees; the last is the heading's.

    Example:
        >>> mounting_covariance(origin_m=(0.02, 0.02, 0.04), attitude_deg=(0, 0, 0.1)).diagonal()[:3].tolist()
        [0.0004, 0.0004, 0.0016]
    """
    values = torch.tensor([*origin_m, *attitude_deg], dtype=torch.float64)
    if values.shape != (6,) or not bool((torch.isfinite(values) & (values >= 0)).all()):
        raise InputError("mounting: three sigmas of the origin and three of the attitude are needed, none negative")
    return torch.diag(torch.cat([values[:3], torch.deg2rad(values[3:])]) ** 2)


class RunErrors(NamedTuple):
    """What a `Localizer` is told of a rig's errors.

    Attributes:
        calibration: of cameras and relative pose; None where nothing is known.
        mounting: (6, 6) or (7, 7) of origin and attitude, as in `Mounting`; None where all is exact.
        link: of the two with each other, as in `Mounting`.
    """

    calibration: RigCovariance | None
    mounting: Tensor | None
    link: Tensor | None


def run_errors(
    rig: Rig, *, yaw_deg: float = 0.0, heading_deg: float = 0.0, origin_m: float = 0.0, elsewhere: bool = False
) -> RunErrors:
    """The errors that a rig knows of itself, and independent ones that are stated besides.

    Args:
        rig: with its covariance and mounting, as far as they are known.
        yaw_deg: standard deviation of the relative yaw.
        heading_deg: of the heading.
        origin_m: of the origin along each axis.
        elsewhere: the rig does not stand as its mounting says, so that the mounting's errors are not its own.

    Example:
        >>> from kcal.rig import planned_rig
        >>> errors = run_errors(planned_rig(), origin_m=0.02)
        >>> errors.calibration is None, round(float(errors.mounting[0, 0]), 6)
        (True, 0.0004)
    """
    calibration, stored = rig.covariance, None if elsewhere else rig.mounting
    if yaw_deg:
        yaw = torch.zeros(6, 6, dtype=torch.float64)
        yaw[1, 1] = math.radians(yaw_deg) ** 2
        calibration = (calibration or RigCovariance.of(rig)).with_pose(yaw)
    mounting = mounting_covariance(origin_m=[origin_m] * 3, attitude_deg=(0.0, 0.0, heading_deg))
    if stored is not None and stored.covariance is not None:
        more = len(stored.covariance) - len(mounting)
        mounting = torch.nn.functional.pad(mounting, (0, more, 0, more)) + stored.covariance
    link = None if stored is None else stored.link
    return RunErrors(calibration, mounting if bool(mounting.any()) else None, link)


def by_mounting(enu: Tensor) -> Tensor:
    """(..., N, 3, 6) derivatives of ENU points by the origin and by small turns about the east, north and up axes."""
    e, n, u = enu.unbind(-1)
    zero = torch.zeros_like(e)
    turns = torch.stack([zero, u, -n, -u, zero, e, n, -e, zero], -1).unflatten(-1, (3, 3))
    still = torch.eye(3, dtype=enu.dtype, device=enu.device).expand(turns.shape)
    return torch.cat([still, turns], -1)


@torch.no_grad()
def rig_errors(
    size: int, factor: Tensor | None, mounting: Tensor | None, link: Tensor | None, errors: int | None = None
) -> Tensor | None:
    """(K, size + 7) root of what is known of two cameras, in the order of `RigCovariance`, and of their mounting.

    Args:
        size: quantities of the cameras.
        factor: (size, L) of them; its errors come first in the result.
        mounting: (7, 7).
        link: (size, 7) of the two with each other.
        errors: how many errors there are at least, some of them zero.
    """
    if factor is None and mounting is None:
        return None
    like = factor if mounting is None else mounting
    assert like is not None
    stands = like.new_zeros(MOUNTING_ERRORS, MOUNTING_ERRORS) if mounting is None else mounting
    half, left_over = like.new_zeros(0, size + MOUNTING_ERRORS), stands
    if factor is not None:
        # What the mounting owes to the calibration's errors: factor · ofᵀ = link.
        of = like.new_zeros(MOUNTING_ERRORS, factor.shape[1])
        if link is not None:
            scale = torch.linalg.vector_norm(factor, dim=1, keepdim=True)
            unit = torch.where(scale > 0, scale, 1.0)
            of = torch.linalg.lstsq(factor / unit, link / unit, driver="gelsd").solution.T
        half, left_over = torch.cat([factor, of]).T, stands - of @ of.T
    # What the calibration's errors explain is zero but for rounding.
    kept = left_over.diagonal() > 1e-12 * stands.diagonal()
    own = half_of_covariance(left_over * (kept[:, None] & kept))
    half = torch.cat([half, torch.nn.functional.pad(own, (size, 0))])
    return torch.nn.functional.pad(half, (0, 0, 0, max((errors or 0) - len(half), 0)))


@torch.no_grad()
def two_stations(rig: Rig, left: Tensor, origin: Origin | None, refraction: float, half: Tensor | None) -> Rig:
    """Two cameras as a rig in another frame, from which the left one is turned by `left`.

    halfᵀ half is the covariance of the quantities of `RigCovariance`, and of place, attitude and refraction.
    """
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


def station_mounting(rig: Rig, camera: int) -> Mounting:
    """How a camera stands: place on the Earth, heading, pitch and roll at its own vertical, and how well that is known.

    Raises:
        InputError: a rig without an origin.

    Example:
        >>> from kcal import Camera, Origin
        >>> from kcal.locate import enu_from_cam
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
