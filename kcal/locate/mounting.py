"""From a camera's pose in a local frame to where it stands on the Earth and where it looks, and back."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.locate.ellipsoid import ecef_from_enu_rotation
from kcal.locate.geodesy import Origin, enu_to_geodetic


class Mounting(NamedTuple):
    """How a camera stands; angles as in `kcal.locate.geodesy.enu_from_cam`.

    Attributes:
        origin: of the camera's projection center.
        heading_deg: clockwise from true north, 0 to 360.
        pitch_deg: positive up.
        roll_deg: clockwise as seen from behind.
        covariance: (6, 6) of east, north, up (meters) and of turns about these axes (radians), all at the camera.
        link: (P, 6) covariance of other quantities with these six.
    """

    origin: Origin
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    covariance: Tensor
    link: Tensor


def attitude(enu_from_cam: Tensor) -> tuple[float, float, float]:
    """Heading, pitch and roll in degrees of a rotation (3, 3): the inverse of `kcal.locate.geodesy.enu_from_cam`.

    Example:
        >>> from kcal.locate.geodesy import enu_from_cam
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
    cam_from_enu: Tensor, center: Tensor, covariance: Tensor, origin: Origin, link: Tensor | None = None
) -> Mounting:
    """How a camera with a pose in the frame of `origin` stands where it is.

    North and up at the camera are not those at the origin: a kilometer apart they differ by 0.01° (up), and by that
    times the tangent of the latitude (north).

    Args:
        cam_from_enu: (3, 3).
        center: (3,) meters.
        covariance: (6, 6) of the center and of turns of the camera, both about the frame's axes.
        origin: of the frame.
        link: (P, 6) covariance of anything else with these six.

    Example:
        >>> from kcal.locate.geodesy import enu_from_cam
        >>> there = mounting_of(enu_from_cam(35.0).T, torch.zeros(3).double(), torch.eye(6).double(),
        ...                     Origin(lat=19.07, lon=72.87, height=14.0))
        >>> round(there.heading_deg, 9), round(there.origin.height, 6)
        (35.0, 14.0)
    """
    lat, lon, height = enu_to_geodetic(center, origin).tolist()
    here = Origin(lat=lat, lon=lon, height=height)
    turn = ecef_from_enu_rotation(lat, lon).T @ ecef_from_enu_rotation(origin.lat, origin.lon)
    both = torch.block_diag(turn, turn)
    link = torch.zeros(0, 6, dtype=torch.float64) if link is None else link
    return Mounting(here, *attitude(turn @ cam_from_enu.T), both @ covariance @ both.T, link @ both.T)
