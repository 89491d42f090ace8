"""Take views of a rig out of what the cameras' calibrations know of them, so that no corner counts twice."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from kcal.calibrate.lensfit.board_modes import board_modes
from kcal.calibrate.rig.blocks import BoardBlock, PosedCamera, RigState
from kcal.calibrate.rig.board_consensus import MINIMUM_CORNERS, pose_alone
from kcal.calibrate.rig.prior_information import less
from kcal.calibrate.rig.sources import Boards
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation, triangular
from kcal.solve.lm import LMOptions
from kcal.solve.schur import without_local

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
    board = _as_seen(known, boards)
    pixels = boards.pixels[named, number]
    poses, _ = pose_alone(board, pixels, camera, solver)
    sigma = record.noise * math.sqrt(record.tempering or 1.0)
    whitening = boards.whitening(sigma)[named, number]
    state = _state(camera, known, poses.rotation, poses.translation)
    posed = PosedCamera(
        camera, camera.params.detach(), torch.eye(3).double(), torch.zeros(3).double(), known.selection(), None, None
    )
    block = _block(known, boards, board, pixels, whitening)
    error = block.errors([posed], state)[:, 0].square().sum(1)
    rms = (error.sum(-1) / block.seen.sum((1, 2))).sqrt()
    then = torch.tensor([record.per_view_rms[name] for name, used in zip(names, named.tolist(), strict=True) if used])
    same = (rms - then).abs() <= _SAME_RMS * then
    if int(same.sum()) == record.views:
        # Only what was assumed is left.
        return dataclasses.replace(known, rows=known.rows[:0], residuals=known.residuals[:0])
    if not bool(same.any()):
        return known
    state = _state(camera, known, poses.rotation[same], poses.translation[same])
    block = _block(known, boards, board, pixels[same], whitening[same])
    rows = without_local(block.rows([posed], state, len(known.estimate)), block.size)
    return less(known, triangular(rows.transpose(0, 1).flatten(1).T))


def _as_seen(known: CameraInformation, boards: Boards) -> Tensor:
    """(N, 3) the board as the calibration found it."""
    if not known.board_size:
        return boards.points
    shapes = board_modes(boards.board.points).shapes
    return boards.board.points + torch.einsum("b,bcn->nc", known.estimate[known.lens_size :], shapes)


def _state(camera: Camera, known: CameraInformation, rotation: Tensor, translation: Tensor) -> RigState:
    nothing = torch.zeros(0, 3, dtype=torch.float64)
    return RigState(
        parameters=camera.params.detach(),
        unknown=torch.zeros(len(known.estimate), dtype=torch.float64),
        refraction=torch.zeros((), dtype=torch.float64),
        rotation=torch.eye(3, dtype=torch.float64)[None],
        center=torch.zeros(1, 3, dtype=torch.float64),
        board=torch.zeros(known.board_size, dtype=torch.float64),
        board_rotation=rotation,
        board_translation=translation,
        points=nothing,
        direction=nothing,
        inverse_range=nothing[:, 0],
    )


def _block(known: CameraInformation, boards: Boards, board: Tensor, pixels: Tensor, whitening: Tensor) -> BoardBlock:
    shapes, by_unknown = None, None
    if known.board_size:
        shapes = board_modes(boards.board.points).shapes
        by_unknown = torch.eye(len(known.estimate), dtype=torch.float64)[known.lens_size :]
    return BoardBlock(pixels[:, None], whitening[:, None], board, shapes, by_unknown)
