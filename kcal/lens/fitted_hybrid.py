"""A hybrid lens through given rays and pixels: lenses of other programs that no parametric model of kcal has."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.errors import DegenerateError
from kcal.lens.camera import Camera
from kcal.lens.hybrid_terms import HybridForm, radius_over_angle
from kcal.lens.model import LensModel
from kcal.lens.projection import project_components
from kcal.lens.zernike import ZernikeModes

# Beyond the outermost ray, in proportion.
_MARGIN = 1.05
_SHAPES = torch.linspace(-1.0, 1.2, 221, dtype=torch.float64)
_STEPS = 4


def hybrid_through(rays: Tensor, pixels: Tensor, size: tuple[int, int]) -> tuple[Camera, Tensor]:
    """The hybrid camera that comes nearest to pixels (N, 2) of rays (N, 3), and its errors (N, 2) in pixels.

    By least squares, without an entrance pupil. The rays should reach all over the image.

    Raises:
        DegenerateError: rays that no hybrid lens shows.
    """
    middle = 0.5 * (torch.tensor(size, dtype=torch.float64) - 1.0)
    theta, radius = torch.atan2(rays[:, :2].norm(dim=-1), rays[:, 2]), (pixels - middle).norm(dim=-1)
    plane = theta * radius_over_angle(_SHAPES[:, None] * theta**2)
    focal = (plane * radius).sum(1) / plane.square().sum(1)
    off = (focal[:, None] * plane - radius).square().sum(1)
    best = int(torch.where(off.isfinite(), off, math.inf).argmin())
    form = HybridForm(shape=float(_SHAPES[best]), radius=_MARGIN * float(plane[best].max()), modes=ZernikeModes())
    model = LensModel(hybrid=form)
    values = torch.zeros(5 + model.size, dtype=torch.float64)
    values[:4] = torch.stack([focal[best], focal[best], *middle])
    # Aspect and skew are modes of the field.
    free = [0, 2, 3, *(5 + i for i, name in enumerate(model.names) if name not in ("pupil1", "pupil2"))]
    for _ in range(_STEPS):
        found = project_components(rays.T, values, model, free)
        slopes = found.by_camera.flatten(1).T
        scale = slopes.norm(dim=0)
        error = (pixels.T - found.pixels).reshape(-1, 1)
        values[free] += torch.linalg.lstsq(slopes / scale, error, driver="gelsd").solution[:, 0] / scale
    camera = Camera(values, size=size, model=model)
    seen, shown = camera.project_rays(rays)
    if not bool(shown.all()):
        raise DegenerateError(f"a hybrid lens shows only {float(shown.double().mean()):.1%} of these rays")
    return camera, seen - pixels
