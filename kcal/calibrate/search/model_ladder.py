"""Fit richer lens models by starting from nested simpler ones, to avoid stopping at the nearest local minimum.

The cost of a rational lens has many minima: solves from zero and from the smaller model often end apart, and either can
be the lower. So each model is solved from several starts side by side, in one batch: every minimum kept so far, a start
without distortion, and starts whose numerator and denominator nearly cancel at a chosen radius. The minimum of the
smaller model is always among the candidates, so that a richer model never ends above the one nested in it.

Some minima reduce the cost a little by a fold or a pole just beyond the outermost corner. A lens that folds inside the
observed radius is never chosen; one that folds elsewhere in the image is chosen only where the gain is significant.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.batching import minimize
from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.calibrate.bundle.compressed_problem import CompressedProblem, compress
from kcal.calibrate.bundle.priors import FoldBarrier, Term
from kcal.calibrate.bundle.views import CameraViews
from kcal.calibrate.search.restarts import restart
from kcal.calibrate.search.starts import wide_starts
from kcal.lens.model import PRESETS, LensModel
from kcal.lens.projection import INTRINSICS, parameter_names
from kcal.solve.lm import LMOptions
from kcal.solve.result import Result, SolverStatus, pick, stack

# For each start of a batch; the best one is then solved to convergence.
_FIRST_SEARCH = LMOptions(max_iterations=150, tolerance=1e-9, flatness=1e-5)
_KEPT = 4
# Where the smaller model leaves more than this (pixels), the lens may be too wide for it.
SUSPICIOUS_RMS = 2.0
# How much χ² a lens that folds inside the image must gain on one that does not: 20 is far beyond chance for the few
# parameters that one model adds to the next.
_FOLD_CHI2 = 20.0
# Trial steps between two checks of a lens that is about to fold, and the number of checks.
_STEPS_PER_CHECK, _CHECKS = 12, 20
# With fewer corners than this, all starts are solved on all views.
_FEW_CORNERS = 1000
# Models through which minima are searched on compressed views.
_SEARCHED = ("opencv8", "opencv12", "opencv14", "ext16", "ext18", "ext20", "ext22")
# Those of them that are also solved on all views.
_SOLVED_FULLY = ("opencv14", "ext20", "ext22")
# With more corners than this there are no restarts from a solution: a batch of starts would take too long.
MANY_CORNERS = 4000
# How far all boards together may be rotated against the first model's at a lower minimum, radians.
_MOST_TURN = math.radians(7.0)
# Enough to tell the minima apart and to come close to the best one.
_SEARCH = LMOptions(max_iterations=60, tolerance=1e-7, initial_damping=1e-6)
# Height of the barrier before a fold, in units of the noise.
_BARRIER = 0.3
# For models that only lead to the next one.
_INTERMEDIATE = LMOptions(max_iterations=100, tolerance=1e-7, flatness=2e-5, initial_damping=1e-6)
# Squared residuals of the barrier, in units of the noise, from which on a lens counts as held back by it.
_AT_BARRIER = 0.1
# Of the cost: a solve that ends higher by less than this has not left its start.
_SAME = 1e-10
# Where starts with nearly canceling terms have their bump, as a fraction of the largest observed r².
_BUMPS = (0.1, 0.25, 0.5)
Progress = Callable[[str], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Minimum:
    """The minimum found for the last model.

    Args:
        result: the solver's.
        iterations: trial steps of all models and starts.
        rivals: other solutions for the last model as (cost, state): further minima, and the first model's solution.
            Where one fits almost as well but lies far away, the data do not determine the model.
        terms: the barriers that kept the lens regular.
    """

    result: Result[BoardState]
    iterations: int
    rivals: tuple[tuple[float, BoardState], ...] = ()
    terms: tuple[Term, ...] = ()


def nested_models(model: LensModel) -> list[LensModel]:
    """The models that lead to `model`, each nested in the next.

    Example:
        >>> [str(m) for m in nested_models(LensModel.named("opencv12"))]
        ['opencv5', 'opencv8', 'opencv12']
    """
    ladder = [
        PRESETS[name] for name in ("opencv5", "opencv8", "opencv12", "opencv14", "ext16", "ext18", "ext20", "ext22")
    ]
    below = [small for small in ladder if model.contains(small) and small != model]
    return [*below, model]


def embed(parameters: Tensor, small: LensModel, large: LensModel) -> Tensor:
    """The same lens (..., 5 + P) written with more coefficients, the new ones zero."""
    names = parameter_names(large)
    out = parameters.new_zeros((*parameters.shape[:-1], len(names)))
    out[..., [names.index(name) for name in parameter_names(small)]] = parameters
    return out


def embed_state(state: BoardState, small: LensModel, large: LensModel) -> BoardState:
    """Likewise a whole state."""
    return state._replace(parameters=embed(state.parameters, small, large))


def near_canceling(parameters: Tensor, model: LensModel, largest: float, place: float) -> Tensor:
    """Nearly the same lens, with a denominator that dips at r² = `place` x `largest` and a numerator that follows.

    The denominator is ((s - s0)² + w²) / (s0² + w²) with w = s0 / 2; the numerator is fitted to keep the ratio.

    Args:
        parameters: (5 + P,) of `model`, whose denominator is as yet zero.
        model: with numerator and denominator of at least order two.
        largest: greatest r² that was observed.
        place: between 0 and 1.
    """
    offset = len(INTRINSICS)
    top = [offset + i for i in model.numerator_index]
    bottom = [offset + i for i in model.denominator_index]
    s = torch.linspace(0.0, largest, 64, dtype=parameters.dtype)
    powers = torch.stack([s ** (j + 1) for j in range(len(top))], -1)
    ratio = 1.0 + powers @ parameters[top]
    s0 = place * largest
    w = 0.5 * s0
    dip = ((s - s0) ** 2 + w**2) / (s0**2 + w**2)
    out = parameters.clone()
    out[top] = torch.linalg.lstsq(powers, (ratio * dip - 1.0)[:, None]).solution[:, 0]
    out[bottom] = 0.0
    out[bottom[0]], out[bottom[1]] = -2.0 * s0 / (s0**2 + w**2), 1.0 / (s0**2 + w**2)
    return out


def solve_ladder(
    views: CameraViews,
    first: BoardState,
    undistorted: BoardState,
    models: Sequence[LensModel],
    options: LMOptions,
    progress: Progress,
) -> Minimum:
    """Solve a ladder of models for one camera.

    Args:
        views: the data.
        first: a solution of `models[0]`.
        undistorted: a state of `models[0]` without distortion.
        models: each nested in the next.
        options: of the final solves.
        progress: called with the name of each finished model.

    Returns:
        The lowest minimum found for the last model, among lenses without a fold or pole inside the observed radius.
    """
    small = models[0]
    if len(models) == 1:
        return Minimum(result=minimize(views.lens_problem(small), first, options), iterations=0)
    if views.corner_count <= _FEW_CORNERS or views.rms(first, small) > SUSPICIOUS_RMS:
        return _search_all_views(views, first, undistorted, models, options, progress)
    return _search_compressed(views, first, models, options, progress)


def _search_compressed(
    views: CameraViews, first: BoardState, models: Sequence[LensModel], options: LMOptions, progress: Progress
) -> Minimum:
    """Search each model's minima on the compressed problem, and solve from the best one on all views.

    Where that ends above the solution of the model before, it is solved again from there: a richer model never ends
    above the one nested in it.
    """
    small, radius, noise = models[0], views.regular_radius(first, models[0]), views.noise(first, models[0])
    observed = views.observed_radius(first)
    compressed = compress(views.problem(small), first, observed)
    kept, reached, spent = [first.parameters], first, 0
    solved = small
    for large in [model for model in models[1:-1] if str(model) in _SEARCHED] + [models[-1]]:
        terms = (FoldBarrier(large, radius, _BARRIER * noise),)
        starts = [embed(parameters, small, large) for parameters in kept]
        bumpy = large.denominator >= 2 and small.denominator == 0 and large.numerator >= 2
        if bumpy and views.constraints.coefficient_prior is None:
            starts += [near_canceling(starts[0], large, observed**2, place) for place in _BUMPS]
        starts = [views.constraints.impose(parameters, large) for parameters in starts]
        free, known = views.constraints.free_parameters(large), (*terms, *views.prior_terms(large))
        search = CompressedProblem(compressed, large, free, known, (len(starts),))
        found = minimize(search, search.start(torch.stack(starts)), _SEARCH)
        kept = [found.state.parameters[i] for i in _distinct(found.cost)]
        spent += int(found.iterations.max())
        small = large
        if large != models[-1] and str(large) not in _SOLVED_FULLY:
            continue
        ends = [search.expand(pick(found.state, i)) for i in _distinct(found.cost)]
        # To convergence also here: a richer model starts from the solution of the one nested in it.
        problem = views.lens_problem(large, terms=terms)
        result = minimize(problem, ends[0], options)
        nested = embed_state(reached, solved, large)
        spent += int(result.iterations)
        if not float(result.cost) <= float(problem.cost(nested)):
            result = minimize(problem, nested, options)
            spent += int(result.iterations)
        if views.corner_count <= MANY_CORNERS and views.constraints.coefficient_prior is None:
            result, steps = _lower_minimum(views, problem, large, first, result, options)
            spent += steps
        reached, solved = result.state, large
        if large != models[-1]:
            # The linear response of the poses is best at the latest solution.
            kept = [result.state.parameters, *kept[1:]]
            compressed = compress(views.problem(large), result.state, observed)
        progress(str(large))
    return minimum_of(views, result, terms, small, [embed_state(first, models[0], small), *ends[1:]], spent)


def _lower_minimum(
    views: CameraViews,
    problem: BoardProblem,
    model: LensModel,
    first: BoardState,
    result: Result[BoardState],
    options: LMOptions,
) -> tuple[Result[BoardState], int]:
    """The outcome of restarts, and the trial steps spent.

    A lower minimum is accepted only if its lens folds no more, and only if the camera's axis stays near that of the
    first model: a tilt can be traded against a rotation of the camera, with a tiny gain of RMS and absurd principal
    points.
    """
    limit = views.fold_penalty(result.state, model)

    def turn(state: BoardState) -> float:
        """Rotation of all boards together against the first model's, radians."""
        trace = float((state.rotation * first.rotation).sum((-2, -1)).mean())
        return math.acos(min(1.0, max(-1.0, 0.5 * (trace - 1.0))))

    most = max(_MOST_TURN, turn(result.state))
    found = restart(
        problem, result, options, lambda state: turn(state) <= most and views.fold_penalty(state, model) <= limit
    )
    return found, int(found.iterations)


def minimum_of(
    views: CameraViews,
    result: Result[BoardState],
    terms: tuple[Term, ...],
    model: LensModel,
    others: list[BoardState],
    spent: int,
) -> Minimum:
    """A minimum with its cost without the barrier; its status is `AT_BOUND` where the barrier matters."""
    plain = views.lens_problem(model)
    cost = plain.cost(result.state)
    status = result.status
    if result.converged and float(result.cost - cost) > _AT_BARRIER * float(cost) / plain.residual_count:
        status = torch.full_like(status, int(SolverStatus.AT_BOUND))
    result = dataclasses.replace(result, cost=cost, status=status)
    rivals = tuple((float(plain.cost(state)), state) for state in others)
    return Minimum(result=result, iterations=spent, rivals=rivals, terms=terms)


def _distinct(costs: Tensor) -> list[int]:
    """Indices of the lowest few costs, equal ones counted once."""
    kept: list[int] = []
    for i in torch.argsort(torch.nan_to_num(costs, nan=torch.inf)).tolist():
        cost = float(costs[i])
        if not kept or (math.isfinite(cost) and all(cost > (1.0 + 1e-6) * float(costs[k]) for k in kept)):
            kept.append(i)
    return kept[:_KEPT]


def _search_all_views(
    views: CameraViews,
    first: BoardState,
    undistorted: BoardState,
    models: Sequence[LensModel],
    options: LMOptions,
    progress: Progress,
) -> Minimum:
    """As `solve_ladder` with all starts on all views: for inaccurate poses, and for few views with many minima."""
    small = models[0]
    kept, spent = [first], 0
    for large in models[1:]:
        carried = [embed_state(state, small, large) for state in kept]
        starts = [*carried, embed_state(undistorted, models[0], large)]
        found = _solve_from(views, starts, small, large, options)
        kept = _ranked(views, found, carried[0], large)
        last = large == models[-1] or str(large) in _SOLVED_FULLY
        result, terms = _solve_within_barrier(views, kept[0], large, options if last else _INTERMEDIATE)
        spent += int(found.iterations.max()) + int(result.iterations)
        kept[0] = result.state
        small = large
        if views.constraints.has_priors:
            # Against the noise of a lens that fits badly priors would count far too much.
            views = views.with_noise_of(kept[0], large)
        if last and terms and views.corner_count <= MANY_CORNERS and views.constraints.coefficient_prior is None:
            problem = views.lens_problem(large, terms=terms)
            result, steps = _lower_minimum(views, problem, large, first, result, options)
            spent += steps
            kept[0] = result.state
        progress(str(large))
    return minimum_of(views, result, terms, small, [embed_state(first, models[0], small), *kept[1:]], spent)


def _fold_cost(cost: float, residual_count: int) -> float:
    """The gain of cost that justifies a fold in the image; exact data count as having noise of a thousandth pixel."""
    return _FOLD_CHI2 * max(cost / residual_count, 1e-6)


def barriers(views: CameraViews, state: BoardState, model: LensModel, radius: float) -> tuple[Term, ...]:
    """The barrier at a radius, if it is finite at `state`."""
    barrier = FoldBarrier(model, radius, _BARRIER * views.noise(state, model))
    return (barrier,) if bool(torch.isfinite(barrier.rows(torch.cat([state.parameters, state.warp]))).all()) else ()


def _solve_within_barrier(
    views: CameraViews, start: BoardState, model: LensModel, options: LMOptions
) -> tuple[Result[BoardState], tuple[Term, ...]]:
    """Solve to convergence within a barrier: around the corners seen, or around the image where that is not enough.

    The best of the solutions and the start is chosen, with a penalty on folds in the image. The cost without the
    barrier does not rise: where the barrier would push the start back, the start is the result.
    """
    plain = views.lens_problem(model)
    limit, before = views.fold_penalty(start, model), float(plain.cost(start))
    fold_cost = _fold_cost(before, plain.residual_count)
    # Where a solve ends at its start's minimum, rounding must not decide that the lens was held back at the start.
    held = before * (1.0 + _SAME)
    ends: list[tuple[float, Result[BoardState], tuple[Term, ...]]] = []
    for radius in (views.seen_radius(start), views.regular_radius(start, model)):
        terms = barriers(views, start, model, radius)
        problem = views.lens_problem(model, terms=terms)
        result = minimize(problem, start, options)
        penalty, cost = views.fold_penalty(result.state, model), float(plain.cost(result.state))
        if penalty > limit or cost <= held:
            ends.append((cost + fold_cost * penalty, result, terms))
        if penalty <= limit:
            break
    else:
        # A tilted lens can fold elsewhere than the barrier assumes: solve in short stretches, until just before.
        state = start
        for _ in range(_CHECKS):
            result = minimize(problem, state, dataclasses.replace(options, max_iterations=_STEPS_PER_CHECK))
            if views.fold_penalty(result.state, model) > limit:
                break
            state = result.state
            if int(result.status) != SolverStatus.ITERATION_LIMIT:
                break
        result = _held_at(result, state)
        ends.append((float(plain.cost(state)) + fold_cost * limit, result, terms))
    fallback = _held_at(result, start)
    ends.append((held + fold_cost * limit, fallback, terms))
    _, result, terms = min((end for end in ends if math.isfinite(end[0]) or end[1] is fallback), key=lambda end: end[0])
    return dataclasses.replace(result, cost=plain.cost(result.state)), terms


def _held_at(result: Result[BoardState], state: BoardState) -> Result[BoardState]:
    return dataclasses.replace(result, state=state, status=torch.full_like(result.status, int(SolverStatus.AT_BOUND)))


def _solve_from(
    views: CameraViews, starts: list[BoardState], small: LensModel, large: LensModel, options: LMOptions
) -> Result[BoardState]:
    """Solve for `large` from all starts and some more side by side, with a limited number of steps."""
    if large.denominator >= 2 and small.denominator == 0 and large.numerator >= 2:
        first = starts[0]
        if views.rms(first, large) > SUSPICIOUS_RMS:
            starts = [*starts, *wide_starts(views, large)]
        largest = views.observed_radius(first) ** 2
        bumps = [near_canceling(first.parameters, large, largest, place) for place in _BUMPS]
        starts = [*starts, *(first._replace(parameters=parameters) for parameters in bumps)]
    impose = views.constraints.impose
    starts = [state._replace(parameters=impose(state.parameters, large)) for state in starts]
    limited = dataclasses.replace(
        _FIRST_SEARCH, max_iterations=min(_FIRST_SEARCH.max_iterations, options.max_iterations)
    )
    return minimize(views.lens_problem(large, (len(starts),)), stack(starts), limited)


def _ranked(views: CameraViews, found: Result[BoardState], carried: BoardState, model: LensModel) -> list[BoardState]:
    """The best few minima that are lenses, best first; `carried` leads if none is as good."""
    problem = views.lens_problem(model)
    limit = float(problem.cost(carried))
    candidates = [(limit, carried)]
    for i in torch.argsort(torch.nan_to_num(found.cost, nan=torch.inf)).tolist():
        cost = float(found.cost[i])
        if math.isfinite(cost) and not any(abs(cost - other) <= 1e-7 * other for other, _ in candidates[1:]):
            candidates.append((cost, pick(found.state, i)))
    # In units of the noise variance, estimated from the best fit.
    fold_cost = _fold_cost(min(cost for cost, _ in candidates), problem.residual_count)
    ranked = [(cost > limit, cost + fold_cost * views.fold_penalty(state, model), state) for cost, state in candidates]
    # A richer model must not end above the one nested in it, whatever the penalty.
    ranked = sorted((entry for entry in ranked if math.isfinite(entry[1])), key=lambda entry: entry[:2])
    return [state for *_, state in ranked[:_KEPT]] or [carried]
