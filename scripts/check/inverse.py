"""Whether the inverse of the lens is right or says so, on thousands of random lenses from mild to absurd.

For each lens two questions are asked. Points all over its valid region are projected: does the inverse find them
again? And pixels all over the image and a margin of half its size: do those that it calls valid project back to
themselves?

Points where a fold is so near that the lens flattens 10000 to 1 are left out of the first question: there the ray is
not determined by the pixel. Round trips may be off by 1e-9 px and what the lens makes of the rounding of its input.
"""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.inverse import prepare_inverse, undistort
from kcal.lens.model import LensModel, distort_components
from kcal.lens.region import in_region

MODELS = ("opencv4", "opencv5", "opencv8", "opencv12", "opencv14", "ext20", "ext24", "fisheye4")
# Standard deviation of every coefficient: 0.01 is an ordinary lens, 0.9 has folds and poles all over.
SCALES = (0.01, 0.03, 0.1, 0.3, 0.9)
BATCH = 8
FLAT = 1e-4
# How far off axis points are looked for, on the plane z = 1 or in radians, and how far out their images may lie.
REACH, MARGIN = 1.5, 3.0
PIXELS = 1e-9


@dataclasses.dataclass
class Tally:
    """What was counted: points and pixels asked for, and how many of them came out wrong."""

    points: int = 0
    lost: int = 0
    elsewhere: int = 0
    pixels: int = 0
    valid: int = 0
    wrong: int = 0
    worst: float = 0.0

    def add(self, other: Tally) -> None:
        """Add another count to this one."""
        for field in dataclasses.fields(self):
            combine = max if field.name == "worst" else sum
            setattr(self, field.name, combine((getattr(self, field.name), getattr(other, field.name))))


def jacobian(normalized: Tensor, coefficients: Tensor, model: LensModel) -> Tensor:
    """Derivative (..., N, 2, 2) of the distorted position by the point (..., N, 2)."""
    lens = distort_components(normalized[..., 0], normalized[..., 1], coefficients, model)
    return torch.stack(lens.point, -1).unflatten(-1, (2, 2))


def check_points(lenses: Tensor, model: LensModel, count: int, generator: torch.Generator) -> Tally:
    """Points of the valid region there and back; lenses are (B, P)."""
    ready = prepare_inverse(lenses, model)
    angle = torch.rand(len(lenses), count, generator=generator, dtype=torch.float64) * 2 * math.pi
    unit_x, unit_y = torch.cos(angle), torch.sin(angle)
    edge = torch.maximum(ready.region.radius[:, None], ready.region.fraction(unit_x, unit_y).reciprocal())
    radius = torch.sqrt(torch.rand(len(lenses), count, generator=generator, dtype=torch.float64))
    radius = radius * edge.clamp(max=REACH)
    x, y = radius * unit_x, radius * unit_y
    image = distort_components(x, y, lenses, model)
    singular = torch.linalg.svdvals(jacobian(torch.stack([x, y], -1), lenses, model))[..., -1]
    asked = in_region(x, y, lenses, model, ready.region) & (singular > FLAT)
    asked &= (image.x.abs() < MARGIN) & (image.y.abs() < MARGIN)
    back, valid = undistort(torch.stack([image.x, image.y], -1), lenses, model, ready)
    error = torch.hypot(back[..., 0] - x, back[..., 1] - y)
    elsewhere = error > 1e-11 * (1 + torch.hypot(image.x, image.y)) / singular
    return Tally(
        points=int(asked.sum()), lost=int((asked & ~valid).sum()), elsewhere=int((asked & valid & elsewhere).sum())
    )


def check_pixels(lenses: Tensor, model: LensModel, count: int, generator: torch.Generator) -> Tally:
    """Pixels of the image and a margin there and back."""
    head = torch.tensor([2000.0, 1900.0, 960.0, 540.0, 0.0], dtype=torch.float64).expand(len(lenses), 5)
    camera = Camera(torch.cat([head, lenses], -1), size=(1920, 1080), model=model)
    pixels = torch.rand(len(lenses), count, 2, generator=generator, dtype=torch.float64) - 0.25
    pixels = pixels * torch.tensor([3840.0, 2160.0], dtype=torch.float64)
    rays, valid = camera.unproject(pixels)
    again, seen = camera.project(rays * 5.0)
    error = torch.linalg.vector_norm(again - pixels, dim=-1)
    point, _ = undistort((pixels - camera.center[:, None]) / camera.focal[:, None], lenses, model)
    steepest = torch.linalg.matrix_norm(jacobian(point, lenses, model), ord=2)
    reach = 1 + torch.linalg.vector_norm(point, dim=-1)
    allowed = PIXELS + 4 * torch.finfo(torch.float64).eps * reach * steepest * 2000.0
    wrong = valid & ~(seen & (error < allowed) & torch.isfinite(rays).all(-1))
    ordinary = valid & seen & (allowed < 2 * PIXELS)
    worst = float(error[ordinary].max()) if bool(ordinary.any()) else 0.0
    return Tally(pixels=valid.numel(), valid=int(valid.sum()), wrong=int(wrong.sum()), worst=worst)


def sweep(lenses: int, seed: int, points: int = 200) -> Tally:
    """Check at least so many lenses, spread over all models and scales."""
    total = Tally()
    generator = torch.Generator().manual_seed(seed)
    rounds = math.ceil(lenses / (len(MODELS) * len(SCALES) * BATCH))
    jobs = [(model, scale) for model in MODELS for scale in SCALES for _ in range(rounds)]
    for name, scale in jobs:
        model = LensModel.named(name)
        coefficients = scale * torch.randn(BATCH, model.size, generator=generator, dtype=torch.float64)
        total.add(check_points(coefficients, model, points, generator))
        total.add(check_pixels(coefficients, model, points, generator))
    return total
