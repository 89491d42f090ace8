"""Calibrate a camera with a residual field, where that is better on held-out views."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from kcal.calibrate.bundle.views import Views, free_parameters
from kcal.calibrate.bundle.weights import whitening
from kcal.calibrate.camera.assess import assess
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.calibrate.camera.solve import Solution, solve
from kcal.calibrate.lensfit.field_fit import (
    LISTED,
    ConvergedField,
    FieldFit,
    field_covariance,
    fit_field,
    fit_to_convergence,
    focal_of,
)
from kcal.calibrate.lensfit.held_out import (
    PARTS,
    GroupedViews,
    cross_validate_parametric,
    group_views,
    without_border,
)
from kcal.calibrate.lensfit.model_choice import Contender, choose, surely_worse
from kcal.calibrate.lensfit.options import HybridOptions, HybridResult
from kcal.calibrate.lensfit.stacking import CANDIDATES, deal
from kcal.calibrate.search.model_ladder import Progress
from kcal.corners.observations import Observations
from kcal.lens.hybrid import HybridCamera
from kcal.lens.model import LensModel
from kcal.lens.residual import FieldResidual
from kcal.solve.result import SolverStatus

# A field with fewer effective weights is no more than chance.
_LEAST = 3.0


def calibrate_hybrid(
    observations: Observations, options: HybridOptions | None = None, progress: Progress = lambda _: None
) -> HybridResult:
    """Calibrate a camera with a residual field, and keep the field only where it is better on held-out views.

    Starting at the parametric solution, the lens, the board's warp, all poses and the weights of a field with several
    widths are fitted jointly, under Gaussian priors on the weights. Fits under thirteen priors, from no field to an
    almost free one, are averaged. Their weights minimize the cost of held-out groups of views and of the corners next
    to the border, which show how a field extrapolates. All of this is repeated without each fifth of the groups, and
    compared on that fifth with parametric models. Of these, and of the lenses under a field, the first one is chosen
    that is not significantly worse than the best one (`kcal.calibrate.lensfit.model_choice`). The hybrid is returned
    where it is better than that parametric model; by more than one standard error, if its lens does not contain that
    model.

    Args:
        observations: the views of one camera.
        options: see `HybridOptions`.
        progress: called with what has just been finished.

    Returns:
        the camera with the reasons for the choice.

    Raises:
        DegenerateError: as `calibrate_camera`, and with too few groups of views.
        InputError: as `calibrate_camera`.

    Example:
        >>> from kcal.corners.board import Board
        >>> from kcal.corners.observations import View
        >>> from kcal.lens.camera import Camera
        >>> from kcal.lens.pose import rotation_from_vector
        >>> board = Board(columns=7, rows=6, square=0.05)
        >>> truth = Camera.build(focal=(800, 805), center=(322, 238), size=(640, 480), coefficients=[-0.1, 0.02])
        >>> noise, views = torch.Generator().manual_seed(0), []
        >>> for i in range(8):
        ...     tilt = 0.5 * torch.tensor([[math.cos(i), math.sin(i), 0.2]], dtype=torch.float64)
        ...     points = board.points @ rotation_from_vector(tilt)[0].T
        ...     pixels, _ = truth.project(points + torch.tensor([-0.15, -0.12, 0.6], dtype=torch.float64))
        ...     pixels = pixels + 0.1 * torch.randn(pixels.shape, dtype=torch.float64, generator=noise)
        ...     views.append(View(name=str(i), pixels=pixels.tolist()))
        >>> seen = Observations(board=board, image_size=(640, 480), views=views)
        >>> options = HybridOptions(models=("opencv5",), rivals=("opencv4",), widths=(1.0,), groups="views")
        >>> result = calibrate_hybrid(seen, options)
        >>> result.kept, type(result.calibration.camera).__name__  # the true lens is parametric
        (False, 'Camera')
    """
    options = options or HybridOptions()
    groups = group_views(observations, options.groups)
    solutions = _Solutions(observations, options)
    models = tuple(dict.fromkeys(LensModel.named(model) for model in options.models))
    first = solutions[models[0]]
    covariances = observations.covariances() if options.weighted else None
    weights = None
    if covariances is not None and first.variance is not None:
        weights = whitening(covariances, first.variance)
    views = Views(
        board_points=observations.board.points,
        pixels=observations.pixels(),
        whitening=weights,
        free_warp=options.board_warp,
    )
    grouped = GroupedViews(every=views, inner=without_border(views.pixels, observations.image_size), groups=groups)
    # A single hybrid is compared with nothing.
    parts = deal(len(groups), PARTS) if len(models) > 1 or options.rivals else []
    bases = []
    for model in models:
        bases.append(fit_field(grouped, observations.image_size, model, solutions[model], options.widths, parts))
        progress(f"{model} with a field compared")
    rivals = []
    for model in dict.fromkeys(LensModel.named(r) for r in options.rivals):
        costs = cross_validate_parametric(grouped, model, solutions[model], parts)
        rivals.append(Contender(name=str(model), costs=costs))
        progress(f"{model} compared")

    converged = None
    for base in _by_preference(bases):
        converged = fit_to_convergence(grouped, base)
        if converged is not None:
            break
    else:
        base = bases[0]
    rival = choose(rivals) if rivals else None
    # No field at all was among the candidates of the average. So a hybrid whose lens contains the rival must be better,
    # but not significantly; against another lens it is another model.
    better = rival is None or (
        base.effective >= _LEAST
        and (
            base.held_out.total < rival.total
            if base.model.contains(LensModel.named(rival.name))
            else surely_worse(rival, base.held_out, errors=1.0)
        )
    )
    wins = converged is not None and better
    kept = converged is not None and (wins or not options.gate)
    corners = views.corner_count
    if converged is not None and kept:
        calibration = _hybrid_calibration(views, observations, base, converged)
    else:
        model = base.model if rival is None else LensModel.named(rival.name)
        calibration = assess(observations, solutions[model], options.parametric(model))
    return HybridResult(
        calibration=calibration,
        kept=kept,
        reason=_reason(base, rival, wins, converged is not None, corners),
        choice="hybrid" if wins else str(base.model) if rival is None else rival.name,
        held_out={one.name: math.sqrt(one.total / corners) for one in (base.held_out, *rivals) if parts},
        model=base.model,
        groups=len(groups),
        shares=tuple(
            (prior, share) for prior, share in zip(CANDIDATES, base.shares.tolist(), strict=True) if share > LISTED
        ),
        effective=base.effective,
        units=base.grid.count,
        largest=math.nan
        if converged is None
        else FieldResidual(base.grid, converged.field.weights).bounds()[0] * focal_of(converged.state),
    )


class _Solutions(dict[LensModel, Solution]):
    """Parametric solutions, each found when it is first used."""

    def __init__(self, observations: Observations, options: HybridOptions) -> None:
        super().__init__()
        self._arguments = observations, options

    def __missing__(self, model: LensModel) -> Solution:
        observations, options = self._arguments
        self[model] = solve(observations, options.parametric(model), lambda _: None)
        return self[model]


def _by_preference(bases: Sequence[FieldFit]) -> list[FieldFit]:
    """The one chosen on held-out views, and then the others, the best first."""
    first = choose([base.held_out for base in bases])
    return sorted(bases, key=lambda base: (base.held_out is not first, base.held_out.total))


def _reason(base: FieldFit, rival: Contender | None, wins: bool, converged: bool, count: int) -> str:
    if not converged:
        return "no step of the field was possible: the parametric camera is returned"
    if rival is None:
        return "there was no parametric model to compare with"
    own, other = (math.sqrt(one.total / count) for one in (base.held_out, rival))
    found = f"held-out RMS {own:.4f} px against {other:.4f} px of {rival.name}, the best parametric choice"
    if not wins:
        return f"no better than a parametric model: {found}"
    sure = "by more than chance explains" if surely_worse(rival, base.held_out) else "though within chance"
    return f"better than a parametric model, {sure}: {found}"


def _hybrid_calibration(
    views: Views, observations: Observations, base: FieldFit, converged: ConvergedField
) -> CameraCalibrationResult:
    field, covariance = converged.field, field_covariance(base, converged.forms)
    free = free_parameters(base.model)
    problem = views.problem(base.model, free, field=field)
    state = problem.tidy(converged.state)
    residual = FieldResidual(field.grid, field.weights)
    camera = HybridCamera(state.parameters, size=observations.image_size, model=base.model, residual=residual)
    squared, seen = problem.pixel_errors(state).square().sum(-2), problem.seen
    of_all = covariance.new_zeros(len(camera.names), len(camera.names))
    of_all[torch.tensor(free)[:, None], torch.tensor(free)] = covariance[: len(free), : len(free)]
    return CameraCalibrationResult(
        observations=observations,
        camera=camera,
        rms=float(torch.sqrt(squared.sum() / seen.sum())),
        weighted_rms=None
        if views.whitening is None
        else math.sqrt(2.0 * float(problem.cost(state)) / views.corner_count),
        per_view_rms=torch.sqrt(squared.sum(-1) / seen.sum(-1)),
        residuals=problem.corner_residuals(state),
        cam_from_board_rotation=state.rotation,
        cam_from_board_translation=state.translation,
        board_warp=state.warp if problem.free_warp else None,
        sigma={
            camera.names[i]: float(of_all[i, i].sqrt()) if bool(torch.isfinite(of_all[i, i])) else None for i in free
        },
        covariance=of_all,
        status=SolverStatus.CONVERGED,
        iterations=base.solution.spent,
        warnings=(),
    )


__all__ = ["HybridOptions", "HybridResult", "calibrate_hybrid"]
