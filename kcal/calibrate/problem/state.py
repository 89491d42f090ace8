"""What the problem of one camera is solved for: camera, board, poses and motions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor


class BoardState(NamedTuple):
    """Camera, board, poses and motions; all tensors may have leading batch dimensions.

    Attributes:
        parameters: (..., 5 + P) fx, fy, cx, cy, skew, coefficients.
        board: (..., B) amplitudes of the board's modes, meters.
        rotation: (..., V, 3, 3) cam_from_board.
        translation: (..., V, 3) cam_from_board, meters.
        motion: (..., V, 12) of each view while it is read (`kcal.calibrate.problem.readout`); (..., V, 0): they stand
            still.

    Example:
        >>> poses = torch.eye(3).expand(4, 3, 3), torch.zeros(4, 3)
        >>> state = BoardState.flat(torch.zeros(9), *poses)
        >>> state.board, tuple(state.views([0, 2]).motion.shape)
        (tensor([0., 0.]), (2, 0))
    """

    parameters: Tensor
    board: Tensor
    rotation: Tensor
    translation: Tensor
    motion: Tensor

    @classmethod
    def still(cls, parameters: Tensor, board: Tensor, rotation: Tensor, translation: Tensor) -> BoardState:
        """The state of views that stand still."""
        return cls(parameters, board, rotation, translation, translation.new_zeros(*translation.shape[:-1], 0))

    @classmethod
    def flat(cls, parameters: Tensor, rotation: Tensor, translation: Tensor) -> BoardState:
        """The state of views that stand still of a board without warp (`warp_modes`)."""
        return cls.still(parameters, parameters.new_zeros((*parameters.shape[:-1], 2)), rotation, translation)

    def views(self, chosen: Sequence[int] | slice | Tensor) -> BoardState:
        """The state of some views only."""
        return self._replace(
            rotation=self.rotation[..., chosen, :, :],
            translation=self.translation[..., chosen, :],
            motion=self.motion[..., chosen, :],
        )


def warp_modes(board_points: Tensor) -> Tensor:
    """How a warped board bulges: two parabolas (2, 3, N), in z, that are 1 in the middle and 0 at the outer corners.

    The board's height above its plane is warp_x (1 - x²) + warp_y (1 - y²), with x and y scaled to ±1 at the outermost
    corners. So each amplitude is the greatest deflection in meters along a direction (as mrcal's first warp model).
    """
    low, high = board_points[:, :2].amin(0), board_points[:, :2].amax(0)
    scaled = (2.0 * board_points[:, :2] - low - high) / (high - low)
    heights = (1.0 - scaled**2).T
    return torch.stack([torch.zeros_like(heights), torch.zeros_like(heights), heights], 1)
