"""What corners and priors say of a camera and of its board, for every lens alike."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.priors import GaussianPrior
from kcal.calibrate.problem.state import BoardState
from kcal.gaussian import triangular
from kcal.lens.information import CameraInformation


def information_of(
    problem: BoardProblem, state: BoardState, noise: float, reduced: Tensor | None = None
) -> CameraInformation:
    """Square roots of information about all unknowns that are not held, poses and motions eliminated.

    Args:
        problem: with the Gaussian priors that count; barriers are no information.
        state: its minimum.
        noise: px, of a corner of weight one.
        reduced: `BoardProblem.reduced_rows`, if these are known already.
    """
    reduced = problem.reduced_rows(state) if reduced is None else reduced
    moving = problem.moving
    rows = reduced[:, [*moving.tolist(), -1]] / noise
    triangle = triangular(rows)[:-1]
    precision = rows.new_zeros(len(moving))
    mean = torch.zeros_like(precision)
    for term in problem.terms:
        if isinstance(term, GaussianPrior):
            place, weight = problem.slots[term.index], (term.weight / noise).square()
            free = place >= 0
            # Parameters that are equal may have a prior each: the product of both.
            precision.index_add_(0, place[free], weight[free])
            mean.index_add_(0, place[free], (weight * term.mean)[free])
    return CameraInformation(
        slots=tuple(problem.slots[: len(state.parameters)].tolist()),
        estimate=problem.unknowns(state)[moving],
        rows=triangle[:, :-1],
        residuals=triangle[:, -1],
        mean=torch.where(precision > 0, mean / precision, 0.0),
        sigma=precision.rsqrt(),
    )
