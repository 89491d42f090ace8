"""Calibrating a camera whose lens is corrected by a residual field, where held-out views say that this is better."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.forms import Forms, linearise_views
from kcal.calibrate.grouped import PARTS, REFIT, GroupedViews, group_views, judge_parametric, some_views
from kcal.calibrate.hybrid_options import HybridOptions, HybridResult
from kcal.calibrate.ladder import Progress
from kcal.calibrate.mono import calibrate_camera
from kcal.calibrate.options import CameraCalibrationResult
from kcal.calibrate.single import Solved, solve
from kcal.calibrate.stacking import CANDIDATES, average_fit, deal, stack_weights
from kcal.calibrate.terms import Term
from kcal.calibrate.together import alone
from kcal.calibrate.weights import whitening
from kcal.corners.observations import Observations
from kcal.lens.hybrid import HybridCamera
from kcal.lens.model import LensModel
from kcal.lens.projection import from_pixels
from kcal.lens.residual import LARGEST_SLOPE, Field, FieldGrid, FieldResidual, field_bounds
from kcal.solve.lm import minimise
from kcal.solve.result import State, Status

# Rounds of averaging anew where the last average stands, until a step moves no corner by more than this share of the
# noise.
_ROUNDS, _STILL = 6, 0.02
# The last step may still move the residuals by this share of their squared length.
_SETTLED = 1e-4


def calibrate_hybrid(
    observations: Observations, options: HybridOptions | None = None, progress: Progress = lambda _: None
) -> HybridResult:
    """Calibrate a camera with a residual field, and keep the field only where held-out views say so.

    From the parametric solution, the lens, the board's warp, all poses and the weights of a field of several widths
    are fitted jointly under Gaussian priors of the weights: what the intrinsics or the lens can carry, they do.
    Fits under thirteen priors, from no field to an almost free one, are averaged so that the average does best on
    held-out groups of views. The same, done again without each fifth of the groups, is compared on that fifth with
    every parametric model: only a hybrid that is better than all of them is returned.

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
        weights=weights,
        groups=groups,
        free_warp=options.board_warp,
    )
    parts = deal(len(groups), PARTS)
    bases = []
    for model in models:
        bases.append(_base(setting, observations.image_size, model, solutions[model], options.widths, parts))
        progress(f"{model} with a field judged")
    bases.sort(key=lambda base: base.held_out)
    rivals = {}
    for rival in dict.fromkeys(LensModel.named(r) for r in options.rivals):
        rivals[str(rival)] = judge_parametric(setting, rival, solutions[rival], parts)
        progress(f"{rival} judged")

    everything = torch.ones(len(groups), dtype=torch.bool)
    for base in bases:
        shares = stack_weights(base.forms, everything, base.precisions)
        final, field, last, settled = _settle(setting, base, shares)
        if settled:
            break
    else:
        base = bases[0]
        shares = stack_weights(base.forms, everything, base.precisions)
    held_out = {"hybrid": base.held_out, **rivals}
    best = min(rivals, key=lambda name: rivals[name], default=None)
    wins = best is None or base.held_out < rivals[best]
    kept = settled and (wins or not options.gate)
    if kept:
        covariance = _covariance(last, base.precisions, shares)
        calibration = _result(setting, observations.image_size, base, final, field, covariance)
    else:
        calibration = calibrate_camera(observations, options.parametric(best or base.model))
    form = base.forms.total(everything)
    return HybridResult(
        calibration=calibration,
        kept=kept,
        reason=_reason(held_out, best, wins, settled),
        held_out=held_out,
        model=base.model,
        groups=len(groups),
        shares=tuple((prior, share) for prior, share in zip(CANDIDATES, shares.tolist(), strict=True) if share > 1e-3),
        effective=sum(
            share * base.forms.freedom(form, precision)
            for share, precision in zip(shares.tolist(), base.precisions, strict=True)
            if share > 1e-3
        ),
        units=base.grid.count,
        largest=FieldResidual(base.grid, field.weights).bounds()[0] * _focal(final) if settled else math.nan,
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Base:
    """A lens model that a field may correct, and how well the two do on groups that were held out (RMS)."""

    model: LensModel
    solved: Solved
    grid: FieldGrid
    precisions: list[Tensor]
    forms: Forms
    held_out: float


def _base(
    setting: GroupedViews,
    size: tuple[int, int],
    model: LensModel,
    solved: Solved,
    widths: Sequence[float],
    parts: Sequence[Tensor],
) -> _Base:
    grid, half = _grid(solved, size, widths)
    precisions = [prior.precision(grid, half) for prior in CANDIDATES]
    forms = _forms(setting, model, solved.result.state, _no_field(grid))
    base = _Base(model=model, solved=solved, grid=grid, precisions=precisions, forms=forms, held_out=math.nan)
    return dataclasses.replace(base, held_out=_judge_hybrid(setting, base, parts))


def _no_field(grid: FieldGrid) -> Field:
    return Field(grid, torch.zeros(2, grid.count, dtype=torch.float64))


def _reason(held_out: dict[str, float], best: str | None, wins: bool, settled: bool) -> str:
    if not settled:
        return "the field did not settle: the parametric camera is returned"
    if best is None:
        return "no parametric model was asked to compare with"
    verb = "better than" if wins else "no better than"
    return (
        f"on held-out views the hybrid has {held_out['hybrid']:.4f} px, {verb} {best}, the best parametric model, "
        f"with {held_out[best]:.4f} px"
    )


def _grid(solved: Solved, size: tuple[int, int], widths: Sequence[float]) -> tuple[FieldGrid, float]:
    """Units over the image, and half its width, on the distorted plane of a solution."""
    width, height = size
    parameters = solved.result.state[0]
    u = torch.tensor([-0.5, width - 0.5], dtype=torch.float64)
    v = torch.tensor([-0.5, height - 0.5], dtype=torch.float64)
    x, y = from_pixels(u, v, parameters)
    half = 0.5 * float(x[1] - x[0])
    low, high = (float(x[0]), float(y[0])), (float(x[1]), float(y[1]))
    return FieldGrid.covering(low, high, [half * value for value in widths]), half


def _forms(setting: GroupedViews, model: LensModel, state: State, field: Field) -> Forms:
    order = [view for group in setting.groups for view in group]
    problem = setting.problem(model, order, field)
    return linearise_views(problem, some_views(state, order), field, [len(group) for group in setting.groups])


def _stepped(field: Field, step: Tensor, forms: Forms, unit: float) -> Field:
    """The field after a step of `Forms`; `unit` is the focal length of the state where these were taken."""
    return Field(field.grid, field.weights + step[forms.lens : -1].unflatten(0, (2, -1)) / unit)


def _refit(
    setting: GroupedViews, model: LensModel, state: State, views: Sequence[int], field: Field, terms: Sequence[Term]
) -> State:
    """Lens, warp and poses of some views solved again under a field that is held.

    To first order that is the step that the forms gave; a lens whose coefficients the data hardly determine, though,
    has long steps, and only the whole problem with its walls keeps it a lens.
    """
    chosen = list(views)
    return minimise(setting.problem(model, chosen, field, terms), some_views(state, chosen), REFIT).state


def _judge_hybrid(setting: GroupedViews, base: _Base, parts: Sequence[Tensor]) -> float:
    """RMS on each part of the groups of a hybrid whose priors and weights come from the other parts alone."""
    total, state, forms = 0.0, base.solved.result.state, base.forms
    for part in parts:
        chosen = torch.ones(len(forms.counts), dtype=torch.bool)
        chosen[part] = False
        step = average_fit(forms, chosen, base.precisions, stack_weights(forms, chosen, base.precisions))
        field = _stepped(_no_field(base.grid), step, forms, _focal(state))
        train = [i for g in chosen.nonzero()[:, 0].tolist() for i in setting.groups[g]]
        *shared, _, _ = _refit(setting, base.model, state, train, field, base.solved.minimum.terms)
        views = [i for g in part.tolist() for i in setting.groups[g]]
        total += setting.held_out(base.model, (*shared, *state[-2:]), views, field)
    return math.sqrt(total / setting.count)


def _focal(state: State) -> float:
    return float(state[0][:2].log().mean().exp())


def _settle(setting: GroupedViews, base: _Base, shares: Tensor) -> tuple[State, Field, Forms, bool]:
    """The averaged fit of all views: a step of the field, all else solved again, anew until it stands still.

    Returns the state, its field, the last forms, and whether it settled.
    """
    model, terms = base.model, base.solved.minimum.terms
    state, field = base.solved.result.state, _no_field(base.grid)
    every = torch.ones(len(setting.groups), dtype=torch.bool)
    before = math.inf
    for _ in range(_ROUNDS):
        forms = _forms(setting, model, state, field)
        step = average_fit(forms, every, base.precisions, shares)
        now = forms.total(every)
        noise = float(now[-1, -1])
        # How much the step changes the residuals, as their squared length.
        change = torch.cat([step[:-1], torch.zeros_like(step[-1:])])
        moved = float(change @ now @ change)
        after = _stepped(field, step, forms, _focal(state))
        steady = math.isfinite(moved) and moved < 4.0 * before
        if not steady or not field_bounds(after)[1] <= LARGEST_SLOPE:
            return state, field, forms, False
        state = _refit(setting, model, state, range(len(setting.pixels)), after, terms)
        field, before = after, moved
        if moved <= _STILL**2 * noise / setting.count:
            break
    return state, field, forms, moved <= _SETTLED * noise


def _covariance(forms: Forms, precisions: Sequence[Tensor], shares: Tensor) -> Tensor:
    """(L, L) covariance of lens and warp: within each candidate's fit, and between the fits that are averaged."""
    form = forms.total(torch.ones(len(forms.counts), dtype=torch.bool))
    used = [(share, precision) for share, precision in zip(shares.tolist(), precisions, strict=True) if share > 0]
    fits = torch.stack([forms.fit(form, precision)[: forms.lens] for _, precision in used])
    share = torch.tensor([share for share, _ in used], dtype=form.dtype)[:, None]
    within = torch.stack([forms.covariance(form, precision) for _, precision in used])
    noise = float(form[-1, -1]) / (2.0 * float(forms.counts.sum()))
    apart = fits - (share * fits).sum(0)
    between = apart.T @ (share * apart)
    return (share[..., None] * within).sum(0) * noise + between


def _result(
    setting: GroupedViews,
    size: tuple[int, int],
    base: _Base,
    state: State,
    field: Field,
    covariance: Tensor,
) -> CameraCalibrationResult:
    problem = setting.problem(base.model, range(len(setting.pixels)), field)
    state = problem.tidy(state)
    s = problem.unpack(state)
    camera = HybridCamera(
        s.parameters[0], size=size, model=base.model, residual=FieldResidual(field.grid, field.weights)
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
        sigma={camera.names[i]: float(of_all[i, i].sqrt()) for i in free},
        covariance=of_all,
        status=Status.CONVERGED,
        iterations=base.solved.spent,
        warnings=(),
    )


__all__ = ["HybridOptions", "HybridResult", "calibrate_hybrid"]
