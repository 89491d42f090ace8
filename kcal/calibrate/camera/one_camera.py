"""Tell whether one camera took all views: groups at another zoom or crop, and lenses that move from view to view."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.camera.checks import stray_corners
from kcal.calibrate.camera.each_view import LESS, SIZE, ByView, Spread, by_view
from kcal.calibrate.camera.hybrid import few_views, fit_by_options, hybrid_result, lasting_findings
from kcal.calibrate.camera.result import CalibrationOptions, CameraCalibrationResult, Progress
from kcal.calibrate.camera.warnings import outlier_findings
from kcal.calibrate.hybrid.evidence import WORTH, with_tempering
from kcal.calibrate.hybrid.fit import HybridFit
from kcal.calibrate.hybrid.fitted_views import hybrid_unknowns
from kcal.calibrate.problem.board_problem import POSE, BoardProblem
from kcal.calibrate.problem.parameters import FreeParameters
from kcal.calibrate.problem.state import BoardState, by_number
from kcal.calibrate.problem.views import LEAST_NOISE, among
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError, InputError
from kcal.finding import Finding
from kcal.gaussian import triangular
from kcal.solve.schur import without_local
from kcal.texts import number_text

# A view's own scale and principal point, θ = (ln scale, cx, cy) off those of all views: of another camera or crop, of a
# lens that focuses anew, or of one that a stabilizer moves.
#
# Poses, motions during the readout, and lens and board of all views hide most of that: the RMS of one camera for all is
# hardly larger. So it is told by the evidence. Near the solution each view is a quadratic form in θ, its pose and
# motion eliminated, lens and board free. Where the slopes by θ are steeper than noise makes them, θ is given a normal
# prior, whose amplitudes have the largest evidence. Corners are moved by what was found, the camera is fitted again to
# these, and so on. In the end two values of θ, one for each of two groups of views, compete with the normal prior.

# fx, fy, cx, cy among the parameters.
_INDICES = (0, 1, 2, 3)
# Which numbers share an amplitude, of θ and of three ways in which a board bends; -1: zero. A board that bends by view
# is the rival: what it explains better is no matter of the lens.
_NONE, _BENT = (-1,) * 6, (-1, -1, -1, 0, 0, 0)
_LENS = ((-1, 0, 0, -1, -1, -1), (0, -1, -1, -1, -1, -1), (0, 1, 1, -1, -1, -1))
# Of amplitudes of motions, of others than these.
_OTHER = 10
# Standard deviations of a score from which amplitudes are asked for, and nats that these must be worth: of 18 simulated
# captures of still lenses one had more, 3.7 and 3.1; those whose principal points moved by 15 px mostly 2.2 and 4.6.
# And nats from which a camera is fitted again: those that were sure in the end began with 2 and more.
_ASKED, _SURE, _IN_SIGHT = 2.0, 4.0, 0.5
# Share of its price that must be in sight before a camera is fitted again for two groups alone.
_PROMISED = 0.7
# Two values that gain a smaller share of what a spread of values does are not tried: where two cameras were true they
# gained as much, where a lens moved .5 to .94 of it.
_BEHIND = 0.8
# Widths of the prior of the difference between two groups: ln scale, and shares of the image's diagonal.
_APART, _APART_CENTER = 0.1, 0.02
# Two groups that lack more nats after a round of refits are given up: further rounds gained 6 at most.
_HOPELESS = 15.0
# Rounds of refits; share of θ, and standard deviations of the camera, by which the last one changes it; the largest
# share of a step of groups that the next one is taken to be; and steps of the search for groups.
_ROUNDS, _REST, _MOVED, _AHEAD, _STEPS = 12, 0.05, 0.2, 0.6, 60
# What to do about a lens that moves.
_STILL = "lock focus and zoom, switch the image stabilizer off (also in the camera's app), and photograph again"
# Fewer views tell nothing; one view alone may be wrong otherwise, and a scale and principal point suits it.
_FEWEST, _FEWEST_OTHERS = 6, 2
# Shares of the image's diagonal that corners of two groups must be apart, beyond which they are of two cameras; a lens
# that focuses by itself scales images by one to three percent.
_CERTAIN = 0.008
# Nats by which a view belongs to its group; standard deviations from which a difference is told, and χ² of two
# numbers that agree.
_CLEAR, _TOLD, _AGREE = 3.0, 3.0, 9.2


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class OwnLenses:
    """Scale and principal point of each view, off the camera's.

    Args:
        fit: of corners from which they were taken away; its error bars allow for them, and for those of the next view.
        sigma: (3,) standard deviations of ln scale, cx and cy, pixels.
        theta: (V, 3) of each view.
        nats: by which this is likelier than one camera for all views.
        groups: of two cameras, if these are likelier.
    """

    fit: HybridFit
    sigma: Tensor
    theta: Tensor
    nats: float
    groups: TwoCameras | None = None

    @property
    def what(self) -> str:
        """What moves."""
        scale, center = 100.0 * float(self.sigma[0]), float(self.sigma[1])
        words = [f"its focal length by some {number_text(scale, digits=2)} % (autofocus or zoom)"] * (scale > 0)
        words += [f"its principal point by some {number_text(center, digits=2)} px (image stabilizer or crop)"] * (
            center > 0
        )
        return f"the lens moves from view to view, {' and '.join(words)}"


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TwoCameras:
    """Views that are not of one camera.

    Args:
        second: (V,) which views are in the smaller group.
        clear: (V,) nats by which each view belongs to its own group.
        change: (3,) ln scale and principal point (px) of the second group less those of the first.
        sigma: (3,) standard deviations of these.
        turned: how images of the second group may have been turned or mirrored; empty if they were not.
    """

    second: Tensor
    clear: Tensor
    change: Tensor
    sigma: Tensor
    turned: str

    @property
    def why(self) -> str:
        """What is different about the smaller group."""
        scale, right, down = self.change.tolist()
        told = (self.change.abs() > _TOLD * self.sigma).tolist()
        percent = 100.0 * math.expm1(scale)
        words = [f"everything is {abs(percent):.1f} % {'larger' if percent > 0 else 'smaller'}"] * told[0]
        sides = [f"{abs(right):.0f} px to the {'right' if right > 0 else 'left'}"] * told[1]
        sides += [f"{abs(down):.0f} px {'down' if down > 0 else 'up'}"] * told[2]
        words += [
            f"the principal point is {' and '.join(sides)}{self.turned and ', as where images are '}{self.turned}"
        ] * bool(sides)
        return f"another camera, zoom or crop: {', and '.join(words) or 'the lens is another one'}"

    @property
    def cure(self) -> str:
        """What to do."""
        back = "turn or mirror images back if they were; otherwise " if self.turned else ""
        return f"{back}calibrate each group for itself, from images as the camera gives them, or take all at one zoom"

    def distance(self, size: tuple[int, int]) -> float:
        """How far apart corners of both groups typically are, in shares of the image's diagonal."""
        # Half of the diagonal's half is a typical distance from the middle.
        return math.hypot(0.25 * float(self.change[0]), float(self.change[1:].norm()) / math.hypot(*size))

    def text(self, names: Sequence[str]) -> str:
        """One sentence that names the views of the smaller group."""
        own = [names[i] for i in self.second.nonzero()[:, 0].tolist()]
        unclear = [names[i] for i in (self.clear < _CLEAR).nonzero()[:, 0].tolist()]
        return (
            f"the views are not of one camera: {len(own)} of {len(names)} ({', '.join(own)}), {self.why}"
            + f" (not clear for {', '.join(unclear)})" * bool(unclear)
        )


def lenses_by_view(
    result: CameraCalibrationResult, options: CalibrationOptions, progress: Progress, theta: Tensor | None = None
) -> CameraCalibrationResult | dict[int, str]:
    """A result that allows for a lens that moves from view to view; or the few views of another camera, and why.

    `theta` (V, 3) is roughly θ of each view, where it is known.

    Raises:
        InputError: the views are of two cameras; or the lens moves, and is a parametric one.
    """
    used = result.per_view_rms.isfinite().nonzero()[:, 0].tolist()
    if len(used) < _FEWEST:
        return result
    pixels = torch.where(result.residuals.isfinite(), result.observations.pixels(), torch.nan)[used]
    seen = result.observations.subset([result.observations.names[i] for i in used])
    try:
        if result.hybrid is not None:
            fit, own = result.hybrid.only(used), options
        else:
            # Views of a parametric lens have no motion: the reference lens tells whether it is that.
            poses = result.cam_from_board_rotation[used], result.cam_from_board_translation[used]
            state, none = BoardState.flat(result.camera.params.detach(), *poses), pixels.new_zeros(len(used), SIZE)
            problem = BoardProblem(result.board_points, pixels, result.camera.model, _INDICES)
            begin = _widths(seen.image_size)
            views = by_view(
                problem, state, max(result.noise, LEAST_NOISE), none, begin, none.new_zeros(len(problem.free))
            )
            if _likeliest(views, _LENS).nats < WORTH:
                return result
            own = CalibrationOptions(board=options.board, motion=options.motion, bending=options.bending)
            fit = fit_by_options(seen, pixels, None, None, own, progress)
        strays, wrong = stray_corners(fit.residuals), list[Finding]()
        doubtful = bool(strays.any())
        found = own_lenses(fit, seen, pixels, own, progress, theta, briefly=doubtful)
        if doubtful and found is not None and found.nats:
            wrong = outlier_findings(seen.names, fit.residuals, strays)
            # One wrong corner would make two cameras of the views.
            progress("again without corners that noise cannot explain")
            pixels, weights = pixels.masked_fill(strays[..., None], torch.nan), fit.weights.masked_fill(strays, 0.0)
            fit = fit_by_options(seen, pixels, weights, fit, own, progress)
            found = own_lenses(fit, seen, pixels, own, progress)
    except (InputError, DegenerateError, ArithmeticError, torch.linalg.LinAlgError):
        return result
    if found is None or (result.hybrid is None and not found.nats):
        return result
    text, groups = f"{found.what} ({found.nats:.0f} nats)", found.groups
    if groups is not None:
        second = groups.second.nonzero()[:, 0].tolist()
        if few_views(len(second), len(used)):
            return {used[i]: groups.why for i in second}
        if groups.distance(fit.size) > _CERTAIN:
            raise InputError(f"{groups.text(seen.names)}; {groups.cure}")
        text += f"; {groups.text(seen.names)}"
    if result.hybrid is None:
        raise InputError(f"{text}. A parametric lens does not allow for that: leave the model out, or {_STILL}")
    try:
        after = hybrid_result(result.observations, found.fit.among(used, len(result.observations.views)), options)
    except DegenerateError as error:
        raise DegenerateError(f"{text}, which leaves no focal length for all of them: {_STILL}") from error
    scale, right, down = found.sigma.tolist()
    text += ": the camera is their mean, and its error bars contain the movement"
    moving = [Finding("moving-lens", "doubt", text, f"for smaller ones {_STILL}")] if found.nats else []
    return dataclasses.replace(
        after,
        by_view=among(found.theta, used, len(result.observations.views)) if moving else None,
        moves=(scale, right, down) if moving else None,
        findings=(*lasting_findings(result), *moving, *wrong, *after.findings),
        rejected_corners=result.rejected_corners,
        rejected_views=result.rejected_views,
    )


def own_lenses(
    fit: HybridFit,
    seen: Observations,
    pixels: Tensor,
    options: CalibrationOptions,
    progress: Progress = lambda _: None,
    theta: Tensor | None = None,
    briefly: bool = False,
) -> OwnLenses | None:
    """Scale and principal point of each view; None if all views have the same, or where nothing tells.

    A lens that moves though that is not proven has zeros and no nats.

    Args:
        fit: of all of them as one camera.
        seen: the views.
        pixels: (V, N, 2), NaN where not seen.
        options: with which they were fitted.
        progress: called after each further fit.
        theta: (V, 3) roughly what will be found, or None.
        briefly: end as soon as it is sure that the lens moves: error bars are then those of a lens that does not, and
            two cameras are not tried.
    """
    views = _of_fit(fit, pixels, torch.zeros_like(pixels[:, 0, :1]).expand(-1, SIZE))
    if not bool(views.N.isfinite().all() and views.g.isfinite().all()):
        return None
    refits, about, nats = _Refits(fit, seen, pixels, options, progress), views.lens(), 0.0
    by_scale, by_center = (about.score(own) for own in ([0], [1, 2]))
    sigma, normal = about.begin * about.begin.new_tensor([0.0, 1.0, 1.0]), None
    # Far below what is asked for, no movement is likelier than none.
    if 2.0 * by_center > _ASKED and bool((sigma := about.later(sigma)).any()):
        normal = OwnLenses(fit=_for_later(fit, sigma), sigma=sigma, theta=refits.theta, nats=0.0)
    spreads = max(by_scale, by_center) > _ASKED
    if spreads:
        found, none, bent = _likeliest(views, _LENS), views.spread(_NONE), views.spread(_BENT)
        if bent.beyond(none) >= 0.0 and bent.nats > found.nats:
            return None
        spreads = found.beyond(none) >= _IN_SIGHT
    if not spreads:
        # Two values may be likelier where no spread is: motions that are held back do not hide the groups.
        held = views.lens(LESS)
        second = _grouped(held, held.spread(_LENS[-1]).mean, fit.size)
        if not _FEWEST_OTHERS <= int(second.sum()) <= len(second) - _FEWEST_OTHERS:
            return normal
        if about.best(second)[2] < _PROMISED * _parted(about, second, fit.size)[2]:
            return normal
    else:
        for turn in range(_ROUNDS):
            views = refits.with_own(found.mean[:, :SIZE] if turn or theta is None else theta)
            found = _likeliest(views, _LENS)
            if refits.rest:
                break
        about = views.lens()
        found = _likeliest(about, _LENS)
        nats = found.nats + refits.nats(about)
        second = _grouped(about, found.mean, fit.size)
        if nats >= _SURE:
            if briefly:
                return OwnLenses(fit=refits.fit, sigma=found.sigma[:SIZE], theta=refits.theta, nats=nats)
            # About the likeliest ones, no more than these are thinkable.
            sigma = about.later(8.0 * found.sigma[:SIZE])
            normal = OwnLenses(fit=refits.widened(sigma), sigma=sigma, theta=refits.theta, nats=nats)
            if about.best(second)[2] < _BEHIND * found.nats:
                return normal
    return _two_cameras(refits, about, second, max(nats, 0.0)) or normal


def _likeliest(views: ByView, ways: Sequence[Sequence[int]]) -> Spread:
    return max((views.spread(tied) for tied in ways), key=lambda spread: spread.nats)


class _Refits:
    """Fits of pixels from which a θ of each view was taken away, each begun where the last one ended."""

    def __init__(
        self, first: HybridFit, seen: Observations, pixels: Tensor, options: CalibrationOptions, progress: Progress
    ) -> None:
        self.first = self.fit = first
        self.seen, self.pixels, self.options, self.progress = seen, pixels, options, progress
        self.theta, self.step, self.rest = pixels.new_zeros(len(pixels), SIZE), math.inf, False

    @property
    def undone(self) -> Tensor:
        """(V, N, 2) pixels as one camera shows them."""
        center, theta = self.first.state.parameters[2:4], self.theta[:, None]
        return (self.pixels - center - theta[..., 1:]) * torch.exp(-theta[..., :1]) + center

    def with_own(self, theta: Tensor, ahead: float = 0.0) -> ByView:
        """Fit with θ (V, 3) taken away; or with more of it, ahead of motions, which make way slowly."""
        theta, before = theta - theta.mean(0), self.fit
        step = (theta - self.theta) / _widths(before.size)
        share = min(float(step.norm()) / self.step, ahead)
        self.step = float(step.norm())
        still = self.step <= _REST * float((theta / _widths(before.size)).norm())
        self.theta = theta + share / (1.0 - share) * (theta - self.theta)
        self.fit = self._again(likely=True)
        moved = (self.fit.state.parameters - before.state.parameters)[:4]
        self.rest = still and bool((moved.abs() <= _MOVED * self.fit.covariance.diagonal()[:4].sqrt()).all())
        return _of_fit(self.fit, self.undone, self.theta)

    def _again(self, **how: Any) -> HybridFit:
        fit = fit_by_options(self.seen, self.undone, self.fit.weights, self.fit, self.options, self.progress, **how)
        self.progress("views with a lens of their own")
        return fit

    def widened(self, sigma: Tensor) -> HybridFit:
        """The last fit with error bars that allow for θ, and for that of the next view."""
        return _widened(self._again(), self.undone, self.theta, sigma)

    def nats(self, views: ByView) -> float:
        """By which the last fit is likelier than the first one, were θ zero in it."""
        fit, first = self.fit, self.first
        # Evidence of views that move is found before they are tempered.
        tempering = fit.tempering if fit.readout is None and first.readout is None else 1.0
        gained = _evidence_at(fit, tempering) - _evidence_at(first, tempering)
        # Pixels were moved, and scaled.
        counts = self.pixels[..., 0].isfinite().sum(1)
        return gained + 0.5 * float(views.total(self.theta)) - 2.0 * float((counts * self.theta[:, 0]).sum())


def _parted(views: ByView, second: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor, float]:
    """The best θ of two groups (2, 3), the covariance (3, 3) of their difference, and the price of both in nats.

    The price is that of these numbers, and of a group for each view; `second` (V,) is one of them.
    """
    both, of_both, _ = views.best(second)
    sign = of_both.new_tensor([-1.0, 1.0])
    covariance = torch.einsum("i,iajb,j->ab", sign, of_both.view(2, SIZE, 2, SIZE), sign)
    unit, share = _widths(size), float(second.double().mean())
    known = torch.eye(SIZE, dtype=torch.float64) + torch.linalg.pinv(covariance) * unit * unit[:, None]
    mixed = -sum(part * math.log(part) for part in (share, 1.0 - share) if part > 0)
    return both, covariance, 0.5 * float(torch.logdet(known)) + 0.5 * math.log(len(second)) + len(second) * mixed


def _grouped(views: ByView, mean: Tensor, size: tuple[int, int]) -> Tensor:
    """(V,) the second of the two groups with which χ² falls most, from several starts; `mean` (V, 3) of single θ."""
    mean = mean / _widths(size)
    _, axes = torch.linalg.eigh(torch.cov(mean.T))
    order = torch.arange(len(mean), dtype=torch.float64)
    lines = torch.cat([order[None], order[None] % 2, mean.T, (mean @ axes).T])
    low, high = lines.aminmax(dim=1, keepdim=True)
    second = torch.cat([lines > lines.median(1, keepdim=True).values, lines > 0.5 * (low + high)])
    for _ in range(_STEPS):
        moved = views.by_group(second) < 0.0
        if torch.equal(moved, second):
            break
        second = moved
    return second[views.best(second)[2].argmax()]


def _two_cameras(refits: _Refits, views: ByView, second: Tensor, nats: float) -> OwnLenses | None:
    """Two groups of views, if two values of θ are likelier than normal ones, which are by so many nats."""
    refits.step, before = math.inf, second
    for _ in range(_ROUNDS):
        if not _FEWEST_OTHERS <= int(second.sum()) <= len(second) - _FEWEST_OTHERS:
            return None
        # Ahead of a view that changed its group it would be in neither one, and change again.
        ahead = _AHEAD if torch.equal(second, before) else 0.0
        views, before = refits.with_own(views.best(second)[0][second.long()], ahead).lens(), second
        moved = views.by_group(second) < 0.0
        done, second = refits.rest and torch.equal(moved, second), moved
        both, covariance, price = _parted(views, second, refits.fit.size)
        unlikely = (both[1] - both[0]) / _widths(refits.fit.size)
        likelier = refits.nats(views) + float(views.best(second)[2] - 0.5 * unlikely.square().sum()) - price
        if likelier < nats + WORTH - _HOPELESS:
            return None
        if done:
            break
    if likelier < nats + WORTH:
        return None
    if 2 * int(second.sum()) > len(second):
        second, both = ~second, both.flip(0)
    fit, change = refits.fit, both[1] - both[0]
    by_group = views.by_group(second)
    groups = TwoCameras(
        second=second,
        clear=0.5 * torch.where(second, -by_group, by_group),
        change=change,
        sigma=covariance.diagonal().sqrt(),
        turned=_mirrored(change, covariance, fit.state.parameters[2:4] + both[0, 1:], fit),
    )
    sigma = refits.theta.square().mean(0).sqrt()
    return OwnLenses(fit=refits.widened(sigma), sigma=sigma, theta=refits.theta, nats=likelier, groups=groups)


def _mirrored(change: Tensor, covariance: Tensor, place: Tensor, fit: HybridFit) -> str:
    """How images are turned or mirrored that move the principal point from `place` by the change; or nothing."""
    width, height = fit.size
    (x, y), last = place.tolist(), (width - 1.0, height - 1.0)
    images = {
        "turned by 180°": (last[0] - x, last[1] - y),
        "mirrored left to right": (last[0] - x, y),
        "mirrored top to bottom": (x, last[1] - y),
    }
    if width == height:
        images |= {"turned by 90°": (last[1] - y, x), "turned by -90°": (y, last[0] - x)}
    # Of the difference: the image of the principal point moves against it.
    known = covariance[1:, 1:] + 4.0 * fit.covariance[2:4, 2:4]
    if abs(float(change[0])) > _TOLD * float(covariance[0, 0].sqrt()):
        return ""
    for how, there in images.items():
        wanted = torch.tensor(there, dtype=torch.float64) - place
        off = change[1:] - wanted
        if float(off @ torch.linalg.solve(known, off)) < _AGREE < float(wanted @ torch.linalg.solve(known, wanted)):
            return how
    return ""


def _widened(fit: HybridFit, pixels: Tensor, theta: Tensor, sigma: Tensor) -> HybridFit:
    """A fit of pixels from which θ was taken away, with error bars that allow for it, and for that of the next view."""
    unknowns = hybrid_unknowns(fit.model, fit.square)
    problem = _problem(fit, pixels, unknowns, fit.board_shapes.shapes)
    rows, local = problem.rows(fit.state._replace(board=torch.zeros_like(fit.state.board))), problem.local_size
    moves = sigma > 0
    fx, fy = fit.state.parameters[:2]
    by_parameter = [rows[:, local + slot] for slot in unknowns.slots[:4]]
    zoom = fx * by_parameter[0] + (fy * by_parameter[1] if not fit.square else 0.0)
    own = torch.stack([zoom, *by_parameter[2:]], 1)[:, moves]
    prior = rows.new_zeros(len(rows), own.shape[1] + rows.shape[1], own.shape[1])
    weight = fit.sigma / sigma[moves]
    prior[:, local : local + len(weight)] = torch.diag(weight)
    prior[:, -1] = weight * theta[:, moves]
    rows = torch.cat([rows[:, :local], own, rows[:, local:]], 1)
    off = without_local(torch.cat([rows, prior], 2), local + len(weight)).transpose(0, 1).flatten(1).T
    data = triangular(off[:, [*_of_information(fit), -1]]) / (fit.sigma * math.sqrt(fit.wider))
    known = dataclasses.replace(fit.information, rows=data[:, :-1], residuals=data[:, -1])
    return _for_later(dataclasses.replace(fit, information=known), sigma)


def _for_later(fit: HybridFit, sigma: Tensor) -> HybridFit:
    """A fit with error bars that allow for θ of the next view, whose standard deviations (3,) these are."""
    change, half = sigma.new_zeros(len(fit.information.slots), SIZE), torch.zeros_like(fit.half)
    change[:2, 0], change[2, 1], change[3, 2] = fit.state.parameters[:2], 1.0, 1.0
    # Lenses of all frames have the same prior.
    known = fit.information.changed(change * sigma, prior=True)
    columns = _of_information(fit)
    half[: len(columns), columns] = known.half()
    return dataclasses.replace(fit, information=known, half=half)


def _of_information(fit: HybridFit) -> list[int]:
    """Which of a fit's unknowns those of its information are."""
    known, unknowns = fit.information, hybrid_unknowns(fit.model, fit.square)
    columns = [0] * known.lens_size
    for index, slot in zip(unknowns.indices, unknowns.slots, strict=True):
        if known.slots[index] >= 0:
            columns[known.slots[index]] = slot
    return [*columns, *range(len(unknowns), len(unknowns) + known.board_size)]


def _problem(fit: HybridFit, pixels: Tensor, free: FreeParameters | Sequence[int], shapes: Tensor) -> BoardProblem:
    """Of a fit's views, with these pixels, and with the board free in these shapes."""
    return BoardProblem(
        fit.board_points, pixels, fit.model, free, shapes=shapes, free_board=True, weights=fit.weights,
        readout=fit.readout, stillness=None if fit.readout is None else fit.stillness,
    ).read_as_shown(fit.state._replace(board=shapes.new_zeros(len(shapes))))  # fmt: skip


def _evidence_at(fit: HybridFit, tempering: float) -> float:
    """Logarithm of a fit's evidence were its data to count as this tempering says."""
    own = fit.tempering if fit.readout is None else 1.0
    freedom = 2.0 * float(fit.residuals[..., 0].isfinite().sum()) - POSE * len(fit.residuals)
    return -with_tempering(-fit.log_evidence, freedom, fit.sigma**2 / fit.tempering, own, tempering)


def _of_fit(fit: HybridFit, pixels: Tensor, theta: Tensor) -> ByView:
    """Of a fit's views, about no motion and no θ; `theta` (V, 3) was taken away from the pixels."""
    # Errors that repeat within a view count less: a lens that does not quite fit is none that moves.
    shapes, noise = fit.board_shapes.shapes, max(fit.sigma, LEAST_NOISE)
    problem = _problem(fit, pixels, hybrid_unknowns(fit.model, fit.square), shapes)
    begin, state = torch.cat([_widths(fit.size), _APART * fit.board_shapes.unit[:SIZE]]), fit.state
    deviation = torch.where(fit.half.any(0), fit.families.deviation(fit.expected), 0.0)
    # Numbers of one amplitude have the same logarithm.
    ties = _OTHER + by_number(np.arange(float(len(fit.log_ratio)))).unique(return_inverse=True)[1]
    state = state._replace(board=theta.new_zeros(len(shapes)))
    spread = noise / fit.stillness.sqrt()
    return by_view(problem, state, noise, theta, begin, deviation, spread, tuple(ties.tolist()))


def _widths(size: tuple[int, int]) -> Tensor:
    """(3,) of the prior of what parts two cameras."""
    return torch.tensor([_APART, *[_APART_CENTER * math.hypot(*size)] * 2], dtype=torch.float64)
