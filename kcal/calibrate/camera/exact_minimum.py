"""A solution to rounding, with the curvature there; or the reason why there is none to differentiate."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem
from kcal.calibrate.bundle.covariance import uncertainty_of
from kcal.calibrate.camera.warnings import check_focal
from kcal.errors import DegenerateError
from kcal.lens.pose import step_rows
from kcal.lens.projection import parameter_names, project_components
from kcal.solve.implicit import Curvature, curvature
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import State
from kcal.solve.schur import SchurLinearization

_POLISH = LMOptions(max_iterations=200, tolerance=1e-13)
# Newton's steps after that: each squares the distance to the minimum.
_NEWTON_STEPS = 8
# A solution is one where a step of Newton's predicts a decrease below this share of the cost ...
_AT_MINIMUM = 1e-10
# ... or below that of residuals (root mean square, pixels) that are rounding. Steps end where it is rounding itself.
_EXACT, _ROUNDING = 1e-10, 1e-22


class RecordedProblem(BoardProblem):
    """`BoardProblem` of one camera whose rows are built without writing in place, for autograd."""

    def rows(self, state: State, views: slice = slice(None)) -> Tensor:
        """See `SchurProblem.rows`."""
        s = self.unpack(state)
        rotated, points = self.points(s)
        seen = project_components(points, s.parameters[0][None], self.models[0], self.free[0].indices)
        parts = [step_rows(seen.by_point, rotated), self.free[0].collapse(seen.by_camera, -3)]
        if self.free_warp:
            along = torch.einsum("vkun,vk->vun", seen.by_point, s.first_from_board_rotation[..., 2])
            parts.append(along[:, None] * self._shape[:, None])
        parts.append((seen.pixels - self._target[:, 0])[:, None])
        rows = torch.where(self.seen[:, 0, None, None], torch.cat(parts, 1), 0.0)
        if self.loss is not None:
            rows = rows * self.loss.weight(rows[:, -1].square().sum(-2)).sqrt()[:, None, None]
        return rows.flatten(-2)

    def linearize(self, state: State) -> SchurLinearization:
        """See `Problem.linearize`."""
        rows = self.rows(state)
        return SchurLinearization(rows @ rows.transpose(-1, -2), self.local_size, self.shared_rows(state))


def settle(problem: BoardProblem, state: State) -> tuple[State, Curvature]:
    """The minimum next to a state to rounding, and the exact Hessian there; `DegenerateError` where there is none."""
    state = minimize(problem, state, _POLISH).state
    zero = state[0].new_zeros(problem.shared_size), state[0].new_zeros(len(state[-1]), problem.local_size)
    cost_there, exact = float(problem.cost(state)), 0.5 * problem.residual_count * _EXACT**2
    best: tuple[float, State, Curvature] | None = None
    for _ in range(_NEWTON_STEPS):
        here = state

        def cost(shared: Tensor, local: Tensor, here: State = here) -> Tensor:
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
            "the solution is no minimum that the data determine (a flat valley, a saddle or a bound), so that it has "
            "no derivatives: fix parameters, choose a smaller model, add views or priors"
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
                f"the views do not determine {', '.join(dict.fromkeys(lost))}, so that the solution has no "
                "derivatives: fix parameters, choose a smaller model, add views or priors"
            )
        check_focal({name: float(known.sigma[k]) for k, group in enumerate(groups) for name in group}, state[0])
    return state, found


def _unknowns(problem: BoardProblem) -> list[list[str]]:
    """Names of the parameters that follow each of the camera's unknowns."""
    names, free = parameter_names(problem.models[0]), problem.free[0]
    groups: list[list[str]] = [[] for _ in range(len(free))]
    for index, slot in zip(free.indices, free.slots, strict=True):
        groups[slot].append(names[index])
    return groups
