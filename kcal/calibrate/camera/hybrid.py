"""Calibrate one camera without a lens model to choose: the default of `calibrate_camera`.

The lens is a base projection between pinhole and fisheye, corrected by a smooth field and by an entrance pupil that
moves with the angle (`kcal.lens.model`); the board may be bent and misprinted
(`kcal.calibrate.hybrid.board_modes`). How large each of these may be is told by the evidence of the views themselves
(`kcal.calibrate.hybrid.evidence`), so a few views give a plain lens with wide error bars, and many views a detailed
one.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from kcal.calibrate.camera.advice import check_directions, roll_findings, what_to_photograph
from kcal.calibrate.camera.checks import (
    MINIMUM_VIEWS,
    check_views,
    corners_beyond,
    least_planar,
    leave_out_outliers,
    noise_scale,
    stray_corners,
    views_beyond,
)
from kcal.calibrate.camera.result import (
    CalibrationOptions,
    CameraCalibrationResult,
    OutlierRejection,
    Progress,
    Rejected,
)
from kcal.calibrate.camera.warnings import (
    bending_findings,
    check_end,
    general_findings,
    hybrid_findings,
    motion_findings,
    moves_beyond_hands,
    outlier_findings,
    pixel_findings,
    pupil_findings,
    spacing_findings,
)
from kcal.calibrate.hybrid.fit import AlikeError, FitOptions, FitStart, HybridFit, fit_hybrid
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError, InputError
from kcal.finding import Finding
from kcal.solve.lm import SolverStatus

# The unknowns that the views alone must determine: focal length, principal point, shape of the base projection.
_UNKNOWNS = 4


def calibrate_hybrid(
    observations: Observations,
    options: CalibrationOptions,
    progress: Progress,
    start: HybridFit | FitStart | None = None,
) -> CameraCalibrationResult:
    """As `kcal.calibrate.camera.calibrate.calibrate_camera`, for the hybrid lens; from an earlier fit on if given."""
    board, pixels, names = observations.board.points, observations.pixels(), observations.names
    check_views(board, pixels, names, _UNKNOWNS, fewest=MINIMUM_VIEWS)
    if options.reject is not None:
        return _hybrid_without_outliers(observations, options, options.reject, progress)
    weights = weigh = None
    if options.weighted and observations.covariances() is not None:
        if start is None:
            weigh = functools.partial(corner_weights, observations)
        else:
            weights = corner_weights(observations, start.residuals)
    fit = fit_by_options(observations, pixels, weights, start, options, progress, weigh)
    return hybrid_result(observations, fit, options)


def fit_by_options(
    observations: Observations,
    pixels: Tensor,
    weights: Tensor | None,
    start: HybridFit | FitStart | None,
    options: CalibrationOptions,
    progress: Progress,
    weigh: Callable[[Tensor], Tensor] | None = None,
    **how: Any,
) -> HybridFit:
    """Fit a hybrid lens as the options say, and as fields of `FitOptions` do; arguments as of `fit_hybrid`."""
    size = observations.image_size
    own = dataclasses.replace(options.of_fit(size), **how)
    points = observations.board.points
    return fit_hybrid(points, pixels, size, weights, own, start=start, progress=progress, weigh=weigh)


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
    robust = fit_by_options(observations, pixels, own, None, options, progress, robust=True, training=None)
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
    """The result of a fit, with what to doubt of it.

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
        without=tuple(name for name in ("motion", "bending") if not getattr(options, name)),
        advice=what_to_photograph(observations, camera, fit.state.rotation),
        findings=(
            *general_findings([names[i] for i in used], camera, fit.rms, per_view[used], (), status, stated),
            *hybrid_findings(fit),
            *motion_findings(fit),
            *bending_findings(names, fit),
            *pixel_findings(fit),
            *pupil_findings(camera, covariance),
            *(roll_findings(fit.state.rotation) if options.board == "printed" else ()),
            *outlier_findings(names, fit.residuals, stray_corners(fit.residuals)),
        ),
    )
    unequal = spacing_findings(result) if options.board == "printed" else ()
    # It explains what else may be said.
    return dataclasses.replace(result, findings=(*unequal, *result.findings)) if unequal else result


# Calibrate without views that no lens fits, before refusing all of them; and name them.
#
# One image of another board, of another camera, or with corners in a wrong order can leave no lens that shows all
# corners. A fit with bounded weights tells which views these are. A few are left out, with a warning; if they are many,
# nobody knows which ones are wrong.

# Views that contradict each other wholly leave a fit without a number to go on with.
_FAILED = (InputError, ArithmeticError, torch.linalg.LinAlgError)
# Largest share of the views that is left out without being asked.
_FEW = 0.2
# Views that must be left: fewer fit one another whatever is wrong with one of them, and another one is blamed for it.
_ENOUGH = 5
# How many times larger or smaller a focal length is that was given wrongly.
_FAR = 1.5
# What was not used concerns the views, not the fit, and stays with another fit of the same views.
_LASTING = ("excluded", "start")
# Names and reasons in one message, at most.
_SHOWN = 5


def calibrate_what_fits(
    observations: Observations, options: CalibrationOptions, progress: Progress
) -> CameraCalibrationResult:
    """As `kcal.calibrate.camera.hybrid.calibrate_hybrid`, but a few views that no lens fits are left out.

    Raises:
        DegenerateError: as `calibrate_hybrid`, with the names of the views.
        InputError: more than a fifth of the views do not fit, or one of five or fewer; the message names them. Or no
            hand moves as views do while they are read.
    """
    # What these refuse, leaving out views does not mend.
    check_views(observations.board.points, observations.pixels(), observations.names, _UNKNOWNS, fewest=MINIMUM_VIEWS)
    given = options.start_focal(observations.image_size)
    failure: Exception | None = None
    try:
        result = _with_start(calibrate_hybrid(observations, options, progress), given)
        if not moves_beyond_hands(result.hybrid):
            return result
    except _FAILED as error:
        if options.reject is not None:
            raise
        failure = error
    except DegenerateError as error:
        # Wrong views can leave the others open, too; but of views that are alike any part is.
        if options.reject is None and given is None and not isinstance(error, AlikeError):
            wrong = _wrong_views(observations, options)
            if wrong and few_views(len(wrong), len(observations.views)):
                return _without(observations, options, wrong, error, progress)
        if any(name in str(error) for name in observations.names):
            raise
        raise DegenerateError(f"{error}; the views are {_few_names(observations.names)}") from error
    if failure is not None and given is not None:
        progress("again without the focal length that was given")
        less = dataclasses.replace(options, focal=None, field_of_view=None)
        try:
            result = calibrate_what_fits(observations, less, progress)
        except InputError:
            raise failure from None
        return _without_given(result, given, "belongs to no lens that shows the corners")
    # Motion at its limit makes room in all views for what is wrong with a few: of seven views of a webcam, two of them
    # of a board that bent, the focal length then was 844 ± 20 px in place of 1130. A lens that stands still tells them.
    wrong = _wrong_views(observations, options, **({} if failure else {"motion": False, "bending": False}))
    listed = listed_views(observations, wrong)
    if not wrong or not few_views(len(wrong), len(observations.views)):
        which = (
            f"{len(wrong)} of {len(observations.views)} views do not fit the others: {listed}"
            if wrong
            else f"Look first at {least_planar(observations.board.points, observations.pixels(), observations.names)}"
        )
        what = "no lens shows all corners where they are"
        cure = "Do all images show this board, not mirrored, and are all from this camera at this zoom?"
        if failure is None:
            what = "views move by more than any hand does while they are read, so that no error bar would hold"
            cure = "Are corners wrong, does the board bend, or was the video cropped or stabilized?"
        raise InputError(
            f"{what}. {which}. {cure} Remove those that do not fit, or photograph a stiff board on a stand, and detect "
            "again"
        ) from failure
    return _without(observations, options, wrong, failure, progress)


def few_views(wrong: int, count: int) -> bool:
    """Whether so many of `count` views are few enough to go on without them."""
    return wrong <= max(1.0, _FEW * count) and count - wrong >= _ENOUGH


def _without(
    observations: Observations,
    options: CalibrationOptions,
    wrong: Mapping[int, str],
    failure: Exception | None,
    progress: Progress,
) -> CameraCalibrationResult:
    """Without views that do not fit."""
    progress(f"without {len(wrong)} views that no lens fits")
    try:
        result = calibrate_hybrid(leaving_out(observations, wrong), options, progress)
    except _FAILED as error:
        listed = listed_views(observations, wrong)
        raise InputError(f"without {len(wrong)} views that no lens fits ({listed}): {error}") from failure
    return without_views(result, observations, wrong)


def _with_start(result: CameraCalibrationResult, given: float | None) -> CameraCalibrationResult:
    """A result, and what is to say of a focal length that was given."""
    found = float(result.camera.focal[0])
    if given is None or 1.0 / _FAR < found / given < _FAR:
        return result
    return _without_given(result, given, f"is far from the camera's ({found:.4g} px)")


def _without_given(result: CameraCalibrationResult, given: float, why: str) -> CameraCalibrationResult:
    """A result, with the doubt of a focal length that was given."""
    text = f"the focal length that was given for the start ({given:.4g} px) {why}: it was not used"
    note = Finding("start", "doubt", text, "leave it out, or correct it")
    return dataclasses.replace(result, findings=(note, *result.findings))


def _wrong_views(observations: Observations, options: CalibrationOptions, **how: Any) -> dict[int, str]:
    """Views that do not fit, by a fit in which few wrong corners count little: index -> why."""
    pixels, board = observations.pixels(), observations.board.points
    try:
        own = FitOptions(board=options.board, robust=True, **how)
        fit = fit_hybrid(board, pixels, observations.image_size, options=own)
    except (*_FAILED, DegenerateError):
        return {}
    residuals = fit.residuals_of(pixels)
    seen = torch.isfinite(pixels).all(-1)
    missing = (seen & ~torch.isfinite(residuals).all(-1)).sum(-1)
    found = views_beyond(board, residuals, pixels, corners_beyond(residuals))
    for i in missing.nonzero()[:, 0].tolist():
        found[i] = f"the lens that fits the others cannot show {int(missing[i])} of its {int(seen[i].sum())} corners"
    return dict(sorted(found.items()))


def lasting_findings(result: CameraCalibrationResult) -> tuple[Finding, ...]:
    """Those of a result's findings that hold for another fit of the same views, too: of these, or what was not used."""
    return tuple(one for one in result.findings if one.name in _LASTING)


def _few_names(names: Sequence[str]) -> str:
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def listed_views(observations: Observations, wrong: Mapping[int, str]) -> str:
    """Names of views with their reasons, a few of them."""
    return _few_names([f"{observations.names[i]} ({why})" for i, why in wrong.items()])


def leaving_out(observations: Observations, views: Collection[int]) -> Observations:
    """The observations without some views."""
    return observations.subset([name for i, name in enumerate(observations.names) if i not in views])


def without_views(
    result: CameraCalibrationResult, observations: Observations, wrong: Mapping[int, str]
) -> CameraCalibrationResult:
    """A result without some views as one for all `observations`, with a doubt that names them."""
    if not wrong:
        return result
    text = f"{len(wrong)} of {len(observations.views)} views were left out: {listed_views(observations, wrong)}"
    note = Finding("excluded", "doubt", text, "look at these images, and remove or retake them")
    result = dataclasses.replace(result, findings=(note, *result.findings))
    return among_all(result, observations, {i: (why, math.nan) for i, why in wrong.items()})


def among_all(
    result: CameraCalibrationResult, observations: Observations, without: Mapping[int, tuple[str, float]]
) -> CameraCalibrationResult:
    """A result without some views as one for all `observations`; of each such view, why, and its residual in pixels."""
    kept = [i for i in range(len(observations.views)) if i not in without]
    counts = torch.isfinite(observations.pixels()).all(-1).sum(-1).tolist()
    left_out = [
        Rejected(view=observations.names[i], corners=counts[i], residual=residual, reason=why)
        for i, (why, residual) in without.items()
    ]
    rejected = (*result.rejected_views, *left_out)
    return dataclasses.replace(result.among(kept, observations), rejected_views=rejected) if left_out else result
