"""The few points that plain Newton does not bring home: near a fold or a pole, or without a preimage at all.

Each starts from the nearest of some thousand samples of the valid region, so that it begins on the right side of every
fold, and takes damped steps that may not leave the region. Inside it the Jacobian's determinant is positive, so that
the residual has no minimum but the solution: a point that stops elsewhere stops at the edge, and has no preimage.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.lens.distortion import distort_components
from kcal.lens.eager import known_true
from kcal.lens.model import LensModel
from kcal.lens.region import DIRECTIONS, Region, in_region

_RINGS = 16
_STEPS = 60
# Points at a time: their distances to all samples are one matrix.
_BLOCK = 1024


def solve_hard(
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
        y: likewise.
        valid: (..., N), where they are the solution.
        target_x: distorted coordinates, broadcast against x.
        target_y: likewise.
        tolerance: square of the residual that is accepted.
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
    sample_x, sample_y, image_x, image_y = _samples(lenses, model, Region(radius, edges))

    camera, place = (~valid).nonzero(as_tuple=True)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for c, n in zip(camera.split(_BLOCK), place.split(_BLOCK), strict=True):
        goal_x, goal_y, enough = target_x[c, n], target_y[c, n], tolerance[c, n]
        nearest = ((image_x[c] - goal_x[:, None]) ** 2 + (image_y[c] - goal_y[:, None]) ** 2).argmin(-1)
        own = lenses[c] if cameras > 1 else lenses[0]
        here = Region(radius[c], edges[c]) if cameras > 1 else Region(radius[0], edges[0])
        # One lens a point where there are several: points then have a dimension of their own, of length one.
        tail = (-1, 1) if cameras > 1 else (-1,)
        args = (goal_x.reshape(tail), goal_y.reshape(tail), enough.reshape(tail), own, model, here)
        found.append(_damped(sample_x[c, nearest].reshape(tail), sample_y[c, nearest].reshape(tail), *args))
    solved = [torch.cat([part[i].reshape(-1) for part in found]) for i in range(3)]
    x, y, valid = (
        old.index_put((camera, place), new).reshape(shape) for old, new in zip((x, y, valid), solved, strict=True)
    )
    return x, y, valid


def _samples(lenses: Tensor, model: LensModel, region: Region) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points of each region on rings like its edge, axis included, and where they are mapped: (cameras, 1025) each."""
    rings = torch.arange(1, _RINGS + 1, dtype=torch.float64, device=lenses.device) / (_RINGS + 0.5)
    points = (rings[:, None, None] * region.outline(DIRECTIONS)[:, None]).flatten(1, 2)
    points = torch.cat([torch.zeros_like(points[:, :1]), points], 1)
    x, y = points.unbind(-1)
    lens = distort_components(x, y, lenses, model)
    regular = lens.positive & (lens.determinant > 0)
    # Far enough never to be the nearest, and still finite when squared.
    image_x, image_y = (
        torch.where(regular, value, 1e150).clamp(-1e150, 1e150).nan_to_num(1e150) for value in (lens.x, lens.y)
    )
    return x, y, image_x, image_y


def _damped(
    x: Tensor,
    y: Tensor,
    target_x: Tensor,
    target_y: Tensor,
    tolerance: Tensor,
    coefficients: Tensor,
    model: LensModel,
    region: Region,
) -> tuple[Tensor, Tensor, Tensor]:
    """Newton steps, halved until they lower the residual and stay in the region: x, y, whether it arrived."""

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
    for _ in range(_STEPS):
        # A step of less than a millionth that still leads nowhere: the point sits at the edge.
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
