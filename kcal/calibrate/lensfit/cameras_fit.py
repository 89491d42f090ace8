"""Fit several cameras together: they share the boards that they saw, and what lenses of one type have in common.

Each camera is fitted alone first. What its data say about the board is a Gaussian message; cameras whose messages agree
better than two separate boards would explain saw one board. Then each camera is fitted again, with the messages of the
others as its prior of the board.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor

from kcal.calibrate.lensfit.board_orders import CLEAR, find_turns, mode_turn, quarter_turns, turned_corners
from kcal.calibrate.lensfit.board_prior import (
    BoardMessage,
    BoardPrior,
    message_from_rows,
    multiplied,
    printed_board,
    printed_prior,
)
from kcal.calibrate.lensfit.evidence import BOARD, Hyperprior, Quadratic, typical_hyperprior
from kcal.calibrate.lensfit.fleet import HyperLikelihood, fleet_hyperprior, hyper_likelihood
from kcal.calibrate.lensfit.hybrid_fit import HybridFit, fit_hybrid
from kcal.calibrate.lensfit.hybrid_problem import HybridProblem
from kcal.calibrate.lensfit.measured_board import MeasuredBoard
from kcal.corners.board import Board
from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.lens.zernike import ZernikeModes

# Until no view is to be turned: two are enough as a rule.
_MOST_FITS = 5


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CameraFit:
    """One of several cameras.

    Args:
        fit: the camera, with poses of the corners as they are turned.
        turns: (V,) quarter turns of the board by which the corners of each view were read from another end.
        message: what its data say about the board.
        hyper: what its data say about the amplitudes of lenses.
        board: which of the boards it saw; -1 for an exact one.
        nats: log evidence that it shares its board with the others of that board, against a board of its own. Of a
            camera that shares none: the same with the board that is most like its own, negative. NaN if there is no
            other camera with a board of this kind.
    """

    fit: HybridFit
    turns: Tensor
    message: BoardMessage
    hyper: HyperLikelihood
    board: int = -1
    nats: float = math.nan


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CamerasFit:
    """Several cameras and their boards.

    Args:
        cameras: in the order of the observations.
        boards: that they saw.
        hyperprior: what the next camera may expect; the typical one unless the cameras were of one type.
    """

    cameras: tuple[CameraFit, ...]
    boards: tuple[MeasuredBoard, ...]
    hyperprior: Hyperprior


def fit_cameras(
    sets: Sequence[Observations],
    *,
    names: Sequence[str] | None = None,
    weights: Sequence[Tensor | None] | None = None,
    modes: ZernikeModes | None = None,
    board: Literal["printed", "exact"] | MeasuredBoard = "printed",
    one_type: bool = False,
    passes: int = 1,
    advance: Callable[[str], None] | None = None,
) -> CamerasFit:
    """Fit cameras that saw one board, or several.

    Args:
        sets: observations of each camera.
        names: of the observations; numbers from 1 if not given.
        weights: (V, N) of each camera's corners; one if not given.
        modes: of the fields.
        board: how boards differ from the ones that were ordered: as printers err, not at all, or as was measured.
        one_type: the cameras are of one type: the amplitudes of their lenses are learned together.
        passes: how often the cameras are fitted again, with what the others tell, after they were fitted alone.
        advance: called with a text after each fit.

    Raises:
        InputError: no observations, or those of another board than the measured one.
    """
    if not sets:
        raise InputError("no observations: at least one camera is needed")
    names = names or [str(i + 1) for i in range(len(sets))]
    weights = weights or [None] * len(sets)
    each, typical = range(len(sets)), typical_hyperprior()

    def fit(
        i: int, turns: Tensor | None, shape: Literal["printed", "exact"] | BoardPrior, hyperprior: Hyperprior
    ) -> CameraFit:
        found = _fit_turned(sets[i], weights[i], modes, turns, shape, hyperprior)
        if advance is not None:
            advance(names[i])
        return found

    known = [board.prior_for(seen.board.points) for seen in sets][0] if isinstance(board, MeasuredBoard) else board
    cameras = [fit(i, None, known, typical) for i in each]
    if known == "printed":
        cameras = _grouped(cameras, [seen.board for seen in sets])
    elif known != "exact":
        cameras = [_compared(camera, known) for camera in cameras]
    for _ in range(passes):
        before = list(cameras)
        for i in each:
            same = [camera.message for j, camera in enumerate(before) if j != i and camera.board == before[i].board]
            shape = known
            if known == "printed" and same:
                base, _ = printed_board(before[i].fit.board_shapes, [before[i].message, *same])
                shape = multiplied(base, same).board
            if one_type or shape is not known:
                # What a camera tells itself does not enter its own priors.
                others = [camera.hyper for j, camera in enumerate(before) if one_type and j != i]
                again = fit(i, before[i].turns, shape, fleet_hyperprior(others, typical))
                cameras[i] = dataclasses.replace(again, board=before[i].board, nats=before[i].nats)
    if isinstance(board, MeasuredBoard):
        boards = [board]
    else:
        boards = [_measured(k, sets, names, cameras) for k in range(1 + max(camera.board for camera in cameras))]
    learned = fleet_hyperprior([camera.hyper for camera in cameras], typical) if one_type else typical
    return CamerasFit(cameras=tuple(cameras), boards=tuple(boards), hyperprior=learned)


def measure_board(
    sets: Sequence[Observations], *, names: Sequence[str] | None = None, advance: Callable[[str], None] | None = None
) -> tuple[MeasuredBoard, ...]:
    """Measure the board that cameras saw: how it bends, and how its print errs.

    Observations share a board where the evidence says so: two prints of one pattern are two boards.

    Args:
        sets: observations of one or several cameras.
        names: of the observations; numbers from 1 if not given.
        advance: called with a text after each fit.

    Returns:
        the boards, usually one, each with the names of the observations that it was measured from.

    Raises:
        InputError: no observations.

    Example:
        >>> from kcal.sim.board import BoardSize
        >>> from kcal.sim.captures import capture_corners, drawn_lens
        >>> from kcal.corners.observations import View
        >>> shots = capture_corners(drawn_lens("machine-vision", 1.0, 7), 8, sigma=0.1, seed=3).pixels.tolist()
        >>> views = tuple(View(name=str(i), pixels=pixels) for i, pixels in enumerate(shots))
        >>> seen = Observations(board=Board(columns=7, rows=6, square=0.05), image_size=(1920, 1080), views=views)
        >>> board, = measure_board([seen])
        >>> board.bending.value < 1e-4, tuple(board.points.shape)
        (True, (42, 3))
    """
    return fit_cameras(sets, names=names, advance=advance).boards


def _fit_turned(
    seen: Observations,
    weights: Tensor | None,
    modes: ZernikeModes | None,
    turns: Tensor | None,
    shape: Literal["printed", "exact"] | BoardPrior,
    hyperprior: Hyperprior,
) -> CameraFit:
    """Fit one camera, turn its views that were read from another end, and fit again until none is left."""
    board, pixels = seen.board, seen.pixels()
    weights = torch.ones_like(pixels[..., 0]) if weights is None else weights
    turns = torch.zeros(len(pixels), dtype=torch.long) if turns is None else turns
    for attempt in range(_MOST_FITS):
        ordered, weighted = (turned_corners(values, board, turns) for values in (pixels, weights))
        fit = fit_hybrid(board.points, ordered, seen.image_size, weighted, modes, shape, hyperprior)
        rows = _rows(fit, board.points, ordered, weighted)
        lens = fit.families.deviation(fit.hyperparameters)[: rows.shape[1] - 1 - len(fit.state.board)]
        if shape == "exact" or attempt == _MOST_FITS - 1:
            break
        prior = printed_prior(fit.board_shapes, fit.hyperparameters[BOARD:]) if shape == "printed" else shape
        more = find_turns(rows, board, prior, lens, fit.sigma**2)
        if not bool(more.any()):
            break
        turns = (turns + more) % 4
    flat = rows.transpose(1, 2).flatten(0, 1)
    freedom = 2 * int((torch.isfinite(ordered).all(-1) & (weighted > 0)).sum()) - 6 * len(pixels)
    message = message_from_rows(flat, lens, fit.sigma**2)
    return CameraFit(fit=fit, turns=turns, message=message, hyper=_hyper(fit, flat, len(lens), shape, freedom))


def _rows(fit: HybridFit, points: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
    """(V, S + 1, 2 N) derivatives by lens and board off the poses, and the target of these rows, pixels."""
    count = len(fit.state.board)
    mean = torch.cat([fit.families.mean[:-count], torch.zeros_like(fit.state.board)])
    problem = HybridProblem(
        points, fit.board_shapes.shapes, pixels, weights, fit.camera.model, mean, torch.zeros_like(mean)
    )
    rows = problem.without_poses(fit.state)
    rows[:, -1] = problem.shared(fit.state) @ rows[:, :-1] - rows[:, -1]
    return rows


def _hyper(
    fit: HybridFit, rows: Tensor, lens: int, shape: Literal["printed", "exact"] | BoardPrior, freedom: int
) -> HyperLikelihood:
    """What the rows (R, S + 1) say about the hyperparameters."""
    by_lens, by_board, target = rows[:, :lens], rows[:, lens:-1], rows[:, -1]
    if shape == "exact":
        by_board = torch.zeros_like(by_board)
    elif shape != "printed":
        target = target - by_board @ shape.mean
        by_board = by_board @ shape.half.T
    both = torch.cat([by_lens, by_board], 1) / math.sqrt(fit.tempering)
    target = target / math.sqrt(fit.tempering)
    data = Quadratic(both.T @ both, both.T @ target, float(target @ target), freedom / fit.tempering)
    return hyper_likelihood(data, fit.families, fit.hyperparameters, fit.sigma**2 / fit.tempering)


def _evidence(messages: Sequence[BoardMessage], like: CameraFit) -> float:
    """Log evidence of messages about one printed board."""
    return printed_board(like.fit.board_shapes, messages)[1] if messages else 0.0


def _gain(camera: CameraFit, others: Sequence[CameraFit]) -> float:
    """Nats by which one board for all is better than one for the camera and one for the others."""
    messages = [other.message for other in others]
    alone = _evidence([camera.message], camera) + _evidence(messages, camera)
    return _evidence([camera.message, *messages], camera) - alone


def _turned(camera: CameraFit, turn: int) -> CameraFit:
    """With all views read from another end."""
    message = camera.message.turned(mode_turn(turn))
    return dataclasses.replace(camera, turns=(camera.turns + turn) % 4, message=message)


def _grouped(cameras: Sequence[CameraFit], kinds: Sequence[Board]) -> list[CameraFit]:
    """Put each camera to the board, among those of its kind, that it shares with most evidence, or to a new one."""
    out, groups = list(cameras), list[list[int]]()
    # Those that know most begin: they have most to lose from another's board.
    known = [float(camera.message.root.square().sum()) for camera in cameras]
    for i in sorted(range(len(out)), key=lambda i: -known[i]):
        best: tuple[float, CameraFit, list[int]] = (0.0, out[i], [])
        for group in groups:
            if kinds[group[0]] == kinds[i]:
                for turn in quarter_turns(kinds[i]):
                    camera = _turned(cameras[i], turn)
                    # Read from another end only where that is clear.
                    gain = _gain(camera, [out[j] for j in group]) - (CLEAR if turn else 0.0)
                    best = max(best, (gain, camera, group), key=lambda found: found[0])
        _, out[i], group = best
        if not group:
            groups.append(group)
        group.append(i)
    # Boards are numbered by their first cameras.
    for k, group in enumerate(sorted(groups, key=min)):
        for i in group:
            rivals = [[j for j in group if j != i]] if len(group) > 1 else [g for g in groups if g is not group]
            gains = [_gain(out[i], [out[j] for j in g]) for g in rivals if kinds[g[0]] == kinds[i]]
            out[i] = dataclasses.replace(out[i], board=k, nats=max(gains, default=math.nan))
    return out


def _compared(camera: CameraFit, known: BoardPrior) -> CameraFit:
    """With the evidence that the board is the measured one."""
    nats = multiplied(known, [camera.message]).log_evidence - _evidence([camera.message], camera)
    return dataclasses.replace(camera, board=0, nats=nats)


def _measured(
    index: int, sets: Sequence[Observations], names: Sequence[str], cameras: Sequence[CameraFit]
) -> MeasuredBoard:
    """One of the boards, from all that saw it."""
    members = [i for i, camera in enumerate(cameras) if camera.board == index]
    messages = [cameras[i].message for i in members]
    prior, log_evidence = printed_board(cameras[members[0]].fit.board_shapes, messages)
    found = multiplied(prior, messages).board
    # Against the likelihood of a board without amplitudes.
    flat = -0.5 * sum(float(message.target.square().sum()) for message in messages)
    return MeasuredBoard(
        name=names[members[0]],
        board=sets[members[0]].board,
        amplitudes=found.mean,
        half=found.half,
        log_evidence=log_evidence - flat,
        observations=tuple(names[i] for i in members),
    )
