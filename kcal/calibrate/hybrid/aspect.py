"""Decide whether pixels are square, from a fit with two focal lengths and what a board's stretch explains of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import STRETCH, BoardModes
from kcal.calibrate.hybrid.evidence_rounds import Rounds, expected_estimate
from kcal.calibrate.hybrid.families import BOARD, Hyperprior, PriorFamilies
from kcal.calibrate.hybrid.fitted_views import Estimate
from kcal.calibrate.hybrid.quadratic import posterior_root

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
