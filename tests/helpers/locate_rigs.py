"""Rigs with known geometry for the tests of kcal.locate."""

import copy
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from kcal import Camera, Localizer, Rig, locate_points
from kcal.locate import Marks
from kcal.locate.positions import Located
from kcal.locate.tabulate import Geoid
from kcal.rig import RigCovariance

SIZE = (1920, 1080)


def tensor(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def pinhole_rig(focal: float = 1600.0, baseline: float = 10.0) -> Rig:
    """Parallel pinhole cameras: disparity = focal * baseline / Z."""
    camera = Camera.build(focal=(focal, focal), center=(959.5, 539.5), size=SIZE, model="pinhole")
    return Rig.pair(camera, camera, torch.eye(3), tensor(-baseline, 0.0, 0.0))


def turned(yaw_deg: float, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Tensor:
    a, b, c = (math.radians(v) for v in (yaw_deg, pitch_deg, roll_deg))
    yaw = tensor([math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)])
    pitch = tensor([1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)])
    return yaw @ pitch @ tensor([math.cos(c), -math.sin(c), 0], [math.sin(c), math.cos(c), 0], [0, 0, 1])


def real_rig() -> Rig:
    """Unlike, distorted, converging cameras on an uneven mast."""
    left = Camera.build(
        focal=(1610, 1604), center=(951.3, 545.8), size=SIZE, coefficients=[-0.21, 0.08, 1e-3, -5e-4, -0.01]
    )
    right = Camera.build(
        focal=(1588, 1592), center=(968.1, 532.4), size=SIZE, coefficients=[-0.19, 0.06, -7e-4, 4e-4, 0.0]
    )
    rotation = turned(1.0, -0.4, 0.7)
    return Rig.pair(left, right, rotation, rotation @ tensor(-10.0, 0.35, 0.6))


def spread_points(ranges: Tensor) -> Tensor:
    """Points at the given ranges, spread over the common view."""
    angle = torch.linspace(-0.35, 0.35, len(ranges), dtype=torch.float64)
    return torch.stack([ranges * angle.sin(), 0.1 * ranges * (7 * angle).sin(), ranges * angle.cos()], -1)


def standing(
    rig: Rig, *, calibration: RigCovariance | None = None, pixel_sigma: float = 0.3, **place: Any
) -> Localizer:
    """Of a rig that is placed, with this covariance if it is given."""
    if calibration is not None:
        rig = copy.copy(rig)
        rig.covariance = calibration
    return Localizer(rig.placed(**place) if place else rig, pixel_sigma=pixel_sigma)


def located_pairs(
    rig: Rig, left: Tensor, right: Tensor, *, names: Sequence[str] | None = None, cov: Tensor | None = None,
    geoid: Geoid | None = None, **options: Any,
) -> Located:  # fmt: skip
    """Positions of pixels in the left and the right image; `options` are those of `standing`."""
    names = [str(i + 1) for i in range(len(left))] if names is None else names
    cov = None if cov is None else cov.expand(len(left), 4, 4)
    return locate_points(standing(rig, **options), Marks.of_pair(names, left, right, cov), geoid=geoid)
