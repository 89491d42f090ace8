"""The verdict on a camera: its error bars, and what its views say against its model, its board and themselves."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

from kcal.calibrate.camera.advice import what_to_photograph
from kcal.calibrate.camera.options import CalibrationOptions, Progress
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.camera.trust import Examination, examine
from kcal.lens.camera import Camera
from kcal.lens.paraxial import paraxial_focal
from kcal.lens.uncertainty import image_sigma
from kcal.locate.ranges import BEARING_SIGMAS
from kcal.report.model_findings import FAULTS, model_findings
from kcal.report.verdict import Finding, RangeAnswer, Requirement, Verdict, sorted_findings
from kcal.report.view_findings import view_findings

_BASIS = "in a rig of two such cameras, {:g} m apart, with marks to {:g} px, RMS over the image"


def camera_verdict(
    result: CameraCalibrationResult,
    options: CalibrationOptions | None = None,
    requirements: Sequence[Requirement] = (),
    *,
    baseline: float = 10.0,
    mark_sigma: float = 0.3,
    subject: str = "camera",
    examination: Examination | None = None,
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
    found += [Finding(name="calibration", severity="doubt", text=text, picture="residuals") for text in result.warnings]
    # What another model that fits as well sees elsewhere is uncertain too, above all where no board was.
    sigma = max(_image_rms(result.camera), 0.0 if examination.model is None else examination.model.rms)
    answers = tuple(
        _camera_answer(result.camera, requirement, sigma, beyond, baseline, mark_sigma) for requirement in requirements
    )
    if not all(answer.ok for answer in answers):
        # A fault that the requirements bear is a doubt; one that breaks them is the reason.
        found = [
            dataclasses.replace(finding, severity="stop") if finding.name in FAULTS else finding for finding in found
        ]
    rotation = result.cam_from_board_rotation
    return Verdict(
        subject=subject,
        answers=answers,
        findings=sorted_findings(found),
        advice=result.advice or what_to_photograph(result.observations, result.camera, rotation),
        basis=_BASIS.format(baseline, mark_sigma),
        unexplained=beyond,
    )


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
    found = [
        Finding(
            name="halves",
            severity="doubt",
            text="the views were not looked at: a wrong lens model or board cannot be noticed in a camera file",
            action="give the observations too (--observations)",
        )
    ]
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
    parts = {"marks": slope * mark_sigma, "lenses": slope * sigma, "faults of the calibration": slope * beyond}
    total = math.hypot(*parts.values())
    return RangeAnswer(requirement=requirement, parts=parts, ranged=total * BEARING_SIGMAS <= requirement.distance)
