"""Undo the distortion by Newton's method, from a start close by, and say for each point whether it can be undone."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.dispatch import finite_or, in_chunks, is_differentiated, known_true, may_branch
from kcal.lens.model import LensModel, check_coefficients, distort_components, polynomial
from kcal.lens.region import DIRECTIONS, SECTORS, Region, direction_limits, in_region, valid_region
from kcal.lens.zernike import unbind_last

# Newton's method in two unknowns, for the inverse of a lens: one step, and when to stop.

# Residual on the plane of the lens that counts as solved: 1e-13 is 2e-10 px at f = 2000 px, just above rounding.
TOLERANCE = 1e-13

# ∂x/∂x, ∂x/∂y, ∂y/∂x, ∂y/∂y of a map of the plane, or their counterparts of its inverse; each (..., N).
Jacobian = tuple[Tensor, ...]


def inverse_jacobian(jacobian: Jacobian) -> Jacobian:
    """Invert 2x2 matrices."""
    a, b, d, e = jacobian
    scale = torch.addcmul(a * e, b, d, value=-1.0).reciprocal()
    opposite = -scale
    return e * scale, b * opposite, d * opposite, a * scale


def newton_step(x: Tensor, y: Tensor, error_x: Tensor, error_y: Tensor, inverse: Jacobian) -> tuple[Tensor, Tensor]:
    """Move x, y (..., N) by the inverse Jacobian times the error, in fused operations."""
    a, b, d, e = inverse
    return (
        torch.addcmul(torch.addcmul(x, b, error_y, value=-1.0), a, error_x, value=-1.0),
        torch.addcmul(torch.addcmul(y, d, error_x, value=-1.0), e, error_y, value=-1.0),
    )


def squared_tolerance(goal_x: Tensor, goal_y: Tensor) -> Tensor:
    """Largest squared residual (..., N) of a solution, relative to 1 + |goal|²."""
    return torch.addcmul(torch.addcmul(goal_x.new_ones(()), goal_x, goal_x), goal_y, goal_y) * TOLERANCE**2


def is_solved(error_x: Tensor, error_y: Tensor, goal_x: Tensor, goal_y: Tensor) -> Tensor:
    """Whether residuals (..., N) are zero to rounding; False for NaN."""
    return torch.addcmul(error_x * error_x, error_y, error_y) <= squared_tolerance(goal_x, goal_y)


# Give Newton's method a start: undo the radial part of a lens by a short polynomial, and the tilt in closed form.
#
# For a lens with radial terms only, the undistorted radius is a function of the distorted one. Their ratio is fitted
# once per lens by a polynomial in √(1 - r_D² / D²), where D is the largest distorted radius. In this variable the
# inverse is smooth also at a fold, where it behaves as a square root. Within the image the polynomial is accurate to
# 1e-5 or better for ordinary lenses. Newton's method does the rest, tangential and prism terms included.

_DEGREE = 11
_NODES = 96
# An interval is split into so many parts, so many times: its end is a little beyond what was asked for, or the fold.
_PARTS, _SECTIONS = 64, 2
# Largest distorted radius for a lens without a camera: 56° through a pinhole.
_DEFAULT_REACH = 1.5


@torch.no_grad()
def fit_start(coefficients: Tensor, model: LensModel, reach: float | Tensor = _DEFAULT_REACH) -> Tensor:
    """Fit the polynomial of `start_from`.

    Args:
        coefficients: (..., P).
        model: the lens model.
        reach: (...) the largest distorted radius that will be asked for.

    Returns:
        (..., 1 + 12): D², then the coefficients by rising powers of 2 √(1 - r_D² / D²) - 1.
    """
    if model.hybrid:
        names = model.hybrid.radial_names
        radial, kept = model, torch.tensor([name in names for name in model.names])
        own = torch.where(kept.to(coefficients.device), coefficients, 0.0)
    else:
        radial = LensModel(numerator=model.numerator, denominator=model.denominator, fisheye=model.fisheye)
        own = coefficients[..., [model.names.index(name) for name in radial.names]]
    limit = direction_limits(own, radial, 1)

    def distorted(radius: Tensor) -> Tensor:
        return distort_components(radius, torch.zeros_like(radius), own, radial, slopes=False).x

    # D lies a little beyond the reach, or at the fold.
    wanted = torch.as_tensor(reach, dtype=torch.float64, device=own.device)[..., None]
    low, high = torch.zeros_like(limit), limit
    fractions = torch.linspace(0.0, 1.0, _PARTS + 1, dtype=torch.float64, device=own.device)
    for _ in range(_SECTIONS):
        # The interval is split into parts; the first whose end lies beyond is the next.
        ends = low + (high - low) * fractions[1:-1]
        part = (distorted(ends) <= 1.1 * wanted).to(torch.int64).cumprod(-1).sum(-1, keepdim=True)
        low, high = low + (high - low) * fractions[part], low + (high - low) * fractions[part + 1]
    # Evenly in angle: for a wide lens, equal steps on the plane would nearly all lie at its edge.
    steps = torch.linspace(1.0 / _NODES, 1.0, _NODES, dtype=torch.float64, device=own.device)
    radius = high * steps if model.wide else torch.tan(torch.atan(high) * steps)
    values = distorted(radius)
    largest = values[..., -1:] ** 2
    variable = 2.0 * torch.sqrt(torch.clamp(1.0 - values * values / largest, min=0.0)) - 1.0
    powers = variable[..., None] ** torch.arange(_DEGREE + 1, device=own.device)
    # A lens without any valid disc gives no equations; any ratio will do.
    usable = torch.isfinite(powers).all(-1).all(-1) & (largest[..., 0] > 0)
    plain = torch.zeros(_DEGREE + 1, dtype=torch.float64, device=own.device)
    plain[0] = 1.0
    powers = torch.where(usable[..., None, None], powers, 0.0)
    ratio = torch.where(usable[..., None], radius / values, 0.0)
    fitted = torch.linalg.pinv(powers, rtol=1e-13) @ ratio[..., None]
    fitted = torch.where(usable[..., None], fitted[..., 0], plain)
    return torch.cat([torch.where(usable[..., None], largest, 1.0), fitted], -1)


def start_from(x: Tensor, y: Tensor, model: LensModel, start: Tensor) -> tuple[Tensor, Tensor]:
    """Guess the undistorted coordinates for distorted ones (..., N) whose tilt is undone."""
    if not (model.numerator or model.denominator or model.hybrid):
        return x, y
    largest, constant, *rest = unbind_last(start)
    square = torch.addcmul(x * x, y, y)
    variable = 2.0 * torch.sqrt(torch.clamp(1.0 - square / largest, min=0.0)) - 1.0
    ratio, _ = polynomial(variable, rest, 0.0, False)
    ratio = ratio + constant
    return x * ratio, y * ratio


def undo_tilt(x: Tensor, y: Tensor, coefficients: Tensor, model: LensModel) -> tuple[Tensor, Tensor, Tensor, LensModel]:
    """Undo the tilt of distorted coordinates (..., N) in closed form: x, y, and the lens that remains."""
    if not model.tilt:
        return x, y, coefficients, model
    c = unbind_last(coefficients)
    tau_x, tau_y = c[model.names.index("tau_x")], c[model.names.index("tau_y")]
    cos_x, sin_x, cos_y, sin_y = torch.cos(tau_x), torch.sin(tau_x), torch.cos(tau_y), torch.sin(tau_y)
    a, b = cos_x - sin_y * x, (cos_y * sin_x) * x
    d, e = -sin_y * (sin_x + y), cos_y * (1.0 + sin_x * y)
    scale = (cos_y * cos_x) * (a * e - b * d).reciprocal()
    return (
        (e * x - b * y) * scale,
        (a * y - d * x) * scale,
        coefficients[..., list(model.untilted_index)],
        model.untilted,
    )


# Solve for the points where plain Newton fails: near a fold or a pole, or without a preimage at all.
#
# Each point starts from the nearest of some thousand samples of the valid region, so that it begins on the right side
# of every fold, and takes damped steps that may not leave the region. Inside the region the Jacobian's determinant is
# positive, so the residual has no minimum but the solution, and a point that stops elsewhere stops at the edge. Where
# the region is not convex, the edge may lie between a start and the solution. The image of the region, however, is a
# star about the origin (`kcal.lens.region`), so the straight line of images from the axis to the target stays inside
# it. Points that stopped at the edge follow that line.

_RINGS = 16
# The image of the region's edge is known at 1024 directions only. A target this much farther out may still be inside:
# it is tried at all, and it is tried again along the line from the axis.
_TRIED, _TRIED_AGAIN = 1.0001, 1.00001
# Share by which the edge's distance may change from one of these directions to the next, to be interpolated.
_STEEP = 0.01
# What has no image is put there. Where the edge has none, by rounding, it is taken for so many times the farthest.
_FAR, _BEYOND = 1e150, 1.1


def solve_safeguarded(
    x: Tensor,
    y: Tensor,
    valid: Tensor,
    target_x: Tensor,
    target_y: Tensor,
    coefficients: Tensor,
    model: LensModel,
    region: Region,
) -> tuple[Tensor, Tensor, Tensor]:
    """Replace x, y, valid (..., N) where not `valid` by the answer of the safeguarded solver.

    Args:
        x: (..., N) coordinates found so far.
        y: (..., N).
        valid: (..., N), where they are the solution.
        target_x: distorted coordinates, broadcast against x.
        target_y: like target_x.
        coefficients: (..., P).
        model: the lens model.
        region: of the lens.
    """
    # That of torch loads all of sympy.
    shape = np.broadcast_shapes(valid.shape, (*coefficients.shape[:-1], valid.shape[-1]))
    lead, count = shape[:-1], shape[-1]
    cameras = torch.Size(lead).numel()
    x, y, valid, target_x, target_y = (
        value.expand(shape).reshape(cameras, count) for value in (x, y, valid, target_x, target_y)
    )
    lenses = coefficients.expand(*lead, model.size).reshape(cameras, model.size)
    radius = region.radius.expand(lead).reshape(cameras)
    edges = region.edge.expand(*lead, -1).reshape(cameras, -1)
    cuts = region.cuts.expand(*lead, -1, -1).reshape(cameras, -1, 4)
    whole = Region(radius, edges, cuts)
    # Just inside the edge.
    edge = (1 - 1e-9) * whole.outline(SECTORS)
    outward = _edge_fraction(target_x, target_y, *_images(edge, lenses, model))
    # Negated, so that NaN is tried.
    camera, place = (~valid & ~(outward > _TRIED)).nonzero(as_tuple=True)
    if not len(camera):
        return x.reshape(shape), y.reshape(shape), valid.reshape(shape)
    # Rings like the edge, and the axis. The edge is no start: the first Newton step from there would be wild.
    rings = torch.arange(_RINGS + 1, dtype=torch.float64, device=lenses.device)[:, None, None] / (_RINGS + 0.5)
    samples = (rings * whole.outline(DIRECTIONS)[:, None]).flatten(1, 2)
    sample_x, sample_y = samples.unbind(-1)
    image_x, image_y = _images(samples, lenses, model)
    found: list[tuple[Tensor, ...]] = []
    # A block of points at a time: their distances to all samples are one matrix.
    for c, n in zip(camera.split(1024), place.split(1024), strict=True):
        # Where there are several lenses, each point has its own, and its own dimension of length one.
        tail = (-1, 1) if cameras > 1 else (-1,)
        goal_x, goal_y = (value[c, n].reshape(tail) for value in (target_x, target_y))
        lens = lenses[c] if cameras > 1 else lenses[0]
        here = Region(radius[c], edges[c], cuts[c]) if cameras > 1 else Region(radius[0], edges[0], cuts[0])
        distances = (image_x[c] - goal_x.reshape(-1, 1)) ** 2 + (image_y[c] - goal_y.reshape(-1, 1)) ** 2
        nearest = distances.argmin(-1)
        start_x, start_y = (value[c, nearest].reshape(tail) for value in (sample_x, sample_y))
        part: tuple[Tensor, ...] = _damped_newton(start_x, start_y, goal_x, goal_y, lens, model, here)
        if not known_true(part[2] | (outward[c, n] > _TRIED_AGAIN).reshape(tail)):
            start_x, start_y = _follow_line(goal_x, goal_y, lens, model)
            led = _damped_newton(start_x, start_y, goal_x, goal_y, lens, model, here)
            part = tuple(torch.where(part[2], old, new) for old, new in zip(part, led, strict=True))
        found.append(part)
    solved = [torch.cat([part[i].reshape(-1) for part in found]) for i in range(3)]
    x, y, valid = (
        old.index_put((camera, place), new).reshape(shape) for old, new in zip((x, y, valid), solved, strict=True)
    )
    return x, y, valid


def _images(points: Tensor, lenses: Tensor, model: LensModel) -> tuple[Tensor, ...]:
    """Images x, y (cameras, N) of points (cameras, N, 2) of each region."""
    lens = distort_components(points[..., 0], points[..., 1], lenses, model)
    regular = lens.positive & (lens.determinant > 0)
    # Images that are no part of the lens: far enough never to be the nearest, and still finite when squared.
    both = torch.where(regular, torch.stack([lens.x, lens.y]), _FAR)
    return both.clamp(-_FAR, _FAR).nan_to_num(_FAR).unbind()


def _edge_fraction(x: Tensor, y: Tensor, edge_x: Tensor, edge_y: Tensor) -> Tensor:
    """Distance of targets (cameras, N) from the origin, as a fraction of that to the image of the region's edge.

    The region's image is a star about the origin, so its edge (cameras, 1024) is a function of direction.
    """
    angle, order = torch.atan2(edge_y, edge_x).sort(-1)
    reach = torch.gather(torch.hypot(edge_x, edge_y), -1, order)
    lost = reach >= _FAR
    farthest = torch.where(lost, 0.0, reach).amax(-1, keepdim=True)
    reach = torch.where(lost & (farthest > 0), _BEYOND * farthest, reach)
    place = torch.atan2(y, x)
    after = torch.searchsorted(angle, place) % SECTORS
    (low, high), (first, last) = (
        (torch.gather(each, -1, (after - 1) % SECTORS), torch.gather(each, -1, after)) for each in (angle, reach)
    )
    # Around a cusp, or where angles jump, the farther one.
    between = first + (last - first) * ((place - low) / (high - low)).clamp(0.0, 1.0)
    steep = ((last - first).abs() > _STEEP * first) | ~(high > low)
    return torch.hypot(x, y) / torch.where(steep, torch.maximum(first, last), between)


def _follow_line(target_x: Tensor, target_y: Tensor, coefficients: Tensor, model: LensModel) -> tuple[Tensor, Tensor]:
    """Follow the solution for t * target from t = 0, where it is the axis, to 1."""
    x, y = torch.zeros_like(target_x), torch.zeros_like(target_y)
    steps = 96
    for k in range(1, steps + 1):
        # The places crowd at the end of the line, where a fold may be.
        t = 1.0 - (1.0 - k / steps) ** 2
        for _ in range(2):
            next_x, next_y = _full_step(x, y, t * target_x, t * target_y, coefficients, model)
            usable = torch.isfinite(next_x + next_y)
            x, y = torch.where(usable, next_x, x), torch.where(usable, next_y, y)
    return x, y


def _damped_newton(
    x: Tensor, y: Tensor, target_x: Tensor, target_y: Tensor, coefficients: Tensor, model: LensModel, region: Region
) -> tuple[Tensor, Tensor, Tensor]:
    """Newton steps, halved until they lower the residual and stay in the region: x, y, and whether they solve it."""
    tolerance = squared_tolerance(target_x, target_y)

    def evaluate(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        lens = distort_components(x, y, coefficients, model)
        a, b, d, e = lens.point
        determinant = lens.determinant
        regular = lens.positive & (determinant > 0) & in_region(x, y, coefficients, model, region, lens)
        inverse = torch.where(regular, determinant.reciprocal(), 0.0)
        error_x, error_y = lens.x - target_x, lens.y - target_y
        error = torch.where(regular, error_x * error_x + error_y * error_y, torch.inf)
        return (e * error_x - b * error_y) * inverse, (a * error_y - d * error_x) * inverse, error

    step_x, step_y, error = evaluate(x, y)
    fraction = torch.ones_like(error)
    for _ in range(60):
        # If a step of a millionth still does not lower the residual, the point sits at the edge.
        if known_true((error <= tolerance) | (fraction < 1e-6)):
            break
        trial_x, trial_y = x - fraction * step_x, y - fraction * step_y
        next_x, next_y, next_error = evaluate(trial_x, trial_y)
        better = next_error < error
        x, y = torch.where(better, trial_x, x), torch.where(better, trial_y, y)
        step_x, step_y = torch.where(better, next_x, step_x), torch.where(better, next_y, step_y)
        error = torch.where(better, next_error, error)
        fraction = torch.where(better, torch.clamp(2.0 * fraction, max=1.0), 0.5 * fraction)
    return x, y, error <= tolerance


# Undo the distortion by Newton's method, and say for each point whether it can be undone.
#
# Most points need three steps from the start of `kcal.lens.inverse`. The few that do not converge, near a fold or
# without a preimage, go to `kcal.lens.inverse`. Where Python must not branch on values (compile, export,
# vmap), all points take the same number of steps, and those that have not converged by then are flagged.

# Steps before a point goes to the safeguarded solver, and steps where all points take the same number.
_STEPS = 6
# A Jacobian taken below the first residual is good enough to be kept: each step gains some four digits with it, so
# that below the second residual one more step reaches rounding.
_KEEP_JACOBIAN, _LAST_STEP = 1e-4, 1e-11

# Distorted coordinates x, y (..., N) to a first guess of the undistorted ones.
InverseStart = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]


class PreparedInverse(NamedTuple):
    """What is known of a lens beforehand: where it is valid, and where Newton's method starts.

    `guess` replaces the start of `kcal.lens.inverse`. A poor guess affects run time only, not the result, because
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
    return solve_safeguarded(x, y, valid, target_x, target_y, coefficients, model, ready.region)


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
