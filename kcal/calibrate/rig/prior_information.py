"""What the calibrations of a rig's cameras know, together: lenses, and the board that they saw, as one Gaussian.

Each camera brings square-root information on its parameters and its board. Rows of cameras that saw one board are
stacked over the same board, whose prior counts once. Views of a calibration that take part in the rig as well are taken
out of it first, so that no corner counts twice.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import BoardModes, board_modes
from kcal.calibrate.hybrid.board_orders import CLEAR, mode_turn, quarter_turns
from kcal.calibrate.hybrid.board_prior import BoardMessage, message_from_rows, printed_board, printed_prior
from kcal.calibrate.hybrid.families import BOARD, typical_hyperprior
from kcal.calibrate.rig.unknowns import SharedUnknowns, held
from kcal.corners.board import Board
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation, triangular, unit_scale, whitened
from kcal.lens.projection import project_components
from kcal.lens.pupil import FAR

# px that a direction must move something seen, for it to be an unknown of the rig.
_FELT = 1e-3
# Meters of a nearby thing, where the wandering of the entrance pupil shows, and px that a meter of board is there.
_NEAR, _PX_PER_METER = 1.0, 1000.0


class Knowledge(NamedTuple):
    """What is known of each camera, and of the board in the rig.

    Attributes:
        cameras: of each camera; None: nothing, it is held.
        board: which of them saw the rig's board, whose modes are then their last unknowns.
        apart: pairs of cameras whose boards have one name, and shapes that contradict each other.
    """

    cameras: tuple[CameraInformation | None, ...]
    board: tuple[bool, ...]
    apart: tuple[tuple[int, int], ...] = ()


def gathered(cameras: Sequence[Camera], known: Sequence[CameraInformation | None], board: Board | None) -> Knowledge:
    """Find which cameras saw one board, by the evidence of both.

    Args:
        cameras: with their calibrations.
        known: what each knows.
        board: in the rig, if there is any; else that of the first camera that has one.
    """
    out, sharing = list(known), [False] * len(cameras)
    first: CameraInformation | None = None
    apart: list[tuple[int, int]] = []
    for number, (camera, own) in enumerate(zip(cameras, known, strict=True)):
        record = None if camera.calibration is None else camera.calibration.record
        if own is None or not own.board_size or record is None:
            continue
        board = board or Board.of(record.board)
        if record.board != board.record:
            continue
        turned = own if first is None else _agreeing(first, own, board)
        if turned is not None:
            first, sharing[number], out[number] = first or own, True, turned
        else:
            apart.append((sharing.index(True), number))
    return Knowledge(tuple(out), tuple(sharing), tuple(apart))


def _agreeing(first: CameraInformation, other: CameraInformation, board: Board) -> CameraInformation | None:
    """The other camera's information with its board turned as the first camera's; None if they saw two boards."""
    modes = board_modes(board.points)
    one, two = _message(first), _message(other)
    apart = printed_board(modes, [one])[1] + printed_board(modes, [two])[1]
    together = {
        turns: printed_board(modes, [one, two.turned(mode_turn(turns))])[1] - apart for turns in quarter_turns(board)
    }
    best = max(together, key=lambda turns: together[turns])
    return _board_turned(other, mode_turn(best)) if together[best] > -CLEAR else None


def _message(known: CameraInformation) -> BoardMessage:
    """What a camera's data say of its board, whatever its lens is within its prior."""
    lens, at = known.lens_size, known.estimate.clone()
    at[:lens] -= known.mean[:lens]
    target = known.rows @ at - known.residuals
    return message_from_rows(torch.cat([known.rows, target[:, None]], 1), known.sigma[:lens], 1.0)


def _board_turned(known: CameraInformation, turn: Tensor) -> CameraInformation:
    """The same with the board's modes turned: a' = turn a, and turns are orthogonal."""
    lens = known.lens_size
    return dataclasses.replace(
        known,
        estimate=torch.cat([known.estimate[:lens], turn @ known.estimate[lens:]]),
        rows=torch.cat([known.rows[:, :lens], known.rows[:, lens:] @ turn.T], 1),
        mean=torch.cat([known.mean[:lens], turn @ known.mean[lens:]]),
        sigma=torch.cat([known.sigma[:lens], turn.abs() @ known.sigma[lens:]]),
        others=None if known.others is None else torch.cat([known.others[:, :-1] @ turn.T, known.others[:, -1:]], 1),
    )


def less(known: CameraInformation, rows: Tensor) -> CameraInformation:
    """What is left of the data without some of them.

    Args:
        known: the whole.
        rows: (R, U + 1) of the data that are taken out, in standard deviations, off all other unknowns; the last column
            holds their residuals at the estimate.
    """
    scale = unit_scale(known.all_rows()[:, :-1])
    gone, whole = rows[:, :-1] * scale, known.rows * scale
    gradient = whole.T @ known.residuals - gone.T @ rows[:, -1]
    values, vectors = torch.linalg.eigh(whole.T @ whole - gone.T @ gone)
    # Weights differ a little between a calibration and a rig: what is left of directions taken out may be negative.
    kept = values > 1e-10 * values[-1:].sum()
    root = values[kept].sqrt()
    return dataclasses.replace(
        known,
        rows=root[:, None] * vectors[:, kept].T / scale,
        residuals=vectors[:, kept].T @ gradient / root,
    )


def joint_unknowns(
    cameras: Sequence[Camera], knowledge: Knowledge, board: Board | None, *, measured: bool = False
) -> tuple[SharedUnknowns, Tensor | None]:
    """Unknowns that are standard normal beforehand, and the deviation (N, 3) of the board where they begin.

    A board that no camera knows is one as printers make them, if a camera is hybrid and the board was not `measured`
    otherwise; None: it is as it is given.
    """
    parts = [
        part if part is None or shares else part.without_board()
        for part, shares in zip(knowledge.cameras, knowledge.board, strict=True)
    ]
    sizes = [0 if part is None else part.lens_size for part in parts]
    lenses, shared = sum(sizes), [part for part in parts if part is not None and part.board_size]
    modes = None
    printed = not measured and any(camera.model.hybrid for camera in cameras)
    if board is not None and (shared or printed):
        modes = board_modes(board.points)
    elif not shared and not lenses:
        return held(cameras), None
    amplitudes, mean, sigma = _board_beforehand(shared, modes)
    boards, total = len(sigma), lenses + len(sigma)
    prior = torch.zeros(boards, total + 1, dtype=torch.float64)
    prior[range(boards), range(lenses, total)] = 1.0 / sigma
    prior[:, -1] = (amplitudes - mean) / sigma
    rows, end = [prior], 0
    selections = []
    for camera, part, size in zip(cameras, parts, sizes, strict=True):
        onto = torch.zeros(len(camera.names), total, dtype=torch.float64)
        if part is not None:
            own = torch.cat([part.data_rows(), part.prior_rows(board=False)])
            if len(shared) == 1 and part.others is not None:
                # What cameras told each other of their board counts once: of two in one rig, each brings its own rows.
                own = torch.cat([own, torch.cat([own.new_zeros(len(part.others), size), part.others], 1)])
            wide = own.new_zeros(len(own), total + 1)
            wide[:, end : end + size], wide[:, -1] = own[:, :size], own[:, -1]
            if part.board_size:
                wide[:, lenses:-1] = own[:, size:-1]
                wide[:, -1] += own[:, size:-1] @ (amplitudes - part.estimate[size:])
            rows.append(wide)
            onto[:, end : end + size] = part.selection()[:, :size]
        selections.append(onto)
        end += size
    triangle = triangular(torch.cat(rows))[:-1]
    change, begin, known = whitened(triangle[:, :-1], triangle[:, -1])
    maps = [onto @ change for onto in selections]
    shapes = torch.zeros(0, 3, 0, dtype=torch.float64) if modes is None else modes.shapes
    by_board = change[lenses:] if modes is not None else change[:0]
    turn = torch.eye(total, dtype=torch.float64)
    if any(camera.model.hybrid for camera in cameras):
        turn = _felt(cameras, maps, torch.einsum("bk,bcn->kcn", by_board, shapes).flatten(1), known)
    found = SharedUnknowns(
        cameras=tuple(onto @ turn for onto in maps),
        shapes=shapes,
        board=by_board @ turn,
        begin=turn.T @ begin,
        known=(turn[known] != 0).any(0),
        labels=("",) * turn.shape[1],
    )
    return found, None if modes is None else torch.einsum("b,bcn->nc", amplitudes, shapes)


def _board_beforehand(shared: Sequence[CameraInformation], modes: BoardModes | None) -> tuple[Tensor, Tensor, Tensor]:
    """Amplitudes to begin with, and mean and sigma of the prior of a board's modes; empty for no board."""
    if shared:
        # Each camera's evidence set amplitudes of its own; what is in between is as good as either.
        sigma = torch.stack([part.sigma[part.lens_size :].log() for part in shared]).mean(0).exp()
        mean = torch.stack([part.mean[part.lens_size :] for part in shared]).mean(0)
        return shared[0].estimate[shared[0].lens_size :], mean, sigma
    if modes is None:
        nothing = torch.zeros(0, dtype=torch.float64)
        return nothing, nothing, nothing
    sigma = printed_prior(modes, typical_hyperprior().mean[BOARD:]).half.diagonal()
    return torch.zeros_like(sigma), torch.zeros_like(sigma), sigma


def _felt(cameras: Sequence[Camera], maps: Sequence[Tensor], by_corners: Tensor, known: Tensor) -> Tensor:
    """(K, F) orthonormal directions: of the known unknowns those that move anything seen by `_FELT` px, all others."""
    effects = [_PX_PER_METER * by_corners[known]]
    for camera, onto in zip(cameras, maps, strict=True):
        rays, valid = camera.unproject(camera.grid(25, 17).reshape(-1, 2))
        rays = rays[valid]
        for distance in (FAR, _NEAR):
            points = rays * distance
            seen = project_components(points.T, camera.params.detach(), camera.model, list(range(len(onto))))
            good = torch.where(seen.regular, seen.by_camera, 0.0).flatten(1)
            effects.append(onto.T[known] @ good)
    moved = torch.cat(effects, 1)
    _, vectors = torch.linalg.eigh(moved @ moved.T)
    # The largest movement of any one place, not their sum.
    felt = vectors[:, (vectors.T @ moved).abs().amax(1) > _FELT].flip(-1)
    unit = torch.eye(len(known), dtype=felt.dtype)
    return torch.cat([unit[:, known] @ felt, unit[:, ~known]], 1)
