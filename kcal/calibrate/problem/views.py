"""Views of a board by one camera: weights, problems, regular region, and what they say of camera and board."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Self

import torch
from torch import Tensor

from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.parameters import FreeParameters, GaussianPrior, ParameterConstraints, Term
from kcal.calibrate.problem.state import BoardState
from kcal.gaussian import Covariance, triangular
from kcal.lens.information import CameraInformation
from kcal.lens.model import LensModel
from kcal.lens.projection import parameter_names, project_components
from kcal.solve.problem import RobustLoss
from kcal.solve.schur import SchurLinearization

# Weights of residuals, from the covariances of corners.


def whitening(covariances: Tensor, variance: float) -> Tensor:
    """Matrices that make residuals of unequal corners equally uncertain.

    Residuals of a calibration contain more than the noise of the corners: boards are not flat and lenses differ from
    their models. So the same variance is added to every corner, as much as the residuals have beyond what the
    covariances predict; where the corners' noise is the smaller error, all count nearly alike. The scale is chosen for
    a mean information of one, so that weighted residuals remain pixels.

    Args:
        covariances: (..., N, 2, 2) px²; NaN where a corner was not seen.
        variance: of the residuals along an axis when all corners count alike, px².

    Returns:
        W (..., N, 2, 2) with Wᵀ W = s² (C + f² 1)⁻¹; NaN where not seen.

    Example:
        >>> corners = torch.eye(2, dtype=torch.float64) * torch.tensor([0.01, 0.04]).double()[:, None, None] ** 2
        >>> weights = whitening(corners, 0.00085)  # the mean variance: nothing beyond the corners' own
        >>> round(float(weights[0, 0, 0] / weights[1, 0, 0]), 4)
        4.0
    """
    seen = torch.isfinite(covariances).all(-1).all(-1)
    identity = torch.eye(2, dtype=covariances.dtype, device=covariances.device)
    filled = torch.where(seen[..., None, None], covariances, identity)
    own = float(covariances[seen].diagonal(dim1=-2, dim2=-1).mean())
    factor = torch.linalg.cholesky(filled + max(variance - own, 0.0) * identity)
    inverse = torch.linalg.solve_triangular(factor, identity.expand_as(factor), upper=False)
    information = inverse[seen].square().sum((-2, -1)).mean() / 2.0
    return torch.where(seen[..., None, None], inverse / information.sqrt(), torch.nan)


# Views of a board by one camera: their least-squares problems, and where the lens must be regular.

# Noise of a corner (pixels) that is assumed at least, where data are exact.
LEAST_NOISE = 1e-3
# A lens must be regular this far beyond the outermost point; the image's corners move a little with the lens.
_MARGIN = 1.05
# Points per side of the image's border.
_SIDE = 8
# Stretches in which the image's border is unprojected: Newton's method from afar may leave a strongly distorting lens.
_SHARES = (0.5, 0.8, 1.0)


def among(values: Tensor, views: Sequence[int], count: int) -> Tensor:
    """(count, ...) values of some views put among all of them: NaN for the others.

    Example:
        >>> among(torch.tensor([2.0]), [1], 3).tolist()
        [nan, 2.0, nan]
    """
    out = values.new_full((count, *values.shape[1:]), torch.nan)
    out[list(views)] = values
    return out


@dataclasses.dataclass(frozen=True, kw_only=True)
class Views:
    """Views of a board by one camera.

    Args:
        board_points: (N, 3) meters.
        pixels: (..., V, N, 2), NaN where not seen.
        whitening: (..., V, N, 2, 2) weights of the corners, or None: all count alike.
        loss: a robust loss, or None.
        free_warp: whether the board's warp is estimated.
    """

    board_points: Tensor
    pixels: Tensor
    whitening: Tensor | None = None
    loss: RobustLoss | None = None
    free_warp: bool = False

    def problem(
        self,
        model: LensModel,
        free: Sequence[int] | FreeParameters = (),
        *,
        terms: Sequence[Term] = (),
        batch: tuple[int, ...] = (),
    ) -> BoardProblem:
        """The least-squares problem of these views; without free parameters, of the poses (and the warp) alone."""
        return BoardProblem(
            self.board_points,
            self.pixels,
            model,
            free,
            free_board=self.free_warp,
            weights=self.whitening,
            loss=self.loss,
            terms=terms,
            batch=batch,
        )

    def some(self, chosen: Sequence[int] | Tensor) -> Self:
        """Some of the views, in that order."""
        weights = None if self.whitening is None else self.whitening[chosen]
        return dataclasses.replace(self, pixels=self.pixels[chosen], whitening=weights)

    def noise(self, state: BoardState, model: LensModel) -> float:
        """Standard deviation (pixels) of the residuals along an axis."""
        problem = self.problem(model)
        return math.sqrt(2.0 * float(problem.cost(state)) / problem.residual_count)

    def observed_radius(self, state: BoardState) -> float:
        """Largest undistorted radius at which a corner was seen."""
        points = self.board_points @ state.rotation.transpose(-1, -2) + state.translation[..., None, :]
        radius = torch.linalg.vector_norm(points[..., :2] / points[..., 2:], dim=-1)
        return float(torch.where(torch.isfinite(self.pixels).all(-1), radius, 0.0).max())


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraViews(Views):
    """Views with what is known about the camera, for the fit of its lens.

    Args:
        size: (width, height) of the image.
        constraints: what is known about the camera's parameters.
        prior_noise: pixels of a corner's noise, in proportion to which priors count.
    """

    size: tuple[int, int]
    constraints: ParameterConstraints = dataclasses.field(default_factory=ParameterConstraints)
    prior_noise: float = 0.3

    def lens_problem(self, model: LensModel, terms: Sequence[Term] = ()) -> BoardProblem:
        """The least-squares problem of a lens model under the constraints, with their priors."""
        terms = (*terms, *self.prior_terms(model))
        return self.problem(model, self.constraints.free_parameters(model), terms=terms)

    def prior_terms(self, model: LensModel) -> tuple[Term, ...]:
        """The priors of the constraints."""
        return self.constraints.terms(model, self.prior_noise)

    def with_noise_of(self, state: BoardState, model: LensModel) -> CameraViews:
        """The same with priors in proportion to the noise of a solution."""
        return dataclasses.replace(self, prior_noise=max(self.noise(state, model), LEAST_NOISE))

    def seen_radius(self, state: BoardState) -> float:
        """Radius on the plane z = 1 around all corners that were seen, with a margin."""
        return _MARGIN * self.observed_radius(state)

    def regular_radius(self, state: BoardState, model: LensModel) -> float:
        """Likewise around the whole image, if the lens reaches it."""
        border = _border(state.parameters, model, self.size)
        seen = self.seen_radius(state)
        return seen if border is None else max(seen, _MARGIN * float(torch.hypot(*border).max()))


def _border(parameters: Tensor, model: LensModel, size: tuple[int, int]) -> Tensor | None:
    """Points (2, K) on the plane z = 1 that the image's border shows; None where the lens does not reach all of it."""
    t = torch.linspace(0.0, 1.0, _SIDE + 1, dtype=torch.float64)[:-1]
    zero, one = torch.zeros_like(t), torch.ones_like(t)
    u, v = torch.cat([t, one, 1.0 - t, zero]), torch.cat([zero, t, one, 1.0 - t])
    border = torch.stack([u * (size[0] - 1.0), v * (size[1] - 1.0)])
    center = torch.stack([parameters[2], parameters[3]])[:, None]
    x, y = _SHARES[0] * (border - center) / torch.stack([parameters[0], parameters[1]])[:, None]
    for share in _SHARES:
        wanted = center + share * (border - center)
        for _ in range(12):
            seen = project_components(torch.stack([x, y, torch.ones_like(x)]), parameters, model, ())
            error = wanted - seen.pixels
            if not bool(seen.regular.all()):
                return None
            if float(error.abs().max()) < 1e-3:
                break
            ux, vx, uy, vy = seen.by_point[:2].flatten(0, 1)
            scale = 1.0 / (ux * vy - uy * vx)
            x, y = x + (vy * error[0] - uy * error[1]) * scale, y + (ux * error[1] - vx * error[0]) * scale
        else:
            return None
    return torch.stack([x, y])


def free_parameters(model: LensModel) -> list[int]:
    """Indices of all parameters but the skew."""
    return [i for i, name in enumerate(parameter_names(model)) if name != "skew"]


# Covariances of a solution, and which parameters the data do not determine.

# Eigenvalues of the scaled information below this share of the largest are rounding errors.
_RANK_TOLERANCE = 1e-13
# A parameter with this squared component in an undetermined direction counts as undetermined.
_UNDETERMINED_SHARE = 1e-2


def uncertainty_of(linear: SchurLinearization, residual_count: int, parameter_count: int) -> Covariance:
    """Covariance of the shared parameters from the information at a minimum, all other parameters free.

    (JᵀJ)⁻¹ ‖r‖² / (residuals - parameters), whose diagonal is the square of what `cv2.calibrateCameraExtended` reports:
    the noise is estimated from the residuals themselves and assumed independent and equal. Where the linearization is
    not finite, because a corner lies on a fold of the lens, nothing is determined.

    Args:
        linear: the linearization at the minimum, not a batch.
        residual_count: scalar residuals.
        parameter_count: all parameters that were free, poses included.
    """
    noise = float(noise_variance(linear, residual_count, parameter_count))
    return Covariance(*linear.information(), noise, tolerance=_RANK_TOLERANCE, lost=_UNDETERMINED_SHARE)


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
