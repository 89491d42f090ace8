"""Fit a parametric lens model to a calibrated camera, for programs that know only that model."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from kcal.calibrate.problem.coefficient_prior import CoefficientPrior
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS, parameter_names, project_components
from kcal.solve.dense import DenseProblem
from kcal.solve.lm import LMOptions, minimize

# Beyond this angle from the axis perspective models have hardly any image.
_STEEPEST = math.radians(80.0)
# Pixels of misfit in proportion to which the weak prior on coefficients counts; 0.3 as in `CalibrationOptions`.
_NOISE, _WIDTH = 0.01, 0.3


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class RefittedCamera:
    """A camera of another model, and how well it stands for the original one.

    Args:
        camera: of the model that was asked for, in the same frame.
        rms: sqrt(mean ‖e‖²) over the image, pixels.
        largest: largest ‖e‖.
        covered: share of the image that was fitted: without what the original camera has no ray for, and without what
            the model cannot show.
        width: (5 + P,) standard deviations of the weak prior on the coefficients; infinite for what has none. None: no
            prior.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.1, 0.01])
        >>> refit_camera(camera, "pinhole").largest > 1  # a pinhole is no lens
        True
    """

    camera: Camera
    rms: float
    largest: float
    covered: float
    width: Tensor | None = None


def refit_camera(
    camera: Camera, model: LensModel | str = "opencv14", *, grid: tuple[int, int] = (33, 25)
) -> RefittedCamera:
    """Fit a parametric model to a camera over its whole image, at infinity.

    The sum of squared distances in pixels is minimized on a grid of directions, with a weak prior on the coefficients.
    The frame stays as it is, so a rig's pose is kept. A wandering entrance pupil is lost: points within a few meters
    are seen elsewhere than by the original camera.

    Args:
        camera: a single camera, for example a hybrid one.
        model: a parametric lens model, by name or as a `LensModel`.
        grid: columns and rows of the directions.

    Raises:
        InputError: a batch of cameras, a hybrid model, or a camera with hardly any ray.

    Example:
        >>> camera = Camera.build(focal=(800, 800), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.1, 0.01])
        >>> found = refit_camera(camera, "opencv14")
        >>> found.rms < 0.001, found.covered
        (True, 1.0)
    """
    model = LensModel.named(model)
    values = camera.params.detach()
    if values.ndim != 1:
        raise InputError("refit_camera: a single camera is needed, not a batch")
    if model.hybrid:
        raise InputError("refit_camera: name a parametric model, for example opencv14")
    pixels = camera.grid(*grid).reshape(-1, 2)
    rays, valid = camera.unproject(pixels)
    angle = torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2])
    good = valid & ((angle < _STEEPEST) if not model.wide else valid)
    if int(good.sum()) < model.size + len(INTRINSICS):
        raise InputError(f"refit_camera: only {int(good.sum())} of {len(good)} directions can be shown by {model}")
    points, wanted = rays[good].T, pixels[good].T
    names = parameter_names(model)
    free = torch.tensor([i for i, name in enumerate(names) if name != "skew"])
    reach = float(torch.tan(angle[good].max())) if not model.wide else float(angle[good].max())
    prior = CoefficientPrior(_WIDTH, reach).term(model, _NOISE)

    def parameters(x: Tensor) -> Tensor:
        return torch.zeros(len(names), dtype=x.dtype).index_put((free,), x)

    def residual(x: Tensor) -> Tensor:
        here = parameters(x)
        seen = project_components(points, here, model)
        return torch.cat([(seen.pixels - wanted).flatten(), prior.weight * here[prior.index]])

    # Near the axis every lens is a pinhole.
    near = angle[good] <= angle[good].sort().values[max(8, int(good.sum()) // 16)]
    plane = points[:2, near] / points[2, near]
    slope = ((wanted[:, near] - values[2:4, None]) * plane).sum() / plane.square().sum()
    start = torch.zeros(len(free), dtype=torch.float64)
    start[:4] = torch.stack([slope, slope, values[2], values[3]])
    result = minimize(DenseProblem(residual, ()), (start,), LMOptions(max_iterations=500, tolerance=1e-10))
    found = Camera(parameters(result.state[0]), size=camera.size, model=model)
    seen, shown = found.project(rays[good])
    error = (seen - pixels[good])[shown].norm(dim=-1)
    if not len(error):
        raise InputError(f"refit_camera: {model} cannot stand for this camera: its fit has no image of any direction")
    return RefittedCamera(
        camera=found,
        rms=float(error.square().mean().sqrt()),
        largest=float(error.max()),
        covered=float(shown.sum()) / len(pixels),
        width=torch.full_like(found.params, math.inf).index_put((prior.index,), _NOISE / prior.weight),
    )
