"""What a drift of the cameras does to positions, in meters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector
from kcal.lens.rig import StereoRig
from kcal.locate.range_sigmas import usual_ranges
from kcal.locate.stereo import PositionStatus, sight_lines


class DriftEffect(NamedTuple):
    """What an old rig makes of things that a turned one sees, (D,) meters for D distances.

    Attributes:
        distance: true range from the left camera.
        found: range by the old rig; infinite where its rays no longer meet.
        sigma: one sigma of the shift, from the covariance of the turn, to first order.
    """

    distance: Tensor
    found: Tensor
    sigma: Tensor


def drift_effect(
    old: StereoRig, new: StereoRig, turn_covariance: Tensor, distances: Sequence[float] | None = None
) -> DriftEffect:
    """Ranges that are found with the old rig after it has turned into the new one, in the direction both look.

    Args:
        old: what is believed.
        new: what is.
        turn_covariance: (3, 3) of the relative turn about the right camera's axes, radians².
        distances: meters; `usual_ranges` if left out.

    Example:
        >>> from kcal.lens import rotation_from_vector
        >>> from kcal.rig import planned_rig
        >>> old = planned_rig()
        >>> turn = rotation_from_vector(torch.tensor([0.0, 1.745329e-4, 0.0]).double())  # 0.01°
        >>> new = StereoRig(old.left, old.right, turn, turn @ old.right_from_left_translation)
        >>> [round(value) for value in drift_effect(old, new, torch.zeros(3, 3).double()).found.tolist()]
        [251, 1018, 5478]
    """
    far = torch.tensor(usual_ranges(old) if distances is None else list(distances), dtype=torch.float64)
    if not bool(((far > 0) & torch.isfinite(far)).all()):
        raise InputError("distances: positive numbers of meters are needed")
    with torch.no_grad():
        axis = new.right_from_left_rotation[2] + new.right_from_left_rotation.new_tensor([0.0, 0.0, 1.0])
        points = far[:, None] * axis / torch.linalg.vector_norm(axis)
        left, right, seen = new(points)
        if not bool(seen.all()):
            raise InputError("the cameras do not look the same way: the effect of a drift cannot be computed")
        lines = sight_lines(old, left, right)
        found = torch.linalg.vector_norm(lines.points, dim=-1)
        # Turning the right camera by ω about its x, y, z moves a point's image; the range follows the disparity.
        slope = [_range_slope(old, new, points, far, k) for k in range(3)]
    rows = torch.stack(slope, -1)
    sigma = (rows @ turn_covariance * rows).sum(-1).clamp_min(0.0).sqrt()
    return DriftEffect(far, torch.where(lines.status == int(PositionStatus.OK), found, math.inf), sigma)


def _range_slope(old: StereoRig, new: StereoRig, points: Tensor, far: Tensor, axis: int) -> Tensor:
    """Meters of range by a radian about one axis of the right camera."""
    ends = []
    for sign in (-1.0, 1.0):
        turn = rotation_from_vector(sign * 1e-8 * torch.eye(3, dtype=torch.float64)[axis])
        rig = StereoRig(
            new.left, new.right, turn @ new.right_from_left_rotation, turn @ new.right_from_left_translation
        )
        left, right, _ = rig(points)
        ends.append(torch.linalg.vector_norm(sight_lines(new, left, right).points, dim=-1))
    return (ends[1] - ends[0]) / 2e-8
