"""Solve for the points where plain Newton fails: near a fold or a pole, or without a preimage at all.

Each point starts from the nearest of some thousand samples of the valid region, so that it begins on the right side of
every fold, and takes damped steps that may not leave the region. Inside the region the Jacobian's determinant is
positive, so the residual has no minimum but the solution, and a point that stops elsewhere stops at the edge. Where the
region is not convex, the edge may lie between a start and the solution. The image of the region, however, is a star
about the origin (`kcal.lens.region`), so the straight line of images from the axis to the target stays inside it.
Points that stopped at the edge follow that line.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.dispatch import known_true
from kcal.lens.distortion import distort_components
from kcal.lens.model import LensModel
from kcal.lens.newton import inverse_jacobian, newton_step
from kcal.lens.region import DIRECTIONS, Region, in_region

_RINGS = 16
# The image of the region's edge is known at 64 directions only. A target this much farther out may still be inside:
# it is tried at all, and it is tried again along the line from the axis.
_TRIED, _TRIED_AGAIN = 1.02, 1.002


def solve_safeguarded(
    x: Tensor,
    y: Tensor,
    valid: Tensor,
    target_x: Tensor,
    target_y: Tensor,
    tolerance: Tensor,
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
        tolerance: largest squared residual of a solution.
        coefficients: (..., P).
        model: the lens model.
        region: of the lens.
    """
    shape = torch.broadcast_shapes(valid.shape, (*coefficients.shape[:-1], valid.shape[-1]))
    lead, count = shape[:-1], shape[-1]
    cameras = torch.Size(lead).numel()
    x, y, valid, target_x, target_y, tolerance = (
        value.expand(shape).reshape(cameras, count) for value in (x, y, valid, target_x, target_y, tolerance)
    )
    lenses = coefficients.expand(*lead, model.size).reshape(cameras, model.size)
    radius = region.radius.expand(lead).reshape(cameras)
    edges = region.edge.expand(*lead, -1).reshape(cameras, -1)
    cuts = region.cuts.expand(*lead, -1, -1).reshape(cameras, -1, 4)
    sample_x, sample_y, image_x, image_y = _region_samples(lenses, model, Region(radius, edges, cuts))
    inner_x, inner_y = image_x[:, :-DIRECTIONS], image_y[:, :-DIRECTIONS]

    outward = _edge_fraction(target_x, target_y, image_x, image_y)
    # Negated, so that NaN is tried.
    camera, place = (~valid & ~(outward > _TRIED)).nonzero(as_tuple=True)
    if not len(camera):
        return x.reshape(shape), y.reshape(shape), valid.reshape(shape)
    found: list[tuple[Tensor, ...]] = []
    # A block of points at a time: their distances to all samples are one matrix.
    for c, n in zip(camera.split(1024), place.split(1024), strict=True):
        # Where there are several lenses, each point has its own, and its own dimension of length one.
        tail = (-1, 1) if cameras > 1 else (-1,)
        goal_x, goal_y, enough = (value[c, n].reshape(tail) for value in (target_x, target_y, tolerance))
        lens = lenses[c] if cameras > 1 else lenses[0]
        here = Region(radius[c], edges[c], cuts[c]) if cameras > 1 else Region(radius[0], edges[0], cuts[0])
        distances = (inner_x[c] - goal_x.reshape(-1, 1)) ** 2 + (inner_y[c] - goal_y.reshape(-1, 1)) ** 2
        nearest = distances.argmin(-1)
        start_x, start_y = (value[c, nearest].reshape(tail) for value in (sample_x, sample_y))
        part: tuple[Tensor, ...] = _damped_newton(start_x, start_y, goal_x, goal_y, enough, lens, model, here)
        if not known_true(part[2] | (outward[c, n] > _TRIED_AGAIN).reshape(tail)):
            start_x, start_y = _follow_line(goal_x, goal_y, lens, model)
            led = _damped_newton(start_x, start_y, goal_x, goal_y, enough, lens, model, here)
            part = tuple(torch.where(part[2], old, new) for old, new in zip(part, led, strict=True))
        found.append(part)
    solved = [torch.cat([part[i].reshape(-1) for part in found]) for i in range(3)]
    x, y, valid = (
        old.index_put((camera, place), new).reshape(shape) for old, new in zip((x, y, valid), solved, strict=True)
    )
    return x, y, valid


def _region_samples(lenses: Tensor, model: LensModel, region: Region) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points of each region on rings like its edge, and their images: (cameras, 1089) each, the axis first.

    The last ring lies just inside the edge. It is no start, because the first Newton step from there would be wild.
    """
    rings = torch.arange(1, _RINGS + 2, dtype=torch.float64, device=lenses.device) / (_RINGS + 0.5)
    rings[-1] = 1 - 1e-9
    points = (rings[:, None, None] * region.outline(DIRECTIONS)[:, None]).flatten(1, 2)
    points = torch.cat([torch.zeros_like(points[:, :1]), points], 1)
    x, y = points.unbind(-1)
    lens = distort_components(x, y, lenses, model)
    regular = lens.positive & (lens.determinant > 0)
    # Images that are no part of the lens: far enough never to be the nearest, and still finite when squared.
    far = 1e150
    image_x, image_y = (torch.where(regular, value, far).clamp(-far, far).nan_to_num(far) for value in (lens.x, lens.y))
    return x, y, image_x, image_y


def _edge_fraction(x: Tensor, y: Tensor, image_x: Tensor, image_y: Tensor) -> Tensor:
    """Distance of targets (cameras, N) from the origin, as a fraction of that to the image of the region's edge.

    The region's image is a star about the origin, so its edge, the image of the last ring, is a function of direction.
    """
    edge_x, edge_y = image_x[:, -DIRECTIONS:], image_y[:, -DIRECTIONS:]
    angle, order = torch.atan2(edge_y, edge_x).sort(-1)
    reach = torch.gather(torch.hypot(edge_x, edge_y), -1, order)
    after = torch.searchsorted(angle, torch.atan2(y, x)) % DIRECTIONS
    before = (after - 1) % DIRECTIONS
    limit = torch.maximum(torch.gather(reach, -1, before), torch.gather(reach, -1, after))
    return torch.hypot(x, y) / limit


def _follow_line(target_x: Tensor, target_y: Tensor, coefficients: Tensor, model: LensModel) -> tuple[Tensor, Tensor]:
    """Follow the solution for t * target from t = 0, where it is the axis, to 1."""
    x, y = torch.zeros_like(target_x), torch.zeros_like(target_y)
    steps = 96
    for k in range(1, steps + 1):
        # The places crowd at the end of the line, where a fold may be.
        t = 1.0 - (1.0 - k / steps) ** 2
        for _ in range(2):
            lens = distort_components(x, y, coefficients, model)
            error_x, error_y = lens.x - t * target_x, lens.y - t * target_y
            next_x, next_y = newton_step(x, y, error_x, error_y, inverse_jacobian(lens.point))
            usable = torch.isfinite(next_x + next_y)
            x, y = torch.where(usable, next_x, x), torch.where(usable, next_y, y)
    return x, y


def _damped_newton(
    x: Tensor,
    y: Tensor,
    target_x: Tensor,
    target_y: Tensor,
    tolerance: Tensor,
    coefficients: Tensor,
    model: LensModel,
    region: Region,
) -> tuple[Tensor, Tensor, Tensor]:
    """Newton steps, halved until they lower the residual and stay in the region: x, y, and whether they solve it."""

    def evaluate(x: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        lens = distort_components(x, y, coefficients, model)
        a, b, d, e = lens.point
        determinant = lens.determinant
        regular = lens.positive & (determinant > 0) & in_region(x, y, coefficients, model, region)
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
