"""The verdict on a camera: its error bars, and what its views say against its model, its board and themselves."""

from __future__ import annotations

import math
from collections.abc import Sequence

from kcal.calibrate.camera.advice import what_to_photograph
from kcal.calibrate.camera.options import CalibrationOptions, Progress
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.camera.trust import Examination, examine, unexplained
from kcal.lens.camera import Camera
from kcal.lens.difference import camera_difference
from kcal.lens.paraxial import paraxial_focal
from kcal.lens.uncertainty import image_sigma
from kcal.report.model_findings import model_findings
from kcal.report.verdict import FAULTS, Finding, RangeAnswer, Requirement, Verdict, sorted_findings, weighed_findings
from kcal.report.view_findings import record_findings, view_findings
from kcal.threads import in_one_thread

# Of the error bars: a camera that was calibrated again from its own views differs by less.
_ITSELF = 0.5
_BASIS = "in a rig of two such cameras, {:g} m apart, with marks to {:g} px, RMS over the image"


@in_one_thread
def camera_verdict(
    result: CameraCalibrationResult,
    options: CalibrationOptions | None = None,
    requirements: Sequence[Requirement] = (),
    *,
    baseline: float = 10.0,
    mark_sigma: float = 0.3,
    subject: str = "camera",
    examination: Examination | None = None,
    stored: Camera | None = None,
    progress: Progress = lambda _: None,
) -> Verdict:
    """Judge a calibration against a user's own requirements.

    Ranges are those of a rig of two such cameras. What halves of the views, or a reference with the hybrid lens, say
    against the error bars counts in them.

    Args:
        result: the calibration.
        options: with which it was made.
        requirements: ranges, and how well they must be known.
        baseline: of the rig, meters.
        mark_sigma: noise of a mark along each axis, px.
        subject: name of the camera.
        examination: from `examine`, if it was made already.
        stored: the camera that is to be used, where the calibration was made again from what should be its views.
        progress: called after each fit.

    Example:
        >>> import torch
        >>> from kcal import Board, Observations, View, calibrate_camera
        >>> from kcal.lens import rotation_from_vector
        >>> board, views = Board(columns=7, rows=6, square=0.05), []
        >>> truth = Camera.build(focal=(800, 800), center=(322, 238), size=(640, 480), model="pinhole")
        >>> tilts = torch.tensor([[0.5, 0, 0], [-0.5, 0.1, 0], [0, 0.5, 0.2], [0.1, -0.5, 0]], dtype=torch.float64)
        >>> for i, rotation in enumerate(rotation_from_vector(tilts)):
        ...     points = board.points @ rotation.T + torch.tensor([-0.15, -0.14, 0.7], dtype=torch.float64)
        ...     views.append(View(name=str(i), pixels=truth.project(points)[0].tolist()))
        >>> result = calibrate_camera(Observations(board=board, image_size=(640, 480), views=views))
        >>> verdict = camera_verdict(result, requirements=Requirement.parse("50m:10%"))
        >>> verdict.usable, [finding.name for finding in verdict.findings if finding.severity == "doubt"]
        (True, ['roll', 'depth', 'coverage', 'views', 'halves', 'calibration'])
    """
    options = options or CalibrationOptions()
    examination = examination or examine(result, options, progress)
    against, beyond = model_findings(result, options, examination)
    # Faults of the views come first: without tilts or with blur the model looks wrong too.
    reference = examination.reference or result
    found = [*view_findings(result, min(result.noise, reference.noise)), *against]
    found += [
        Finding(name="calibration", severity="doubt", text=text, picture="residuals", part="lenses")
        for text in result.warnings
    ]
    if stored is not None:
        other, apart = other_views(stored, result)
        found, beyond = [*other, *found], max(beyond, apart)
    # What another model that fits as well sees elsewhere is uncertain too, above all where no board was; what is known
    # to be wrong of it counts as a fault.
    elsewhere = 0.0 if examination.model is None else max(examination.model.rms**2 - beyond**2, 0.0)
    sigma = max(_image_rms(result.camera), math.sqrt(elsewhere))
    answers = tuple(
        _camera_answer(result.camera, requirement, sigma, beyond, baseline, mark_sigma) for requirement in requirements
    )
    rotation = result.cam_from_board_rotation
    return Verdict(
        subject=subject,
        answers=answers,
        findings=weighed_findings(found, answers),
        advice=result.advice or what_to_photograph(result.observations, result.camera, rotation),
        basis=_BASIS.format(baseline, mark_sigma),
        unexplained=beyond,
    )


@in_one_thread
def stored_verdict(
    camera: Camera,
    requirements: Sequence[Requirement] = (),
    *,
    baseline: float = 10.0,
    mark_sigma: float = 0.3,
    subject: str = "camera",
) -> Verdict:
    """Judge a camera by its file alone: its error bars are believed.

    Args:
        camera: with its `calibration`.
        requirements: ranges, and how well they must be known.
        baseline: of a rig of two such cameras, meters.
        mark_sigma: noise of a mark along each axis, px.
        subject: name of the camera.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
        >>> stored_verdict(camera).reason
        'the camera has no error bars: nobody can say how wrong its directions are'
    """
    found = stored_findings(camera)
    sigma = _image_rms(camera)
    if math.isinf(sigma):
        found.append(
            Finding(
                name="error-bars",
                severity="stop",
                text="the camera has no error bars: nobody can say how wrong its directions are",
                action="calibrate it with kcal calibrate",
            )
        )
    return Verdict(
        subject=subject,
        answers=tuple(
            _camera_answer(camera, requirement, sigma, 0.0, baseline, mark_sigma) for requirement in requirements
        ),
        findings=sorted_findings(found),
        basis=_BASIS.format(baseline, mark_sigma),
    )


def stored_findings(camera: Camera) -> list[Finding]:
    """What a camera's file tells of its calibration, and that its views were not looked at."""
    record = camera.calibration.record if camera.calibration else None
    unseen = Finding(
        name="halves",
        severity="doubt",
        text="the views were not looked at, and a camera file alone cannot show that its lens model or board is wrong",
        action="give the observations too (--observations FILE, for a rig twice: left, then right)",
        part="lenses",
    )
    return [unseen, *([] if record is None else record_findings(record))]


def other_views(stored: Camera, result: CameraCalibrationResult) -> tuple[list[Finding], float]:
    """Whether these views give another camera than the one to be used, and by how many px beyond their error bars."""
    found = camera_difference(stored, result.camera)
    record = stored.calibration.record if stored.calibration else None
    missing = [] if record is None else [view for view in record.per_view_rms if view not in result.observations.names]
    # A rig refines its cameras within their error bars, and keeps no error bars of each alone.
    alike = found.ratio is not None and (found.ratio <= _ITSELF if found.known[0] else bool(found.same))
    if alike and not missing:
        return [], 0.0
    text = "these are not the views that the camera was calibrated from"
    if record is not None and missing:
        text += f", {record.views} with {missing[0]}"
    text += f": they give one that differs by {found.rms:.2g} px (RMS)"
    if found.ratio is not None:
        text += f", {found.ratio:.1f} times what the error bars predict"
    other = Finding(
        name="other-views",
        severity="doubt" if found.same else "stop",
        text=text,
        action="give the observations that it was calibrated from, or calibrate it again",
        part=FAULTS,
    )
    told = record_findings(record) if record is not None and missing else []
    return [other, *told], unexplained(found)


def _image_rms(camera: Camera) -> float:
    """RMS over the image of the standard deviation of far directions, px; infinite without error bars."""
    known = camera.calibration
    if known is None or known.known(camera.params.detach()) is None:
        return math.inf
    sigma = image_sigma(camera)
    sigma = sigma[sigma.isfinite()]
    return float(sigma.square().mean().sqrt()) if len(sigma) else math.inf


def _camera_answer(
    camera: Camera, requirement: Requirement, sigma: float, beyond: float, baseline: float, mark_sigma: float
) -> RangeAnswer:
    """The range of a target by two such cameras: Z² / (f B) for each pixel of disparity, which both cameras spoil."""
    slope = math.sqrt(2.0) * requirement.distance**2 / (paraxial_focal(camera).mean[0] * baseline)
    parts = {"marks": slope * mark_sigma, "lenses": slope * sigma, FAULTS: slope * beyond}
    return RangeAnswer(requirement=requirement, parts=parts)
