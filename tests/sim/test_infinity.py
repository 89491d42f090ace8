"""Error at infinity: nothing for a turned camera, the right number for a wrong one, NaN where nothing is seen."""

from __future__ import annotations

import pytest
import torch

from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector
from scripts.shared.infinity import error_at_infinity

SIZE = (640, 480)


def camera(**changes: object) -> Camera:
    arguments: dict = {"focal": (500, 500), "center": (319.5, 239.5), "coefficients": [-0.2, 0.05]} | changes
    return Camera.build(size=SIZE, **arguments)


class Turned:
    """A camera that looks elsewhere."""

    size = SIZE
    focal = torch.tensor([500.0, 500.0])

    def __init__(self, inner: Camera, rotation: torch.Tensor) -> None:
        self.inner, self.rotation = inner, rotation

    def unproject(self, pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        rays, valid = self.inner.unproject(pixels)
        return rays @ self.rotation.T, valid

    def project(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.inner.project(points @ self.rotation)

    def inside(self, pixels: torch.Tensor) -> torch.Tensor:
        return self.inner.inside(pixels)


def test_a_turned_camera_has_no_error() -> None:
    turn = rotation_from_vector(torch.tensor([0.02, -0.05, 0.1], dtype=torch.float64))
    found = error_at_infinity(camera(), Turned(camera(), turn))
    assert found.maximum < 1e-8
    torch.testing.assert_close(found.rotation, turn.T, atol=1e-10, rtol=0)
    assert found.valid == 1.0


def test_another_focal_length_is_a_zoom() -> None:
    found = error_at_infinity(camera(focal=(501, 501)), camera())
    centered = found.pixels - torch.tensor([319.5, 239.5])
    torch.testing.assert_close(found.errors, 0.002 * centered, atol=2e-6, rtol=0)
    assert found.rms == pytest.approx(float((0.002 * centered).pow(2).sum(-1).mean().sqrt()), rel=1e-6)
    assert found.maximum == pytest.approx(0.002 * float(centered.norm(dim=-1).max()), rel=1e-5)


def test_no_rotation_does_better() -> None:
    found = error_at_infinity(camera(center=(324.5, 236.5)), camera())
    rays = camera().unproject(found.pixels.reshape(-1, 2))[0]
    for axis in torch.eye(3, dtype=torch.float64):
        for sign in (-1e-5, 1e-5):
            turn = rotation_from_vector(sign * axis) @ found.rotation
            seen = camera(center=(324.5, 236.5)).project(rays @ turn.T * 1e9)[0]
            assert float((seen - found.pixels.reshape(-1, 2)).pow(2).sum(-1).mean().sqrt()) > found.rms


def test_what_a_folding_lens_does_not_see_is_nan() -> None:
    folding = camera(coefficients=[-0.9, 0.1])
    found = error_at_infinity(folding, camera())
    assert 0.1 < found.valid < 0.95
    assert float(torch.isnan(found.errors).any(-1).double().mean()) == pytest.approx(1 - found.valid)


def test_sizes_must_agree() -> None:
    other = Camera.build(focal=(500, 500), center=(300, 200), size=(600, 400))
    with pytest.raises(InputError, match="same size"):
        error_at_infinity(other, camera())
