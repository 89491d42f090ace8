"""A second opinion on a rich lens model: where the mildest lens lies that fits nearly as well, and what σ that leaves.

Rich models have solutions of almost equal cost that lie far apart: numerators and denominators that nearly cancel, a
tilt that does the work of a shifted principal point and of turned boards. The lowest of them is often one that bends
sharply between the corners, and Gauss and Newton's σ there is that of the bend, not of the lens: far too small.
A weak prior (`kcal.calibrate.bundle.coefficient_prior`) leaves one solution, around which the cost is nearly the
quadratic that σ assumes. Where the data do not exclude it, the truth may lie around it as well as around the lowest
one:

    Σ = Σ_mild + d dᵀ,  d = x - x_mild

is the mean square distance of the truth from x, if the truth lies about x_mild with Σ_mild, the covariance there with
the prior counted.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem
from kcal.calibrate.bundle.coefficient_prior import CoefficientPrior
from kcal.calibrate.bundle.compressed_problem import CompressedProblem, fold
from kcal.calibrate.bundle.covariance import Uncertainty, uncertainty_of
from kcal.calibrate.bundle.parameters import Free
from kcal.calibrate.bundle.priors import Prior
from kcal.calibrate.bundle.views import Views
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.pose import step_rows
from kcal.lens.projection import project_components
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import State

# Of the mild lens, as `CalibrationOptions.weak_prior`.
WIDTH = 0.3
# A mild lens that is worse by more χ² than this is excluded by the data. Sharp bends gain up to 30 by chance.
_EXCLUDED = 40.0
# The two agree where no parameter differs by more than this share of its σ, and no σ by more than this factor.
_NEAR, _ALIKE = 0.5, 1.5
# Columns and rows of places where two lenses are compared.
_GRID = (17, 11)
_ITERATIONS = 60
# Steps stop where they would gain less χ² than this.
_ENOUGH = 0.1
# With fewer corners, or from a start that is worse (pixels), all views are solved at once.
_FEW_CORNERS, _SUSPICIOUS_RMS = 1000, 2.0


class PriorComparison(NamedTuple):
    """What a second look found.

    Args:
        uncertainty: of the shared parameters: Gauss and Newton's where the two agree.
        rms: of the mild lens over the corners, by their weights, pixels.
        shift: greatest distance (pixels) between the two lenses' images of the same direction, over the picture, after
            the best turn of one camera; infinite where only the mild one has an image.
        explained: whether three standard deviations of the mild lens explain it everywhere.
    """

    uncertainty: Uncertainty
    rms: float
    shift: float
    explained: bool


def weak_prior_term(views: Views, start: State, model: LensModel, noise: float) -> Prior:
    """The weak prior of `WIDTH` for the radius that is seen from a start, beside corners of `noise` pixels."""
    known = {*views.rules.fixed, *views.rules.priors}
    return CoefficientPrior(WIDTH, float(views.observed_radius(start))).prior(model, noise, known)


def compare_with_prior(
    views: Views, problem: BoardProblem, plain: BoardProblem, start: State, state: State, found: Uncertainty
) -> PriorComparison | None:
    """Look for the mild lens and compare.

    Args:
        views: the data.
        problem: the corners, the user's priors and the weak one.
        plain: without the weak one.
        start: a solution of a small model, written with this one's coefficients.
        state: the solution.
        found: its covariance.

    Returns:
        None where the data exclude the mild lens, so that the solution stands alone.
    """
    model = plain.models[0]
    if not bool(torch.isfinite(problem.cost(start))):
        return None
    if views.corner_count > _FEW_CORNERS and views.rms(start, model) <= _SUSPICIOUS_RMS:
        near = _search(views, problem, start, model)
        if bool(problem.cost(near) < problem.cost(start)):
            start = near
    mild = minimize(problem, start, _rough(plain.residual_count)).state
    linear, cost = plain.linearize(mild), float(plain.cost(state))
    count = plain.shared_size + 6 * len(state[-1])
    measured = plain.residual_count + plain.prior_count
    variance = 2.0 * cost / max(measured - count, 1)
    excess = 2.0 * (float(linear.cost) - cost)
    if not excess < _EXCLUDED * variance:
        return None
    rms = math.sqrt(2.0 * float(linear.cost) / (0.5 * plain.residual_count))
    determined = uncertainty_of(linear, measured, count).determined
    linear = problem.linearize(mild)
    # The noise is that of the better fit.
    linear.cost = plain.cost(state)
    around = uncertainty_of(linear, measured, count)
    shift, sigma = _image_shift(views.size, state[0], mild[0], around.covariance, model, plain.free[0])
    difference = _difference(plain, state, mild)
    own, other = found.covariance.diagonal().sqrt(), around.covariance.diagonal().sqrt()
    ratio = other / own
    alike = (difference.abs() <= _NEAR * own) & (ratio <= _ALIKE) & (ratio >= 1.0 / _ALIKE)
    if bool(alike.all()):
        return PriorComparison(found, rms, float(shift.max()), True)
    both = Uncertainty(around.covariance + torch.outer(difference, difference), determined)
    return PriorComparison(both, rms, float(shift.max()), bool((shift <= 3.0 * sigma).all()))


def _search(views: Views, problem: BoardProblem, start: State, model: LensModel) -> State:
    """Near the mild lens, by folded views."""
    folded = fold(views.problem(model, poses_only=True), start, float(views.observed_radius(start)))
    search = CompressedProblem(folded, model, problem.free[0], problem.terms)
    return search.unfold(minimize(search, search.start(start[0]), _rough(problem.residual_count)).state)


def _rough(residual_count: int) -> LMOptions:
    return LMOptions(max_iterations=_ITERATIONS, tolerance=_ENOUGH / residual_count, initial_damping=1e-6)


def _difference(problem: BoardProblem, state: State, other: State) -> Tensor:
    """(S,) by which the shared parameters of two states differ."""
    free = problem.free[0]
    change = (state[0] - other[0])[list(free.indices)]
    out = change.new_zeros(problem.shared_size)
    out[list(free.slots)] = change
    if problem.free_warp:
        out[-2:] = state[1] - other[1]
    return out


def _image_shift(
    size: tuple[int, int], parameters: Tensor, mild: Tensor, shared: Tensor, model: LensModel, free: Free
) -> tuple[Tensor, Tensor]:
    """How far apart (pixels) two lenses see the same directions after the best turn, and its σ: (K,) over the image."""
    camera = Camera(mild, size=size, model=model)
    rays, valid = camera.unproject(camera.grid(*_GRID).reshape(-1, 2))
    rays = rays[valid]
    here = project_components(rays.T, mild, model, free.indices)
    there = project_components(rays.T, parameters, model)
    turn = step_rows(here.by_point, rays.T)[:3].flatten(1).T  # (2 K, 3), all u, then all v
    by_lens = free.collapse(here.by_camera, -3).flatten(1).T
    # What a turn of the camera and all boards does is no difference between lenses.
    basis, _ = torch.linalg.qr(turn)
    by_lens = by_lens - basis @ (basis.T @ by_lens)
    sigma = ((by_lens @ shared[: len(free), : len(free)]) * by_lens).sum(-1).unflatten(0, (2, -1)).sum(0).sqrt()
    change = torch.where(there.regular, there.pixels - here.pixels, 0.0).flatten()
    change = (change - basis @ (basis.T @ change)).unflatten(0, (2, -1)).norm(dim=0)
    return torch.where(there.regular, change, torch.inf), sigma
