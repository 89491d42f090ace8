"""Simulate the corners of a board in many views, with noise, without rendering images."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.sim.captures import (
    BoardLike,
    BoardSize,
    LensLike,
    board_points,
    project_board,
    sample_board_poses,
)

# The board of the paper: 6 x 7 corners, squares of 5 cm.
PAPER_BOARD = BoardSize(7, 6, 0.05)


class Capture(NamedTuple):
    """Views of a board and the truth about them.

    Attributes:
        pixels: (V, N, 2) corners with noise, in the order of `board_points`.
        true_pixels: (V, N, 2) without.
        rotation: (V, 3, 3) cam_from_board.
        translation: (V, 3) meters.
        points: (N, 3) corners on the board, meters.
    """

    pixels: Tensor
    true_pixels: Tensor
    rotation: Tensor
    translation: Tensor
    points: Tensor


def capture_corners(
    lens: LensLike,
    views: int,
    *,
    sigma: float,
    seed: int,
    board: BoardLike = PAPER_BOARD,
    fill: tuple[float, float] = (0.25, 0.8),
) -> Capture:
    """Simulate the corners of a board in poses that cover the image, with Gaussian noise.

    Args:
        lens: true lens.
        views: how many.
        sigma: noise in pixels along each axis.
        seed: of poses and noise; another sigma scales the same noise.
        board: its size.
        fill: smallest and largest share of the image's width or height that the board takes.

    Raises:
        InputError: see `sample_board_poses`; or a sigma that is negative.
    """
    if not 0 <= sigma < math.inf:
        raise InputError(f"sigma {sigma}: pixels, not negative, are needed")
    generator = torch.Generator().manual_seed(seed)
    poses = sample_board_poses(lens, board, views, generator, fill=fill)
    true = torch.stack([project_board(lens, pose, board)[0] for pose in poses])
    noise = torch.randn(true.shape, dtype=torch.float64, generator=generator)
    return Capture(
        true + sigma * noise,
        true,
        torch.stack([pose.rotation for pose in poses]),
        torch.stack([pose.translation for pose in poses]),
        board_points(board),
    )
