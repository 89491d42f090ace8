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

from kcal.calibrate.problem import BoardProblem
from kcal.lens.camera import Camera
from kcal.lens.inverse import valid_radius
from kcal.lens.model import PRESETS, LensModel
from kcal.lens.projection import INTRINSICS, parameter_names
from kcal.solve.lm import LMOptions, minimise
from kcal.solve.result import Result, State

# Trial steps given to each start of a batch; the best one is then taken to convergence.
_SCOUT_ITERATIONS = 150
_KEPT = 4
# How much χ² a lens that folds inside the image must gain on one that does not: 20 is far beyond chance for the few
# parameters that a step of the ladder adds.
_FOLD_PRICE = 20.0
# Where near-cancelling starts put their bump, as a fraction of the largest observed r².
_BUMPS = (0.1, 0.25, 0.5)
Progress = Callable[[str], None]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Minimum:
    """The end of a ladder: the solver's result, and the trial steps spent on the way."""

    result: Result
    iterations: int


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


def observed_radius(board_points: Tensor, pixels: Tensor, state: State) -> Tensor:
    """Largest undistorted radius (...) at which a corner was seen, for a single camera."""
    *_, rotation, translation = state
    points = board_points @ rotation.transpose(-1, -2) + translation[..., None, :]
    radius = torch.linalg.vector_norm(points[..., :2] / points[..., 2:], dim=-1)
    seen = torch.isfinite(pixels[:, 0]).all(-1)
    return torch.where(seen, radius, 0.0).amax((-2, -1))


def _starts(kept: list[State], cold: State, small: LensModel, large: LensModel, largest: float) -> list[State]:
    carried = [(embed(state[0], small, large), *state[1:]) for state in kept]
    starts = [*carried, cold]
    if large.denominator >= 2 and small.denominator == 0 and large.numerator >= 2:
        base = carried[0]
        starts += [(near_cancelling(base[0], large, largest, place), *base[1:]) for place in _BUMPS]
    return starts


def free_parameters(model: LensModel) -> list[int]:
    """Indices of all parameters but the skew."""
    return [i for i, name in enumerate(parameter_names(model)) if name != "skew"]


def climb(
    board_points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    first: State,
    cold: State,
    models: Sequence[LensModel],
    options: LMOptions,
    *,
    free_warp: bool,
    progress: Progress,
) -> Minimum:
    """Solve a ladder of models for one camera.

    Args:
        board_points: (N, 3).
        pixels: (V, 1, N, 2).
        size: (width, height) of the image.
        first: a solution of `models[0]`.
        cold: a state of `models[0]` without distortion.
        models: each nested in the next.
        options: of the final solves.
        free_warp: whether the board's warp is estimated.
        progress: told the name of each finished model.

    Returns:
        The lowest minimum found for the last model. Among states that fold or meet a pole inside the radius that was
        observed none is chosen.
    """
    kept = [first]
    small = models[0]
    result: Result | None = None
    spent = 0
    for large in models[1:]:
        largest = float(observed_radius(board_points, pixels, kept[0])) ** 2
        starts = _starts(kept, (embed(cold[0], models[0], large), *cold[1:]), small, large, largest)
        free = [free_parameters(large)]
        scouts = BoardProblem(board_points, pixels, [large], free, free_warp=free_warp, batch=(len(starts),))
        scouting = dataclasses.replace(options, max_iterations=min(_SCOUT_ITERATIONS, options.max_iterations))
        found = minimise(scouts, stack(starts), scouting)
        spent += int(found.iterations.max())
        problem = BoardProblem(board_points, pixels, [large], free, free_warp=free_warp)
        kept = _distinct(board_points, pixels, size, found, starts[0], problem, large)
        result = minimise(problem, kept[0], options)
        spent += int(result.iterations)
        if _trouble(board_points, pixels, size, result.state, large) <= _trouble(
            board_points, pixels, size, kept[0], large
        ):
            kept[0] = result.state
        else:
            # The last steps left the lens: keep the state before them.
            result = dataclasses.replace(result, state=kept[0], cost=problem.cost(kept[0]))
        small = large
        progress(str(large))
    if result is None:
        problem = BoardProblem(board_points, pixels, [small], [free_parameters(small)], free_warp=free_warp)
        result = minimise(problem, first, options)
        spent += int(result.iterations)
        progress(str(small))
    return Minimum(result=result, iterations=spent)


def _trouble(board_points: Tensor, pixels: Tensor, size: tuple[int, int], state: State, model: LensModel) -> float:
    """0 for a lens that is regular in the whole image, 1 if it folds outside the observed radius, infinity inside."""
    radius = valid_radius(state[0][len(INTRINSICS) :], model)
    if not bool(radius > observed_radius(board_points, pixels, state)):
        return math.inf
    return 0.0 if bool(Camera(state[0], size=size, model=model).covers_image()) else 1.0


def _distinct(
    board_points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    found: Result,
    carried: State,
    problem: BoardProblem,
    model: LensModel,
) -> list[State]:
    """The best few minima that are lenses, best first; the carried-over state leads if none is as good."""
    # In units of the noise variance, estimated from the best fit there is.
    limit = float(problem.cost(carried))
    lowest = min(limit, float(torch.nan_to_num(found.cost, nan=math.inf).min()))
    price = _FOLD_PRICE * max(lowest, 1e-300) / problem.residual_count
    ranked = [(limit + price * _trouble(board_points, pixels, size, carried, model), limit, carried)]
    costs: list[float] = []
    for i in torch.argsort(torch.nan_to_num(found.cost, nan=torch.inf)).tolist():
        cost, state = float(found.cost[i]), pick(found.state, i)
        if not math.isfinite(cost) or any(abs(cost - other) <= 1e-7 * other for other in costs):
            continue
        costs.append(cost)
        ranked.append((cost + price * _trouble(board_points, pixels, size, state, model), cost, state))
    # A richer model must not end above the one nested in it, whatever the price says.
    ranked = [entry for entry in ranked if math.isfinite(entry[0])]
    ranked.sort(key=lambda entry: (entry[1] > limit, entry[0]))
    return [state for _, _, state in ranked[:_KEPT]] or [carried]
