"""Compare a rich lens model with its solution under a weak prior, and let σ include the difference.

Rich models have solutions with almost equal cost that lie far apart: numerators and denominators nearly cancel, or a
tilt replaces a shifted principal point and rotated boards. The lowest of them often bends sharply between the corners,
and the Gauss-Newton σ there describes only the bend: it is far too small. A weak prior
(`kcal.calibrate.bundle.coefficient_prior`) leaves one solution, around which the cost is nearly the quadratic that σ
assumes. Where the data do not exclude it, the truth may lie around it as well as around the lowest one:

    Σ = Σ_prior + d dᵀ,  d = x - x_prior

is the mean square distance of the truth from x, if the truth is distributed around x_prior with the covariance Σ_prior
there, prior included.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.calibrate.bundle.coefficient_prior import CoefficientPrior
from kcal.calibrate.bundle.compressed_problem import CompressedProblem, compress
from kcal.calibrate.bundle.covariance import Uncertainty, uncertainty_of
from kcal.calibrate.bundle.parameters import FreeParameters
from kcal.calibrate.bundle.priors import GaussianPrior
from kcal.calibrate.bundle.views import CameraViews
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.pose import step_rows
from kcal.lens.projection import project_components
from kcal.solve.lm import LMOptions, minimize

# As `CalibrationOptions.weak_prior`.
WIDTH = 0.3
# The data exclude the solution under the prior if its χ² is higher by more. Sharp bends gain up to 30 by chance.
_EXCLUDED = 40.0
# The two agree where no parameter differs by more than this share of its σ, and no σ by more than this factor.
_NEAR, _ALIKE = 0.5, 1.5
# Columns and rows of pixels at which two lenses are compared.
_GRID = (17, 11)
_ITERATIONS = 60
# The solver stops where it would gain less χ² than this.
_ENOUGH = 0.1
# With fewer corners, or a start with a higher RMS (pixels), the compressed problem is not used.
_FEW_CORNERS, _SUSPICIOUS_RMS = 1000, 2.0


class PriorComparison(NamedTuple):
    """A solution compared with that under the weak prior.

    Args:
        uncertainty: of the shared parameters: that of Gauss and Newton where the two agree.
        rms: of the solution under the prior over the corners, by their weights, pixels.
        shift: greatest distance (pixels) between the two lenses' images of the same direction, over the image, after
            the best rotation of one camera; infinite where only the lens under the prior has an image.
        explained: whether three standard deviations under the prior explain the shift everywhere.
    """

    uncertainty: Uncertainty
    rms: float
    shift: float
    explained: bool


def weak_prior_term(views: CameraViews, start: BoardState, model: LensModel, noise: float) -> GaussianPrior:
    """The weak prior of `WIDTH` for the radius that is seen at a start, in proportion to corners of `noise` pixels."""
    known = {*views.constraints.fixed, *views.constraints.priors}
    return CoefficientPrior(WIDTH, views.observed_radius(start)).term(model, noise, known)


def compare_with_prior(
    views: CameraViews,
    problem: BoardProblem,
    plain: BoardProblem,
    start: BoardState,
    state: BoardState,
    found: Uncertainty,
) -> PriorComparison | None:
    """Solve under the weak prior and compare.

    Args:
        views: the data.
        problem: the corners, the user's priors and the weak one.
        plain: without the weak one.
        start: a solution of a small model, written with this one's coefficients.
        state: the solution.
        found: its covariance.

    Returns:
        None where the data exclude the solution under the prior.
    """
    model = plain.model
    if not bool(torch.isfinite(problem.cost(start))):
        return None
    if views.corner_count > _FEW_CORNERS and views.rms(start, model) <= _SUSPICIOUS_RMS:
        near = _search(views, problem, start, model)
        if bool(problem.cost(near) < problem.cost(start)):
            start = near
    other = minimize(problem, start, _rough(plain.residual_count)).state
    linear, cost = plain.linearize(other), float(plain.cost(state))
    count = plain.shared_size + 6 * len(state.translation)
    measured = plain.residual_count + plain.prior_count
    variance = 2.0 * cost / max(measured - count, 1)
    excess = 2.0 * (float(linear.cost) - cost)
    if not excess < _EXCLUDED * variance:
        return None
    rms = math.sqrt(2.0 * float(linear.cost) / (0.5 * plain.residual_count))
    determined = uncertainty_of(linear, measured, count).determined
    linear = problem.linearize(other)
    # The noise is that of the better fit.
    linear.cost = plain.cost(state)
    around = uncertainty_of(linear, measured, count)
    lenses = state.parameters, other.parameters
    shift, sigma = _image_shift(views.size, *lenses, around.covariance, model, plain.free)
    difference = _difference(plain, state, other)
    own = found.covariance.diagonal().sqrt()
    ratio = around.covariance.diagonal().sqrt() / own
    alike = (difference.abs() <= _NEAR * own) & (ratio <= _ALIKE) & (ratio >= 1.0 / _ALIKE)
    if bool(alike.all()):
        return PriorComparison(found, rms, float(shift.max()), True)
    both = Uncertainty(around.covariance + torch.outer(difference, difference), determined)
    return PriorComparison(both, rms, float(shift.max()), bool((shift <= 3.0 * sigma).all()))


def _search(views: CameraViews, problem: BoardProblem, start: BoardState, model: LensModel) -> BoardState:
    """A state near the solution under the prior, from compressed views."""
    compressed = compress(views.problem(model), start, views.observed_radius(start))
    search = CompressedProblem(compressed, model, problem.free, problem.terms)
    return search.expand(minimize(search, search.start(start.parameters), _rough(problem.residual_count)).state)


def _rough(residual_count: int) -> LMOptions:
    return LMOptions(max_iterations=_ITERATIONS, tolerance=_ENOUGH / residual_count, initial_damping=1e-6)


def _difference(problem: BoardProblem, state: BoardState, other: BoardState) -> Tensor:
    """(S,) by which the shared parameters of two states differ."""
    free = problem.free
    change = (state.parameters - other.parameters)[list(free.indices)]
    out = change.new_zeros(problem.shared_size)
    out[list(free.slots)] = change
    if problem.free_warp:
        out[-2:] = state.warp - other.warp
    return out


def _image_shift(
    size: tuple[int, int], parameters: Tensor, other: Tensor, shared: Tensor, model: LensModel, free: FreeParameters
) -> tuple[Tensor, Tensor]:
    """Distance (pixels) of two lenses' images of a direction after the best rotation, and its σ: (K,) over the image.

    The covariance `shared` is that of `other`.
    """
    camera = Camera(other, size=size, model=model)
    rays, valid = camera.unproject(camera.grid(*_GRID).reshape(-1, 2))
    rays = rays[valid]
    here = project_components(rays.T, other, model, free.indices)
    there = project_components(rays.T, parameters, model)
    turn = step_rows(here.by_point, rays.T)[:3].flatten(1).T  # (2 K, 3), all u, then all v
    by_lens = free.collapse(here.by_camera, -3).flatten(1).T
    # A rotation of the camera and all boards is no difference between lenses.
    basis, _ = torch.linalg.qr(turn)
    by_lens = by_lens - basis @ (basis.T @ by_lens)
    sigma = ((by_lens @ shared[: len(free), : len(free)]) * by_lens).sum(-1).unflatten(0, (2, -1)).sum(0).sqrt()
    change = torch.where(there.regular, there.pixels - here.pixels, 0.0).flatten()
    change = (change - basis @ (basis.T @ change)).unflatten(0, (2, -1)).norm(dim=0)
    return torch.where(there.regular, change, torch.inf), sigma
