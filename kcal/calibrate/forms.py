"""Views as quadratic forms in a lens, a board's warp and a residual field: fits and held-out costs without the views.

Near a solution each view's board pose answers linearly. With it eliminated, the squared residuals of a group of views
are one quadratic form in what the views share. Leaving groups out, another prior, the cost of the groups left out with
their poses solved again: all of that is small linear algebra then, so that hundreds of fits cost less than one look at
the corners.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.problem import BoardProblem
from kcal.lens.distortion import distort_components
from kcal.lens.plane import plane_from_points
from kcal.lens.projection import INTRINSICS
from kcal.lens.residual import Field, field_basis
from kcal.solve.result import State

# Relative to the scaled normal matrix, whose diagonal is one: keeps its factors apart from rounding.
_JITTER = 1e-13


@dataclasses.dataclass(frozen=True, kw_only=True)
class Forms:
    """Groups of views at one state, poses eliminated.

    The unknowns are steps of the free camera parameters, then of the warp, then the field's weights along x and y in
    pixels (times the focal length); the last row and column hold the residuals.

    Args:
        groups: (G, S + 1, S + 1).
        counts: (G,) corners.
        lens: how many unknowns come before the weights.
        weights: (2 K,) of the field at the state, pixels.
    """

    groups: Tensor
    counts: Tensor
    lens: int
    weights: Tensor

    def total(self, chosen: Tensor) -> Tensor:
        """The form (S + 1, S + 1) of all groups in a mask (G,)."""
        return self.groups[chosen].sum(0)

    def fit(self, form: Tensor, precision: Tensor) -> Tensor:
        """The best step (S + 1,), with a last 1, under Gaussian priors on the weights alone.

        Lens and warp have no prior. So what they can carry as well as the field (shift, scale, the lens's own terms)
        they do carry: at the minimum the weights are orthogonal, in the prior's metric, to every change of weights that
        intrinsics and lens could undo.

        Args:
            form: (S + 1, S + 1), see `total`.
            precision: (2 K,) of the weights: squared noise over their variance; infinite: they are zero.
        """
        used = torch.cat([torch.ones(self.lens, dtype=torch.bool), torch.isfinite(precision)]).nonzero()[:, 0]
        step = torch.cat([torch.zeros(self.lens, dtype=form.dtype), -self.weights, torch.ones(1, dtype=form.dtype)])
        own = used[self.lens :] - self.lens
        step[used] = 0.0
        # Weights that stay at zero go there first, and the others answer.
        gradient = (form @ step)[used]
        matrix = form[used][:, used]
        matrix.diagonal()[self.lens :].add_(precision[own])
        gradient[self.lens :] += precision[own] * self.weights[own]
        scale = matrix.diagonal().clamp_min(1e-300).rsqrt()
        matrix = matrix * scale[:, None] * scale
        matrix.diagonal().add_(_JITTER)
        factor = torch.linalg.cholesky(matrix)
        step[used] = -torch.cholesky_solve((gradient * scale)[:, None], factor)[:, 0] * scale
        return step

    def covariance(self, form: Tensor, precision: Tensor) -> Tensor:
        """(L, L) of lens and warp under a prior, for residuals of variance one."""
        used = torch.cat([torch.ones(self.lens, dtype=torch.bool), torch.isfinite(precision)]).nonzero()[:, 0]
        matrix = form[used][:, used]
        matrix.diagonal()[self.lens :].add_(precision[used[self.lens :] - self.lens])
        scale = matrix.diagonal().clamp_min(1e-300).rsqrt()
        matrix = matrix * scale[:, None] * scale
        matrix.diagonal().add_(_JITTER)
        first = torch.eye(len(used), self.lens, dtype=form.dtype)
        inverse = torch.cholesky_solve(first, torch.linalg.cholesky(matrix))
        return inverse[: self.lens] * scale[: self.lens, None] * scale[: self.lens]

    def freedom(self, form: Tensor, precision: Tensor) -> float:
        """The effective number of weights that a prior leaves free: the trace of what maps data to fitted weights."""
        own = torch.isfinite(precision).nonzero()[:, 0]
        if not len(own):
            return 0.0
        lens, across = form[: self.lens, : self.lens], form[: self.lens, self.lens + own]
        # What is left for the field once lens and warp have answered.
        field = form[self.lens + own][:, self.lens + own] - across.T @ torch.linalg.lstsq(lens, across).solution
        return float(torch.linalg.solve(field + torch.diag(precision[own]), field).diagonal().sum())


def linearise_views(problem: BoardProblem, state: State, field: Field, sizes: Sequence[int]) -> Forms:
    """Fold views into forms.

    Args:
        problem: of one camera, its `fields` the field at the state.
        state: of this problem.
        field: at the state, the same.
        sizes: how many views each group has; the views are in the order of the groups.
    """
    s = problem.unpack(state)
    parameters, model = s.parameters[0], problem.models[0]
    unit = float(parameters[:2].log().mean().exp())
    _, points = problem.points(s)
    x, y = plane_from_points(points[:, 0], points[:, 1], points[:, 2], model)
    lens = distort_components(x, y, parameters[len(INTRINSICS) :], model, slopes=False)
    seen = problem.seen[:, 0]
    x, y = torch.where(seen, lens.x, 0.0), torch.where(seen, lens.y, 0.0)
    fx, fy, _, _, skew = parameters[: len(INTRINSICS)]
    zero = torch.zeros_like(fx)
    # Along u and v by a shift along x and along y of the plane, per pixel of weight.
    along = torch.stack([torch.stack([fx, zero]), torch.stack([skew, fy])]) / unit
    forms, counts = [], []
    start = 0
    for size in sizes:
        chosen = slice(start, start + size)
        start += size
        basis = field_basis(x[chosen], y[chosen], field.grid) * seen[chosen, None]
        rows = problem.rows(_some(state, chosen), chosen)
        pose, shared, residual = rows[:, :6], rows[:, 6:-1], rows[:, -1:]
        moved = problem.whiten(along[:, :, None].expand(size, 2, 2, x.shape[-1]), chosen)
        by_weight = (moved[:, :, None] * basis[:, None, :, None]).flatten(1, 2).flatten(-2)
        others = torch.cat([shared, by_weight, residual], 1)
        factor = torch.linalg.cholesky(pose @ pose.transpose(-1, -2))
        across = torch.linalg.solve_triangular(factor, pose, upper=False)
        others = others - (others @ across.transpose(-1, -2)) @ across
        flat = others.transpose(0, 1).flatten(1)
        forms.append(flat @ flat.T)
        counts.append(int(seen[chosen].sum()))
    return Forms(
        groups=torch.stack(forms),
        counts=torch.tensor(counts),
        lens=problem.shared_size,
        weights=field.weights.flatten() * unit,
    )


def _some(state: State, views: slice) -> State:
    """The state of some views only."""
    *shared, rotation, translation = state
    return (*shared, rotation[views], translation[views])
