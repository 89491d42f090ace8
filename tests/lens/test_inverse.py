"""The inverse is right or says that it is not: round trips, folds, poles, and pixels that nothing maps to."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from lenses import HYBRID, MODELS, distort_with_jacobian, parameters, strong
from torch import Tensor

from kcal import Camera, InputError
from kcal.lens import LensModel
from kcal.lens.inverse import _FAR, _edge_fraction, undistort
from kcal.lens.projection import largest_radius
from kcal.lens.region import valid_region
from scripts.shared.distorted import distort

# Newton stops at 1e-13 in normalized coordinates, which is 2e-10 px at 2000 px of focal length.
PIXEL_TOLERANCE = 1e-9


def image_grid(camera: Camera, columns: int = 33, rows: int = 19) -> Tensor:
    width, height = camera.size
    u = torch.linspace(-0.5, width - 0.5, columns, dtype=torch.float64)
    v = torch.linspace(-0.5, height - 0.5, rows, dtype=torch.float64)
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), -1).reshape(-1, 2)


def check_round_trip(camera: Camera, pixels: Tensor) -> Tensor:
    """Where the inverse claims to be valid, projecting the ray gives the pixel again. Returns the mask."""
    rays, valid = camera.unproject(pixels)
    assert bool(torch.isfinite(rays).all())
    torch.testing.assert_close(
        torch.linalg.vector_norm(rays, dim=-1), torch.ones_like(rays[..., 0]), rtol=0, atol=1e-15
    )
    again, projected = camera.project(camera.ray_origins(rays[valid]) + rays[valid] * 7.0)
    assert bool(projected.all())
    error = torch.linalg.vector_norm(again - pixels[valid], dim=-1)
    assert bool((error < allowed_error(camera, camera.normalize(pixels)[0])[valid]).all())
    return valid


def allowed_error(camera: Camera, normalized: Tensor) -> Tensor:
    """1e-9 px, and more only beside a pole, where the lens magnifies the rounding of the ray itself."""
    jacobian = distort_with_jacobian(normalized, camera.coefficients, camera.model)[1]
    steepest = torch.linalg.matrix_norm(jacobian, ord=2)
    rounding = 4 * torch.finfo(torch.float64).eps * (1 + torch.linalg.vector_norm(normalized, dim=-1))
    return PIXEL_TOLERANCE + rounding * steepest * camera.focal.amax(-1)[..., None]


class TestRoundTrip:
    @pytest.mark.parametrize("model", ["pinhole", *MODELS, HYBRID], ids=str)
    def test_strong_lens(self, model: str | LensModel) -> None:
        vector = parameters(model, strong(model))
        vector[:5] = torch.tensor([2000.0, 2010.0, 950.0, 545.0, 2.0])
        camera = Camera(vector, size=(1920, 1080), model=model)
        # The corners lie 0.55 off axis, before any of these lenses folds: every pixel has a ray.
        assert bool(check_round_trip(camera, image_grid(camera)).all())

    @pytest.mark.parametrize("model", [*MODELS, HYBRID], ids=str)
    def test_from_points(self, model: str | LensModel) -> None:
        normalized = torch.rand(500, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 1.2 - 0.6
        back, valid = undistort(distort(normalized, strong(model), model), strong(model), model)
        assert bool(valid.all())
        # A residual of 1e-13 divided by the smallest singular value of J, 0.3 here.
        torch.testing.assert_close(back, normalized, rtol=0, atol=1e-12)

    @pytest.mark.slow
    @settings(max_examples=15, deadline=None)
    @given(seed=st.integers(0, 2**31), scale=st.floats(0.01, 3.0), model=st.sampled_from(MODELS))
    def test_any_coefficients(self, seed: int, scale: float, model: str) -> None:
        """Random lenses, most of them absurd: four at a time, valid or flagged, never wrong."""
        generator = torch.Generator().manual_seed(seed)
        lens = torch.randn(4, LensModel.named(model).size, generator=generator, dtype=torch.float64) * scale * 0.3
        head = torch.tensor([2000.0, 1900.0, 960.0, 540.0, 1.0], dtype=torch.float64).expand(4, 5)
        camera = Camera(torch.cat([head, lens], -1), size=(1920, 1080), model=model)
        pixels = torch.rand(4, 40, 2, generator=generator, dtype=torch.float64) * 4000.0 - 1000.0
        rays, valid = camera.unproject(pixels)
        assert bool(torch.isfinite(rays).all())
        assert torch.equal(rays[~valid], torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(rays[~valid]))
        again, projected = camera.project(rays)
        assert bool(projected[valid].all())
        error = torch.linalg.vector_norm(again - pixels, dim=-1)
        assert bool((error < allowed_error(camera, camera.normalize(pixels)[0]))[valid].all())

    @pytest.mark.slow
    @settings(max_examples=15, deadline=None)
    @given(seed=st.integers(0, 2**31), scale=st.floats(0.01, 1.0), model=st.sampled_from(MODELS))
    def test_what_was_projected_is_found(self, seed: int, scale: float, model: str) -> None:
        """The other way round: a point that `project` calls valid comes back as the same ray."""
        generator = torch.Generator().manual_seed(seed)
        lens = torch.randn(4, LensModel.named(model).size, generator=generator, dtype=torch.float64) * scale * 0.1
        limit = valid_region(lens, model).radius.clamp(max=3.0)
        angle = torch.rand(4, 40, generator=generator, dtype=torch.float64) * 2 * math.pi
        # Within nine tenths of the fold; at the fold itself the inverse has no finite derivative.
        radius = 0.9 * limit[:, None] * torch.rand(4, 40, generator=generator, dtype=torch.float64)
        normalized = torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)], -1)
        distorted, jacobian, _ = distort_with_jacobian(normalized, lens, model)
        back, valid = undistort(distorted, lens, model)
        assert bool(valid.all())
        # The residual of 1e-13 (1 + r_D), divided by the smallest singular value of J.
        weakest = torch.linalg.svdvals(jacobian)[..., -1]
        allowed = 1e-12 * (1 + torch.linalg.vector_norm(distorted, dim=-1)) / weakest
        assert bool((torch.linalg.vector_norm(back - normalized, dim=-1) <= allowed).all())


class TestFold:
    # The camera of kornia issue 3273: 3840x2160; its corners have no preimage.
    kornia = Camera.build(
        focal=(1917.36, 1917.36),
        center=(1920, 1080),
        size=(3840, 2160),
        coefficients=[-0.2535, 0.0924, -0.0006, 0.0007, -0.0191],
        model="opencv5",
    )
    # The camera of OpenCV issue 20736: at its corners undistortPoints is wrong by hundreds of pixels.
    opencv = Camera.build(
        focal=(2421.791748046875, 2421.791748046875),
        center=(1919.6131591796875, 1090.346435546875),
        size=(3840, 2160),
        coefficients=[
            2.9972164630889893,
            -6.0928826332092285,
            0.0005746248061768711,
            -4.857033854932524e-05,
            -1.2618762254714966,
            3.5340938568115234,
            -4.270793914794922,
            -5.302351951599121,
        ],
        model="opencv8",
    )

    def test_flagged_exactly_where_no_preimage_is(self) -> None:
        """The image of the fold is the border: all pixels inside it are found, none outside."""
        camera = self.kornia
        pixels = image_grid(camera)
        valid = check_round_trip(camera, pixels)
        angle = torch.linspace(0, 2 * math.pi, 721, dtype=torch.float64)
        rim = float(camera.valid_radius) * torch.stack([torch.cos(angle), torch.sin(angle)], -1)
        outline = distort(rim, camera.coefficients, camera.model) * camera.focal + camera.center
        reach = torch.linalg.vector_norm(outline - camera.center, dim=-1)
        distance = torch.linalg.vector_norm(pixels - camera.center, dim=-1)
        # Tangential terms of 7e-4 make the border a little oval (1947 to 1972 px); in between, either is right.
        assert float(reach.max() - reach.min()) < 30.0
        inside, outside = distance < reach.min(), distance > reach.max()
        assert bool(valid[inside].all())
        assert not bool(valid[outside].any())
        assert int(outside.sum()) >= 40

    def test_rational_lens_with_a_pole_in_the_image(self) -> None:
        valid = check_round_trip(self.opencv, image_grid(self.opencv))
        assert 0 < int(valid.sum()) < len(valid)
        # The axis and its neighborhood are a sane lens all the same.
        assert bool(self.opencv.unproject(self.opencv.center[None] + 500.0)[1].all())

    def test_beyond_the_fold(self) -> None:
        # x - 0.3 x³ turns at x = 1/sqrt(0.9), where it is 2/3 of that.
        lens = torch.tensor([-0.3, 0.0, 0.0, 0.0], dtype=torch.float64)
        fold = 1 / math.sqrt(0.9)
        assert float(valid_region(lens, "opencv4").radius) == pytest.approx(fold, abs=1e-12)
        top = 2 / 3 * fold
        targets = torch.tensor([[top - 1e-6, 0.0], [top + 1e-6, 0.0], [0.0, -top - 1e-6], [5.0, 5.0]]).double()
        back, valid = undistort(targets, lens, "opencv4")
        assert valid.tolist() == [True, False, False, False]
        assert torch.equal(back[1:], torch.zeros(3, 2, dtype=torch.float64))
        # Of the two preimages of the first target, the one before the fold is the lens.
        assert 0 < float(back[0, 0]) < fold

    def test_a_pole_ends_the_lens(self) -> None:
        # 1 - 0.25 r² vanishes at r = 2.
        lens = torch.zeros(8, dtype=torch.float64)
        lens[5] = -0.25
        assert float(valid_region(lens, "opencv8").radius) == pytest.approx(2.0, abs=1e-12)
        camera = Camera.build(focal=(100, 100), center=(0, 0), size=(9, 9), coefficients=lens.tolist(), model="opencv8")
        _, valid = camera.project(torch.tensor([[1.99, 0, 1], [2.01, 0, 1], [9.0, 0, 1]]))
        assert valid.tolist() == [True, False, False]

    def test_a_lens_without_a_valid_disc(self) -> None:
        # Tilted by more than 90° even the axis is behind the sensor; nothing is valid, and nothing fails.
        lens = torch.zeros(14, dtype=torch.float64)
        lens[12] = 2.0
        assert float(valid_region(lens, "opencv14").radius) == 0.0
        assert undistort(torch.zeros(1, 2, dtype=torch.float64), lens, "opencv14")[1].tolist() == [False]

    def test_what_lies_beside_a_pole_is_found(self) -> None:
        # 1 - 0.25 r² vanishes at r = 2, and everything beyond r_D = 2 comes from just before the pole.
        lens = torch.zeros(8, dtype=torch.float64)
        lens[5] = -0.25
        normalized = torch.tensor([[1.0, 0.0], [1.5, 0.5], [0.0, -1.8], [1.3, 1.3]], dtype=torch.float64)
        back, valid = undistort(distort(normalized, lens, "opencv8"), lens, "opencv8")
        assert valid.tolist() == [True] * 4
        torch.testing.assert_close(back, normalized, rtol=0, atol=1e-13)

    def test_nothing_goes_wrong_in_a_pinhole(self) -> None:
        assert float(valid_region(torch.zeros(0), "pinhole").radius) == largest_radius(LensModel())
        assert float(valid_region(torch.tensor([0.1, 0.0, 0.0, 0.0]), "opencv4").radius) == largest_radius(LensModel())

    @settings(max_examples=15, deadline=None)
    @given(seed=st.integers(0, 2**31), model=st.sampled_from(MODELS))
    def test_the_disc_is_regular(self, seed: int, model: str) -> None:
        """Inside the valid radius, also between the directions that were walked, no fold and no pole is left."""
        generator = torch.Generator().manual_seed(seed)
        lens = torch.randn(8, LensModel.named(model).size, generator=generator, dtype=torch.float64) * 0.1
        # Radial terms only up to rounding of the 64 directions: with strong tangential terms the fold is no circle
        # and may reach in between two directions by 1 - cos(π / 64) = 0.1 %.
        limit = valid_region(lens, model).radius * 0.99
        angle = torch.rand(8, 400, generator=generator, dtype=torch.float64) * 2 * math.pi
        radius = limit[:, None] * torch.sqrt(torch.rand(8, 400, generator=generator, dtype=torch.float64))
        normalized = torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)], -1)
        _, jacobian, _ = distort_with_jacobian(normalized, lens, model)
        assert bool((torch.linalg.det(jacobian) > 0).all())


class TestOddInput:
    camera = Camera.build(
        focal=(1000, 1000), center=(640, 360), size=(1280, 720), coefficients=[-0.2, 0.05], model="opencv5"
    )

    def test_pixels_that_are_not_finite(self) -> None:
        nan, inf = float("nan"), float("inf")
        pixels = torch.tensor([[nan, 0.0], [0.0, nan], [inf, 0.0], [0.0, -inf], [700.0, 300.0]], dtype=torch.float64)
        rays, valid = self.camera.unproject(pixels)
        assert valid.tolist() == [False, False, False, False, True]
        assert rays[:4].tolist() == [[0.0, 0.0, 1.0]] * 4
        assert torch.equal(rays[4:], self.camera.unproject(pixels[4:])[0])

    def test_points_that_are_not_in_front(self) -> None:
        nan = float("nan")
        points = torch.tensor([[0.1, 0.1, -1.0], [0.1, 0.1, 0.0], [0.0, 0.0, 0.0], [nan, 0, 1], [0.1, 0.1, 1.0]])
        pixels, valid = self.camera.project(points)
        assert valid.tolist() == [False, False, False, False, True]
        assert pixels[:4].tolist() == [[640.0, 360.0]] * 4

    def test_points_beyond_the_fold(self) -> None:
        camera = Camera.build(focal=(100, 100), center=(9, 8), size=(20, 20), coefficients=[-0.3], model="opencv4")
        # 1.06 folds back onto pixels that 1.05 owns: without the flag they would look like good ones.
        pixels, valid = camera.project(torch.tensor([[1.05, 0.0, 1.0], [1.06, 0.0, 1.0], [3.0, 0.0, 1.0]]))
        assert valid.tolist() == [True, False, False]
        assert pixels[1:].tolist() == [[9.0, 8.0]] * 2

    def test_no_points_at_all(self) -> None:
        rays, valid = self.camera.unproject(torch.zeros(0, 2, dtype=torch.float64))
        assert (tuple(rays.shape), tuple(valid.shape)) == ((0, 3), (0,))
        pixels, valid = self.camera.project(torch.zeros(0, 3, dtype=torch.float64))
        assert (tuple(pixels.shape), tuple(valid.shape)) == ((0, 2), (0,))

    @pytest.mark.parametrize("dtype", [torch.int32, torch.int64, torch.uint8, torch.bool])
    def test_integers_are_refused(self, dtype: torch.dtype) -> None:
        with pytest.raises(InputError, match=r"floating point is needed.*\.double\(\)"):
            self.camera.unproject(torch.zeros(3, 2, dtype=dtype))
        with pytest.raises(InputError, match="floating point"):
            self.camera.project(torch.zeros(3, 3, dtype=dtype))

    def test_wrong_shapes_are_refused(self) -> None:
        with pytest.raises(InputError, match=r"pixels: shape \(\.\.\., 2\) is needed, got \(5, 3\)"):
            self.camera.unproject(torch.zeros(5, 3))
        with pytest.raises(InputError, match=r"points_cam: shape \(\.\.\., 3\) is needed, got \(5, 2\)"):
            self.camera.project(torch.zeros(5, 2))
        with pytest.raises(InputError, match=r"shape \(\.\.\., 5\) is needed for opencv5"):
            distort(torch.zeros(1, 2), torch.zeros(4), "opencv5")


def test_a_place_of_the_edge_without_an_image_opens_no_way_beyond() -> None:
    """Rounding may leave none; pixels far beyond the others would be followed all the way from the axis."""
    angle = torch.linspace(-math.pi, math.pi, 1025, dtype=torch.float64)[:-1]
    edge = 2.0 * torch.stack([angle.cos(), angle.sin()])
    edge[:, 300] = _FAR
    at = angle[300] + torch.tensor([0.0, 0.002, 0.004], dtype=torch.float64)
    for reach in (1.9, 2.5):
        x, y = reach * torch.stack([at.cos(), at.sin()])
        assert bool((_edge_fraction(x[None], y[None], edge[:1], edge[1:]) > 1.0001).all()) == (reach > 2.2)
