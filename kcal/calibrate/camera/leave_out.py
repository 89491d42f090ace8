"""Views that do not belong: of another camera or crop, or such that no lens fits; leave them out, and name them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.camera.checks import MINIMUM_VIEWS, check_views, least_planar
from kcal.calibrate.camera.hybrid import calibrate_hybrid
from kcal.calibrate.camera.outliers import corners_beyond, views_beyond
from kcal.calibrate.camera.result import CalibrationOptions, CameraCalibrationResult, Progress, RejectedView
from kcal.calibrate.hybrid.evidence import with_tempering
from kcal.calibrate.hybrid.fit import HybridFit, fit_hybrid
from kcal.calibrate.problem.board_problem import POSE, BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import LEAST_NOISE
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError, InputError
from kcal.solve.schur import without_local

# Find views that another camera took, or the same one at another zoom or with another crop, and say so.
#
# Groups that no focusing lens makes are refused; smaller differences, as of an autofocus, are a warning.
#
# Two such groups differ in scale and principal point. Poses, and motions during the readout, hide most of that: the RMS
# of one camera for both is hardly larger than of two. So it is told by the evidence. Near the solution each view is a
# quadratic form in scale and principal point, its pose and motion eliminated; two groups are fitted to these as by
# k-means. Where they would explain a lot, the corners are moved by what parts the groups, so that one camera shows all
# of them, and this camera is fitted again: the groups are real if the logarithm of the evidence rises by more than the
# choice of a group for each view, and of three numbers, can bring by chance.

# What to do, in warnings of views that are perhaps not of one camera.
AUTOFOCUS = "switch the autofocus off"
# Views of the smaller group: two views of any camera find a scale and principal point that suit them.
_FEWEST = 3
# fx, fy, cx, cy among the parameters; groups differ in their common scale, and in cx and cy.
_INDICES, _SIZE = (0, 1, 2, 3), 3
# Standard deviations of ln scale and, in shares of the image's diagonal, of the principal point, by which the estimates
# of single views are held together before they are grouped.
_SPREAD, _SPREAD_CENTER = 0.1, 0.02
# Nats beyond chance. Measured (scripts/check/faults.py): what groups of good captures bring stays 5 below chance.
_BEYOND = 5.0
# Shares of the image's diagonal that corners must be apart: a lens that was touched moves by less than the first; an
# autofocus scales images by one to three percent, so that only beyond the second views are certainly of two cameras.
_APART, _CERTAIN = 0.002, 0.008
# Before the camera is fitted again the quadratic forms must promise this share: motions take up the rest.
_PROMISED = 0.4
# How far motions are held back where groups are looked for: with them as wide as found, they hide the groups.
_HELD = 10.0
_ROUNDS, _STEPS = 3, 30
# Nats by which a view belongs to its group.
_CLEAR = 3.0
_UNCOMPARED = (InputError, DegenerateError, ArithmeticError, torch.linalg.LinAlgError)


class _ByView(NamedTuple):
    """χ² of each view by scale and principal point: c + 2 gᵀθ + θᵀNθ.

    Attributes:
        N: (V, 3, 3).
        g: (V, 3).
    """

    N: Tensor
    g: Tensor

    def change(self, theta: Tensor) -> Tensor:
        """(..., V) of χ² by θ (..., 1, 3), or by one for each view (..., V, 3)."""
        each = theta.expand(*theta.shape[:-2], *self.g.shape)
        return (each * (2.0 * self.g + (self.N @ each[..., None])[..., 0])).sum(-1)

    def best(self, second: Tensor) -> Tensor:
        """(..., 2, 3) the best θ of both groups; `second` (..., V) tells which views are in the second one."""
        groups = torch.stack([~second, second], -2).to(self.g.dtype)
        N, g = (groups @ self.N.flatten(1)).unflatten(-1, self.N.shape[1:]), groups @ self.g
        return -torch.linalg.lstsq(N, g[..., None]).solution[..., 0]

    def fall(self, second: Tensor) -> Tensor:
        """(...) by how much χ² falls with the best of both groups."""
        theta = self.best(second)
        return -torch.where(second, self.change(theta[..., 1:, :]), self.change(theta[..., :1, :])).sum(-1)


@dataclasses.dataclass(frozen=True, kw_only=True)
class TwoCameras:
    """Views that are not of one camera.

    Args:
        second: (V,) which views are in the smaller group.
        clear: (V,) nats by which each view belongs to its own group.
        log_scale: of the second group's images from the first's.
        shift: (2,) px of its principal point.
        nats: by which two cameras are more likely than one, the choice of the groups paid for.
    """

    second: Tensor
    clear: Tensor
    log_scale: float
    shift: Tensor
    nats: float

    def certain(self, size: tuple[int, int]) -> bool:
        """Whether the groups are farther apart than a lens that focuses brings them."""
        return _distance_apart(self.log_scale, self.shift, size) > _CERTAIN

    def text(self, names: Sequence[str]) -> str:
        """One sentence that names the views of the smaller group."""
        own = [names[i] for i in self.second.nonzero()[:, 0].tolist()]
        unclear = [names[i] for i in (self.clear < _CLEAR).nonzero()[:, 0].tolist()]
        u, v = self.shift.tolist()
        return (
            f"the views are not of one camera, zoom and crop: {len(own)} of {len(names)} ({', '.join(own)}) show "
            f"everything {100.0 * math.expm1(self.log_scale):+.1f} % larger than the others, with the principal point "
            f"({u:+.0f}, {v:+.0f}) px from theirs (two cameras are likelier than one by {self.nats:.0f} nats"
            + (f"; not clear for {', '.join(unclear)}" if unclear else "")
            + "). Calibrate both groups separately, from images as the camera gives them"
        )


def two_camera_warnings(
    result: CameraCalibrationResult, options: CalibrationOptions, progress: Progress
) -> tuple[str, ...]:
    """A warning where views of a result are perhaps not of one camera; it names the smaller group.

    Raises:
        InputError: they certainly are not.
    """
    used = result.per_view_rms.isfinite().nonzero()[:, 0].tolist()
    if len(used) < 2 * _FEWEST:
        return ()
    seen = result.observations
    pixels = torch.where(result.residuals.isfinite(), seen.pixels(), torch.nan)[used]
    if result.hybrid is not None:
        fit = result.hybrid.only(used)
    else:
        # Views of a parametric lens have no motion: the reference lens tells whether it is that.
        state = BoardState.flat(
            result.camera.params.detach(),
            result.cam_from_board_rotation[used],
            result.cam_from_board_translation[used],
        )
        problem = BoardProblem(result.board_points, pixels, result.camera.model, _INDICES)
        if _promising(_by_view(problem, state, result.noise**2), pixels, seen.image_size) is None:
            return ()
        try:
            fit = fit_hybrid(
                seen.board.points,
                pixels,
                seen.image_size,
                board=options.board,
                motion=options.motion,
                bending=options.bending,
            )
        except _UNCOMPARED:
            return ()
    found = two_cameras(fit, seen.board.points, pixels, options, progress)
    if found is None:
        return ()
    text = found.text([seen.names[i] for i in used])
    if found.certain(seen.image_size):
        raise InputError(text)
    return (f"{text}. A lens that focused by itself does this, too: {AUTOFOCUS}",)


def two_cameras(
    fit: HybridFit, points: Tensor, pixels: Tensor, options: CalibrationOptions, progress: Progress = lambda _: None
) -> TwoCameras | None:
    """Tell whether views are of two cameras; None if they are of one, or where nothing tells.

    Args:
        fit: of all of them as one camera.
        points: (N, 3) the board as ordered, meters.
        pixels: (V, N, 2), NaN where not seen.
        options: with which it was fitted.
        progress: called after each further fit.
    """
    found = _promising(_of_fit(fit, pixels), pixels, fit.size)
    if found is None and fit.readout is not None:
        return None
    second = found if fit.readout is None else _grouped(_of_fit(fit, pixels, _HELD), fit.size)
    if second is None:
        return None
    current, theta, needed = fit, _of_fit(fit, pixels).best(second), _chance(pixels) + _BEYOND
    best: TwoCameras | None = None
    for _ in range(_ROUNDS):
        if not _FEWEST <= int(second.sum()) <= len(second) - _FEWEST:
            break
        undone = _undone(pixels, second, theta, fit.state.parameters[2:4])
        try:
            current = fit_hybrid(points, undone, fit.size, fit.weights, board=options.board, start=current)
        except _UNCOMPARED:
            break
        progress("views as of two cameras")
        views = _of_fit(current, undone)
        change = theta[1] - theta[0]
        # What a view would gain in the other group.
        clear = 0.5 * views.change(torch.where(second[:, None], -change, change))
        tempering = _common_tempering(fit, current)
        gain = _evidence_at(current, tempering) - _evidence_at(fit, tempering) - needed
        if best is None or gain > best.nats:
            best = TwoCameras(second=second, clear=clear, log_scale=float(change[0]), shift=change[1:], nats=gain)
        theta = theta + views.best(second)
        second = second ^ (clear < 0.0)
    if best is None or best.nats <= 0.0 or not _far_apart(best.log_scale, best.shift, fit.size):
        return None
    if 2 * int(best.second.sum()) > len(second):
        return dataclasses.replace(best, second=~best.second, log_scale=-best.log_scale, shift=-best.shift)
    return best


def _common_tempering(fit: HybridFit, other: HybridFit) -> float:
    """The tempering at which two fits are compared: how far residuals repeat in the other one."""
    # Evidence of views that move is found before they are tempered.
    return other.tempering if fit.readout is None and other.readout is None else 1.0


def _evidence_at(fit: HybridFit, tempering: float) -> float:
    """Logarithm of a fit's evidence were its data to count as this tempering says."""
    own = fit.tempering if fit.readout is None else 1.0
    freedom = 2.0 * float(fit.residuals[..., 0].isfinite().sum()) - POSE * len(fit.residuals)
    return -with_tempering(-fit.log_evidence, freedom, fit.sigma**2 / fit.tempering, own, tempering)


def _of_fit(fit: HybridFit, pixels: Tensor, held: float = 1.0) -> _ByView:
    """Of a fit's views, motions held back so many times as much as it found."""
    still = None if fit.readout is None else held * fit.own_stillness
    problem = BoardProblem(
        fit.board_points, pixels, fit.model, _INDICES, weights=fit.weights, readout=fit.readout, stillness=still
    )
    state = fit.state._replace(board=fit.state.board.new_zeros(len(problem.shapes)))
    return _by_view(problem, state, fit.sigma**2 / fit.tempering)


def _by_view(problem: BoardProblem, state: BoardState, variance: float) -> _ByView:
    rows, local = problem.rows(state), problem.local_size
    fx, fy = state.parameters[0], state.parameters[1]
    scale = fx * rows[:, local] + fy * rows[:, local + 1]
    off = without_local(torch.cat([rows[:, :local], scale[:, None], rows[:, local + 2 :]], 1), local)
    gram = off @ off.transpose(1, 2) / max(variance, LEAST_NOISE**2)
    return _ByView(gram[:, :_SIZE, :_SIZE], gram[:, :_SIZE, _SIZE])


def _promising(views: _ByView, pixels: Tensor, size: tuple[int, int]) -> Tensor | None:
    """The second group (V,) if two groups might be real, else None."""
    second = _grouped(views, size)
    if second is None or 0.5 * float(views.fall(second)) < _PROMISED * (_chance(pixels) + _BEYOND):
        return None
    change = views.best(second)[1] - views.best(second)[0]
    return second if _far_apart(2.0 * float(change[0]), 2.0 * change[1:], size) else None


def _grouped(views: _ByView, size: tuple[int, int]) -> Tensor | None:
    """(V,) the second of the two groups with which χ² falls most, from several starts; None where nothing is known."""
    if not bool(views.N.isfinite().all() and views.g.isfinite().all()):
        return None
    center = _SPREAD_CENTER * math.hypot(*size)
    # In units of the prior, so that it holds what a view leaves open even where the noise is as small as it may be.
    unit = torch.tensor([_SPREAD, center, center], dtype=torch.float64)
    scaled, one = views.N * unit * unit[:, None], torch.eye(_SIZE, dtype=torch.float64)
    found = -torch.linalg.solve(scaled + one, (unit * views.g)[..., None])[..., 0]
    each, white = unit * found, found @ torch.linalg.cholesky(scaled.mean(0) + one)
    _, axes = torch.linalg.eigh(torch.cov(white.T))
    order = torch.arange(len(each), dtype=torch.float64)
    lines = torch.stack([order, order % 2, *(white @ axes).T, *each.T])
    low, high = lines.aminmax(dim=1, keepdim=True)
    middle = lines.median(1, keepdim=True).values
    # Every other view: there is nothing between the two values.
    middle[1] = 0.5 * (low + high)[1]
    second = lines > middle
    for _ in range(_STEPS):
        theta = views.best(second)
        moved = views.change(theta[:, 1:]) < views.change(theta[:, :1])
        if torch.equal(moved, second):
            break
        second = moved
    count = second.sum(1)
    possible = (count >= _FEWEST) & (count <= len(order) - _FEWEST)
    falls = torch.where(possible, views.fall(second), -torch.inf)
    return second[falls.argmax()] if bool(possible.any()) else None


def _chance(pixels: Tensor) -> float:
    """Nats that the choice of a group for each view and three numbers bring by chance, at most."""
    residuals = 2.0 * float(pixels.isfinite().all(-1).sum())
    return len(pixels) * math.log(2.0) + 0.5 * _SIZE * math.log(residuals)


def _far_apart(log_scale: float, shift: Tensor, size: tuple[int, int]) -> bool:
    return _distance_apart(log_scale, shift, size) > _APART


def _distance_apart(log_scale: float, shift: Tensor, size: tuple[int, int]) -> float:
    """How far apart corners of two groups typically are, in shares of the image's diagonal."""
    # Half of the diagonal's half is a typical distance from the middle.
    return math.hypot(0.25 * log_scale, float(shift.norm()) / math.hypot(*size))


def _undone(pixels: Tensor, second: Tensor, theta: Tensor, center: Tensor) -> Tensor:
    """Pixels as one camera between both groups shows them; areas stay the same altogether, and so does the noise."""
    share = float(second.double().mean())
    apart = theta - (1.0 - share) * theta[0] - share * theta[1]
    each = apart[second.long()][:, None]
    return (pixels - center - each[..., 1:]) * torch.exp(-each[..., :1]) + center


# Calibrate without views that no lens fits, before refusing all of them; and name them.
#
# One image of another board, of another camera, or with corners in a wrong order can leave no lens that shows all
# corners. A fit with bounded weights tells which views these are. A few are left out, with a warning; if they are many,
# nobody knows which ones are wrong.

# Views that contradict each other wholly leave a fit without a number to go on with.
_FAILED = (InputError, ArithmeticError, torch.linalg.LinAlgError)
# Largest share of the views that is left out without being asked.
_FEW = 0.2
# How many times larger or smaller a focal length is that was given wrongly.
_FAR = 1.5
# In warnings about what was not used: they concern the views, not the fit, and stay with another fit of the same views.
_LEFT_OUT, _START = "views were left out:", "was given for the start"
# Names and reasons in one message, at most.
_SHOWN = 5
# The unknowns that the views alone must determine: focal length, principal point, shape of the base projection.
_UNKNOWNS = 4


def calibrate_what_fits(
    observations: Observations, options: CalibrationOptions, progress: Progress
) -> CameraCalibrationResult:
    """As `kcal.calibrate.camera.hybrid.calibrate_hybrid`, but a few views that no lens fits are left out.

    Raises:
        DegenerateError: as `calibrate_hybrid`, with the names of the views.
        InputError: more than a fifth of the views do not fit; the message names them.
    """
    # What these refuse, leaving out views does not mend.
    check_views(observations.board.points, observations.pixels(), observations.names, _UNKNOWNS, fewest=MINIMUM_VIEWS)
    given = options.start_focal(observations.image_size)
    try:
        return _with_start(calibrate_hybrid(observations, options, progress), given)
    except _FAILED as error:
        if options.reject is not None:
            raise
        failure = error
    except DegenerateError as error:
        # Wrong views can leave the others open, too.
        if options.reject is None and given is None:
            wrong = _wrong_views(observations, options)
            if wrong and _few(wrong, observations):
                return _without(observations, options, wrong, error, progress)
        if any(name in str(error) for name in observations.names):
            raise
        raise DegenerateError(f"{error}; the views are {_few_names(observations.names)}") from error
    if given is not None:
        return _without_start(observations, options, given, failure, progress)
    wrong = _wrong_views(observations, options)
    listed = listed_views(observations, wrong)
    if not wrong or not _few(wrong, observations):
        which = (
            f"{len(wrong)} of {len(observations.views)} views do not fit the others: {listed}"
            if wrong
            else f"Look first at {least_planar(observations.board.points, observations.pixels(), observations.names)}"
        )
        raise InputError(
            f"no lens shows all corners where they are. {which}. Do all images show this board, not mirrored, and are "
            "all from this camera at this zoom? Remove those that do not, and detect again"
        ) from failure
    return _without(observations, options, wrong, failure, progress)


def _few(wrong: Mapping[int, str], observations: Observations) -> bool:
    """Whether views are few enough to go on without them."""
    count = len(observations.views)
    return len(wrong) <= max(1.0, _FEW * count) and count - len(wrong) >= MINIMUM_VIEWS


def _without(
    observations: Observations,
    options: CalibrationOptions,
    wrong: Mapping[int, str],
    failure: Exception,
    progress: Progress,
) -> CameraCalibrationResult:
    """Without views that do not fit."""
    progress(f"without {len(wrong)} views that no lens fits")
    kept = [i for i in range(len(observations.views)) if i not in wrong]
    used = observations.subset([observations.names[i] for i in kept])
    try:
        result = calibrate_hybrid(used, options, progress)
    except _FAILED as error:
        listed = listed_views(observations, wrong)
        raise InputError(f"without {len(wrong)} views that no lens fits ({listed}): {error}") from failure
    return without_views(result, observations, wrong)


def _with_start(result: CameraCalibrationResult, given: float | None) -> CameraCalibrationResult:
    """A result, and what is to say of a focal length that was given."""
    found = float(result.camera.focal[0])
    if given is None or 1.0 / _FAR < found / given < _FAR:
        return result
    note = (
        f"the focal length that {_START} ({given:.4g} px) is far from the camera's ({found:.4g} px): it was not used; "
        "leave it out, or correct it"
    )
    return dataclasses.replace(result, warnings=(note, *result.warnings))


def _without_start(
    observations: Observations, options: CalibrationOptions, given: float, failure: Exception, progress: Progress
) -> CameraCalibrationResult:
    """Again, as if no focal length had been given."""
    progress("again without the focal length that was given")
    try:
        result = calibrate_what_fits(
            observations, dataclasses.replace(options, focal=None, field_of_view=None), progress
        )
    except InputError:
        raise failure from None
    note = (
        f"no lens with the focal length that {_START} ({given:.4g} px) shows the corners: it was not "
        "used; leave it out, or correct it"
    )
    return dataclasses.replace(result, warnings=(note, *result.warnings))


def _wrong_views(observations: Observations, options: CalibrationOptions) -> dict[int, str]:
    """Views that do not fit, by a fit in which few wrong corners count little: index -> why."""
    pixels, board = observations.pixels(), observations.board.points
    try:
        fit = fit_hybrid(board, pixels, observations.image_size, board=options.board, robust=True)
    except (*_FAILED, DegenerateError):
        return {}
    residuals = fit.residuals_of(pixels)
    seen = torch.isfinite(pixels).all(-1)
    missing = (seen & ~torch.isfinite(residuals).all(-1)).sum(-1)
    found = views_beyond(board, residuals, pixels, corners_beyond(residuals))
    for i in missing.nonzero()[:, 0].tolist():
        found[i] = f"the lens that fits the others cannot show {int(missing[i])} of its {int(seen[i].sum())} corners"
    return dict(sorted(found.items()))


def lasting_warnings(result: CameraCalibrationResult) -> tuple[str, ...]:
    """Those of a result's warnings that hold for another fit of the same views, too: of these, or what was not used."""
    return tuple(text for text in result.warnings if any(part in text for part in (_LEFT_OUT, _START, AUTOFOCUS)))


def _few_names(names: Sequence[str]) -> str:
    more = len(names) - _SHOWN
    return ", ".join(names[:_SHOWN]) + (f" and {more} more" if more > 0 else "")


def listed_views(observations: Observations, wrong: Mapping[int, str]) -> str:
    """Names of views with their reasons, a few of them."""
    shown = [f"{observations.names[i]} ({why})" for i, why in list(wrong.items())[:_SHOWN]]
    more = len(wrong) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more > 0 else "")


def without_views(
    result: CameraCalibrationResult, observations: Observations, wrong: Mapping[int, str]
) -> CameraCalibrationResult:
    """A result without some views as one for all `observations`, with a warning that names them."""
    if not wrong:
        return result
    kept = [i for i in range(len(observations.views)) if i not in wrong]
    counts = torch.isfinite(observations.pixels()).all(-1).sum(-1).tolist()
    left_out = tuple(
        RejectedView(view=observations.names[i], corners=counts[i], residual=float("nan"), reason=why)
        for i, why in wrong.items()
    )
    note = (
        f"{len(wrong)} of {len(observations.views)} {_LEFT_OUT} {listed_views(observations, wrong)}; look at "
        "these images, and remove or retake them"
    )
    return dataclasses.replace(
        result.among(kept, observations),
        warnings=(note, *result.warnings),
        rejected_views=(*result.rejected_views, *left_out),
    )
