"""Findings about lens model, board and error bars, from what a calibration says against itself."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from kcal.calibrate.camera.options import CalibrationOptions
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.camera.summary import summarize
from kcal.calibrate.camera.trust import Examination, HalvesDifference, unexplained
from kcal.lens.uncertainty import image_sigma
from kcal.report.verdict import Finding

# Names of findings by which a camera is wrong beyond its error bars.
FAULTS = ("model", "board", "pupil", "changed")
# Chance by which halves may differ. Error bars from half of the views are approximate: at 1e-3, one of 30 clean
# captures was doubted (tuning seeds of scripts/check/verdict.py), where wrong models reach 1e-7 and less.
_CHANCE = 1e-6
# Correlation of neighboring residuals: -0.06 to 0.02 in clean captures, 0.4 and more with a wrong lens or board.
_NEIGHBORS = 0.12
# Averages of residuals over parts of the image, mean squares over what noise leaves: below 1.2 in clean captures.
_IMAGE = 2.5
# Standard deviations by which a board bends, or a pupil moves, before it is named.
_SURE = 5.0
# Halves that differ in time by this many times more than halves that are alike: two cameras, or one that changed.
_CHANGED = 2.5


def model_findings(
    result: CameraCalibrationResult, options: CalibrationOptions, found: Examination
) -> tuple[list[Finding], float]:
    """What speaks against lens model, board and error bars, and by how many px RMS the camera is wrong beyond these."""
    findings: list[Finding] = []
    beyond = 0.0
    reference = found.reference
    structured = found.structure.neighbors > _NEIGHBORS or found.structure.image > _IMAGE
    bends = _board_fault(result, options, reference)
    pupil = _pupil_fault(result, reference)
    if found.model is not None and reference is not None:
        far = found.model.rms
        beyond = far if bends or pupil or structured else unexplained(found.model)
        if bends:
            findings.append(
                Finding(
                    name="board",
                    severity="doubt",
                    text=f"{bends}, but was taken as flat and exact: far directions are wrong by {far:.2g} px",
                    action="calibrate with the default lens and --board printed, which measures the board, or use a "
                    "stiffer board",
                    picture="board",
                )
            )
        elif pupil:
            findings.append(
                Finding(
                    name="pupil",
                    severity="doubt",
                    text=f"{pupil}, which {result.camera.model} does not have: far directions are off by {far:.2g} px",
                    action="calibrate with the default lens (--model hybrid), or show the board from farther away",
                    picture="model",
                )
            )
        elif not beyond and (reference.hybrid is not None and result.hybrid is None) and far > _image_sigma_of(result):
            findings.append(
                Finding(
                    name="model",
                    severity="doubt",
                    text=f"another lens model fits these views as well as {result.camera.model} and differs by "
                    f"{far:.2g} px, most where no board was",
                    action="calibrate with the default lens (--model hybrid), and show the board at the borders of the "
                    "image",
                    picture="model",
                )
            )
        elif beyond:
            findings.append(
                Finding(
                    name="model",
                    severity="doubt",
                    text=f"the lens model {result.camera.model} does not fit this lens: it differs by {far:.2g} px "
                    "from one that does",
                    action="calibrate with the default lens (--model hybrid)",
                    picture="model",
                )
            )
    elif structured:
        findings.append(
            Finding(
                name="model",
                severity="stop",
                text="residuals are not noise: those of neighboring corners have a correlation of "
                f"{found.structure.neighbors:.2f}. Lens model or board do not fit, and error bars are too small",
                action="check that all views show one flat, stiff board, with the camera's focus and zoom unchanged",
                picture="residuals",
            )
        )
    halves = {half.label: unexplained(half.difference, _CHANCE) for half in found.halves}
    worst = max(halves.values(), default=0.0)
    beyond = max(beyond, worst)
    if worst and not findings:
        findings.append(_halves_finding(found.halves, halves, options))
    if found.failures or not found.halves:
        findings.append(
            Finding(
                name="halves",
                severity="doubt",
                text=f"the error bars could not be checked by halves of the views: {'; '.join(found.failures)}",
                action="take more views",
            )
        )
    elif not findings:
        ratios = ", ".join(f"{half.difference.ratio or 0.0:.1f}" for half in found.halves)
        findings.append(
            Finding(
                name="halves",
                severity="fine",
                text=f"cameras from halves of the views agree: their difference is {ratios} times what the error bars "
                "predict",
                picture="halves",
            )
        )
    return findings, beyond


def _halves_finding(
    halves: Sequence[HalvesDifference], beyond: Mapping[str, float], options: CalibrationOptions
) -> Finding:
    """What differing halves mean: halves in time, or by name, that differ more than alike ones are not one camera."""
    alike = max((half.difference.ratio or 1.0 for half in halves if half.alike), default=1.0)
    for half in halves:
        if not half.alike and beyond[half.label] and (half.difference.ratio or 0.0) > _CHANGED * alike:
            return Finding(
                name="changed",
                severity="stop",
                text=f"{half.label} show two different cameras, {half.difference.rms:.2g} px apart: images of two "
                "cameras in one file, or focus, zoom or image stabilization changed in between",
                action="calibrate from the images of one camera with fixed focus and zoom",
                picture="halves",
            )
    worst = max(beyond, key=lambda label: beyond[label])
    return Finding(
        name="model",
        severity="doubt",
        text=f"cameras from two halves of the views ({worst}) differ by {beyond[worst]:.2g} px beyond their error "
        "bars: the lens model or the board does not fit",
        action="take more views, with one flat, stiff board"
        if options.hybrid
        else "calibrate with the default lens and --board printed",
        picture="halves",
    )


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
