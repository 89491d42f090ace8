"""From a camera's pose in a local frame to where it stands on the Earth and where it looks, and back."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.rig.result import RigResult
from kcal.errors import InputError
from kcal.lens.rig import REFRACTION, Mounting, Origin, Rig
from kcal.locate.geodesy import ecef_from_enu_rotation, enu_to_geodetic
from kcal.threads import in_one_thread

# Errors of where a rig stands at most: place, attitude, refraction.
MOUNTING_ERRORS = 7


def attitude(enu_from_cam: Tensor) -> tuple[float, float, float]:
    """Heading, pitch and roll in degrees of a rotation (3, 3): the inverse of `kcal.locate.enu_from_cam`.

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
    cam_from_enu: Tensor, center: Tensor, covariance: Tensor, origin: Origin, refraction: float = REFRACTION
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
        refraction: the coefficient.

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
        refraction=refraction,
    )


@in_one_thread
def placed_rig(result: RigResult, origin: Origin) -> Rig:
    """The rig of a result with its errors, and its mounting if the data determine it.

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
        stands = mounting_of(result.rotation[0], result.center[0], covariance, origin, result.refraction)
        rig.mounting = stands
        if (half := result.joint_half()) is not None:
            # From axes of the frame to those at the camera.
            turn = stands.enu_from_cam @ result.rotation[0]
            both = torch.block_diag(torch.eye(half.shape[1] - 7).double(), turn, turn, torch.ones(1, 1).double())
            rig.relative_root = half @ both.T
    return rig


@in_one_thread
def mounting_covariance(
    *, origin_m: Sequence[float] = (0.0, 0.0, 0.0), attitude_deg: Sequence[float] = (0.0, 0.0, 0.0)
) -> Tensor:
    """(6, 6) covariance of a mounting: east, north, up of its origin, and small turns about these axes.

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


def with_stated_errors(rig: Rig, *, yaw_deg: float = 0.0, heading_deg: float = 0.0, origin_m: float = 0.0) -> Rig:
    """Two cameras with independent errors that are stated besides those that the rig knows of itself.

    Args:
        rig: with what is known of it.
        yaw_deg: standard deviation of the relative yaw.
        heading_deg: of the heading.
        origin_m: of the origin along each axis.

    Example:
        >>> from kcal import Origin
        >>> from kcal.rig import planned_rig
        >>> rig = planned_rig().placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=35.0)
        >>> found = with_stated_errors(rig, origin_m=0.02)
        >>> found.covariance is None, round(float(found.mounting.covariance[0, 0]), 6)
        (True, 0.0004)
    """
    same, known = copy.copy(rig), rig.relative_root
    # Rotation and translation of the relative pose, place, attitude, refraction.
    sigma = [0.0, math.radians(yaw_deg), 0.0, 0.0, 0.0, 0.0, *[origin_m] * 3, 0.0, 0.0, math.radians(heading_deg), 0.0]
    more = torch.nn.functional.pad(torch.diag(rig.center.new_tensor(sigma)), (sum(rig.sizes), 0))
    more = more[more.any(1)]
    if len(more):
        same.relative_root = more if known is None else torch.cat([known, more])
    return same


def by_mounting(enu: Tensor) -> Tensor:
    """(..., N, 3, 6) derivatives of ENU points by the origin and by small turns about the east, north and up axes."""
    e, n, u = enu.unbind(-1)
    zero = torch.zeros_like(e)
    turns = torch.stack([zero, u, -n, -u, zero, e, n, -e, zero], -1).unflatten(-1, (3, 3))
    return torch.cat([torch.eye(3, dtype=enu.dtype, device=enu.device).expand(turns.shape), turns], -1)


@torch.no_grad()
def leveled(rig: Rig, look: Tensor, origin: Origin | None, refraction: float, errors: int | None = None) -> Rig:
    """The rig in another frame, from which its own is turned by `look` (3, 3); `errors` as for `Localizer.apart`."""
    look = look.to(rig.center)
    same = Rig(
        rig.each, rig.names, rig.rotation @ look.T, center=rig.center @ look.T, origin=origin, refraction=refraction
    )
    if rig.root is not None:
        root, count = rig.root.to(look), sum(rig.sizes)
        poses = (root[:, count:-1].unflatten(1, (-1, 3)) @ look.T).flatten(1)
        root = torch.cat([root[:, :count], poses, root[:, -1:]], 1)
        same.root = torch.nn.functional.pad(root, (0, 0, 0, max((errors or 0) - len(root), 0)))
    return same


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
