"""The focal length on the optical axis: against projections a little off it, and its σ against drawn cameras."""

from __future__ import annotations

import math

import pytest
import torch
from lenses import FEW_MODES, HYBRID, KINDS, hybrid_camera, strong
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.information import CameraInformation
from kcal.lens.model import PRESETS
from kcal.lens.projection import FAR, project_components
from kcal.lens.uncertainty import ParaxialFocal, paraxial_focal

PLAIN = [name for name, model in PRESETS.items() if not model.tilt]


def strong_camera(model: str) -> Camera:
    head = torch.tensor([520.0, 515.0, 325.0, 235.0, 0.4], dtype=torch.float64)
    return Camera(torch.cat([head, strong(model)]), size=(640, 480), model=model)


STEP = 1e-3
ENDS = torch.tensor([-2.0, -1.0, 1.0, 2.0], dtype=torch.float64) * STEP
WEIGHT = torch.tensor([1.0, -8.0, 8.0, -1.0], dtype=torch.float64) / (12.0 * STEP)


def near_the_axis(camera: Camera, values: Tensor | None = None) -> Tensor:
    """(..., 2) from pixels of directions a step off the axis, by differences of fourth order.

    Of the camera, or of its lens with other values (..., 5 + P): cameras take long to make.
    """
    found = []
    for axis in (0, 1):
        rays = torch.zeros(4, 3, dtype=torch.float64)
        rays[:, 2], rays[:, axis] = 1.0, ENDS
        if values is None:
            pixels, valid = camera.project_rays(rays)
            assert bool(valid.all())
        else:
            points = (FAR * rays.T).expand(*values.shape[:-1], -1, -1)
            pixels = project_components(points, values, camera.model).pixels.mT
        found.append(pixels[..., axis] @ WEIGHT)
    return torch.stack(found, -1)


@pytest.mark.parametrize("kind", [*KINDS, *PRESETS])
def test_it_is_the_derivative_of_the_projection(kind: str) -> None:
    camera = hybrid_camera(kind, modes=FEW_MODES) if kind in KINDS else strong_camera(kind)
    torch.testing.assert_close(paraxial_focal(camera).value, near_the_axis(camera), rtol=1e-8, atol=0)


@pytest.mark.parametrize("model", PLAIN)
def test_of_a_parametric_lens_without_tilt_it_is_the_parameter(model: str) -> None:
    camera = strong_camera(model)
    assert paraxial_focal(camera).value.tolist() == camera.focal.tolist()


def test_of_others_it_is_not() -> None:
    tilted, field = (
        strong_camera("opencv14"),
        Camera(
            torch.cat([torch.tensor([520.0, 520.0, 325.0, 235.0, 0.0]).double(), strong(HYBRID)]),
            size=(640, 480),
            model=HYBRID,
        ),
    )
    for camera in (tilted, field):
        assert float((paraxial_focal(camera).value / camera.focal - 1.0).abs().min()) > 1e-4


@pytest.mark.parametrize("kind", ["hybrid", "opencv14"])
@pytest.mark.parametrize("by", ["covariance", "information"])
def test_sigma_is_the_scatter_of_cameras_drawn(kind: str, by: str) -> None:
    """fx and the field nearly make up for each other, as in a calibration; what is left must be right."""
    camera = strong_camera("opencv14") if kind == "opencv14" else hybrid_camera("webcam", modes=FEW_MODES)
    generator = torch.Generator().manual_seed(3)
    mean = camera.params.detach()
    count = len(mean)
    root = 1e-6 * torch.randn(count, count, generator=generator, dtype=torch.float64)
    root[:, :2] = 0.5 * torch.randn(count, 1, generator=generator, dtype=torch.float64)
    if kind == "hybrid":
        # fx together with the weight that makes up for it on the axis, but for a hundredth.
        steps = 1e-3 * torch.eye(count, dtype=torch.float64)
        slopes = (near_the_axis(camera, mean + steps) - near_the_axis(camera, mean)).mean(1)
        weight = 8 + int(slopes[8:].abs().argmax())
        root[:, weight] -= 0.99 * root[:, 0] * float(slopes[:2].sum() / slopes[weight])
    covariance = root.T @ root
    if by == "covariance":
        known = CameraCalibration(covariance=covariance)
    else:
        known = CameraCalibration(information=CameraInformation.from_covariance(mean, covariance))
    drawn = torch.randn(2000, count, generator=generator, dtype=torch.float64) @ root
    camera = camera.with_parameters(mean)
    camera.calibration = known
    found, values = paraxial_focal(camera), near_the_axis(camera, mean + drawn)
    if kind == "hybrid":
        assert float(found.sigma.max()) < 0.2 * float(covariance[0, 0].sqrt())
    # The σ of 2000 draws is known to 1.6 %.
    torch.testing.assert_close(found.sigma, values.std(0), rtol=0.07, atol=0)
    assert found.mean[1] == pytest.approx(float(values.mean(1).std()), rel=0.07)
    assert found.aspect[1] == pytest.approx(float((values[:, 1] / values[:, 0]).std()), rel=0.07)


def test_without_error_bars_sigma_is_unknown() -> None:
    camera = strong_camera("opencv5")
    assert bool(paraxial_focal(camera).sigma.isnan().all())
    assert str(paraxial_focal(camera)) == "520.000 px along rows, 515.000 px along columns"
    camera.calibration = CameraCalibration(sigma={"fx": 0.5, "fy": None})
    assert bool(paraxial_focal(camera).sigma.isnan().all())
    camera.calibration = CameraCalibration(sigma={"fx": 0.5, "fy": 0.25})
    assert paraxial_focal(camera).sigma.tolist() == [0.5, 0.25]
    tilted = strong_camera("opencv14")
    # How the tilt varies together with fx, sigmas do not tell.
    tilted.calibration = CameraCalibration(sigma=dict.fromkeys(tilted.names, 0.5))
    assert bool(paraxial_focal(tilted).sigma.isnan().all())


def test_one_number_where_both_are_equal_as_far_as_is_known() -> None:
    value, covariance = torch.tensor([500.0, 501.0]).double(), torch.tensor([[1.0, 0.9], [0.9, 1.0]]).double()
    assert ParaxialFocal(value, covariance.diagonal().sqrt(), covariance).aspect[1] == pytest.approx(9e-4, rel=0.02)
    assert str(ParaxialFocal(value, covariance.diagonal().sqrt(), covariance)) == "500.50 ± 0.97 px"
    sure = 0.1 * covariance
    text = "500.00 ± 0.32 px along rows, 501.00 ± 0.32 px along columns"
    assert str(ParaxialFocal(value, sure.diagonal().sqrt(), sure)) == text


def test_a_batch_is_refused() -> None:
    camera = strong_camera("opencv5")
    with pytest.raises(InputError, match="single camera"):
        paraxial_focal(Camera(camera.params.detach().expand(2, -1).clone(), size=(640, 480), model="opencv5"))
    assert math.isfinite(paraxial_focal(camera).mean[0])
