"""One camera's minimum: closed forms, first model, ladder, weights. What to think of it is told elsewhere."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import torch
from torch import Tensor

from kcal.calibrate.bundle.batching import Solve, Steps
from kcal.calibrate.bundle.board_problem import BoardProblem
from kcal.calibrate.bundle.closed_form import (
    spread_out,
)
from kcal.calibrate.bundle.coefficient_prior import CoefficientPrior, is_overparameterized
from kcal.calibrate.bundle.poses import unflipping
from kcal.calibrate.bundle.views import Views
from kcal.calibrate.bundle.weights import whitening
from kcal.calibrate.camera.initial_model import first_model, posed
from kcal.calibrate.camera.options import CalibrationOptions
from kcal.calibrate.search.direct_solve import step
from kcal.calibrate.search.model_ladder import LEAST_NOISE, Minimum, Progress, climb, steps_to
from kcal.errors import DegenerateError, InputError
from kcal.solve.lm import LMOptions
from kcal.solve.result import Result, SolverStatus
from kcal.solve.robust import RobustLoss

_MINIMUM_VIEWS = 3
_MINIMUM_CORNERS = 6
# RMS distance in pixels of a view's corners from the line that fits them best, below which they show no plane.
_MINIMUM_WIDTH = 0.5

# How often what priors refer to is measured anew, and its relative change from which on that is worth it: of the
# solution it moves less than 1e-4 standard deviations.
_PRIOR_ROUNDS, _SAME = 5, 1e-4
# Of a solve that begins next to its solution.
_NEAR_DAMPING = 1e-8
# For a first model from which the last one is reached in one step.
_ROUGH = LMOptions(max_iterations=100, tolerance=1e-5)


class BoardPoints(Protocol):
    """A board: where its corners lie."""

    @property
    def points(self) -> Tensor:
        """(N, 3) meters."""
        ...


class Corners(Protocol):
    """What is calibrated from: `kcal.corners.observations.Observations`, or tensors."""

    @property
    def board(self) -> BoardPoints:
        """The board that was shown."""
        ...

    @property
    def image_size(self) -> tuple[int, int]:
        """(width, height) pixels."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Of the views."""
        ...

    def pixels(self) -> Tensor:
        """(V, N, 2), NaN where not seen."""
        ...

    def covariances(self) -> Tensor | None:
        """(V, N, 2, 2) px², or None."""
        ...


@dataclasses.dataclass(frozen=True, kw_only=True)
class Solved:
    """A solution for one set of corners, before it is judged."""

    views: Views
    problem: BoardProblem
    result: Result
    minimum: Minimum
    plain_cost: float
    spent: int
    variance: float | None


def solve(observations: Corners, options: CalibrationOptions, progress: Progress) -> Steps[Solved]:
    """Find the minimum for all corners given, as `calibrate_camera` describes it; its errors are raised here."""
    model = options.lens
    board = observations.board.points
    pixels = observations.pixels()
    rules = options.rules(observations.image_size)
    fewest = _MINIMUM_VIEWS if options.camera is None else 1
    _check(observations, pixels, len(rules.parameters(model)), options.board_warp, fewest)

    solver = options.solver
    mild = options.weak_prior is not None and options.camera is None and is_overparameterized(model)
    ladder = [lens for lens in steps_to(model) if rules.allows(lens)] if options.camera is None else [model]
    if options.camera is None:
        rough = _ROUGH if mild and len(ladder) > 1 else solver
        first, cold, spent = yield from first_model(board, pixels, observations.image_size, ladder[0], options, rough)
    else:
        if options.camera.size != observations.image_size:
            raise InputError(
                f"the known camera is of {options.camera.size} px, the observations of {observations.image_size} px"
            )
        first = cold = yield from posed(board, pixels, observations.names, options.camera)
        spent = 0
    progress(f"start ({ladder[0]})")
    seen = pixels[:, None]
    views = Views(
        board_points=board,
        pixels=seen,
        size=observations.image_size,
        free_warp=options.board_warp,
        rules=rules,
    )
    reach = float(views.observed_radius(first))
    if mild and options.weak_prior is not None:
        rules = dataclasses.replace(rules, mild=CoefficientPrior(options.weak_prior, reach))
        views = dataclasses.replace(views, rules=rules)
    if rules.informed:
        views = dataclasses.replace(views, prior_noise=max(views.noise(first, ladder[0]), LEAST_NOISE))
    minimum = None
    if rules.mild is not None and len(ladder) > 1:
        minimum = yield from step(views, first, ladder[0], model, progress)
    if minimum is None:
        minimum = yield from climb(views, first, cold, ladder, solver, progress)
    spent += minimum.iterations

    # The first model's poses were looked at; look once more under another lens.
    result = minimum.result
    if result.status == SolverStatus.BAD_START:
        raise InputError(
            "the lens cannot show all corners where they are: are all views of this board and this camera?"
        )
    problem = views.problem(model, terms=minimum.terms)
    if len(ladder) > 1:
        state, flipped = yield from unflipping(board, seen, [model], result.state)
        if flipped:
            result = yield Solve(problem, state, solver)
            spent += int(result.iterations)
    if rules.informed:
        # The noise, against which priors count, is that of this solution, and so is the outermost corner.
        for turn in range(_PRIOR_ROUNDS):
            noise = max(views.noise(result.state, model), LEAST_NOISE)
            reach = float(views.observed_radius(result.state))
            known = rules.mild is None or abs(reach - rules.mild.reach) <= _SAME * reach
            if turn and known and abs(noise - views.prior_noise) <= _SAME * noise:
                break
            if rules.mild is not None:
                rules = dataclasses.replace(rules, mild=dataclasses.replace(rules.mild, reach=reach))
            views = dataclasses.replace(views, prior_noise=noise, rules=rules)
            problem = views.problem(model, terms=minimum.terms)
            result = yield Solve(problem, result.state, dataclasses.replace(solver, initial_damping=_NEAR_DAMPING))
            spent += int(result.iterations)
        rivals = tuple((float(views.problem(model).cost(state)), state) for _, state in minimum.rivals)
        terms = (*minimum.terms, *rules.terms(model, views.prior_noise))
        minimum = dataclasses.replace(minimum, rivals=rivals, terms=terms)
    plain_cost = float(result.cost)
    covariances = observations.covariances() if options.weighted else None
    # The residuals of the plain solution tell how much there is beyond the corners' own noise.
    variance = None if covariances is None else 2.0 * plain_cost / problem.residual_count
    if variance is not None or options.loss is not None:
        problem = corner_problem(observations, options, minimum, variance, options.loss)
        result = yield Solve(problem, result.state, solver)
        spent += int(result.iterations)
    return Solved(
        views=views,
        problem=problem,
        result=result,
        minimum=minimum,
        plain_cost=plain_cost,
        spent=spent,
        variance=variance,
    )


def corner_problem(
    observations: Corners,
    options: CalibrationOptions,
    minimum: Minimum,
    variance: float | None,
    loss: RobustLoss | None,
) -> BoardProblem:
    """All corners with their weights, and a robust loss."""
    model = options.lens
    covariances = None if variance is None else observations.covariances()
    weights = None if covariances is None or variance is None else whitening(covariances, variance)[:, None]
    return BoardProblem(
        observations.board.points,
        observations.pixels()[:, None],
        [model],
        [options.rules(observations.image_size).parameters(model)],
        free_warp=options.board_warp,
        whitening=weights,
        loss=loss,
        terms=minimum.terms,
    )


def _check(observations: Corners, pixels: Tensor, count: int, warp: bool, fewest: int) -> None:
    seen = torch.isfinite(pixels).all(-1).sum(-1)
    if len(pixels) < fewest:
        raise DegenerateError(
            f"{len(pixels)} view(s) of the board: at least {fewest} at different tilts are needed, 10 to 40 are good"
        )
    poor = (seen < _MINIMUM_CORNERS).nonzero()[:, 0].tolist()
    if poor:
        raise InputError(
            f"view {observations.names[poor[0]]!r} has {int(seen[poor[0]])} corners; at least {_MINIMUM_CORNERS} are "
            "needed: remove the view"
        )
    on_line = (~spread_out(observations.board.points, pixels)).nonzero()[:, 0].tolist()
    if on_line:
        raise InputError(
            f"view {observations.names[on_line[0]]!r}: all its corners, or all but one, lie on one line: that leaves "
            "the board's pose open; remove the view"
        )
    centered = torch.nan_to_num(pixels - pixels.nanmean(1, keepdim=True))
    width = torch.linalg.svdvals(centered)[:, 1] / seen.sqrt()
    thin = (width < _MINIMUM_WIDTH).nonzero()[:, 0].tolist()
    if thin:
        raise InputError(
            f"view {observations.names[thin[0]]!r}: its corners coincide or the board is seen edge-on; remove the view"
        )
    unknowns = count + 2 * warp + 6 * len(pixels)
    if 2 * int(seen.sum()) <= unknowns:
        raise DegenerateError(
            f"{int(seen.sum())} corners cannot determine {unknowns} parameters: add views or choose a smaller model"
        )
