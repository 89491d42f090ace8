"""Where a parametric camera begins: at the base projection of the hybrid lens, whose curve its own terms follow."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.hybrid.base_fit import fit_projection
from kcal.calibrate.problem.coefficient_prior import CoefficientPrior
from kcal.calibrate.problem.poses import poses_under
from kcal.calibrate.problem.priors import FoldBarrier, Term
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import CameraViews
from kcal.errors import InputError
from kcal.lens.base_map import radius_over_angle
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS
from kcal.solve.lm import LMOptions

# Largest angle off the axis, degrees, that terms of tan θ follow, and how far beyond the outermost corner they do.
_STEEPEST, _BEYOND = 84.0, 1.05
# Standard deviation of the curve, in focal lengths, against the width of the coefficients' prior, in shares of their
# radius: terms that nearly cancel stay small.
_CURVE, _WIDTH = 1e-4, 0.3
# Terms of each polynomial of a ratio that follow: more would nearly cancel.
_RATIONAL = 3
# Height of the barrier before a fold, in units of the noise.
_BARRIER = 0.3


class LensStart(NamedTuple):
    """Where a fit begins.

    Attributes:
        state: camera and poses.
        terms: a barrier before folds of the lens, if there is one that the state keeps.
    """

    state: BoardState
    terms: tuple[Term, ...]


def first_states(
    views: CameraViews, model: LensModel, focal: float | None, *, barrier: bool
) -> tuple[list[LensStart], float, int]:
    """Begin at the base projection: with the model's own curve, and without distortion.

    Args:
        views: the data.
        model: the lens model.
        focal: a focal length to begin with, or None.
        barrier: whether the lens must not fold within the image, nor else around the corners that were seen.

    Returns:
        those of the two that show all corners, or the second alone; the noise of the base projection in pixels; and the
        trial steps spent.
    """
    ones = torch.ones_like(views.pixels[..., 0])
    fixed = views.constraints.fixed
    known = fixed.get("fx", fixed.get("fy"))
    base = fit_projection(
        views.board_points, views.pixels, views.size, ones, known_focal=known or focal, exact_focal=known is not None
    )
    points = views.board_points @ base.state.rotation.mT + base.state.translation[:, None]
    angle = torch.atan2(points[..., :2].norm(dim=-1), points[..., 2])
    widest = _BEYOND * float(torch.where(torch.isfinite(views.pixels).all(-1), angle, 0.0).max())
    lens = follow_base(base.shape, widest, model, fixed)
    noise = math.sqrt(base.variance)
    states = []
    for own in (lens, torch.zeros_like(lens)):
        parameters = views.constraints.impose(torch.cat([base.state.parameters[:5], own]), model)
        states.append(BoardState.flat(parameters, base.state.rotation, base.state.translation))
    shown = [state for state in states if math.isfinite(float(views.problem(model).cost(state)))] or states[1:]
    height = _BARRIER * noise
    return [LensStart(s, _barrier(views, s, model, height) if barrier else ()) for s in shown], noise, base.steps


def _barrier(views: CameraViews, state: BoardState, model: LensModel, weight: float) -> tuple[Term, ...]:
    """A barrier before folds in the image, else around the corners that were seen; none where the state folds there."""
    values = torch.cat([state.parameters, state.board])
    for radius in (views.regular_radius(state, model), views.seen_radius(state)):
        term = FoldBarrier(model, radius, weight)
        if bool(term.rows(values).isfinite().all()):
            return (term,)
    return ()


def follow_base(shape: float, widest: float, model: LensModel, fixed: Mapping[str, float]) -> Tensor:
    """Lens coefficients (P,) whose radial terms follow a base projection; all others are zero.

    A ratio of polynomials is fitted linearly, and again with weights from the last denominator (Sanathanan and Koerner
    1963). Coefficients that the curve leaves open stay as small as a prior has them.

    Args:
        shape: of the base projection (`kcal.lens.base_map`).
        widest: angle off the axis, radians, up to which it is followed.
        model: the lens model.
        fixed: coefficients that are held, by name.

    Example:
        >>> lens = follow_base(0.25, 0.6, LensModel.named("opencv5"), {})  # stereographic, 2 tan(θ / 2)
        >>> r = torch.tensor(0.6).double().tan()
        >>> found = r * (1 + lens[0] * r**2 + lens[1] * r**4 + lens[4] * r**6)
        >>> bool((found - 2 * torch.tensor(0.3).double().tan()).abs() < 2e-4)
        True
    """
    top, bottom = list(model.numerator_index), list(model.denominator_index)
    if bottom:
        top, bottom = top[:_RATIONAL], bottom[:_RATIONAL]
    out = torch.tensor([fixed.get(name, 0.0) for name in model.names], dtype=torch.float64)
    free = [k for k, i in enumerate([*top, *bottom]) if model.names[i] not in fixed]
    if not free:
        return out
    angle = torch.linspace(0.0, 1.0, 200, dtype=torch.float64)[1:]
    angle = angle * (widest if model.wide else min(widest, math.radians(_STEEPEST)))
    radius = angle if model.wide else torch.tan(angle)
    ratio = angle * radius_over_angle(torch.tensor(shape, dtype=torch.float64) * angle**2) / radius
    s = radius**2
    powers = [s ** (j + 1) for j in range(len(top))] + [-ratio * s ** (j + 1) for j in range(len(bottom))]
    columns, chosen = torch.stack(powers, -1), [[*top, *bottom][k] for k in free]
    weights = CoefficientPrior(_WIDTH, float(radius[-1])).term(model, _CURVE)
    ridge = torch.diag(weights.weight[[weights.index.tolist().index(len(INTRINSICS) + i) for i in chosen]])
    denominator = torch.ones_like(s)
    for _ in range(10 if bottom else 1):
        weight = radius / denominator
        target = ratio - 1.0 - columns @ torch.where(_is_in(free, columns), 0.0, out[[*top, *bottom]])
        rows = torch.cat([columns[:, free] * weight[:, None], ridge])
        right = torch.cat([target * weight, torch.zeros(len(free), dtype=torch.float64)])
        out[chosen] = torch.linalg.lstsq(rows, right[:, None]).solution[:, 0]
        denominator = 1.0 + sum((s ** (j + 1) * out[i] for j, i in enumerate(bottom)), start=torch.zeros_like(s))
    return out


def _is_in(chosen: Sequence[int], columns: Tensor) -> Tensor:
    out = torch.zeros(columns.shape[1], dtype=torch.bool)
    out[list(chosen)] = True
    return out


def known_model(camera: Camera, views: CameraViews, names: Sequence[str]) -> BoardState:
    """Begin with a known camera and the board poses under it."""
    camera = Camera(camera.params.detach().cpu(), size=camera.size, model=camera.model)
    if camera.size != views.size:
        raise InputError(f"the known camera is of {camera.size} px, the observations of {views.size} px")
    state, _ = poses_under(camera, views, LMOptions(max_iterations=30))
    poor = state.translation.isnan().any(-1).nonzero()[:, 0].tolist()
    if poor:
        raise InputError(
            f"view {names[poor[0]]!r}: the known camera gives too few of its corners a ray; remove the view, or "
            "calibrate without a known camera"
        )
    return state
