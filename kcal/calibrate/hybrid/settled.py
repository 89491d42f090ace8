"""Find where a fit of one camera settles: base projection, then rounds of solver and evidence, and pixels' aspect."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.hybrid.base_fit import fit_base
from kcal.calibrate.hybrid.board_modes import STRETCH, BoardModes, board_modes
from kcal.calibrate.hybrid.evidence import WORTH, posterior_root
from kcal.calibrate.hybrid.evidence_rounds import (
    Rounds,
    columns_may_be_read,
    expected_estimate,
    motion_is_worth,
    run_rounds,
)
from kcal.calibrate.hybrid.families import BOARD, Hyperprior, PriorFamilies, typical_hyperprior
from kcal.calibrate.hybrid.fitted_views import Estimate, FittedViews
from kcal.calibrate.hybrid.fleet import LensPrior
from kcal.calibrate.hybrid.measured_board import BoardPrior, MeasuredBoard
from kcal.calibrate.problem.state import Readout
from kcal.errors import InputError
from kcal.lens.field_modes import FieldModes
from kcal.lens.zernike import ZernikeModes

# Decide whether pixels are square, from a fit with two focal lengths and what a board's stretch explains of them.

# Stretch that a print may have whatever this board's amplitude is, in units of its extent to each side: one tenth of a
# percent, or two of its length. Boards that are upright in all views do not tell it from the aspect of pixels.
_PRINTED = 1e-3
# Standard deviations beyond which pixels are not square: seven nats.
_CLEAR = 3.75
# Share by which two focal lengths may differ for their lens to be a start for one with square pixels.
_NEARLY = 0.03


def aspect_score(rounds: Rounds, hyperprior: Hyperprior, never: Tensor) -> float:
    """Standard deviations by which the aspect ratio that a fit with two focal lengths found is off one.

    Args:
        rounds: of the fit.
        hyperprior: of its amplitudes.
        never: (S,) unknowns that were held.
    """
    score = _standing(rounds, never)
    if pixels_are_square(score):
        return score
    # Amplitudes as they are to be expected: those of largest evidence may state the ratio too surely.
    return _standing(rounds._replace(estimate=expected_estimate(rounds, hyperprior)), never)


def _standing(rounds: Rounds, never: Tensor) -> float:
    """The same at the amplitudes of the rounds, the board's stretch being hardly known."""
    estimate, data = rounds.estimate, rounds.data
    families, h = estimate.families, estimate.hyperparameters.clone()
    h[BOARD + STRETCH] = h[BOARD + STRETCH].clamp_min(math.log(_PRINTED))
    deviation = torch.where(never, 0.0, families.deviation(h))
    still = data.integrated(estimate.log_ratio).data
    half = posterior_root(still.K, deviation, estimate.variance) * deviation
    x = half.T @ (half @ (still.g + still.K @ still.at)) / estimate.variance + families.mean
    columns, rows = 0, len(x) - len(rounds.capture.board.unit) - 1
    aspect = float(x[rows] / x[columns])
    slope = torch.zeros_like(x)
    slope[rows], slope[columns] = 1.0 / x[columns], -aspect / x[columns]
    return (aspect - 1.0) / float((half @ slope).norm())


def pixels_are_square(score: float) -> bool:
    """Whether an aspect ratio that is so many standard deviations off cannot be told from one."""
    return not abs(score) > _CLEAR


def with_square_pixels(estimate: Estimate, board: BoardModes) -> Estimate | None:
    """An estimate with two focal lengths as one with a single one; None where they differ by more than a little."""
    params = estimate.state.parameters.clone()
    if not abs(float(params[1] / params[0]) - 1.0) < _NEARLY:
        return None
    params[:2] = params[:2].mean()
    rows = len(estimate.families.mean) - len(board.unit) - 1
    families = PriorFamilies(*(torch.cat([part[:rows], part[rows + 1 :]]) for part in estimate.families))
    return estimate._replace(families=families, state=estimate.state._replace(parameters=params))


# Find where a fit of one camera settles: base projection, then rounds of solver and evidence, and what these decide.
#
# Decided are whether pixels are square, whether views moved while they were read, and whether rows or columns were
# read.


class FitStart(NamedTuple):
    """With what a fit of the same views under other weights begins.

    Attributes:
        estimate: camera, board, poses, motions and amplitudes.
        readout: how views move while they are read; None: they stand still.
        square: whether pixels are square.
        residuals: (V, N, 2) projected minus observed, pixels, weights left out; NaN where a corner did not count.
        iterations: trial steps of the solver.
    """

    estimate: Estimate
    readout: Readout | None
    square: bool
    residuals: Tensor
    iterations: int


class Settled(NamedTuple):
    """Where a fit settled.

    Attributes:
        rounds: the last ones.
        never: (S,) unknowns that were held.
        hyperprior: of the amplitudes.
        board: how it differs from the one that was ordered.
    """

    rounds: Rounds
    never: Tensor
    hyperprior: Hyperprior
    board: Literal["printed", "exact"] | BoardPrior


def settle(
    points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    weights: Tensor,
    *,
    modes: FieldModes | None = None,
    board: Literal["printed", "exact"] | BoardPrior | MeasuredBoard,
    square: bool | None = None,
    motion: bool,
    bending: bool = True,
    focal: float | None,
    start: FitStart | None = None,
    robust: bool = False,
    hyperprior: Hyperprior | None = None,
    lens: LensPrior | None = None,
    progress: Callable[[str], object],
    rough: bool = False,
) -> Settled:
    """Settle amplitudes, camera, board, poses and motions, with arguments as of `kcal.calibrate.hybrid.fit.fit_hybrid`.

    If `rough`, another fit will begin where this one ends, so that it need not come to rest entirely.
    """
    if start is not None:
        form = start.estimate.model.hybrid
        assert form is not None
        modes = form.modes
    elif lens is not None:
        modes = lens.form.modes
    modes = modes or ZernikeModes()
    hyperprior = hyperprior or typical_hyperprior(modes)
    if isinstance(board, MeasuredBoard):
        board = board.prior_for(points)
    ordered, shown = points, board_modes(points)
    if isinstance(board, BoardPrior):
        points, shown = board.applied(points, shown)
    capture = FittedViews(
        points=points,
        board=shown,
        pixels=pixels,
        size=size,
        weights=weights,
        readout=_readout(ordered, size) if start is None and motion else start.readout if start else None,
        square=start.square if start is not None else lens.square if lens is not None else square is True,
        robust=robust,
        exact=board == "exact",
        heights=board_modes(ordered).heights if bending and start is None and board != "exact" else None,
    )

    def run(
        capture: FittedViews, estimate: Estimate, spent: int, *, cold: bool = False, rough: bool = rough
    ) -> tuple[Rounds, Tensor]:
        held = torch.zeros_like(estimate.families.mean, dtype=torch.bool)
        if capture.exact:
            held[-len(shown.unit) :] = True
        rounds = run_rounds(capture, estimate, hyperprior, held, cold=cold, spent=spent, rough=rough, progress=progress)
        return rounds, held

    def begin(capture: FittedViews, rough: bool = rough) -> tuple[Rounds, Tensor]:
        estimate, steps = fit_base(capture, modes, focal, hyperprior.mean, lens)
        progress("base projection")
        if capture.readout is not None:
            distance = float(estimate.state.translation.norm(dim=-1).median())
            readout = dataclasses.replace(capture.readout, distance=distance)
            capture = dataclasses.replace(capture, readout=readout)
        return run(capture, estimate, steps, cold=True, rough=rough)

    if start is not None:
        estimate = start.estimate
        state, h = estimate.state, estimate.hyperparameters
        if isinstance(board, BoardPrior):
            state, h = state._replace(board=board.in_units(state.board)), h.clone()
            # Nothing depends on them any more, so that they are no reason for another round.
            h[BOARD:] = hyperprior.mean[BOARD:]
        families = estimate.families.with_board(shown)
        estimate = estimate._replace(families=families, state=state, hyperparameters=h)
        rounds, never = run(capture, estimate, start.iterations)
    else:
        undecided = square is None and lens is None
        # Whether pixels are square is told well enough before amplitudes are entirely at rest.
        rounds, never = begin(capture, rough or undecided)
        if undecided:
            score = aspect_score(rounds, hyperprior, never)
            one = dataclasses.replace(rounds.capture, square=pixels_are_square(score))
            near = with_square_pixels(rounds.estimate, shown) if one.square else rounds.estimate
            readout, most = rounds.readout, rounds.gained + 0.5 * score**2
            if near is None:
                rounds, never = begin(dataclasses.replace(one, readout=readout))
            elif one.square or not rough:
                rounds, never = run(one, near, rounds.steps)
                # Motion along columns and the aspect of pixels look alike: with square pixels it may explain what the
                # aspect did, and that is no more than the nats that the aspect was worth.
                hidden = one.square and one.readout is None and not most < WORTH
                if hidden and readout is not None and motion_is_worth(rounds, readout, hyperprior, never):
                    rounds, never = run(dataclasses.replace(one, readout=readout), near, rounds.steps)
        if capture.readout is not None and columns_may_be_read(rounds, hyperprior, never):
            by_columns = dataclasses.replace(capture.readout, columns=True)
            other = begin(dataclasses.replace(capture, square=rounds.capture.square, readout=by_columns))
            if other[0].untempered_loss < rounds.untempered_loss:
                rounds, never = other
    return Settled(rounds, never, hyperprior, board)


def rough_start(
    points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    weights: Tensor,
    board: Literal["printed", "exact"] | BoardPrior | MeasuredBoard = "printed",
    motion: bool = True,
    bending: bool = True,
    focal: float | None = None,
    progress: Callable[[str], object] = lambda _: None,
    modes: FieldModes | None = None,
) -> FitStart:
    """With what a fit of these views under other weights begins: no error bars, and not entirely at rest.

    Raises:
        InputError: as `kcal.calibrate.hybrid.fit.fit_hybrid`.
        DegenerateError: likewise.
    """
    rounds, never, _, known = settle(
        points, pixels, size, weights, modes=modes, board=board, motion=motion, bending=bending, focal=focal,
        progress=progress, rough=True,
    )  # fmt: skip
    capture, estimate = rounds.capture, rounds.estimate
    errors = capture.problem(estimate, never).pixel_errors(estimate.state)
    check_shown(errors)
    if isinstance(known, BoardPrior):
        state = estimate.state
        estimate = estimate._replace(state=state._replace(board=known.in_amplitudes(state.board)))
    return FitStart(estimate, capture.readout, capture.square, capture.by_corner(errors), rounds.steps)


def check_shown(errors: Tensor) -> None:
    """Raise `InputError` where a corner has no image under the lens that was found: errors that are not finite."""
    if not bool(torch.isfinite(errors).all()):
        raise InputError(
            "the lens cannot show all corners where they are: are all views of this board and this camera? Rejection "
            "of outliers leaves wrong views out"
        )


def _readout(points: Tensor, size: tuple[int, int]) -> Readout:
    return Readout(center=points.mean(0), distance=1.0, size=size)
