"""Poses of a board that both cameras of a rig see, as `kcal.sim.captures` chooses them for one."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.lens.pose import Pose
from kcal.lens.rig import Rig
from kcal.sim.captures import BoardLike, PoseOptions, TrueRig, check_draws, choose_poses, draw_poses


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
