"""Find one camera's minimum: start, priors, weights. `assess` tells how good it is."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.camera.advice import check_directions
from kcal.calibrate.camera.checks import (
    MINIMUM_VIEWS,
    check_views,
    least_planar,
    leave_out_outliers,
    noise_scale,
    stray_corners,
    without,
)
from kcal.calibrate.camera.result import CalibrationOptions, CameraCalibrationResult, OutlierRejection, Progress
from kcal.calibrate.camera.warnings import (
    NO_ERROR_BARS,
    dispersion_findings,
    general_findings,
    outlier_findings,
    prior_findings,
    rival_findings,
)
from kcal.calibrate.hybrid.base_fit import fit_projection
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.parameters import CoefficientPrior, FoldBarrier, GaussianPrior, Term, is_overparameterized
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import (
    LEAST_NOISE,
    CameraViews,
    dispersion_of,
    information_of,
    noise_variance,
    poses_under,
    uncertainty_of,
    unflip,
    whitening,
)
from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.gaussian import Covariance
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.model import LensModel, radius_over_angle
from kcal.lens.projection import INTRINSICS
from kcal.solve.lm import LMOptions, Result, RobustLoss, SolverStatus, minimize

# Where a parametric camera begins: at the base projection of the hybrid lens, whose curve its own terms follow.

# Largest angle off the axis, degrees, that terms of tan θ follow, and how far beyond the outermost corner they do.
_STEEPEST, _BEYOND = 84.0, 1.05
# Standard deviation of the curve, in focal lengths, against the width of the coefficients' prior, in shares of their
# radius: terms that nearly cancel stay small.
_CURVE, _WIDTH = 1e-4, 0.3
# Terms of each polynomial of a ratio that follow: more would nearly cancel.
_RATIONAL = 3
# Height of the barrier before a fold, in units of the noise.
_BARRIER = 0.3


class LensStart(NamedTuple):
    """Where a fit begins.

    Attributes:
        state: camera and poses.
        terms: a barrier before folds of the lens, if there is one that the state keeps.
    """

    state: BoardState
    terms: tuple[Term, ...]


def first_states(
    views: CameraViews, model: LensModel, focal: float | None, *, barrier: bool
) -> tuple[list[LensStart], float, int]:
    """Begin at the base projection: with the model's own curve, and without distortion.

    Args:
        views: the data.
        model: the lens model.
        focal: a focal length to begin with, or None.
        barrier: whether the lens must not fold within the image, nor else around the corners that were seen.

    Returns:
        those of the two that show all corners, or the second alone; the noise of the base projection in pixels; and the
        trial steps spent.
    """
    ones = torch.ones_like(views.pixels[..., 0])
    fixed = views.constraints.fixed
    known = fixed.get("fx", fixed.get("fy"))
    base = fit_projection(
        views.board_points, views.pixels, views.size, ones, known_focal=known or focal, exact_focal=known is not None
    )
    points = views.board_points @ base.state.rotation.mT + base.state.translation[:, None]
    angle = torch.atan2(points[..., :2].norm(dim=-1), points[..., 2])
    widest = _BEYOND * float(torch.where(torch.isfinite(views.pixels).all(-1), angle, 0.0).max())
    lens = follow_base(base.shape, widest, model, fixed)
    noise = math.sqrt(base.variance)
    states = []
    for own in (lens, torch.zeros_like(lens)):
        parameters = views.constraints.impose(torch.cat([base.state.parameters[:5], own]), model)
        states.append(BoardState.flat(parameters, base.state.rotation, base.state.translation))
    shown = [state for state in states if math.isfinite(float(views.problem(model).cost(state)))] or states[1:]
    height = _BARRIER * noise
    return [LensStart(s, _barrier(views, s, model, height) if barrier else ()) for s in shown], noise, base.steps


def _barrier(views: CameraViews, state: BoardState, model: LensModel, weight: float) -> tuple[Term, ...]:
    """A barrier before folds in the image, else around the corners that were seen; none where the state folds there."""
    values = torch.cat([state.parameters, state.board])
    for radius in (views.regular_radius(state, model), views.seen_radius(state)):
        term = FoldBarrier(model, radius, weight)
        if bool(term.rows(values).isfinite().all()):
            return (term,)
    return ()


def follow_base(shape: float, widest: float, model: LensModel, fixed: Mapping[str, float]) -> Tensor:
    """Lens coefficients (P,) whose radial terms follow a base projection; all others are zero.

    A ratio of polynomials is fitted linearly, and again with weights from the last denominator (Sanathanan and Koerner
    1963). Coefficients that the curve leaves open stay as small as a prior has them.

    Args:
        shape: of the base projection (`kcal.lens.model`).
        widest: angle off the axis, radians, up to which it is followed.
        model: the lens model.
        fixed: coefficients that are held, by name.

    Example:
        >>> lens = follow_base(0.25, 0.6, LensModel.named("opencv5"), {})  # stereographic, 2 tan(θ / 2)
        >>> r = torch.tensor(0.6).double().tan()
        >>> found = r * (1 + lens[0] * r**2 + lens[1] * r**4 + lens[4] * r**6)
        >>> bool((found - 2 * torch.tensor(0.3).double().tan()).abs() < 2e-4)
        True
    """
    top, bottom = list(model.numerator_index), list(model.denominator_index)
    if bottom:
        top, bottom = top[:_RATIONAL], bottom[:_RATIONAL]
    out = torch.tensor([fixed.get(name, 0.0) for name in model.names], dtype=torch.float64)
    free = [k for k, i in enumerate([*top, *bottom]) if model.names[i] not in fixed]
    if not free:
        return out
    angle = torch.linspace(0.0, 1.0, 200, dtype=torch.float64)[1:]
    angle = angle * (widest if model.wide else min(widest, math.radians(_STEEPEST)))
    radius = angle if model.wide else torch.tan(angle)
    ratio = angle * radius_over_angle(torch.tensor(shape, dtype=torch.float64) * angle**2) / radius
    s = radius**2
    powers = [s ** (j + 1) for j in range(len(top))] + [-ratio * s ** (j + 1) for j in range(len(bottom))]
    columns, chosen = torch.stack(powers, -1), [[*top, *bottom][k] for k in free]
    weights = CoefficientPrior(_WIDTH, float(radius[-1])).term(model, _CURVE)
    ridge = torch.diag(weights.weight[[weights.index.tolist().index(len(INTRINSICS) + i) for i in chosen]])
    denominator = torch.ones_like(s)
    for _ in range(10 if bottom else 1):
        weight = radius / denominator
        target = ratio - 1.0 - columns @ out[[*top, *bottom]].index_fill(0, torch.tensor(free), 0.0)
        rows = torch.cat([columns[:, free] * weight[:, None], ridge])
        right = torch.cat([target * weight, torch.zeros(len(free), dtype=torch.float64)])
        out[chosen] = torch.linalg.lstsq(rows, right[:, None]).solution[:, 0]
        denominator = 1.0 + sum((s ** (j + 1) * out[i] for j, i in enumerate(bottom)), start=torch.zeros_like(s))
    return out


def known_model(camera: Camera, views: CameraViews, names: Sequence[str]) -> BoardState:
    """Begin with a known camera and the board poses under it."""
    camera = Camera(camera.params.detach().cpu(), size=camera.size, model=camera.model)
    if camera.size != views.size:
        raise InputError(f"the known camera is of {camera.size} px, the observations of {views.size} px")
    state, _ = poses_under(camera, views, LMOptions(max_iterations=30))
    poor = state.translation.isnan().any(-1).nonzero()[:, 0].tolist()
    if poor:
        raise InputError(
            f"view {names[poor[0]]!r}: the known camera gives too few of its corners a ray; remove the view, or "
            "calibrate without a known camera"
        )
    return state


# Find one camera's minimum: start, priors, weights. `assess` tells how good it is.

# Maximum number of times the noise level that weights the priors is re-estimated, and the smallest relative change that
# is worth it: it moves the solution by less than 1e-4 standard deviations.
_PRIOR_ROUNDS, _SAME = 5, 1e-4
# For a solve that begins next to its solution.
_NEAR_DAMPING = 1e-8
# Priors count in proportion to this solution's noise; from there it is solved again to the end.
_ROUGH = LMOptions(max_iterations=60, tolerance=1e-6, initial_damping=1e-5)
# The weak prior that leads to where the corners alone decide.
_WEAK = 0.3
# Squared residuals of the barrier, in units of the noise, from which on a lens counts as held back by it.
_AT_BARRIER = 0.1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solution:
    """The minimum for one set of corners.

    Args:
        views: the corners, all counting alike, and what is known about the camera.
        problem: the final problem, with weights and loss; priors and barriers are those of corners that count alike.
        result: its result.
        rivals: costs and states of other solutions, all corners counting alike. Where one fits almost as well but lies
            far away, the corners alone do not determine the model.
        plain_cost: of this solution, likewise.
        spent: trial steps.
        variance: of the residuals along an axis when all corners count alike, px²; None where they do.
    """

    views: CameraViews
    problem: BoardProblem
    result: Result[BoardState]
    rivals: tuple[tuple[float, BoardState], ...]
    plain_cost: float
    spent: int
    variance: float | None

    def problem_for(
        self,
        pixels: Tensor,
        covariances: Tensor | None,
        loss: RobustLoss | None = None,
        terms: Sequence[Term] | None = None,
    ) -> BoardProblem:
        """The problem of any corners of this camera, with their weights and by default with this solution's terms."""
        weights = None if covariances is None or self.variance is None else whitening(covariances, self.variance)
        views = dataclasses.replace(self.views, pixels=pixels, whitening=weights, loss=loss)
        terms = self.problem.terms if terms is None else terms
        return views.problem(self.problem.model, self.problem.free, terms=terms)


def solve(observations: Observations, options: CalibrationOptions, progress: Progress) -> Solution:
    """Find the minimum for all corners given, as `calibrate_camera` describes it and with its errors."""
    return solve_corners(
        observations.board.points,
        observations.pixels(),
        observations.image_size,
        options,
        progress,
        covariances=observations.covariances(),
        names=observations.names,
    )


def solve_corners(
    board_points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    options: CalibrationOptions,
    progress: Progress,
    covariances: Tensor | None = None,
    names: Sequence[str] = (),
) -> Solution:
    """As `solve`, for tensors: board points (N, 3), pixels (V, N, 2), covariances (V, N, 2, 2), names of the views."""
    model, solver = options.lens, options.solver
    names = names or [f"view {i}" for i in range(len(pixels))]
    constraints, warp = options.constraints(size), options.board_warp
    views = CameraViews(board_points=board_points, pixels=pixels, free_warp=warp, size=size, constraints=constraints)
    unknowns = len(constraints.free_parameters(model)) + 2 * warp
    check_views(board_points, pixels, names, unknowns, fewest=MINIMUM_VIEWS if options.camera is None else 1)

    rich = options.camera is None and is_overparameterized(model)
    if options.camera is None:
        try:
            starts, noise, spent = first_states(views, model, options.start_focal(size), barrier=rich)
        except InputError as error:
            raise InputError(f"{error} Look first at {least_planar(board_points, pixels, names)}") from error
        progress("base projection")
        views = dataclasses.replace(views, prior_noise=min(noise, views.prior_noise))
    else:
        starts, spent = [LensStart(known_model(options.camera, views, names), ())], 0
        views = views.with_noise_of(starts[0].state, model)
    width = (options.weak_prior or _WEAK) if rich else None
    free = rich and options.weak_prior is None
    # Where the corners alone decide there are several minima: the lower one of two counts.
    found = [_solve_from(views, model, start, width, free, solver) for start in (starts if free else starts[:1])]
    spent += sum(one.spent for one in found)
    best = min(found, key=lambda one: torch.nan_to_num(one.result.cost, nan=torch.inf))
    views, result, terms = best.views, best.result, best.terms
    if result.status == SolverStatus.BAD_START:
        raise InputError(
            f"the lens {model} cannot show all corners where they are. Look first at "
            f"{least_planar(board_points, pixels, names)}: remove what is not this board and this camera, or leave the "
            "model out (the default lens leaves wrong views out)"
        )
    if views.constraints.has_priors:
        views, result, steps = _reweight_priors(views, model, terms, result, solver)
        spent += steps
    progress(str(model))
    plain, problem = views.lens_problem(model), views.lens_problem(model, terms)
    # Its cost without the barrier; `AT_BOUND` where the barrier matters.
    cost, status = plain.cost(result.state), result.status
    if result.converged and float(result.cost - cost) > _AT_BARRIER * float(cost) / plain.residual_count:
        status = torch.full_like(status, int(SolverStatus.AT_BOUND))
    result = dataclasses.replace(result, cost=cost, status=status)
    others = [one.led for one in found] + [one.result.state for one in found if one is not best]
    covariances = covariances if options.weighted else None
    solution = Solution(
        views=views,
        problem=problem,
        result=result,
        rivals=tuple((float(plain.cost(state)), state) for state in others if free),
        plain_cost=float(result.cost),
        spent=spent,
        # The residuals of the plain solution tell how much there is beyond the corners' own noise.
        variance=None if covariances is None else 2.0 * float(result.cost) / problem.residual_count,
    )
    if covariances is None and options.loss is None:
        return solution
    problem = solution.problem_for(pixels, covariances, options.loss)
    result = minimize(problem, result.state, solver)
    return dataclasses.replace(solution, problem=problem, result=result, spent=spent + int(result.iterations))


class _Found(NamedTuple):
    """The minimum next to a start.

    Attributes:
        views: with their priors.
        result: of the solver.
        terms: the barrier.
        led: a state on the way there, to which a prior has led.
        spent: trial steps.
    """

    views: CameraViews
    result: Result[BoardState]
    terms: tuple[Term, ...]
    led: BoardState
    spent: int


def _solve_from(
    views: CameraViews, model: LensModel, start: LensStart, width: float | None, free: bool, solver: LMOptions
) -> _Found:
    """Solve from a start.

    Args:
        views: the data.
        model: the lens model.
        start: see there.
        width: of a weak prior on the coefficients; None: there is none.
        free: the prior only leads to a minimum next to which the corners alone decide.
        solver: options.
    """
    known = views
    if width is not None:
        known = _with_prior(views, CoefficientPrior(width, views.observed_radius(start.state)))
    result = minimize(known.lens_problem(model, start.terms), start.state, solver if width is None else _ROUGH)
    led, spent = result.state, int(result.iterations)
    known = views if free else known
    if result.status != SolverStatus.BAD_START:
        state, flipped = unflip(known, model, result.state)
        if flipped or width is not None:
            result = minimize(known.lens_problem(model, start.terms), state, solver)
            spent += int(result.iterations)
    return _Found(known, result, start.terms, led, spent)


def _with_prior(views: CameraViews, prior: CoefficientPrior) -> CameraViews:
    return dataclasses.replace(views, constraints=dataclasses.replace(views.constraints, coefficient_prior=prior))


def _reweight_priors(
    views: CameraViews, model: LensModel, terms: tuple[Term, ...], result: Result[BoardState], solver: LMOptions
) -> tuple[CameraViews, Result[BoardState], int]:
    """Solve again with priors for the noise and the outermost corner of the solution, until these stay the same."""
    near, spent = dataclasses.replace(solver, initial_damping=_NEAR_DAMPING), 0
    for number in range(_PRIOR_ROUNDS):
        after = views.with_noise_of(result.state, model)
        reach = views.observed_radius(result.state)
        prior = views.constraints.coefficient_prior
        known = prior is None or abs(reach - prior.reach) <= _SAME * reach
        if number and known and abs(after.prior_noise - views.prior_noise) <= _SAME * after.prior_noise:
            break
        views = after if prior is None else _with_prior(after, dataclasses.replace(prior, reach=reach))
        result = minimize(views.lens_problem(model, terms), result.state, near)
        spent += int(result.iterations)
    return views, result, spent


# Assess a camera's solution: σ, covariance, residuals and doubts, as the result of its calibration.


def assess(observations: Observations, solution: Solution, options: CalibrationOptions) -> CameraCalibrationResult:
    """The result of a calibration, from its solution.

    Raises:
        DegenerateError: the views hardly determine where the camera sees what they show.
    """
    problem, solved = solution.problem, solution.result
    state = problem.tidy(solved.state)
    # A lens may fold exactly at a corner, where rounding decides whether it has an image.
    if not bool(torch.isfinite(problem.cost(state))):
        state = solved.state
    camera = Camera(state.parameters, size=observations.image_size, model=problem.model)
    squared, count = problem.pixel_errors(state).square().sum(-2), problem.seen.sum(-1)
    per_view, rms = torch.sqrt(squared.sum(-1) / count), float(torch.sqrt(squared.sum() / count.sum()))

    uncertainty, information, dispersion = _uncertainty(observations, solution, state, options.loss)
    free = problem.free
    slot = {camera.names[i]: k for i, k in zip(free.indices, free.slots, strict=True)}
    spread = free.by_parameter(uncertainty.matrix, len(camera.names))
    sigma = {name: float(uncertainty.sigma[k]) if bool(uncertainty.determined[k]) else None for name, k in slot.items()}
    fixed = tuple(name for name in camera.names if name in solution.views.constraints.fixed)
    sigma = {name: sigma.get(name) for name in camera.names if name in slot or name in fixed}
    status = SolverStatus(int(solved.status))
    doubts = []
    if uncertainty.computed:
        open_focal = any(not bool(uncertainty.determined[slot[name]]) for name in ("fx", "fy") if name in slot)
        check_directions(
            state.parameters,
            problem.model,
            problem.points(state),
            problem.seen,
            # Views that a poor lens does not fit have tilts enough.
            torch.full_like(spread, torch.inf) if open_focal else spread / dispersion,
            state.rotation,
            observations.names,
        )
        labels = free.labels(camera.names)
        lost = [name for name, known in zip(labels, uncertainty.determined.tolist(), strict=False) if not known]
    else:
        # Unknown is not the same as undetermined by the views.
        doubts, lost = [NO_ERROR_BARS], []
    weighted = problem.corner_residuals(solved.state, weighted=True)
    return CameraCalibrationResult(
        camera=camera,
        observations=observations,
        rms=rms,
        weighted_rms=None
        if problem.weights is None and problem.loss is None
        else float(torch.sqrt(2.0 * solved.cost / count.sum())),
        per_view_rms=per_view,
        residuals=problem.corner_residuals(state),
        cam_from_board_rotation=state.rotation,
        cam_from_board_translation=state.translation,
        board_warp=state.board if problem.free_board else None,
        sigma=sigma,
        fixed=fixed,
        led_by_prior=_led_by_prior(solution, camera.names, slot, uncertainty),
        status=status,
        iterations=solution.spent,
        covariance=spread,
        information=information,
        tempering=dispersion,
        findings=(
            *general_findings(observations.names, camera, rms, per_view, lost, status),
            *doubts,
            *rival_findings(camera, sigma, solution.rivals, solution.plain_cost, problem.residual_count),
            *dispersion_findings(str(problem.model), dispersion),
            *prior_findings(problem.terms, solved.state, solution.views.prior_noise),
            *outlier_findings(
                observations.names, weighted, stray_corners(weighted), "; this lens may need a richer model"
            ),
        ),
    )


class _Uncertainty(NamedTuple):
    """Covariance of the unknowns; what is said of the camera, None where that is not finite; see `dispersion_of`."""

    covariance: Covariance
    information: CameraInformation | None = None
    dispersion: float = 1.0


def _uncertainty(
    observations: Observations, solution: Solution, state: BoardState, loss: RobustLoss | None
) -> _Uncertainty:
    if not solution.problem.shared_size:
        # Under a known camera and a flat board nothing is shared by the views.
        return _Uncertainty(Covariance(state.parameters.new_zeros(0, 0), state.parameters.new_zeros(0)))
    # Barriers before folds are no information about the lens.
    known = [term for term in solution.problem.terms if isinstance(term, GaussianPrior)]
    plain = solution.problem_for(observations.pixels(), observations.covariances(), loss, known)
    linear = plain.linearize(state)
    count, residuals = plain.shared_size + 6 * len(state.translation), plain.residual_count + plain.prior_count
    variance = float(noise_variance(linear, residuals, count))
    dispersion = dispersion_of(plain, state, variance)
    variance *= dispersion
    if known and dispersion > 1.0:
        # Of priors is known how much they count.
        known = [dataclasses.replace(term, weight=term.weight * math.sqrt(dispersion)) for term in known]
        plain = solution.problem_for(observations.pixels(), observations.covariances(), loss, known)
        linear = plain.linearize(state)
    found = uncertainty_of(linear, variance)
    if not found.computed or not variance > 0 or not len(plain.free):
        return _Uncertainty(found, None, dispersion)
    return _Uncertainty(found, information_of(plain, state, math.sqrt(variance)).without_board(), dispersion)


def _led_by_prior(
    solution: Solution, names: Sequence[str], slot: Mapping[str, int], uncertainty: Covariance
) -> tuple[str, ...]:
    """Parameters whose variance would more than double without their prior."""
    led = []
    for term in solution.problem.terms:
        if isinstance(term, GaussianPrior):
            spread = solution.views.prior_noise / term.weight
            for index, sigma in zip(term.index.tolist(), spread.tolist(), strict=True):
                if float(uncertainty.sigma[slot[names[index]]]) ** 2 > 0.5 * sigma**2:
                    led.append(names[index])
    return tuple(led)


# Calibrate one camera with a parametric lens model, for exchange with other programs.

# To tell which corners are wrong: a loss that a few of them cannot spoil, its scale in units of the noise.
_ROUGH_FIT = LMOptions(max_iterations=40, tolerance=1e-8)
_CAUCHY_SCALE, _CAUCHY_ROUNDS = 3.0, 4


def calibrate_parametric(
    observations: Observations, options: CalibrationOptions, progress: Progress
) -> CameraCalibrationResult:
    """As `kcal.calibrate.camera.calibrate.calibrate_camera`, for a parametric model."""
    if options.reject is not None:
        return _without_outliers(observations, options, options.reject, progress)
    return assess(observations, solve(observations, options, progress), options)


def _without_outliers(
    observations: Observations, options: CalibrationOptions, rejection: OutlierRejection, progress: Progress
) -> CameraCalibrationResult:
    """Leave out corners and views that noise cannot explain."""
    first = solve(observations, options, progress)
    robust, spent = _robust_residuals(observations, first)
    spent += first.spent

    def fit(left: list[int], rejected: Tensor) -> tuple[Solution, Tensor]:
        nonlocal spent
        if len(left) == len(robust) and not bool(rejected.any()):
            return first, robust
        solution = solve(without(observations, left, rejected), options, progress)
        residuals, steps = _robust_residuals(without(observations, left, torch.zeros_like(rejected)), solution)
        spent += solution.spent + steps
        return solution, residuals

    kept = leave_out_outliers(observations, rejection, robust, fit, progress)
    used = without(observations, kept.views, kept.rejected)
    every = without(observations, kept.views, torch.zeros_like(kept.rejected))
    problem, state = kept.fit.problem_for(every.pixels(), every.covariances()), kept.fit.result.state
    plain, weighted = (problem.corner_residuals(state, weighted=own) for own in (False, True))
    result = assess(used, dataclasses.replace(kept.fit, spent=spent), options)
    return kept.complete(result, observations, plain, weighted)


def _robust_residuals(observations: Observations, solution: Solution) -> tuple[Tensor, int]:
    """Weighted residuals (V, N, 2) of all corners at a solution robust to a few wrong ones, and its trial steps.

    Infinite where the lens does not reach a corner at all.
    """
    state, spent = solution.result.state, 0
    whole = solution.problem_for(observations.pixels(), observations.covariances())
    for _ in range(_CAUCHY_ROUNDS):
        residuals = whole.corner_residuals(state, weighted=True)
        reached = torch.isfinite(residuals).all(-1)
        some = without(observations, range(len(observations.views)), whole.seen & ~reached)
        scale = max(_CAUCHY_SCALE * float(noise_scale(residuals.flatten(0, 1))), LEAST_NOISE)
        loss = RobustLoss(kind="cauchy", scale=scale)
        result = minimize(solution.problem_for(some.pixels(), some.covariances(), loss), state, _ROUGH_FIT)
        spent += int(result.iterations)
        if result.status == SolverStatus.BAD_START:
            break
        state = result.state
    residuals = whole.corner_residuals(state, weighted=True)
    unreached = whole.seen & ~torch.isfinite(residuals).all(-1)
    return torch.where(unreached[..., None], torch.inf, residuals), spent
