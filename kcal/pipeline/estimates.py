"""From what is believed of tracks in the rig frame to places and velocities on the Earth, with all their errors."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.locate.geodesy import place_enu
from kcal.locate.localizer import StereoLocalizer
from kcal.locate.mounting import by_mounting
from kcal.locate.ranges import BEARING_SIGMAS, range_interval
from kcal.locate.stereo import PositionStatus, flag_positions
from kcal.pipeline.beliefs import Summary


class TrackStates(NamedTuple):
    """Places of T tracks at one moment; nothing is NaN. Look at `status` before anything else.

    Attributes:
        enu: (T, 3) meters east, north, up of the left camera; zeros unless the status is OK.
        covariance: (T, 3, 3) of `enu`; an infinite diagonal unless OK.
        systematic: (T, 3, 3) the part of it that more frames do not reduce: calibration, mounting, clocks,
            refraction, and what lasts of errors in the marks.
        velocity: (T, 3) m/s east, north, up; zeros unless OK.
        velocity_covariance: (T, 3, 3); an infinite diagonal unless OK.
        geodetic: (T, 3) latitude, longitude (degrees), ellipsoidal height (meters); the origin unless OK.
        range_low: (T,) meters from the left camera, lower end of the 95 % interval.
        range_high: (T,) its upper end, infinite where the target may be at infinity.
        status: (T,) int8 codes of `PositionStatus`: OK, BEARING_ONLY or PARALLEL.
        bearing: (T, 3) unit vector east, north, up.
        inverse_range: (T,) one over meters: the quantity whose errors are Gaussian.
        inverse_range_sigma: (T,).
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


def track_states(localize: StereoLocalizer, frame: Tensor, beliefs: Summary, root: Tensor) -> TrackStates:
    """Place beliefs on the Earth.

    Args:
        localize: the rig and where it stands.
        frame: (T, 3, 3) rotations from the rig's axes into the tracks' frames.
        beliefs: of T tracks.
        root: (B, R) of the covariance of the shared errors.
    """
    spread = beliefs.effect @ root
    mean = beliefs.mean
    axes = localize.enu_from_rig @ frame.mT
    ray = torch.cat([mean[:, :2], torch.ones_like(mean[:, :1])], -1)
    length = torch.linalg.vector_norm(ray, dim=-1)
    inverse_range = mean[:, 2] / length
    slope = torch.cat([-mean[:, 2:3] * ray[:, :2] / length[:, None] ** 3, 1.0 / length[:, None]], -1)
    noise = beliefs.noise
    variance = (slope[:, None] @ noise[:, :3, :3])[:, 0].mul(slope).sum(-1)
    variance = variance + (slope[:, None] @ spread[:, :3])[:, 0].square().sum(-1)
    sigma = variance.clamp_min(0.0).sqrt()
    status = torch.zeros_like(mean[:, 0], dtype=torch.int8)
    status = flag_positions(status, inverse_range < BEARING_SIGMAS * sigma, PositionStatus.BEARING_ONLY)
    status = flag_positions(status, inverse_range <= 0, PositionStatus.PARALLEL)
    ok = status == int(PositionStatus.OK)
    interval = range_interval(inverse_range, sigma)

    depth = 1.0 / torch.where(ok, mean[:, 2], 1.0)
    straight = (axes @ ray[..., None])[..., 0] * depth[:, None]
    velocity = (axes @ mean[:, 3:, None])[..., 0] * depth[:, None]
    by_state = torch.zeros(len(mean), 6, 6).to(mean)
    by_state[:, :3, :2] = axes[..., :2] * depth[:, None, None]
    by_state[:, :3, 2] = -straight * depth[:, None]
    by_state[:, 3:, 2] = -velocity * depth[:, None]
    by_state[:, 3:, 3:] = axes * depth[:, None, None]
    shared = by_state @ spread
    random, systematic = by_state @ noise @ by_state.mT, shared @ shared.mT
    level = straight[:, :2].square().sum(-1)
    enu = straight - localize.drop * torch.nn.functional.pad(level[:, None], (2, 0))
    if localize.mounting is not None:
        bent = torch.nn.functional.pad(-localize.half_curvature * level[:, None, None], (0, 0, 2, 0))
        still = torch.zeros(len(mean), 3, 3).to(mean)
        turn = torch.cat([torch.cat([by_mounting(enu), bent], -1),
                          torch.cat([still, by_mounting(velocity)[..., 3:], still[..., :1]], -1)], 1)  # fmt: skip
        systematic = systematic + turn @ localize.mounting @ turn.mT
        if localize.link is not None and localize.calibration_factor is not None:
            link = torch.linalg.pinv(localize.calibration_factor) @ localize.link
            own = beliefs.effect[..., : len(link)]
            mixed = -by_state @ own @ link @ turn.mT
            systematic = systematic + mixed + mixed.mT
    whole = random + systematic
    nowhere = torch.diag(mean.new_full((3,), math.inf))
    there = ok[:, None, None]
    geodetic = place_enu(enu, localize.ecef_from_enu, localize.ecef_of_origin)
    return TrackStates(
        enu=torch.where(ok[:, None], enu, 0.0),
        covariance=torch.where(there, whole[:, :3, :3], nowhere),
        systematic=torch.where(there, systematic[:, :3, :3], nowhere),
        velocity=torch.where(ok[:, None], velocity, 0.0),
        velocity_covariance=torch.where(there, whole[:, 3:, 3:], nowhere),
        geodetic=torch.where(ok[:, None], geodetic, localize.geodetic_of_origin),
        range_low=interval.low,
        range_high=interval.high,
        status=status,
        bearing=(axes @ ray[..., None])[..., 0] / length[:, None],
        inverse_range=inverse_range,
        inverse_range_sigma=sigma,
    )
