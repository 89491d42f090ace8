"""Take views of a rig out of what the cameras' calibrations know of them, so that no corner counts twice."""

from __future__ import annotations

import dataclasses
import math

import torch

from kcal.calibrate.hybrid.board_modes import board_modes
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.parameters import FreeParameters
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.rig.board_consensus import MINIMUM_CORNERS, pose_alone
from kcal.calibrate.rig.prior_information import less
from kcal.calibrate.rig.sources import Boards
from kcal.gaussian import triangular
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.solve.lm import LMOptions

# A view of a calibration has the residuals that its record says, whatever corners were left out.
_SAME_RMS = 0.25


def without_repeated(
    known: CameraInformation, camera: Camera, boards: Boards, number: int, solver: LMOptions
) -> CameraInformation:
    """What a calibration knows from other views than the rig's.

    Views are the same if name and residuals are.

    Args:
        known: what the calibration knows from all its views.
        camera: the camera, with its calibration.
        boards: of the rig, as they were read.
        number: of the camera in the rig.
        solver: options for poses.
    """
    record = None if camera.calibration is None else camera.calibration.record
    names = () if boards.views is None else boards.views[number]
    if record is None or record.noise is None or not names:
        return known
    named = torch.tensor([name in record.per_view_rms for name in names])
    named &= torch.isfinite(boards.pixels[:, number]).all(-1).sum(-1) >= MINIMUM_CORNERS
    if not bool(named.any()):
        return known
    pixels, parameters = boards.pixels[named, number], camera.params.detach()
    sigma = record.noise * math.sqrt(record.tempering or 1.0)
    free = [i for i, slot in enumerate(known.slots) if slot >= 0]
    with_board = known.board_size > 0
    # Unknowns of the calibration: of the camera, and of the board as it was ordered.
    problem = BoardProblem(
        boards.board.points if with_board else boards.points,
        pixels,
        camera.model,
        FreeParameters(tuple(free), tuple(known.slots[i] for i in free)),
        shapes=board_modes(boards.board.points).shapes if with_board else pixels.new_zeros(0, 3, pixels.shape[1]),
        free_board=with_board,
        weights=boards.whitening(sigma)[named, number],
    )
    amplitudes = known.estimate[known.lens_size :]
    seen = problem.board_points + torch.einsum("b,bcn->nc", amplitudes, problem.shapes)
    poses, _ = pose_alone(seen, pixels, camera, solver)
    state = BoardState.still(parameters, amplitudes, poses.rotation, poses.translation)
    rms = problem.corner_residuals(state).square().sum(-1).nanmean(-1).sqrt()
    then = torch.tensor([record.per_view_rms[name] for name, used in zip(names, named.tolist(), strict=True) if used])
    same = (rms - then).abs() <= _SAME_RMS * then
    if int(same.sum()) == record.views:
        # Only what was assumed is left.
        return dataclasses.replace(known, rows=known.rows[:0], residuals=known.residuals[:0])
    if not bool(same.any()):
        return known
    return less(known, triangular(problem.off_poses(state)[same].transpose(0, 1).flatten(1).T))
