"""From the first model to a rich one in one step, where a weak prior leaves one minimum and nothing to search."""

from __future__ import annotations

from kcal.calibrate.bundle.batching import Solve, Steps
from kcal.calibrate.bundle.compressed_problem import CompressedProblem, fold
from kcal.calibrate.bundle.views import Views
from kcal.calibrate.search.model_ladder import MANY_CORNERS, SUSPICIOUS_RMS, Minimum, Progress, embed, minimum_of, walls
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions
from kcal.solve.result import SolverStatus, State, pick

# What priors count is told by this solution's noise, so that it is solved again.
_ROUGH = LMOptions(max_iterations=60, tolerance=1e-6, initial_damping=1e-5)


def step(views: Views, first: State, small: LensModel, model: LensModel, progress: Progress) -> Steps[Minimum | None]:
    """Solve roughly for `model` from a solution of a smaller one.

    Of many views all but the last steps are taken on folded views (`kcal.calibrate.bundle.compressed_problem`).

    Args:
        views: the data, with a weak prior.
        first: a solution of `small`.
        small: nested in `model`.
        model: the one to solve for.
        progress: told the model's name at the end.

    Returns:
        the minimum, or None where the way is not so plain, and is to be climbed: the first model fits badly, the lens
        comes near a fold, or the steps do not settle.
    """
    if views.rms(first, small) > SUSPICIOUS_RMS:
        return None
    start = (views.rules.impose(embed(first[0], small, model), model), *first[1:])
    wall = walls(views, start, model, views.regular_radius(first, small))
    if not wall:
        return None
    problem, state, spent = views.problem(model, terms=wall), start, 0
    if views.corner_count > MANY_CORNERS:
        folded = fold(views.problem(small, poses_only=True), first, float(views.observed_radius(first)))
        known = (*wall, *views.rules.terms(model, views.prior_noise))
        search = CompressedProblem(folded, model, views.rules.parameters(model), known, (1,))
        found = yield Solve(search, search.start(start[0][None]), _ROUGH)
        near, spent = search.unfold(pick(found.state, 0)), int(found.iterations)
        if float(problem.cost(near)) < float(problem.cost(start)):
            state = near
    result = yield Solve(problem, state, _ROUGH)
    minimum = minimum_of(views, result, wall, model, [start], spent + int(result.iterations))
    if int(minimum.result.status) not in (SolverStatus.CONVERGED, SolverStatus.EXACT):
        return None
    progress(str(model))
    return minimum
