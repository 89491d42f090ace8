"""Calibrate one camera without a lens model to choose: the default of `calibrate_camera`.

The lens is a base projection between pinhole and fisheye, corrected by a smooth field and by an entrance pupil that
moves with the angle (`kcal.lens.hybrid_terms`); the board may be bent and misprinted
(`kcal.calibrate.hybrid.board_modes`). How large each of these may be is told by the evidence of the views themselves
(`kcal.calibrate.hybrid.evidence`), so a few views give a plain lens with wide error bars, and many views a detailed
one.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from kcal.calibrate.camera.advice import check_directions, roll_warnings, what_to_photograph
from kcal.calibrate.camera.checks import MINIMUM_VIEWS, check_views
from kcal.calibrate.camera.outliers import leave_out_outliers, noise_scale
from kcal.calibrate.camera.result import CalibrationOptions, CameraCalibrationResult, OutlierRejection, Progress
from kcal.calibrate.camera.warnings import (
    bending_warnings,
    check_end,
    general_warnings,
    hybrid_warnings,
    motion_warnings,
    outlier_warnings,
    pixel_warnings,
    pupil_warnings,
    spacing_warnings,
)
from kcal.calibrate.hybrid.fit import HybridFit, fit_hybrid
from kcal.calibrate.hybrid.settled import FitStart, rough_start
from kcal.corners.observations import Observations
from kcal.solve.problem import SolverStatus

# The unknowns that the views alone must determine: focal length, principal point, shape of the base projection.
_UNKNOWNS = 4


def calibrate_hybrid(
    observations: Observations, options: CalibrationOptions, progress: Progress
) -> CameraCalibrationResult:
    """As `kcal.calibrate.camera.calibrate.calibrate_camera`, for the hybrid lens."""
    board, pixels, names = observations.board.points, observations.pixels(), observations.names
    check_views(board, pixels, names, _UNKNOWNS, fewest=MINIMUM_VIEWS)
    if options.reject is not None:
        return _hybrid_without_outliers(observations, options, options.reject, progress)
    weights, start = torch.ones_like(pixels[..., 0]), None
    if options.weighted and observations.covariances() is not None:
        start = rough_start(
            board, pixels, observations.image_size, weights, options.board, options.motion, options.bending,
            options.start_focal(observations.image_size), progress, options.modes,
        )  # fmt: skip
        weights = corner_weights(observations, start.residuals)
    fit = fit_by_options(observations, pixels, weights, start, options, progress)
    return hybrid_result(observations, fit, options)


def fit_by_options(
    observations: Observations,
    pixels: Tensor,
    weights: Tensor | None,
    start: HybridFit | FitStart | None,
    options: CalibrationOptions,
    progress: Progress,
    robust: bool = False,
) -> HybridFit:
    """Fit a hybrid lens as the options say; arguments as of `kcal.calibrate.hybrid.fit.fit_hybrid`."""
    return fit_hybrid(
        observations.board.points, pixels, observations.image_size, weights, options.modes, board=options.board,
        motion=options.motion, bending=options.bending, focal=options.start_focal(observations.image_size), start=start,
        robust=robust, training=None if robust or options.modes is None else options.training, progress=progress,
    )  # fmt: skip


def corner_weights(observations: Observations, residuals: Tensor) -> Tensor:
    """(V, N) by the corners' covariances, and by what residuals have beyond these, which is the same for all.

    Normalized to a mean information of one; 0 where a corner was not seen.
    """
    covariances = observations.covariances()
    seen = torch.isfinite(observations.pixels()).all(-1)
    if covariances is None:
        return seen.double()
    own = 0.5 * covariances.diagonal(dim1=-2, dim2=-1).sum(-1)
    total = float(noise_scale(residuals.flatten(0, 1))) ** 2
    information = 1.0 / (own + max(total - float(own[seen].median()), 0.0))
    return torch.where(seen, information / information[seen].mean(), 0.0).sqrt()


def _hybrid_without_outliers(
    observations: Observations, options: CalibrationOptions, reject: OutlierRejection, progress: Progress
) -> CameraCalibrationResult:
    """Leave out corners and views that noise cannot explain."""
    pixels, names = observations.pixels(), observations.names
    own = torch.isfinite(pixels).all(-1).double()
    # A few wrong corners bend a plain fit towards them; bounded weights let them stand out.
    robust = fit_by_options(observations, pixels, own, None, options, progress, robust=True)
    if options.weighted:
        own = corner_weights(observations, robust.residuals)

    def fit(left: list[int], rejected: Tensor) -> tuple[HybridFit, Tensor]:
        some, weights = pixels[left], own[left]
        used = observations.subset([names[i] for i in left])
        found = fit_by_options(used, some, torch.where(rejected, 0.0, weights), None, options, progress)
        return found, found.residuals_of(some) * weights[..., None]

    kept = leave_out_outliers(observations, reject, robust.residuals_of(pixels) * own[..., None], fit, progress)
    plain, weights = kept.fit.residuals_of(pixels[kept.views]), own[kept.views][..., None]
    used = observations.subset([names[i] for i in kept.views])
    return kept.complete(hybrid_result(used, kept.fit, options), observations, plain, plain * weights)


def hybrid_result(observations: Observations, fit: HybridFit, options: CalibrationOptions) -> CameraCalibrationResult:
    """The result of a fit, with its warnings.

    Raises:
        DegenerateError: the views hardly determine where the camera sees what they show.
        InputError: the fit did not reach its solution.
    """
    check_end(fit)
    camera, covariance, names = fit.camera, fit.covariance, observations.names
    per_view = fit.residuals.square().sum(-1).nanmean(-1).sqrt()
    spread = covariance.diagonal().sqrt()
    sigma: dict[str, float | None] = {
        name: float(value) for name, value in zip(camera.names, spread, strict=True) if name != "skew"
    }
    check_directions(
        camera.params,
        camera.model,
        fit.board_points @ fit.state.rotation.transpose(-1, -2) + fit.state.translation[:, None],
        fit.residuals.isfinite().all(-1),
        # What views leave open is a matter of where boards were, not of how well motions are known.
        covariance / fit.wider,
        fit.state.rotation,
        names,
    )
    status = SolverStatus.CONVERGED if fit.converged else SolverStatus.ITERATION_LIMIT
    used = [i for i, rms in enumerate(per_view.tolist()) if not math.isnan(rms)]
    stated = observations.covariances()
    result = CameraCalibrationResult(
        camera=camera,
        observations=observations,
        rms=fit.rms,
        weighted_rms=fit.weighted_rms if options.weighted and stated is not None else None,
        per_view_rms=per_view,
        residuals=fit.residuals,
        cam_from_board_rotation=fit.state.rotation,
        cam_from_board_translation=fit.state.translation,
        board_warp=None,
        sigma=sigma,
        covariance=covariance,
        information=fit.information,
        status=status,
        iterations=fit.iterations,
        hybrid=fit,
        advice=what_to_photograph(observations, camera, fit.state.rotation),
        warnings=(
            *general_warnings([names[i] for i in used], camera, fit.rms, per_view[used], (), status, stated),
            *hybrid_warnings(fit),
            *motion_warnings(fit),
            *bending_warnings(names, fit),
            *pixel_warnings(fit),
            *pupil_warnings(camera, covariance),
            *(roll_warnings(fit.state.rotation) if options.board == "printed" else ()),
            *outlier_warnings(names, fit.residuals),
        ),
    )
    unequal = spacing_warnings(result) if options.board == "printed" else ()
    # It explains what else may be said.
    return dataclasses.replace(result, warnings=(*unequal, *result.warnings)) if unequal else result
