"""Images: undistorted, turned, and a stack of cameras."""

import copy
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from image_cameras import BARREL, F64, LITTLE, OTHER, PINCUSHION, SMALL, build
from kornia.geometry.transform import remap
from lenses import NAMED, camera_of
from torch import Tensor

from kcal import Camera, InputError
from kcal.lens import CameraCalibration, CameraRays, ImageTransform, Undistort, undistort_maps
from kcal.lens.camera_like import project_each, stackable, unproject_each
from kcal.lens.projection import project_components
from kcal.lens.views import new_pinhole, source_pixels


def ramp(size: tuple[int, int]) -> Tensor:
    """(2, H, W): every pixel holds its own position, which bilinear interpolation reproduces exactly."""
    x, y = torch.meshgrid(torch.arange(size[0], dtype=F64), torch.arange(size[1], dtype=F64), indexing="xy")
    return torch.stack([x, y])


class TestWhereItLooks:
    @pytest.mark.parametrize("camera", [BARREL, PINCUSHION])
    def test_a_pixel_takes_the_value_where_its_ray_was_imaged(self, camera: Camera) -> None:
        """The half-pixel convention: position ramps come back as `project(unproject(pixel))`."""
        new = new_pinhole(camera, alpha=0.3)
        seen, mask = Undistort(camera, new)(ramp(camera.size))
        pixels = ramp(new.size).permute(1, 2, 0).reshape(-1, 2)
        rays, _ = new.unproject(pixels)
        expected, _ = camera.project(rays)
        expected = expected.unflatten(0, (480, 640)).permute(2, 0, 1)
        assert 0.8 < mask.double().mean() < 1
        # Rounding of 640 px through the sampler's [-1, 1].
        assert (seen - expected)[:, mask].abs().max() < 1e-11
        assert (seen[:, ~mask] == 0).all()

    def test_identity(self) -> None:
        camera = build(500, (64, 48), [], "pinhole")
        image = torch.rand(3, 48, 64, dtype=F64)
        for new in (camera, None):
            same, mask = Undistort(camera, new)(image)
            assert mask.all()
            # Positions pass through [-1, 1]: 64 px times rounding, times differences of up to 1.
            assert (same - image).abs().max() < 1e-12
        bits = (image * 255).to(torch.uint8)
        assert torch.equal(Undistort(camera)(bits)[0], bits)

    def test_another_lens_as_target(self) -> None:
        """Distorting a pinhole image and undistorting it again is the identity on positions."""
        pinhole = new_pinhole(BARREL, alpha=1)
        distorted, seen = Undistort(pinhole, BARREL)(ramp(pinhole.size))
        back, mask = Undistort(BARREL, pinhole)(distorted)
        inner = mask.clone()
        inner[:3], inner[-3:], inner[:, :3], inner[:, -3:] = False, False, False, False
        assert seen.double().mean() > 0.98
        # The distorted ramp bends: its bilinear interpolation errs by 1/8 of second differences, 0.002 px here.
        assert (back - ramp(pinhole.size))[:, inner].abs().max() < 0.01


class TestAgainstOthers:
    def test_kornia_remap(self) -> None:
        """The maps kept in [-1, 1] are those that kornia's remap makes from pixels with align_corners=True."""
        maps = undistort_maps(BARREL)
        image = torch.rand(1, 3, 480, 640)
        x, y = (torch.from_numpy(m)[None] for m in maps[:2])
        ours, _ = Undistort(BARREL)(image)
        # Positions in float32 differ by some 1e-4 px, neighbors by up to 1.
        assert (ours - remap(image, x, y, align_corners=True)).abs().max() < 5e-4

    @pytest.mark.parametrize("alpha", [0.0, 1.0])
    def test_cv2_remap_on_a_real_image(self, kcal_data: Path, alpha: float) -> None:
        image = cv2.imread(str(kcal_data / "opencv_stereo" / "left01.jpg"), cv2.IMREAD_GRAYSCALE).astype(np.float32)
        new = new_pinhole(BARREL, alpha)
        maps = undistort_maps(BARREL, new)
        theirs = cv2.remap(image, maps.map_x, maps.map_y, cv2.INTER_LINEAR)
        ours, mask = Undistort(BARREL, new)(torch.from_numpy(image)[None])
        exact, _ = Undistort(BARREL, new)(torch.from_numpy(image)[None].double())
        # OpenCV's maps are float32: 3e-5 px at 640, times edges of up to 200 gray levels a pixel.
        assert np.abs(exact[0].numpy() - theirs).max() < 0.01
        # In float32 our positions pass through [-1, 1] and err by up to 640 * 1.2e-7 px as well.
        assert np.abs(ours[0].numpy() - theirs).max() < 0.02
        assert ((ours - exact) ** 2).mean().sqrt() < 0.001
        assert np.array_equal(mask.numpy(), maps.mask)

    def test_cv2_undistort(self) -> None:
        """OpenCV's own maps for the same new camera."""
        new = new_pinhole(BARREL)
        lens = BARREL.coefficients.numpy()
        size = new.size
        x, y = cv2.initUndistortRectifyMap(BARREL.matrix.numpy(), lens, None, new.matrix.numpy(), size, cv2.CV_32FC1)
        maps = undistort_maps(BARREL, new)
        # One float32 step at 640 px is 6e-5.
        assert np.abs(maps.map_x - x).max() < 1e-4
        assert np.abs(maps.map_y - y).max() < 1e-4


class TestMask:
    def test_needs_all_four_neighbors(self) -> None:
        camera = build(100, (11, 9), [], "pinhole")
        pixels = torch.tensor([[0.0, 0.0], [10.0, 8.0], [-1e-3, 4.0], [5.0, 8.001], [10.0 + 1e-8, 4.0]], dtype=F64)
        found, seen = source_pixels(camera, camera.unproject(pixels)[0])
        assert seen.tolist() == [True, True, False, False, True]
        assert found[-1].tolist() == [10.0, 4.0]

    def test_shift_by_whole_pixels(self) -> None:
        camera = Camera.build(focal=(50, 50), center=(10, 8), size=(24, 16), model="pinhole")
        shifted = Camera.build(focal=(50, 50), center=(7, 10), size=(20, 16), model="pinhole")
        image = torch.rand(1, 16, 24, dtype=F64)
        moved, mask = Undistort(camera, shifted)(image)
        assert mask.shape == (16, 20)
        assert torch.equal(mask, torch.cat([torch.zeros(2, 20), torch.ones(14, 20)]).bool())
        assert (moved[0, 2:] - image[0, :14, 3:23]).abs().max() < 1e-13
        assert (moved[0, :2] == 0).all()


class TestModule:
    def test_leading_shapes(self) -> None:
        undistort = Undistort(LITTLE, new_pinhole(LITTLE, 1, (60, 50)))
        images = torch.rand(2, 3, 1, 120, 160)
        out, mask = undistort(images)
        assert out.shape == (2, 3, 1, 50, 60)
        assert mask.shape == (2, 3, 50, 60)
        single, _ = undistort(images[1, 2])
        assert torch.equal(out[1, 2], single)
        assert undistort(images[:0])[0].shape == (0, 3, 1, 50, 60)

    def test_batch_of_cameras(self) -> None:
        batch = Camera(torch.stack([LITTLE.params, OTHER.params]), size=(160, 120))
        image = torch.rand(1, 120, 160, dtype=F64)
        out, mask = Undistort(batch)(image)
        assert out.shape == (2, 1, 120, 160)
        for i, camera in enumerate((LITTLE, OTHER)):
            expected, seen = Undistort(camera)(image)
            assert (out[i] - expected).abs().max() < 1e-9
            assert torch.equal(mask[i], seen)
        with pytest.raises(InputError, match="does not fit"):
            Undistort(batch)(torch.rand(3, 1, 120, 160))
        with pytest.raises(InputError, match="single camera"):
            undistort_maps(batch)

    @pytest.mark.parametrize("lead", [(), (2,), (2, 1), (0,)])
    @pytest.mark.parametrize("channels", [1, 2, 3, 4, 5])
    def test_whole_numbers_are_sampled_as_floats_are(self, channels: int, lead: tuple[int, ...]) -> None:
        undistort = Undistort(LITTLE, new_pinhole(LITTLE, 1))
        assert not bool(undistort.mask.all())
        for kind, top in ((torch.uint8, 255), (torch.uint16, 65535)):
            image = (torch.rand(*lead, channels, 120, 160) * top).round().to(kind)
            beside = image.movedim(-3, -1).contiguous().movedim(-1, -3)
            exact, _ = undistort(image.double())
            for same in (image, beside):
                out, _ = undistort(same)
                assert out.shape == exact.shape
                assert bool(((out.double() - exact).abs() < 0.5 + 1e-4 * top).all())
            if lead == (2, 1):
                mapped = torch.func.vmap(lambda one: undistort(one)[0])(image)
                assert (mapped.double() - exact).abs().max() < 0.5 + 1e-4 * top

    def test_whole_numbers_of_several_cameras_and_of_one_that_changes(self) -> None:
        image, batch = (
            (torch.rand(3, 120, 160) * 255).to(torch.uint8),
            Camera(torch.stack([LITTLE.params, OTHER.params]), size=(160, 120)),
        )
        out, _ = Undistort(batch)(image)
        changed = Undistort(copy.deepcopy(LITTLE), new_pinhole(OTHER))
        changed(image)
        changed.load_state_dict(Undistort(OTHER).state_dict(), strict=False)
        for got, camera in ((out[0], LITTLE), (out[1], OTHER), (changed(image)[0], OTHER)):
            expected, _ = Undistort(camera)(image.double())
            assert (got.double() - expected).abs().max() < 0.53

    def test_half_precision_keeps_positions(self) -> None:
        image = ramp((160, 120))[:1] / 160
        undistort = Undistort(LITTLE)
        full, _ = undistort(image)
        for kind in (torch.float16, torch.bfloat16):
            out, _ = undistort.to(kind)(image.to(kind))
            assert out.dtype == kind
            # The ramp itself is rounded on the way in and out. Positions rounded to 11 bits would err by up to 0.15 px.
            assert (out.double() - full).abs().max() < 2 * torch.finfo(kind).eps
        assert undistort.grid.dtype == torch.float32
        assert undistort.camera.params.dtype == F64

    def test_maps_follow_the_parameters(self) -> None:
        image = ramp((160, 120))
        new = new_pinhole(LITTLE)
        undistort = Undistort(copy.deepcopy(OTHER), new)
        expected, _ = Undistort(LITTLE, new)(image)
        assert (undistort(image)[0] - expected).abs().max() > 1
        undistort.load_state_dict(Undistort(LITTLE, new).state_dict())
        assert torch.equal(undistort(image)[0], expected)
        assert sorted(undistort.state_dict()) == sorted(
            ["_extra_state", *(f"{which}.{name}" for which in ("camera", "new_camera") for name in LITTLE.state_dict())]
        )

    def test_what_inference_mode_kept_can_be_trained_through(self) -> None:
        camera = copy.deepcopy(LITTLE)
        undistort, rays = Undistort(camera), CameraRays(camera)
        with torch.no_grad():
            camera.params[0] += 1.0
        image, pose = torch.rand(1, 120, 160), torch.eye(4)[None]
        with torch.inference_mode():
            undistort(image), rays(pose)
        for module, given in ((undistort, image), (rays, pose)):
            found = module(given.requires_grad_())
            (found[0] if isinstance(found, tuple) else found).sum().backward()
            assert bool(given.grad.any())

    @pytest.mark.parametrize(
        ("image", "message"),
        [
            (torch.rand(1, 160, 120), r"shape \(..., C, 120, 160\) is needed, got \(1, 160, 120\)"),
            (torch.rand(120, 160), r"got \(120, 160\)"),
            (torch.zeros(1, 120, 160, dtype=torch.int64), "int64"),
            (np.zeros((1, 120, 160)), "ndarray"),
            (torch.rand(1, 120, 160, device="meta"), "image is on meta"),
        ],
    )
    def test_refused(self, image: Tensor, message: str) -> None:
        with pytest.raises(InputError, match=message):
            Undistort(LITTLE)(image)


class TestGradients:
    def test_by_the_image(self) -> None:
        undistort = Undistort(SMALL, new_pinhole(SMALL, 1))
        image = torch.rand(2, 1, 6, 7, dtype=F64, requires_grad=True)
        assert torch.autograd.gradcheck(lambda value: undistort(value)[0], (image,))

    def test_by_the_cameras(self) -> None:
        """Bilinear interpolation has kinks at whole pixels; a new camera with odd numbers keeps away from them."""
        new = Camera.build(focal=(6.13, 6.37), center=(2.913, 2.471), size=(6, 5), model="pinhole")
        image = torch.rand(1, 6, 7, dtype=F64, generator=torch.Generator().manual_seed(1))
        undistort = Undistort(copy.deepcopy(SMALL), new).requires_grad_(True)
        names = ["camera.params", "new_camera.params"]
        values = [undistort.get_parameter(name).detach().clone().requires_grad_(True) for name in names]
        assert undistort(image)[1].double().mean() > 0.6

        def image_of(*parameters: Tensor) -> Tensor:
            swapped = dict(zip(names, parameters, strict=True))
            out: Tensor = torch.func.functional_call(undistort, swapped, (image,))[0]
            return out

        assert torch.autograd.gradcheck(image_of, values)
        (slope,) = torch.autograd.grad(image_of(*values).sum(), values[:1])
        assert (slope[:2].abs() > 1e-3).all()

    def test_frozen_cameras_keep_their_maps(self) -> None:
        undistort = Undistort(copy.deepcopy(SMALL))
        image = torch.rand(1, 6, 7, requires_grad=True)
        kept = undistort.grid
        undistort(image)[0].sum().backward()
        assert undistort.grid is kept
        assert image.grad is not None
        undistort.requires_grad_(True)
        undistort(image)[0].sum().backward()
        assert undistort.camera.params.grad.abs().max() > 0


# Resized, cropped and letterboxed: pixels, cameras and error bars agree with each other and with real resampling.


FULL = (1920, 1080)

TRANSFORMS = {
    "resize": ImageTransform.resize(FULL, (800, 640)),
    "crop": ImageTransform.crop(FULL, 300, 200, (640, 480)),
    "letterbox": ImageTransform.letterbox(FULL, (640, 640)),
    "chain": ImageTransform.crop(FULL, 11, 7, (1001, 701)).then(ImageTransform.letterbox((1001, 701), (416, 352))),
}


@pytest.mark.parametrize("transform", TRANSFORMS.values(), ids=TRANSFORMS)
@pytest.mark.parametrize("lens", ["opencv5", "opencv14", "fisheye4", "hybrid"])
def test_the_camera_of_the_input_sees_the_pixels_of_the_input(lens: str, transform: ImageTransform) -> None:
    camera = camera_of(lens, 0.3)
    pixels = torch.stack([torch.linspace(400, 900, 40), torch.linspace(250, 600, 40)], -1).double()
    rays, valid = camera.unproject(pixels)
    seen, also = camera.transformed(transform).project_rays(rays)
    assert bool((valid & also).all())
    assert torch.allclose(seen, transform.to_input(pixels), rtol=0, atol=1e-9)
    assert torch.allclose(transform.to_full(transform.to_input(pixels)), pixels, rtol=0, atol=1e-9)


def test_edges_coincide_as_in_torch() -> None:
    """A ramp, resampled by torch: its value at an input pixel is where that pixel lies in the full image."""
    columns = torch.arange(64.0).expand(1, 1, 48, 64)
    rows = torch.arange(48.0)[:, None].expand(1, 1, 48, 64)
    size = (40, 36)
    transform = ImageTransform.resize((64, 48), size)
    resized = torch.nn.functional.interpolate(torch.cat([columns, rows], 1), size=size[::-1], mode="bilinear")[0]
    pixels = torch.stack(torch.meshgrid(torch.arange(3.0, 37), torch.arange(3.0, 33), indexing="xy"), -1)
    found = torch.stack([image[3:33, 3:37] for image in resized], -1).double()
    assert torch.allclose(transform.to_full(pixels), found, atol=1e-5)


@pytest.mark.parametrize(
    ("full", "size", "pad", "inner"),
    [
        ((1920, 1080), (640, 640), (0, 140), (640, 360)),
        ((1279, 720), (640, 640), (0, 140), (640, 360)),  # 360.28 rows are 360
        ((810, 1080), (640, 640), (80, 0), (480, 640)),
        ((1000, 701), (416, 352), (0, 30), (416, 292)),  # 60 rows to pad
        ((1000, 703), (416, 353), (0, 30), (416, 292)),  # 61: the odd one goes below
    ],
)
def test_letterbox_is_that_of_ultralytics(
    full: tuple[int, int], size: tuple[int, int], pad: tuple[int, int], inner: tuple[int, int]
) -> None:
    found = ImageTransform.letterbox(full, size)
    assert found.offset == pad
    assert found.scale == (inner[0] / full[0], inner[1] / full[1])
    corner = torch.tensor([full[0] - 0.5, full[1] - 0.5])
    wanted = torch.tensor([p + i - 0.5 for p, i in zip(pad, inner, strict=True)], dtype=torch.float64)
    assert torch.allclose(found.to_input(corner), wanted)


def test_small_images_may_stay_small_and_padding_may_go_to_one_side() -> None:
    assert ImageTransform.letterbox((320, 240), (640, 640), enlarge=False).scale == (1.0, 1.0)
    assert ImageTransform.letterbox((1920, 1080), (640, 640), centered=False).offset == (0, 0)


def test_methods_of_the_camera() -> None:
    camera = camera_of("opencv5", 0.3)
    assert camera.resized((960, 540)).focal.tolist() == [800.0, 805.0]
    assert camera.cropped(100, 50, (640, 480)).center.tolist() == [855.0, 491.0]
    assert camera.letterboxed((640, 640)).size == (640, 640)


def test_error_bars_travel_exactly() -> None:
    """The sigma of a projected pixel, in input pixels, is that of the full image times the scale."""
    camera = camera_of("opencv5", 0.3)
    root = torch.randn(10, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 1e-3
    names = dict.fromkeys(camera.names, 0.5) | {"skew": None}
    camera.calibration = CameraCalibration(name="left", sigma=names, covariance=root @ root.T)
    transform = TRANSFORMS["resize"]
    small = camera.transformed(transform)
    assert small.calibration.name == "left"
    assert small.calibration.sigma["skew"] is None
    assert math.isclose(small.calibration.sigma["cx"] or 0.0, 0.5 * 800 / 1920)
    points = torch.tensor([[0.3, 0.2, 1.0]], dtype=torch.float64)
    found = []
    for one in (camera, small):
        slope = torch.autograd.functional.jacobian(
            lambda values, one=one: _with(one, values).project(points)[0][0],
            one.params.detach(),
        )
        found.append(slope @ one.calibration.covariance @ slope.T)
    scale = torch.tensor(transform.scale, dtype=torch.float64)
    assert torch.allclose(found[1], scale[:, None] * found[0] * scale, rtol=1e-9)


def _with(camera: Camera, values: torch.Tensor) -> Camera:
    other = camera.with_parameters(values)
    del other.params
    other.params = values
    return other


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ImageTransform.crop(FULL, 1900, 0, (640, 480)), "does not lie inside"),
        (lambda: ImageTransform.resize(FULL, (0, 640)), "must be positive"),
        (
            lambda: camera_of("opencv5", 0.3).transformed(ImageTransform.resize((640, 480), (320, 240))),
            "the camera has",
        ),
        (lambda: TRANSFORMS["crop"].then(TRANSFORMS["resize"]), "the second begins with"),
        (lambda: TRANSFORMS["crop"].to_full(torch.ones(3, 2, dtype=torch.int64)), "floating point"),
    ],
)
def test_what_cannot_be(make: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()  # type: ignore[operator]


# Cameras in one call give what each gives alone.


def make_camera(preset: str, focal: float) -> Camera:
    return camera_of(preset, 0.3 * focal / 1600, focal)


def some_pixels(*shape: int) -> Tensor:
    """In the image, around it, and one that is not finite."""
    random = torch.Generator().manual_seed(1)
    pixels = torch.rand(*shape, 2, generator=random, dtype=torch.float64) * torch.tensor([2400.0, 1500.0]) - 200.0
    pixels[..., 3, 0] = torch.nan
    return pixels


@pytest.mark.parametrize("kinds", [(name, name) for name in NAMED] + [("fisheye4", "opencv5", "opencv5")])
def test_rays_are_those_of_each_camera(kinds: tuple[str, ...]) -> None:
    cameras = [make_camera(kind, 1500.0 + 100.0 * number) for number, kind in enumerate(kinds)]
    assert stackable(cameras) == (len(set(kinds)) == 1 and kinds[0] != "hybrid")
    for shape in ((len(cameras), 40), (2, len(cameras), 40)):
        pixels = some_pixels(*shape)
        rays, valid = unproject_each(cameras, pixels)
        alone = [camera.unproject(pixels[..., number, :, :]) for number, camera in enumerate(cameras)]
        assert torch.equal(valid, torch.stack([seen for _, seen in alone], -2))
        assert torch.allclose(rays, torch.stack([ray for ray, _ in alone], -3), rtol=0, atol=1e-13)


def test_gradients_reach_each_camera() -> None:
    cameras = [make_camera("opencv14", focal).free() for focal in (1500.0, 1600.0)]
    pixels = some_pixels(2, 20)
    weight = torch.rand(2, 20, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    slopes = []
    alone = [camera.unproject(some)[0] for camera, some in zip(cameras, pixels, strict=True)]
    for rays in (unproject_each(cameras, pixels)[0], torch.stack(alone)):
        slopes.append(torch.autograd.grad((weight * rays).sum(), [camera.params for camera in cameras]))
    for one, other in zip(*slopes, strict=True):
        assert float(one.abs().max()) > 0
        assert torch.allclose(one, other, rtol=1e-10, atol=1e-14)


@pytest.mark.parametrize("kinds", [("opencv14", "opencv14"), ("fisheye4", "hybrid"), ("hybrid", "hybrid")])
def test_projections_are_those_of_each_camera(kinds: tuple[str, str]) -> None:
    cameras = [make_camera(kind, 1500.0 + 100.0 * number) for number, kind in enumerate(kinds)]
    random = torch.Generator().manual_seed(3)
    points = torch.randn(2, 3, 15, generator=random, dtype=torch.float64) + torch.tensor([[0.0], [0.0], [6.0]])
    meter = torch.full((15,), 0.01, dtype=torch.float64)
    wanted = [list(range(len(camera.names))) for camera in cameras]
    for number, found in enumerate(project_each(cameras, points, wanted, meter)):
        camera = cameras[number]
        alone = project_components(points[number], camera.values, camera.model, wanted[number], meter)
        for one, other in zip(found, alone, strict=True):
            assert (one is None) == (other is None)
            assert one is None or torch.allclose(one, other, rtol=1e-13, atol=1e-12)
