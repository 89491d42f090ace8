"""Tell how well the data determine a rig: goodness of fit, joint covariances, names for what the data leave open."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import CLEAR, BoardModes, board_modes, mode_turn, turned
from kcal.calibrate.hybrid.families import BOARD, typical_hyperprior
from kcal.calibrate.hybrid.measured_board import printed_board, printed_prior
from kcal.calibrate.rig.blocks import RigState
from kcal.calibrate.rig.problem import RigProblem, SharedUnknowns, held
from kcal.checks import variance_factor
from kcal.corners.board import Board
from kcal.gaussian import Gaussian, Slots, inverse_root, stacked, unit_scale, whitened
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.projection import FAR, project_components

# Eigenvalues of the scaled information below this share of the largest are rounding, not information.
_RANK_TOLERANCE = 1e-12
# A function of the unknowns with more than this share of its length in open directions is not determined.
_LOST_SHARE = 1e-6
# A motion gives an open direction its name if it lies in the open directions but for this share.
_NAMED_SHARE = 0.02
_IDENTITY = torch.eye(3, dtype=torch.float64)


class GoodnessOfFit(NamedTuple):
    """How residuals compare with their sigmas.

    Attributes:
        chi2: sum of squares of all residuals over their sigmas.
        freedom: degrees of freedom.
        variance: by which covariances are to be multiplied: χ² per degree of freedom where that is larger than chance
            explains, otherwise 1.
    """

    chi2: float
    freedom: int
    variance: float


def goodness_of_fit(problem: RigProblem, state: RigState) -> GoodnessOfFit:
    """Compare the residuals at a minimum with their sigmas."""
    chi2 = 2.0 * float(problem.cost(state))
    counted = sum(int((block.counts - block.size).sum()) for block in problem.blocks)
    freedom = counted + problem.term_rows(state).shape[1] - problem.shared_size
    return GoodnessOfFit(chi2, freedom, variance_factor(chi2, freedom))


class SharedCovariance:
    """Covariance of the shared unknowns at a solution, with all others free.

    Args:
        problem: the problem.
        state: its solution.
        variance: by which the covariance is multiplied: 1 where the stated sigmas are right.

    Attributes:
        root: (S, K) with root rootᵀ the covariance.
    """

    def __init__(self, problem: RigProblem, state: RigState, variance: float = 1.0) -> None:
        self._problem, self._state = problem, state
        information, self._scale = problem.linearize(state).information()
        root, self._open = inverse_root(information, self._scale, _RANK_TOLERANCE)
        self.root = root * math.sqrt(variance)

    @property
    def complete(self) -> bool:
        """Whether nothing is open."""
        return not self._open.shape[1]

    def of(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Covariance (K, K) of K linear functions (K, S) of a step, and which of them are determined.

        What is not determined has infinite variance, and no covariance with anything.
        """
        factor, lost = rows @ self.root, self._lost(rows)
        matrix = factor @ factor.T
        matrix = torch.where(lost[:, None] | lost[None, :], 0.0, 0.5 * (matrix + matrix.T))
        return matrix + torch.diag(torch.where(lost, torch.inf, 0.0)), ~lost

    def variances(self, rows: Tensor) -> Tensor:
        """(K,) variances of K linear functions (K, S) of a step; infinite for what is not determined."""
        return torch.where(self._lost(rows), torch.inf, (rows @ self.root).square().sum(-1))

    def _lost(self, rows: Tensor) -> Tensor:
        """(K,) which functions are not determined."""
        scaled = rows * self._scale
        length = scaled.square().sum(-1)
        return (scaled @ self._open).square().sum(-1) > _LOST_SHARE * torch.where(length > 0, length, 1.0)

    def half_of(self, rows: Tensor) -> Tensor | None:
        """(S, K) root of the covariance of K linear functions (K, S) of a step; None where one is not determined."""
        _, determined = self.of(rows)
        return (rows @ self.root).T if bool(determined.all()) else None

    def open_directions(self, names: Sequence[str], *, absolute: bool) -> tuple[str, ...]:
        """Names of what the data leave open, plainest first."""
        left, found = self._open, []
        motions = _named_motions(self._problem, self._state, names, absolute=absolute)
        while left.shape[1]:
            best: tuple[float, str, Tensor] = (0.0, "", left[0])
            for label, motion in motions:
                scaled = motion / self._scale
                inside = left.T @ (scaled / torch.linalg.vector_norm(scaled))
                share = float(inside.square().sum())
                # Of names that say the same, the first.
                if share > best[0] + 1e-6:
                    best = (share, label, inside)
            share, label, inside = best
            if share <= 1.0 - _NAMED_SHARE:
                label = f"a mixture of {_largest_parts(self._problem, left[:, 0], names)}"
                inside = torch.eye(left.shape[1], dtype=left.dtype)[0]
            found.append(label)
            # What is left of the open directions without the one that has a name now.
            rest = torch.linalg.svd(inside[None] / torch.linalg.vector_norm(inside)).Vh[1:]
            left = left @ rest.T
        return tuple(found)


def _named_motions(
    problem: RigProblem, state: RigState, names: Sequence[str], *, absolute: bool
) -> list[tuple[str, Tensor]]:
    """Motions (S,) of the cameras that people have a name for."""
    rotation, center = state.rotation, state.center
    middle = center.mean(0)
    out: list[tuple[str, Tensor]] = []

    def rig_motion(label: str, turn: Tensor, shift: Tensor) -> None:
        motion = torch.zeros(problem.shared_size, dtype=torch.float64)
        for c, (turn_slot, shift_slot) in enumerate(zip(problem.turn, problem.shift, strict=True)):
            if turn_slot is not None:
                motion[turn_slot] = -rotation[c] @ turn
            if shift_slot is not None:
                motion[shift_slot] = shift[c]
        if bool(motion.any()):
            out.append((label, motion))

    zero = torch.zeros(3, dtype=torch.float64)
    if absolute:
        for axis, word in zip(_IDENTITY, ("east", "north", "up"), strict=True):
            rig_motion(f"where the rig stands ({word})", zero, axis.expand_as(center))
        along = center[min(1, len(center) - 1)] - center[0]
        axes_of_turns = [(_IDENTITY[2], "the heading (a turn about the vertical)")]
        axes_of_turns += [
            (axis, f"a tilt of the rig about the {word} axis")
            for axis, word in zip(_IDENTITY[:2], ("east", "north"), strict=True)
        ]
        if bool(along.any()):
            axes_of_turns.append((along / torch.linalg.vector_norm(along), "a turn of the rig about its baseline"))
        for axis, label in axes_of_turns:
            for pivot in (middle, *center):
                rig_motion(label, axis, torch.linalg.cross(axis.expand_as(center), center - pivot))
    fixed = center[0] if problem.shift[0] is None else middle
    rig_motion("the scale (how far apart the cameras stand)", zero, center - fixed)
    for c, name in enumerate(names):
        turns = [f"the {word} of {name}" for word in ("pitch", "yaw", "roll")]
        shifts = [f"where {name} stands ({word})" for word in ("sideways", "up and down", "along its axis")]
        for slot, labels, axes in ((problem.turn[c], turns, _IDENTITY), (problem.shift[c], shifts, rotation[c])):
            for label, axis in zip(labels if slot else (), axes, strict=False):
                motion = torch.zeros(problem.shared_size, dtype=torch.float64)
                motion[slot] = axis
                out.append((label, motion))
    single = torch.eye(problem.shared_size, dtype=torch.float64)
    return out + [(label, axis) for label, axis in zip(_labels(problem), single, strict=True) if label]


def _labels(problem: RigProblem) -> list[str]:
    """A name for each unknown that has one by itself; empty for turns and shifts."""
    known = list(problem.unknowns.labels)
    return known + [""] * (problem.shared_size - len(known))


def _largest_parts(problem: RigProblem, direction: Tensor, names: Sequence[str]) -> str:
    labels = _labels(problem)
    for c, name in enumerate(names):
        turn_slot, shift_slot = problem.turn[c], problem.shift[c]
        if turn_slot is not None:
            labels[turn_slot] = [f"the attitude of {name}"] * 3
        if shift_slot is not None:
            labels[shift_slot] = [f"where {name} stands"] * 3
    order = direction.abs().argsort(descending=True)[:4].tolist()
    return ", ".join(dict.fromkeys(labels[i] for i in order))


def relative_rows(problem: RigProblem, state: RigState, first: int, second: int) -> Tensor:
    """(6, S): the step (ω, v) of second_from_first (see `apply_twist`) by a step of the shared unknowns."""
    rotation, center = state.rotation, state.center
    shift = rotation[second] @ (center[first] - center[second])
    by_second = turn_rows(problem, second)
    turned = by_second - rotation[second] @ rotation[first].T @ turn_rows(problem, first)
    moved = rotation[second] @ (_shift_rows(problem, first) - _shift_rows(problem, second))
    # ω × shift, column by column.
    return torch.cat([turned, moved + torch.linalg.cross(by_second, shift[:, None].expand_as(by_second), dim=0)])


def mounting_rows(problem: RigProblem, state: RigState, camera: int) -> Tensor:
    """(7, S): shift of a camera's center, its turn about the world's axes, and the coefficient of refraction."""
    bending = torch.zeros(1, problem.shared_size, dtype=torch.float64)
    if problem.unknowns.by_refraction is not None:
        bending[0, : len(problem.unknowns)] = problem.unknowns.by_refraction
    return torch.cat([_shift_rows(problem, camera), -state.rotation[camera].T @ turn_rows(problem, camera), bending])


def turn_rows(problem: RigProblem, camera: int) -> Tensor:
    """(3, S): turn of a camera about its own axes."""
    return _slot_rows(problem, problem.turn[camera])


def _shift_rows(problem: RigProblem, camera: int) -> Tensor:
    return _slot_rows(problem, problem.shift[camera])


def _slot_rows(problem: RigProblem, slot: slice | None) -> Tensor:
    rows = torch.zeros(3, problem.shared_size, dtype=torch.float64)
    if slot is not None:
        rows[:, slot] = _IDENTITY
    return rows


def parameter_rows(problem: RigProblem, camera: int) -> Tensor:
    """(5 + P, S): all parameters of a camera, held ones with zeros."""
    by_unknown = problem.unknowns.cameras[camera]
    rows = by_unknown.new_zeros(len(by_unknown), problem.shared_size)
    rows[:, : by_unknown.shape[1]] = by_unknown
    return rows


# What the calibrations of a rig's cameras know, together: lenses, and the board that they saw, as one Gaussian.
#
# Each camera brings square-root information on its parameters and its board. Rows of cameras that saw one board are
# stacked over the same board, whose prior counts once. Views of a calibration that take part in the rig as well are
# taken out of it first, so that no corner counts twice.

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
    one, two = first.board_message, other.board_message
    apart = printed_board(modes, [one])[1] + printed_board(modes, [two])[1]
    together = {turns: printed_board(modes, [one, turned(two, turns)])[1] - apart for turns in board.quarter_turns}
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
    said, given = [prior], list[_GivenBoard]()
    for camera, part in zip(cameras, parts, strict=True):
        if part is None:
            nothing = torch.zeros(len(camera.names), 0, dtype=torch.float64)
            by_board = nothing.new_zeros(len(nothing), len(amplitudes))
            given.append(_GivenBoard(nothing, nothing[0], nothing[0] > 0, by_board))
            continue
        own = part.data + part.lens_prior
        if len(shared) == 1:
            # What cameras told each other of their board counts once: of two in one rig, each brings its own rows.
            own = own + part.told
        said.append(own.marginal(part.board))
        given.append(_given_board(part, own, prior.slots, amplitudes))
    told = stacked([one.placed(prior.slots, amplitudes) for one in said])
    shape = whitened(told.rows[:, :-1], told.rows[:, -1])
    given = [lens._replace(by_board=lens.by_board @ shape.change) for lens in given]
    # Without a board in view, only what cameras say of theirs is left, and no corner moves.
    shapes = torch.zeros(0, 3, 0, dtype=torch.float64) if modes is None else modes.shapes
    of_board = shape.change[:0] if modes is None else shape.change
    parts_begin, parts_known = ([getattr(one, name) for one in (*given, shape)] for name in ("begin", "known"))
    turns = [torch.eye(len(known), dtype=torch.float64) for known in parts_known]
    if any(camera.model.hybrid for camera in cameras):
        corners = torch.einsum("bk,bcn->kcn", of_board, shapes).flatten(1)
        turns = _felt(cameras, given, _PX_PER_METER * corners, parts_known)
    # The unknowns of each camera, one after the other, and the board's: through these, lenses depend on each other.
    columns, selected = torch.block_diag(*turns).split([len(known) for known in parts_known]), list[Tensor]()
    for lens, own_columns in zip(given, columns, strict=False):
        selected.append(lens.own @ own_columns + lens.by_board @ columns[-1])
    found = SharedUnknowns(
        cameras=tuple(selected),
        shapes=shapes,
        board=of_board @ columns[-1],
        begin=torch.cat([turn.T @ begin for turn, begin in zip(turns, parts_begin, strict=True)]),
        known=torch.cat([(turn[known] != 0).any(0) for turn, known in zip(turns, parts_known, strict=True)]),
        labels=("",) * sum(turn.shape[1] for turn in turns),
    )
    return found, None if modes is None else torch.einsum("b,bcn->nc", amplitudes, shapes)


class _GivenBoard(NamedTuple):
    """A camera's parameters as functions of unknowns y that are independent of its board, and of the board.

    Attributes:
        own: (5 + P, Y) derivatives by y.
        begin: (Y,) what y is for the camera and the board as given.
        known: (Y,) whether y is a standard normal; nothing is known of the others.
        by_board: (5 + P, B) derivatives by the board's unknowns while y is held.
    """

    own: Tensor
    begin: Tensor
    known: Tensor
    by_board: Tensor


def _given_board(part: CameraInformation, own: Gaussian, board: Slots, amplitudes: Tensor) -> _GivenBoard:
    """What is known of a camera and its board, as if the board were known."""
    size = part.lens_size
    rows = own.placed((*part.lens, *board), torch.cat([part.estimate[:size], amplitudes])).rows
    change, pull, known = whitened(rows[:, :size], rows[:, size:])
    selection = part.selection()[:, :size]
    return _GivenBoard(selection @ change, pull[:, -1], known, -selection @ change @ pull[:, :-1])


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


def _felt(
    cameras: Sequence[Camera], lenses: Sequence[_GivenBoard], by_corners: Tensor, known: Sequence[Tensor]
) -> list[Tensor]:
    """For each camera's unknowns, and last the board's, those directions (K, F) that matter, orthonormal.

    Of the known unknowns they are those that move anything seen by `_FELT` px; all others stay.

    Args:
        cameras: of the rig.
        lenses: their parameters by the unknowns.
        by_corners: (B, 3 N) movements of the board by its unknowns, px.
        known: of each camera's unknowns and of the board's, which are standard normals.
    """
    found, effects = list[Tensor](), [by_corners]
    for camera, lens, standard in zip(cameras, lenses, known, strict=False):
        rays, valid = camera.unproject(camera.grid(25, 17).reshape(-1, 2))
        own = list[Tensor]()
        for distance in (FAR, _NEAR):
            points = (rays[valid] * distance).T
            seen = project_components(points, camera.params.detach(), camera.model, list(range(len(lens.own))))
            good = torch.where(seen.regular, seen.by_camera, 0.0).flatten(1)
            own.append(lens.own.T @ good)
            effects.append(lens.by_board.T @ good)
        found.append(_moving(torch.cat(own, 1), standard))
    return [*found, _moving(torch.cat(effects, 1), known[-1])]


def _moving(effects: Tensor, known: Tensor) -> Tensor:
    """(K, F): of the known ones of K unknowns those directions that move anything, by effects (K, N); all others."""
    moved = effects[known]
    _, vectors = torch.linalg.eigh(moved @ moved.T)
    # The largest movement of any one place, not their sum.
    felt = vectors[:, (vectors.T @ moved).abs().amax(1) > _FELT].flip(-1)
    unit = torch.eye(len(known), dtype=felt.dtype)
    return torch.cat([unit[:, known] @ felt, unit[:, ~known]], 1)
