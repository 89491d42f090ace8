"""Gradients through `Camera`: to points, pixels and parameters, and second derivatives of the inverse."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from lenses import MODELS, distort_with_jacobian, parameters, strong
from torch import Tensor, nn
from torch.autograd import gradcheck, gradgradcheck
from torch.func import functional_call, jacrev

from kcal.lens.camera import Camera
from kcal.lens.inverse import undistort

POINTS = torch.tensor([[0.1, -0.2, 1.1], [-0.6, 0.5, 1.3], [1.2, 0.9, 2.5]], dtype=torch.float64)


class Method(nn.Module):
    """Makes a method of a camera reachable for `functional_call`."""

    def __init__(self, camera: Camera, name: str) -> None:
        super().__init__()
        self.camera, self.name = camera, name

    def forward(self, value: Tensor) -> tuple[Tensor, Tensor]:
        return getattr(self.camera, self.name)(value)


def of_parameters(camera: Camera, name: str) -> Callable[[Tensor, Tensor], Tensor]:
    module = Method(camera, name)

    def function(value: Tensor, vector: Tensor) -> Tensor:
        result, valid = functional_call(module, {"camera.params": vector}, (value,))
        assert bool(valid.all())
        return result

    return function


def small_camera(model: str) -> Camera:
    return Camera(parameters(model, strong(model)), size=(4, 3), model=model)


@pytest.mark.parametrize("model", ["pinhole", *MODELS])
def test_first_derivatives(model: str) -> None:
    vector = parameters(model, strong(model))
    camera = Camera(vector, size=(4, 3), model=model)
    pixels = camera.project(POINTS)[0]
    vector.requires_grad_(True)
    # gradcheck's numbers are second-order differences with step 1e-6: 1e-8 is what they can show.
    tolerance = {"eps": 1e-6, "atol": 1e-8, "rtol": 1e-6}
    assert gradcheck(of_parameters(camera, "project"), (POINTS.clone().requires_grad_(True), vector), **tolerance)
    assert gradcheck(of_parameters(camera, "unproject"), (pixels.clone().requires_grad_(True), vector), **tolerance)


@pytest.mark.parametrize("model", ["opencv5", "opencv14", "ext20"])
def test_second_derivatives_of_the_inverse(model: str) -> None:
    vector = parameters(model, strong(model))
    camera = Camera(vector, size=(4, 3), model=model)
    pixels = camera.project(POINTS)[0].requires_grad_(True)
    vector.requires_grad_(True)
    assert gradgradcheck(of_parameters(camera, "unproject"), (pixels, vector), eps=1e-6, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("model", MODELS)
def test_inverse_has_the_inverse_jacobian(model: str) -> None:
    """The implicit function theorem, written out: dx/dx_D = J⁻¹ and dx/dc = -J⁻¹ ∂x_D/∂c."""
    lens = strong(model)
    normalized = POINTS[:, :2] / POINTS[:, 2:]
    distorted, by_point, by_coefficients = distort_with_jacobian(normalized, lens, model)
    inverse = torch.linalg.inv(by_point)
    for n in range(len(POINTS)):

        def solve(target: Tensor, coefficients: Tensor) -> Tensor:
            return undistort(target[None], coefficients, model)[0][0]

        target = distorted[n].clone()
        by_target, by_lens = jacobian(solve, target, lens)
        # Newton stops within 1e-13 of the root; J there differs from J at the root by as much.
        torch.testing.assert_close(by_target, inverse[n], rtol=0, atol=1e-11)
        torch.testing.assert_close(by_lens, -inverse[n] @ by_coefficients[n], rtol=0, atol=1e-11)


def jacobian(function: Callable[[Tensor, Tensor], Tensor], *inputs: Tensor) -> tuple[Tensor, Tensor]:
    by_target, by_lens = torch.autograd.functional.jacobian(function, inputs)
    return by_target, by_lens


def test_invalid_pixels_leave_no_nan_in_gradients() -> None:
    # k1 alone folds at r = sqrt(1 / 0.9), r_D = 0.70: the second and third pixels have no preimage.
    camera = Camera.build(focal=(100, 100), center=(50, 50), size=(101, 101), coefficients=[-0.3], model="opencv4")
    camera.requires_grad_(True)
    pixels = torch.tensor([[60.0, 50.0], [300.0, 50.0], [float("nan"), 50.0]], dtype=torch.float64, requires_grad=True)
    rays, valid = camera.unproject(pixels)
    assert valid.tolist() == [True, False, False]
    rays[..., 0].sum().backward()
    assert pixels.grad is not None
    assert camera.params.grad is not None
    assert bool(torch.isfinite(camera.params.grad).all())
    assert pixels.grad[1].tolist() == [0.0, 0.0]
    assert float(pixels.grad[0, 0]) > 0.009


def test_invalid_points_leave_no_nan_in_gradients() -> None:
    camera = small_camera("opencv14").requires_grad_(True)
    points = torch.tensor([[0.1, 0.1, 1.0], [0.0, 0.0, 0.0], [1.0, 1.0, -1.0], [float("nan"), 0.0, 1.0]]).double()
    points.requires_grad_(True)
    pixels, valid = camera.project(points)
    assert valid.tolist() == [True, False, False, False]
    assert bool(torch.isfinite(pixels).all())
    pixels.sum().backward()
    assert points.grad is not None
    assert camera.params.grad is not None
    assert bool(torch.isfinite(camera.params.grad).all())
    assert torch.equal(points.grad[1:], torch.zeros(3, 3, dtype=torch.float64))


def test_gradients_reach_through_low_precision_inputs() -> None:
    camera = small_camera("opencv5")
    points = POINTS.to(torch.float32).requires_grad_(True)
    camera.project(points)[0].sum().backward()
    assert points.grad is not None
    assert points.grad.dtype == torch.float32
    expected = jacrev(lambda value: camera.project(value)[0].sum())(POINTS.to(torch.float32).double())
    torch.testing.assert_close(points.grad, expected.float(), rtol=0, atol=0)
