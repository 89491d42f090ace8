"""Views to which a hybrid camera is fitted, their least squares, and rounds of solver and evidence until both rest."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import BoardModes
from kcal.calibrate.hybrid.evidence import (
    NO_MOTION,
    WORTH,
    Amplitudes,
    EvidenceLoss,
    ViewData,
    evidence_of_corners,
    evidence_of_motion,
    expected_maximum,
    loss_at,
    maximize_evidence,
    overdispersion,
    relative_bends,
    steps_of_amplitudes,
    view_data,
    with_tempering,
)
from kcal.calibrate.hybrid.families import PUPIL, Hyperprior, PriorFamilies
from kcal.calibrate.problem.board_problem import POSE, TURN, BoardProblem
from kcal.calibrate.problem.parameters import FreeParameters, GaussianPrior, GaussianTerm
from kcal.calibrate.problem.state import (
    AMPLITUDES,
    BENDS,
    LARGEST,
    MOTION,
    BoardState,
    Readout,
    motion_sigma,
    stillness,
    usual_motion,
)
from kcal.calibrate.problem.views import LEAST_NOISE
from kcal.gaussian import Gaussian, numbered
from kcal.lens.camera import Camera
from kcal.lens.information import LENS_SLOT
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions, RobustLoss, minimize

# What is unknown of a hybrid camera and of the board that it saw, and the least squares of both under their priors.


def hybrid_unknowns(model: LensModel, square: bool = True) -> FreeParameters:
    """What is free of a hybrid camera: focal length, principal point, and all coefficients; no skew.

    Square pixels have one focal length; others have that of the rows as the last of the camera's unknowns.
    """
    rest = range(5, 5 + model.size)
    rows = 0 if square else 3 + model.size
    return FreeParameters((0, 1, 2, 3, *rest), (0, rows, 1, 2, *(i - 2 for i in rest)))


def hybrid_prior(model: LensModel, mean: Tensor, precision: Tensor, square: bool = True) -> GaussianPrior:
    """The prior of `FittedViews.problem_under`."""
    leading, count, held = hybrid_unknowns(model, square).leading, 5 + model.size, torch.isinf(precision)
    board = torch.arange(count, count + len(mean) - len(leading))
    index = torch.cat([torch.tensor(leading), board])[~held]
    return GaussianPrior(index, mean[~held], precision[~held].sqrt())


# Views to which a hybrid camera is fitted, where a fit stands, and the least squares of both.


class Estimate(NamedTuple):
    """The present solution of a fit: its lens, the priors of all unknowns, their values and amplitudes.

    Attributes:
        model: of the lens.
        families: which amplitudes set the prior of each unknown.
        state: values of camera, board, poses and motions.
        amplitudes: the hyperparameters of the priors, and the noise without tempering.
        tempering: factor by which the data count less, because residuals repeat within views.
        relative: (V,) how much the board bends in each view, relative to the others; None: alike in all.
    """

    model: LensModel
    families: PriorFamilies
    state: BoardState
    amplitudes: Amplitudes
    tempering: float = 1.0
    relative: Tensor | None = None

    @property
    def variance(self) -> float:
        """Of the noise, tempering included, px²."""
        return self.amplitudes.variance * self.tempering

    @property
    def deviation(self) -> Tensor:
        """(S,) prior standard deviations of all unknowns."""
        return self.families.deviation(self.amplitudes.h)

    @property
    def stillness(self) -> Tensor:
        """The squared noise over the variance of each number of a view."""
        return stillness(self.amplitudes.log_ratio, self.relative)

    def with_board(self, board: BoardModes) -> Estimate:
        """The same with corners that are displaced by themselves, not at first, or no longer."""
        old, new = self.state.board, len(board.unit)
        families = self.families.with_board(board, len(old), len(self.amplitudes.h))
        moved = torch.nn.functional.pad(old, (0, new - len(old)))
        return self._replace(families=families, state=self.state._replace(board=moved))


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class FittedViews:
    """What a camera is fitted to.

    Args:
        points: (N, 3) the board as it was before, meters.
        board: how it may differ.
        pixels: (V, N, 2), NaN where not seen.
        size: (width, height) of the image.
        weights: (V, N) by which residuals are multiplied.
        hyperprior: of the amplitudes.
        readout: how views move while they are read, and how the board bends in them; None: neither.
        square: whether pixels are square.
        robust: bound the weight of corners that are far off.
        exact: the board does not differ.
        heights: (12, N) of the corners by which the board may bend by view, meters, if the evidence says so, or None.
        corners: whether each may be off its place on the board by itself, if the evidence says so.
        turning: views show points (V, N, 3) that are infinitely far, such as stars: poses are rotations, nothing
            depends on the pupil, and errors do not repeat within a view.
        known: what other data say of the lens, by the numbers of its unknowns, in standard deviations as weighted
            residuals are then, too; unknowns that it does not name are held. None: nothing.
    """

    points: Tensor
    board: BoardModes
    pixels: Tensor
    size: tuple[int, int]
    weights: Tensor
    hyperprior: Hyperprior
    readout: Readout | None = None
    square: bool = True
    robust: bool = False
    exact: bool = False
    heights: Tensor | None = None
    corners: bool = False
    turning: bool = False
    known: Gaussian | None = None

    @functools.cached_property
    def _kept(self) -> list[tuple[LensModel, Tensor, BoardProblem]]:
        """The last problem, with its lens and the mask of held unknowns."""
        return []

    @property
    def seen(self) -> Tensor:
        """(V, N)."""
        return torch.isfinite(self.pixels).all(-1) & (self.weights > 0)

    def by_corner(self, errors: Tensor) -> Tensor:
        """(V, N, 2) errors (V, 2, N) of pixels; NaN where a corner does not count."""
        return torch.where(self.seen[..., None], errors.transpose(-1, -2), torch.nan)

    def of_corners(self, kept: Tensor) -> FittedViews:
        """These views without motion, of some of the board's corners, given by their numbers."""
        return dataclasses.replace(
            self,
            points=self.points[kept],
            board=self.board._replace(shapes=self.board.shapes[..., kept]),
            pixels=self.pixels[:, kept],
            weights=self.weights[:, kept],
            readout=None,
            heights=None,
        )

    @property
    def freedom(self) -> int:
        """Number of residuals less the unknowns of all poses."""
        return 2 * int(self.seen.sum()) - (TURN if self.turning else POSE) * len(self.pixels)

    def held(self, estimate: Estimate) -> Tensor:
        """(S,) whether an unknown keeps its value, whatever the views show: of an exact board, of a pupil of stars."""
        held = torch.zeros_like(estimate.families.mean, dtype=torch.bool)
        if self.known is not None:
            named = set(self.known.slots)
            return torch.tensor([slot not in named for slot in numbered(LENS_SLOT, len(held))])
        held[PUPIL] = self.turning
        held[len(held) - len(self.board.unit) :] = self.exact
        return held

    def _told(self, model: LensModel) -> list[GaussianTerm]:
        """What other data say of the lens, as residuals."""
        if self.known is None:
            return []
        leading = hybrid_unknowns(model, self.square).leading
        numbers = dict(zip(numbered(LENS_SLOT, len(leading)), leading, strict=True))
        return [GaussianTerm(torch.tensor([numbers[slot] for slot in self.known.slots]), self.known, 1.0)]

    def problem_under(
        self, model: LensModel, mean: Tensor, precision: Tensor, stillness: Tensor | None = None
    ) -> BoardProblem:
        """Residuals of boards under a hybrid lens, with a normal prior on each unknown of lens and board.

        Args:
            model: of a hybrid lens.
            mean: (S,) of the prior on the unknowns of the camera and on the board.
            precision: (S,) its weight: the squared noise over the prior's variance. Infinite: held.
            stillness: (M,) or (V, M) the squared noise over the variance of each number of a view beside its pose.
        """
        return BoardProblem(
            self.points, self.pixels, model, hybrid_unknowns(model, self.square), shapes=self.board.shapes,
            free_board=True, held=torch.isinf(precision), weights=self.weights,
            terms=[hybrid_prior(model, mean, precision, self.square)], readout=self.readout, stillness=stillness,
            turning=self.turning, displaced=self.board.displaced,
        )  # fmt: skip

    def problem(self, estimate: Estimate, held: Tensor | None = None) -> BoardProblem:
        """The least squares at amplitudes of an estimate, unknowns (S,) being held: those of `held` if not given."""
        never = self.held(estimate) if held is None else held
        precision = torch.where(never, torch.inf, estimate.variance / estimate.deviation.square())
        fixed, still, kept = torch.isinf(precision), estimate.stillness, self._kept
        if kept and kept[0][0] is estimate.model and torch.equal(kept[0][1], fixed):
            # What corners say at the last state serves under other priors, too. The first state may show corners many
            # pixels from where they were read.
            problem = kept[0][2].read_as_shown(estimate.state, math.sqrt(estimate.amplitudes.variance))
        else:
            problem = self.problem_under(estimate.model, estimate.families.mean, precision, still)
            problem = problem.read_as_shown(estimate.state)
        kept[:] = [(estimate.model, fixed, problem)]
        prior = hybrid_prior(estimate.model, estimate.families.mean, precision, self.square)
        problem = problem.with_priors([prior, *self._told(estimate.model)], still)
        if self.robust:
            return problem.with_weights(_cauchy_weights(problem, estimate.state, self.weights))
        return problem

    def solved(
        self, estimate: Estimate, effort: tuple[int, float], last_step: bool = False, held: Tensor | None = None
    ) -> tuple[BoardProblem, Estimate, int]:
        """The problem, the estimate with its solution, and the trial steps.

        Without a last step the solution is where the problem was linearized: what is linear in lens and board, as the
        evidence is, follows from there.
        """
        problem = self.problem(estimate, held)
        steps, gain = effort
        options = LMOptions(
            max_iterations=steps, tolerance=gain / self.freedom, initial_damping=1e-10, last_step=last_step
        )
        result = minimize(problem, estimate.state, options, bend=problem.bent)
        return problem, estimate._replace(state=result.state), int(result.iterations)

    def data(self, problem: BoardProblem, estimate: Estimate) -> ViewData:
        """The data near an estimate as a quadratic form."""
        state, products = estimate.state, problem.products(estimate.state).off(problem.pose)
        count = problem.unknown_count
        if len(problem.moving) < count:
            # Unknowns that are held are among the others, of which nothing is said.
            place, size = torch.cat([problem.moving, torch.tensor([count])]), count + 1
            total = products.total.new_zeros(size, size)
            total[place[:, None], place] = products.total
            right, score = (
                part.new_zeros(*part.shape[:-1], size).index_copy_(-1, place, part)
                for part in (products.right, products.score)
            )
            products = products._replace(right=right, score=score, total=total)
        if self.known is not None:
            told = self.known.placed(numbered(LENS_SLOT, count), problem.unknowns(state)).products
            products = products._replace(total=products.total + told)
        found = view_data(products, problem.unknowns(state) - estimate.families.mean, state.motion, self.freedom)
        return found._replace(relative=estimate.relative)


def _cauchy_weights(problem: BoardProblem, state: BoardState, weights: Tensor) -> Tensor:
    """(V, N) weights of a Cauchy loss at a state, its scale three robust standard deviations; 0 without an image."""
    length = (problem.pixel_errors(state) * weights[:, None]).norm(dim=1)
    shown = torch.isfinite(length) & problem.seen
    # Of two normal components, the median length is 1.18 standard deviations.
    scale = max(3.0 * float(length[shown].median()) / 1.18, LEAST_NOISE)
    return torch.where(shown, weights * RobustLoss(kind="cauchy", scale=scale).weight(length.square()).sqrt(), 0.0)


# Solve for camera, board, poses and motions, and set all amplitudes by the evidence, until both converge.

_ROUNDS = 12
# Rounds after which the evidence of one compares with that of another: the first begins with typical amplitudes.
_SETTLED = 1
# Steps of the solver, and squared standard deviations by which one must lower chi² to be worth the next: in the first
# round, in the others, and at the end.
_FIRST, _LATER, LAST = (8, 0.1), (12, 0.02), (60, 0.01)
# First rounds after which corners are weighed anew, where that is asked for.
_REWEIGHED = 3
# Nats by which the evidence may fall from one round to another, because the problem is not linear.
_DRIFT = 5.0
# Rounds that single corners need to settle.
_ANEW = 3
# Motions beyond this stand for something else.
_TOO_MUCH = 0.5 * LARGEST
# Hyperparameters have converged when none, nor the logarithm of the tempering, changes by more.
_AT_REST = 0.1
# The same for a fit from which another begins.
_NEAR_REST = 0.3
# Nats by which the evidence may still change from one round to the next; and where a board bends by view: its amplitude
# and the factors of views pass a common scale to each other for many rounds, which the camera does not feel.
_UNFELT, _SCALE = 0.02, 0.5
# With which motions begin: as a hand moves. From that of still views, field and board explain the motion first, and
# the evidence has another maximum there (one of sixty simulated captures by hand).
_MOVING = 3e-3
# Standard deviations of bending, in extents of the board, with which it is tried.
_BENT = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
# The same of displacements of single corners.
_DISPLACED = (2e-5, 6e-5, 2e-4, 6e-4, 2e-3)


class Rounds(NamedTuple):
    """The result of `run_rounds`.

    Attributes:
        capture: what was fitted; without a readout where views turned out not to move.
        readout: with which the rounds began.
        estimate: camera, board, poses and amplitudes.
        data: near it.
        loss: the negative logarithm of the evidence; of data that count less by the tempering, where views stand still.
        steps: trial steps of the solver.
        converged: whether the hyperparameters converged.
        gained: nats by which motion raised the evidence, where that was too little for it to be kept.
    """

    capture: FittedViews
    readout: Readout | None
    estimate: Estimate
    data: ViewData
    loss: float
    steps: int
    converged: bool
    gained: float = math.nan

    @property
    def untempered_loss(self) -> float:
        """`loss` for data that count fully: only such losses of different rounds can be compared."""
        tempering = self.estimate.tempering
        own, variance = 1.0 if self.data.moving else tempering, self.estimate.amplitudes.variance
        return with_tempering(self.loss, self.data.still.freedom, variance, own, 1.0)


def begin_motion(capture: FittedViews, estimate: Estimate) -> Estimate:
    """An estimate with motion and bending as the capture's readout has them.

    Values that the estimate has already are kept; new ones begin at zero, with the amplitude of a hand's motion.
    """
    readout, old, ratios = capture.readout, estimate.state.motion, estimate.amplitudes.log_ratio
    has = (False, False) if readout is None else (readout.moves, readout.bends is not None)
    had = (len(ratios) >= AMPLITUDES, len(ratios) % AMPLITUDES > 0)
    count, again = len(capture.pixels), len(old) == len(capture.pixels)
    if has == had and again:
        return estimate
    begin, by_hand = np.full(AMPLITUDES * has[0] + has[1], math.log(_MOVING)), capture.hyperprior.by_hand
    begin = usual_motion(len(begin), True)[0] if by_hand and has[0] else begin
    ratio = begin - 0.5 * math.log(estimate.amplitudes.variance)
    motion = old.new_zeros(count, MOTION * has[0] + BENDS * has[1])
    # Motion comes first, bending last.
    numbers, parts = (slice(MOTION), slice(-BENDS, None)), (slice(AMPLITUDES), slice(-1, None))
    for kept in (k for k in (0, 1) if again and has[k] and had[k]):
        motion[:, numbers[kept]], ratio[parts[kept]] = old[:, numbers[kept]], ratios[parts[kept]]
    relative = (estimate.relative if again and had[1] else old.new_ones(count)) if has[1] else None
    amplitudes = estimate.amplitudes._replace(log_ratio=ratio if any(has) else NO_MOTION)
    return estimate._replace(state=estimate.state._replace(motion=motion), amplitudes=amplitudes, relative=relative)


def _least_gained(readout: Readout, data: ViewData, estimate: Estimate, by_hand: bool) -> tuple[float, bool]:
    """The smaller gain of evidence (nats), of motion beside bending or of bending beside motion; whether of motion.

    Where views move as by hand, nobody asks whether they moved.
    """
    _, families, _, best, tempering, _ = estimate
    parts = [(list(range(AMPLITUDES)), True)] * (readout.moves and not by_hand)
    parts += [([len(best.log_ratio) - 1], False)] * (readout.bends is not None)
    gains = [(evidence_of_motion(data, best, families, tempering, part), moves) for part, moves in parts]
    return min(gains, default=(math.inf, True))


def _with_bending(capture: FittedViews, estimate: Estimate) -> tuple[FittedViews, Estimate] | None:
    """Views and estimate with a board that bends by view; None where that explains the views no better.

    This is decided from one linearization at the estimate: nothing is fitted.
    """
    readout = capture.readout or Readout(center=capture.points.mean(0), distance=1.0, size=capture.size, moves=False)
    if capture.heights is None or readout.bends is not None:
        return None
    wider = dataclasses.replace(capture, readout=dataclasses.replace(readout, bends=capture.heights))
    bent, best = begin_motion(wider, estimate), estimate.amplitudes
    data = wider.data(wider.problem(bent), bent)
    stiff = loss_at(data.only(range(len(best.log_ratio))), best, estimate.families, estimate.tempering)
    least, found = stiff, best
    for ratio in np.log(_BENT) - 0.5 * math.log(best.variance):
        trial = best._replace(log_ratio=np.append(best.log_ratio, ratio))
        loss = loss_at(data, trial, estimate.families, estimate.tempering)
        if not loss < least:
            # The evidence of a variance has one maximum: most boards are stiff, and the least bending is unlikelier.
            break
        least, found = loss, trial
    return (wider, bent._replace(amplitudes=found, tempering=1.0)) if stiff - least >= WORTH else None


def _with_corners(capture: FittedViews, estimate: Estimate) -> tuple[FittedViews, Estimate] | None:
    """Views and estimate with each corner displaced by itself, or with none again; None where all stays as it is.

    Decided from one linearization, as `_with_bending` does.
    """
    if not capture.corners:
        return None
    if capture.board.displaced:
        data, best = capture.data(capture.problem(estimate), estimate), estimate.amplitudes
        sizes = [math.exp(float(best.h[-1]))]
        if float(evidence_of_corners(data, best, estimate.families, estimate.tempering, sizes)[0]) >= WORTH:
            return None
        board = capture.board.without_corners()
        return dataclasses.replace(capture, board=board, corners=False), estimate.with_board(board)
    wider = dataclasses.replace(capture, board=capture.board.with_corners())
    trial, best = estimate.with_board(wider.board), estimate.amplitudes
    data = wider.data(wider.problem(trial), trial)
    gained = evidence_of_corners(data, best, trial.families, estimate.tempering, _DISPLACED)
    if not gained.max() >= WORTH:
        return None
    h = best.h.clone()
    h[-1] = math.log(_DISPLACED[int(gained.argmax())])
    return wider, trial._replace(amplitudes=best._replace(h=h))


def run_rounds(
    capture: FittedViews,
    estimate: Estimate,
    *,
    cold: bool = False,
    spent: int = 0,
    rough: bool = False,
    progress: Callable[[str], object] = lambda _: None,
    reweigh: Callable[[FittedViews, Estimate], FittedViews] | None = None,
) -> Rounds:
    """Solve for all unknowns and set amplitudes by the evidence, in turn, until both converge.

    Args:
        capture: what is fitted.
        estimate: to begin with.
        cold: the estimate is that of the base projection, so that its amplitudes mean nothing yet.
        spent: trial steps before.
        rough: another fit will begin where this one ends, so that it need not converge entirely.
        progress: called after each round.
        reweigh: called after each of the first rounds: the same views with other weights, such as without outliers.
    """
    readout, converged, tempered, lost = capture.readout, False, False, math.nan
    top: Rounds | None = None
    last, effort = math.inf, _LATER
    estimate = begin_motion(capture, estimate)
    if capture.readout is not None:
        # That of an earlier fit, which was found after its rounds.
        estimate = estimate._replace(tempering=1.0)
    for turn in range(_ROUNDS):
        first = turn == 0 and cold
        problem, estimate, steps = capture.solved(estimate, _FIRST if first else effort)
        spent += steps
        data = capture.data(problem, estimate)
        former = tempering = estimate.tempering
        if not first and problem.readout is None and not capture.turning:
            found = _overdispersion(data, estimate, capture)
            # More tempering leaves fewer parameters, over which the scores scatter less, and so on: the mean of both
            # ends this where the new value alone swings forever (OpenCV's left camera, between 1 and 2).
            tempering = math.sqrt(tempering * found) if tempered else found
            tempered = True
        best = estimate.amplitudes
        # An earlier fit of still views, under another prior, is farther off than what a round leaves: by a step.
        most = 3 if turn == 0 and problem.readout is None else 2
        for roughly in (True,) if rough else (True, False):
            best = maximize_evidence(
                data,
                estimate.families,
                best,
                capture.hyperprior,
                tempering,
                roughly,
                known_noise=capture.known is not None,
            )
            change = max(_moved_by(estimate.amplitudes, best), abs(math.log(tempering / former)))
            # The solver may try several steps where it finds nothing that the evidence feels.
            ended, bends = steps < effort[0], data.relative is not None
            still = steps <= most or abs(best.loss - last) < (_SCALE if ended and bends else _UNFELT)
            resting = not first and (change < _NEAR_REST if rough else change < _AT_REST and still)
            # To the end where nothing will change any more.
            if not resting:
                break
        if data.relative is not None:
            relative, best = relative_bends(data, best, estimate.families)
            moved = float((relative / data.relative).log().abs().max())
            resting &= moved < (_NEAR_REST if rough else _AT_REST)
            data = data._replace(relative=relative)
        estimate = estimate._replace(amplitudes=best, tempering=tempering, relative=data.relative)
        last = best.loss
        # Where its amplitudes rest and the solver does not, more rounds of a few steps would end as those before.
        effort = LAST if bends and change < _AT_REST and not ended else _LATER
        progress(f"prior amplitudes from the evidence, step {turn + 1}")
        if reweigh is not None and turn < _REWEIGHED:
            weighed = reweigh(capture, estimate)
            resting &= torch.equal(weighed.weights, capture.weights)
            capture = weighed
        if (first or resting) and turn < _ROUNDS // 2:
            bent = _with_bending(capture, estimate)
            if bent is not None:
                (capture, estimate), top = bent, None
                continue
        if data.moving and turn < _ROUNDS - 1:
            # The first round tells it as the second does, within .05 nats for 16 simulated captures of 6 to 200 views.
            assert capture.readout is not None
            gained, moves = _least_gained(capture.readout, data, estimate, capture.hyperprior.by_hand)
            if gained < WORTH:
                less = dataclasses.replace(capture.readout, **({"moves": False} if moves else {"bends": None}))
                # A stiff board is not tried again.
                lost, heights = (gained, capture.heights) if moves else (lost, None)
                capture = dataclasses.replace(capture, readout=less if less.numbers else None, heights=heights)
                estimate = begin_motion(capture, estimate)
                continue
        # A rough fit is followed by one that asks.
        if (resting or turn == _ROUNDS // 2) and not rough and turn < _ROUNDS - _ANEW:
            other = _with_corners(capture, estimate)
            if other is not None:
                (capture, estimate), top = other, None
                continue
        if resting:
            converged = True
            break
        if data.moving and turn >= _SETTLED and ended:
            # Few views that move much leave a direction along which the best camera drifts while the evidence falls:
            # the round of largest evidence counts, among those whose solver came to its end.
            if top is None or best.loss < top.loss:
                top = Rounds(capture, readout, estimate, data, best.loss, spent, False)
            elif best.loss > top.loss + _DRIFT:
                break
    if top is not None and not converged and data.moving and top.loss < best.loss:
        capture, estimate, data = top.capture, top.estimate, top.data
    if data.moving:
        # Once, at the end: amplitudes of motions that were set with it again would grow without bound where views are
        # few, as both explain the same residuals (measured on a webcam's seven views).
        tempering = _overdispersion(data, estimate, capture)
        estimate = estimate._replace(tempering=tempering)
    return Rounds(capture, readout, estimate, data, best.loss, spent, converged, lost)


def expected_estimate(rounds: Rounds) -> Estimate:
    """The estimate with expected amplitudes (`expected_maximum`) in place of the most likely ones."""
    return rounds.estimate._replace(amplitudes=expected_maximum(*_at_maximum(rounds)))


def moved_by_amplitudes(rounds: Rounds) -> Tensor:
    """(H, S) by how much lens and board move with amplitudes that are known only roughly (`steps_of_amplitudes`)."""
    return steps_of_amplitudes(*_at_maximum(rounds))


def _at_maximum(rounds: Rounds) -> tuple[ViewData, PriorFamilies, Amplitudes, Hyperprior, float]:
    estimate, data = rounds.estimate, rounds.data
    # Views that move were tempered after their amplitudes were found.
    tempering = 1.0 if data.moving else estimate.tempering
    return data, estimate.families, estimate.amplitudes, rounds.capture.hyperprior, tempering


def motion_is_worth(rounds: Rounds, readout: Readout) -> bool:
    """Whether views that were fitted as standing still are explained better by motion, to first order at the fit."""
    capture = dataclasses.replace(rounds.capture, readout=readout)
    moving = begin_motion(capture, rounds.estimate)
    data = capture.data(capture.problem(moving), moving)
    best = maximize_evidence(data, moving.families, moving.amplitudes, capture.hyperprior, rough=True)
    return bool(evidence_of_motion(data, best, moving.families, 1.0) >= WORTH)


def columns_may_be_read(rounds: Rounds) -> bool:
    """Whether columns, read one after the other, may explain the motion of views better than rows.

    They do near this solution; or there is none, because motions came to their limit.
    """
    readout, estimate = rounds.capture.readout, rounds.estimate
    if readout is None or not readout.moves:
        return False
    found = motion_sigma(estimate.amplitudes.log_ratio, estimate.amplitudes.variance)
    if not rounds.converged or max(found.turn, found.shift) > _TOO_MUCH:
        return True
    still = estimate._replace(state=estimate.state._replace(motion=torch.zeros_like(estimate.state.motion)))
    readouts = [dataclasses.replace(readout, columns=columns) for columns in (False, True)]
    captures = [dataclasses.replace(rounds.capture, readout=one) for one in readouts]
    by_rows, by_columns = (capture.data(capture.problem(estimate), still) for capture in captures)
    prior, families, amplitudes = rounds.capture.hyperprior, estimate.families, estimate.amplitudes
    # Amplitudes are the best ones for rows already.
    best = maximize_evidence(by_columns, families, amplitudes, prior, rough=True)
    return best.loss < EvidenceLoss(by_rows, families, prior, 1.0).value(amplitudes.vector)


def _moved_by(old: Amplitudes, new: Amplitudes) -> float:
    """The largest change of a hyperparameter or ratio."""
    return max(float((new.h - old.h).abs().max()), float(np.abs(new.log_ratio - old.log_ratio).max(initial=0.0)))


def _overdispersion(data: ViewData, estimate: Estimate, capture: FittedViews) -> float:
    deviation, ratio = torch.where(capture.held(estimate), 0.0, estimate.deviation), estimate.amplitudes.log_ratio
    K = data.integrated(ratio).data.K
    # Single corners do not repeat within a view, and there are many.
    own = slice(len(deviation) - len(estimate.state.board) + len(capture.board.shapes))
    return overdispersion(data.scores(ratio)[:, own], K[own, own], deviation[own], estimate.variance)


# Poses and motions of views that were held out, under a camera and a board that stay as they are.

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
        stillness: (M,) the squared noise over the variance of each number of a view.

    Returns:
        (V, N, 2) projected minus seen, pixels; NaN where not seen.
    """
    posed = rotation.flatten(1).isfinite().all(1)
    out = torch.full_like(pixels, torch.nan)
    if not bool(posed.any()):
        return out
    params = camera.params.detach()
    some = pixels[posed]
    problem = BoardProblem(board_points, some, camera.model, readout=readout, stillness=stillness)
    motion = rotation.new_zeros(len(some), readout.numbers)
    state = BoardState.flat(params, rotation[posed], translation[posed])._replace(motion=motion)
    out[posed] = problem.corner_residuals(minimize(problem, state, _EFFORT).state)
    return out
