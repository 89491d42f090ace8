"""What corners and priors say of a camera and its board, and which parameters the data do not determine."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.parameters import GaussianPrior
from kcal.calibrate.problem.state import BoardState
from kcal.gaussian import triangular
from kcal.lens.information import CameraInformation
from kcal.solve.schur import SchurLinearization

# Covariances of a solution, and which parameters the data do not determine.

# Eigenvalues of the scaled information below this share of the largest are rounding errors.
_RANK_TOLERANCE = 1e-13
# A parameter with this squared component in an undetermined direction counts as undetermined.
_UNDETERMINED_SHARE = 1e-2


class Uncertainty(NamedTuple):
    """Covariance of the shared parameters (S, S), and whether the data determine each (S,).

    Where the linearization is not finite, because a corner lies on a fold of the lens, the covariance is NaN and no
    parameter counts as determined.
    """

    covariance: Tensor
    determined: Tensor

    @property
    def computed(self) -> bool:
        """Whether the covariance is finite."""
        return bool(torch.isfinite(self.covariance).all())

    @property
    def sigma(self) -> Tensor:
        """(S,) standard deviations, infinite where not determined."""
        return torch.where(self.determined, self.covariance.diagonal().sqrt(), torch.inf)


def uncertainty_of(linear: SchurLinearization, residual_count: int, parameter_count: int) -> Uncertainty:
    """Covariance of the shared parameters from the information at a minimum, all other parameters free.

    (JᵀJ)⁻¹ ‖r‖² / (residuals - parameters), whose diagonal is the square of what `cv2.calibrateCameraExtended` reports:
    the noise is estimated from the residuals themselves and assumed independent and equal.

    Args:
        linear: the linearization at the minimum, not a batch.
        residual_count: scalar residuals.
        parameter_count: all parameters that were free, poses included.
    """
    inverse, scale, determined = _invert(linear)
    noise = noise_variance(linear, residual_count, parameter_count)
    return Uncertainty(inverse * scale[:, None] * scale * noise, determined)


def _invert(linear: SchurLinearization) -> tuple[Tensor, Tensor, Tensor]:
    """The inverse of the scaled information (S, S), the scale of each parameter, and whether each is determined."""
    information, scale = linear.information()
    if not bool(torch.isfinite(information).all() & torch.isfinite(linear.cost)):
        return torch.full_like(information, torch.nan), scale, torch.zeros_like(scale, dtype=torch.bool)
    eigenvalues, vectors = torch.linalg.eigh(information)
    floor = _RANK_TOLERANCE * eigenvalues[-1]
    undetermined = (vectors[:, eigenvalues <= floor] ** 2).sum(-1)
    # Below the floor an eigenvalue is unknown; the floor gives the smallest possible variance.
    inverse = (vectors / eigenvalues.clamp_min(floor)) @ vectors.T
    return inverse, scale, undetermined < _UNDETERMINED_SHARE


def noise_variance(linear: SchurLinearization, residual_count: int, parameter_count: int) -> Tensor:
    """Variance of a residual, estimated from the cost."""
    return 2.0 * linear.cost / max(residual_count - parameter_count, 1)


# What corners and priors say of a camera and of its board, for every lens alike.


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
