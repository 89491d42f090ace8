"""The verdict on a camera: its error bars, and what its views say against its model, its board and themselves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from kcal.calibrate.camera.advice import ROLL_SPAN, board_tilts, reached, roll_span, unreached_share, what_to_photograph
from kcal.calibrate.camera.checks import mirrored_views
from kcal.calibrate.camera.result import CalibrationOptions, CameraCalibrationResult, Progress
from kcal.calibrate.camera.summary import summarize
from kcal.calibrate.camera.trust import Examination, HalvesDifference, examine, seen_pixels, unexplained
from kcal.calibrate.camera.warnings import REPEATING
from kcal.calibrate.rig.pairs import names_by_side
from kcal.corners.observations import Observations
from kcal.lens.calibration import CalibrationRecord
from kcal.lens.camera import Camera
from kcal.lens.difference import camera_difference
from kcal.lens.paraxial import paraxial_focal
from kcal.lens.uncertainty import image_sigma
from kcal.report.verdict import (
    FAULTS,
    Finding,
    RangeAnswer,
    Requirement,
    Severity,
    Verdict,
    sorted_findings,
    weighed_findings,
)
from kcal.threads import in_one_thread

# Findings about the views of a calibration: order of corners, tilts, rolls, depth, coverage, blur, number.

# Degrees beyond which a view tells the focal length, and how many views must.
_TILTED, _FEWEST_TILTED = 15.0, 3
# Farthest over nearest board.
_DEPTH = 1.3
# Share of the image, and of its border ring, that no board reached.
_UNREACHED, _BORDER = 0.25, 0.5
# Pixels of noise: sharp images give 0.02 to 0.2; blurred corners are shifted by what lies beyond their squares as well.
_SOFT, _BLURRED = 0.35, 0.7
# Share of the views whose corners say that they are blurred.
_MANY = 0.25
_TEMPERING = 5.0
_FEW_VIEWS = 12
# Share of the views with a partner of another camera's name, beyond which these are of two cameras.
_PARTNERS = 0.5


def view_findings(result: CameraCalibrationResult, noise: float | None = None) -> list[Finding]:
    """What the views themselves say, whatever was fitted to them.

    Args:
        result: the calibration.
        noise: of a corner along an axis, px, under a lens that fits; that of the calibration if left out.
    """
    used = result.cam_from_board_rotation.isfinite().all(-1).all(-1)
    rotation, translation = result.cam_from_board_rotation[used], result.cam_from_board_translation[used]
    found = [_order_finding(seen_pixels(result)[used], result.observations), *_pose_findings(rotation, translation)]
    found += [
        _coverage_finding(result.observations),
        _sides_finding(result.observations.names, "doubt"),
        _blur_finding(result.noise if noise is None else noise, _blurred_share(result.observations)),
        _repetition_finding(1.0 if result.hybrid is None else result.hybrid.tempering),
    ]
    if len(rotation) < _FEW_VIEWS:
        found.append(_few_finding(len(rotation)))
    return [finding for finding in found if finding is not None]


def record_findings(record: CalibrationRecord) -> list[Finding]:
    """What the record of a calibration tells of its views, where these themselves are not at hand."""
    found = [_sides_finding(tuple(record.per_view_rms), "stop"), _repetition_finding(record.tempering or 1.0)]
    if record.noise is not None:
        found.append(_blur_finding(record.noise, 0.0))
    if record.views < _FEW_VIEWS:
        found.append(_few_finding(record.views))
    found += [Finding(name="calibration", severity="doubt", text=text, part="lenses") for text in record.warnings]
    return [finding for finding in found if finding is not None]


def _sides_finding(names: Sequence[str], severity: Severity) -> Finding | None:
    """Views whose names are those of two cameras that took them together, as left01 and right01.

    Where the views are at hand, their halves by name tell (`model_findings`), and names alone are a doubt.
    """
    sides = list(names_by_side(names).items())
    for (one, some), (other, others) in itertools.pairwise(sides):
        both = [key for key in some if key in others]
        if 2 * len(both) > _PARTNERS * len(names):
            return Finding(
                name="names",
                severity=severity,
                text=f"{2 * len(both)} of {len(names)} views are named like pairs of two cameras, {some[both[0]]} and "
                f"{others[both[0]]}: images of both in one file",
                action=f"calibrate each camera from its own images, {one} and {other}; if they are of one camera, its "
                "observations tell (kcal report --observations)",
                part="lenses",
            )
    return None


def _few_finding(views: int) -> Finding:
    return Finding(
        name="views",
        severity="doubt",
        text=f"{views} views are few: a wrong one among them could not be noticed",
        action="take 20 to 40 views",
        picture="views",
        part="lenses",
    )


def _order_finding(pixels: Tensor, observations: Observations) -> Finding | None:
    wrong = int(mirrored_views(observations.board.points, pixels).sum())
    if not wrong:
        return None
    some = "all views show" if wrong == len(pixels) else f"{wrong} of {len(pixels)} views show"
    return Finding(
        name="mirrored",
        severity="stop",
        text=f"{some} the board mirrored: the images are flipped (a selfie view, a mirror), or the corners are in "
        "another order than the board's",
        action="switch the mirroring off, or correct the order of the corners, and detect again",
        picture="coverage",
    )


def _pose_findings(rotation: Tensor, translation: Tensor) -> list[Finding]:
    tilts = board_tilts(rotation)
    found = []
    tilted = int((tilts > _TILTED).sum())
    if tilted < _FEWEST_TILTED:
        found.append(
            Finding(
                name="tilt",
                severity="stop",
                text=f"the board faces the camera in {len(tilts) - tilted} of {len(tilts)} views: without tilted views "
                "focal length and distance cannot be told apart",
                action="tilt the board by 30 to 45 degrees in different directions",
                picture="poses",
                part="lenses",
            )
        )
    if (span := roll_span(rotation)) < ROLL_SPAN:
        found.append(
            Finding(
                name="roll",
                severity="doubt",
                text=f"the board was always held the same way up (rolls within {span:.0f}°): its print and the "
                "principal point cannot be told apart",
                action="turn the board by 90 degrees in some views",
                picture="poses",
                part="lenses",
            )
        )
    distance = translation.norm(dim=-1)
    if float(distance.max()) < _DEPTH * float(distance.min()):
        found.append(
            Finding(
                name="depth",
                severity="doubt",
                text=f"the board was always at the same distance ({float(distance.min()):.2g} to "
                f"{float(distance.max()):.2g} m)",
                action="show the board near and far",
                picture="poses",
                part="lenses",
            )
        )
    if not found:
        found.append(
            Finding(
                name="poses",
                severity="fine",
                text=f"tilts up to {float(tilts.max()):.0f}°, rolls within {span:.0f}°, distances "
                f"{float(distance.min()):.2g} to {float(distance.max()):.2g} m",
                picture="poses",
                part="lenses",
            )
        )
    return found


def _coverage_finding(observations: Observations) -> Finding:
    share = unreached_share(observations)
    seen = reached(observations, 96, 64)
    ring = torch.ones_like(seen)
    ring[6:-6, 9:-9] = False
    border = 1.0 - float(seen[ring].double().mean())
    text = f"no board reached {100 * share:.0f} % of the image, and {100 * border:.0f} % of its border"
    if share <= _UNREACHED and border <= _BORDER:
        return Finding(name="coverage", severity="fine", text=text, picture="coverage", part="lenses")
    return Finding(
        name="coverage",
        severity="doubt",
        text=f"{text}: there the camera rests on its lens model alone",
        action="show the board at the borders and in the corners of the image, parts of it outside if need be",
        picture="coverage",
        part="lenses",
    )


def _blurred_share(observations: Observations) -> float:
    """Share of the views whose corners say that they are blurred."""
    stated = observations.covariances()
    if stated is None:
        return 0.0
    spread = (0.5 * stated.diagonal(dim1=-2, dim2=-1).sum(-1)).sqrt().nanmedian(-1).values
    return float((spread > _BLURRED).double().mean())


def _blur_finding(noise: float, share: float) -> Finding | None:
    if noise <= _SOFT and share <= _MANY:
        return None
    blurred = noise > _BLURRED or share > _MANY
    what = f"{100 * share:.0f} % of the views are blurred" if share > _MANY else f"corners scatter by {noise:.2g} px"
    return Finding(
        name="blur",
        severity="stop" if blurred else "doubt",
        text=f"{what}: blurred corners are shifted by what lies next to them, which no error bar knows",
        action="hold board and camera still, focus, use more light or a shorter exposure, and take the views again",
        picture="residuals",
        part="lenses",
    )


def _repetition_finding(tempering: float) -> Finding | None:
    if tempering <= _TEMPERING:
        return None
    return Finding(
        name="unsteady",
        severity="stop",
        text=f"residuals repeat within views ({tempering:.1f} times as much as noise): the board flexes, "
        "several boards were used, or the images are from a moving camera",
        action="use one stiff board, held still, and take the views again",
        picture="views",
        part="lenses",
    )


# Findings about lens model, board and error bars, from what a calibration says against itself.

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


# The verdict on a camera: its error bars, and what its views say against its model, its board and themselves.

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
