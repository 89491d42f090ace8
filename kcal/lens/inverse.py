"""Undo the distortion by Newton's method, and say for each point whether it can be undone.

Most points need three steps from the start of `kcal.lens.inverse_start`. The few that do not converge, near a fold or
without a preimage, go to `kcal.lens.inverse_safeguarded`. Where Python must not branch on values (compile, export,
vmap), all points take the same number of steps, and those that have not converged by then are flagged.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.dispatch import finite_or, in_chunks, is_differentiated, known_true, may_branch
from kcal.lens.distortion import check_coefficients, distort_components
from kcal.lens.inverse_safeguarded import solve_safeguarded
from kcal.lens.inverse_start import fit_start, start_from, undo_tilt
from kcal.lens.model import LensModel
from kcal.lens.newton import Jacobian, inverse_jacobian, is_solved, newton_step, squared_tolerance
from kcal.lens.region import Region, in_region, valid_region

# Steps before a point goes to the safeguarded solver, and steps where all points take the same number.
_STEPS = 6
# A Jacobian taken below the first residual is good enough to be kept: each step gains some four digits with it, so
# that below the second residual one more step reaches rounding.
_KEEP_JACOBIAN, _LAST_STEP = 1e-4, 1e-11

# Distorted coordinates x, y (..., N) to a first guess of the undistorted ones.
InverseStart = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


class PreparedInverse(NamedTuple):
    """What is known of a lens beforehand: where it is valid, and where Newton's method starts.

    `guess` replaces the start of `kcal.lens.inverse_start`. A poor guess affects run time only, not the result, because
    points that do not converge from it go to the safeguarded solver.
    """

    region: Region
    start: Tensor
    guess: InverseStart | None = None


def prepare_inverse(coefficients: Tensor, model: LensModel, reach: Tensor | None = None) -> PreparedInverse:
    """Measure a lens (..., P); `reach` (...) is the largest distorted radius that will be asked for."""
    fitted = fit_start(coefficients, model) if reach is None else fit_start(coefficients, model, reach)
    return PreparedInverse(valid_region(coefficients, model), fitted)


def undistort(
    distorted: Tensor, coefficients: Tensor, model: LensModel | str, prepared: PreparedInverse | None = None
) -> tuple[Tensor, Tensor]:
    """Map distorted to undistorted coordinates, with a mask of the points for which that is possible.

    Gradients follow the implicit function theorem: the last two Newton steps stay in the autograd graph, and at a
    solution these have its exact first and second derivatives by the point and by the coefficients.

    Args:
        distorted: (..., N, 2) distorted coordinates on the plane z = 1.
        coefficients: (..., P).
        model: a `LensModel` or the name of one.
        prepared: from `prepare_inverse`; computed here if not given.

    Returns:
        normalized (..., N, 2), on the plane z = 1 or, for a fisheye, on the plane of angles; and valid (..., N).
        Where `valid` is False, there is no preimage inside the valid region or the input was not finite; the
        coordinates are then zero.

    Raises:
        InputError: a wrong shape or an integer dtype.

    Example:
        >>> k = torch.tensor([-0.2, 0.0, 0.0, 0.0])
        >>> undistort(torch.tensor([[0.475, 0.0], [3.0, 0.0]]), k, "opencv4")[1].tolist()
        [True, False]
    """
    model = LensModel.named(model)
    distorted = as_points("distorted", distorted, 2)
    coefficients = check_coefficients(coefficients, model)
    ready = prepare_inverse(coefficients.detach(), model) if prepared is None else prepared

    def one(points: Tensor) -> tuple[Tensor, Tensor]:
        origin = torch.zeros((), dtype=points.dtype, device=points.device)
        target_x, target_y, finite = finite_or(points[..., 0], points[..., 1], origin, origin)
        x, y, valid = undistort_components(target_x, target_y, finite, coefficients, model, ready)
        return torch.stack([x, y], -1), valid

    return in_chunks(
        one,
        distorted,
        coefficients[..., :1].numel(),
        differentiated=is_differentiated(distorted, coefficients, *model.weights),
    )


def undistort_components(
    goal_x: Tensor, goal_y: Tensor, usable: Tensor, coefficients: Tensor, model: LensModel, ready: PreparedInverse
) -> tuple[Tensor, Tensor, Tensor]:
    """As `undistort`, for separate finite coordinates (..., N), of which only the `usable` ones count: x, y, valid."""
    with torch.no_grad():
        if model.size:
            solve = _solve_eagerly if may_branch(goal_x, coefficients, ready.start) else _solve_in_fixed_steps
            x, y, valid = solve(goal_x, goal_y, coefficients, model, ready)
        else:
            x, y, valid = goal_x, goal_y, in_region(goal_x, goal_y, coefficients, model, ready.region)
        valid = valid & usable
        all_valid = known_true(valid)
        if not all_valid:
            x, y = torch.where(valid, x, 0.0), torch.where(valid, y, 0.0)
    if is_differentiated(goal_x, goal_y, coefficients, *model.weights):
        for _ in range(2):
            x, y = _full_step(x, y, goal_x, goal_y, coefficients, model)
            if not all_valid:
                x, y = torch.where(valid, x, 0.0), torch.where(valid, y, 0.0)
    return x, y, valid


def _full_step(
    x: Tensor, y: Tensor, goal_x: Tensor, goal_y: Tensor, coefficients: Tensor, model: LensModel
) -> tuple[Tensor, Tensor]:
    lens = distort_components(x, y, coefficients, model)
    return newton_step(x, y, lens.x - goal_x, lens.y - goal_y, inverse_jacobian(lens.point))


def _newton_start(
    goal_x: Tensor, goal_y: Tensor, coefficients: Tensor, model: LensModel, ready: PreparedInverse
) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor, Tensor, LensModel]]:
    """Where Newton's method starts, and what it solves: the goal and the lens with the tilt undone."""
    untilted = undo_tilt(goal_x, goal_y, coefficients, model)
    x, y, _, rest = untilted
    guess = start_from(x, y, rest, ready.start) if ready.guess is None else ready.guess(goal_x, goal_y)
    return *guess, untilted


def _solve_eagerly(
    target_x: Tensor, target_y: Tensor, coefficients: Tensor, model: LensModel, ready: PreparedInverse
) -> tuple[Tensor, Tensor, Tensor]:
    """Plain Newton for all points, then the safeguarded solver for those that did not converge."""
    x, y, (goal_x, goal_y, own, rest) = _newton_start(target_x, target_y, coefficients, model, ready)
    lens = distort_components(x, y, own, rest)
    inverse: Jacobian = ()
    keep = last = False
    for _ in range(_STEPS):
        error_x, error_y = lens.x - goal_x, lens.y - goal_y
        error = torch.addcmul(error_x * error_x, error_y, error_y)
        if keep:
            last = known_true(error <= _LAST_STEP**2)
        else:
            inverse = inverse_jacobian(lens.point)
            keep = known_true(error <= _KEEP_JACOBIAN**2)
        x, y = newton_step(x, y, error_x, error_y, inverse)
        if last:
            break
        lens = distort_components(x, y, own, rest, slopes=not keep)
    lens = distort_components(x, y, coefficients, model, slopes=False)
    valid = is_solved(lens.x - target_x, lens.y - target_y, target_x, target_y) & lens.positive
    valid = valid & in_region(x, y, coefficients, model, ready.region)
    if known_true(valid):
        return x, y, valid
    tolerance = squared_tolerance(target_x, target_y)
    return solve_safeguarded(x, y, valid, target_x, target_y, tolerance, coefficients, model, ready.region)


def _solve_in_fixed_steps(
    target_x: Tensor, target_y: Tensor, coefficients: Tensor, model: LensModel, ready: PreparedInverse
) -> tuple[Tensor, Tensor, Tensor]:
    """The same steps for every point. Points that stray, near a fold or without a preimage, fail the last check."""
    x, y, (goal_x, goal_y, own, rest) = _newton_start(target_x, target_y, coefficients, model, ready)
    for _ in range(_STEPS):
        x, y = _full_step(x, y, goal_x, goal_y, own, rest)
    lens = distort_components(x, y, coefficients, model, slopes=not model.radial)
    valid = is_solved(lens.x - target_x, lens.y - target_y, target_x, target_y) & lens.positive
    return x, y, valid & in_region(x, y, coefficients, model, ready.region, lens)
