"""What to doubt of a finished calibration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.camera.advice import roll_findings
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.hybrid.fit import HybridFit, pixels_are_square
from kcal.calibrate.problem.parameters import GaussianPrior, Term
from kcal.calibrate.problem.state import FELT, FEW, LARGEST, BoardState
from kcal.errors import DegenerateError, InputError
from kcal.finding import Finding
from kcal.lens.camera import Camera
from kcal.lens.projection import pupil_depth
from kcal.lens.uncertainty import paraxial_focal
from kcal.solve.lm import SolverStatus
from kcal.texts import percent_text

# Warnings about how views were taken: motion while rows were read, and images that were stretched.

# Views in which the board bends by so many times what is typical are named, if they are no more than this share.
_BENT, _SOME, _NAMED = 2.0, 0.5, 5
# A share of the largest motion, from which it is at its limit.
_LIMIT = 0.9
# Meters: of a smaller distance a hand moves by that share.
_NEAR = 0.2


def moves_beyond_hands(fit: HybridFit | None) -> bool:
    """Whether the motion of views is at its limit: it then stands for something else, unless the board is near."""
    if fit is None or fit.readout is None or fit.motion_sigma is None:
        return False
    turn, shift, turn_twice, shift_twice = fit.motion_sigma
    shifts = (shift, shift_twice) if fit.readout.distance > _NEAR else ()
    return max(turn, turn_twice, *shifts) > _LIMIT * LARGEST


def motion_findings(fit: HybridFit) -> list[Finding]:
    """A doubt where the camera or the board moved while an image was read, with how much that moved corners."""
    if fit.motion_sigma is None or fit.readout is None:
        return []
    if moves_beyond_hands(fit):
        text = (
            "while an image is read, views move by more than any hand does: these motions stand for something else "
            "(wrong corners, a board that bends, a cropped or stabilized video), and error bars may be far too small"
        )
        return [Finding("motion", "doubt", text, "look at the views that fit worst, and photograph a board on a stand")]
    lines = "column" if fit.readout.columns else "row"
    moved = fit.motion_sigma.moved(float(fit.state.parameters[0]), fit.readout.reach(fit.board_points))
    if moved < FELT * fit.sigma:
        return []
    views = len(fit.state.motion)
    if views < FEW:
        text = (
            f"{views} views hardly tell whether the camera or the board moved while {lines}s were read (rolling "
            f"shutter): error bars allow for a hand, some {moved:.1f} px from the first {lines} to the last, and may "
            "still be too small"
        )
        action = f"take {FEW} views or more; or, if both stood still, leave motion out (--without motion)"
    else:
        text = (
            f"the camera or the board moved while {lines}s were read (rolling shutter), by some {moved:.1f} px from "
            f"the first {lines} to the last: this is taken out, and error bars allow for it"
        )
        action = "put both on a stand, or take the still moments of a video, for smaller error bars"
    return [Finding("motion", "doubt", text, action)]


def bending_findings(names: Sequence[str], fit: HybridFit) -> list[Finding]:
    """A doubt where the board bends from view to view, with how much, and in which views most."""
    if fit.bends is None or fit.relative is None:
        return []
    # RMS of the corners in each view, millimeters; NaN where a view was left out.
    height, count = 1e3 * fit.bends.square().mean(-1).sqrt(), int(fit.relative.isfinite().sum())
    clear = [i for i in height.nan_to_num(0.0).argsort(descending=True).tolist() if float(fit.relative[i]) > _BENT]
    named = ", ".join(names[i] for i in clear[:_NAMED]) + (", ..." if len(clear) > _NAMED else "")
    where = f", most in {len(clear)} of {count} views ({named})" if 0 < len(clear) <= _SOME * count else ""
    text = (
        f"the board bends from view to view, by {float(height.nanmedian()):.2g} mm (RMS of its corners) in a typical "
        f"view and by up to {float(height.nan_to_num(0.0).max()):.2g} mm{where}: this is taken out, and error bars "
        "allow for it"
    )
    return [Finding("bending", "doubt", text, "mount the board on a stiff plate for smaller error bars")]


def measured_aspect(fit: HybridFit) -> tuple[float, float]:
    """f_y / f_x of the base projection, and its standard deviation."""
    fx, fy = fit.state.parameters[:2].tolist()
    slope = torch.zeros(len(fit.state.parameters), dtype=torch.float64)
    slope[0], slope[1] = -fy / fx**2, 1.0 / fx
    return fy / fx, float(slope @ fit.covariance @ slope) ** 0.5


def pixel_findings(fit: HybridFit) -> list[Finding]:
    """A doubt where pixels are not square."""
    if fit.square:
        return []
    aspect, sigma = measured_aspect(fit)
    if pixels_are_square((aspect - 1.0) / sigma):
        # The rounds said so, and error bars with amplitudes as they are to be expected do not.
        return []
    action = (
        "was the image or video resized, or taken in an anamorphic mode? The camera is right for images of this size "
        "and shape only: photograph boards and targets in the same mode"
    )
    return [Finding("pixels", "doubt", f"pixels are not square: f_y / f_x = {aspect:.4f} ± {sigma:.4f}", action)]


# Share beyond which columns of a board that are farther apart than its rows are no error of the print, and in standard
# deviations.
_NO_PRINT, _UNEQUAL = 0.02, 5.0


def spacing_findings(result: CameraCalibrationResult, refused: bool = False) -> list[Finding]:
    """A doubt where columns of the board are not as far apart as its rows; or why a lens is refused for it."""
    board, measured = result.observations.board, result.measured_board
    if measured is None:
        return []
    value, sigma = measured.stretch
    if abs(value) < max(_NO_PRINT, _UNEQUAL * sigma):
        return []
    rows = 1e3 * board.square
    what = "tags of the board are {} mm wide and {} mm high"
    if board.pattern != "aprilgrid":
        what = "columns of the board are {} mm apart, and its rows {} mm"
    apart = what.format(f"{rows * (1.0 + value):.4g}", f"{rows:.4g}")
    allows = "the camera allows for this, and all distances are as right as that of the rows"
    if refused:
        allows = "only the default lens with a printed board allows for this"
    unsure = ""
    if roll_findings(result.cam_from_board_rotation):
        unsure = "; or else pixels are not square, which views that show the board upright hardly tell: turn it by 90° "
        unsure += "for a third of the views"
    text = f"{apart} ({100 * value:+.2f} ± {100 * sigma:.2g} %), but one length was given for both: {allows}"
    action = (
        "measure both with a ruler, give the distance of the rows as --square, and print at 100 %, not fitted to the "
        f"page{unsure}"
    )
    return [Finding("board", "doubt", text, action)]


# Say what a fitted movement of the entrance pupil stands for, where it is larger than any lens has.
#
# A hybrid lens may move its entrance pupil, and the views tell how far. Only near points show that, so that whatever
# errs with the distance of the board can pass for it: a board of another size, one that bends from view to view,
# motion.

# Meters per square radian. Traced lenses of a few millimeters of focal length move by some 3 mm, and a full-frame lens
# of 150 degrees by 6 mm: ten times as much is no lens's.
_GLASS = 10 * 3e-3
# Meters. At small angles long lenses move by more than that rule says, and by less than this.
_LEAST = 10e-3
# Of chance, in standard deviations: what glass does not have needs less proof than what it may have.
_SURE = 2.0


class CornerPupil(NamedTuple):
    """The entrance pupil of the image's farthest corner.

    Attributes:
        depth: meters by which it lies before that of the middle.
        sigma: its standard deviation.
        angle: of that corner off the optical axis, radians.
    """

    depth: float
    sigma: float
    angle: float


def corner_pupil(camera: Camera, covariance: Tensor) -> CornerPupil | None:
    """The entrance pupil of a hybrid camera; None for other lenses.

    Args:
        camera: the camera.
        covariance: (5 + P, 5 + P) of its parameters.
    """
    if not camera.model.hybrid:
        return None
    rays, valid = camera.unproject(camera.grid(17, 13).reshape(-1, 2))
    if not bool(valid.any()):
        return None
    angle = torch.acos(rays[valid][:, 2].clamp(-1.0, 1.0)).max()
    port = camera.model.hybrid.port
    place = [i for i, name in enumerate(camera.names) if name.startswith("pupil")]
    slope = torch.stack([angle ** (2 * k) for k in range(1, 1 + len(place))])
    depth = pupil_depth(angle[None] ** 2, camera.params.detach()[5:], port)
    variance = slope @ covariance[place][:, place] @ slope
    return CornerPupil(float(depth[0]), math.sqrt(max(float(variance), 0.0)), float(angle))


def pupil_findings(camera: Camera, covariance: Tensor) -> list[Finding]:
    """A doubt where the entrance pupil moves by more than ten times what glass does, and by more than chance.

    Args:
        camera: the camera.
        covariance: (5 + P, 5 + P) of its parameters.
    """
    pupil = corner_pupil(camera, covariance)
    if pupil is None:
        return []
    if camera.model.hybrid and camera.model.hybrid.port:
        return [_port_finding(camera, covariance, pupil)]
    most = max(_LEAST, _GLASS * pupil.angle**2)
    if not abs(pupil.depth) > max(most, _SURE * pupil.sigma):
        return []
    text = (
        f"the fitted entrance pupil moves by {1e3 * abs(pupil.depth):.0f} ± {1e3 * pupil.sigma:.0f} mm, which no lens "
        f"does ({1e3 * most:.0f} mm at most, {math.degrees(pupil.angle):.0f}° off the axis): it stands for an error "
        "that changes with the board's distance: a wrong size of the squares, a board that flexes, motion, or a focal "
        "length that too few tilts tell"
    )
    action = "measure the squares, and photograph a stiff board at rest, tilted by 30 to 45 degrees in all directions"
    return [Finding("pupil", "doubt", text, action)]


# Index of refraction of water.
_WATER = 1.333


def _port_finding(camera: Camera, covariance: Tensor, pupil: CornerPupil) -> Finding:
    """What a flat port is like, in numbers."""
    p, q = camera.coefficients.detach()[4:6].tolist()
    slope, place = math.hypot(p, q), [camera.names.index(name) for name in ("port_x", "port_y")]
    along = torch.tensor([p, q], dtype=torch.float64) / max(slope, 1e-12)
    tilt, sigma = (math.degrees(x) for x in (math.atan(slope), math.sqrt(along @ covariance[place][:, place] @ along)))
    inside = 1.0 - (_WATER * math.sin(pupil.angle)) ** 2
    text = (
        f"rays towards the image's corners start {-1e3 * pupil.depth:.1f} ± {1e3 * pupil.sigma:.1f} mm behind the "
        "central ones, which no lens does: a flat port is fitted"
    )
    if inside > 0:
        recedes = _WATER * (math.cos(pupil.angle) / math.sqrt(inside) - 1.0)
        gap, spread = (1e3 * x / recedes for x in (-pupil.depth, pupil.sigma))
        text += f", in water with {gap:.0f} ± {spread:.0f} mm of air behind it"
    action = (
        "use the camera in the same water; without a port, measure the squares, and photograph a stiff board at rest, "
        "tilted by 30 to 45 degrees in all directions"
    )
    return Finding("port", "doubt", f"{text}, its normal {tilt:.1f} ± {sigma:.1f}° off the camera's axis", action)


# Checks of a finished calibration.

# Another solution with a χ² higher by less than this cannot be excluded: 14 parameters more gain as much by chance.
_CLOSE_RIVAL = 25.0
# Mean square of the differences from priors, in their standard deviations, beyond which the data contradict them.
_CONTRADICTION = 3.0
# Tempering that chance and rounding do not explain: it is 1 on simulated captures, 2.2 on the wide lens's.
REPEATING = 2.0
# Times the noise of its corners beyond which the RMS of a fit shows that it did not end: it is 0.93 to 1.0 on captures.
_ENDED = 2.0
# Times what corners state of themselves from which the RMS is not of their noise: 1.3 to 8 on most captures that
# strangers made, 14 and 20 on the worst two.
_NOT_OF_CORNERS = 30.0
# Of the principal point, in standard deviations of its prior.
_FAR_CENTER = 3.0
NO_ERROR_BARS = Finding(
    "open", "doubt", "no error bars: σ cannot be computed, because a corner lies where the lens model folds",
    "choose a smaller model",
)  # fmt: skip


def dispersion_findings(model: str, dispersion: float) -> list[Finding]:
    """A note where error bars of a parametric model are widened much because residuals repeat within views."""
    if dispersion <= REPEATING:
        return []
    text = (
        f"residuals repeat within views (tempering {dispersion:.1f}, where noise alone gives 1): the board bends, "
        f"something moved, or the lens is not quite {model}; error bars are {math.sqrt(dispersion):.1f} times as wide "
        "as noise alone makes them"
    )
    return [Finding("patterns", "note", text, "calibrate with the default lens, which allows for all of these")]


def prior_findings(terms: Sequence[Term], state: BoardState, noise: float) -> list[Finding]:
    """A doubt where parameters differ from their priors by much more than the priors allow.

    Args:
        terms: the priors among them are checked.
        state: the solution.
        noise: pixels, in proportion to which the priors counted.
    """
    values = torch.cat([state.parameters, state.board])
    rows = [term.rows(values)[-1] for term in terms if isinstance(term, GaussianPrior)]
    squared = sum(float((row / noise).square().sum()) for row in rows)
    count = sum(len(row) for row in rows)
    if squared <= _CONTRADICTION * count:
        return []
    away = (squared / count) ** 0.5
    text = f"the views contradict the priors: the parameters differ from them by {away:.1f} standard deviations"
    return [Finding("priors", "doubt", text, "give wider priors, for a strong lens a larger weak prior or none")]


def rival_findings(
    camera: Camera,
    sigma: Mapping[str, float | None],
    rivals: Sequence[tuple[float, BoardState]],
    cost: float,
    residual_count: int,
) -> list[Finding]:
    """A doubt where another solution, of (cost, state), fits almost as well and lies outside the error bars."""
    variance = max(2.0 * cost / residual_count, 1e-300)
    here = dict(zip(camera.names, camera.params.tolist(), strict=True))
    for other, state in rivals:
        if not 2.0 * (other - cost) / variance < _CLOSE_RIVAL:
            continue
        there = dict(zip(camera.names, state.parameters.tolist(), strict=True))
        apart = {
            name: there[name] - here[name]
            for name in ("fx", "fy", "cx", "cy")
            if abs(there[name] - here[name]) > max(1.0, 4.0 * (sigma.get(name) or 0.0))
        }
        if apart:
            rms = (2.0 * variance * other / cost) ** 0.5
            where = ", ".join(f"{name} {shift:+.1f} px" for name, shift in apart.items())
            text = f"another solution fits almost as well (RMS {rms:.4f} px) with {where}"
            action = "choose a smaller model or add views"
            return [Finding("model", "doubt", f"{text}: do not trust this model's parameters", action)]
    return []


def check_end(fit: HybridFit) -> None:
    """Raise `InputError` where residuals are far larger than the noise that error bars are made of."""
    noise = math.sqrt(2.0) * fit.sigma / math.sqrt(fit.tempering)
    if not fit.weighted_rms < _ENDED * noise:
        raise InputError(
            f"the fit ended before it reached its solution: RMS {fit.weighted_rms:.3g} px, where its error bars assume "
            f"{noise:.3g} px; look at the views that fit worst, leave them out (--reject), or give the focal length "
            "roughly (--focal, --fov)"
        )


def hybrid_findings(fit: HybridFit) -> list[Finding]:
    """Doubts about the evidence: residuals that repeat within views, a principal point far from the middle."""
    found = []
    if fit.tempering > REPEATING:
        text = (
            f"residuals repeat within views (tempering {fit.tempering:.1f}, where noise alone gives 1): blur, or what "
            "neither motion nor bending of the board explains; error bars are widened for it"
        )
        found.append(Finding("patterns", "doubt", text, "use a stand and a short exposure"))
    off = (fit.state.parameters[2:4] - fit.families.mean[1:3]).norm() / fit.families.log_unit[1].exp()
    if float(off) > _FAR_CENTER:
        cx, cy = (float(value) for value in fit.state.parameters[2:4])
        text = f"the principal point ({cx:.0f}, {cy:.0f}) is far from the middle of the image"
        action = "give images that are not cropped, and turn the board by 90 degrees in a third of the views"
        found.append(Finding("center", "doubt", text, action))
    return found


def outlier_findings(names: Sequence[str], residuals: Tensor, strays: Tensor, more: str = "") -> list[Finding]:
    """A doubt that names the worst of corners that are off.

    Args:
        names: of the views.
        residuals: (V, N, 2), NaN where not seen.
        strays: (V, N) as of `kcal.calibrate.camera.checks.stray_corners`.
        more: what is said where the lens may be to blame.
    """
    if not bool(strays.any()):
        return []
    count = int(strays.sum())
    length = residuals.nan_to_num(0.0).norm(dim=-1)
    view, corner = divmod(int(length.argmax()), length.shape[1])
    text = (
        f"{count} of {int(residuals.isfinite().all(-1).sum())} corners are farther off than noise explains, corner "
        f"{corner} of view {names[view]} by {float(length.max()):.2f} px"
    )
    return [Finding("corners", "doubt", text, f"look at them, and leave wrong ones out (--reject){more}")]


def general_findings(
    names: Sequence[str],
    camera: Camera,
    rms: float,
    per_view: Tensor,
    lost: Sequence[str],
    status: SolverStatus,
    stated: Tensor | None = None,
) -> list[Finding]:
    """Doubts about the solver, the RMS, parameters that are not determined, and folds of the lens.

    Args:
        names: of the views.
        camera: the calibrated camera.
        rms: over all corners, pixels.
        per_view: (V,) likewise.
        lost: names of parameters that the views do not determine.
        status: of the solver.
        stated: (..., 2, 2) covariances of the corners, as they came with them, in views that were used.
    """
    found = list[Finding]()

    def doubt(name: str, text: str, action: str = "") -> None:
        found.append(Finding(name, "doubt", text, action))

    noise = math.nan if stated is None else float(stated.diagonal(dim1=-2, dim2=-1).sum(-1).sqrt().nanmedian())
    hybrid = camera.model.hybrid is not None
    if status not in (SolverStatus.CONVERGED, SolverStatus.EXACT):
        rest = ": the camera may be farther off than its error bars say" if hybrid else ""
        action = "add views, and see which of them fit worst" if hybrid else ""
        doubt("solver", f"the solver {status.message}{rest}", action)
    if rms > 1.0:
        doubt(
            "residuals", f"RMS {rms:.2f} px is high: corners, board and lens model do not fit each other",
            "check the board's size, and look at the views that fit worst",
        )  # fmt: skip
    elif rms > _NOT_OF_CORNERS * noise:
        doubt(
            "residuals",
            f"RMS {rms:.2g} px is {rms / noise:.0f} times what the corners' own covariances say ({noise:.2g} px): "
            "either these are far too small, or most of it is no noise; look whether the board is as ordered (numbers "
            "of squares, print), whether all images are of one camera at one zoom and focus, and whether they were "
            "resized or stabilized",
        )
    typical = float(per_view.median())
    for i in (per_view > max(3.0 * typical, 0.1)).nonzero()[:, 0].tolist():
        text = f"view {names[i]}: RMS {float(per_view[i]):.2f} px is high, {typical:.2f} px is typical"
        doubt("residuals", text, "check it")
    if lost:
        doubt("open", f"the views do not determine {', '.join(lost)}", "choose a smaller model or add views")
    if not bool(camera.covers_image()):
        _, valid = camera.unproject(camera.grid(33, 25))
        if not bool(valid.any()):
            raise DegenerateError(
                "no pixel of the image has a ray: the lens that shows the corners folds on its axis, where no board "
                "was; add views with the board in the middle of the image, or all around it"
            )
        share = percent_text(float((~valid).double().mean()))
        if hybrid:
            doubt(
                "no-ray",
                f"{share} of the image has no ray: no board was there, and the lens found from the rest ends before",
                "if the lens shows anything there, add views with the board in these parts",
            )
        else:
            doubt(
                "no-ray", f"the lens model folds inside the image: {share} of it has no ray",
                "choose a smaller model, or add views with corners there",
            )  # fmt: skip
    return found


# The size of the board, and its unit.


def board_distances(result: CameraCalibrationResult) -> tuple[float, float]:
    """Of the board's middle in the nearest and in the farthest view, meters."""
    board = result.observations.board
    middle = (result.cam_from_board_rotation @ board.points.mean(0)) + result.cam_from_board_translation
    distance = middle.norm(dim=-1)
    distance = distance[distance.isfinite()]
    return float(distance.min()), float(distance.max())


def unit_findings(result: CameraCalibrationResult) -> list[Finding]:
    """Ask about a board that is larger than any sheet of paper, or tiny: another unit of its squares may be meant."""
    board = result.observations.board
    square = board.likelier_square
    if square is None:
        return []
    (wide, high), scale, (nearest, farthest) = board.extent, square / board.square, board_distances(result)
    focal = float(paraxial_focal(result.camera).value.mean())
    text = (
        f"with squares of {1e3 * board.square:g} mm the board is {wide:.3g} x {high:.3g} m, photographed with a focal "
        f"length of {focal:.0f} px from "
        f"{distance_text(nearest)} to {distance_text(farthest)}; with squares of {1e3 * square:g} mm it would be "
        f"{wide * scale:.3g} x {high * scale:.3g} m, from {distance_text(nearest * scale)} to "
        f"{distance_text(farthest * scale)}. All lengths that come of it scale alike"
    )
    return [Finding("unit", "doubt", text, "measure a square, and detect again if its unit was wrong (--square)")]


def distance_text(value: float) -> str:
    """Meters with two digits."""
    return f"{value:.{max(0, 1 - math.floor(math.log10(value)))}f} m" if value > 0 else "0 m"
