"""From a simple lens model to a rich one, step by step, without falling into the nearest hole.

The cost of a rational lens has many minima: a start from zero and a start from the smaller model often end apart, and
either can be the lower. So each step solves from several starts side by side, in one batch: every minimum kept so far,
a start without distortion, and starts whose numerator and denominator nearly cancel at a chosen radius. A minimum of
the smaller model, carried over unchanged, is always among the candidates, so that a richer model never ends above the
one nested in it.

Some minima buy a little cost with a fold or a pole just beyond the outermost corner. One inside the observed radius is
no lens and is never chosen; one elsewhere in the image is chosen only where the gain is significant.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.batching import Solve, Steps
from kcal.calibrate.bundle.board_problem import BoardProblem
from kcal.calibrate.bundle.compressed_problem import CompressedProblem, fold
from kcal.calibrate.bundle.priors import FoldBarrier, Term
from kcal.calibrate.bundle.views import Views
from kcal.calibrate.search.restarts import escape
from kcal.calibrate.search.starts import wide_starts
from kcal.lens.model import PRESETS, LensModel
from kcal.lens.projection import INTRINSICS, parameter_names
from kcal.solve.lm import LMOptions
from kcal.solve.result import Result, SolverStatus, State, pick, stack

# For each start of a batch; the best one is then taken to convergence.
_SCOUT = LMOptions(max_iterations=150, tolerance=1e-9, flatness=1e-5)
_KEPT = 4
# Where the smaller model leaves more than this (pixels), the lens may be too wide for it.
SUSPICIOUS_RMS = 2.0
# How much χ² a lens that folds inside the image must gain on one that does not: 20 is far beyond chance for the few
# parameters that a step of the ladder adds.
_FOLD_PRICE = 20.0
# Trial steps between two looks at a lens that is about to fold, and how often to look.
_STRETCH, _STRETCHES = 12, 20
# With fewer corners than this, all starts are solved on all views.
_FEW_CORNERS = 1000
# Models through which minima are searched on folded views.
_RUNGS = ("opencv8", "opencv12", "opencv14", "ext16", "ext18", "ext20", "ext22")
# Those of them that are solved on all views on the way.
_LANDINGS = ("opencv14", "ext20", "ext22")
# With more corners than this, valleys are not followed from the solution: a batch of starts would take too long.
MANY_CORNERS = 4000
# How far all boards together may be turned against the first model's at a lower minimum, radians.
_MOST_TURN = math.radians(7.0)
# Of a corner, pixels, where priors count against it.
LEAST_NOISE = 1e-3
# Enough to tell the minima apart and to come near the best one.
_SEARCH = LMOptions(max_iterations=60, tolerance=1e-7, initial_damping=1e-6)
# Height of the wall before a fold, in units of the noise.
_WALL = 0.3
# For models on the way: as good as their solution.
_LANDING = LMOptions(max_iterations=100, tolerance=1e-7, flatness=2e-5, initial_damping=1e-6)
# Squared residuals of the wall, in units of the noise, from which on a lens counts as held back.
_AT_WALL = 0.1
# Where near-canceling starts put their bump, as a fraction of the largest observed r².
_BUMPS = (0.1, 0.25, 0.5)
Progress = Callable[[str], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Minimum:
    """The end of a ladder.

    Args:
        result: the solver's, for the last model.
        iterations: trial steps spent on the way.
        rivals: other ends for the last model as (cost, state): further minima, and the first model's solution. Where
            one fits almost as well but lies far away, the data do not determine the model.
        terms: the bounds that held the solution to regular lenses.
    """

    result: Result
    iterations: int
    rivals: tuple[tuple[float, State], ...] = ()
    terms: tuple[Term, ...] = ()


def steps_to(model: LensModel) -> list[LensModel]:
    """The models to pass through on the way to `model`, each nested in the next.

    Example:
        >>> [str(m) for m in steps_to(LensModel.named("opencv12"))]
        ['opencv5', 'opencv8', 'opencv12']
    """
    ladder = [
        PRESETS[name] for name in ("opencv5", "opencv8", "opencv12", "opencv14", "ext16", "ext18", "ext20", "ext22")
    ]
    below = [step for step in ladder if model.contains(step) and step != model]
    return [*below, model]


def embed(parameters: Tensor, small: LensModel, large: LensModel) -> Tensor:
    """The same lens (..., 5 + P) written with more coefficients, the new ones zero."""
    names = parameter_names(large)
    out = parameters.new_zeros((*parameters.shape[:-1], len(names)))
    out[..., [names.index(name) for name in parameter_names(small)]] = parameters
    return out


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


def climb(
    views: Views, first: State, cold: State, models: Sequence[LensModel], options: LMOptions, progress: Progress
) -> Steps[Minimum]:
    """Solve a ladder of models for one camera.

    Args:
        views: the data.
        first: a solution of `models[0]`.
        cold: a state of `models[0]` without distortion.
        models: each nested in the next.
        options: of the final solves.
        progress: told the name of each finished model.

    Returns:
        The lowest minimum found for the last model. Among states that fold or meet a pole inside the radius that was
        observed none is chosen.
    """
    small = models[0]
    if len(models) == 1:
        result = yield Solve(views.problem(small), first, options)
        return Minimum(result=result, iterations=0)
    if views.corner_count <= _FEW_CORNERS or views.rms(first, small) > SUSPICIOUS_RMS:
        return (yield from _climb_wholly(views, first, cold, models, options, progress))
    return (yield from _climb_folded(views, first, models, options, progress))


def _climb_folded(
    views: Views, first: State, models: Sequence[LensModel], options: LMOptions, progress: Progress
) -> Steps[Minimum]:
    """Search each model's minima on the compressed problem, and solve from the best one on all views.

    Where that ends above the solution of the model before, it is solved again from there: a richer model never ends
    above the one nested in it.
    """
    small, radius, noise = models[0], views.regular_radius(first, models[0]), views.noise(first, models[0])
    observed = float(views.observed_radius(first))
    folded = fold(views.problem(small, poses_only=True), first, observed)
    kept, reached, spent = [first[0]], first, 0
    landed = small
    for large in [model for model in models[1:-1] if str(model) in _RUNGS] + [models[-1]]:
        terms = (FoldBarrier(large, radius, _WALL * noise),)
        starts = [embed(parameters, small, large) for parameters in kept]
        bumpy = large.denominator >= 2 and small.denominator == 0 and large.numerator >= 2
        if bumpy and views.rules.mild is None:
            starts += [near_canceling(starts[0], large, observed**2, place) for place in _BUMPS]
        starts = [views.rules.impose(parameters, large) for parameters in starts]
        known = (*terms, *views.rules.terms(large, views.prior_noise))
        search = CompressedProblem(folded, large, views.rules.parameters(large), known, (len(starts),))
        found = yield Solve(search, search.start(torch.stack(starts)), _SEARCH)
        kept = [found.state[0][i] for i in _distinct(found)]
        spent += int(found.iterations.max())
        small = large
        if large != models[-1] and str(large) not in _LANDINGS:
            continue
        ends = [search.unfold(pick(found.state, i)) for i in _distinct(found)]
        # To the end also on the way: what a richer model starts from is the solution of the one nested in it.
        problem = views.problem(large, terms=terms)
        result = yield Solve(problem, ends[0], options)
        nested = (embed(reached[0], landed, large), *reached[1:])
        spent += int(result.iterations)
        if not float(result.cost) <= float(problem.cost(nested)):
            result = yield Solve(problem, nested, options)
            spent += int(result.iterations)
        if views.corner_count <= MANY_CORNERS and views.rules.mild is None:
            result, steps = yield from _lower(views, problem, large, first, result, options)
            spent += steps
        reached, landed = result.state, large
        if large != models[-1]:
            # What is searched next answers best from here.
            kept = [result.state[0], *kept[1:]]
            folded = fold(views.problem(large, poses_only=True), result.state, observed)
        progress(str(large))
    others = [(embed(first[0], models[0], small), *first[1:]), *ends[1:]]
    return minimum_of(views, result, terms, small, others, spent)


def _lower(
    views: Views, problem: BoardProblem, model: LensModel, first: State, result: Result, options: LMOptions
) -> Steps[tuple[Result, int]]:
    """What lies further along the valleys, and the trial steps spent.

    It must be no less of a lens. Neither may the camera's axis be somewhere else altogether: a tilt can be traded
    against a turn of the camera, and far along that valley the last bit of RMS is bought with absurd principal points.
    """
    limit = views.trouble(result.state, model)

    def turn(state: State) -> float:
        """By how much all boards together are turned against the first model's, radians."""
        return math.acos(min(1.0, max(-1.0, 0.5 * (float((state[-2] * first[-2]).sum((-2, -1)).mean()) - 1.0))))

    most = max(_MOST_TURN, turn(result.state))

    def accepts(state: State) -> bool:
        return turn(state) <= most and views.trouble(state, model) <= limit

    found = yield from escape(problem, result, options, accepts)
    return found, int(found.iterations)


def minimum_of(
    views: Views, result: Result, terms: tuple[Term, ...], model: LensModel, others: list[State], spent: int
) -> Minimum:
    """A ladder's end, its cost without the wall; told `AT_BOUND` where the wall matters."""
    plain = views.problem(model)
    cost = plain.cost(result.state)
    status = result.status
    if result.converged and float(result.cost - cost) > _AT_WALL * float(cost) / plain.residual_count:
        status = torch.full_like(status, int(SolverStatus.AT_BOUND))
    result = dataclasses.replace(result, cost=cost, status=status)
    rivals = tuple((float(plain.cost(state)), state) for state in others)
    return Minimum(result=result, iterations=spent, rivals=rivals, terms=terms)


def _distinct(found: Result) -> list[int]:
    """The lowest few of a batch, those that ended in the same place counted once."""
    kept: list[int] = []
    for i in torch.argsort(torch.nan_to_num(found.cost, nan=torch.inf)).tolist():
        cost = float(found.cost[i])
        if not kept or (math.isfinite(cost) and all(cost > (1.0 + 1e-6) * float(found.cost[k]) for k in kept)):
            kept.append(i)
    return kept[:_KEPT]


def _climb_wholly(
    views: Views, first: State, cold: State, models: Sequence[LensModel], options: LMOptions, progress: Progress
) -> Steps[Minimum]:
    """As `climb`, all starts solved on all views: for poses that are not settled yet, and few views of many minima."""
    small = models[0]
    kept, spent = [first], 0
    for large in models[1:]:
        plain = (embed(cold[0], models[0], large), *cold[1:])
        carried = [(embed(state[0], small, large), *state[1:]) for state in kept]
        found = yield from _scout(views, carried, plain, small, large, options)
        kept = _rank(views, found, carried[0], large)
        last = large == models[-1] or str(large) in _LANDINGS
        result, terms = yield from _finish(views, kept[0], large, options if last else _LANDING)
        spent += int(found.iterations.max()) + int(result.iterations)
        kept[0] = result.state
        small = large
        if views.rules.informed:
            # Against the noise of a lens that fits badly priors would count far too much.
            views = dataclasses.replace(views, prior_noise=max(views.noise(kept[0], large), LEAST_NOISE))
        if last and terms and views.corner_count <= MANY_CORNERS and views.rules.mild is None:
            result, steps = yield from _lower(views, views.problem(large, terms=terms), large, first, result, options)
            spent += steps
            kept[0] = result.state
        progress(str(large))
    others = [(embed(first[0], models[0], small), *first[1:]), *kept[1:]]
    return minimum_of(views, result, terms, small, others, spent)


def _price(cost: float, residual_count: int) -> float:
    """Of a fold in the image; where data are exact, a thousandth of a pixel counts as their noise."""
    return _FOLD_PRICE * max(cost / residual_count, 1e-6)


def walls(views: Views, state: State, model: LensModel, radius: float) -> tuple[Term, ...]:
    """The wall at a radius, if `state` stands behind it."""
    wall = FoldBarrier(model, radius, _WALL * views.noise(state, model))
    return (wall,) if bool(torch.isfinite(wall.rows(torch.cat([state[0], state[1]]))).all()) else ()


def _finish(views: Views, start: State, model: LensModel, options: LMOptions) -> Steps[tuple[Result, tuple[Term, ...]]]:
    """Solve to convergence behind a wall: around the corners seen, or around the image where that is not enough.

    Among the ends and the start itself the best is chosen, folds in the image at their price. The plain cost never
    rises: where a wall would push the start back, the start is the result.
    """
    plain = views.problem(model)
    limit, before = views.trouble(start, model), float(plain.cost(start))
    price = _price(before, plain.residual_count)
    ends: list[tuple[float, Result, tuple[Term, ...]]] = []
    for radius in (views.seen_radius(start), views.regular_radius(start, model)):
        terms = walls(views, start, model, radius)
        problem = views.problem(model, terms=terms)
        result = yield Solve(problem, start, options)
        trouble, cost = views.trouble(result.state, model), float(plain.cost(result.state))
        if trouble > limit:
            ends.append((cost + price * trouble, result, terms))
            continue
        if cost <= before:
            ends.append((cost + price * trouble, result, terms))
        break
    else:
        # A tilted lens folds elsewhere than the wall knows: in short stretches, until just before.
        state = start
        for _ in range(_STRETCHES):
            result = yield Solve(problem, state, dataclasses.replace(options, max_iterations=_STRETCH))
            if views.trouble(result.state, model) > limit:
                break
            state = result.state
            if int(result.status) != SolverStatus.ITERATION_LIMIT:
                break
        result = dataclasses.replace(
            result, state=state, status=torch.full_like(result.status, int(SolverStatus.AT_BOUND))
        )
        ends.append((float(plain.cost(state)) + price * limit, result, terms))
    fallback = dataclasses.replace(
        result, state=start, status=torch.full_like(result.status, int(SolverStatus.AT_BOUND))
    )
    ends.append((before + price * limit, fallback, terms))
    _, result, terms = min((end for end in ends if math.isfinite(end[0]) or end[1] is fallback), key=lambda end: end[0])
    return dataclasses.replace(result, cost=plain.cost(result.state)), terms


def _scout(
    views: Views,
    carried: list[State],
    plain: State,
    small: LensModel,
    large: LensModel,
    options: LMOptions,
) -> Steps[Result]:
    """Solve for `large` from all starts side by side, with a limited number of steps."""
    starts = [*carried, plain]
    if large.denominator >= 2 and small.denominator == 0 and large.numerator >= 2:
        if views.rms(carried[0], large) > SUSPICIOUS_RMS:
            starts += wide_starts(views, large)
        largest = float(views.observed_radius(carried[0])) ** 2
        starts += [(near_canceling(carried[0][0], large, largest, b), *carried[0][1:]) for b in _BUMPS]
    starts = [(views.rules.impose(state[0], large), *state[1:]) for state in starts]
    limited = dataclasses.replace(_SCOUT, max_iterations=min(_SCOUT.max_iterations, options.max_iterations))
    result = yield Solve(views.problem(large, (len(starts),)), stack(starts), limited)
    return result


def _rank(views: Views, found: Result, carried: State, model: LensModel) -> list[State]:
    """The best few minima that are lenses, best first; the carried-over state leads if none is as good."""
    problem = views.problem(model)
    limit = float(problem.cost(carried))
    candidates = [(limit, carried)]
    for i in torch.argsort(torch.nan_to_num(found.cost, nan=torch.inf)).tolist():
        cost = float(found.cost[i])
        if math.isfinite(cost) and not any(abs(cost - other) <= 1e-7 * other for other, _ in candidates[1:]):
            candidates.append((cost, pick(found.state, i)))
    # In units of the noise variance, estimated from the best fit there is.
    price = _price(min(cost for cost, _ in candidates), problem.residual_count)
    ranked = [(cost > limit, cost + price * views.trouble(state, model), state) for cost, state in candidates]
    # A richer model must not end above the one nested in it, whatever the price says.
    ranked = sorted((entry for entry in ranked if math.isfinite(entry[1])), key=lambda entry: entry[:2])
    return [state for *_, state in ranked[:_KEPT]] or [carried]
