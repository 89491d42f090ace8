"""Fitting a residual field beside a lens: under averaged priors, to some views or to all."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.bundle.priors import Term
from kcal.calibrate.camera.solve import Solved
from kcal.calibrate.lensfit.held_out import REFIT, GroupedViews, some_views
from kcal.calibrate.lensfit.model_choice import Contender
from kcal.calibrate.lensfit.quadratic_forms import QuadraticForms, linearize_views
from kcal.calibrate.lensfit.stacking import CANDIDATES, average_fit, stack_weights
from kcal.lens.model import LensModel
from kcal.lens.projection import from_pixels
from kcal.lens.residual import LARGEST_SLOPE, Field, FieldGrid, field_bounds
from kcal.solve.lm import minimize
from kcal.solve.result import Result, State

# Rounds of averaging anew where the last average stands, until a step moves no corner by more than this share of the
# noise.
_ROUNDS, _STILL = 8, 0.02
# A round may raise the squared residuals by no more than this factor.
_WORSE = 1.1
# A smaller share of the average is not worth a mention.
SEEN = 1e-3


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldFit:
    """A lens model that a field may correct, its views as forms, and how priors are averaged."""

    model: LensModel
    solved: Solved
    grid: FieldGrid
    precisions: list[Tensor]
    forms: QuadraticForms
    shares: Tensor
    effective: float
    judged: Contender


class Settled(NamedTuple):
    """A field that stands still: all parameters but its own, the field, and the last forms."""

    state: State
    field: Field
    forms: QuadraticForms


def fit_field(
    setting: GroupedViews,
    size: tuple[int, int],
    model: LensModel,
    solved: Solved,
    widths: Sequence[float],
    parts: Sequence[Tensor],
) -> FieldFit:
    """Fit a field on top of a parametric solution, to first order.

    Args:
        setting: the views.
        size: of the image.
        model: the lens model.
        solved: its solution.
        widths: of the field's units, in half widths of the image.
        parts: numbers of the groups that are held out together to judge it; none: it is not judged.
    """
    grid, half = _grid(solved, size, widths)
    precisions = [prior.precision(grid, half) for prior in CANDIDATES]
    forms = _forms(setting, model, solved.result.state, _no_field(grid))
    everything = torch.ones(len(setting.groups), dtype=torch.bool)
    shares, form = stack_weights(forms, everything, precisions), forms.total(everything)
    effective = sum(
        share * forms.freedom(form, precision)
        for share, precision in zip(shares.tolist(), precisions, strict=True)
        if share > SEEN
    )
    base = FieldFit(
        model=model,
        solved=solved,
        grid=grid,
        precisions=precisions,
        forms=forms,
        shares=shares,
        effective=effective,
        judged=Contender(name="hybrid", costs=shares.new_zeros(0)),
    )
    if not parts:
        return base
    costs = _judge_hybrid(setting, base, parts)
    return dataclasses.replace(base, judged=dataclasses.replace(base.judged, costs=costs))


def _no_field(grid: FieldGrid) -> Field:
    return Field(grid, torch.zeros(2, grid.count, dtype=torch.float64))


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


def _forms(setting: GroupedViews, model: LensModel, state: State, field: Field, border: bool = True) -> QuadraticForms:
    order = setting.views(torch.ones(len(setting.groups), dtype=torch.bool))
    problem = setting.problem(model, order, field)
    inner = setting.within.problem(model, order, field) if border else None
    return linearize_views(problem, some_views(state, order), field, [len(group) for group in setting.groups], inner)


def _stepped(field: Field, step: Tensor, forms: QuadraticForms, unit: float) -> Field:
    """The field after a step of `QuadraticForms`; `unit` is the focal length of the state where these were taken."""
    return Field(field.grid, field.weights + step[forms.lens : -1].unflatten(0, (2, -1)) / unit)


def _refit(
    setting: GroupedViews, model: LensModel, state: State, views: Sequence[int], field: Field, terms: Sequence[Term]
) -> Result:
    """Lens, warp and poses of some views solved again under a field that is held.

    To first order that is the step that the forms gave; a lens whose coefficients the data hardly determine, though,
    has long steps, and only the whole problem with its walls keeps it a lens.
    """
    chosen = list(views)
    return minimize(setting.problem(model, chosen, field, terms), some_views(state, chosen), REFIT)


def _judge_hybrid(setting: GroupedViews, base: FieldFit, parts: Sequence[Tensor]) -> Tensor:
    """(G,) squared residuals of a hybrid whose priors and weights come from the other parts alone."""
    state, forms = base.solved.result.state, base.forms

    def fit(chosen: Tensor) -> tuple[LensModel, State, Field]:
        shares = stack_weights(forms, chosen, base.precisions)
        step = average_fit(forms, forms.total(chosen), base.precisions, shares)
        field = _stepped(_no_field(base.grid), step, forms, focal_of(state))
        train = setting.views(chosen)
        *shared, _, _ = _refit(setting, base.model, state, train, field, base.solved.minimum.terms).state
        return base.model, (*shared, *state[-2:]), field

    return setting.judge(parts, fit)


def focal_of(state: State) -> float:
    """Pixels for each unit of the plane, the mean of both axes."""
    return float(state[0][:2].log().mean().exp())


def settle(setting: GroupedViews, base: FieldFit) -> Settled | None:
    """The averaged fit of all views: a step of the field, all else solved again, anew until it stands still.

    Where a further step would be too long, or rounds run out, the field stays as it is: after the first step it is what
    held-out views have judged, afterwards nearer to where it would stand still.

    Returns None where not even the first step is possible.
    """
    model, terms = base.model, base.solved.minimum.terms
    state, field = base.solved.result.state, _no_field(base.grid)
    every = torch.ones(len(setting.groups), dtype=torch.bool)
    before, found = math.inf, False
    for _ in range(_ROUNDS):
        forms = _forms(setting, model, state, field, border=False)
        now = forms.total(every)
        step = average_fit(forms, now, base.precisions, base.shares)
        moved = _moved(forms, now, step)
        after = _stepped(field, step, forms, focal_of(state))
        if not moved < 4.0 * before or not field_bounds(after)[1] <= LARGEST_SLOPE:
            break
        refit = _refit(setting, model, state, range(len(setting.pixels)), after, terms)
        # An average of fits need not fit better than what was there, but no step makes it much worse.
        if not 2.0 * float(refit.cost) <= _WORSE * float(now[-1, -1]):
            break
        state, field, before, found = refit.state, after, moved, True
        if moved <= _STILL**2 * float(now[-1, -1]) / setting.count:
            break
    return Settled(state, field, forms) if found else None


def _moved(forms: QuadraticForms, form: Tensor, step: Tensor) -> float:
    """How much a step changes the residuals, as their squared length: the whole step, or the field's part of it alone.

    A wall before a fold can hold the lens where the form, which knows no walls, would always move it on; and lens and
    field can trade what neither corner sees.
    """
    whole = torch.cat([step[:-1], torch.zeros_like(step[-1:])])
    alone = whole.clone()
    alone[: forms.lens] = 0.0
    lengths = [float(change @ form @ change) for change in (whole, alone)]
    return min(lengths) if all(map(math.isfinite, lengths)) else math.inf


def field_covariance(base: FieldFit, forms: QuadraticForms) -> Tensor:
    """(L, L) covariance of lens and warp: within each candidate's fit, and between the fits that are averaged."""
    form = forms.total(torch.ones(len(forms.counts), dtype=torch.bool))
    used = [
        (share, precision) for share, precision in zip(base.shares.tolist(), base.precisions, strict=True) if share > 0
    ]
    fits = torch.stack([forms.fit(form, precision)[: forms.lens] for _, precision in used])
    share = torch.tensor([share for share, _ in used], dtype=form.dtype)[:, None]
    within = torch.stack([forms.covariance(form, precision) for _, precision in used])
    noise = float(form[-1, -1]) / (2.0 * float(forms.counts.sum()))
    apart = fits - (share * fits).sum(0)
    between = apart.T @ (share * apart)
    return (share[..., None] * within).sum(0) * noise + between
