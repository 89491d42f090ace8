"""A minimum to rounding with its exact Hessian, for derivatives; or the reason why there is none."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.calibrate.bundle.covariance import uncertainty_of
from kcal.calibrate.camera.determined import check_directions
from kcal.errors import DegenerateError
from kcal.lens.projection import parameter_names
from kcal.solve.implicit import Curvature, curvature
from kcal.solve.lm import LMOptions, minimize

_POLISH = LMOptions(max_iterations=200, tolerance=1e-13)
# Newton steps after that; each squares the distance to the minimum.
_NEWTON_STEPS = 8
# At a minimum a Newton step predicts a decrease below this share of the cost, or below the cost of residuals of 1e-10
# pixels (root mean square), which are rounding errors. Steps end where the decrease itself is rounding.
_AT_MINIMUM, _EXACT, _ROUNDING = 1e-10, 1e-10, 1e-22


def exact_minimum(problem: BoardProblem, state: BoardState) -> tuple[BoardState, Curvature]:
    """The minimum next to a state to rounding, and the exact Hessian there; `DegenerateError` where there is none."""
    state = minimize(problem, state, _POLISH).state
    like, views = state.parameters, len(state.translation)
    zero = like.new_zeros(problem.shared_size), like.new_zeros(views, problem.local_size)
    cost_there, exact = float(problem.cost(state)), 0.5 * problem.residual_count * _EXACT**2
    best: tuple[float, BoardState, Curvature] | None = None
    for _ in range(_NEWTON_STEPS):
        here = state

        def cost(shared: Tensor, local: Tensor, here: BoardState = here) -> Tensor:
            return problem.cost(problem.retract(here, (shared, local)))

        gradient, found = curvature(cost, *zero)
        step, decrease = found.system(*gradient).step(zero[0].new_zeros(()))
        left = float(decrease)
        if best is not None and not left < best[0]:
            break
        if left == left:
            best = left, state, found
        if not left > _ROUNDING * cost_there:
            break
        state = problem.retract(state, step)
    if best is None or not best[0] <= max(_AT_MINIMUM * cost_there, exact):
        raise DegenerateError(
            "the solution has no derivatives, because it is no minimum that the data determine (a flat cost, a saddle, "
            "a barrier): fix parameters, choose a smaller model, add views or priors"
        )
    _, state, found = best
    if problem.shared_size:
        linear = found.system(*zero)
        linear.cost = problem.cost(state)
        known = uncertainty_of(linear, problem.residual_count, problem.shared_size + zero[1].numel())
        groups = _unknowns(problem)
        names = [*(" = ".join(group) for group in groups), *(["the board's warp"] * 2)]
        lost = [name for name, sure in zip(names, known.determined.tolist(), strict=False) if not sure]
        if lost:
            raise DegenerateError(
                f"the views do not determine {', '.join(dict.fromkeys(lost))}, and the solution has no derivatives: "
                "fix parameters, choose a smaller model, add views or priors"
            )
        slots, places = torch.tensor(problem.free.slots), torch.tensor(problem.free.indices)
        spread = state.parameters.new_zeros(2 * (len(state.parameters),))
        spread[places[:, None], places] = known.covariance[slots[:, None], slots]
        points = problem.points(state)[1].transpose(-1, -2)
        check_directions(state.parameters, problem.model, points, problem.seen, spread, state.rotation)
    return state, found


def _unknowns(problem: BoardProblem) -> list[list[str]]:
    """Names of the parameters that follow each of the camera's unknowns."""
    names, free = parameter_names(problem.model), problem.free
    groups: list[list[str]] = [[] for _ in range(len(free))]
    for index, slot in zip(free.indices, free.slots, strict=True):
        groups[slot].append(names[index])
    return groups
