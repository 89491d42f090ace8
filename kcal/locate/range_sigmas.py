"""How uncertain ranges of a solved rig are, by what to improve: marks, lenses, relative pose; and the mounting."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.rig import StereoRig
from kcal.locate.budget import points_at
from kcal.locate.geodesy import enu_from_cam
from kcal.locate.max_likelihood import calibration_effect
from kcal.locate.mounting import by_mounting
from kcal.locate.ranges import BEARING_SIGMAS
from kcal.locate.stereo import checked_rig, fit_pairs

# Singular values of the lenses' errors below this share of the largest are rounding.
_ROUNDING = 1e-6


class RangeSigmas(NamedTuple):
    """Standard deviations in meters, (D,) each; marks² + lenses² + pose² = total².

    Attributes:
        distance: true range from the left camera.
        marks: from noise in the marks of one pair.
        lenses: from errors of both lenses, with what the relative pose makes up for: what exact lenses would gain.
        pose: from errors of the relative pose that would remain if both lenses were known exactly.
        total: of the range.
        ranged: (D,) bool: whether a range can be told at all, the parallax being three of its sigmas.
        sideways: level and across the line of sight, from errors of the mounting, which do not change ranges.
    """

    distance: Tensor
    marks: Tensor
    lenses: Tensor
    pose: Tensor
    total: Tensor
    ranged: Tensor
    sideways: Tensor


def usual_ranges(rig: StereoRig, baselines: Sequence[float] = (25.0, 100.0, 500.0)) -> list[float]:
    """Ranges at which a rig is near, usual and far: about so many baselines, as round numbers of meters.

    Example:
        >>> from kcal.rig import planned_rig
        >>> usual_ranges(planned_rig())
        [250.0, 1000.0, 5000.0]
    """
    return [_round_number(count * float(rig.baseline)) for count in baselines]


def _round_number(meters: float) -> float:
    """The nearest of 1, 2.5, 5, 10, 25 and so on, by ratio."""
    decade = 10.0 ** math.floor(math.log10(meters))
    return min((decade * k for k in (1.0, 2.5, 5.0, 10.0)), key=lambda number: abs(math.log(number / meters)))


def range_sigmas(
    rig: StereoRig,
    distances: Tensor | Sequence[float] | None = None,
    *,
    pixel_sigma: float = 0.3,
    pixel: Sequence[float] | None = None,
) -> RangeSigmas:
    """Split the standard deviation of ranges by its sources.

    Errors of lenses and relative pose are correlated: a pose that was solved makes up for most of what the lenses have
    wrong. So the variance of both together is split into what would remain with exact lenses, which better landmarks or
    far features reduce, and the rest, which better calibrated cameras reduce.

    Args:
        rig: with its `covariance` and `mounting`; where one is None, its part is 0.
        distances: (D,) ranges from the left camera, meters; `usual_ranges` if left out.
        pixel_sigma: of a mark along each axis, px.
        pixel: where in the left image; the direction in which both cameras' axes look, if left out.

    Raises:
        InputError: a distance that is not positive or that the right camera does not see.

    Example:
        >>> from kcal.rig import RigCovariance, planned_rig
        >>> rig = planned_rig()
        >>> yaw = torch.zeros(6, 6, dtype=torch.float64)
        >>> yaw[1, 1] = torch.deg2rad(torch.tensor(0.001)) ** 2
        >>> rig.covariance = RigCovariance.of(rig, pose=yaw)
        >>> found = range_sigmas(rig, [5000.0], pixel_sigma=0.1)
        >>> [round(float(part)) for part in (found.marks, found.lenses, found.pose, found.total)]
        [221, 0, 44, 225]
    """
    variance = checked_rig(rig, pixel_sigma) ** 2
    far, points, left, right = points_at(rig, usual_ranges(rig) if distances is None else distances, pixel)
    with torch.no_grad():
        found = fit_pairs(rig, left, right, by_camera=rig.covariance is not None)
        # Meters of range by the fit's inverse distance.
        slope = far.square() / (found.scale * found.length)
        marks = slope * (variance * found.fit.covariance[5]).sqrt()
        lenses = pose = sideways = torch.zeros_like(far)
        if rig.covariance is not None:
            factor = rig.covariance.half.T
            effect = slope[:, None] * calibration_effect(found.fit, found.scale, factor)[2].mT
            by_lenses = effect @ row_space(factor[:-6])
            lenses = by_lenses.norm(dim=-1)
            pose = (effect.square().sum(-1) - lenses.square()).clamp_min(0.0).sqrt()
        stands = rig.mounting
        if stands is not None and stands.covariance is not None:
            enu = points @ enu_from_cam(stands.heading_deg, stands.pitch_deg, stands.roll_deg).T
            level = torch.nn.functional.normalize(enu[:, :2], dim=-1)
            across = torch.stack([level[:, 1], -level[:, 0], torch.zeros_like(far)], -1)
            rows = (across[:, None] @ by_mounting(enu))[:, 0]
            sideways = (rows @ stands.covariance[:6, :6] * rows).sum(-1).sqrt()
    total = torch.stack([marks, lenses, pose]).norm(dim=0)
    return RangeSigmas(far, marks, lenses, pose, total, total * BEARING_SIGMAS <= far, sideways)


def row_space(matrix: Tensor) -> Tensor:
    """(K, R) orthonormal basis of the rows of a matrix (P, K), whose rows may have any units."""
    length = matrix.norm(dim=-1, keepdim=True)
    _, values, rows = torch.linalg.svd(matrix / torch.where(length > 0, length, 1.0), full_matrices=False)
    return rows[values > _ROUNDING * values[:1].sum()].T
