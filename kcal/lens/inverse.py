"""From distorted back to undistorted coordinates: Newton's method that says where it failed, and where it may be asked.

Most points need three steps from the start of `kcal.lens.inverse_start`. The few that do not arrive, near a fold or
without a preimage at all, go to `kcal.lens.inverse_safeguarded`. Where Python may not look at values (compile, export,
vmap) all points take the same number of steps, and what has not arrived by then is flagged.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.lens.distortion import Distorted, check_coefficients, distort_components
from kcal.lens.inverse_safeguarded import solve_hard
from kcal.lens.inverse_start import fit_start, start_from, without_tilt
from kcal.lens.model import LensModel
from kcal.lens.region import Region, in_region, valid_radius, valid_region
from kcal.lens.tracing import finite_or, in_chunks, is_differentiated, known_true, may_branch

__all__ = ["Inverse", "InverseStart", "prepare_inverse", "undistort", "undistort_components", "valid_radius"]

# Residual in normalized coordinates: 1e-13 is 2e-10 px at f = 2000 px, just above rounding.
TOLERANCE = 1e-13
# Steps before a point counts as hard, and steps where all points take the same number.
_MOST = 6
_FIXED = 6
# A Jacobian taken below the first residual is good enough to be kept: each step gains some four digits with it, so
# that below the second residual one more step reaches rounding.
_CLOSE, _LAST = 1e-4, 1e-11


# Distorted coordinates x, y (..., N) to a first guess of the undistorted ones.
InverseStart = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


class Inverse(NamedTuple):
    """What is known of a lens beforehand: where it is valid, and where Newton starts.

    `guess` stands in for the start of `kcal.lens.inverse_start`. However bad it is, it costs time and no more: what
    Newton does not bring home from there is begun anew.
    """

    region: Region
    start: Tensor
    guess: InverseStart | None = None


def prepare_inverse(coefficients: Tensor, model: LensModel, reach: Tensor | None = None) -> Inverse:
    """Measure a lens (..., P); `reach` (...) is the largest distorted radius that will be asked for."""
    region = valid_region(coefficients, model)
    fitted = fit_start(coefficients, model) if reach is None else fit_start(coefficients, model, reach)
    return Inverse(region, fitted)


def undistort(
    distorted: Tensor, coefficients: Tensor, model: LensModel | str, prepared: Inverse | None = None
) -> tuple[Tensor, Tensor]:
    """Undo the distortion, or say that it cannot be undone.

    Newton's method with the 2x2 Jacobian, each point on its own. The last two steps stay in the autograd graph: at a
    solution, a Newton step has the exact implicit derivative by the point and by the coefficients, and two of them
    the second one too.

    Args:
        distorted: (..., N, 2) distorted coordinates on the plane z = 1.
        coefficients: (..., P).
        model: a `LensModel` or a preset's name.
        prepared: from `prepare_inverse`, computed here if not given.

    Returns:
        normalized (..., N, 2), on the plane z = 1 or, for a fisheye, on the plane of angles; and valid (..., N).
        Where `valid` is False there is no preimage inside the valid region (or the input was not finite), and the
        coordinates are zero.

    Raises:
        InputError: wrong shapes or an integer dtype.

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
        one, distorted, coefficients[..., :1].numel(), differentiated=is_differentiated(distorted, coefficients)
    )


def undistort_components(
    target_x: Tensor, target_y: Tensor, usable: Tensor, coefficients: Tensor, model: LensModel, ready: Inverse
) -> tuple[Tensor, Tensor, Tensor]:
    """As `undistort`, for separate finite coordinates (..., N), of which only the `usable` ones count: x, y, valid."""
    with torch.no_grad():
        solve = _solve_eagerly if may_branch(target_x, coefficients, ready.start) else _solve_in_fixed_steps
        x, y, valid = solve(target_x, target_y, coefficients, model, ready)
        valid = valid & usable
        all_valid = known_true(valid)
        if not all_valid:
            x, y = torch.where(valid, x, 0.0), torch.where(valid, y, 0.0)
    if is_differentiated(target_x, target_y, coefficients):
        for _ in range(2):
            x, y = _newton_step(x, y, target_x, target_y, coefficients, model)
            if not all_valid:
                x, y = torch.where(valid, x, 0.0), torch.where(valid, y, 0.0)
    return x, y, valid


def _inverse_jacobian(lens: Distorted) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    a, b, d, e = lens.point
    scale = lens.determinant.reciprocal()
    return e * scale, b * scale, d * scale, a * scale


def _newton_step(
    x: Tensor, y: Tensor, target_x: Tensor, target_y: Tensor, coefficients: Tensor, model: LensModel
) -> tuple[Tensor, Tensor]:
    lens = distort_components(x, y, coefficients, model)
    e, b, d, a = _inverse_jacobian(lens)
    error_x, error_y = lens.x - target_x, lens.y - target_y
    return x - (e * error_x - b * error_y), y - (a * error_y - d * error_x)


def _squared_error(lens: Distorted, target_x: Tensor, target_y: Tensor) -> Tensor:
    error_x, error_y = lens.x - target_x, lens.y - target_y
    return torch.addcmul(error_x * error_x, error_y, error_y)


def _squared_tolerance(target_x: Tensor, target_y: Tensor) -> Tensor:
    return torch.addcmul(torch.addcmul(target_x.new_ones(()), target_x, target_x), target_y, target_y) * TOLERANCE**2


def _solve_eagerly(
    target_x: Tensor, target_y: Tensor, coefficients: Tensor, model: LensModel, ready: Inverse
) -> tuple[Tensor, Tensor, Tensor]:
    """Plain Newton for all, and the safeguarded solver for those that it does not bring home."""
    goal_x, goal_y, own, rest = without_tilt(target_x, target_y, coefficients, model)
    x, y = start_from(goal_x, goal_y, rest, ready.start) if ready.guess is None else ready.guess(target_x, target_y)
    lens = distort_components(x, y, own, rest)
    close = last = False
    for _ in range(_MOST):
        error_x, error_y = lens.x - goal_x, lens.y - goal_y
        error = torch.addcmul(error_x * error_x, error_y, error_y)
        if close:
            last = known_true(error <= _LAST**2)
        else:
            e, b, d, a = _inverse_jacobian(lens)
            close = known_true(error <= _CLOSE**2)
        x = torch.addcmul(torch.addcmul(x, b, error_y), e, error_x, value=-1.0)
        y = torch.addcmul(torch.addcmul(y, d, error_x), a, error_y, value=-1.0)
        if last:
            break
        lens = distort_components(x, y, own, rest, slopes=not close)
    lens = distort_components(x, y, coefficients, model, slopes=False)
    tolerance = _squared_tolerance(target_x, target_y)
    valid = (_squared_error(lens, target_x, target_y) <= tolerance) & lens.positive
    valid = valid & in_region(x, y, coefficients, model, ready.region)
    if known_true(valid):
        return x, y, valid
    return solve_hard(x, y, valid, target_x, target_y, tolerance, coefficients, model, ready.region)


def _solve_in_fixed_steps(
    target_x: Tensor, target_y: Tensor, coefficients: Tensor, model: LensModel, ready: Inverse
) -> tuple[Tensor, Tensor, Tensor]:
    """The same steps for every point. What strays, beside a fold or without a preimage, fails the last check."""
    goal_x, goal_y, own, rest = without_tilt(target_x, target_y, coefficients, model)
    x, y = start_from(goal_x, goal_y, rest, ready.start) if ready.guess is None else ready.guess(target_x, target_y)
    for _ in range(_FIXED):
        x, y = _newton_step(x, y, goal_x, goal_y, own, rest)
    lens = distort_components(x, y, coefficients, model, slopes=not model.radial)
    valid = (_squared_error(lens, target_x, target_y) <= _squared_tolerance(target_x, target_y)) & lens.positive
    return x, y, valid & in_region(x, y, coefficients, model, ready.region, lens)
