"""Find one camera's minimum: initial model, richer models, priors, weights. `assess` tells how good it is."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

from torch import Tensor

from kcal.calibrate.bundle.batching import minimize
from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.calibrate.bundle.coefficient_prior import CoefficientPrior, is_overparameterized
from kcal.calibrate.bundle.poses import unflip
from kcal.calibrate.bundle.priors import Term
from kcal.calibrate.bundle.views import CameraViews
from kcal.calibrate.bundle.weights import whitening
from kcal.calibrate.camera.checks import MINIMUM_VIEWS, check_views, least_planar
from kcal.calibrate.camera.initial_model import first_model, known_model
from kcal.calibrate.camera.options import CalibrationOptions
from kcal.calibrate.search.direct_solve import solve_directly
from kcal.calibrate.search.model_ladder import Minimum, Progress, nested_models, solve_ladder
from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions
from kcal.solve.result import Result, SolverStatus
from kcal.solve.robust import RobustLoss

# Maximum number of times the noise level that weights the priors is re-estimated, and the smallest relative change that
# is worth it: it moves the solution by less than 1e-4 standard deviations.
_PRIOR_ROUNDS, _SAME = 5, 1e-4
# For a solve that begins next to its solution.
_NEAR_DAMPING = 1e-8
# For a first model from which the last one is reached directly.
_ROUGH = LMOptions(max_iterations=100, tolerance=1e-5)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solution:
    """The minimum for one set of corners.

    Args:
        views: the corners, all counting alike, and what is known about the camera.
        problem: the final problem, with weights, loss, priors and barriers.
        result: its result.
        minimum: of the search, all corners counting alike.
        plain_cost: with all corners counting alike.
        spent: trial steps.
        variance: of the residuals along an axis when all corners count alike, px²; None where they do.
    """

    views: CameraViews
    problem: BoardProblem
    result: Result[BoardState]
    minimum: Minimum
    plain_cost: float
    spent: int
    variance: float | None

    def problem_for(
        self,
        pixels: Tensor,
        covariances: Tensor | None,
        loss: RobustLoss | None = None,
        terms: Sequence[Term] | None = None,
    ) -> BoardProblem:
        """The problem of any corners of this camera, with their weights and by default with this solution's terms."""
        weights = None if covariances is None or self.variance is None else whitening(covariances, self.variance)
        views = dataclasses.replace(self.views, pixels=pixels, whitening=weights, loss=loss)
        return views.problem(
            self.problem.model, self.problem.free, terms=self.minimum.terms if terms is None else terms
        )


def solve(observations: Observations, options: CalibrationOptions, progress: Progress) -> Solution:
    """Find the minimum for all corners given, as `calibrate_camera` describes it and with its errors."""
    return solve_corners(
        observations.board.points,
        observations.pixels(),
        observations.image_size,
        options,
        progress,
        covariances=observations.covariances(),
        names=observations.names,
    )


def solve_corners(
    board_points: Tensor,
    pixels: Tensor,
    size: tuple[int, int],
    options: CalibrationOptions,
    progress: Progress,
    covariances: Tensor | None = None,
    names: Sequence[str] = (),
) -> Solution:
    """As `solve`, for tensors: board points (N, 3), pixels (V, N, 2), covariances (V, N, 2, 2), names of the views."""
    model, solver = options.lens, options.solver
    names = names or [f"view {i}" for i in range(len(pixels))]
    constraints, warp = options.constraints(size), options.board_warp
    views = CameraViews(board_points=board_points, pixels=pixels, free_warp=warp, size=size, constraints=constraints)
    unknowns = len(constraints.free_parameters(model)) + 2 * warp
    check_views(board_points, pixels, names, unknowns, fewest=MINIMUM_VIEWS if options.camera is None else 1)

    weak_prior = options.weak_prior if options.camera is None and is_overparameterized(model) else None
    if options.camera is None:
        models = [lens for lens in nested_models(model) if constraints.allows(lens)]
        rough = _ROUGH if weak_prior is not None and len(models) > 1 else solver
        first, undistorted, spent = first_model(views, models[0], options.start_focal(size), rough, names)
    else:
        models = [model]
        first = undistorted = known_model(options.camera, views, names)
        spent = 0
    progress(f"start ({models[0]})")
    if weak_prior is not None:
        views = _with_prior(views, CoefficientPrior(weak_prior, views.observed_radius(first)))
    if views.constraints.has_priors:
        views = views.with_noise_of(first, models[0])
    minimum = None
    if weak_prior is not None and len(models) > 1:
        minimum = solve_directly(views, first, models[0], model, progress)
    if minimum is None:
        minimum = solve_ladder(views, first, undistorted, models, solver, progress)
    spent += minimum.iterations

    result = minimum.result
    if result.status == SolverStatus.BAD_START:
        raise InputError(
            f"the lens {model} cannot show all corners where they are. Look first at "
            f"{least_planar(board_points, pixels, names)}: remove what is not this board and this camera, or leave the "
            "model out (the default lens leaves wrong views out)"
        )
    problem = views.lens_problem(model, terms=minimum.terms)
    if len(models) > 1:
        # Under the first model poses were checked already; under another lens they are checked once more.
        state, flipped = unflip(views, model, result.state)
        if flipped:
            result = minimize(problem, state, solver)
            spent += int(result.iterations)
    if views.constraints.has_priors:
        views, result, steps = _reweight_priors(views, model, minimum, result, solver)
        spent += steps
        problem = views.lens_problem(model, terms=minimum.terms)
        rivals = tuple((float(views.lens_problem(model).cost(state)), state) for _, state in minimum.rivals)
        minimum = dataclasses.replace(minimum, rivals=rivals, terms=problem.terms)
    covariances = covariances if options.weighted else None
    solution = Solution(
        views=views,
        problem=problem,
        result=result,
        minimum=minimum,
        plain_cost=float(result.cost),
        spent=spent,
        # The residuals of the plain solution tell how much there is beyond the corners' own noise.
        variance=None if covariances is None else 2.0 * float(result.cost) / problem.residual_count,
    )
    if covariances is None and options.loss is None:
        return solution
    problem = solution.problem_for(pixels, covariances, options.loss)
    result = minimize(problem, result.state, solver)
    return dataclasses.replace(solution, problem=problem, result=result, spent=spent + int(result.iterations))


def _with_prior(views: CameraViews, prior: CoefficientPrior) -> CameraViews:
    return dataclasses.replace(views, constraints=dataclasses.replace(views.constraints, coefficient_prior=prior))


def _reweight_priors(
    views: CameraViews, model: LensModel, minimum: Minimum, result: Result[BoardState], solver: LMOptions
) -> tuple[CameraViews, Result[BoardState], int]:
    """Solve again with priors for the noise and the outermost corner of the solution, until these stay the same."""
    near, spent = dataclasses.replace(solver, initial_damping=_NEAR_DAMPING), 0
    for number in range(_PRIOR_ROUNDS):
        after = views.with_noise_of(result.state, model)
        reach = views.observed_radius(result.state)
        prior = views.constraints.coefficient_prior
        known = prior is None or abs(reach - prior.reach) <= _SAME * reach
        if number and known and abs(after.prior_noise - views.prior_noise) <= _SAME * after.prior_noise:
            break
        views = after if prior is None else _with_prior(after, dataclasses.replace(prior, reach=reach))
        result = minimize(views.lens_problem(model, terms=minimum.terms), result.state, near)
        spent += int(result.iterations)
    return views, result, spent
