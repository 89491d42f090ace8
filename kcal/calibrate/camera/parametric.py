"""Calibrate one camera with a parametric lens model, for exchange with other programs."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from kcal.calibrate.camera.assess import assess
from kcal.calibrate.camera.options import CalibrationOptions, OutlierRejection, Progress
from kcal.calibrate.camera.outliers import leave_out_outliers, noise_scale, without
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.camera.solve import Solution, solve
from kcal.calibrate.problem.views import LEAST_NOISE
from kcal.corners.observations import Observations
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import SolverStatus
from kcal.solve.robust import RobustLoss

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
