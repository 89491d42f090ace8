"""Solve for camera, board, poses and motions, and set all amplitudes by the evidence, until both come to rest."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from kcal.calibrate.hybrid.evidence import (
    WORTH,
    Maximum,
    ViewData,
    evidence_of_motion,
    expected_maximum,
    maximize_evidence,
    overdispersion,
    relative_bends,
    with_tempering,
)
from kcal.calibrate.hybrid.families import PriorFamilies
from kcal.calibrate.hybrid.fitted_views import NO_MOTION, Estimate, FittedViews
from kcal.calibrate.problem.state import (
    AMPLITUDES,
    BENDS,
    LARGEST,
    MOTION,
    Readout,
    motion_sigma,
)

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
# Motions beyond this stand for something else.
_TOO_MUCH = 0.5 * LARGEST
# Hyperparameters have come to rest when none, nor the logarithm of the tempering, moves by more.
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


class Rounds(NamedTuple):
    """Where the rounds ended.

    Attributes:
        capture: what was fitted; views that do not move have lost their readout.
        readout: with which they began.
        estimate: camera, board, poses and amplitudes.
        data: near it.
        loss: the negative logarithm of the evidence; of data that count less by the tempering, where views stand still.
        steps: trial steps of the solver.
        converged: whether the hyperparameters came to rest.
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
        """The same of data that count fully, so that it compares with that of other rounds."""
        tempering = self.estimate.tempering
        own, variance = 1.0 if self.data.moving else tempering, self.estimate.variance / tempering
        return with_tempering(self.loss, self.data.still.freedom, variance, own, 1.0)


def begin_motion(capture: FittedViews, estimate: Estimate) -> Estimate:
    """An estimate with the numbers of views that a capture has: those it had stay, others begin as a hand moves."""
    readout, old, ratios = capture.readout, estimate.state.motion, estimate.log_ratio
    has = (False, False) if readout is None else (readout.moves, readout.bends is not None)
    had = (len(ratios) >= AMPLITUDES, len(ratios) % AMPLITUDES > 0)
    count, again = len(capture.pixels), len(old) == len(capture.pixels)
    if has == had and again:
        return estimate
    begin = math.log(_MOVING) - 0.5 * math.log(estimate.variance / estimate.tempering)
    motion, ratio = old.new_zeros(count, MOTION * has[0] + BENDS * has[1]), np.full(AMPLITUDES * has[0] + has[1], begin)
    # Motion comes first, bending last.
    numbers, parts = (slice(MOTION), slice(-BENDS, None)), (slice(AMPLITUDES), slice(-1, None))
    for kept in (k for k in (0, 1) if again and has[k] and had[k]):
        motion[:, numbers[kept]], ratio[parts[kept]] = old[:, numbers[kept]], ratios[parts[kept]]
    relative = (estimate.relative if again and had[1] else old.new_ones(count)) if has[1] else None
    return estimate._replace(
        state=estimate.state._replace(motion=motion), log_ratio=ratio if any(has) else NO_MOTION, relative=relative
    )


def _least_gained(
    readout: Readout, data: ViewData, best: Maximum, families: PriorFamilies, tempering: float
) -> tuple[float, bool]:
    """By how many nats motion, or bending, raises the evidence beside the other: the lesser, and whether of motion."""
    parts = [(list(range(AMPLITUDES)), True)] * readout.moves
    parts += [([len(best.log_ratio) - 1], False)] * (readout.bends is not None)
    return min((evidence_of_motion(data, best, families, tempering, part), moves) for part, moves in parts)


def _with_bending(
    capture: FittedViews, estimate: Estimate, best: Maximum, tempering: float
) -> tuple[FittedViews, Estimate] | None:
    """The same of a board that bends by view; None where that explains the views no better.

    It is told near the estimate, from one linearization: nothing is fitted.
    """
    readout = capture.readout or Readout(center=capture.points.mean(0), distance=1.0, size=capture.size, moves=False)
    if capture.heights is None or readout.bends is not None:
        return None
    wider = dataclasses.replace(capture, readout=dataclasses.replace(readout, bends=capture.heights))
    bent = begin_motion(wider, estimate)
    data, trials = wider.data(wider.problem(bent), bent), []
    for sigma in _BENT:
        ratio = np.append(best.log_ratio, math.log(sigma) - 0.5 * math.log(best.variance))
        trial, number = best._replace(log_ratio=ratio), [len(ratio) - 1]
        trials.append((evidence_of_motion(data, trial, estimate.families, tempering, number), sigma, ratio))
    gained, _, ratio = max(trials)
    return (wider, bent._replace(log_ratio=ratio, variance=best.variance, tempering=1.0)) if gained >= WORTH else None


def run_rounds(
    capture: FittedViews,
    estimate: Estimate,
    *,
    cold: bool,
    spent: int,
    rough: bool,
    progress: Callable[[str], object],
    reweigh: Callable[[FittedViews, Estimate], FittedViews] | None = None,
) -> Rounds:
    """Solve and set amplitudes in turn.

    Args:
        capture: what is fitted.
        estimate: to begin with.
        cold: the estimate is that of the base projection, so that its amplitudes mean nothing yet.
        spent: trial steps before.
        rough: another fit will begin where this one ends, so that it need not come to rest entirely.
        progress: called after each round.
        reweigh: called after each of the first rounds: the same views with other weights, such as without outliers.
    """
    readout, converged, tempered, lost = capture.readout, False, False, math.nan
    top: Rounds | None = None
    last, effort = math.inf, _LATER
    estimate = begin_motion(capture, estimate)
    if capture.readout is not None:
        # That of an earlier fit, which was found after its rounds.
        estimate = estimate._replace(variance=estimate.variance / estimate.tempering, tempering=1.0)
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
        best = Maximum(estimate.hyperparameters, estimate.log_ratio, estimate.variance / former, math.inf)
        # An earlier fit of still views, under another prior, is farther off than what a round leaves: by a step.
        most = 3 if turn == 0 and problem.readout is None else 2
        for roughly in (True,) if rough else (True, False):
            best = maximize_evidence(
                data,
                estimate.families,
                best.h,
                best.variance,
                capture.hyperprior,
                best.log_ratio,
                tempering,
                roughly,
                known_noise=capture.known is not None,
            )
            change = max(_moved_by(estimate, best), abs(math.log(tempering / former)))
            # The solver may try several steps where it finds nothing that the evidence feels.
            ended, bends = steps < effort[0], data.relative is not None
            still = steps <= most or abs(best.loss - last) < (_SCALE if ended and bends else _UNFELT)
            resting = not first and (change < _NEAR_REST if rough else change < _AT_REST and still)
            # To the end where nothing will change any more.
            if not resting:
                break
        if data.relative is not None:
            relative = relative_bends(data, best, estimate.families)
            moved = float((relative / data.relative).log().abs().max())
            resting &= moved < (_NEAR_REST if rough else _AT_REST)
            data = data._replace(relative=relative)
        estimate = estimate._replace(
            hyperparameters=best.h,
            relative=data.relative,
            log_ratio=best.log_ratio,
            variance=best.variance * tempering,
            tempering=tempering,
        )
        last = best.loss
        # Where its amplitudes rest and the solver does not, more rounds of a few steps would end as those before.
        effort = LAST if bends and change < _AT_REST and not ended else _LATER
        progress(f"evidence, round {turn + 1}")
        if reweigh is not None and turn < _REWEIGHED:
            weighed = reweigh(capture, estimate)
            resting &= torch.equal(weighed.weights, capture.weights)
            capture = weighed
        if (first or resting) and turn < _ROUNDS // 2:
            bent = _with_bending(capture, estimate, best, tempering)
            if bent is not None:
                (capture, estimate), top = bent, None
                continue
        if data.moving and turn < _ROUNDS - 1:
            # The first round tells it as the second does, within .05 nats for 16 simulated captures of 6 to 200 views.
            assert capture.readout is not None
            gained, moves = _least_gained(capture.readout, data, best, estimate.families, tempering)
            if gained < WORTH:
                less = dataclasses.replace(capture.readout, **({"moves": False} if moves else {"bends": None}))
                # A stiff board is not tried again.
                lost, heights = (gained, capture.heights) if moves else (lost, None)
                capture = dataclasses.replace(capture, readout=less if less.numbers else None, heights=heights)
                estimate = begin_motion(capture, estimate)
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
        estimate = estimate._replace(variance=estimate.variance * tempering, tempering=tempering)
    return Rounds(capture, readout, estimate, data, best.loss, spent, converged, lost)


def expected_estimate(rounds: Rounds) -> Estimate:
    """The estimate with the amplitudes that are to be expected in place of the most likely ones."""
    estimate, data = rounds.estimate, rounds.data
    variance = estimate.variance / estimate.tempering
    best = Maximum(estimate.hyperparameters, estimate.log_ratio, variance, rounds.loss)
    # Views that move were tempered after their amplitudes were found.
    tempering = 1.0 if data.moving else estimate.tempering
    found = expected_maximum(data, estimate.families, best, rounds.capture.hyperprior, tempering)
    return estimate._replace(hyperparameters=found.h, log_ratio=found.log_ratio)


def motion_is_worth(rounds: Rounds, readout: Readout) -> bool:
    """Whether motion would explain views better that were fitted as standing still; to first order, near the fit."""
    capture = dataclasses.replace(rounds.capture, readout=readout)
    estimate = rounds.estimate
    moving = begin_motion(capture, estimate)
    data = capture.data(capture.problem(moving), moving)
    variance, families = estimate.variance / estimate.tempering, estimate.families
    best = maximize_evidence(
        data, families, estimate.hyperparameters, variance, capture.hyperprior, moving.log_ratio, rough=True
    )
    return bool(evidence_of_motion(data, best, families, 1.0) >= WORTH)


def columns_may_be_read(rounds: Rounds) -> bool:
    """Whether columns, read one after the other, may explain the motion of views better than rows.

    They do near this solution; or there is none, because motions came to their limit.
    """
    readout, estimate = rounds.capture.readout, rounds.estimate
    if readout is None or not readout.moves:
        return False
    found = motion_sigma(estimate.log_ratio, estimate.variance / estimate.tempering)
    if not rounds.converged or max(found.turn, found.shift) > _TOO_MUCH:
        return True
    losses = []
    still = estimate._replace(state=estimate.state._replace(motion=torch.zeros_like(estimate.state.motion)))
    for columns in (False, True):
        capture = dataclasses.replace(rounds.capture, readout=dataclasses.replace(readout, columns=columns))
        data = capture.data(capture.problem(estimate), still)
        best = maximize_evidence(
            data,
            estimate.families,
            estimate.hyperparameters,
            estimate.variance / estimate.tempering,
            capture.hyperprior,
            estimate.log_ratio,
            rough=True,
        )
        losses.append(best.loss)
    return losses[1] < losses[0]


def _moved_by(estimate: Estimate, best: Maximum) -> float:
    """By how much the hyperparameters moved."""
    change = float((best.h - estimate.hyperparameters).abs().max())
    if len(best.log_ratio):
        change = max(change, float(np.abs(best.log_ratio - estimate.log_ratio).max()))
    return change


def _overdispersion(data: ViewData, estimate: Estimate, capture: FittedViews) -> float:
    deviation = torch.where(capture.held(estimate), 0.0, estimate.families.deviation(estimate.hyperparameters))
    K = data.integrated(estimate.log_ratio).data.K
    return overdispersion(data.scores(estimate.log_ratio), K, deviation, estimate.variance)
