"""Restart from a local minimum along the directions that the data hardly determine.

A rich lens model fits almost as well along a few curves in its parameters: the tilt against the principal point, a bump
of the radial term against its neighbors. Where a solver stops on such a curve depends on its start, and elsewhere on it
there may be a lower minimum. The weakest eigenvectors of the information at a minimum point along these curves. The
length of a restart's step is some standard deviations of what the data leave open. Board poses respond linearly.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import torch

from kcal.calibrate.bundle.batching import minimize
from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.solve.lm import LMOptions
from kcal.solve.result import Result, SolverStatus, pick, stack

# How many of the weakest directions are followed, and how far: standard deviations.
_DIRECTIONS = 4
_LENGTHS = (30.0, 12.0, 5.0, 2.0)
_ROUNDS = 3
# Of the cost: a smaller gain ends the search, because a solver may stop that far from its minimum.
_GAIN = 1e-5
# Of the cost: by less than this the searches end above and below the same minimum, as rounding has it.
_SAME = 1e-9
# Eigenvalues of the scaled information below this are rounding errors, which would give endless lengths.
_LOWEST = 1e-14
_SEARCH = LMOptions(max_iterations=100, tolerance=1e-9, flatness=1e-5, initial_damping=1e-5)


def restart(
    problem: BoardProblem, result: Result[BoardState], options: LMOptions, accepts: Callable[[BoardState], bool]
) -> Result[BoardState]:
    """Restart from a solution until no lower minimum is found.

    Args:
        problem: not a batch.
        result: its solution.
        options: for solving from where a search has ended.
        accepts: whether a state with lower cost may be returned.

    Returns:
        the lowest accepted solution, its iterations those of all searches.
    """
    spent = 0
    for _ in range(_ROUNDS if int(result.status) != SolverStatus.EXACT else 0):
        starts = restart_states(problem, result.state)
        if not starts:
            break
        found = minimize(problem.repeated(len(starts)), stack(starts), _SEARCH)
        spent += int(found.iterations.max())
        before = float(result.cost)
        order = torch.argsort(torch.nan_to_num(found.cost, nan=math.inf)).tolist()
        lower = (pick(found.state, i) for i in order if float(found.cost[i]) < (1.0 - _SAME) * before)
        best = next((state for state in lower if accepts(state)), None)
        if best is None:
            break
        solved = minimize(problem, best, options)
        spent += int(solved.iterations)
        if not accepts(solved.state):
            break
        result = solved
        if not float(result.cost) < (1.0 - _GAIN) * before:
            break
    return dataclasses.replace(result, iterations=torch.full_like(result.iterations, spent))


@torch.no_grad()
def restart_states(problem: BoardProblem, state: BoardState) -> list[BoardState]:
    """States some standard deviations away along each of the weakest directions: the farthest that has a cost.

    Args:
        problem: not a batch.
        state: a minimum of it.
    """
    linear = problem.linearize(state)
    information, scale = linear.information()
    response, _ = linear.local_response()
    values, vectors = torch.linalg.eigh(information)
    noise = math.sqrt(2.0 * float(linear.cost) / problem.residual_count)
    if not (math.isfinite(noise) and bool(response.isfinite().all())):
        return []
    count = min(_DIRECTIONS, len(values))
    sigma = noise / values[:count].clamp_min(_LOWEST).sqrt()
    along = (vectors[:, :count] * sigma).T * scale
    both = torch.cat([along, -along])  # (2 D, S)
    lengths = torch.tensor(_LENGTHS, dtype=torch.float64)[:, None, None]
    steps = (lengths * both).flatten(0, 1)
    many = problem.repeated(len(steps))
    tried = many.retract(stack([state] * len(steps)), (steps, torch.einsum("vls,ks->kvl", response, steps)))
    finite = many.cost(tried).isfinite().unflatten(0, (len(_LENGTHS), -1))
    starts = []
    for k in range(len(both)):
        usable = finite[:, k].nonzero()[:, 0].tolist()
        if usable:
            starts.append(pick(tried, usable[0] * len(both) + k))
    return starts
