"""Matches of ground at a slant: optics blur it differently in both images, and it shines differently."""

import math

import pytest
import torch
from torch import Tensor

from kcal import Camera, Rig
from kcal.corners.patches import image_windows, sample, warped_blur_windows
from kcal.scene import refine
from kcal.scene.refine import refine_matches

SIZE = (320, 240)
CAMERA = Camera.build(focal=(300, 300), center=(160, 120), size=SIZE, model="pinhole")
RIG = Rig.pair(CAMERA, CAMERA, torch.eye(3).double(), torch.tensor([-1.0, 0.0, 0.0]).double())
# Pixels of the right image by those of the left: a ground 1.4 baselines below the cameras.
WARP = torch.tensor([[1.0, -1.0 / 1.4], [0.0, 1.0]]).double()
MIDDLE = torch.tensor([160.0, 120.0]).double()
OPTICS = 0.8


def waves(warp: Tensor, optics: float = OPTICS) -> Tensor:
    """A texture of plane waves through optics that blur it: what is at p of the left image is at MIDDLE + warp p."""
    draw = torch.Generator().manual_seed(4)
    angle, phase = (2.0 * math.pi * torch.rand(2, 60, generator=draw)).double()
    size = 0.2 + 0.7 * torch.rand(60, generator=draw).double()
    seen = (size * torch.stack([angle.cos(), angle.sin()])).T @ torch.linalg.inv(warp)
    y, x = torch.meshgrid(*(torch.arange(count).double() for count in SIZE[::-1]), indexing="ij")
    at = torch.stack([x, y], -1) - MIDDLE
    blurred = torch.exp(-0.5 * optics**2 * seen.square().sum(-1))
    return 120.0 + 5.0 * torch.einsum("hwk,k->hw", torch.cos(at @ seen.T + phase), blurred)


def below() -> tuple[Tensor, Tensor]:
    """Left and right pixels of places on the ground."""
    left = torch.tensor([[100.0 + 12.0 * i, 130.0 + 10.0 * j] for i in range(12) for j in range(9)]).double()
    right = (left - MIDDLE) @ WARP.T + MIDDLE
    inside = (right[:, 0] > 20.0) & (right[:, 0] < 300.0)
    return left[inside], right[inside]


def errors(second: Tensor) -> Tensor:
    """(M, 2) px, of what was found."""
    left, truth = below()
    found = refine_matches(RIG, (waves(torch.eye(2).double()).float(), second.float()), left, truth + 0.4)
    assert float(found.good.double().mean()) > 0.75
    return (found.right - truth)[found.good]


def test_both_images_are_blurred_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it, errors beyond interpolation's are several times as large."""
    error = errors(waves(WARP))
    monkeypatch.setattr(refine, "_LEAST_WARPED", math.inf)
    before = errors(waves(WARP))
    assert float(error[:, 1].square().mean().sqrt()) < 0.01
    assert float(before[:, 1].square().mean().sqrt()) > 0.02


def test_brightness_may_have_a_slope() -> None:
    ramp = torch.arange(SIZE[0]).double() * 0.5 - torch.arange(SIZE[1]).double()[:, None] * 0.3
    error = errors(waves(WARP) + ramp)
    assert float(error[:, 1].square().mean().sqrt()) < 0.01


def test_windows_are_blurred_as_the_other_image_is() -> None:
    """What optics of the other image did to it there: both blurs together, seen from either side."""
    # Whole pixels in both images, so that nothing is interpolated.
    left = torch.tensor([[120.0 + 8.0 * i, 120.0 + 14.0 * j] for i in range(12) for j in range(6)]).double()
    right = ((left - MIDDLE) @ WARP.T + MIDDLE).round()
    one, two = (waves(warp, optics=0.0) for warp in (torch.eye(2).double(), WARP))
    plain = sample(image_windows(one, left[:, None], 0, math.inf), left[:, None])
    warped = sample(warped_blur_windows(two, right[:, None], WARP.expand(len(left), 2, 2)), right[:, None])
    alike = sample(image_windows(two, right[:, None], 0, math.inf), right[:, None])
    # Kernels end at three standard deviations.
    assert float((plain - warped).abs().max()) < 1e-3 * float(plain.std())
    assert float((plain - alike).abs().max()) > 0.1 * float(plain.std())
