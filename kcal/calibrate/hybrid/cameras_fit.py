"""Fit several cameras together: they share the boards that they saw, and what lenses of one type have in common."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal, cast

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import CLEAR, find_turns, turned, turned_corners, turned_deviation
from kcal.calibrate.hybrid.evidence import Quadratic, negative_log_evidence
from kcal.calibrate.hybrid.families import BEFORE_LENS, BOARD, Hyperprior, LensPrior, PriorFamilies, typical_hyperprior
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.calibrate.hybrid.measured_board import BoardPrior, MeasuredBoard, evidence, printed_board, printed_prior
from kcal.corners.board import Board
from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.gaussian import Gaussian, numbered, stacked
from kcal.lens.information import BOARD_SLOT, LENS_SLOT
from kcal.lens.model import HybridForm
from kcal.threads import in_one_thread

# What cameras of one type have in common, learned from each other: first amplitudes, then the lens itself.
#
# Each camera's data are a Gaussian of its unknowns x: hyperparameters near their best, or lens coefficients.
# Over the cameras x is normal with unknown mean and spread, found by expectation maximization (empirical Bayes: Efron
# and Morris 1973). What the next camera may expect has the spread of Student's t, as a variance from few samples asks.

# Fewer tell no spread.
LEAST_CAMERAS = 4
_ITERATIONS = 50
# One camera more, that deviates by this share of the typical spread, keeps the spread above zero.
_LEAST_SPREAD = 0.1
# Focal lengths of one type of camera, relative.
_FOCAL = 0.05


def hyper_likelihood(data: Quadratic, families: PriorFamilies, h: Tensor, variance: float) -> Gaussian:
    """What the data of a camera say about its hyperparameters, near h (H,); the noise is maximized over.

    Args:
        data: of the camera.
        families: its priors.
        h: of largest evidence.
        variance: of the noise there.
    """
    _, gradient, bend = negative_log_evidence(data, families, np.append(h.numpy(), math.log(variance)))
    hessian = torch.from_numpy(bend)
    information = hessian[:-1, :-1] - torch.outer(hessian[:-1, -1], hessian[-1, :-1]) / hessian[-1, -1]
    slope = torch.from_numpy(gradient[:-1])
    # Far from where the data say anything the likelihood bends the wrong way: nothing is known there.
    values, vectors = torch.linalg.eigh(information)
    root, vectors = values[values > 0].sqrt()[:, None], vectors[:, values > 0].T
    rows = torch.cat([root * vectors, (vectors @ slope)[:, None] / root], 1)
    return Gaussian(numbered("amplitude", len(h)), h, rows)


def fleet_priors(cameras: Sequence[Gaussian], typical: Hyperprior) -> tuple[Hyperprior, list[Hyperprior]]:
    """The prior of the next camera of a type, and that of each camera from all others.

    Args:
        cameras: that are known.
        typical: what is expected of any camera.
    """
    unit, count = typical.sd, len(cameras)
    products = torch.stack([camera.placed(camera.slots, typical.mean).products for camera in cameras])
    information, vector = products[:, :-1, :-1] * unit[:, None] * unit, -products[:, :-1, -1] * unit
    # In units of the typical spread, about the typical mean.
    mean, variance = torch.zeros_like(unit), torch.ones_like(unit)
    for _ in range(_ITERATIONS):
        covariance = torch.linalg.inv(information + torch.diag(1.0 / variance))
        each = torch.einsum("gij,gj->gi", covariance, vector + mean / variance)
        mean = each.sum(0) / (count + variance)
        squares = (each - mean).square() + covariance.diagonal(dim1=1, dim2=2)
        variance = ((_LEAST_SPREAD**2 + squares.sum(0)) / count).clamp_max(1.0)

    def prior(total: Tensor, squares: Tensor, count: int) -> Hyperprior:
        if count < LEAST_CAMERAS - 1:
            return typical
        variance = ((_LEAST_SPREAD**2 + squares) / count).clamp_max(1.0)
        # Variance of Student's t of `count` degrees of freedom; the mean is known from `count` cameras.
        wide = (variance * (1.0 + 1.0 / count) * count / (count - 2.0)).clamp_max(1.0)
        return typical._replace(mean=typical.mean + unit * total / (count + variance), sd=unit * wide.sqrt())

    without = [prior(each.sum(0) - x, squares.sum(0) - s, count - 1) for x, s in zip(each, squares, strict=True)]
    return prior(each.sum(0), squares.sum(0), count), without


def typical_lens(form: HybridForm, families: PriorFamilies, h: Tensor, square: bool) -> Hyperprior:
    """What is expected of a lens with these amplitudes, from a type of which no other camera is known.

    Args:
        form: constants of the lens.
        families: priors that belong to these.
        h: (H,).
        square: whether pixels are square.
    """
    count = BEFORE_LENS + len(form.names) + (0 if square else 1)
    mean, sd = families.mean[:count].clone(), families.deviation(h)[:count].clone()
    sd[0] = _FOCAL * mean[0]
    if not square:
        sd[-1] = _FOCAL * mean[-1]
    return Hyperprior(mean, sd)


# Fit one camera of several: views turned to one order, and what its data say about board, amplitudes and lens.

# How a board differs from the one that was ordered: as printers err, not at all, or as others tell.
Shape = Literal["printed", "exact"] | BoardPrior

# Until no view is to be turned: two are enough as a rule.
_MOST_FITS = 5


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CameraFit:
    """One of several cameras.

    Args:
        fit: the camera, with poses of the corners as they are turned.
        turns: (V,) quarter turns of the board by which the corners of each view were read from another end.
        message: what its data say about the board.
        hyper: what its data say about the amplitudes of lenses; None unless it is one of a type.
        lens: likewise about its own lens, in the form of the fit.
        board: which of the boards it saw; -1 for an exact one.
        nats: log evidence that it shares its board with the others of that board, against a board of its own. Of a
            camera that shares none: the same with the board that is most like its own, negative. With a measured board:
            that it is this one. NaN if there is nothing to compare.
    """

    fit: HybridFit
    turns: Tensor
    message: Gaussian
    hyper: Gaussian | None = None
    lens: Gaussian | None = None
    board: int = -1
    nats: float = math.nan


def fit_turned(
    seen: Observations,
    weights: Tensor | None,
    options: FitOptions,
    turns: Tensor | None = None,
    one_type: bool = False,
    start: HybridFit | None = None,
    done: bool = False,
) -> CameraFit:
    """Fit one camera, turn its views that were read from another end, and fit again until none is left.

    Args:
        seen: what it saw.
        weights: (V, N) of the corners; one if not given.
        options: see there.
        turns: (V,) quarter turns that are known already.
        one_type: the camera is one of a type, so that it tells of its lens, too.
        start: an earlier fit of the views with these turns, to begin with.
        done: it has these weights and options, and is taken as it is.
    """
    board, pixels, shape = seen.board, seen.pixels(), options.board
    weights = torch.ones_like(pixels[..., 0]) if weights is None else weights
    turns = torch.zeros(len(pixels), dtype=torch.long) if turns is None else turns
    for attempt in range(_MOST_FITS):
        ordered, weighted = (turned_corners(values, board, turns) for values in (pixels, weights))
        if start is not None and done and attempt == 0:
            fit = start
        else:
            fit = fit_hybrid(board.points, ordered, seen.image_size, weighted, options, start=start)
        if shape == "exact" or len(board.quarter_turns) == 1 or attempt == _MOST_FITS - 1:
            break
        known = options.known_board(board.points)
        prior = printed_prior(fit.board_shapes, fit.expected[BOARD:]) if known is None else known.whole
        deviation = fit.families.deviation(fit.expected)[: -len(fit.state.board)]
        more = find_turns(_absolute_rows(fit, board.points, ordered, weighted), board, prior, deviation, fit.sigma**2)
        if not bool(more.any()):
            break
        turns, start = (turns + more) % 4, None
    message = fit.information.board_message.weighted(math.sqrt(fit.wider))
    found = CameraFit(fit=fit, turns=turns, message=message)
    return _with_its_type(found, board.points, ordered, weighted, options) if one_type else found


def _with_its_type(
    camera: CameraFit, points: Tensor, pixels: Tensor, weights: Tensor, options: FitOptions
) -> CameraFit:
    """Add what its data say about the amplitudes of lenses, and about its lens."""
    fit = camera.fit
    deviation = fit.families.deviation(fit.expected)
    of_board = numbered(BOARD_SLOT, len(fit.state.board))
    of_lens = numbered(LENS_SLOT, len(deviation) - len(of_board))
    mean = fit.families.mean[: len(of_lens)]
    flat = _absolute_rows(fit, points, pixels, weights).transpose(1, 2).flatten(0, 1)
    # The target is absolute, so that the residuals at the mean of lens and board are its negative.
    flat[:, -1] *= -1.0
    pixels_of = Gaussian((*of_lens, *of_board), torch.cat([mean, torch.zeros_like(fit.state.board)]), flat)
    data = pixels_of.weighted(1.0 / fit.sigma)
    known = options.known_board(points)
    if options.board == "exact":
        lens_alone = data.conditioned(of_board).compressed()
        pixels_of = pixels_of.conditioned(of_board).placed(pixels_of.slots, pixels_of.at)
    elif known is None:
        sigma = deviation[len(of_lens) :]
        lens_alone = (data + Gaussian.independent(of_board, torch.zeros_like(sigma), sigma)).marginal(of_lens)
    else:
        lens_alone = (data + known.whole).marginal(of_lens)
        # In the variables of the fit's priors.
        at, half = known.whole.mean_and_half()
        pixels_of = pixels_of.replaced(of_board, at, half.T, of_board)
    freedom = 2 * int((torch.isfinite(pixels).all(-1) & (weights > 0)).sum()) - 6 * len(pixels)
    hyper = _about_hyperparameters(fit, pixels_of.weighted(fit.tempering**-0.5), freedom / fit.tempering)
    return dataclasses.replace(camera, hyper=hyper, lens=lens_alone)


def _absolute_rows(fit: HybridFit, points: Tensor, pixels: Tensor, weights: Tensor) -> Tensor:
    """(V, S + 1, R) derivatives by lens and board off poses and motions, and the target of these rows, pixels."""
    count = len(fit.state.board)
    mean = torch.cat([fit.families.mean[:-count], torch.zeros_like(fit.state.board)])
    problem = fit.problem(points, pixels, weights, mean, torch.zeros_like(mean))
    rows = problem.off_poses(fit.state)
    rows[:, -1] = torch.einsum("s,vsn->vn", problem.unknowns(fit.state) - mean, rows[:, :-1]) - rows[:, -1]
    return rows


def _about_hyperparameters(fit: HybridFit, data: Gaussian, freedom: float) -> Gaussian:
    """What the data say, in pixels and about the mean of the fit's priors."""
    quadratic = Quadratic(data.products, freedom, torch.zeros_like(fit.families.mean))
    return hyper_likelihood(quadratic, fit.families, fit.hyperparameters, fit.sigma**2 / fit.tempering)


# Which cameras saw one board: their messages about it agree better than those about two boards would.


def grouped(cameras: Sequence[CameraFit], kinds: Sequence[Board]) -> list[CameraFit]:
    """Put each camera to the board, among those of its kind, that it shares with most evidence, or to a new one.

    Whether one board is better than two is asked of messages alone. Nothing is fitted again, and the evidence of each
    camera and of each group is found once.
    """
    out, groups = list(cameras), list[_SharedBoard]()
    # Those that know most begin: they have most to lose from another's board.
    known = [float(camera.message.rows[:, :-1].square().sum()) for camera in cameras]
    # Boards as printers make them look alike from all ends: turned messages have the same evidence.
    alone = [_evidence([camera.message], camera) for camera in cameras]
    for i in sorted(range(len(out)), key=lambda i: -known[i]):
        best: tuple[float, CameraFit, _SharedBoard | None, float] = (0.0, out[i], None, alone[i])
        for group in groups:
            if kinds[group.members[0]] == kinds[i]:
                for turn in kinds[i].quarter_turns:
                    camera = _turned(cameras[i], turn)
                    together = _evidence([camera.message, group.said], camera)
                    # Read from another end only where that is clear.
                    gain = together - alone[i] - group.evidence - (CLEAR if turn else 0.0)
                    best = max(best, (gain, camera, group, together), key=lambda found: found[0])
        _, out[i], home, together = best
        if home is None:
            groups.append(_SharedBoard([i], out[i].message, together))
        else:
            home.members.append(i)
            home.said, home.evidence = stacked([home.said, out[i].message]).compressed(), together
    # Boards are numbered by their first cameras.
    for k, group in enumerate(sorted(groups, key=lambda group: min(group.members))):
        for i, others in zip(group.members, _but_one([out[i].message for i in group.members]), strict=True):
            if others is not None:
                gains = [group.evidence - alone[i] - _evidence([others], out[i])]
            else:
                rivals = [g for g in groups if g is not group and kinds[g.members[0]] == kinds[i]]
                gains = [_evidence([out[i].message, g.said], out[i]) - alone[i] - g.evidence for g in rivals]
            out[i] = dataclasses.replace(out[i], board=k, nats=max(gains, default=math.nan))
    return out


@dataclasses.dataclass
class _SharedBoard:
    """Cameras that saw one board, what they say of it, and the log evidence of that."""

    members: list[int]
    said: Gaussian
    evidence: float


def compared(camera: CameraFit, known: Gaussian, kind: Board) -> CameraFit:
    """Add the evidence that the board is the measured one; turn all views if it was read from another end."""

    def nats(camera: CameraFit) -> float:
        return evidence(known, [camera.message]) - _evidence([camera.message], camera)

    best = camera
    for turn in kind.quarter_turns[1:]:
        best = max(best, _turned(camera, turn), key=lambda found: nats(found) + CLEAR * (found is camera))
    return dataclasses.replace(best, board=0, nats=nats(best))


def others_of(cameras: Sequence[CameraFit], board: int) -> dict[int, Gaussian | None]:
    """For each camera that saw a board: what all others say of it."""
    members = [i for i, camera in enumerate(cameras) if camera.board == board]
    return dict(zip(members, _but_one([cameras[i].message for i in members]), strict=True))


def _but_one(messages: Sequence[Gaussian]) -> list[Gaussian | None]:
    """For each message, all others merged; None where there is no other. The work is linear in the messages."""
    before = itertools.accumulate([None, *messages[:-1]], _merged)
    after = itertools.accumulate([None, *reversed(messages[1:])], _merged)
    return [*map(_merged, before, reversed([*after]))]


def _merged(*messages: Gaussian | None) -> Gaussian | None:
    """The sum of those messages that there are, in as many rows as there are unknowns; None without any."""
    some = [message for message in messages if message is not None]
    return stacked(some).compressed() if some else None


def _evidence(messages: Sequence[Gaussian], like: CameraFit) -> float:
    """Log evidence of messages about one printed board."""
    return printed_board(like.fit.board_shapes, messages)[1]


def _turned(camera: CameraFit, turn: int) -> CameraFit:
    """The camera with all views read from another end."""
    return dataclasses.replace(camera, turns=(camera.turns + turn) % 4, message=turned(camera.message, turn))


# Fit several cameras together: they share the boards that they saw, and what lenses of one type have in common.
#
# Each camera is fitted alone first. What its data say about the board is a Gaussian message; cameras whose messages
# agree better than two separate boards would explain saw one board. Then each camera is fitted again, with the messages
# of the others as its prior of the board.

# Calls a function for each of the numbered argument lists; numbers and results come in any order.
Run = Callable[[Callable[..., CameraFit], dict[int, tuple[Any, ...]]], Iterable[tuple[int, CameraFit]]]
# Further arguments of `fit_turned`.
_Task = tuple[FitOptions, Tensor | None, bool, HybridFit | None, bool]


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
    options: FitOptions | None = None,
    *,
    names: Sequence[str] | None = None,
    one_type: bool = False,
    passes: int = 1,
    first: Sequence[HybridFit] | None = None,
    run: Run | None = None,
    advance: Callable[[str], None] | None = None,
) -> CamerasFit:
    """Fit cameras that saw one board, or several.

    Args:
        sets: observations of each camera.
        options: of all fits; a board is as printers err, as it was ordered, or as was measured.
        names: of the observations; numbers from 1 if not given.
        one_type: the cameras are of one type: from four cameras on, each learns from the others what its lens is like.
        passes: how often the cameras are fitted again, with what the others tell, after they were fitted alone.
        first: fits of each camera alone with these options, if there are any; their weights are kept.
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
    weights = [fit.weights for fit in first] if first else [None] * len(sets)
    options = options or FitOptions()
    board = options.board
    known: BoardPrior | None = None
    if isinstance(board, MeasuredBoard):
        for seen in sets:
            known = board.prior_for(seen.board.points)
    each, alone = range(len(sets)), cast(Shape, "exact" if board == "exact" else "printed")

    run = run or (lambda function, tasks: ((i, function(*arguments)) for i, arguments in tasks.items()))

    def fit(tasks: dict[int, _Task]) -> dict[int, CameraFit]:
        """Fits of some cameras; each is told on as it ends."""
        found = {}
        for i, camera in run(fit_turned, {i: (sets[i], weights[i], *task) for i, task in tasks.items()}):
            found[i] = camera
            if advance is not None:
                advance(names[i])
        return found

    fleet = one_type and len(sets) >= LEAST_CAMERAS
    own = dataclasses.replace(options, board=alone)
    begun = fit({i: (own, None, fleet, first[i] if first else None, True) for i in each})
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
                shape = BoardPrior(printed[camera.board], same, _corners_of(camera.board, sets, cameras, fitted, i))
            if fleet or shape is not alone:
                # Views that were turned since, and lenses of another form, have other unknowns.
                kept = lenses[i] is None and torch.equal(camera.turns, fitted[i])
                own = dataclasses.replace(options, board=shape, lens=lenses[i])
                tasks[i] = own, camera.turns, fleet, camera.fit if kept else None, False
        for i, again in fit(tasks).items():
            fitted[i] = again.turns
            cameras[i] = dataclasses.replace(again, board=cameras[i].board, nats=cameras[i].nats)
    if isinstance(board, MeasuredBoard):
        boards = [board]
    else:
        numbers = range(1 + max(camera.board for camera in cameras))
        boards = [_measured(k, sets, names, cameras, fitted) for k in numbers]
    return CamerasFit(cameras=tuple(cameras), boards=tuple(boards), lens=lens)


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
        >>> from kcal.sim.captures import BoardSize, project_board
        >>> from kcal.sim.captures import sample_board_poses
        >>> camera = Camera.build(focal=(500, 500), center=(320, 240), size=(640, 480), coefficients=[-0.1])
        >>> size, generator = BoardSize(7, 6, 0.05), torch.Generator().manual_seed(3)
        >>> poses = sample_board_poses(camera, size, 6, generator, fill=(0.25, 0.8))
        >>> pixels = torch.stack([project_board(camera, pose, size)[0] for pose in poses])
        >>> pixels = pixels + 0.1 * torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
        >>> views = tuple(View(name=str(i), pixels=shot) for i, shot in enumerate(pixels.tolist()))
        >>> seen = Observations(board=Board(columns=7, rows=6, square=0.05), image_size=(640, 480), views=views)
        >>> board, = measure_board([seen])
        >>> board.bending.value < 3 * board.bending.sigma, tuple(board.points.shape)
        (True, (42, 3))
    """
    return fit_cameras(sets, names=names, advance=advance).boards


def _begun_fleet(cameras: Sequence[CameraFit]) -> LensPrior:
    """A lens prior for a type: the form of the camera of median focal length, and the amplitudes of all cameras.

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
    """Lens priors from all cameras for the next one, and for each camera from all others but itself."""
    following, each = fleet_priors([c.lens for c in cameras if c.lens is not None], typical.unknowns)
    return typical._replace(unknowns=following), [typical._replace(unknowns=prior) for prior in each]


def _measured(
    index: int,
    sets: Sequence[Observations],
    names: Sequence[str],
    cameras: Sequence[CameraFit],
    fitted: Sequence[Tensor],
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
        corners=_corners_of(index, sets, cameras, fitted),
    )


def _corners_of(
    board: int, sets: Sequence[Observations], cameras: Sequence[CameraFit], fitted: Sequence[Tensor], but: int = -1
) -> Tensor | None:
    """(N, 2) by which corners of a board are off their places, the mean over all cameras that found it but one."""
    found = []
    for i, (seen, camera, turns) in enumerate(zip(sets, cameras, fitted, strict=True)):
        if camera.board == board and i != but and camera.fit.displaced is not None:
            # A whole camera may have been turned since it was fitted.
            turn = int((camera.turns - turns)[0]) % 4
            found.append(turned_deviation(camera.fit.displaced, seen.board, turn))
    return torch.stack(found).mean(0) if found else None
