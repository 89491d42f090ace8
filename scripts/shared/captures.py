"""Simulate the corners of a board in many views, with noise, without rendering images; poses that both cameras see."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.pose import Pose
from kcal.lens.rig import Rig
from kcal.sim.captures import (
    BoardLike,
    BoardSize,
    LensLike,
    PoseOptions,
    TrueRig,
    board_points,
    check_draws,
    choose_poses,
    draw_poses,
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


def sample_pair_poses(
    rig: Rig | TrueRig,
    board: BoardLike,
    count: int,
    generator: torch.Generator,
    *,
    distance: tuple[float, float],
    options: PoseOptions | None = None,
) -> list[Pose]:
    """Choose poses that both cameras of a rig see completely, tilted against the line from the rig's middle.

    Args:
        rig: two cameras.
        board: its size.
        count: how many poses.
        generator: source of the draws; the same state gives the same poses.
        distance: nearest and farthest distance of the board's center from the left camera, meters.
        options: limits of tilt, roll and margins.

    Returns:
        left_from_board poses; `rig_pose` gives those of the right camera.

    Raises:
        InputError: fewer than `count` of 4096 drawn boards are completely seen by both, or an argument out of range.

    Example:
        >>> from kcal import Camera
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480))
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        >>> from kcal.sim.captures import BoardSize, project_board
        >>> board = BoardSize(9, 6, 0.1)
        >>> poses = sample_pair_poses(rig, board, 4, torch.Generator().manual_seed(1), distance=(4.0, 6.0))
        >>> bool(project_board(rig.right, rig_pose(rig, poses[0]), board)[1].all())
        True
    """
    options = options or PoseOptions()
    check_draws(count, "distance", distance)
    rotation, translation = rig.right_from_left_rotation, rig.right_from_left_translation
    middle = -0.5 * rotation.T @ translation
    drawn = draw_poses(rig.left, board, distance, middle, generator, options)
    still = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    return choose_poses(drawn, [(rig.left, *still), (rig.right, rotation, translation)], board, count, options)


def rig_pose(rig: Rig | TrueRig, left_from_board: tuple[Tensor, Tensor]) -> Pose:
    """Convert left_from_board to right_from_board."""
    rotation, translation = left_from_board
    return Pose(rig.right_from_left_rotation @ rotation, rig.right_from_left(translation))
