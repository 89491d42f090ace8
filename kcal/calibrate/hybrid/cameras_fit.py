"""Fit several cameras together: they share the boards that they saw, and what lenses of one type have in common.

Each camera is fitted alone first. What its data say about the board is a Gaussian message; cameras whose messages agree
better than two separate boards would explain saw one board. Then each camera is fitted again, with the messages of the
others as its prior of the board.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, Literal, cast

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_groups import compared, grouped, others_of
from kcal.calibrate.hybrid.board_prior import BoardPrior, printed_board
from kcal.calibrate.hybrid.families import typical_hyperprior
from kcal.calibrate.hybrid.fit import HybridFit
from kcal.calibrate.hybrid.fleet import LEAST_CAMERAS, LensPrior, fleet_priors, typical_lens
from kcal.calibrate.hybrid.measured_board import MeasuredBoard
from kcal.calibrate.hybrid.turned_fit import CameraFit, Shape, fit_turned
from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.gaussian import Gaussian, stacked
from kcal.lens.zernike import ZernikeModes
from kcal.threads import in_one_thread

# Calls a function for each of the numbered argument lists; numbers and results come in any order.
Run = Callable[[Callable[..., CameraFit], dict[int, tuple[Any, ...]]], Iterable[tuple[int, CameraFit]]]
# Of one fit: turns, shape, whether cameras are of one type, lens, a fit to begin with, a fit that is taken as it is.
_Task = tuple[Tensor | None, Shape, bool, LensPrior | None, HybridFit | None, HybridFit | None]


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
    first: Sequence[HybridFit] | None = None,
    run: Run | None = None,
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
        first: fits of each camera alone with these weights and this board, if there are any.
        run: makes the fits of one pass, for example on other processes; one after the other if not given.
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

    run = run or _one_by_one

    def fit(tasks: dict[int, _Task]) -> dict[int, CameraFit]:
        """Fits of some cameras; each is told on as it ends."""
        found = {}
        for i, camera in run(fit_turned, {i: (sets[i], weights[i], modes, *task) for i, task in tasks.items()}):
            found[i] = camera
            if advance is not None:
                advance(names[i])
        return found

    fleet = one_type and len(sets) >= LEAST_CAMERAS
    begun = fit({i: (None, alone, fleet, None, None, first[i] if first else None) for i in each})
    cameras = [begun[i] for i in each]
    fitted = [camera.turns for camera in cameras]
    if known is not None:
        cameras = [compared(camera, known.own, seen.board) for camera, seen in zip(cameras, sets, strict=True)]
    elif alone == "printed":
        cameras = grouped(cameras, [seen.board for seen in sets])
    lens = _begun_fleet(cameras) if fleet else None
    lenses = [lens] * len(sets)
    for turn in range(max(passes, 2) if fleet else passes):
        if lens is not None and turn == 1:
            lens, lenses[:] = _learned_fleet(cameras, lens)
        tasks: dict[int, _Task] = {}
        others = [others_of(cameras, k) for k in range(1 + max(camera.board for camera in cameras))]
        # The prior of a printed board is the same for all that saw it.
        printed: dict[int, Gaussian] = {}
        for i, camera in enumerate(cameras):
            same = others[camera.board][i] if camera.board >= 0 else None
            shape = alone if known is None else known
            if shape == "printed" and same is not None:
                if camera.board not in printed:
                    printed[camera.board], _ = printed_board(camera.fit.board_shapes, [camera.message, same])
                shape = BoardPrior(printed[camera.board], same)
            if fleet or shape is not alone:
                # Views that were turned since, and lenses of another form, have other unknowns.
                kept = lenses[i] is None and torch.equal(camera.turns, fitted[i])
                tasks[i] = camera.turns, shape, fleet, lenses[i], camera.fit if kept else None, None
        for i, again in fit(tasks).items():
            fitted[i] = again.turns
            cameras[i] = dataclasses.replace(again, board=cameras[i].board, nats=cameras[i].nats)
    if isinstance(board, MeasuredBoard):
        boards = [board]
    else:
        boards = [_measured(k, sets, names, cameras) for k in range(1 + max(camera.board for camera in cameras))]
    return CamerasFit(cameras=tuple(cameras), boards=tuple(boards), lens=lens)


def _one_by_one(
    function: Callable[..., CameraFit], tasks: dict[int, tuple[Any, ...]]
) -> Iterator[tuple[int, CameraFit]]:
    for i, arguments in tasks.items():
        yield i, function(*arguments)


@in_one_thread
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
        >>> from kcal import Board, Camera, View
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
    """One form for the lenses of a type, that of the camera of middle focal length, and the amplitudes of all.

    Where pixels of one camera are not square, those of its type need not be.
    """
    stretched = [camera for camera in cameras if not camera.fit.square] or cameras
    middle = sorted(stretched, key=lambda camera: float(camera.fit.state.parameters[0]))[len(stretched) // 2].fit
    form = middle.camera.model.hybrid
    assert form is not None
    hyperprior, _ = fleet_priors([camera.hyper for camera in cameras if camera.hyper is not None], typical_hyperprior())
    usual = typical_lens(form, middle.families, hyperprior.mean, middle.square)
    return LensPrior(form, float(middle.families.mean[0]), usual)


def _learned_fleet(cameras: Sequence[CameraFit], typical: LensPrior) -> tuple[LensPrior, list[LensPrior]]:
    """The lens of the next camera, and each camera's from all others: what a camera tells does not enter its prior."""
    following, each = fleet_priors([c.lens for c in cameras if c.lens is not None], typical.unknowns)
    return typical._replace(unknowns=following), [typical._replace(unknowns=prior) for prior in each]


def _measured(
    index: int, sets: Sequence[Observations], names: Sequence[str], cameras: Sequence[CameraFit]
) -> MeasuredBoard:
    """One of the boards, from all that saw it."""
    members = [i for i, camera in enumerate(cameras) if camera.board == index]
    messages = [cameras[i].message for i in members]
    prior, log_evidence = printed_board(cameras[members[0]].fit.board_shapes, messages)
    mean, half = stacked([prior, *messages]).mean_and_half()
    # Against the likelihood of a board without amplitudes.
    flat = -0.5 * float(stacked(messages).placed(prior.slots, torch.zeros_like(mean)).products[-1, -1])
    return MeasuredBoard(
        name=names[members[0]],
        board=sets[members[0]].board,
        amplitudes=mean,
        half=half,
        log_evidence=log_evidence - flat,
        observations=tuple(names[i] for i in members),
    )
