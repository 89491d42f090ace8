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

from kcal.calibrate.views import Views
from kcal.calibrate.wide import wide_starts
from kcal.lens.model import PRESETS, LensModel
from kcal.lens.projection import INTRINSICS, parameter_names
from kcal.solve.lm import LMOptions, minimise
from kcal.solve.result import Result, State, Status

# Trial steps given to each start of a batch; the best one is then taken to convergence.
_SCOUT_STEPS = 150
_KEPT = 4
# Where the smaller model leaves more than this (pixels), the lens may be too wide for it.
_SUSPICIOUS_RMS = 2.0
# How much χ² a lens that folds inside the image must gain on one that does not: 20 is far beyond chance for the few
# parameters that a step of the ladder adds.
_FOLD_PRICE = 20.0
# Trial steps between two looks at a lens that is about to fold.
_STRETCH = 12
# How far beyond the outermost corner a lens must be regular.
_MARGIN = 1.02
# Where near-cancelling starts put their bump, as a fraction of the largest observed r².
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
    """

    result: Result
    iterations: int
    rivals: tuple[tuple[float, State], ...] = ()


def steps_to(model: LensModel) -> list[LensModel]:
    """The models to pass through on the way to `model`, each nested in the next.

    Example:
        >>> [str(m) for m in steps_to(LensModel.named("opencv12"))]
        ['opencv5', 'opencv8', 'opencv12']
    """
    ladder = [PRESETS[name] for name in ("opencv5", "opencv8", "opencv12", "opencv14", "ext16", "ext18", "ext20")]
    below = [step for step in ladder if model.contains(step) and step != model]
    return [*below, model]


def embed(parameters: Tensor, small: LensModel, large: LensModel) -> Tensor:
    """The same lens (..., 5 + P) written with more coefficients, the new ones zero."""
    names = parameter_names(large)
    out = parameters.new_zeros((*parameters.shape[:-1], len(names)))
    out[..., [names.index(name) for name in parameter_names(small)]] = parameters
    return out


def near_cancelling(parameters: Tensor, model: LensModel, largest: float, place: float) -> Tensor:
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


def stack(states: Sequence[State]) -> State:
    """Several states as one batch."""
    return tuple(torch.stack(tensors) for tensors in zip(*states, strict=True))


def pick(state: State, index: int) -> State:
    """One element of a batch."""
    return tuple(tensor[index] for tensor in state)


def climb(
    views: Views, first: State, cold: State, models: Sequence[LensModel], options: LMOptions, progress: Progress
) -> Minimum:
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
    result = minimise(views.problem(small), first, options)
    kept, spent = [result.state], int(result.iterations)
    for large in models[1:]:
        plain = (embed(cold[0], models[0], large), *cold[1:])
        carried = [(embed(state[0], small, large), *state[1:]) for state in kept]
        found = _scout(views, carried, plain, small, large, options)
        kept = _rank(views, found, carried[0], large)
        result = _finish(views, kept[0], large, options)
        spent += int(found.iterations.max()) + int(result.iterations)
        kept[0] = result.state
        small = large
        progress(str(large))
    last = views.problem(small)
    others = [(embed(first[0], models[0], small), *first[1:]), *kept[1:]]
    rivals = tuple((float(last.cost(state)), state) for state in others) if len(models) > 1 else ()
    return Minimum(result=result, iterations=spent, rivals=rivals)


def _finish(views: Views, start: State, model: LensModel, options: LMOptions) -> Result:
    """Solve to convergence, or until the lens would fold in a part of the image where it did not at the start."""
    limit = views.trouble(start, model)
    problem = views.problem(model, radius=_MARGIN * float(views.observed_radius(start)))
    result = minimise(problem, start, options)
    if views.trouble(result.state, model) <= limit:
        return result
    # Go again in short stretches, and stop before the one that folds the lens.
    best = dataclasses.replace(result, state=start, cost=problem.cost(start))
    for _ in range(options.max_iterations // _STRETCH):
        result = minimise(problem, best.state, dataclasses.replace(options, max_iterations=_STRETCH))
        if views.trouble(result.state, model) > limit:
            break
        best = result
        if best.status != Status.ITERATION_LIMIT:
            return best
    return dataclasses.replace(best, status=torch.full_like(best.status, int(Status.AT_BOUND)))


def _scout(
    views: Views, carried: list[State], plain: State, small: LensModel, large: LensModel, options: LMOptions
) -> Result:
    """Solve for `large` from all starts side by side, with a limited number of steps."""
    starts = [*carried, plain]
    if large.denominator >= 2 and small.denominator == 0 and large.numerator >= 2:
        if views.rms(carried[0], large) > _SUSPICIOUS_RMS:
            starts += wide_starts(views, large)
        largest = float(views.observed_radius(carried[0])) ** 2
        starts += [(near_cancelling(carried[0][0], large, largest, b), *carried[0][1:]) for b in _BUMPS]
    limited = dataclasses.replace(options, max_iterations=min(_SCOUT_STEPS, options.max_iterations))
    return minimise(views.problem(large, (len(starts),)), stack(starts), limited)


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
    price = _FOLD_PRICE * max(min(cost for cost, _ in candidates), 1e-300) / problem.residual_count
    ranked = [(cost > limit, cost + price * views.trouble(state, model), state) for cost, state in candidates]
    # A richer model must not end above the one nested in it, whatever the price says.
    ranked = sorted((entry for entry in ranked if math.isfinite(entry[1])), key=lambda entry: entry[:2])
    return [state for *_, state in ranked[:_KEPT]] or [carried]
