"""Solve a stereo rig from boards that both cameras have seen."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from kcal.calibrate.problem.closed_form import spread_out
from kcal.calibrate.rig.board_consensus import MINIMUM_CORNERS
from kcal.calibrate.rig.pairs import Pair, paired_boards
from kcal.calibrate.rig.result import RigResult
from kcal.calibrate.rig.solve import RigOptions, solve_rig
from kcal.calibrate.rig.sources import RigData
from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.threads import in_one_thread


@in_one_thread
def calibrate_rig(
    left: Camera,
    right: Camera,
    left_observations: Observations,
    right_observations: Observations,
    pairs: Sequence[Pair],
    options: RigOptions | None = None,
) -> RigResult:
    """Find the pose of the right camera in the left one's frame: `solve_rig` with boards alone.

    Each camera's board poses are found alone; every pair then proposes a relative pose, in the corner order as read
    and with the right image's order turned by 180°. The proposal that the other pairs agree with best tells which
    pairs were read from the other end and which do not belong. The others are refined jointly: one board pose for each
    pair, one relative pose, least squares over both images.

    Args:
        left: the left camera, calibrated.
        right: the right camera, calibrated.
        left_observations: views of the left camera.
        right_observations: views of the right camera.
        pairs: names of views taken at the same moment (see `kcal.calibrate.rig.pairs`).
        options: see `RigOptions`.

    Raises:
        InputError: boards or image sizes that differ, cameras that do not fit their observations, views with too few
            corners for a pose.
        DegenerateError: no pair is left.

    Example:
        >>> from kcal import Board, StereoRig, View
        >>> from kcal.lens import rotation_from_vector
        >>> board = Board(columns=7, rows=6, square=0.05)
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
        >>> truth = StereoRig(camera, camera, torch.eye(3), torch.tensor([-0.2, 0.0, 0.0]))
        >>> tilts = torch.tensor([[0.4, 0, 0], [-0.4, 0.1, 0], [0, 0.4, 0.2]], dtype=torch.float64)
        >>> sides = ([], [])
        >>> for i, rotation in enumerate(rotation_from_vector(tilts)):
        ...     points = board.points @ rotation.T + torch.tensor([-0.1, -0.1, 1.0], dtype=torch.float64)
        ...     for views, pixels in zip(sides, truth(points)[:2]):
        ...         views.append(View(name=f"{i}.png", pixels=pixels.tolist()))
        >>> left, right = (Observations(board=board, image_size=(640, 480), views=views) for views in sides)
        >>> pairs = [(name, name) for name in left.names]
        >>> result = calibrate_rig(camera, camera, left, right, pairs)
        >>> [round(value, 6) + 0.0 for value in result.stereo().right_from_left_translation.tolist()]
        [-0.2, 0.0, 0.0]
    """
    boards = paired_boards((left, right), (left_observations, right_observations), pairs)
    for pair, counts in zip(pairs, torch.isfinite(boards.pixels).all(-1).sum(-1).tolist(), strict=True):
        if min(counts) < MINIMUM_CORNERS:
            raise InputError(f"pair {pair[0]}, {pair[1]}: at least {MINIMUM_CORNERS} corners are needed in each view")
    for side in (0, 1):
        for i in (~spread_out(boards.points, boards.pixels[:, side])).nonzero()[:, 0].tolist():
            raise InputError(f"{pairs[i][side]}: all its corners, or all but one, lie on one line; leave the pair out")
    return solve_rig(RigData(cameras=(left, right), names=("left", "right"), boards=boards), options)
