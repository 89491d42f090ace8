"""Views as quadratic forms in a lens, a board's warp and a residual field, for fits and held-out costs without corners.

Near a solution each view's board pose responds linearly. With the poses eliminated, the squared residuals of a group of
views are one quadratic form in the shared parameters. Leaving groups out, other priors, and the cost of held-out groups
with their poses solved again are then small linear algebra: hundreds of fits cost less than one pass over the corners.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.lens.distortion import distort_components
from kcal.lens.plane import plane_from_points
from kcal.lens.projection import INTRINSICS
from kcal.lens.residual import Field, field_basis

# Added to the diagonal (one) of the scaled normal matrix: the first of these with which Cholesky's factorization
# succeeds. Lenses whose coefficients nearly cancel need more.
_JITTERS = (1e-13, 1e-12, 1e-11, 1e-10, 1e-9)


@dataclasses.dataclass(frozen=True, kw_only=True)
class QuadraticForms:
    """Groups of views at one state, poses eliminated.

    The unknowns are steps of the free camera parameters, then of the warp, then the field's weights along x and y in
    pixels (times the focal length); the last row and column hold the residuals.

    Args:
        groups: (G, S + 1, S + 1).
        inner: likewise, of the corners that are not next to the border of what was seen.
        counts: (G,) corners.
        lens: how many unknowns come before the weights.
        weights: (2 K,) of the field at the state, pixels.
    """

    groups: Tensor
    inner: Tensor
    counts: Tensor
    lens: int
    weights: Tensor

    def total(self, chosen: Tensor) -> Tensor:
        """The form (S + 1, S + 1) of all groups in a mask (G,)."""
        return _sum(self.groups, chosen)

    def inside(self, chosen: Tensor) -> Tensor:
        """Likewise without the corners next to the border.

        `total` minus this is the cost of predicting those, with poses from the others.
        """
        return _sum(self.inner, chosen)

    def fit(self, form: Tensor, precision: Tensor) -> Tensor:
        """The best step (S + 1,), with a last 1, under Gaussian priors on the weights alone.

        Lens and warp have no prior, so that they take everything that they can represent (shift, scale, the lens's own
        terms): at the minimum the weights are orthogonal, in the prior's metric, to every change of weights that
        intrinsics and lens could compensate.

        Args:
            form: (S + 1, S + 1), see `total`.
            precision: (2 K,) of the weights: squared noise over their variance; infinite: they are zero.
        """
        used = torch.cat([torch.ones(self.lens, dtype=torch.bool), torch.isfinite(precision)]).nonzero()[:, 0]
        step = torch.cat([torch.zeros(self.lens, dtype=form.dtype), -self.weights, torch.ones(1, dtype=form.dtype)])
        own = used[self.lens :] - self.lens
        step[used] = 0.0
        # Weights that are held at zero go there first, and the others respond.
        gradient = (form @ step)[used]
        # All of them is the usual case, and needs no gathering.
        matrix = form[:-1, :-1].clone() if len(used) == len(form) - 1 else form[used][:, used]
        matrix.diagonal()[self.lens :].add_(precision[own])
        gradient[self.lens :] += precision[own] * self.weights[own]
        factor, scale = _factor(matrix)
        step[used] = -torch.cholesky_solve((gradient * scale)[:, None], factor)[:, 0] * scale
        return step

    def covariance(self, form: Tensor, precision: Tensor) -> Tensor:
        """(L, L) of lens and warp under a prior, for residuals of variance one."""
        used = torch.cat([torch.ones(self.lens, dtype=torch.bool), torch.isfinite(precision)]).nonzero()[:, 0]
        matrix = form[used][:, used]
        matrix.diagonal()[self.lens :].add_(precision[used[self.lens :] - self.lens])
        factor, scale = _factor(matrix)
        first = torch.eye(len(used), self.lens, dtype=form.dtype)
        inverse = torch.cholesky_solve(first, factor)
        return inverse[: self.lens] * scale[: self.lens, None] * scale[: self.lens]

    def freedom(self, form: Tensor, precision: Tensor) -> float:
        """The effective number of free weights under a prior: the trace of the map from data to fitted weights."""
        own = torch.isfinite(precision).nonzero()[:, 0]
        if not len(own):
            return 0.0
        lens, across = form[: self.lens, : self.lens], form[: self.lens, self.lens + own]
        # The field's information after eliminating lens and warp.
        field = form[self.lens + own][:, self.lens + own] - across.T @ torch.linalg.lstsq(lens, across).solution
        return float(torch.linalg.solve(field + torch.diag(precision[own]), field).diagonal().sum())


def _sum(groups: Tensor, chosen: Tensor) -> Tensor:
    """The sum of the groups in a mask, as one product: they are too many numbers to be copied."""
    return (chosen.to(groups.dtype) @ groups.flatten(1)).unflatten(0, groups.shape[1:])


def _factor(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Cholesky's factor of the scaled normal matrix, and the scale of each unknown."""
    scale = matrix.diagonal().clamp_min(1e-300).rsqrt()
    scaled = matrix * scale[:, None] * scale
    before = 0.0
    for jitter in _JITTERS:
        scaled.diagonal().add_(jitter - before)
        before = jitter
        factor, failed = torch.linalg.cholesky_ex(scaled)
        if not bool(failed):
            break
    else:
        # A candidate with NaN loses every comparison.
        factor = torch.full_like(factor, torch.nan)
    return factor, scale


def linearize_views(
    problem: BoardProblem, state: BoardState, field: Field, sizes: Sequence[int], inner: BoardProblem | None = None
) -> QuadraticForms:
    """Compute the quadratic forms of views.

    Args:
        problem: with the field at the state.
        state: of this problem.
        field: the same field.
        sizes: number of views of each group; the views are in the order of the groups.
        inner: the same problem without the corners next to the border; None: none is next to it.
    """
    parameters, model = state.parameters, problem.model
    unit = float(parameters[:2].log().mean().exp())
    _, points = problem.points(state)
    x, y = plane_from_points(points[:, 0], points[:, 1], points[:, 2], model)
    lens = distort_components(x, y, parameters[len(INTRINSICS) :], model, slopes=False)
    seen = problem.seen
    x, y = torch.where(seen, lens.x, 0.0), torch.where(seen, lens.y, 0.0)
    fx, fy, _, _, skew = parameters[: len(INTRINSICS)]
    zero = torch.zeros_like(fx)
    # Along u and v by a shift along x and along y of the plane, per pixel of weight.
    along = torch.stack([torch.stack([fx, zero]), torch.stack([skew, fy])]) / unit
    groups, inside, counts = [], [], []
    start = 0
    for size in sizes:
        chosen = slice(start, start + size)
        start += size
        basis = field_basis(x[chosen], y[chosen], field.grid)
        rows = problem.rows(state.views(chosen), chosen).unflatten(-1, (2, -1))
        moved = problem.whiten(along[:, :, None].expand(size, 2, 2, x.shape[-1]), chosen)
        groups.append(_eliminated(rows, moved, basis, seen[chosen]))
        left = seen[chosen] if inner is None else inner.seen[chosen]
        same = torch.equal(left, seen[chosen])
        inside.append(groups[-1] if same else _eliminated(rows, moved, basis, left))
        counts.append(int(seen[chosen].sum()))
    return QuadraticForms(
        groups=torch.stack(groups),
        inner=torch.stack(inside),
        counts=torch.tensor(counts),
        lens=problem.shared_size,
        weights=field.weights.flatten() * unit,
    )


def _eliminated(rows: Tensor, moved: Tensor, basis: Tensor, seen: Tensor) -> Tensor:
    """The quadratic form of some views with their poses eliminated.

    Args:
        rows: (V, 6 + L + 1, 2, N) derivatives by pose, lens and warp, and last the residuals.
        moved: (V, 2, 2, N) derivatives of u and v of each corner by a shift along x and one along y.
        basis: (V, K, N) units of the field at each corner.
        seen: (V, N) corners that count.
    """
    rows = (rows * seen[:, None, None]).flatten(-2)
    pose, others = rows[:, :6], rows[:, 6:]
    factor = torch.linalg.cholesky(pose @ pose.transpose(-1, -2))
    across = torch.linalg.solve_triangular(factor, pose, upper=False)
    # The pose is eliminated from the rows, because a difference of products would lose digits.
    others = others - (others @ across.transpose(-1, -2)) @ across
    # (K, V N): weighted, these are the field's columns, the same for x and y.
    units = (basis * seen[:, None]).transpose(0, 1).flatten(1)

    def weighted(values: Tensor) -> Tensor:
        """(V, P, 2, N): rows (V, P, R) along x and y at each corner."""
        return torch.einsum("vpun,vqun->vpqn", values.unflatten(-1, (2, -1)), moved)

    field = _weighed_products(units, torch.einsum("vqun,vwun->qwvn", moved, moved).flatten(-2))
    response = (weighted(across) @ basis.transpose(-1, -2)[:, None]).flatten(0, 1).flatten(1)
    field = field - response.T @ response
    flat = others.transpose(0, 1).flatten(1)
    small, mixed = flat @ flat.T, (weighted(others).permute(1, 2, 0, 3).flatten(-2) @ units.T).flatten(1)
    top = torch.cat([small[:-1, :-1], mixed[:-1], small[:-1, -1:]], 1)
    middle = torch.cat([mixed[:-1].T, field, mixed[-1:].T], 1)
    bottom = torch.cat([small[-1:, :-1], mixed[-1:], small[-1:, -1:]], 1)
    return torch.cat([top, middle, bottom])


def _weighed_products(units: Tensor, weights: Tensor) -> Tensor:
    """(2 K, 2 K): units (K, M) times themselves under weights (2, 2, M) of x and y; no more products than needed."""

    def product(values: Tensor) -> Tensor:
        return (units * values) @ units.T

    along_x = product(weights[0, 0])
    # Corners with isotropic weights need one product for both axes.
    ratio = float(weights[1, 1].sum() / weights[0, 0].sum().clamp_min(1e-300))
    alike = torch.allclose(weights[1, 1], ratio * weights[0, 0], rtol=1e-12, atol=0.0)
    along_y = ratio * along_x if alike else product(weights[1, 1])
    both = product(weights[0, 1]) if bool(weights[0, 1].any()) else torch.zeros_like(along_x)
    return torch.cat([torch.cat([along_x, both], 1), torch.cat([both, along_y], 1)])
