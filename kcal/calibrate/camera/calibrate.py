"""Calibrate one camera, or many, from views of a board (Algorithm 1 of the paper)."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import torch

from kcal.calibrate.camera.checks import MINIMUM_VIEWS, unusable_views
from kcal.calibrate.camera.leave_out import calibrate_what_fits, listed_views, without_views
from kcal.calibrate.camera.options import CalibrationOptions, Progress
from kcal.calibrate.camera.parametric import calibrate_parametric
from kcal.calibrate.camera.repeats import copied_views, copy_warnings, pose_warnings
from kcal.calibrate.camera.result import CameraCalibrationResult, RejectedView
from kcal.calibrate.camera.sharing import ALONE, sharing
from kcal.calibrate.camera.two_cameras import two_camera_warnings
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError, InputError, KcalError
from kcal.threads import in_one_thread

__all__ = ["CalibrationOptions", "CameraCalibrationResult", "calibrate_camera", "calibrate_cameras"]


def _silent(_: str) -> None:
    return None


@in_one_thread
def calibrate_camera(
    observations: Observations, options: CalibrationOptions | None = None, progress: Progress = _silent
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
        kept = [name for i, name in enumerate(observations.names) if i not in unusable]
        if len(kept) < MINIMUM_VIEWS:
            raise DegenerateError(
                f"{len(kept)} view(s) of the board can be used, and at least {MINIMUM_VIEWS} at different tilts are "
                f"needed, 10 to 40 are good; of no use: {listed_views(observations, unusable)}"
            )
        return without_views(calibrate_camera(observations.subset(kept), options, progress), observations, unusable)
    pixels, copied = observations.pixels(), copied_views(observations.pixels(), 0.0)
    result = _calibrate(_without_copies(observations, copied), options, progress)
    if (nearly := copied_views(pixels, result.noise)) != copied:
        progress(f"{len(nearly)} views are copies of others; again without them")
        copied = nearly
        result = _calibrate(_without_copies(observations, copied), options, progress)
    doubts = two_camera_warnings(result, options, progress)
    result = dataclasses.replace(result, warnings=(*result.warnings, *doubts))
    return _complete(result, observations, copied)


def _without_copies(observations: Observations, copied: Mapping[int, int]) -> Observations:
    return observations.model_copy(
        update={"views": tuple(view for i, view in enumerate(observations.views) if i not in copied)}
    )


def _complete(
    result: CameraCalibrationResult, observations: Observations, copied: Mapping[int, int]
) -> CameraCalibrationResult:
    """A result without copies as one for all observations, with warnings about views that add nothing."""
    pixels, names = observations.pixels(), observations.names
    warnings = (*result.warnings, *copy_warnings(names, copied), *pose_warnings(result.observations.pixels()))
    kept = [i for i in range(len(names)) if i not in copied]
    left_out = tuple(
        RejectedView(
            view=names[i],
            corners=int(torch.isfinite(pixels[i]).all(-1).sum()),
            residual=float(result.per_view_rms[kept.index(first)]),
            reason=f"it is a copy of {names[first]}",
        )
        for i, first in copied.items()
    )
    if left_out:
        result = result.among(kept, observations)
    return dataclasses.replace(result, warnings=warnings, rejected_views=(*result.rejected_views, *left_out))


def _calibrate(observations: Observations, options: CalibrationOptions, progress: Progress) -> CameraCalibrationResult:
    if options.hybrid:
        return calibrate_what_fits(observations, options, progress)
    return calibrate_parametric(observations, options, progress)


@in_one_thread
def calibrate_cameras(
    observations: Sequence[Observations],
    options: CalibrationOptions | None = None,
    progress: Progress = _silent,
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
        [DegenerateError('1 view(s) of the board: at least 3 at different tilts are needed, 10 to 40 are good')]
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
        note = f"{ALONE}: {error}"
        return [
            found if isinstance(found, KcalError) else dataclasses.replace(found, warnings=(*found.warnings, note))
            for found in alone
        ]
