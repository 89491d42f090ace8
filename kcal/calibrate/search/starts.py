"""Initial values for wide-angle lenses, which no pinhole with a few polynomial terms explains.

Beyond about 110° the closed forms fail: they take strong barrel distortion for tilt. Such lenses are designed along
known curves (equidistant r = f θ, stereographic r = 2 f tan(θ/2)), which a rational radial term can approximate.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardState
from kcal.calibrate.bundle.closed_form import homographies, poses_from_homographies
from kcal.calibrate.bundle.views import CameraViews
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS

# Image radius in focal lengths as a function of the angle off the axis, and its inverse.
_CURVES: tuple[tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]], ...] = (
    (lambda angle: angle, lambda radius: radius),
    (lambda angle: 2.0 * torch.tan(0.5 * angle), lambda radius: 2.0 * torch.atan(0.5 * radius)),
)
# Angles off the axis of the image's corner that are tried, degrees.
_HALF_DIAGONALS = (55.0, 65.0, 75.0, 82.0)
_STEEPEST = math.radians(84.0)


def rational_curve(curve: Callable[[Tensor], Tensor], model: LensModel, steepest: float) -> Tensor:
    """Lens coefficients whose radial term follows a curve up to an angle: (P,), all other coefficients zero.

    The ratio of two polynomials is fitted linearly, and again with weights from the last denominator (Sanathanan and
    Koerner 1963).

    Args:
        curve: image radius in focal lengths by the angle off the axis.
        model: with numerator and denominator.
        steepest: angle in radians, below π/2.
    """
    angle = torch.linspace(0.0, steepest, 200, dtype=torch.float64)[1:]
    radius = torch.tan(angle)
    ratio = curve(angle) / radius
    # In units of the largest s, so that powers have similar scales.
    unit = float(radius[-1] ** 2)
    s = radius**2 / unit
    top = torch.stack([s ** (j + 1) for j in range(model.numerator)], -1)
    bottom = torch.stack([s ** (j + 1) for j in range(model.denominator)], -1)
    rows = torch.cat([top, -ratio[:, None] * bottom], -1)
    denominator = torch.ones_like(s)
    for _ in range(10):
        weight = radius / denominator
        solution = torch.linalg.lstsq(rows * weight[:, None], ((ratio - 1.0) * weight)[:, None]).solution[:, 0]
        denominator = 1.0 + bottom @ solution[model.numerator :]
    powers = [unit ** -(j + 1) for j in (*range(model.numerator), *range(model.denominator))]
    coefficients = torch.zeros(model.size, dtype=torch.float64)
    coefficients[[*model.numerator_index, *model.denominator_index]] = solution * torch.tensor(powers).double()
    return coefficients


def wide_starts(views: CameraViews, model: LensModel, count: int = 2) -> list[BoardState]:
    """The best few starts over curves and fields of view, by the cost of the corners.

    Args:
        views: the data.
        model: with numerator and denominator of at least order two.
        count: the largest number of starts to return.
    """
    width, height = views.size
    center = torch.tensor([(width - 1) / 2, (height - 1) / 2], dtype=torch.float64)
    found: list[tuple[float, BoardState]] = []
    for curve, angle_of in _CURVES:
        lens = rational_curve(curve, model, _STEEPEST)
        for degrees in _HALF_DIAGONALS:
            focal = 0.5 * math.hypot(width, height) / float(curve(torch.tensor(math.radians(degrees))))
            offset = (views.pixels - center) / focal
            radius = torch.linalg.vector_norm(offset, dim=-1, keepdim=True)
            angle = angle_of(radius)
            if not bool((torch.nan_to_num(angle) < _STEEPEST).all()):
                continue
            normalized = offset * torch.tan(angle) / radius.clamp_min(1e-9)
            pinhole = torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64)
            poses = poses_from_homographies(homographies(views.board_points, normalized), pinhole)
            parameters = torch.zeros(len(INTRINSICS) + model.size, dtype=torch.float64)
            parameters[:4] = torch.cat([torch.full((2,), focal, dtype=torch.float64), center])
            parameters[len(INTRINSICS) :] = lens
            state = BoardState.flat(parameters, *poses)
            cost = float(views.lens_problem(model).cost(state))
            if math.isfinite(cost):
                found.append((cost, state))
    return [state for _, state in sorted(found, key=lambda entry: entry[0])[:count]]
