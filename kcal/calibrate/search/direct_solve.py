"""From the first model to a rich one in one solve, where a weak prior leaves a single minimum and nothing to search."""

from __future__ import annotations

from kcal.calibrate.bundle.batching import minimize
from kcal.calibrate.bundle.board_problem import BoardState
from kcal.calibrate.bundle.compressed_problem import CompressedProblem, compress
from kcal.calibrate.bundle.views import CameraViews
from kcal.calibrate.search.model_ladder import (
    MANY_CORNERS,
    SUSPICIOUS_RMS,
    Minimum,
    Progress,
    barriers,
    embed_state,
    minimum_of,
)
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions
from kcal.solve.result import SolverStatus, pick

# Priors count in proportion to this solution's noise; the caller solves again to the end.
_ROUGH = LMOptions(max_iterations=60, tolerance=1e-6, initial_damping=1e-5)


def solve_directly(
    views: CameraViews, first: BoardState, small: LensModel, model: LensModel, progress: Progress
) -> Minimum | None:
    """Solve roughly for `model`, starting at a solution of a smaller one.

    With many views, all but the last steps are taken on compressed views (`kcal.calibrate.bundle.compressed_problem`).

    Args:
        views: the data, with a weak prior.
        first: a solution of `small`.
        small: nested in `model`.
        model: the one to solve for.
        progress: called with the model's name at the end.

    Returns:
        the minimum, or None where the model ladder is needed: the first model fits badly, the lens comes close to a
        fold, or the solver does not converge.
    """
    if views.rms(first, small) > SUSPICIOUS_RMS:
        return None
    start = embed_state(first, small, model)
    start = start._replace(parameters=views.constraints.impose(start.parameters, model))
    barrier = barriers(views, start, model, views.regular_radius(first, small))
    if not barrier:
        return None
    problem, state, spent = views.lens_problem(model, terms=barrier), start, 0
    if views.corner_count > MANY_CORNERS:
        compressed = compress(views.problem(small), first, views.observed_radius(first))
        terms = (*barrier, *views.prior_terms(model))
        search = CompressedProblem(compressed, model, views.constraints.free_parameters(model), terms, (1,))
        found = minimize(search, search.start(start.parameters[None]), _ROUGH)
        near, spent = search.expand(pick(found.state, 0)), int(found.iterations)
        if float(problem.cost(near)) < float(problem.cost(start)):
            state = near
    result = minimize(problem, state, _ROUGH)
    minimum = minimum_of(views, result, barrier, model, [start], spent + int(result.iterations))
    if int(minimum.result.status) not in (SolverStatus.CONVERGED, SolverStatus.EXACT):
        return None
    progress(str(model))
    return minimum
