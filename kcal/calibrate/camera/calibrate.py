"""Calibrate one camera, or many together, from views of a board (Algorithm 1 of the paper)."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from kcal.calibrate.camera.checks import MINIMUM_VIEWS, copied_views, copy_findings, pose_findings, unusable_views
from kcal.calibrate.camera.hybrid import (
    among_all,
    calibrate_hybrid,
    calibrate_what_fits,
    hybrid_result,
    lasting_findings,
    leaving_out,
    listed_views,
    without_views,
)
from kcal.calibrate.camera.one_camera import lenses_by_view
from kcal.calibrate.camera.result import COPY, CalibrationOptions, CameraCalibrationResult, Progress, SharedBoard
from kcal.calibrate.camera.solve import calibrate_parametric
from kcal.calibrate.camera.warnings import spacing_findings, unit_findings
from kcal.calibrate.hybrid.base_fit import may_be_unequal
from kcal.calibrate.hybrid.board_modes import turned_corners
from kcal.calibrate.hybrid.cameras_fit import LEAST_CAMERAS, Run, fit_cameras
from kcal.calibrate.hybrid.fit import FitOptions
from kcal.calibrate.hybrid.measured_board import MeasuredBoard
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError, InputError, KcalError
from kcal.finding import Finding
from kcal.threads import in_one_thread

# Cameras that are calibrated together: they share the boards that they saw, and what lenses of one type have alike.
#
# Each camera is calibrated alone first. Whether two saw one board is told by the evidence; each camera is then fitted
# again with the board as the others measured it (`kcal.calibrate.hybrid.cameras_fit`).

Outcome = CameraCalibrationResult | KcalError
# Said of each camera when all of them together could not be fitted.
ALONE = "calibrated alone, without what other cameras tell of the board"


def sharing(
    outcomes: Sequence[Outcome],
    options: CalibrationOptions,
    *,
    one_type: bool = False,
    run: Run | None = None,
    advance: Callable[[str], None] | None = None,
) -> list[Outcome]:
    """Calibrate cameras again, each with what the others tell.

    Args:
        outcomes: of each camera alone, with these options; errors stay what they are.
        options: of all of them.
        one_type: the cameras are of one type: from four cameras on, each learns from the others what its lens is like.
        run: makes the fits, see `fit_cameras`.
        advance: called after each fit.

    Raises:
        KcalError: the cameras cannot be fitted together.
    """
    found = list(outcomes)
    # A lens that moves by view stays as it was found.
    known = {
        i: outcome
        for i, outcome in enumerate(outcomes)
        if isinstance(outcome, CameraCalibrationResult) and outcome.by_view is None
    }
    boards = [result.observations.board for result in known.values()]
    together = options.board == "printed" and len(set(boards)) < len(boards)
    if not options.hybrid or not (together or (one_type and len(known) >= LEAST_CAMERAS)):
        return found
    used = {i: result.per_view_rms.isfinite().nonzero()[:, 0].tolist() for i, result in known.items()}
    alone = [result.hybrid.only(used[i]) for i, result in known.items() if result.hybrid is not None]
    fitted = fit_cameras(
        [result.observations.subset([result.observations.names[k] for k in used[i]]) for i, result in known.items()],
        FitOptions(board=options.board, motion=options.motion, bending=options.bending),
        names=[str(i + 1) for i in known],
        one_type=one_type,
        first=alone,
        run=run,
        advance=advance,
    )
    for camera, first, (i, before) in zip(fitted.cameras, alone, known.items(), strict=True):
        others = tuple(j for j, c in zip(known, fitted.cameras, strict=True) if c.board == camera.board >= 0 and j != i)
        shared = SharedBoard(others=others, evidence=camera.nats) if others else None
        if camera.fit is first:
            found[i] = dataclasses.replace(before, shared_board=shared)
            continue
        seen = _in_order(before.observations, used[i], camera.turns)
        after = hybrid_result(seen, camera.fit.among(used[i], len(seen.views)), options)
        pixels = before.observations.pixels()
        copied = {k: of for k, of in copied_views(pixels, before.noise).items() if k not in used[i]}
        repeats = (*copy_findings(before.observations.names, copied), *pose_findings(pixels[used[i]]))
        found[i] = dataclasses.replace(
            after,
            findings=(*lasting_findings(before), *after.findings, *repeats, *unit_findings(after)),
            rejected_corners=before.rejected_corners,
            rejected_views=before.rejected_views,
            shared_board=shared,
        )
    return found


def _in_order(seen: Observations, used: Sequence[int], turns: Tensor) -> Observations:
    """With the corners of views that were read from another end in the order of the others."""
    views, corners = list(seen.views), torch.arange(seen.board.corners)[None]
    for k, turn in zip(used, turns, strict=True):
        if turn:
            order = turned_corners(corners, seen.board, turn[None])[0].tolist()
            there, spread = views[k].pixels, views[k].covariance
            covariance = None if spread is None else tuple(spread[n] for n in order)
            views[k] = views[k].model_copy(update={"pixels": tuple(there[n] for n in order), "covariance": covariance})
    return seen.model_copy(update={"views": tuple(views)})


# Calibrate one camera, or many, from views of a board (Algorithm 1 of the paper).

__all__ = ["CalibrationOptions", "CameraCalibrationResult", "calibrate_camera", "calibrate_cameras"]


@in_one_thread
def calibrate_camera(
    observations: Observations, options: CalibrationOptions | None = None, progress: Progress = lambda _: None
) -> CameraCalibrationResult:
    """Find a camera's intrinsics and lens from views of a board.

    By default the lens is the hybrid one: it fits any camera, from webcam to fisheye, and the views themselves tell how
    much of each of its terms, of the entrance pupil's movement and of the board's errors there is
    (`kcal.calibrate.camera.hybrid`).

    A parametric model (`CalibrationOptions.model`) begins at the hybrid lens's base projection, whose curve its radial
    terms follow; then Levenberg-Marquardt minimizes the reprojection error of all corners over all parameters, with
    board poses eliminated by the Schur complement. Board poses with the wrong one of two tilts are found and solved
    again.

    Args:
        observations: the views of one camera. Left out with a warning that names them are copies of other views,
            compressed again or not, views whose corners do not determine the board's pose, and with the hybrid lens a
            few views that no lens fits.
        options: see `CalibrationOptions`.
        progress: called with what has just been finished.

    Returns:
        the camera with its residuals and error bars. Skew stays 0 unless `free` or `fixed` name it.

    Raises:
        DegenerateError: fewer than three views or poses of the board, too few corners for the model, or views that do
            not determine the focal length (all parallel to the image, for example).
        InputError: the data and the model do not fit at all; views that are not of one camera, which are named.

    Example:
        >>> from kcal import Board, Camera, View
        >>> from kcal.lens import rotation_from_vector
        >>> board = Board(columns=7, rows=6, square=0.05)
        >>> truth = Camera.build(focal=(800, 800), center=(322, 238), size=(640, 480), coefficients=[-0.1, 0.02])
        >>> tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
        >>> views = []
        >>> for i, rotation in enumerate(rotation_from_vector(tilts)):
        ...     points = board.points @ rotation.T + torch.tensor([-0.15, -0.14, 0.7], dtype=torch.float64)
        ...     views.append(View(name=str(i), pixels=truth.project(points)[0].tolist()))
        >>> seen = Observations(board=board, image_size=(640, 480), views=views)
        >>> result = calibrate_camera(seen)
        >>> round(float(result.camera.focal[0])), result.rms < 0.01
        (800, True)
        >>> exact = calibrate_camera(seen, CalibrationOptions(model="opencv4"))
        >>> round(float(exact.camera.focal[0]), 6), exact.rms < 1e-6
        (800.0, True)
    """
    options = options or CalibrationOptions()
    if options.camera is not None and not options.free:
        # Each view is for itself.
        return _calibrate(observations, options, progress)
    if unusable := unusable_views(observations.board.points, observations.pixels()):
        usable = leaving_out(observations, unusable)
        if len(usable.views) < MINIMUM_VIEWS:
            raise DegenerateError(
                f"{len(usable.views)} of {len(observations.views)} views of the board can be used, and at "
                f"least {MINIMUM_VIEWS} at different tilts are "
                f"needed, 10 to 40 are good; of no use: {listed_views(observations, unusable)}"
            )
        return without_views(calibrate_camera(usable, options, progress), observations, unusable)
    pixels, copied = observations.pixels(), copied_views(observations.pixels(), 0.0)
    _check_spacing(observations, options, progress)
    result = _calibrate(leaving_out(observations, copied), options, progress)
    if (nearly := copied_views(pixels, result.noise)) != copied:
        progress(f"{len(nearly)} views are copies of others; again without them")
        copied = nearly
        result = _calibrate(leaving_out(observations, copied), options, progress)
    checked = lenses_by_view(result, options, progress)
    if not isinstance(checked, CameraCalibrationResult):
        left = [view.name for view in result.observations.views]
        wrong = {observations.names.index(left[i]): why for i, why in checked.items()}
        wrong |= {i: wrong[first] for i, first in copied.items() if first in wrong}
        progress(f"again without {len(wrong)} views of another camera")
        return without_views(calibrate_camera(leaving_out(observations, wrong), options, progress), observations, wrong)
    # Copies come back as views that were left out, and what views do not add is doubted.
    names, views = observations.names, checked.observations.pixels()
    more = (*copy_findings(names, copied), *pose_findings(views), *unit_findings(checked))
    residuals = dict(zip((i for i in range(len(names)) if i not in copied), checked.per_view_rms.tolist(), strict=True))
    without = {i: (f"{COPY} {names[first]}", residuals[first]) for i, first in copied.items()}
    return among_all(dataclasses.replace(checked, findings=(*checked.findings, *more)), observations, without)


def _check_spacing(observations: Observations, options: CalibrationOptions, progress: Progress) -> None:
    """Raise `InputError` where the lens cannot allow for columns of the board that are not as far apart as its rows."""
    if (options.hybrid and options.board != "exact") or isinstance(options.board, MeasuredBoard):
        return
    try:
        if not may_be_unequal(observations.board.points, observations.pixels(), observations.image_size):
            return
        found = spacing_findings(calibrate_hybrid(observations, CalibrationOptions(), progress), refused=True)
    except (KcalError, ArithmeticError):
        # What is wrong with the views is said when they are calibrated.
        return
    if found:
        raise InputError(found[0].sentence)


def _calibrate(observations: Observations, options: CalibrationOptions, progress: Progress) -> CameraCalibrationResult:
    if options.hybrid:
        return calibrate_what_fits(observations, options, progress)
    return calibrate_parametric(observations, options, progress)


@in_one_thread
def calibrate_cameras(
    observations: Sequence[Observations],
    options: CalibrationOptions | None = None,
    progress: Progress = lambda _: None,
    *,
    one_type: bool = False,
) -> list[CameraCalibrationResult | KcalError]:
    """Calibrate several cameras with the same options.

    Each is calibrated as by `calibrate_camera`. Cameras with the hybrid lens that saw one printed board then share
    what they know of its bending and print errors; the evidence tells which of them saw one
    (`CameraCalibrationResult.shared_board`). Five views of a camera are worth more with the board that others measured.

    Args:
        observations: the views of each camera; numbers of views, image sizes and missing corners may differ.
        options: for all of them.
        progress: called with how many are finished.
        one_type: the cameras are of one type: from four cameras on, each learns from the others what its lens is like.

    Returns:
        for each camera what `calibrate_camera` returns, or the error that it would have raised: one bad set does not
        affect the others.

    Raises:
        InputError: `one_type` with a parametric model, or with images of several sizes.

    Example:
        >>> from kcal import Board, View
        >>> board = Board(columns=3, rows=3, square=0.1)
        >>> view = View(name="a", pixels=[(100.0 * x, 100.0 * y) for y in range(1, 4) for x in range(1, 4)])
        >>> calibrate_cameras([Observations(board=board, image_size=(640, 480), views=[view])])
        [DegenerateError('1 view of the board: at least 3 at different tilts are needed, 10 to 40 are good')]
    """
    options = options or CalibrationOptions()
    if one_type and not options.hybrid:
        raise InputError("cameras of one type learn from each other with the hybrid lens only; leave the model out")
    if one_type and len({seen.image_size for seen in observations}) > 1:
        raise InputError("cameras of one type have images of one size; these have several")
    alone: list[CameraCalibrationResult | KcalError] = []
    for seen in observations:
        try:
            alone.append(calibrate_camera(seen, options))
        except KcalError as error:
            alone.append(error)
        progress(f"{len(alone)} of {len(observations)} cameras")
    try:
        return sharing(
            alone, options, one_type=one_type, advance=lambda name: progress(f"camera {name} with the others")
        )
    except KcalError as error:
        note = Finding("alone", "doubt", f"{ALONE}: {error}")
        return [
            found if isinstance(found, KcalError) else dataclasses.replace(found, findings=(*found.findings, note))
            for found in alone
        ]
