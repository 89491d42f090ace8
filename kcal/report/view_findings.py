"""Findings about the views of a calibration: order of corners, tilts, rolls, depth, coverage, blur, number."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.camera.advice import ROLL_SPAN, board_tilts, reached, roll_span, unreached_share
from kcal.calibrate.camera.checks import mirrored_views
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.camera.trust import seen_pixels
from kcal.calibrate.rig.pairs import names_by_side
from kcal.corners.observations import Observations
from kcal.lens.calibration import CalibrationRecord
from kcal.report.verdict import Finding, Severity

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
