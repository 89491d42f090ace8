"""Fit several cameras together: they share the boards that they saw, and what lenses of one type have in common.

Each camera is fitted alone first. What its data say about the board is a Gaussian message; cameras whose messages agree
better than two separate boards would explain saw one board. Then each camera is fitted again, with the messages of the
others as its prior of the board.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Literal, cast

import torch
from torch import Tensor

from kcal.calibrate.lensfit.board_orders import CLEAR, mode_turn, quarter_turns
from kcal.calibrate.lensfit.board_prior import BoardMessage, BoardPrior, multiplied, printed_board
from kcal.calibrate.lensfit.evidence import Hyperprior, typical_hyperprior
from kcal.calibrate.lensfit.fleet import LEAST_CAMERAS, LensPrior, fleet_priors, typical_lens
from kcal.calibrate.lensfit.measured_board import MeasuredBoard
from kcal.calibrate.lensfit.turned_fit import CameraFit, Shape, fit_turned
from kcal.corners.board import Board
from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.lens.zernike import ZernikeModes


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CamerasFit:
    """Several cameras and their boards.

    Args:
        cameras: in the order of the observations.
        boards: that they saw.
        lens: what the next camera of the type may expect, if the cameras were of one type, and four at least.
    """

    cameras: tuple[CameraFit, ...]
    boards: tuple[MeasuredBoard, ...]
    lens: LensPrior | None


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
        one_type: the cameras are of one type: from four cameras on, each learns from the others what its lens is like.
        passes: how often the cameras are fitted again, with what the others tell, after they were fitted alone.
        advance: called with a text after each fit.

    Raises:
        InputError: no observations, those of another board than the measured one, no pass, or images of several sizes
            from cameras of one type.
    """
    if not sets:
        raise InputError("no observations: at least one camera is needed")
    if passes < 1:
        raise InputError(f"passes {passes}: one at least is needed, so that cameras learn from each other")
    if one_type and len({seen.image_size for seen in sets}) > 1:
        raise InputError("cameras of one type have images of one size; these have several")
    names = names or [str(i + 1) for i in range(len(sets))]
    weights = weights or [None] * len(sets)
    known: BoardPrior | None = None
    if isinstance(board, MeasuredBoard):
        for seen in sets:
            known = board.prior_for(seen.board.points)
    each, alone = range(len(sets)), cast(Shape, "exact" if board == "exact" else "printed")

    fitted: dict[int, Tensor] = {}

    def fit(i: int, shape: Shape, before: CameraFit | None = None, lens: LensPrior | None = None) -> CameraFit:
        turns = None if before is None else before.turns
        # Views that were turned since, and lenses of another form, have other unknowns.
        same = before is not None and lens is None and torch.equal(before.turns, fitted[i])
        start = before.fit if before is not None and same else None
        found = fit_turned(sets[i], weights[i], modes, turns, shape, lens, start)
        fitted[i] = found.turns
        if advance is not None:
            advance(names[i])
        return found

    cameras = [fit(i, alone) for i in each]
    if known is not None:
        cameras = [_compared(camera, known, seen.board) for camera, seen in zip(cameras, sets, strict=True)]
    elif alone == "printed":
        cameras = _grouped(cameras, [seen.board for seen in sets])
    fleet = one_type and len(sets) >= LEAST_CAMERAS
    lens = _begun_fleet(cameras) if fleet else None
    lenses = [lens] * len(sets)
    for turn in range(max(passes, 2) if fleet else passes):
        if lens is not None and turn == 1:
            lens, lenses[:] = _learned_fleet(cameras, lens)
        before = list(cameras)
        for i in each:
            same = [camera.message for j, camera in enumerate(before) if j != i and camera.board == before[i].board]
            shape = alone if known is None else known
            if shape == "printed" and same:
                base, _ = printed_board(before[i].fit.board_shapes, [before[i].message, *same])
                shape = multiplied(base, same).board
            if fleet or shape is not alone:
                again = fit(i, shape, before[i], lenses[i])
                cameras[i] = dataclasses.replace(again, board=before[i].board, nats=before[i].nats)
    if isinstance(board, MeasuredBoard):
        boards = [board]
    else:
        boards = [_measured(k, sets, names, cameras) for k in range(1 + max(camera.board for camera in cameras))]
    return CamerasFit(cameras=tuple(cameras), boards=tuple(boards), lens=lens)


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
        >>> from kcal.corners.observations import View
        >>> from kcal.lens.camera import Camera
        >>> from kcal.sim.captures import capture_corners
        >>> camera = Camera.build(focal=(500, 500), center=(320, 240), size=(640, 480), coefficients=[-0.1])
        >>> shots = capture_corners(camera, 6, sigma=0.1, seed=3).pixels.tolist()
        >>> views = tuple(View(name=str(i), pixels=pixels) for i, pixels in enumerate(shots))
        >>> seen = Observations(board=Board(columns=7, rows=6, square=0.05), image_size=(640, 480), views=views)
        >>> board, = measure_board([seen])
        >>> board.bending.value < 3 * board.bending.sigma, tuple(board.points.shape)
        (True, (42, 3))
    """
    return fit_cameras(sets, names=names, advance=advance).boards


def _begun_fleet(cameras: Sequence[CameraFit]) -> LensPrior:
    """One form for the lenses of a type, that of the camera of middle focal length, and the amplitudes of all."""
    middle = sorted(cameras, key=lambda camera: float(camera.fit.camera.params[0]))[len(cameras) // 2].fit
    form = middle.camera.model.hybrid
    assert form is not None
    hyperprior, _ = fleet_priors([camera.hyper for camera in cameras], typical_hyperprior())
    return LensPrior(form, float(middle.families.mean[0]), *typical_lens(form, middle.families, hyperprior.mean))


def _learned_fleet(cameras: Sequence[CameraFit], typical: LensPrior) -> tuple[LensPrior, list[LensPrior]]:
    """The lens of the next camera, and each camera's from all others: what a camera tells does not enter its prior."""
    following, each = fleet_priors([camera.lens for camera in cameras], Hyperprior(typical.mean, typical.sd))
    return typical._replace(**following._asdict()), [typical._replace(**prior._asdict()) for prior in each]


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


def _compared(camera: CameraFit, known: BoardPrior, kind: Board) -> CameraFit:
    """With the evidence that the board is the measured one, and all views turned if it was read from another end."""

    def nats(camera: CameraFit) -> float:
        return multiplied(known, [camera.message]).log_evidence - _evidence([camera.message], camera)

    best = camera
    for turn in quarter_turns(kind)[1:]:
        best = max(best, _turned(camera, turn), key=lambda found: nats(found) + CLEAR * (found is camera))
    return dataclasses.replace(best, board=0, nats=nats(best))


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
