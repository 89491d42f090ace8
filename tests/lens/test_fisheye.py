"""The fisheye: OpenCV's and kornia's values, what an angle is, derivatives, and a round trip to behind the camera."""

import math

import cv2
import numpy as np
import pytest
import torch
from differences import numeric
from kornia.geometry.camera import distort_points_kannala_brandt
from torch import Tensor
from torch.func import jacfwd

from kcal.lens.camera import Camera
from kcal.lens.model import PRESETS, LensModel
from kcal.lens.projection import angle_over_distance, project_components
from scripts.shared.distorted import distort

FISHEYE = PRESETS["fisheye4"]
COEFFICIENTS = [0.03, -0.012, 0.004, -0.0007]
# As for the other models: pixels near 1000 carry 1e-13 of rounding.
TOLERANCE = 1e-11


def make_camera(alpha: float = 0.0, coefficients: list[float] | None = None) -> Camera:
    lens = COEFFICIENTS if coefficients is None else coefficients
    return Camera.build(
        focal=(700, 710), center=(640, 360), size=(1280, 720), coefficients=lens, model="fisheye4", skew=alpha * 700
    )


def test_opencv_values_live() -> None:
    points, zero, lens = points_to(89.9, 2000), np.zeros(3), np.array(COEFFICIENTS)
    matrix, camera = np.array([[700.0, 0, 640], [0, 710, 360], [0, 0, 1]]), make_camera(0.003)
    expected, _ = cv2.fisheye.projectPoints(points.numpy()[:, None], zero, zero, matrix, lens, alpha=0.003)
    pixels, valid = camera.project(points)
    assert bool(valid.all())
    assert float((pixels - torch.from_numpy(expected[:, 0])).abs().max()) < TOLERANCE


def test_kornia_values() -> None:
    points = points_to(88.0, 500)
    camera = make_camera()
    parameters = torch.tensor([700.0, 710.0, 640.0, 360.0, *COEFFICIENTS], dtype=torch.float64)
    expected = distort_points_kannala_brandt(points[:, :2] / points[:, 2:], parameters)
    assert float((camera.project(points)[0] - expected).abs().max()) < TOLERANCE


def points_to(degrees: float, count: int) -> Tensor:
    """Points up to so many degrees off axis, 1 to 50 m away."""
    angle, turn, distance = torch.rand(3, count, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    angle, turn, distance = math.radians(degrees) * angle, 2 * math.pi * turn, 1 + 49 * distance
    flat = torch.stack([torch.sin(angle) * torch.cos(turn), torch.sin(angle) * torch.sin(turn), torch.cos(angle)], -1)
    return distance[:, None] * flat


class TestAngles:
    ideal = make_camera(coefficients=[0.0] * 4)

    def test_radius_is_the_angle(self) -> None:
        points = torch.tensor([[1.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, -1.0]], dtype=torch.float64)
        pixels, valid = self.ideal.project(points)
        assert valid.tolist() == [True] * 3
        expected = torch.tensor(
            [[640 + 700 * math.pi / 4, 360], [640 + 700 * math.pi / 2, 360], [640, 360 + 710 * math.pi * 3 / 4]],
            dtype=torch.float64,
        )
        torch.testing.assert_close(pixels, expected, rtol=0, atol=1e-12)

    def test_what_has_no_place(self) -> None:
        # Straight behind, at the center of projection, and not finite.
        points = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [torch.nan, 0.0, 1.0]], dtype=torch.float64)
        pixels, valid = self.ideal.project(points)
        assert valid.tolist() == [False] * 3
        assert pixels.tolist() == [[640.0, 360.0]] * 3

    def test_no_normalized_coordinates_beside_the_camera(self) -> None:
        pixels = self.ideal.project(torch.tensor([[1.0, 0.0, 1.0], [1.0, 0.0, 0.0], [1.0, 0.0, -1.0]]).double())[0]
        assert self.ideal.unproject(pixels)[1].tolist() == [True] * 3
        normalized, valid = self.ideal.normalize(pixels)
        assert valid.tolist() == [True, False, False]
        torch.testing.assert_close(normalized[0], torch.tensor([1.0, 0.0]).double(), rtol=0, atol=1e-14)

    def test_the_lens_ends_where_the_radius_does(self) -> None:
        # θ - θ³/12 turns back at θ = 2.
        camera = make_camera(coefficients=[-1 / 12, 0.0, 0.0, 0.0])
        assert float(camera.valid_radius) == pytest.approx(2.0, abs=1e-12)
        angles = torch.tensor([1.99, 2.01], dtype=torch.float64)
        points = torch.stack([torch.sin(angles), torch.zeros(2).double(), torch.cos(angles)], -1)
        assert camera.project(points)[1].tolist() == [True, False]
        edge = 640 + 700 * (2 - 8 / 12)
        pixels = torch.tensor([[edge - 1e-3, 360.0], [edge + 1e-3, 360.0]], dtype=torch.float64)
        assert camera.unproject(pixels)[1].tolist() == [True, False]


def test_round_trip_to_170_degrees() -> None:
    camera = make_camera(0.002, [0.01, -0.002, 1e-4, -1e-5])
    points = points_to(170.0, 3000)
    pixels, valid = camera.project(points)
    assert bool(valid.all())
    rays, found = camera.unproject(pixels)
    assert bool(found.all())
    directions = points / torch.linalg.vector_norm(points, dim=-1, keepdim=True)
    torch.testing.assert_close(rays, directions, rtol=0, atol=1e-12)


# (3, N): on the axis, beside it, at the series' ends, at 90 degrees, and behind the camera.
PLACES = torch.tensor(
    [
        [0.0, 1e-9, 0.1, 0.099, 0.5, -1.0, 2.0, -0.8],
        [0.0, 1e-9, 0.0, 0.0, -0.4, 1.2, 0.3, 0.9],
        [1.5, 1.0, 1.0, 1.0, 0.9, 0.0, 0.4, -0.7],
    ],
    dtype=torch.float64,
)


def test_angles_by_both_formulas() -> None:
    """Where derivatives are recorded, others are used; on the axis behind the camera there is no such ratio."""
    X, Y, Z = torch.cat([PLACES, torch.tensor([[0.0], [0.0], [-1.0]]).double()], 1)
    plain = angle_over_distance(X, Y, Z)
    smooth = angle_over_distance(X.clone().requires_grad_(True), Y, Z).detach()
    torch.testing.assert_close(plain[:-1], smooth[:-1], rtol=4e-15, atol=0)
    assert not plain[-1].isfinite()
    assert not smooth[-1].isfinite()


class TestDerivatives:
    parameters = torch.tensor([2.1, 1.7, 0.3, -0.2, 0.05, 0.05, -0.03, 0.02, -0.01], dtype=torch.float64)

    def test_by_camera(self) -> None:
        def pixels(values: Tensor) -> Tensor:
            return project_components(PLACES, values, FISHEYE).pixels

        for at in (self.parameters, torch.cat([self.parameters[:5], torch.zeros(4, dtype=torch.float64)])):
            analytic = project_components(PLACES, at, FISHEYE, range(9)).by_camera.movedim(-3, -1)
            torch.testing.assert_close(analytic, jacfwd(pixels)(at), rtol=1e-12, atol=1e-14)
            torch.testing.assert_close(analytic, numeric(pixels, at, 1e-3), rtol=0, atol=1e-10)

    def test_by_point(self) -> None:
        result = project_components(PLACES, self.parameters, FISHEYE, range(9))
        for n in range(PLACES.shape[1]):

            def pixels(point: Tensor) -> Tensor:
                return project_components(point[:, None], self.parameters, FISHEYE).pixels[:, 0]

            point, analytic = PLACES[:, n], result.by_point[..., n].T
            torch.testing.assert_close(analytic, jacfwd(pixels)(point), rtol=1e-11, atol=1e-13)
            # Fourth-order differences, step 1e-3: truncation is larger where angles change fast, beside the camera.
            torch.testing.assert_close(analytic, numeric(pixels, point, 1e-3), rtol=0, atol=1e-9)

    def test_gradients_of_the_inverse(self) -> None:
        camera = make_camera()
        pixels = camera.project(points_to(80.0, 5))[0].detach().requires_grad_(True)

        assert torch.autograd.gradcheck(lambda p: camera.unproject(p)[0], (pixels,), atol=1e-8)
        assert torch.autograd.gradgradcheck(lambda p: camera.unproject(p)[0], (pixels,), atol=1e-6)

    def test_other_orders(self) -> None:
        # Any number of coefficients; two are the first two of four.
        short = LensModel(numerator=2, fisheye=True)
        assert short.names == ("k1", "k2")
        at = torch.tensor([[0.3, -0.4]], dtype=torch.float64)
        two = distort(at, torch.tensor([0.05, -0.03]), short)
        torch.testing.assert_close(two, distort(at, torch.tensor([0.05, -0.03, 0, 0]), FISHEYE), rtol=0, atol=1e-16)
