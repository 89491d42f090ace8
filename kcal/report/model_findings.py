"""Findings about lens model, board and error bars, from what a calibration says against itself."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from kcal.calibrate.camera.options import CalibrationOptions, Progress
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.camera.summary import summarize
from kcal.calibrate.camera.trust import Examination, HalvesDifference, examine, unexplained
from kcal.calibrate.camera.warnings import REPEATING
from kcal.lens.uncertainty import image_sigma
from kcal.report.verdict import FAULTS, Finding

# Chance by which halves may differ. Error bars from half of the views are approximate: at 1e-3, one of 30 clean
# captures was doubted (tuning seeds of scripts/check/verdict.py), where wrong models reach 1e-7 and less.
_CHANCE = 1e-6
# Correlation of neighboring residuals: -0.06 to 0.02 in clean captures, 0.4 and more with a wrong lens or board.
_NEIGHBORS = 0.12
# Averages of residuals over parts of the image, mean squares over what noise leaves: below 1.2 in clean captures.
_IMAGE = 2.5
# Standard deviations by which a board bends, or a pupil moves, before it is named.
_SURE = 5.0
# RMS of halves over that of all views, below which these are not of one camera: 0.93 and more in captures of one.
_OWN = 0.8
# A lens with a measured board and motions fits two cameras that are nearly alike. Their halves differ by more than
# chance explains at the lower level, and predict each other worse than halves that are alike by this factor: 1.1 and
# 1.2 for OpenCV's left and right images, 1.9 for both in one file.
_LIKELY, _APART = 1e-3, 1.5
# RMS of corners that a half did not see over that of fitted ones: 1.01 to 1.19 in clean captures of 12 to 22 views, 1.5
# to 2.1 with 5 coefficients on a wide lens (tuning seeds of scripts/check/verdict.py).
_PREDICTED = 1.25
# Mean squares of averages of residuals over parts of the image beyond which the lens is wrong, whatever else is: 11 and
# more with wrong lenses, at most 2.5 with bent boards and moving pupils.
_LENS = 5.0


def model_findings(
    result: CameraCalibrationResult, options: CalibrationOptions, found: Examination
) -> tuple[list[Finding], float]:
    """What speaks against lens model, board and error bars, and by how many px RMS the camera is wrong beyond these."""
    structured = found.structure.neighbors > _NEIGHBORS or found.structure.image > _IMAGE
    halves = {half.label: unexplained(half.difference, _CHANCE) for half in found.halves}
    beyond = max(halves.values(), default=0.0)
    against = None
    if (changed := _changed(result, found.halves, halves)) is not None:
        against, beyond = _changed_finding(changed), max(beyond, unexplained(changed.difference, _LIKELY))
    if found.model is not None and found.reference is not None:
        named = _against_reference(result, options, found, found.model.rms)
        certain = named is not None and named.name in ("board", "pupil")
        beyond = max(beyond, found.model.rms if certain or structured else unexplained(found.model))
        if named is None and beyond:
            named = Finding(
                name="model",
                severity="doubt",
                text=f"the lens model {result.camera.model} does not fit this lens: it differs by "
                f"{found.model.rms:.2g} px from one that does",
                action="calibrate with the default lens (--model hybrid)",
                picture="model",
                part=FAULTS,
            )
        against = against or named
    elif structured and against is None:
        # Real corners are never quite independent: with halves that agree, and the same in all views, they do little.
        # OpenCV's stereo images have a correlation of 0.25 and predict held-out views to 0.1 px; their tempering is
        # below that of which the calibration itself warns, that of two boards in one file above it.
        tempered = result.hybrid is not None and result.hybrid.tempering <= REPEATING
        slight = tempered and not beyond and found.structure.image <= _IMAGE
        against = Finding(
            name="model",
            severity="doubt" if slight else "stop",
            text="residuals are not noise: those of neighboring corners have a correlation of "
            f"{found.structure.neighbors:.2f}. Lens model or board do not fit"
            + (" everywhere" if slight else ", and error bars are too small"),
            action="check that all views show one flat, stiff board, with the camera's focus and zoom unchanged",
            picture="residuals",
            part=FAULTS,
        )
    elif beyond and against is None:
        worst = max(halves, key=lambda label: halves[label])
        against = Finding(
            name="model",
            severity="doubt",
            text=f"cameras from two halves of the views ({worst}) differ by {halves[worst]:.2g} px beyond their error "
            "bars: lens model or board do not fit",
            action="take more views, with one flat, stiff board",
            picture="halves",
            part=FAULTS,
        )
    findings = [] if against is None else [against]
    if alike := [half for half in found.halves if half.alike]:
        findings.append(_prediction_finding(alike[0]))
    if found.failures or not found.halves:
        findings.append(
            Finding(
                name="halves",
                severity="doubt",
                text=f"the error bars could not be checked by halves of the views: {'; '.join(found.failures)}",
                action="take more views",
                part="lenses",
            )
        )
    elif against is None:
        ratios = ", ".join(f"{half.difference.ratio or 0.0:.1f}" for half in found.halves)
        findings.append(
            Finding(
                name="halves",
                severity="fine",
                text=f"cameras from halves of the views agree: their difference is {ratios} times what the error bars "
                "predict",
                picture="halves",
                part="lenses",
            )
        )
    return findings, beyond


def fault_of_views(
    result: CameraCalibrationResult, options: CalibrationOptions, progress: Progress = lambda _: None
) -> Finding | None:
    """What a calibration's own views say against its error bars, if it moves the camera beyond these; else None."""
    findings, beyond = model_findings(result, options, examine(result, options, progress))
    faults = [finding for finding in findings if finding.part == FAULTS]
    return faults[0] if faults and (beyond > 0.0 or faults[0].severity == "stop") else None


def _prediction_finding(half: HalvesDifference) -> Finding:
    """How well one half of the views predicts the other: held-out residuals beside those of fits."""
    ratio = half.held_out / half.own
    text = (
        f"the camera from one half of the views predicts the corners of the other half to {half.held_out:.2g} px RMS, "
        f"{ratio:.2f} times what is left where they are fitted"
    )
    if ratio <= _PREDICTED:
        return Finding(name="prediction", severity="fine", text=text, picture="halves", part="lenses")
    return Finding(
        name="prediction",
        severity="doubt",
        text=f"{text}: lens model or board do not carry over to other views",
        action="take more views, all over the image and at several distances, with one flat, stiff board",
        picture="halves",
        part="lenses",
    )


def _changed(
    result: CameraCalibrationResult, halves: Sequence[HalvesDifference], beyond: Mapping[str, float]
) -> HalvesDifference | None:
    """Halves in time, or by name, that are not of one camera: each fits alone, and both together, or one the other not.

    Args:
        result: the calibration.
        halves: of its views.
        beyond: label -> px by which they differ beyond their error bars.
    """
    alike = min((half.held_out for half in halves if half.alike), default=math.inf)
    for half in halves:
        likely = (half.difference.probability or 0.0) < _LIKELY and half.held_out > _APART * alike
        likely = likely and result.hybrid is not None
        if not half.alike and (likely or (beyond[half.label] and half.own < _OWN * result.rms)):
            return half
    return None


def _changed_finding(half: HalvesDifference) -> Finding:
    return Finding(
        name="changed",
        severity="stop",
        text=f"{half.label} show two different cameras, {half.difference.rms:.2g} px apart: images of two "
        "cameras in one file, or focus, zoom or image stabilization changed in between",
        action="calibrate from the images of one camera with fixed focus and zoom",
        picture="halves",
        part=FAULTS,
    )


def _against_reference(
    result: CameraCalibrationResult, options: CalibrationOptions, found: Examination, far: float
) -> Finding | None:
    """What the reference finds that was left out: the board's shape, the pupil's movement, or another lens."""
    plain = found.structure.image < _LENS
    if plain and (bends := _board_fault(result, options, found.reference)):
        return Finding(
            name="board",
            severity="doubt",
            text=f"{bends}, but was taken as flat and exact: far directions are wrong by {far:.2g} px",
            action="calibrate with the default lens and --board printed, which measures the board, or use a stiffer "
            "board",
            picture="board",
            part=FAULTS,
        )
    if plain and (pupil := _pupil_fault(result, found.reference)):
        return Finding(
            name="pupil",
            severity="doubt",
            text=f"{pupil}, which {result.camera.model} does not have: far directions are off by {far:.2g} px",
            action="calibrate with the default lens (--model hybrid), or show the board from farther away",
            picture="model",
            part=FAULTS,
        )
    if (
        plain
        and result.hybrid is None
        and found.model is not None
        and not unexplained(found.model)
        and far > _image_sigma_of(result)
    ):
        return Finding(
            name="model",
            severity="doubt",
            text=f"another lens model fits these views as well as {result.camera.model} and differs by {far:.2g} px, "
            "most where no board was",
            action="calibrate with the default lens (--model hybrid), and show the board at the borders of the image",
            picture="model",
            part=FAULTS,
        )
    return None


def _image_sigma_of(result: CameraCalibrationResult) -> float:
    """RMS over the image of the error bars, px."""
    sigma = image_sigma(result.camera)
    return float(sigma[sigma.isfinite()].square().mean().sqrt())


def _board_fault(
    result: CameraCalibrationResult, options: CalibrationOptions, reference: CameraCalibrationResult | None
) -> str:
    """How the board differs from the flat one that was assumed; empty where it does not, or was measured."""
    if reference is None or reference.measured_board is None or not bool(reference.measured_board.amplitudes.any()):
        return ""
    if options.hybrid and options.board != "exact":
        return ""
    board = reference.measured_board
    better = reference.noise < 0.97 * result.noise
    if board.bending.value > _SURE * board.bending.sigma and better and not options.board_warp:
        return f"the board bends by {1e3 * board.bending.value:.2g} mm"
    if abs(board.stretch.value) > _SURE * board.stretch.sigma and better:
        return f"the board's squares are {100 * abs(board.stretch.value):.2g} % longer one way than the other"
    return ""


def _pupil_fault(result: CameraCalibrationResult, reference: CameraCalibrationResult | None) -> str:
    """How the entrance pupil moves, where the model has none; empty where it does not."""
    if reference is None or result.hybrid is not None:
        return ""
    brief = summarize(reference)
    if brief.pupil is None or not brief.pupil_sigma or abs(brief.pupil) < _SURE * brief.pupil_sigma:
        return ""
    return f"the entrance pupil moves by {1e3 * abs(brief.pupil):.2g} mm towards the image's corners"
