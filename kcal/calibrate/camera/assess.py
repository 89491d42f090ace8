"""Assess a camera's solution: σ, covariance, residuals and warnings, as the result of its calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch

from kcal.calibrate.camera.determined import check_directions
from kcal.calibrate.camera.options import CalibrationOptions
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.camera.solve import Solution
from kcal.calibrate.camera.warnings import (
    NO_ERROR_BARS,
    general_warnings,
    outlier_warnings,
    prior_warnings,
    rival_warnings,
)
from kcal.calibrate.problem.covariance import Uncertainty, noise_variance, uncertainty_of
from kcal.calibrate.problem.information import information_of
from kcal.calibrate.problem.priors import GaussianPrior
from kcal.calibrate.problem.state import BoardState
from kcal.corners.observations import Observations
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.solve.result import SolverStatus
from kcal.solve.robust import RobustLoss


def assess(observations: Observations, solution: Solution, options: CalibrationOptions) -> CameraCalibrationResult:
    """The result of a calibration, from its solution.

    Raises:
        DegenerateError: the views hardly determine where the camera sees what they show.
    """
    problem, solved = solution.problem, solution.result
    state = problem.tidy(solved.state)
    # A lens may fold exactly at a corner, where rounding decides whether it has an image.
    if not bool(torch.isfinite(problem.cost(state))):
        state = solved.state
    camera = Camera(state.parameters, size=observations.image_size, model=problem.model)
    squared, count = problem.pixel_errors(state).square().sum(-2), problem.seen.sum(-1)
    per_view, rms = torch.sqrt(squared.sum(-1) / count), float(torch.sqrt(squared.sum() / count.sum()))

    uncertainty, information = _uncertainty(observations, solution, state, options.loss)
    free = problem.free
    slot = {camera.names[i]: k for i, k in zip(free.indices, free.slots, strict=True)}
    spread = free.by_parameter(uncertainty.covariance, len(camera.names))
    sigma = {name: float(uncertainty.sigma[k]) if bool(uncertainty.determined[k]) else None for name, k in slot.items()}
    fixed = tuple(name for name in camera.names if name in solution.views.constraints.fixed)
    sigma = {name: sigma.get(name) for name in camera.names if name in slot or name in fixed}
    status = SolverStatus(int(solved.status))
    doubts = []
    if uncertainty.computed:
        open_focal = any(not bool(uncertainty.determined[slot[name]]) for name in ("fx", "fy") if name in slot)
        check_directions(
            state.parameters,
            problem.model,
            problem.points(state),
            problem.seen,
            torch.full_like(spread, torch.inf) if open_focal else spread,
            state.rotation,
            observations.names,
        )
        labels = free.labels(camera.names)
        lost = [name for name, known in zip(labels, uncertainty.determined.tolist(), strict=False) if not known]
    else:
        # Unknown is not the same as undetermined by the views.
        doubts, lost = [NO_ERROR_BARS], []
    weighted = problem.corner_residuals(solved.state, weighted=True)
    return CameraCalibrationResult(
        camera=camera,
        observations=observations,
        rms=rms,
        weighted_rms=None
        if problem.weights is None and problem.loss is None
        else float(torch.sqrt(2.0 * solved.cost / count.sum())),
        per_view_rms=per_view,
        residuals=problem.corner_residuals(state),
        cam_from_board_rotation=state.rotation,
        cam_from_board_translation=state.translation,
        board_warp=state.board if problem.free_board else None,
        sigma=sigma,
        fixed=fixed,
        led_by_prior=_led_by_prior(solution, camera.names, slot, uncertainty),
        status=status,
        iterations=solution.spent,
        covariance=spread,
        information=information,
        warnings=(
            *general_warnings(observations.names, camera, rms, per_view, lost, status),
            *doubts,
            *rival_warnings(camera, sigma, solution.rivals, solution.plain_cost, problem.residual_count),
            *prior_warnings(solution.terms, solved.state, solution.views.prior_noise),
            *outlier_warnings(observations.names, weighted),
        ),
    )


def _uncertainty(
    observations: Observations, solution: Solution, state: BoardState, loss: RobustLoss | None
) -> tuple[Uncertainty, CameraInformation | None]:
    """Covariance of the unknowns, and what is said of the camera; None where that is not finite."""
    if not solution.problem.shared_size:
        # Under a known camera and a flat board nothing is shared by the views.
        return Uncertainty(state.parameters.new_zeros(0, 0), torch.zeros(0, dtype=torch.bool)), None
    # Barriers before folds are no information about the lens.
    known = [term for term in solution.terms if isinstance(term, GaussianPrior)]
    plain = solution.problem_for(observations.pixels(), observations.covariances(), loss, known)
    linear = plain.linearize(state)
    count, residuals = plain.shared_size + 6 * len(state.translation), plain.residual_count + plain.prior_count
    found = uncertainty_of(linear, residuals, count)
    variance = float(noise_variance(linear, residuals, count))
    if not found.computed or not variance > 0:
        return found, None
    if not len(plain.free):
        return found, None
    return found, information_of(plain, state, math.sqrt(variance)).without_board()


def _led_by_prior(
    solution: Solution, names: Sequence[str], slot: Mapping[str, int], uncertainty: Uncertainty
) -> tuple[str, ...]:
    """Parameters whose variance would more than double without their prior."""
    led = []
    for term in solution.terms:
        if isinstance(term, GaussianPrior):
            spread = solution.views.prior_noise / term.weight
            for index, sigma in zip(term.index.tolist(), spread.tolist(), strict=True):
                if float(uncertainty.sigma[slot[names[index]]]) ** 2 > 0.5 * sigma**2:
                    led.append(names[index])
    return tuple(led)
