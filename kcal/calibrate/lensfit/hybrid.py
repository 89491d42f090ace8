"""Calibrating a camera whose lens is corrected by a residual field, where held-out views say that this is better."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from kcal.calibrate.bundle.batching import alone
from kcal.calibrate.bundle.weights import whitening
from kcal.calibrate.camera.calibrate import judged
from kcal.calibrate.camera.options import CameraCalibrationResult
from kcal.calibrate.camera.record import camera_calibration
from kcal.calibrate.camera.solve import Solved, solve
from kcal.calibrate.lensfit.field_fit import SEEN, FieldFit, Settled, field_covariance, fit_field, focal_of, settle
from kcal.calibrate.lensfit.held_out import (
    PARTS,
    GroupedViews,
    group_views,
    judge_parametric,
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
from kcal.solve.result import Status

# A field of fewer weights in effect is what chance leaves of none.
_LEAST = 3.0


def calibrate_hybrid(
    observations: Observations, options: HybridOptions | None = None, progress: Progress = lambda _: None
) -> HybridResult:
    """Calibrate a camera with a residual field, and keep the field only where held-out views say so.

    From the parametric solution, the lens, the board's warp, all poses and the weights of a field of several widths
    are fitted jointly under Gaussian priors of the weights: what the intrinsics or the lens can carry, they do.
    Fits under thirteen priors, from no field to an almost free one, are averaged so that the average does best on
    held-out groups of views, and on the corners next to the border, held out in all of them, which tell how a field is
    extrapolated. The same, done again without each fifth of the groups, is compared on that fifth with parametric
    models. Of these, and likewise of the lenses under a field, the first is chosen that is not surely worse than the
    best one (`kcal.calibrate.lensfit.model_choice`). The hybrid is returned where it is better than that parametric
    model; by more than one standard error, if its lens does not contain that model.

    Args:
        observations: the views of one camera.
        options: see `HybridOptions`.
        progress: told what has just been finished.

    Returns:
        the camera with the evidence.

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
        >>> result.kept, type(result.calibration.camera).__name__  # the lens is parametric, and so is the answer
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
        weights = whitening(covariances, first.variance)[:, None]
    setting = GroupedViews(
        board_points=observations.board.points,
        pixels=observations.pixels()[:, None],
        inner=without_border(observations.pixels(), observations.image_size)[:, None],
        weights=weights,
        groups=groups,
        free_warp=options.board_warp,
    )
    # A single hybrid is compared with nothing.
    parts = deal(len(groups), PARTS) if len(models) > 1 or options.rivals else []
    bases = []
    for model in models:
        bases.append(fit_field(setting, observations.image_size, model, solutions[model], options.widths, parts))
        progress(f"{model} with a field judged")
    rivals = []
    for model in dict.fromkeys(LensModel.named(r) for r in options.rivals):
        costs = judge_parametric(setting, model, solutions[model], parts)
        rivals.append(Contender(name=str(model), costs=costs))
        progress(f"{model} judged")

    settled = None
    for base in _by_preference(bases):
        settled = settle(setting, base)
        if settled is not None:
            break
    else:
        base = bases[0]
    rival = choose(rivals) if rivals else None
    # How much of a field to believe was settled by held-out views, with none at all among the candidates: beside a lens
    # within its own it need not be surely better, but better it has to be. Beside another lens it is another model.
    better = rival is None or (
        base.effective >= _LEAST
        and (
            base.judged.total < rival.total
            if base.model.contains(LensModel.named(rival.name))
            else surely_worse(rival, base.judged, errors=1.0)
        )
    )
    wins = settled is not None and better
    kept = settled is not None and (wins or not options.gate)
    if settled is not None and kept:
        calibration = _result(observations, setting, base, settled)
    else:
        model = base.model if rival is None else LensModel.named(rival.name)
        calibration = judged(observations, solutions[model], options.parametric(model))
    calibration.camera.calibration = camera_calibration(calibration, observations)
    return HybridResult(
        calibration=calibration,
        kept=kept,
        reason=_reason(base, rival, wins, settled is not None, setting.count),
        choice="hybrid" if wins else str(base.model) if rival is None else rival.name,
        held_out={one.name: math.sqrt(one.total / setting.count) for one in (base.judged, *rivals) if parts},
        model=base.model,
        groups=len(groups),
        shares=tuple(
            (prior, share) for prior, share in zip(CANDIDATES, base.shares.tolist(), strict=True) if share > SEEN
        ),
        effective=base.effective,
        units=base.grid.count,
        largest=math.nan
        if settled is None
        else FieldResidual(base.grid, settled.field.weights).bounds()[0] * focal_of(settled.state),
    )


class _Solutions(dict[LensModel, Solved]):
    """Parametric solutions, each found when it is first asked for."""

    def __init__(self, observations: Observations, options: HybridOptions) -> None:
        super().__init__()
        self._ask = observations, options

    def __missing__(self, model: LensModel) -> Solved:
        observations, options = self._ask
        self[model] = alone(solve(observations, options.parametric(model), lambda _: None))
        return self[model]


def _by_preference(bases: Sequence[FieldFit]) -> list[FieldFit]:
    """The one that held-out views choose, and then the others, the best first."""
    first = choose([base.judged for base in bases])
    return sorted(bases, key=lambda base: (base.judged is not first, base.judged.total))


def _reason(base: FieldFit, rival: Contender | None, wins: bool, settled: bool, count: int) -> str:
    if not settled:
        return "no step of the field was possible: the parametric camera is returned"
    if rival is None:
        return "no parametric model was asked to compare with"
    own, other = (math.sqrt(one.total / count) for one in (base.judged, rival))
    found = (
        f"on held-out views the hybrid has {own:.4f} px, {rival.name}, the parametric model to choose, {other:.4f} px"
    )
    if not wins:
        return f"no better than a parametric model: {found}"
    sure = "by more than chance explains" if surely_worse(rival, base.judged) else "if within chance"
    return f"better than a parametric model, {sure}: {found}"


def _result(
    observations: Observations, setting: GroupedViews, base: FieldFit, settled: Settled
) -> CameraCalibrationResult:
    field, covariance = settled.field, field_covariance(base, settled.forms)
    problem = setting.problem(base.model, range(len(setting.pixels)), field)
    state = problem.tidy(settled.state)
    s = problem.unpack(state)
    camera = HybridCamera(
        s.parameters[0],
        size=observations.image_size,
        model=base.model,
        residual=FieldResidual(field.grid, field.weights),
    )
    residuals = problem.pixel_errors(state)[:, 0].transpose(-1, -2)
    seen = problem.seen[:, 0]
    squared = (residuals**2).sum(-1)
    free = list(problem.free[0])
    of_all = covariance.new_zeros(len(camera.names), len(camera.names))
    of_all[torch.tensor(free)[:, None], torch.tensor(free)] = covariance[: len(free), : len(free)]
    return CameraCalibrationResult(
        camera=camera,
        rms=float(torch.sqrt(squared.sum() / seen.sum())),
        weighted_rms=math.sqrt(2.0 * float(problem.cost(state)) / setting.count) if problem.whitened else None,
        per_view_rms=torch.sqrt(squared.sum(-1) / seen.sum(-1)),
        residuals=torch.where(seen[..., None], residuals, torch.nan),
        cam_from_board_rotation=s.first_from_board_rotation,
        cam_from_board_translation=s.first_from_board_translation,
        board_warp=s.warp if problem.free_warp else None,
        sigma={
            camera.names[i]: float(of_all[i, i].sqrt()) if bool(torch.isfinite(of_all[i, i])) else None for i in free
        },
        covariance=of_all,
        status=Status.CONVERGED,
        iterations=base.solved.spent,
        warnings=(),
        observations=observations,
    )


__all__ = ["HybridOptions", "HybridResult", "calibrate_hybrid"]
