"""Calibrate one camera with a parametric lens model, for exchange with other programs, and assess its solution."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from kcal.calibrate.camera.advice import check_directions
from kcal.calibrate.camera.outliers import leave_out_outliers, noise_scale, without
from kcal.calibrate.camera.result import CalibrationOptions, CameraCalibrationResult, OutlierRejection, Progress
from kcal.calibrate.camera.solve import Solution, solve
from kcal.calibrate.camera.warnings import (
    NO_ERROR_BARS,
    general_warnings,
    outlier_warnings,
    prior_warnings,
    rival_warnings,
)
from kcal.calibrate.problem.covariance import Uncertainty, information_of, noise_variance, uncertainty_of
from kcal.calibrate.problem.parameters import GaussianPrior
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import LEAST_NOISE
from kcal.corners.observations import Observations
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.problem import RobustLoss, SolverStatus

# Assess a camera's solution: σ, covariance, residuals and warnings, as the result of its calibration.


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
            *outlier_warnings(observations.names, weighted, "; this lens may need a richer model"),
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


# Calibrate one camera with a parametric lens model, for exchange with other programs.

# To tell which corners are wrong: a loss that a few of them cannot spoil, its scale in units of the noise.
_ROUGH = LMOptions(max_iterations=40, tolerance=1e-8)
_CAUCHY_SCALE, _CAUCHY_ROUNDS = 3.0, 4


def calibrate_parametric(
    observations: Observations, options: CalibrationOptions, progress: Progress
) -> CameraCalibrationResult:
    """As `kcal.calibrate.camera.calibrate.calibrate_camera`, for a parametric model."""
    if options.reject is not None:
        return _without_outliers(observations, options, options.reject, progress)
    return assess(observations, solve(observations, options, progress), options)


def _without_outliers(
    observations: Observations, options: CalibrationOptions, rejection: OutlierRejection, progress: Progress
) -> CameraCalibrationResult:
    """Leave out corners and views that noise cannot explain."""
    first = solve(observations, options, progress)
    robust, spent = _robust_residuals(observations, first)
    spent += first.spent

    def fit(left: list[int], rejected: Tensor) -> tuple[Solution, Tensor]:
        nonlocal spent
        if len(left) == len(robust) and not bool(rejected.any()):
            return first, robust
        solution = solve(without(observations, left, rejected), options, progress)
        residuals, steps = _robust_residuals(without(observations, left, torch.zeros_like(rejected)), solution)
        spent += solution.spent + steps
        return solution, residuals

    kept = leave_out_outliers(observations, rejection, robust, fit, progress)
    used = without(observations, kept.views, kept.rejected)
    every = without(observations, kept.views, torch.zeros_like(kept.rejected))
    problem, state = kept.fit.problem_for(every.pixels(), every.covariances()), kept.fit.result.state
    plain, weighted = (problem.corner_residuals(state, weighted=own) for own in (False, True))
    result = assess(used, dataclasses.replace(kept.fit, spent=spent), options)
    return kept.complete(result, observations, plain, weighted)


def _robust_residuals(observations: Observations, solution: Solution) -> tuple[Tensor, int]:
    """Weighted residuals (V, N, 2) of all corners at a solution robust to a few wrong ones, and its trial steps.

    Infinite where the lens does not reach a corner at all.
    """
    state, spent = solution.result.state, 0
    whole = solution.problem_for(observations.pixels(), observations.covariances())
    for _ in range(_CAUCHY_ROUNDS):
        residuals = whole.corner_residuals(state, weighted=True)
        reached = torch.isfinite(residuals).all(-1)
        some = without(observations, range(len(observations.views)), whole.seen & ~reached)
        scale = max(_CAUCHY_SCALE * float(noise_scale(residuals.flatten(0, 1))), LEAST_NOISE)
        loss = RobustLoss(kind="cauchy", scale=scale)
        result = minimize(solution.problem_for(some.pixels(), some.covariances(), loss), state, _ROUGH)
        spent += int(result.iterations)
        if result.status == SolverStatus.BAD_START:
            break
        state = result.state
    residuals = whole.corner_residuals(state, weighted=True)
    unreached = whole.seen & ~torch.isfinite(residuals).all(-1)
    return torch.where(unreached[..., None], torch.inf, residuals), spent
