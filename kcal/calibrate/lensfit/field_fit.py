"""Fit a residual field together with a lens, averaged over priors, to some views or to all."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardState
from kcal.calibrate.bundle.priors import Term
from kcal.calibrate.camera.solve import Solution
from kcal.calibrate.lensfit.held_out import REFIT, GroupedViews
from kcal.calibrate.lensfit.model_choice import Contender
from kcal.calibrate.lensfit.quadratic_forms import QuadraticForms, linearize_views
from kcal.calibrate.lensfit.stacking import CANDIDATES, average_fit, stack_weights
from kcal.lens.model import LensModel
from kcal.lens.projection import from_pixels
from kcal.lens.residual import LARGEST_SLOPE, Field, FieldGrid, field_bounds
from kcal.solve.lm import minimize
from kcal.solve.result import Result

# Rounds of averaging again at the last average, until a step moves corners by less than this share of the noise.
_ROUNDS, _CONVERGED = 8, 0.02
# A round may raise the squared residuals by no more than this factor.
_WORSE = 1.1
# A smaller share of the average is not listed.
LISTED = 1e-3


@dataclasses.dataclass(frozen=True, kw_only=True)
class FieldFit:
    """A lens model that a field may correct, its views as quadratic forms, and the weights of the priors."""

    model: LensModel
    solution: Solution
    grid: FieldGrid
    precisions: list[Tensor]
    forms: QuadraticForms
    shares: Tensor
    effective: float
    held_out: Contender


class ConvergedField(NamedTuple):
    """A field with all other parameters, and the last quadratic forms."""

    state: BoardState
    field: Field
    forms: QuadraticForms


def fit_field(
    grouped: GroupedViews,
    size: tuple[int, int],
    model: LensModel,
    solution: Solution,
    widths: Sequence[float],
    parts: Sequence[Tensor],
) -> FieldFit:
    """Fit a field on top of a parametric solution, to first order.

    Args:
        grouped: the views.
        size: of the image.
        model: the lens model.
        solution: its solution.
        widths: of the field's units, in half widths of the image.
        parts: numbers of the groups that are held out together for cross-validation; none: there is none.
    """
    grid, half = _grid(solution, size, widths)
    precisions = [prior.precision(grid, half) for prior in CANDIDATES]
    forms = _forms(grouped, model, solution.result.state, _no_field(grid))
    everything = torch.ones(len(grouped.groups), dtype=torch.bool)
    shares, form = stack_weights(forms, everything, precisions), forms.total(everything)
    effective = sum(
        share * forms.freedom(form, precision)
        for share, precision in zip(shares.tolist(), precisions, strict=True)
        if share > LISTED
    )
    base = FieldFit(
        model=model,
        solution=solution,
        grid=grid,
        precisions=precisions,
        forms=forms,
        shares=shares,
        effective=effective,
        held_out=Contender(name="hybrid", costs=shares.new_zeros(0)),
    )
    if not parts:
        return base
    costs = _cross_validate_hybrid(grouped, base, parts)
    return dataclasses.replace(base, held_out=dataclasses.replace(base.held_out, costs=costs))


def _no_field(grid: FieldGrid) -> Field:
    return Field(grid, torch.zeros(2, grid.count, dtype=torch.float64))


def _grid(solution: Solution, size: tuple[int, int], widths: Sequence[float]) -> tuple[FieldGrid, float]:
    """Units over the image, and half its width, on the distorted plane of a solution."""
    width, height = size
    parameters = solution.result.state.parameters
    u = torch.tensor([-0.5, width - 0.5], dtype=torch.float64)
    v = torch.tensor([-0.5, height - 0.5], dtype=torch.float64)
    x, y = from_pixels(u, v, parameters)
    half = 0.5 * float(x[1] - x[0])
    low, high = (float(x[0]), float(y[0])), (float(x[1]), float(y[1]))
    return FieldGrid.covering(low, high, [half * value for value in widths]), half


def _forms(
    grouped: GroupedViews, model: LensModel, state: BoardState, field: Field, border: bool = True
) -> QuadraticForms:
    order = grouped.views(torch.ones(len(grouped.groups), dtype=torch.bool))
    problem = grouped.problem(model, order, field)
    inner = grouped.within.problem(model, order, field) if border else None
    return linearize_views(problem, state.views(order), field, [len(group) for group in grouped.groups], inner)


def _stepped(field: Field, step: Tensor, forms: QuadraticForms, unit: float) -> Field:
    """The field after a step of `QuadraticForms`; `unit` is the focal length at which these were linearized."""
    return Field(field.grid, field.weights + step[forms.lens : -1].unflatten(0, (2, -1)) / unit)


def _refit(
    grouped: GroupedViews,
    model: LensModel,
    state: BoardState,
    views: Sequence[int],
    field: Field,
    terms: Sequence[Term],
) -> Result[BoardState]:
    """Lens, warp and poses of some views solved again under a field that is held.

    To first order that is the step of the quadratic forms. But where the data hardly determine the coefficients, steps
    are long, and only the whole problem with its barriers keeps the lens regular.
    """
    chosen = list(views)
    return minimize(grouped.problem(model, chosen, field, terms), state.views(chosen), REFIT)


def _cross_validate_hybrid(grouped: GroupedViews, base: FieldFit, parts: Sequence[Tensor]) -> Tensor:
    """(G,) squared residuals of a hybrid whose priors and weights come from the other parts alone."""
    state, forms = base.solution.result.state, base.forms

    def fit(chosen: Tensor) -> tuple[LensModel, BoardState, Field]:
        shares = stack_weights(forms, chosen, base.precisions)
        step = average_fit(forms, forms.total(chosen), base.precisions, shares)
        field = _stepped(_no_field(base.grid), step, forms, focal_of(state))
        found = _refit(grouped, base.model, state, grouped.views(chosen), field, base.solution.minimum.terms).state
        return base.model, state._replace(parameters=found.parameters, warp=found.warp), field

    return grouped.cross_validate(parts, fit)


def focal_of(state: BoardState) -> float:
    """Pixels per unit of the plane, the mean of both axes."""
    return float(state.parameters[:2].log().mean().exp())


def fit_to_convergence(grouped: GroupedViews, base: FieldFit) -> ConvergedField | None:
    """The averaged fit to all views: steps of the field, with all else solved again, until it converges.

    Where a further step would be too long, or after the last round, the field stays as it is: after the first step it
    is the one that was cross-validated, afterwards it is closer to convergence.

    Returns None where not even the first step is possible.
    """
    model, terms = base.model, base.solution.minimum.terms
    state, field = base.solution.result.state, _no_field(base.grid)
    every = torch.ones(len(grouped.groups), dtype=torch.bool)
    before, found = math.inf, False
    for _ in range(_ROUNDS):
        forms = _forms(grouped, model, state, field, border=False)
        now = forms.total(every)
        step = average_fit(forms, now, base.precisions, base.shares)
        moved = _moved(forms, now, step)
        after = _stepped(field, step, forms, focal_of(state))
        if not moved < 4.0 * before or not field_bounds(after)[1] <= LARGEST_SLOPE:
            break
        refit = _refit(grouped, model, state, range(len(grouped.every.pixels)), after, terms)
        # An average of fits need not fit better than the last state, but must not fit much worse.
        if not 2.0 * float(refit.cost) <= _WORSE * float(now[-1, -1]):
            break
        state, field, before, found = refit.state, after, moved, True
        if moved <= _CONVERGED**2 * float(now[-1, -1]) / grouped.every.corner_count:
            break
    return ConvergedField(state, field, forms) if found else None


def _moved(forms: QuadraticForms, form: Tensor, step: Tensor) -> float:
    """The squared change of the residuals by a step: by the whole step or by the field's part, whichever is smaller.

    A barrier before a fold can hold the lens where the form, which has no barriers, would always move it on; and lens
    and field can exchange what no corner sees.
    """
    whole = torch.cat([step[:-1], torch.zeros_like(step[-1:])])
    alone = whole.clone()
    alone[: forms.lens] = 0.0
    lengths = [float(change @ form @ change) for change in (whole, alone)]
    return min(lengths) if all(map(math.isfinite, lengths)) else math.inf


def field_covariance(base: FieldFit, forms: QuadraticForms) -> Tensor:
    """(L, L) covariance of lens and warp: within each candidate's fit, plus that between the averaged fits."""
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
