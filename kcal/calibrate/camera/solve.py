"""Find one camera's minimum: start, priors, weights. `assess` tells how good it is."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.camera.checks import MINIMUM_VIEWS, check_views, least_planar
from kcal.calibrate.camera.initial_model import LensStart, first_states, known_model
from kcal.calibrate.camera.options import CalibrationOptions, Progress
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.coefficient_prior import CoefficientPrior, is_overparameterized
from kcal.calibrate.problem.poses import unflip
from kcal.calibrate.problem.priors import Term
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import CameraViews
from kcal.calibrate.problem.weights import whitening
from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import Result, SolverStatus
from kcal.solve.robust import RobustLoss

# Maximum number of times the noise level that weights the priors is re-estimated, and the smallest relative change that
# is worth it: it moves the solution by less than 1e-4 standard deviations.
_PRIOR_ROUNDS, _SAME = 5, 1e-4
# For a solve that begins next to its solution.
_NEAR_DAMPING = 1e-8
# Priors count in proportion to this solution's noise; from there it is solved again to the end.
_ROUGH = LMOptions(max_iterations=60, tolerance=1e-6, initial_damping=1e-5)
# The weak prior that leads to where the corners alone decide.
_WEAK = 0.3
# Squared residuals of the barrier, in units of the noise, from which on a lens counts as held back by it.
_AT_BARRIER = 0.1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solution:
    """The minimum for one set of corners.

    Args:
        views: the corners, all counting alike, and what is known about the camera.
        problem: the final problem, with weights, loss, priors and barriers.
        result: its result.
        terms: priors and barriers of the solution with all corners counting alike.
        rivals: costs and states of other solutions, all corners counting alike. Where one fits almost as well but lies
            far away, the corners alone do not determine the model.
        plain_cost: of this solution, likewise.
        spent: trial steps.
        variance: of the residuals along an axis when all corners count alike, px²; None where they do.
    """

    views: CameraViews
    problem: BoardProblem
    result: Result[BoardState]
    terms: tuple[Term, ...]
    rivals: tuple[tuple[float, BoardState], ...]
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
        return views.problem(self.problem.model, self.problem.free, terms=self.terms if terms is None else terms)


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

    rich = options.camera is None and is_overparameterized(model)
    if options.camera is None:
        try:
            starts, noise, spent = first_states(views, model, options.start_focal(size), barrier=rich)
        except InputError as error:
            raise InputError(f"{error} Look first at {least_planar(board_points, pixels, names)}") from error
        progress("base projection")
        views = dataclasses.replace(views, prior_noise=min(noise, views.prior_noise))
    else:
        starts, spent = [LensStart(known_model(options.camera, views, names), ())], 0
        views = views.with_noise_of(starts[0].state, model)
    width = (options.weak_prior or _WEAK) if rich else None
    free = rich and options.weak_prior is None
    # Where the corners alone decide there are several minima: the lower one of two counts.
    found = [_solve_from(views, model, start, width, free, solver) for start in (starts if free else starts[:1])]
    spent += sum(one.spent for one in found)
    best = min(found, key=lambda one: torch.nan_to_num(one.result.cost, nan=torch.inf))
    views, result, terms = best.views, best.result, best.terms
    if result.status == SolverStatus.BAD_START:
        raise InputError(
            f"the lens {model} cannot show all corners where they are. Look first at "
            f"{least_planar(board_points, pixels, names)}: remove what is not this board and this camera, or leave the "
            "model out (the default lens leaves wrong views out)"
        )
    if views.constraints.has_priors:
        views, result, steps = _reweight_priors(views, model, terms, result, solver)
        spent += steps
    progress(str(model))
    plain, problem = views.lens_problem(model), views.lens_problem(model, terms)
    result = _beside_barrier(plain, result)
    others = [one.led for one in found] + [one.result.state for one in found if one is not best]
    covariances = covariances if options.weighted else None
    solution = Solution(
        views=views,
        problem=problem,
        result=result,
        terms=problem.terms,
        rivals=tuple((float(plain.cost(state)), state) for state in others if free),
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


class _Found(NamedTuple):
    """The minimum next to a start.

    Attributes:
        views: with their priors.
        result: of the solver.
        terms: the barrier.
        led: a state on the way there, to which a prior has led.
        spent: trial steps.
    """

    views: CameraViews
    result: Result[BoardState]
    terms: tuple[Term, ...]
    led: BoardState
    spent: int


def _solve_from(
    views: CameraViews, model: LensModel, start: LensStart, width: float | None, free: bool, solver: LMOptions
) -> _Found:
    """Solve from a start.

    Args:
        views: the data.
        model: the lens model.
        start: see there.
        width: of a weak prior on the coefficients; None: there is none.
        free: the prior only leads to a minimum next to which the corners alone decide.
        solver: options.
    """
    known = views
    if width is not None:
        known = _with_prior(views, CoefficientPrior(width, views.observed_radius(start.state)))
    result = minimize(known.lens_problem(model, start.terms), start.state, solver if width is None else _ROUGH)
    led, spent = result.state, int(result.iterations)
    known = views if free else known
    if result.status != SolverStatus.BAD_START:
        state, flipped = unflip(known, model, result.state)
        if flipped or width is not None:
            result = minimize(known.lens_problem(model, start.terms), state, solver)
            spent += int(result.iterations)
    return _Found(known, result, start.terms, led, spent)


def _beside_barrier(plain: BoardProblem, result: Result[BoardState]) -> Result[BoardState]:
    """A result with its cost without the barrier; its status is `AT_BOUND` where the barrier matters."""
    cost, status = plain.cost(result.state), result.status
    if result.converged and float(result.cost - cost) > _AT_BARRIER * float(cost) / plain.residual_count:
        status = torch.full_like(status, int(SolverStatus.AT_BOUND))
    return dataclasses.replace(result, cost=cost, status=status)


def _with_prior(views: CameraViews, prior: CoefficientPrior) -> CameraViews:
    return dataclasses.replace(views, constraints=dataclasses.replace(views.constraints, coefficient_prior=prior))


def _reweight_priors(
    views: CameraViews, model: LensModel, terms: tuple[Term, ...], result: Result[BoardState], solver: LMOptions
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
        result = minimize(views.lens_problem(model, terms), result.state, near)
        spent += int(result.iterations)
    return views, result, spent
