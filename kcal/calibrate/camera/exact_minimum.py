"""A minimum to rounding with its exact Hessian, for derivatives; or the reason why there is none."""

from __future__ import annotations

from kcal.calibrate.camera.determined import check_directions
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.covariance import uncertainty_of
from kcal.calibrate.problem.state import BoardState
from kcal.errors import DegenerateError
from kcal.lens.projection import parameter_names
from kcal.solve.hessian import HessianSolve, newton_minimum
from kcal.solve.lm import LMOptions

_POLISH = LMOptions(max_iterations=200, tolerance=1e-13)


def exact_minimum(problem: BoardProblem, state: BoardState) -> tuple[BoardState, HessianSolve]:
    """The minimum next to a state to rounding, and systems with the Hessian there.

    Raises:
        DegenerateError: there is none, or the views do not determine a parameter.
    """
    state, found = newton_minimum(problem, state, _POLISH)
    if problem.shared_size:
        known = uncertainty_of(found.linear, problem.residual_count, problem.shared_size + found.zero[1].numel())
        names = [*problem.free.labels(parameter_names(problem.model)), *(["the board's warp"] * 2)]
        lost = [name for name, sure in zip(names, known.determined.tolist(), strict=False) if not sure]
        if lost:
            raise DegenerateError(
                f"the views do not determine {', '.join(dict.fromkeys(lost))}, and the solution has no derivatives: "
                "fix parameters, choose a smaller model, add views or priors"
            )
        spread = problem.free.by_parameter(known.covariance, len(state.parameters))
        check_directions(state.parameters, problem.model, problem.points(state), problem.seen, spread, state.rotation)
    return state, found
