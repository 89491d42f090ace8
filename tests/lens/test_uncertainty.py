"""Uncertainty of far directions: what a change of a parameter does to the image after the best turn."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch
from lenses import HYBRID, strong

from kcal.errors import InputError
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.uncertainty import image_sigma, pixel_covariance, projection_sigma
from scripts.shared.infinity import error_at_infinity

SIZE = (640, 480)


def hybrid() -> Camera:
    head = torch.tensor([520.0, 520.0, 325.0, 235.0, 0.0], dtype=torch.float64)
    return Camera(torch.cat([head, 0.2 * strong(HYBRID)]), size=SIZE, model=HYBRID)


CAMERAS = {
    "opencv5": Camera.build(
        focal=(500, 505), center=(325, 235), size=SIZE, coefficients=[-0.2, 0.05, 1e-3, -5e-4, 0.0]
    ),
    "hybrid": hybrid(),
}


@pytest.mark.parametrize(
    ("kind", "name"), [(k, n) for k in CAMERAS for n in ("fx", "cx", "cy")] + [("hybrid", "shape")]
)
def test_a_parameter_moves_the_image_by_as_much(kind: str, name: str) -> None:
    """Independent of the formulas: the changed camera compared with the first one after a turn found by search."""
    camera = CAMERAS[kind]
    place = camera.names.index(name)
    step = 1e-3 * (1.0 if name != "shape" else 1e-3)
    changed = camera.params.detach().clone()
    changed[place] += step
    found = error_at_infinity(camera.with_parameters(changed), camera, columns=25, rows=17)
    unit = torch.zeros(len(camera.names), len(camera.names), dtype=torch.float64)
    unit[place, place] = step**2
    predicted = pixel_covariance(camera, camera.grid(25, 17), unit)
    # To first order in the step.
    assert float(predicted.diagonal(dim1=-2, dim2=-1).sum(-1).mean().sqrt()) == pytest.approx(found.rms, rel=2e-3)
    # In each place, along its own direction.
    length = found.errors[..., :, None] * found.errors[..., None, :]
    torch.testing.assert_close(length, predicted, rtol=0, atol=2e-2 * float(predicted.max()))


def test_a_turn_is_no_uncertainty() -> None:
    """Far away a pinhole's shift and turn are nearly the same: what is left is small, and smallest in the middle."""
    camera = Camera.build(focal=(5000, 5000), center=(319.5, 239.5), size=SIZE, model="pinhole")
    shift = torch.zeros(5, 5, dtype=torch.float64)
    shift[2, 2] = 1.0
    sigma = image_sigma(dataclass_camera(camera, shift))
    assert float(sigma.max()) < 0.005
    assert sigma.shape == (25, 33)


def dataclass_camera(camera: Camera, covariance: torch.Tensor) -> Camera:
    camera.calibration = dataclasses.replace(CameraCalibration(), covariance=covariance)
    return camera


@pytest.mark.parametrize("at", [0.5, 20.0, math.inf])
def test_projection_sigma_near_and_far(at: float) -> None:
    """Pixels and their rays agree; a change of the pupil moves what is near, by f ζ θ² sin θ cos θ / distance."""
    camera = CAMERAS["hybrid"]
    pupil = camera.names.index("pupil1")
    covariance = torch.zeros(len(camera.names), len(camera.names), dtype=torch.float64)
    covariance[pupil, pupil] = 1e-6
    known = dataclass_camera(camera.with_parameters(camera.params.detach().clone()), covariance)
    pixels = torch.tensor([[100.0, 235.0], [325.0, 235.0], [600.0, 400.0]], dtype=torch.float64)
    rays, valid = known.unproject(pixels)
    assert bool(valid.all())
    found = projection_sigma(known, pixels, at=at)
    torch.testing.assert_close(found, projection_sigma(known, 7.0 * rays, at=at), rtol=1e-6, atol=1e-9)
    if math.isinf(at):
        # To the rounding of rays that are followed for 1e12 m.
        assert float(found.abs().max()) < 1e-9
        return
    moved = known.params.detach().clone()
    moved[pupil] += 1e-3
    points = known.ray_origins(rays) + at * rays
    there, _ = known.with_parameters(moved).project(points)
    torch.testing.assert_close(found, (there - pixels).norm(dim=-1), rtol=0.02 / at, atol=1e-4)


def test_refusals() -> None:
    camera = Camera.build(focal=(500, 500), center=(319.5, 239.5), size=SIZE, model="pinhole")
    pixels = torch.tensor([[1.0, 2.0]], dtype=torch.float64)
    with pytest.raises(InputError, match="no covariance"):
        pixel_covariance(camera, pixels)
    with pytest.raises(InputError, match=r"\(5, 5\)"):
        pixel_covariance(camera, pixels, torch.eye(3, dtype=torch.float64))
    with pytest.raises(InputError, match="positive distance"):
        pixel_covariance(camera, pixels, torch.eye(5, dtype=torch.float64), at=0.0)
    many = Camera(camera.params.detach().expand(2, -1).clone(), size=SIZE, model="pinhole")
    with pytest.raises(InputError, match="single camera"):
        pixel_covariance(many, pixels)
