"""The difference of two cameras: what a turn undoes does not count, and error bars tell whether the rest is chance."""

from __future__ import annotations

import math

import pytest
import torch

from kcal.errors import InputError
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.difference import camera_difference
from kcal.lens.pose import rotation_from_vector

CAMERA = Camera.build(focal=(800, 810), center=(320, 240), size=(640, 480), coefficients=[-0.1, 0.02, 1e-3, 0, 0])
SPREAD = torch.tensor([1.0, 1, 2, 2, 0, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4], dtype=torch.float64)


def drawn(generator: torch.Generator, factor: float = 1.0) -> Camera:
    """A camera whose parameters are off by `factor` times what its covariance says."""
    noise = factor * SPREAD * torch.randn(10, generator=generator, dtype=torch.float64)
    camera = CAMERA.with_parameters(CAMERA.params + noise)
    camera.calibration = CameraCalibration(covariance=torch.diag(SPREAD**2))
    return camera


def test_no_rotation_fits_better() -> None:
    other = Camera.build(focal=(802, 811), center=(323, 238), size=(640, 480), coefficients=[-0.11, 0.03])
    found = camera_difference(CAMERA, other)
    best = float(found.shift.square().sum())
    for axis in range(3):
        for angle in (-1e-5, 1e-5):
            step = torch.zeros(3, dtype=torch.float64)
            step[axis] = angle
            turned = camera_difference(CAMERA, other, rotation=rotation_from_vector(step) @ found.rotation)
            assert float(turned.shift.square().sum()) > best
    assert found.rms < camera_difference(CAMERA, other, rotation=torch.eye(3)).rms / 3


def test_at_a_distance_a_shift_counts_too() -> None:
    """A longer focal length is nearly a camera that stands nearer."""
    other = CAMERA.with_parameters(CAMERA.params * torch.tensor([1.01, 1.01] + [1.0] * 8, dtype=torch.float64))
    far, near = camera_difference(CAMERA, other), camera_difference(CAMERA, other, at=2.0)
    assert near.rms < 0.2 * far.rms
    assert float(near.translation[2]) == pytest.approx(2.0 * 0.01, rel=0.2)
    assert far.translation.tolist() == [0, 0, 0]


def test_cameras_that_agree_differ_at_the_stated_rate() -> None:
    generator = torch.Generator().manual_seed(0)
    found = [camera_difference(drawn(generator), drawn(generator), grid=(17, 13)) for _ in range(40)]
    refused = sum(not each.same for each in found)
    # 2 of 40 are expected; more than 7 have a probability of 5e-4.
    assert refused <= 7
    assert 10 <= sum((each.probability or 0) < 0.5 for each in found) <= 30


def test_a_real_change_is_seen() -> None:
    generator = torch.Generator().manual_seed(1)
    found = camera_difference(drawn(generator), drawn(generator, 8.0))
    assert found.same is False
    assert found.ratio is not None
    assert found.ratio > 2


def test_without_error_bars_nothing_is_claimed() -> None:
    found = camera_difference(CAMERA, CAMERA)
    assert (found.same, found.ratio, found.sigma, found.known) == (None, None, None, (False, False))
    one = camera_difference(drawn(torch.Generator().manual_seed(2)), CAMERA)
    assert one.known == (True, False)
    assert one.sigma is not None


def test_the_angle_of_the_turn() -> None:
    turn = rotation_from_vector(torch.tensor([0.0, math.radians(2.0), 0.0], dtype=torch.float64))
    assert camera_difference(CAMERA, CAMERA, rotation=turn).turn_deg == pytest.approx(2.0)


def test_refusals() -> None:
    small = Camera.build(focal=(800, 800), center=(160, 120), size=(320, 240))
    with pytest.raises(InputError, match="640x480 and 320x240"):
        camera_difference(CAMERA, small)
    with pytest.raises(InputError, match="positive distance"):
        camera_difference(CAMERA, CAMERA, at=0.0)
