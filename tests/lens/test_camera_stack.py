"""Cameras in one call give what each gives alone."""

from __future__ import annotations

import pytest
import torch
from lenses import HYBRID, strong
from torch import Tensor

from kcal.lens.camera import Camera
from kcal.lens.camera_like import project_each, stackable, unproject_each
from kcal.lens.model import PRESETS
from kcal.lens.projection import project_components

NAMED = {**PRESETS, "hybrid": HYBRID}


def make_camera(preset: str, focal: float) -> Camera:
    model = NAMED[preset]
    lens = (
        torch.tensor([0.02, -0.01, 0.003, -0.0005], dtype=torch.float64) if model.fisheye else torch.zeros(0).double()
    )
    if model.size and not model.fisheye:
        lens = 0.3 * focal / 1600 * strong(model)
    head = torch.tensor([focal, focal + 9.0, 955.0, 541.0, 2.0], dtype=torch.float64)
    return Camera(torch.cat([head, lens]), size=(1920, 1080), model=model)


def some_pixels(*shape: int) -> Tensor:
    """In the image, around it, and one that is not finite."""
    random = torch.Generator().manual_seed(1)
    pixels = torch.rand(*shape, 2, generator=random, dtype=torch.float64) * torch.tensor([2400.0, 1500.0]) - 200.0
    pixels[..., 3, 0] = torch.nan
    return pixels


@pytest.mark.parametrize("kinds", [(name, name) for name in NAMED] + [("fisheye4", "opencv5", "opencv5")])
def test_rays_are_those_of_each_camera(kinds: tuple[str, ...]) -> None:
    cameras = [make_camera(kind, 1500.0 + 100.0 * number) for number, kind in enumerate(kinds)]
    assert stackable(cameras) == (len(set(kinds)) == 1 and kinds[0] != "hybrid")
    for shape in ((len(cameras), 40), (2, len(cameras), 40)):
        pixels = some_pixels(*shape)
        rays, valid = unproject_each(cameras, pixels)
        alone = [camera.unproject(pixels[..., number, :, :]) for number, camera in enumerate(cameras)]
        assert torch.equal(valid, torch.stack([seen for _, seen in alone], -2))
        assert torch.allclose(rays, torch.stack([ray for ray, _ in alone], -3), rtol=0, atol=1e-13)


def test_gradients_reach_each_camera() -> None:
    cameras = [make_camera("opencv14", focal).free() for focal in (1500.0, 1600.0)]
    pixels = some_pixels(2, 20)
    weight = torch.rand(2, 20, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    slopes = []
    alone = [camera.unproject(some)[0] for camera, some in zip(cameras, pixels, strict=True)]
    for rays in (unproject_each(cameras, pixels)[0], torch.stack(alone)):
        slopes.append(torch.autograd.grad((weight * rays).sum(), [camera.params for camera in cameras]))
    for one, other in zip(*slopes, strict=True):
        assert float(one.abs().max()) > 0
        assert torch.allclose(one, other, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("kinds", [("opencv14", "opencv14"), ("fisheye4", "hybrid"), ("hybrid", "hybrid")])
def test_projections_are_those_of_each_camera(kinds: tuple[str, str]) -> None:
    cameras = [make_camera(kind, 1500.0 + 100.0 * number) for number, kind in enumerate(kinds)]
    random = torch.Generator().manual_seed(3)
    points = torch.randn(2, 3, 15, generator=random, dtype=torch.float64) + torch.tensor([[0.0], [0.0], [6.0]])
    meter = torch.full((15,), 0.01, dtype=torch.float64)
    wanted = [list(range(len(camera.names))) for camera in cameras]
    for number, found in enumerate(project_each(cameras, points, wanted, meter)):
        camera = cameras[number]
        alone = project_components(points[number], camera.values, camera.model, wanted[number], meter)
        for one, other in zip(found, alone, strict=True):
            assert (one is None) == (other is None)
            assert one is None or torch.allclose(one, other, rtol=1e-13, atol=1e-12)
