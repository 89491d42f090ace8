"""Tell whether one camera took all views: groups at another zoom or crop, and lenses that move from view to view."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.camera.checks import stray_corners
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
from kcal.solve.schur import matrix_product, products_of, without_local
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
_SIZE = 3
# Which numbers share an amplitude, of θ and of three ways in which a board bends; -1: zero. A board that bends by view
# is the rival: what it explains better is no matter of the lens.
_NONE, _BENT = (-1,) * 6, (-1, -1, -1, 0, 0, 0)
_LENS = ((-1, 0, 0, -1, -1, -1), (0, -1, -1, -1, -1, -1), (0, 1, 1, -1, -1, -1))
# Of amplitudes of motions, of others than these.
_OTHER = 10
# Share of the variances of motions with which the search for amplitudes begins: a lens that moves was taken for motion.
_LESS = 0.01
# Standard deviations of a score from which amplitudes are asked for, and nats that these must be worth: of 18 simulated
# captures of still lenses one had more, 3.7 and 3.1; those whose principal points moved by 15 px mostly 2.2 and 4.6.
_ASKED, _SURE = 2.0, 4.0
# Share of captures in which lenses are taken to move, before anything is known.
_MOVING = 0.2
# Share of its price that must be in sight before a camera is fitted again for two groups alone.
_PROMISED = 0.7
# Two values that gain a smaller share of what a spread of values does are not tried: where two cameras were true they
# gained as much, where a lens moved .5 to .94 of it.
_BEHIND = 0.8
# Widths of the prior of the difference between two groups: ln scale, and shares of the image's diagonal.
_APART, _APART_CENTER = 0.1, 0.02
# Rounds of refits; share of θ, and standard deviations of the camera, by which the last one changes it; the largest
# share of a step of groups that the next one is taken to be; and steps of the search for amplitudes.
_ROUNDS, _REST, _MOVED, _AHEAD, _STEPS = 12, 0.05, 0.2, 0.6, 60
# Nats by which the last step of that search raises the evidence; shares of a variance to which one step may lead; and
# the largest variance, in the widest ones that are expected.
_SETTLED, _STEP, _MOST = 1e-2, (0.05, 4.0), 100.0
# Views of which rows are in memory together.
_TOGETHER = 256
# Share of a unit, squared, that the widest movements change of combinations of lens and board that are left out.
_UNFELT = 1e-3
# What to do about a lens that moves.
_STILL = "lock focus and zoom, switch the image stabilizer off (also in the camera's app), and photograph again"
# Fewer views tell nothing; one view alone may be wrong otherwise, and a scale and principal point suits it.
_FEWEST, _FEWEST_OTHERS = 6, 2
# Shares of the image's diagonal that corners of two groups must be apart, beyond which they are of two cameras; a lens
# that focuses by itself scales images by one to three percent.
_CERTAIN = 0.008
# Share of the best known difference between groups, below which one is zero but for rounding.
_ALIKE = 1e-10
# Nats by which a view belongs to its group; standard deviations from which a difference is told, and χ² of two
# numbers that agree.
_CLEAR, _TOLD, _AGREE = 3.0, 3.0, 9.2


@dataclasses.dataclass(frozen=True, eq=False)
class _ByView:
    """χ² by x of each view: its motion and bending over their deviations, θ, and how its board bends: 2 gᵀx + xᵀNx.

    And by the lens and board of all views, y, in combinations of unit weight: 2 (b + Σ Cᵀx)ᵀ y + yᵀy. They would hide
    a good part of what moves, were they held where one camera for all views has them.

    Attributes:
        N: (V, X, X).
        g: (V, X).
        C: (V, X, S).
        b: (V, S), to be summed.
        ties: which numbers of the motion and bending share an amplitude.
        begin: (6,) standard deviations of the rest, larger than any, with which the search for amplitudes begins.
    """

    N: Tensor
    g: Tensor
    C: Tensor
    b: Tensor
    ties: Sequence[int]
    begin: Tensor

    def lens(self, held: float = 1.0) -> _ByView:
        """By θ alone, motions integrated out, with this share of their variances; the board as it is."""
        count = len(self.ties)
        own, inner = slice(count, count + _SIZE), self.N[:, :count, :count]
        rest = torch.cat([self.N[:, :count, own], self.g[:, :count, None], self.C[:, :count]], 2)
        gone = torch.linalg.solve(inner + torch.eye(count, dtype=torch.float64) / held, rest)
        left = torch.cat([self.N[:, own, own], self.g[:, own, None], self.C[:, own]], 2) - rest[..., :_SIZE].mT @ gone
        shared = rest[..., _SIZE + 1 :].mT @ gone[..., _SIZE:]
        N, g, C = left[..., :_SIZE], left[..., _SIZE], left[..., _SIZE + 1 :]
        H = torch.eye(C.shape[-1], dtype=torch.float64) - shared[..., 1:].sum(0)
        return _ByView(N, g, *_unit_weight(H, C, self.b - shared[..., 0]), (), self.begin[:_SIZE])

    @functools.cached_property
    def joint(self) -> _Joint:
        """By θ off its mean, lens and board at their best."""
        g, N, C = self.g - self.C @ self.b.sum(0), self.N, self.C - self.C.mean(0)
        # The mean is that of the camera, which hardly anything but its prior tells from the lens.
        one = torch.eye(_SIZE, dtype=torch.float64).expand_as(N)
        off = (N - 0.5 * N.mean(0)) / len(N)
        return _Joint(N, torch.cat([one, off, C], 2), torch.cat([off, one, C], 2), g - g.mean(0))

    def score(self, own: list[int]) -> float:
        """Standard deviations by which the slopes by these numbers of θ are steeper than by noise alone."""
        N, F, G, g = self.joint
        N, F, G = N[:, own][..., own], F[:, own], G[:, own]
        noise = torch.einsum("vaa->", N) - (F * G).sum()
        square = N.square().sum() - 2.0 * ((N @ F) * G).sum()
        square += (products_of(F.flatten(0, 1).T) * products_of(G.flatten(0, 1).T)).sum()
        return float((g[:, own].square().sum() - noise) / (2.0 * square).sqrt())

    def later(self, most: Tensor) -> Tensor:
        """(3,) root of the mean square of θ in views to come, by all deviations up to `most` (3,) and their evidence.

        So it has room for the error of the likeliest deviation, and for a lens that moves though that is not proven.
        Zeros where the evidence is against it.
        """
        N, F, G, g = self.joint
        basis = _felt(F[..., 2 * _SIZE :], most)
        F, G = (torch.cat([part[..., : 2 * _SIZE], part[..., 2 * _SIZE :] @ basis], 2) for part in (F, G))
        squares, nats = 4.0 ** -torch.arange(0.0, 6.5, 0.5, dtype=g.dtype), list[Tensor]()
        for root in squares.sqrt()[:, None] * most:
            own = torch.eye(_SIZE, dtype=g.dtype) + root[:, None] * N * root
            at = torch.linalg.solve(own, root[:, None] * torch.cat([F, g[..., None]], 2))
            across = (root[:, None] * G).flatten(0, 1).T @ at.flatten(0, 1)
            left = torch.eye(F.shape[2], dtype=g.dtype) - across[:, :-1]
            gained = (root * g * at[..., -1]).sum()
            gained += (root * g).flatten() @ at[..., :-1].flatten(0, 1) @ torch.linalg.solve(left, across[:, -1])
            nats.append(0.5 * (gained - torch.logdet(own).sum() - torch.linalg.slogdet(left).logabsdet))
        odds = math.log(_MOVING / (1.0 - _MOVING) / len(squares))
        likely = torch.cat([g.new_zeros(1), odds + torch.stack(nats)]).softmax(0)
        return most * (likely[1:] @ squares).sqrt() * (likely[0] < 1.0 - _MOVING)

    def total(self, theta: Tensor) -> Tensor:
        """(...) the change of χ² by θ (..., V, 3)."""
        return ((self.joint.g + self.joint.slope(theta)) * theta).sum((-2, -1))

    def best(self, second: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The best θ of both groups (..., 2, 3), its covariance (..., 6, 6), and by how many nats it is likelier (...).

        `second` (..., V) tells which views are in the second group.
        """
        N, F, G, g = self.joint
        groups, unit = torch.stack([~second, second], -2).to(g.dtype), self.begin[:_SIZE].repeat(2)
        summed, of_F, of_G = ((groups @ part.flatten(1)).unflatten(-1, part.shape[1:]) for part in (N, F, G))
        K = -of_F.flatten(-3, -2) @ of_G.flatten(-3, -2).mT
        K.unflatten(-1, (2, -1)).unflatten(-3, (2, -1)).diagonal(dim1=-4, dim2=-2).add_(summed.movedim(-3, -1))
        inverse = unit[:, None] * torch.linalg.pinv(unit[:, None] * K * unit, rtol=_ALIKE, hermitian=True) * unit
        slope = (groups @ g).flatten(-2)
        both = -(inverse @ slope[..., None])[..., 0]
        return both.unflatten(-1, (2, _SIZE)), inverse, -0.5 * (slope * both).sum(-1)

    def by_group(self, second: Tensor) -> Tensor:
        """(..., V) of χ² with each view in the second group, less that with it in the first one."""
        joint, both = self.joint, self.best(second)[0]
        theta = torch.where(second[..., None], both[..., 1:, :], both[..., :1, :])
        apart = both[..., 1, :] - both[..., 0, :]
        bend = torch.einsum("...a,vab,...b->...v", apart, joint.N - joint.F @ joint.G.mT, apart)
        return 2.0 * (joint.slope(theta) @ apart[..., None])[..., 0] + torch.where(second, -bend, bend)

    def spread(self, tied: Sequence[int]) -> _Spread:
        """Normal motions and others, whose amplitudes have the largest evidence; `tied` tells which are one.

        Variances become the mean squares over the number of views that tell of them (MacKay, 1992), where that does not
        raise the evidence, those of expectation maximization, which is safe and slow.
        """
        count, tied = len(self.ties), tied[: len(self.begin)]
        ties = torch.tensor([*self.ties, *tied])
        index = (ties >= 0).nonzero()[:, 0]
        if not len(index):
            zeros = self.g.new_zeros(len(self.g), len(tied))
            return _Spread(0.0, zeros[:, 0], zeros[0], zeros)
        N, g, one = self.N[:, index[:, None], index], self.g[:, index], torch.eye(len(index), dtype=torch.float64)
        C, widest = self.C[:, index], torch.cat([self.g.new_ones(count), self.begin.square()])[index]
        basis = _felt(C, widest.sqrt())
        C, each_b = matrix_product(C, basis), self.b @ basis
        b, free = each_b.sum(0), torch.eye(basis.shape[1], dtype=torch.float64)
        share = (ties[index] == ties[index, None]).double()
        share = share / share.sum(1)
        variance = safe = share @ torch.where(index < count, _LESS, widest)
        least, found = math.inf, (g[:, 0], variance, g)
        for _ in range(_STEPS):
            root = variance.sqrt()
            inner = torch.linalg.cholesky(one + root[:, None] * N * root)
            half = torch.linalg.solve_triangular(inner, torch.diag(root), upper=False)
            by_shared, by_own = matrix_product(half, C), (half @ g[..., None])[..., 0]
            flat = by_shared.flatten(0, 1)
            M, unsolved = torch.linalg.cholesky_ex(free - products_of(flat.T))
            y = -torch.cholesky_solve((b - flat.T @ by_own.flatten())[:, None], M)[:, 0]
            mean = -(half.mT @ (by_own + by_shared @ y)[..., None])[..., 0]
            nats = -0.5 * ((mean * g).sum(-1) + each_b @ (y + b)) - inner.diagonal(dim1=1, dim2=2).log().sum(1)
            nats -= M.diagonal().log().sum() / len(nats)
            loss = -float(nats.sum())
            if unsolved or not loss <= least:
                variance, least = safe, math.inf
                continue
            found, gained, least = (nats, root, mean), least - loss, loss
            if gained < _SETTLED:
                break
            others = matrix_product(half.mT, by_shared).flatten(0, 1).T
            others = torch.linalg.solve_triangular(M, others, upper=False).square().sum(0)
            spread = share @ (half.square().sum(1) + others.view(mean.shape)).mean(0)
            squares = share @ mean.square().mean(0)
            safe, known = squares + spread, (variance - spread).clamp_min(1e-300)
            variance = torch.minimum(variance * (squares / known).clamp(*_STEP), _MOST * widest)
        nats, root, mean = found
        sigma, each = N.new_zeros(len(ties)), N.new_zeros(len(N), len(ties))
        sigma[index], each[:, index] = root, mean
        # A second amplitude must be worth it, and a scale, by which a lens that is not quite as modeled seems to move.
        paid = 0.5 * len(ties[index].unique()) * math.log(len(N)) + WORTH * (max(0, *tied) + (tied[0] >= 0))
        return _Spread(float(nats.sum()) - paid, nats, sigma[count:][: len(tied)], each[:, count:])


class _Joint(NamedTuple):
    """χ² by θ of all views, 2 gᵀθ + θᵀKθ, K being block diagonal but for a matrix of low rank.

    Attributes:
        N: (V, 3, 3) of K = N - FGᵀ.
        F: (V, 3, R).
        G: (V, 3, R).
        g: (V, 3).
    """

    N: Tensor
    F: Tensor
    G: Tensor
    g: Tensor

    def slope(self, theta: Tensor) -> Tensor:
        """(..., V, 3) g + Kθ, of θ (..., V, 3)."""
        shared = theta.flatten(-2) @ self.G.flatten(0, 1)
        return self.g + (self.N @ theta[..., None])[..., 0] - (shared @ self.F.flatten(0, 1).T).view(theta.shape)


class _Spread(NamedTuple):
    """Numbers of all views that are normal about zero.

    Attributes:
        nats: by which they are likelier than zeros, the choice of amplitudes paid for.
        by_view: (V,) nats of each view.
        sigma: (X,) standard deviations.
        mean: (V, X) of each view.
    """

    nats: float
    by_view: Tensor
    sigma: Tensor
    mean: Tensor

    def beyond(self, other: _Spread) -> float:
        """Nats by which this is likelier than another one, without the view that tells most: it may be a wrong one."""
        return self.nats - other.nats - float((self.by_view - other.by_view).max().clamp_min(0.0))


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
            state, none = BoardState.flat(result.camera.params.detach(), *poses), pixels.new_zeros(len(used), _SIZE)
            problem = BoardProblem(result.board_points, pixels, result.camera.model, _INDICES)
            begin = _widths(seen.image_size)
            views = _by_view(
                problem, state, max(result.noise, LEAST_NOISE), none, begin, none.new_zeros(len(problem.free))
            )
            if _likeliest(views, _LENS).nats < WORTH:
                return result
            own = CalibrationOptions(board=options.board, motion=options.motion, bending=options.bending)
            fit = fit_by_options(seen, pixels, None, None, own, progress)
        found = own_lenses(fit, seen, pixels, own, progress, theta)
        strays, wrong = stray_corners(fit.residuals), list[Finding]()
        if found is not None and found.nats and bool(strays.any()):
            wrong = outlier_findings(seen.names, fit.residuals, strays)
            # One wrong corner would make two cameras of the views.
            progress("again without corners that noise cannot explain")
            pixels, weights = pixels.masked_fill(strays[..., None], torch.nan), fit.weights.masked_fill(strays, 0.0)
            found = own_lenses(fit_by_options(seen, pixels, weights, fit, own, progress), seen, pixels, own, progress)
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
    """
    views = _of_fit(fit, pixels, torch.zeros_like(pixels[:, 0, :1]).expand(-1, _SIZE))
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
        spreads = found.beyond(none) >= 0.0
    if not spreads:
        # Two values may be likelier where no spread is: motions that are held back do not hide the groups.
        held = views.lens(_LESS)
        second = _grouped(held, held.spread(_LENS[-1]).mean, fit.size)
        if not _FEWEST_OTHERS <= int(second.sum()) <= len(second) - _FEWEST_OTHERS:
            return normal
        if about.best(second)[2] < _PROMISED * _parted(about, second, fit.size)[2]:
            return normal
    else:
        for turn in range(_ROUNDS):
            views = refits.with_own(found.mean[:, :_SIZE] if turn or theta is None else theta)
            found = _likeliest(views, _LENS)
            if refits.rest:
                break
        about = views.lens()
        found = _likeliest(about, _LENS)
        nats = found.nats + refits.nats(about)
        second = _grouped(about, found.mean, fit.size)
        if nats >= _SURE:
            # About the likeliest ones, no more than these are thinkable.
            sigma = about.later(8.0 * found.sigma[:_SIZE])
            normal = OwnLenses(fit=refits.widened(sigma), sigma=sigma, theta=refits.theta, nats=nats)
            if about.best(second)[2] < _BEHIND * found.nats:
                return normal
    return _two_cameras(refits, about, second, max(nats, 0.0)) or normal


def _likeliest(views: _ByView, ways: Sequence[Sequence[int]]) -> _Spread:
    return max((views.spread(tied) for tied in ways), key=lambda spread: spread.nats)


class _Refits:
    """Fits of pixels from which a θ of each view was taken away, each begun where the last one ended."""

    def __init__(
        self, first: HybridFit, seen: Observations, pixels: Tensor, options: CalibrationOptions, progress: Progress
    ) -> None:
        self.first = self.fit = first
        self.seen, self.pixels, self.options, self.progress = seen, pixels, options, progress
        self.theta, self.step, self.rest = pixels.new_zeros(len(pixels), _SIZE), math.inf, False

    @property
    def undone(self) -> Tensor:
        """(V, N, 2) pixels as one camera shows them."""
        center, theta = self.first.state.parameters[2:4], self.theta[:, None]
        return (self.pixels - center - theta[..., 1:]) * torch.exp(-theta[..., :1]) + center

    def with_own(self, theta: Tensor, ahead: float = 0.0) -> _ByView:
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

    def nats(self, views: _ByView) -> float:
        """By which the last fit is likelier than the first one, were θ zero in it."""
        fit, first = self.fit, self.first
        # Evidence of views that move is found before they are tempered.
        tempering = fit.tempering if fit.readout is None and first.readout is None else 1.0
        gained = _evidence_at(fit, tempering) - _evidence_at(first, tempering)
        # Pixels were moved, and scaled.
        counts = self.pixels[..., 0].isfinite().sum(1)
        return gained + 0.5 * float(views.total(self.theta)) - 2.0 * float((counts * self.theta[:, 0]).sum())


def _parted(views: _ByView, second: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor, float]:
    """The best θ of two groups (2, 3), the covariance (3, 3) of their difference, and the price of both in nats.

    The price is that of these numbers, and of a group for each view; `second` (V,) is one of them.
    """
    both, of_both, _ = views.best(second)
    sign = of_both.new_tensor([-1.0, 1.0])
    covariance = torch.einsum("i,iajb,j->ab", sign, of_both.view(2, _SIZE, 2, _SIZE), sign)
    unit, share = _widths(size), float(second.double().mean())
    known = torch.eye(_SIZE, dtype=torch.float64) + torch.linalg.pinv(covariance) * unit * unit[:, None]
    mixed = -sum(part * math.log(part) for part in (share, 1.0 - share) if part > 0)
    return both, covariance, 0.5 * float(torch.logdet(known)) + 0.5 * math.log(len(second)) + len(second) * mixed


def _grouped(views: _ByView, mean: Tensor, size: tuple[int, int]) -> Tensor:
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


def _two_cameras(refits: _Refits, views: _ByView, second: Tensor, nats: float) -> OwnLenses | None:
    """Two groups of views, if two values of θ are likelier than normal ones, which are by so many nats."""
    refits.step, before = math.inf, second
    for _ in range(_ROUNDS):
        if not _FEWEST_OTHERS <= int(second.sum()) <= len(second) - _FEWEST_OTHERS:
            return None
        # Ahead of a view that changed its group it would be in neither one, and change again.
        ahead = _AHEAD if torch.equal(second, before) else 0.0
        views, before = refits.with_own(views.best(second)[0][second.long()], ahead).lens(), second
        moved = views.by_group(second) < 0.0
        if refits.rest and torch.equal(moved, second):
            break
        second = moved
    second = second if 2 * int(second.sum()) <= len(second) else ~second
    fit = refits.fit
    both, covariance, price = _parted(views, second, fit.size)
    change = both[1] - both[0]
    unlikely = change / _widths(fit.size)
    likelier = refits.nats(views) + float(views.best(second)[2] - 0.5 * unlikely.square().sum()) - price
    if likelier < nats + WORTH:
        return None
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
    change, half = sigma.new_zeros(len(fit.information.slots), _SIZE), torch.zeros_like(fit.half)
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


def _of_fit(fit: HybridFit, pixels: Tensor, theta: Tensor) -> _ByView:
    """Of a fit's views, about no motion and no θ; `theta` (V, 3) was taken away from the pixels."""
    # Errors that repeat within a view count less: a lens that does not quite fit is none that moves.
    shapes, noise = fit.board_shapes.shapes, max(fit.sigma, LEAST_NOISE)
    problem = _problem(fit, pixels, hybrid_unknowns(fit.model, fit.square), shapes)
    begin, state = torch.cat([_widths(fit.size), _APART * fit.board_shapes.unit[:_SIZE]]), fit.state
    deviation = torch.where(fit.half.any(0), fit.families.deviation(fit.expected), 0.0)
    # Numbers of one amplitude have the same logarithm.
    ties = _OTHER + by_number(np.arange(float(len(fit.log_ratio)))).unique(return_inverse=True)[1]
    state = state._replace(board=theta.new_zeros(len(shapes)))
    spread = noise / fit.stillness.sqrt()
    return _by_view(problem, state, noise, theta, begin, deviation, spread, tuple(ties.tolist()))


def _by_view(
    problem: BoardProblem,
    state: BoardState,
    noise: float,
    theta: Tensor,
    begin: Tensor,
    deviation: Tensor,
    spread: Tensor | float = 1.0,
    ties: Sequence[int] = (),
) -> _ByView:
    """Of what a problem's views show; `deviation` (S,) of the priors of lens and board, zero where held."""
    local, slots, motion = problem.local_size, problem.free.slots, state.motion
    spread = torch.as_tensor(spread, dtype=torch.float64).expand_as(motion)
    grams, H = list[Tensor](), torch.eye(int((deviation > 0).sum()), dtype=torch.float64)
    for first in range(0, len(theta), _TOGETHER):
        views = slice(first, first + _TOGETHER)
        rows = problem.corner_rows(state, views)
        shared = rows[:, local:-1]
        zoom = state.parameters[0] * shared[:, slots[0]]
        if slots[1] != slots[0]:
            zoom = zoom + state.parameters[1] * shared[:, slots[1]]
        lens = torch.cat([zoom[:, None], shared[:, list(slots[2:4])]], 1)
        own, bends = rows[:, POSE:local] * spread[views, :, None], shared[:, len(problem.free) :][:, :_SIZE]
        shared, size = (shared * deviation[:, None])[:, deviation > 0], local - POSE + _SIZE + bends.shape[1]
        off = without_local(torch.cat([rows[:, :POSE], own, lens, bends, shared, rows[:, -1:]], 1), POSE) / noise
        grams.append(matrix_product(off[:, :size], off.mT))
        H += products_of(off[:, size:-1].transpose(0, 1).flatten(1))
    gram = torch.cat(grams)
    N, C = gram[..., : (size := gram.shape[1])], gram[..., size:-1]
    x = torch.cat([motion / spread.clamp_min(1e-30), theta], 1)
    x = torch.nn.functional.pad(x, (0, size - x.shape[1]))[..., None]
    g = gram[..., -1] - (N @ x)[..., 0]
    # There is no better lens and board than those of the state.
    return _ByView(N, g, *_unit_weight(H, C, -(C.mT @ x)[..., 0]), ties, begin)


def _felt(C: Tensor, widest: Tensor) -> Tensor:
    """(S, R) combinations of lens and board that the widest movements (X,) of views feel; C (V, X, S) are products."""
    felt, basis = torch.linalg.eigh(products_of((C * widest[:, None]).flatten(0, 1).T))
    return basis[:, felt > _UNFELT]


def _unit_weight(H: Tensor, C: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """C (V, X, S) and b (V, S) by combinations of unit weight of unknowns whose products are H (S, S)."""
    both = torch.cat([C, b[:, None]], 1)
    flat = torch.linalg.solve_triangular(torch.linalg.cholesky(H), both.flatten(0, 1).T, upper=False)
    both = flat.T.view(both.shape)
    return both[:, :-1], both[:, -1]


def _widths(size: tuple[int, int]) -> Tensor:
    """(3,) of the prior of what parts two cameras."""
    return torch.tensor([_APART, *[_APART_CENTER * math.hypot(*size)] * 2], dtype=torch.float64)
