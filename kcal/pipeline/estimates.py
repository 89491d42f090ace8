"""From what is believed of tracks in the rig frame to places and velocities on the Earth, with all their errors."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.locate.geodesy import place_enu
from kcal.locate.multi_localizer import MultiViewLocalizer
from kcal.locate.ranges import BEARING_SIGMAS, range_interval
from kcal.locate.stereo import PositionStatus, flag_positions, status_counts
from kcal.pipeline.imm_filter import Summary
from kcal.pipeline.small_matrices import product, rooted, squared
from kcal.texts import brief


class TrackStates(NamedTuple):
    """Places of T tracks at one moment; nothing is NaN. Look at `status` before anything else.

    Attributes:
        enu: (T, 3) meters east, north, up in the rig's frame (of two cameras: from the left one); zeros unless the
            status is OK.
        covariance: (T, 3, 3) of `enu`; an infinite diagonal unless OK.
        systematic: (T, 3, 3) the part of it that more frames do not reduce: calibration, mounting, clocks,
            refraction, and what lasts of errors in the marks.
        velocity: (T, 3) m/s east, north, up; zeros unless OK.
        velocity_covariance: (T, 3, 3); an infinite diagonal unless OK.
        geodetic: (T, 3) latitude, longitude (degrees), ellipsoidal height (meters); the origin unless OK.
        range_low: (T,) meters from the anchor, lower end of the 95 % interval.
        range_high: (T,) its upper end, infinite where the target may be at infinity.
        status: (T,) int8 codes of `PositionStatus`: OK, BEARING_ONLY or PARALLEL.
        bearing: (T, 3) unit vector east, north, up, from the anchor to the target; light bends beside it.
        inverse_range: (T,) one over meters: the quantity whose errors are Gaussian.
        inverse_range_sigma: (T,).
        anchor: (T,) int64, number of the camera from which bearing and range count: the first that saw the target.
    """

    enu: Tensor
    covariance: Tensor
    systematic: Tensor
    velocity: Tensor
    velocity_covariance: Tensor
    geodetic: Tensor
    range_low: Tensor
    range_high: Tensor
    status: Tensor
    bearing: Tensor
    inverse_range: Tensor
    inverse_range_sigma: Tensor
    anchor: Tensor

    def __repr__(self) -> str:
        return brief(self, status=status_counts(self.status))


def track_states(
    localize: MultiViewLocalizer, frame: Tensor, home: Tensor, beliefs: Summary, root: Tensor | None
) -> TrackStates:
    """Place beliefs on the Earth.

    Args:
        localize: the rig and where it stands.
        frame: (T, 3, 3) rotations from the rig's axes into the tracks' frames.
        home: (T,) cameras from which the tracks are told.
        beliefs: of T tracks.
        root: (B, R) of the covariance of the shared errors; None: the identity.
    """
    mean, noise, effect = (value.movedim(0, -1) for value in beliefs)
    spread = rooted(effect, root)
    axes = frame.movedim(0, -1).transpose(0, 1)
    ray = torch.cat([mean[:2], torch.ones_like(mean[:1])])
    squares = ray.square().sum(0)
    length = squares.sqrt()
    inverse_range = mean[2] / length
    slope = torch.cat([-inverse_range * ray[:2] / squares, (1.0 / length)[None]])
    variance = ((slope[:, None] * noise[:3, :3]).sum(0) * slope).sum(0)
    sigma = (variance + (slope[:, None] * spread[:3]).sum(0).square().sum(0)).clamp_min(0.0).sqrt()
    status = torch.zeros_like(inverse_range, dtype=torch.int8)
    status = flag_positions(status, inverse_range < BEARING_SIGMAS * sigma, PositionStatus.BEARING_ONLY)
    status = flag_positions(status, inverse_range <= 0, PositionStatus.PARALLEL)
    ok = status == int(PositionStatus.OK)
    interval = range_interval(inverse_range, sigma)

    depth = 1.0 / torch.where(ok, mean[2], 1.0)
    bearing = (axes * ray).sum(1)
    straight, velocity = bearing * depth, (axes * mean[3:]).sum(1) * depth
    # East, north, up and the velocity by the state.
    none = torch.zeros_like(axes)
    by_place = torch.cat([axes[:, :2], -straight[:, None], none], 1)
    by_state = torch.cat([by_place, torch.cat([none[:, :2], -velocity[:, None], axes], 1)]) * depth
    carried = product(by_state, torch.cat([noise, spread], 1))
    random, systematic = product(carried[:, :6], by_state.transpose(0, 1)), squared(carried[:, 6:])
    enu = localize.rig.center[home] + straight.T
    whole, systematic = (value.movedim(-1, 0) for value in (random + systematic, systematic))
    nowhere = torch.diag(mean.new_full((3,), math.inf))
    there = ok[:, None, None]
    assert localize.ecef_from_enu is not None
    geodetic = place_enu(enu, localize.ecef_from_enu, localize.ecef_of_origin)
    return TrackStates(
        enu=torch.where(ok[:, None], enu, 0.0),
        covariance=torch.where(there, whole[:, :3, :3], nowhere),
        systematic=torch.where(there, systematic[:, :3, :3], nowhere),
        velocity=torch.where(ok[:, None], velocity.T, 0.0),
        velocity_covariance=torch.where(there, whole[:, 3:, 3:], nowhere),
        geodetic=torch.where(ok[:, None], geodetic, localize.geodetic_of_origin),
        range_low=interval.low,
        range_high=interval.high,
        status=status,
        bearing=(bearing / length).T,
        inverse_range=inverse_range,
        inverse_range_sigma=sigma,
        anchor=home,
    )
