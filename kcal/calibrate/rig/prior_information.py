"""What the calibrations of a rig's cameras know, together: lenses, and the board that they saw, as one Gaussian.

Each camera brings square-root information on its parameters and its board. Rows of cameras that saw one board are
stacked over the same board, whose prior counts once. Views of a calibration that take part in the rig as well are taken
out of it first, so that no corner counts twice.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Hashable, Sequence

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import BoardModes, board_modes
from kcal.calibrate.hybrid.board_orders import CLEAR, mode_turn, quarter_turns, turned
from kcal.calibrate.hybrid.board_prior import printed_board, printed_prior
from kcal.calibrate.hybrid.families import BOARD, typical_hyperprior
from kcal.calibrate.rig.unknowns import SharedUnknowns, held
from kcal.corners.board import Board
from kcal.gaussian import Gaussian, stacked, unit_scale, whitened
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.projection import project_components
from kcal.lens.pupil import FAR

# px that a direction must move something seen, for it to be an unknown of the rig.
_FELT = 1e-3
# Meters of a nearby thing, where the wandering of the entrance pupil shows, and px that a meter of board is there.
_NEAR, _PX_PER_METER = 1.0, 1000.0


def gathered(
    cameras: Sequence[Camera], known: Sequence[CameraInformation | None], board: Board | None
) -> tuple[tuple[CameraInformation | None, ...], tuple[tuple[int, int], ...]]:
    """What is known of each camera, and of one board by those that saw it, by the evidence of both.

    Args:
        cameras: with their calibrations.
        known: what each knows.
        board: in the rig, if there is any; else that of the first camera that has one.

    Returns:
        What is known: of cameras that saw another board, what is said of the camera alone; None: nothing, it is held.
        And pairs of cameras whose boards have one name, and shapes that contradict each other.
    """
    out: list[CameraInformation | None] = []
    first: CameraInformation | None = None
    begun = 0
    apart: list[tuple[int, int]] = []
    for number, (camera, own) in enumerate(zip(cameras, known, strict=True)):
        record = None if camera.calibration is None else camera.calibration.record
        sharing = None
        if own is not None and own.board_size and record is not None:
            board = board or Board.of(record.board)
            if record.board == board.record:
                sharing = own if first is None else _agreeing(first, own, board)
                if sharing is None:
                    apart.append((begun, number))
                elif first is None:
                    first, begun = sharing, number
        out.append(sharing or (None if own is None else own.without_board()))
    return tuple(out), tuple(apart)


def _agreeing(first: CameraInformation, other: CameraInformation, board: Board) -> CameraInformation | None:
    """The other camera's information with its board turned as the first camera's; None if they saw two boards."""
    modes = board_modes(board.points)
    # What the data of each say of the board, whatever its lens is within its prior.
    one, two = ((known.data + known.lens_prior).marginal(known.board) for known in (first, other))
    apart = printed_board(modes, [one])[1] + printed_board(modes, [two])[1]
    together = {turns: printed_board(modes, [one, turned(two, turns)])[1] - apart for turns in quarter_turns(board)}
    best = max(together, key=lambda turns: together[turns])
    return _board_turned(other, best) if together[best] > -CLEAR else None


def _board_turned(known: CameraInformation, turns: int) -> CameraInformation:
    """The same with the board's modes turned."""
    lens, turn = known.lens_size, mode_turn(turns)
    estimate = torch.cat([known.estimate[:lens], turn @ known.estimate[lens:]])
    out = dataclasses.replace(
        known,
        estimate=estimate,
        mean=torch.cat([known.mean[:lens], turn @ known.mean[lens:]]),
        sigma=torch.cat([known.sigma[:lens], turn.abs() @ known.sigma[lens:]]),
        others=None if known.others is None else turned(known.told, turns).placed(known.board, estimate[lens:]).rows,
    )
    return out.with_data(turned(known.data, turns))


def less(known: CameraInformation, rows: Tensor) -> CameraInformation:
    """What is left of the data without some of them.

    Args:
        known: the whole.
        rows: (R, U + 1) of the data that are taken out, in standard deviations, off all other unknowns; the last column
            holds their residuals at the estimate.
    """
    scale = unit_scale(known.whole.rows[:, :-1])
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
    cameras: Sequence[Camera], parts: Sequence[CameraInformation | None], board: Board | None, *, measured: bool = False
) -> tuple[SharedUnknowns, Tensor | None]:
    """Unknowns that are standard normal beforehand, and the deviation (N, 3) of the board where they begin.

    A board that no camera knows is one as printers make them, if a camera is hybrid and the board was not `measured`
    otherwise; None: it is as it is given.

    Args:
        cameras: of the rig.
        parts: what is known of each and of the board (`gathered`).
        board: of the rig, or of the cameras.
        measured: the board's shape is known.
    """
    shared = [part for part in parts if part is not None and part.board_size]
    lenses = sum(part.lens_size for part in parts if part is not None)
    modes = None
    printed = not measured and any(camera.model.hybrid for camera in cameras)
    if board is not None and (shared or printed):
        modes = board_modes(board.points)
    elif not shared and not lenses:
        return held(cameras), None
    prior, amplitudes = _board_beforehand(shared, modes)
    names: list[Hashable] = []
    said, places = [prior], []
    for number, part in enumerate(parts):
        if part is None:
            continue
        own = part.data + part.lens_prior
        if len(shared) == 1:
            # What cameras told each other of their board counts once: of two in one rig, each brings its own rows.
            own = own + part.told
        said.append(own.named(tuple(slot if slot in prior.slots else (number, slot) for slot in own.slots)))
        names += [(number, slot) for slot in part.lens]
        places.append(part.estimate[: part.lens_size])
    slots, at = (*names, *prior.slots), torch.cat([*places, amplitudes])
    joint = stacked([one.placed(slots, at) for one in said]).compressed()
    change, begin, known = whitened(joint.rows[:, :-1], joint.rows[:, -1])
    selections, end = [], 0
    for camera, part in zip(cameras, parts, strict=True):
        onto = torch.zeros(len(camera.names), len(slots), dtype=torch.float64)
        if part is not None:
            onto[:, end : end + part.lens_size] = part.selection()[:, : part.lens_size]
            end += part.lens_size
        selections.append(onto)
    maps = [onto @ change for onto in selections]
    shapes = torch.zeros(0, 3, 0, dtype=torch.float64) if modes is None else modes.shapes
    by_board = change[lenses:] if modes is not None else change[:0]
    turn = torch.eye(len(slots), dtype=torch.float64)
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


def _board_beforehand(shared: Sequence[CameraInformation], modes: BoardModes | None) -> tuple[Gaussian, Tensor]:
    """The prior of a board's modes, and amplitudes to begin with; of no unknowns for no board."""
    if shared:
        # Each camera's evidence set amplitudes of its own; what is in between is as good as either.
        sigma = torch.stack([part.sigma[part.lens_size :].log() for part in shared]).mean(0).exp()
        mean = torch.stack([part.mean[part.lens_size :] for part in shared]).mean(0)
        return Gaussian.independent(shared[0].board, mean, sigma), shared[0].estimate[shared[0].lens_size :]
    if modes is None:
        nothing = torch.zeros(0, dtype=torch.float64)
        return Gaussian.independent((), nothing, nothing), nothing
    prior = printed_prior(modes, typical_hyperprior().mean[BOARD:])
    return prior, torch.zeros_like(prior.at)


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
