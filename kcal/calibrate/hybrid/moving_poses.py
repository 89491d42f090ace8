"""Poses and motions of views that were held out, under a camera and a board that stay as they are."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.readout import MOTION, Readout
from kcal.calibrate.problem.state import BoardState
from kcal.lens.camera import Camera
from kcal.solve.lm import LMOptions, minimize

_EFFORT = LMOptions(max_iterations=60, tolerance=1e-12, initial_damping=1e-6)


def moving_residuals(
    camera: Camera,
    board_points: Tensor,
    pixels: Tensor,
    rotation: Tensor,
    translation: Tensor,
    readout: Readout,
    stillness: Tensor,
) -> Tensor:
    """Residuals of views whose poses and motions are solved for, the camera and its board being held.

    A lens is judged by views that were not fitted. Of views that moved while they were read the motion is unknown too,
    and would be counted as an error of the lens.

    Args:
        camera: of any model.
        board_points: (N, 3) the board, meters.
        pixels: (V, N, 2), NaN where not seen.
        rotation: (V, 3, 3) cam_from_board, to begin with; a view without a pose is NaN and stays so.
        translation: (V, 3) meters.
        readout: how views are read.
        stillness: (12,) the squared noise over the variance of each number of a motion.

    Returns:
        (V, N, 2) projected minus seen, pixels; NaN where not seen.
    """
    posed = rotation.flatten(1).isfinite().all(1)
    out = torch.full_like(pixels, torch.nan)
    if not bool(posed.any()):
        return out
    params = camera.params.detach()
    some = pixels[posed]
    problem = BoardProblem(
        board_points,
        some,
        camera.model,
        readout=readout,
        stillness=stillness,
    )
    motion = rotation.new_zeros(len(some), MOTION)
    state = BoardState.flat(params, rotation[posed], translation[posed])._replace(motion=motion)
    out[posed] = problem.corner_residuals(minimize(problem, state, _EFFORT).state)
    return out
