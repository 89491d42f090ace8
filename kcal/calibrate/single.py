"""One camera's minimum: closed forms, first model, ladder, weights. What to think of it is told elsewhere."""

from __future__ import annotations

import dataclasses
from typing import Protocol

import torch
from torch import Tensor

from kcal.calibrate.init import (
    homographies,
    intrinsics_candidates,
    poses_from_homographies,
    radial_start,
    spread_out,
)
from kcal.calibrate.ladder import Minimum, Progress, climb, steps_to
from kcal.calibrate.mild import Mild
from kcal.calibrate.options import CalibrationOptions
from kcal.calibrate.poses import refining, unflipping
from kcal.calibrate.problem import BoardProblem
from kcal.calibrate.together import Solve, Steps
from kcal.calibrate.views import Views
from kcal.calibrate.weights import whitening
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS
from kcal.solve.lm import LMOptions
from kcal.solve.result import Result, State, Status
from kcal.solve.robust import RobustLoss

_MINIMUM_VIEWS = 3
_MINIMUM_CORNERS = 6
# RMS distance in pixels of a view's corners from the line that fits them best, below which they show no plane.
_MINIMUM_WIDTH = 0.5
# A first fit worse than this many pixels is retried from other focal lengths.
_SUSPICIOUS_RMS = 2.0

# Of a corner, pixels; and how often it is measured anew beside priors.
LEAST_NOISE, _NOISE_ROUNDS = 1e-3, 3


class BoardPoints(Protocol):
    """A board: where its corners lie."""

    @property
    def points(self) -> Tensor:
        """(N, 3) metres."""
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
    ladder = [step for step in steps_to(model) if rules.allows(step)] if options.camera is None else [model]
    if options.camera is None:
        first, cold, spent = yield from _first(board, pixels, observations.image_size, ladder[0], options)
    else:
        first = cold = yield from _known(observations, pixels, options.camera)
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
    if options.weak_prior is not None:
        rules = dataclasses.replace(rules, mild=Mild(options.weak_prior, reach))
        views = dataclasses.replace(views, rules=rules)
    if rules.informed:
        views = dataclasses.replace(views, prior_noise=max(views.noise(first, ladder[0]), LEAST_NOISE))
    minimum = yield from climb(views, first, cold, ladder, solver, progress)
    spent += minimum.iterations

    # The first model's poses were looked at; look once more under another lens.
    result = minimum.result
    if result.status == Status.BAD_START:
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
        # The noise, against which priors count, is that of this solution.
        for _ in range(_NOISE_ROUNDS):
            views = dataclasses.replace(views, prior_noise=max(views.noise(result.state, model), LEAST_NOISE))
            problem = views.problem(model, terms=minimum.terms)
            result = yield Solve(problem, result.state, solver)
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
    centred = torch.nan_to_num(pixels - pixels.nanmean(1, keepdim=True))
    width = torch.linalg.svdvals(centred)[:, 1] / seen.sqrt()
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


def _first(
    board: Tensor, pixels: Tensor, size: tuple[int, int], model: LensModel, options: CalibrationOptions
) -> Steps[tuple[State, State, int]]:
    """The first model's solution, a start without distortion, both from the closed forms, and the trials spent."""
    homography = homographies(board, pixels)
    spent = 0
    best: tuple[float, State, State] | None = None
    candidates = intrinsics_candidates(homography, size)
    rules, focal = options.rules(size), options.start_focal(size)
    if focal is not None:
        centre = [(size[0] - 1) / 2, (size[1] - 1) / 2]
        candidates.insert(0, torch.tensor([focal, focal, *centre], dtype=torch.float64))
    views = Views(board_points=board, pixels=pixels[:, None], size=size, free_warp=options.board_warp, rules=rules)
    for candidate in candidates:
        zero = torch.zeros(len(INTRINSICS) + model.size, dtype=torch.float64)
        zero[:4] = candidate
        zero = rules.impose(zero, model)
        intrinsics = zero[:4]
        rotation, translation = poses_from_homographies(homography, intrinsics)
        lens = zero.clone()
        if model.numerator >= 2:
            k1, k2 = (len(INTRINSICS) + i for i in model.numerator_index[:2])
            lens[[k1, k2]] = radial_start(board, pixels, intrinsics, rotation, translation)
        lens = rules.impose(lens, model)
        rest = (
            torch.zeros(2, dtype=torch.float64),
            torch.zeros(0, 3, 3, dtype=torch.float64),
            torch.zeros(0, 3, dtype=torch.float64),
            rotation,
            translation,
        )
        problem = views.problem(model)
        cold: State = (zero, *rest)
        for start in ((lens, *rest), cold):
            result = yield Solve(problem, start, options.solver)
            spent += int(result.iterations)
            if result.status != Status.BAD_START:
                break
        state, flipped = yield from unflipping(board, pixels[:, None], [model], result.state)
        if flipped:
            result = yield Solve(problem, state, options.solver)
            spent += int(result.iterations)
        cost = float(result.cost)
        if cost == cost and (best is None or cost < best[0]):
            best = (cost, result.state, cold)
        if best is not None and _rms(best[0], pixels) < _SUSPICIOUS_RMS:
            break
    if best is None:
        raise InputError("no start explains the corners: are all views of this board and from this camera?")
    return best[1], best[2], spent


def _known(observations: Corners, pixels: Tensor, camera: Camera) -> Steps[State]:
    """Board poses under a known camera, refined one by one, both tilts of each tried."""
    if camera.size != observations.image_size:
        raise InputError(f"the known camera is of {camera.size} px, the observations of {observations.image_size} px")
    board, seen = observations.board.points, torch.isfinite(pixels).all(-1)
    camera = Camera(camera.parameters_vector.detach().double().cpu(), size=camera.size, model=camera.model)
    rays, valid = camera.unproject(torch.nan_to_num(pixels))
    used = seen & valid & (rays[..., 2] > 0)
    ideal = torch.where(used[..., None], rays[..., :2] / rays[..., 2:], torch.nan)
    poor = (~spread_out(board, ideal)).nonzero()[:, 0].tolist()
    if poor:
        raise InputError(f"view {observations.names[poor[0]]!r}: the known camera gives its corners too few rays")
    pinhole = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
    poses = poses_from_homographies(homographies(board, ideal), pinhole)
    empty = torch.zeros(0, 3, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.float64)
    state: State = (camera.parameters_vector, torch.zeros(2, dtype=torch.float64), *empty, *poses)
    views = pixels[:, None]
    state, _ = yield from refining(board, views, [camera.model], state, LMOptions(max_iterations=30))
    state, _ = yield from unflipping(board, views, [camera.model], state)
    return state


def _rms(cost: float, pixels: Tensor) -> float:
    return float((2.0 * cost / int(torch.isfinite(pixels).all(-1).sum())) ** 0.5)
