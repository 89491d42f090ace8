"""Landmarks that something shifts together: derivatives, and what the adjustment finds of it."""

import dataclasses

import pytest
import torch

from kcal import Camera, InputError, Landmarks, RigData, RigOptions, solve_rig
from kcal.rig import Effect

CAMERA = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
LOOK = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)
CENTERS = torch.tensor([[0.0, 0, 0], [10.0, 0, 0]], dtype=torch.float64)
COUNT = 40


def landmarks(amount: float, seed: int = 0, noise: float = 0.1) -> Landmarks:
    """Points of which half are seen elsewhere, by `amount` sigmas of an effect of 2 m in their own directions."""
    random = torch.Generator().manual_seed(seed)
    draw = torch.rand(COUNT, 3, generator=random, dtype=torch.float64)
    points = (draw - 0.5) * torch.tensor([160.0, 200.0, 60.0]) + torch.tensor([0.0, 250.0, 0.0])
    way = torch.randn(COUNT, 1, 3, generator=random, dtype=torch.float64).expand(-1, 2, -1)
    shift = 2.0 * way * (torch.arange(COUNT) < COUNT // 2).double()[:, None, None]
    survey = 0.05 * torch.randn(COUNT, 3, generator=random, dtype=torch.float64)
    seen = points[:, None] + amount * shift - CENTERS
    pixels = torch.stack([CAMERA.project(seen[:, c] @ LOOK.T)[0] for c in range(2)], 1)
    pixels = pixels + noise * torch.randn(pixels.shape, generator=random, dtype=torch.float64)
    return Landmarks(
        names=tuple(f"p{i}" for i in range(COUNT)),
        points=points + survey,
        sigma=torch.full((COUNT, 3), 0.05, dtype=torch.float64),
        pixels=pixels,
        pixel_sigma=noise,
        effects=(Effect(name="their clock", shift=shift),),
    )


def solved(data: Landmarks):
    return solve_rig(
        RigData(cameras=(CAMERA, CAMERA), names=("left", "right"), landmarks=data),
        RigOptions(refraction=0.0, refraction_sigma=0.0),
    )


@pytest.mark.parametrize("amount", [0.0, 0.8, -1.5])
def test_effect_is_found_with_its_sigma(amount: float) -> None:
    found, sigma = solved(landmarks(amount)).effects()["their clock"]
    assert 0.0 < sigma < 0.02
    assert abs(found - amount) < 4 * sigma


def test_without_effect_the_same_points_contradict() -> None:
    with pytest.raises(InputError, match="contradict"):
        solved(dataclasses.replace(landmarks(1.5), effects=()))


def test_sum_keeps_effects_with_their_landmarks() -> None:
    first, second = landmarks(0.5), landmarks(-0.5, seed=1)
    second = dataclasses.replace(second, names=tuple(f"q{i}" for i in range(COUNT)))
    both = first + second
    shifts = both.shifts()
    assert torch.equal(shifts[0, :COUNT], first.effects[0].shift)
    assert not shifts[0, COUNT:].any()
    assert torch.equal(shifts[1, COUNT:], second.effects[0].shift)
    assert not shifts[1, :COUNT].any()
    assert both.pixel_sigma.shape == (2 * COUNT, 2)


def test_effects_of_another_shape_are_refused() -> None:
    with pytest.raises(InputError, match="their clock"):
        dataclasses.replace(landmarks(0.0), effects=(Effect(name="their clock", shift=torch.zeros(COUNT, 3).double()),))
