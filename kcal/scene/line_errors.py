"""How far matches lie off their epipolar lines, and what turns and shifts of the rig change in that."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.lens.pose import side_axes
from kcal.lens.rig import StereoRig


class LineErrors(NamedTuple):
    """Matches (M,) beside their epipolar lines in the right image.

    Attributes:
        off: pixels by which right pixels are off.
        across: (M, 2) unit vectors of the right image across the lines.
        slopes: (M, 5) by how much `off` changes with the rig: px per radian of its turns about the right camera's axes,
            and per share of the baseline of a shift along both axes across it.
    """

    off: Tensor
    across: Tensor
    slopes: Tensor

    def sigma(self, covariance: Tensor) -> Tensor:
        """Standard deviations (M,) of `off`, by covariances (M, 2, 2) px² of right pixels."""
        return (self.across[:, None] @ covariance @ self.across[..., None])[:, 0, 0].sqrt()


def line_errors(rig: StereoRig, pixels: Tensor) -> LineErrors:
    """Matches (M, 2, 2), left and right pixels, beside their epipolar lines.

    What is off has slopes of its own, which a pose does not use: slopes are those on the line.
    """
    left = rig.left.unproject(pixels[:, 0])[0] @ rig.right_from_left_rotation.T
    shift = rig.right_from_left_translation.expand_as(left)
    normal = torch.linalg.cross(shift, left)
    right = rig.right.unproject(pixels[:, 1])[0]
    steps = 0.1 * torch.eye(2, dtype=torch.float64)
    moved = torch.stack([rig.right.unproject(pixels[:, 1] + step)[0] for step in steps], -1)
    slope = (normal[..., None] * (moved - right[..., None])).sum(-2) / 0.1
    per_px = torch.linalg.vector_norm(slope, dim=-1, keepdim=True)
    # right · (shift x left) is what is off: a turn adds turn x left to left, a shift adds to shift.
    turned = -torch.linalg.cross(torch.linalg.cross(right, shift), left)
    axes = rig.baseline * torch.cat(side_axes(rig.right_from_left_translation[None] / rig.baseline))
    shifted = torch.linalg.cross(left, right) @ axes.T
    slopes = torch.cat([turned, shifted], 1) / per_px
    return LineErrors((right * normal).sum(-1) / per_px[:, 0], slope / per_px, slopes)
