"""Projections in closed form: the pinhole, its gradients, the paraxial limit."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from image_cameras import BARREL, F64, FOLDING, PINCUSHION, build
from lenses import FEW_MODES, HYBRID, KINDS, MODELS, distort_with_jacobian, hybrid_camera, parameters, strong
from torch import Tensor, nn
from torch.autograd import gradcheck, gradgradcheck
from torch.func import functional_call, jacrev

from kcal import Camera, DegenerateError, InputError
from kcal.lens import CameraCalibration
from kcal.lens.images import NOWHERE, undistort_maps
from kcal.lens.information import CameraInformation
from kcal.lens.inverse import undistort
from kcal.lens.model import PRESETS, LensModel
from kcal.lens.projection import FAR, project_components
from kcal.lens.uncertainty import ParaxialFocal, paraxial_focal
from kcal.lens.views import new_pinhole


class TestNewPinhole:
    # for alpha in (0, 0.3, 1): cv2.getOptimalNewCameraMatrix(
    #     np.array([[1600, 0, 950], [0, 1590, 545], [0, 0, 1.0]]), np.array(k), (1920, 1080), alpha, size)[0]
    # with OpenCV 5.0.0. It looks at 9 x 9 points and undoes the lens in five steps. On a mild lens the border between
    # two of its points bends by 0.02 px, and the focal length changes by as much.
    OPENCV = (
        ((-0.1, 0.02, 1e-4, -2e-4), (1920, 1080), 0.0, (1542.873731, 1571.688229, 948.910882, 545.185340)),
        ((-0.1, 0.02, 1e-4, -2e-4), (1920, 1080), 0.3, (1537.395233, 1554.395874, 948.895278, 545.206963)),
        ((-0.1, 0.02, 1e-4, -2e-4), (1920, 1080), 1.0, (1524.612071, 1514.047045, 948.858869, 545.257417)),
        ((-0.1, 0.02, 1e-4, -2e-4), (800, 600), 0.0, (642.395055, 872.512742, 395.091086, 302.656181)),
        ((0.08, 0.02, 1e-4, -2e-4), (1920, 1080), 0.0, (1662.701944, 1652.709479, 950.219139, 544.999062)),
        ((0.08, 0.02, 1e-4, -2e-4), (1920, 1080), 0.3, (1658.029152, 1638.332028, 950.226942, 544.984566)),
        ((0.08, 0.02, 1e-4, -2e-4), (1920, 1080), 1.0, (1647.125970, 1604.784642, 950.245148, 544.950742)),
    )

    @pytest.mark.parametrize(("lens", "size", "alpha", "expected"), OPENCV)
    def test_opencv(
        self, lens: tuple[float, ...], size: tuple[int, int], alpha: float, expected: tuple[float, ...]
    ) -> None:
        camera = Camera.build(focal=(1600, 1590), center=(950, 545), size=(1920, 1080), coefficients=lens)
        new = new_pinhole(camera, alpha, size)
        assert new.size == size
        assert new.model.names == ()
        assert np.abs(new.params[:4].numpy() - expected).max() < 0.02

    def test_identity(self) -> None:
        camera = build(500, (640, 480), [0.0])
        for alpha in (0.0, 0.4, 1.0):
            assert (new_pinhole(camera, alpha).params - camera.params[:5]).abs().max() < 1e-10

    @settings(max_examples=20)
    @given(
        st.lists(st.floats(-0.4, 0.4), min_size=2, max_size=2),
        st.lists(st.floats(-0.01, 0.01), min_size=2, max_size=2),
        st.floats(40, 400),
        st.tuples(st.floats(0.3, 0.7), st.floats(0.3, 0.7)),
    )
    def test_alpha_0_is_valid_and_cannot_grow(
        self, radial: list[float], tangential: list[float], focal: float, center: tuple[float, float]
    ) -> None:
        """From pincushion to lenses that fold inside the image: every new pixel is valid, and none is wasted."""
        size = (64, 48)
        camera = Camera.build(
            focal=(focal, focal),
            center=(center[0] * 63, center[1] * 47),
            size=size,
            coefficients=[*radial, *tangential],
        )
        new = new_pinhole(camera)
        assert undistort_maps(camera, new).mask.all()
        focal_new, center_new = new.focal / 1.01, (new.center - 31.5) / 1.01 + 31.5
        wider = Camera.build(focal=focal_new.tolist(), center=center_new.tolist(), size=size, model="pinhole")
        assert not undistort_maps(camera, wider).mask.all()

    @settings(max_examples=20)
    @given(st.lists(st.floats(-0.3, 0.3), min_size=2, max_size=2), st.floats(60, 400))
    def test_alpha_1_shows_every_source_pixel_with_a_ray(self, radial: list[float], focal: float) -> None:
        camera = build(focal, (64, 48), radial)
        new = new_pinhole(camera, alpha=1)
        rays, valid = camera.unproject(camera.grid(64, 48).flatten(0, 1))
        shown, ahead = new.project(rays)
        last = torch.tensor([63.0, 47.0], dtype=F64)
        inside = ((shown > -1e-6) & (shown < last + 1e-6)).all(-1) & ahead
        assert torch.equal(inside & valid, valid)
        # Tight: each side is touched; sides that a fold ends are touched between source pixels.
        shown, gap = shown[valid], 0.01 if valid.all() else 4.0
        assert (shown.amin(0) < gap).all()
        assert (shown.amax(0) > last - gap).all()

    def test_batch_is_one_by_one(self) -> None:
        values = torch.stack([BARREL.params, PINCUSHION.params])
        values = torch.stack([values, values * torch.tensor([1.1, 1.1, *[1.0] * 8], dtype=F64)])
        for alpha in (0.0, 0.6, 1.0):
            batch = new_pinhole(Camera(values, size=(640, 480)), alpha).params
            assert batch.shape == (2, 2, 5)
            for i, j in np.ndindex(2, 2):
                single = new_pinhole(Camera(values[i, j], size=(640, 480)), alpha).params
                assert (batch[i, j] - single).abs().max() < 1e-10

    @pytest.mark.parametrize("alpha", [-0.1, 1.1, math.nan])
    def test_alpha_out_of_range(self, alpha: float) -> None:
        with pytest.raises(InputError, match="alpha"):
            new_pinhole(BARREL, alpha)

    def test_an_image_of_one_row(self) -> None:
        with pytest.raises(InputError, match="at least 2 pixels"):
            new_pinhole(BARREL, size=(640, 1))

    def test_nothing_to_show(self) -> None:
        camera = Camera.build(focal=(100, 100), center=(5000, 50), size=(100, 100), coefficients=[-0.2])
        for alpha in (0.0, 1.0):
            with pytest.raises(DegenerateError):
                new_pinhole(camera, alpha)


class TestFold:
    def test_pixels_beyond_the_fold_are_masked(self) -> None:
        """A pinhole wider than the lens: beyond r = 1.29 the model comes back into the image, and must not show."""
        wide = Camera.build(focal=(75, 75), center=(240, 135), size=(480, 270), model="pinhole")
        maps = undistort_maps(FOLDING, wide)
        x, y = (wide.normalize(wide.grid(*wide.size).flatten(0, 1))[0]).unbind(-1)
        beyond = torch.hypot(x, y).unflatten(0, (270, 480)) >= math.sqrt(1 / 0.6)
        assert beyond.double().mean() > 0.5
        assert np.array_equal(maps.mask, ~beyond.numpy())
        assert (maps.map_x[~maps.mask] == NOWHERE).all()
        r = math.sqrt(3.0)
        assert FOLDING.inside(600 * torch.tensor([[r - 0.2 * r**3, 0.0]], dtype=F64) + FOLDING.center).all()

    def test_new_pixels_without_a_ray_are_masked(self) -> None:
        """The other way round: the new camera's corners have no preimage, and must not show the optical axis."""
        folding = Camera.build(focal=(25, 25), center=(80, 45), size=(160, 90), coefficients=[-0.2])
        wide = new_pinhole(folding, alpha=1)
        _, valid = folding.unproject(folding.grid(160, 90).flatten(0, 1))
        mask = undistort_maps(wide, folding).mask
        assert 0.05 < mask.mean() < 0.9
        assert np.array_equal(mask, valid.unflatten(0, (90, 160)).numpy())

    def test_alpha(self) -> None:
        """None of this camera's four sides has a ray; both rectangles end on the fold's circle."""
        radius = math.sqrt(1 / 0.6)
        size = (480, 270)
        inner, outer = new_pinhole(FOLDING, 0, size), new_pinhole(FOLDING, 1, size)
        assert undistort_maps(FOLDING, inner).mask.all()
        half = torch.tensor([479.0, 269.0], dtype=F64) / 2
        # The rim itself is no longer valid: 1e-9 inside, and the rectangle is narrowed down to as much.
        assert torch.allclose(torch.linalg.vector_norm(half / inner.focal), torch.tensor(radius, dtype=F64), rtol=1e-8)
        assert torch.allclose(half / outer.focal, torch.tensor([radius, radius], dtype=F64), rtol=1e-8)


# Gradients through `Camera`: to points, pixels and parameters, and second derivatives of the inverse.


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


def small_camera(model: str | LensModel) -> Camera:
    return Camera(parameters(model, strong(model)), size=(4, 3), model=model)


@pytest.mark.parametrize("model", ["pinhole", *MODELS, HYBRID], ids=str)
def test_first_derivatives(model: str | LensModel) -> None:
    vector = parameters(model, strong(model))
    camera = Camera(vector, size=(4, 3), model=model)
    pixels = camera.project(POINTS)[0]
    vector.requires_grad_(True)
    # gradcheck's numbers are second-order differences with step 1e-6: 1e-8 is what they can show.
    tolerance = {"eps": 1e-6, "atol": 1e-8, "rtol": 1e-6}
    assert gradcheck(of_parameters(camera, "project"), (POINTS.clone().requires_grad_(True), vector), **tolerance)
    assert gradcheck(of_parameters(camera, "unproject"), (pixels.clone().requires_grad_(True), vector), **tolerance)


@pytest.mark.parametrize("model", ["opencv5", "opencv14", "ext20", HYBRID], ids=str)
def test_second_derivatives_of_the_inverse(model: str | LensModel) -> None:
    vector = parameters(model, strong(model))
    camera = Camera(vector, size=(4, 3), model=model)
    pixels = camera.project(POINTS)[0].requires_grad_(True)
    vector.requires_grad_(True)
    assert gradgradcheck(of_parameters(camera, "unproject"), (pixels, vector), eps=1e-6, atol=1e-7, rtol=1e-5)


@pytest.mark.parametrize("model", [*MODELS, HYBRID], ids=str)
def test_inverse_has_the_inverse_jacobian(model: str | LensModel) -> None:
    """The implicit function theorem, written out: dx/dx_D = J⁻¹ and dx/dc = -J⁻¹ ∂x_D/∂c."""
    lens = strong(model)
    distorted, by_point, by_coefficients = distort_with_jacobian(POINTS[:, :2] / POINTS[:, 2:], lens, model)
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
    assert camera.params.grad is not None
    assert bool(torch.isfinite(camera.params.grad).all())
    assert pixels.grad[1].tolist() == [0.0, 0.0]
    assert float(pixels.grad[0, 0]) > 0.009


@pytest.mark.parametrize("model", ["opencv14", HYBRID], ids=str)
def test_invalid_points_leave_no_nan_in_gradients(model: str | LensModel) -> None:
    camera = small_camera(model).requires_grad_(True)
    points = torch.tensor([[0.1, 0.1, 1.0], [0.0, 0.0, 0.0], [1.0, 1.0, -1.0], [float("nan"), 0.0, 1.0]]).double()
    points.requires_grad_(True)
    pixels, valid = camera.project(points)
    assert valid.tolist() == [True, False, False, False]
    assert bool(torch.isfinite(pixels).all())
    pixels.sum().backward()
    assert camera.params.grad is not None
    assert bool(torch.isfinite(camera.params.grad).all())
    assert torch.equal(points.grad[1:], torch.zeros(3, 3, dtype=torch.float64))


def test_gradients_reach_through_low_precision_inputs() -> None:
    camera = small_camera("opencv5")
    points = POINTS.to(torch.float32).requires_grad_(True)
    camera.project(points)[0].sum().backward()
    assert points.grad.dtype == torch.float32
    expected = jacrev(lambda value: camera.project(value)[0].sum())(POINTS.to(torch.float32).double())
    torch.testing.assert_close(points.grad, expected.float(), rtol=0, atol=0)


# The focal length on the optical axis: against projections a little off it, and its σ against drawn cameras.


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


@pytest.mark.parametrize("model", ["pinhole", "opencv5"])
def test_masks_of_a_batch_of_cameras_have_its_axis(model: str) -> None:
    one = Camera.build(focal=(800, 810), center=(322, 238), size=(640, 480), model=model)
    several = Camera(one.params.detach().repeat(4, 1), size=one.size, model=model)
    pixels, valid = several.project(torch.tensor([[0.1, 0.0, 1.0], [0.0, 0.0, -1.0]]))
    assert valid.tolist() == [[True, False]] * 4
    assert pixels[valid].shape == (4, 2)
