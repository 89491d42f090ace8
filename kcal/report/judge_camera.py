"""The verdict on a camera: its error bars, and what its views say against its model, its board and themselves."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

import kcal.calibrate.camera.trust as trust
from kcal.calibrate.camera.advice import ROLL_SPAN, board_tilts, reached, roll_span, unreached_share, what_to_photograph
from kcal.calibrate.camera.checks import mirrored_views
from kcal.calibrate.camera.result import CalibrationOptions, CameraCalibrationResult, Progress
from kcal.calibrate.rig.pairs import names_by_side
from kcal.corners.observations import Observations
from kcal.finding import FAULTS, Finding, Severity, sorted_findings
from kcal.lens.calibration import CalibrationRecord
from kcal.lens.camera import Camera
from kcal.lens.difference import camera_difference
from kcal.lens.uncertainty import image_sigma, paraxial_focal
from kcal.report.verdict import RangeAnswer, Requirement, Verdict, weighed_findings
from kcal.texts import percent_text
from kcal.threads import in_one_thread

# Findings about the views of a calibration: order of corners, tilts, rolls, depth, coverage, blur, number.

# Degrees beyond which a view tells the focal length, and how many views must; and its error, as a share of it, from
# which too little tilt is the reason.
_TILTED, _FEWEST_TILTED, _OPEN = 25.0, 3, 0.02
# Farthest over nearest board.
_DEPTH = 1.3
# Share of the image, and of its border ring, that no board reached.
_UNREACHED, _BORDER = 0.25, 0.5
# Pixels of noise: sharp images give 0.02 to 0.2; blurred corners are shifted by what lies beyond their squares as well.
# Corners that themselves tell of more than the second are blurred.
_SOFT, _BLURRED = 0.35, 0.7
# Share of the views whose corners say that they are blurred.
_MANY = 0.25
_FEW_VIEWS = 12
# Share of the views with a partner of another camera's name, beyond which these are of two cameras.
_PARTNERS = 0.5


def view_findings(result: CameraCalibrationResult, noise: float | None = None) -> list[Finding]:
    """Findings about the views, which do not depend on what was fitted to them.

    Args:
        result: the calibration.
        noise: of a corner along an axis, px, under a lens that fits; that of the calibration if left out.
    """
    seen, used = result.observations, result.cam_from_board_rotation.isfinite().all(-1).all(-1)
    rotation = result.cam_from_board_rotation[used]
    middle = rotation @ result.board_points.mean(0) + result.cam_from_board_translation[used]
    found = [
        _order_finding(trust.seen_pixels(result)[used], seen),
        *_pose_findings(result.camera, rotation, middle),
        _coverage_finding(seen),
        _sides_finding(seen.names, "doubt"),
        _blur_finding(result.noise if noise is None else noise, _blurred_share(seen)),
        _few_finding(len(rotation)),
    ]
    return [finding for finding in found if finding is not None]


def record_findings(record: CalibrationRecord) -> list[Finding]:
    """What the record of a calibration tells of its views, where these themselves are not at hand."""
    found = [_sides_finding(tuple(record.per_view_rms), "stop")]
    if record.noise is not None:
        found.append(_blur_finding(record.noise, 0.0))
    found += [_few_finding(record.views), *record.findings]
    return [finding for finding in found if finding is not None]


def _sides_finding(names: Sequence[str], severity: Severity) -> Finding | None:
    """Views whose names are those of two cameras that took them together, as left01 and right01.

    Where the views are at hand, their halves by name tell (`model_findings`), and names alone are a doubt.
    """
    for (one, some), (other, others) in itertools.pairwise(names_by_side(names).items()):
        both = [key for key in some if key in others]
        if 2 * len(both) > _PARTNERS * len(names):
            text = (
                f"{2 * len(both)} of {len(names)} views are named like pairs of two cameras, {some[both[0]]} and "
                f"{others[both[0]]}: images of both in one file"
            )
            action = (
                f"calibrate each camera from its own images, {one} and {other}; if they are of one camera, its "
                "observations tell (kcal report --observations)"
            )
            return Finding("names", severity, text, action)
    return None


def _few_finding(views: int) -> Finding | None:
    if views >= _FEW_VIEWS:
        return None
    text = f"{views} views are few: a wrong one among them could not be noticed"
    return Finding("views", "doubt", text, "take 20 to 40 views")


def _order_finding(pixels: Tensor, observations: Observations) -> Finding | None:
    wrong = int(mirrored_views(observations.board.points, pixels).sum())
    if not wrong:
        return None
    some = "all views show" if wrong == len(pixels) else f"{wrong} of {len(pixels)} views show"
    text = (
        f"{some} the board mirrored: the images are flipped (a selfie view, a mirror), or the corners are in "
        "another order than the board's"
    )
    action = "switch the mirroring off, or correct the order of the corners, and detect again"
    return Finding("mirrored", "stop", text, action)


def _pose_findings(camera: Camera, rotation: Tensor, middle: Tensor) -> list[Finding]:
    """Tilts, rolls and distances of boards, from their rotations and middles (V, 3)."""
    tilts = board_tilts(rotation)
    found = []
    known = None if camera.calibration is None else camera.calibration.sigma
    # Not known; or held, and so not asked of tilts.
    focal_error = math.inf if known is None else (known.get("fx") or 0.0) / float(camera.focal[0])
    tilted = int((tilts > _TILTED).sum())
    if tilted < _FEWEST_TILTED and focal_error > _OPEN:
        text = (
            f"the board is tilted by more than {_TILTED:.0f}° in {tilted} of {len(tilts)} views, by "
            f"{float(tilts.max()):.0f}° at most: the focal length is known only to "
            + (f"±{100 * focal_error:.2g} %" if math.isfinite(focal_error) else "an error that nobody can tell")
        )
        found.append(Finding("tilt", "stop", text, "tilt the board by 30 to 45 degrees in different directions"))
    if (span := roll_span(rotation)) < ROLL_SPAN:
        text = (
            f"the board was always held the same way up (rolls within {span:.0f}°): its print and the "
            "principal point cannot be told apart"
        )
        found.append(Finding("roll", "doubt", text, "turn the board by 90 degrees in some views"))
    near, far = map(float, middle.norm(dim=-1).aminmax())
    if far < _DEPTH * near:
        text = f"the board was always at the same distance ({near:.2g} to {far:.2g} m)"
        found.append(Finding("depth", "doubt", text, "show the board near and far"))
    if not found:
        text = f"tilts up to {tilts.max():.0f}°, rolls within {span:.0f}°, distances {near:.2g} to {far:.2g} m"
        found.append(Finding("poses", "fine", text))
    return found


def _coverage_finding(observations: Observations) -> Finding:
    share = unreached_share(observations)
    seen = reached(observations, 96, 64)
    ring = torch.ones_like(seen)
    ring[6:-6, 9:-9] = False
    border = 1.0 - float(seen[ring].double().mean())
    text = f"no board reached {percent_text(share)} of the image, and {percent_text(border)} of its border"
    if share <= _UNREACHED and border <= _BORDER:
        return Finding("coverage", "fine", text)
    action = "show the board at the borders and in the corners of the image, parts of it outside if need be"
    return Finding("coverage", "doubt", f"{text}: there the camera rests on its lens model alone", action)


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
    what = f"{100 * share:.0f} % of the views are blurred" if share > _MANY else f"corners scatter by {noise:.2g} px"
    text = f"{what}: blurred corners are shifted by what lies next to them, which no error bar knows"
    action = "hold board and camera still, focus, use more light or a shorter exposure, and take the views again"
    return Finding("blur", "doubt", text, action)


# Findings about lens model, board and error bars, from what a calibration says against itself.

# Chance by which halves may differ. Error bars from half of the views are approximate: at the higher level, one of 30
# clean captures was doubted (tuning seeds of scripts/check/verdict.py), where wrong models reach 1e-7 and less. At that
# level residuals must also have patterns, or halves predict each other worse than halves that are alike by this factor:
# 1.1 and 1.2 for OpenCV's left and right images, 1.9 for both in one file.
_CHANCE, _LIKELY, _APART = 1e-6, 1e-3, 1.5
# Chance below which a difference is told with its figures, without a word of agreement.
_AGREE = 0.01
# Correlation of neighboring residuals: -0.06 to 0.02 in clean captures, 0.4 and more with a wrong lens or board.
_NEIGHBORS = 0.12
# Averages of residuals over parts of the image, mean squares over what noise leaves: below 1.2 in clean captures.
_IMAGE = 2.5
# Standard deviations by which a board bends, or a pupil moves, before it is named.
_SURE = 5.0
# RMS of halves over that of all views, below which these are not of one camera: 0.93 and more in captures of one.
_OWN = 0.8
# A half of few views may predict badly though its error bars say so. More than a plain lens is a fault.
_PLAIN = 1.1
# Mean squares of averages of residuals over parts of the image beyond which the lens is wrong, whatever else is: 11 and
# more with wrong lenses, at most 2.5 with bent boards and moving pupils.
_LENS = 5.0


def model_findings(
    result: CameraCalibrationResult, options: CalibrationOptions, found: trust.Examination
) -> tuple[list[Finding], float]:
    """Findings about lens model, board and error bars, and the px RMS by which the camera errs beyond its error bars.

    A fault is what was measured: halves of the views, or a reference, that differ by more than the error bars state, or
    a plain lens that predicts other views better. Residuals that are not noise are a note: error bars allow for them.
    """
    structure = found.structure
    patterns = structure.neighbors > _NEIGHBORS or structure.image > _IMAGE
    apart = _far_halves(found.halves, patterns)
    beyond = max((trust.unexplained(half.difference, _LIKELY) for half in apart), default=0.0)
    # Names may tell two cameras apart of which every other view is the one: they are the better reason then.
    worst = next((half for half in apart if not half.alike and half.own < _OWN * result.rms), next(iter(apart), None))
    against = None if worst is None else _apart_finding(result, found.halves, worst, patterns, structure)
    if found.model is not None and found.reference is not None:
        named = _against_reference(result, options, found, found.model.rms)
        certain = named is not None and named.name in ("board", "pupil")
        wrong = found.model.rms if certain or patterns else trust.unexplained(found.model)
        beyond = max(beyond, wrong)
        if named is None and wrong:
            text = (
                f"the lens model {result.camera.model} does not fit this lens: it differs by "
                f"{found.model.rms:.2g} px from one that does"
            )
            named = Finding("model", "doubt", text, "calibrate with the default lens (--model hybrid)", FAULTS)
        against = against if against is not None and against.name == "changed" else named or against
    findings = [] if against is None else [against]
    if patterns and against is None:
        findings.append(_patterns_finding(found))
    if alike := [half for half in found.halves if half.alike]:
        findings.append(_prediction_finding(alike[0], found.plain))
    if found.failures or not found.halves:
        text = f"the error bars could not be checked by halves of the views: {'; '.join(found.failures)}"
        findings.append(Finding("halves", "doubt", text, "take more views"))
    elif against is None:
        agree = _halves_agree(found.halves)
        ratios = ", ".join(
            f"{half.difference.ratio or 0.0:.1f} times (p {half.difference.probability or 0.0:.1g}, {half.label})"
            for half in found.halves
        )
        text = (
            f"cameras from halves of the views {'agree: they ' if agree else ''}differ by "
            f"{ratios} what the error bars predict{'' if agree else ': these may be too small'}"
        )
        findings.append(Finding("halves", "fine" if agree else "doubt", text, "" if agree else "take more views"))
    return findings, beyond


def _halves_agree(halves: Sequence[trust.HalvesDifference]) -> bool:
    return all((half.difference.probability or 0.0) >= _AGREE for half in halves)


def fault_of_views(
    result: CameraCalibrationResult, options: CalibrationOptions, progress: Progress = lambda _: None
) -> Finding | None:
    """What a calibration's own views say against its error bars, if it moves the camera beyond these; else None."""
    findings, beyond = model_findings(result, options, trust.examine(result, options, progress))
    fault = next((finding for finding in findings if finding.part == FAULTS), None)
    return fault if fault is not None and (beyond > 0.0 or fault.severity == "stop") else None


def _patterns_finding(found: trust.Examination) -> Finding:
    """Residuals that are not noise, where no harm of it was measured."""
    structure = found.structure
    what = f"averages over parts of the image are {math.sqrt(structure.image):.1f} times what noise leaves"
    if structure.neighbors > _NEIGHBORS:
        what = f"neighboring corners have a correlation of {structure.neighbors:.2f}"
    agree = bool(found.halves) and _halves_agree(found.halves)
    checked = "halves of the views do not show that the error bars allow for it"
    if agree:
        checked = "halves of the views agree within the error bars, which allow for it"
    action = "for smaller error bars use a flat, stiff board on a stand, with fixed focus and zoom"
    text = f"residuals are not only noise: {what}; {checked}"
    return Finding("patterns", "note" if agree else "doubt", text, action)


def _prediction_finding(half: trust.HalvesDifference, plain: trust.PlainLens | None) -> Finding:
    """How well one half of the views predicts the other, beside fits and a plain lens."""
    ratio = half.held_out / half.own
    text = (
        f"the camera from one half of the views predicts the corners of the other half to {half.held_out:.2g} px RMS, "
        f"{ratio:.2f} times what is left where they are fitted"
    )
    if ratio <= trust.PREDICTED:
        return Finding("prediction", "fine", text)
    better = plain is not None and plain.own > _PLAIN * plain.held_out
    if plain is not None:
        text += (
            f". With poses alone refitted, a plain lens ({plain.model}) predicts them "
            f"{'better' if better else 'no better'}: {plain.held_out:.2g} px, this lens {plain.own:.2g} px"
        )
    if plain is None or not better:
        action = "take more views, all over the image and at several distances, with one flat, stiff board"
        return Finding("prediction", "doubt" if plain is None else "note", text, action)
    action = f"use --model {plain.model}, or take more views all over the image and at several distances"
    return Finding("prediction", "stop", text, action, part=FAULTS)


def _far_halves(halves: Sequence[trust.HalvesDifference], patterns: bool) -> list[trust.HalvesDifference]:
    """Halves that differ by more than their error bars state, the farthest first.

    Less is proof enough where something else says so too: `patterns` in the residuals, or that halves which are not
    alike by construction predict each other worse than those that are.
    """
    alike = min((half.held_out for half in halves if half.alike), default=math.inf)

    def far(half: trust.HalvesDifference) -> float:
        also = patterns or (not half.alike and half.held_out > _APART * alike)
        return trust.unexplained(half.difference, _LIKELY if also else _CHANCE)

    return sorted((half for half in halves if far(half)), key=far, reverse=True)


def _apart_finding(
    result: CameraCalibrationResult,
    halves: Sequence[trust.HalvesDifference],
    half: trust.HalvesDifference,
    patterns: bool,
    structure: trust.ResidualStructure,
) -> Finding:
    """Error bars that halves contradict, and what the tests say of the cause.

    Halves in time or by name are of two cameras where each fits much better alone. Otherwise halves that are alike
    tell whether something changed from the one half to the other, or the model does not fit.
    """
    difference = half.difference
    how = (
        f"{half.label}: two cameras that differ by {difference.rms:.2g} px, {difference.ratio:.1f} times what their "
        f"error bars predict (p {difference.probability:.1g})"
    )
    alike = next((one for one in halves if one.alike and one is not half), None)
    if not half.alike and half.own < _OWN * result.rms:
        text = (
            f"{how}, and each fits better alone (RMS {half.own:.2g} px, together {result.rms:.2g} px): images of "
            "two cameras in one file, or focus, zoom or image stabilization changed in between"
        )
        return Finding("changed", "stop", text, "calibrate from the images of one camera with fixed focus and zoom")
    if alike is not None and not half.alike and not trust.unexplained(alike.difference, _CHANCE):
        cause = (
            f". With {alike.label} it is {alike.difference.ratio:.1f} times, and the halves fit hardly better alone "
            f"(RMS {half.own:.2g} px, together {result.rms:.2g} px): it is one camera, and the board's shape, or how "
            "it was held, changed from one half to the other"
        )
    elif patterns:
        cause = f", and residuals are not noise (correlation {structure.neighbors:.2f}): lens model or board do not fit"
    else:
        cause = ": lens model or board do not fit"
    action = "take the views again with one flat, stiff board on a stand, tilted and rolled in mixed order"
    return Finding("halves", "doubt", f"{how}{cause}. The error bars are too small", action, FAULTS)


def _against_reference(
    result: CameraCalibrationResult, options: CalibrationOptions, found: trust.Examination, far: float
) -> Finding | None:
    """What the reference finds that was left out: the board's shape, the pupil's movement, or another lens."""
    plain = found.structure.image < _LENS
    if plain and (bends := _board_fault(result, options, found.reference)):
        text = f"{bends}, but was taken as flat and exact: points at infinity are wrong by {far:.2g} px"
        action = "calibrate with the default lens and --board printed, which measures the board, or use a stiffer board"
        return Finding("board", "doubt", text, action, FAULTS)
    if plain and (pupil := _pupil_fault(result, found.reference)):
        text = f"{pupil}, which {result.camera.model} does not have: points at infinity are off by {far:.2g} px"
        action = "calibrate with the default lens (--model hybrid), or show the board from farther away"
        return Finding("pupil", "doubt", text, action, FAULTS)
    alike = plain and result.hybrid is None and found.model is not None and not trust.unexplained(found.model)
    if alike and not _is_better(found.reference, result) and far > _image_rms(result.camera):
        text = (
            f"another lens model fits these views as well as {result.camera.model} and differs by {far:.2g} px, "
            "most where no board was"
        )
        action = "calibrate with the default lens (--model hybrid), and show the board at the borders of the image"
        return Finding("model", "doubt", text, action, FAULTS)
    return None


def _is_better(reference: CameraCalibrationResult | None, result: CameraCalibrationResult) -> bool:
    """Whether the reference explains the corners better than the camera does."""
    return reference is not None and reference.noise < 0.97 * result.noise


def _board_fault(
    result: CameraCalibrationResult, options: CalibrationOptions, reference: CameraCalibrationResult | None
) -> str:
    """How the board differs from the flat one that was assumed; empty where it does not, or was measured."""
    board = None if reference is None else reference.measured_board
    measured = options.hybrid and options.board != "exact"
    if reference is None or board is None or measured or not bool(board.amplitudes.any()):
        return ""
    better = _is_better(reference, result)
    if board.bending.value > _SURE * board.bending.sigma and better and not options.board_warp:
        return f"the board bends by {1e3 * board.bending.value:.2g} mm"
    if abs(board.stretch.value) > _SURE * board.stretch.sigma and better:
        return f"the board's squares are {100 * abs(board.stretch.value):.2g} % longer one way than the other"
    return ""


def _pupil_fault(result: CameraCalibrationResult, reference: CameraCalibrationResult | None) -> str:
    """How the entrance pupil moves, where the model has none; empty where it does not."""
    if reference is None or result.hybrid is not None:
        return ""
    brief = trust.summarize(reference)
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
    examination: trust.Examination | None = None,
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
        (True, ['depth', 'coverage', 'views', 'patterns', 'halves', 'motion', 'roll'])
    """
    options = options or CalibrationOptions()
    examination = examination or trust.examine(result, options, progress)
    against, beyond = model_findings(result, options, examination)
    # Faults of the views come first: without tilts or with blur the model looks wrong too.
    reference = examination.reference or result
    found = [*view_findings(result, min(result.noise, reference.noise)), *against]
    # That views show the board upright says more than that they roll it little.
    told = {finding.name for finding in result.findings} & {"roll"}
    found = [*(finding for finding in found if finding.name not in told), *result.findings]
    if stored is not None:
        other, apart = other_views(stored, result)
        found, beyond = [*other, *found], max(beyond, apart)
    # What another model that fits as well sees elsewhere is uncertain too, above all where no board was; what is known
    # to be wrong of it counts as a fault.
    elsewhere = 0.0 if examination.model is None else max(examination.model.rms**2 - beyond**2, 0.0)
    sigma = max(_image_rms(result.camera), math.sqrt(elsewhere))
    answers = _camera_answers(result.camera, requirements, sigma, beyond, baseline, mark_sigma)
    rotation = result.cam_from_board_rotation
    contradicted = any(finding.name == "halves" and finding.part == FAULTS for finding in against)
    return Verdict(
        subject=subject,
        answers=answers,
        findings=weighed_findings(found, answers, wrong=contradicted or beyond > _image_rms(result.camera)),
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
        text = "the camera has no error bars: nobody can say how wrong its directions are"
        found.append(Finding("error-bars", "stop", text, "calibrate it with kcal calibrate"))
    return Verdict(
        subject=subject,
        answers=_camera_answers(camera, requirements, sigma, 0.0, baseline, mark_sigma),
        findings=sorted_findings(found),
        basis=_BASIS.format(baseline, mark_sigma),
    )


def stored_findings(camera: Camera) -> list[Finding]:
    """What a camera's file tells of its calibration, and that its views were not looked at."""
    record = camera.calibration.record if camera.calibration else None
    text = "the views were not looked at, and a camera file alone cannot show that its lens model or board is wrong"
    action = "give the observations too (--observations FILE, for a rig those of left and of right)"
    unseen = Finding("halves", "doubt", text, action)
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
    action = "give the observations that it was calibrated from, or calibrate it again"
    told = record_findings(record) if record is not None and missing else []
    other = Finding("other-views", "doubt" if found.same else "stop", text, action)
    return [other, *told], trust.unexplained(found)


def _image_rms(camera: Camera) -> float:
    """RMS over the image of the standard deviation of points at infinity, px; infinite without error bars."""
    known = camera.calibration
    if known is None or known.known(camera.params.detach()) is None:
        return math.inf
    sigma = image_sigma(camera)
    sigma = sigma[sigma.isfinite()]
    return float(sigma.square().mean().sqrt()) if len(sigma) else math.inf


def _camera_answers(
    camera: Camera, needs: Sequence[Requirement], sigma: float, beyond: float, baseline: float, mark_sigma: float
) -> tuple[RangeAnswer, ...]:
    """Ranges of targets by two such cameras: Z² / (f B) for each pixel of disparity, which both cameras spoil."""
    answers = []
    pixels = {"marks": mark_sigma, "lenses": sigma, FAULTS: beyond}
    for need in needs:
        slope = math.sqrt(2.0) * need.distance**2 / (paraxial_focal(camera).mean[0] * baseline)
        answers.append(RangeAnswer(requirement=need, parts={name: slope * one for name, one in pixels.items()}))
    return tuple(answers)
