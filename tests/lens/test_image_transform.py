"""Resized, cropped and letterboxed: pixels, cameras and error bars agree with each other and with real resampling."""

from __future__ import annotations

import math

import pytest
import torch
from lenses import HYBRID, strong

from kcal.errors import InputError
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.camera_conversions import ImageTransform
from kcal.lens.model import PRESETS

FULL = (1920, 1080)
TRANSFORMS = {
    "resize": ImageTransform.resize(FULL, (800, 640)),
    "crop": ImageTransform.crop(FULL, 300, 200, (640, 480)),
    "letterbox": ImageTransform.letterbox(FULL, (640, 640)),
    "chain": ImageTransform.crop(FULL, 11, 7, (1001, 701)).then(ImageTransform.letterbox((1001, 701), (416, 352))),
}


def camera_of(name: str) -> Camera:
    model = HYBRID if name == "hybrid" else PRESETS[name]
    lens = torch.tensor([0.02, -0.01, 0.003, -0.0005]) if model.fisheye else 0.3 * strong(model)
    return Camera(torch.cat([torch.tensor([1600.0, 1610.0, 955.0, 541.0, 2.0]), lens]).double(), size=FULL, model=model)


@pytest.mark.parametrize("transform", TRANSFORMS.values(), ids=TRANSFORMS)
@pytest.mark.parametrize("lens", ["opencv5", "opencv14", "fisheye4", "hybrid"])
def test_the_camera_of_the_input_sees_the_pixels_of_the_input(lens: str, transform: ImageTransform) -> None:
    camera = camera_of(lens)
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
    images = torch.cat([columns, rows], 1)
    resized = torch.nn.functional.interpolate(images, size=size[::-1], mode="bilinear")[0]
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
    camera = camera_of("opencv5")
    assert camera.resized((960, 540)).focal.tolist() == [800.0, 805.0]
    assert camera.cropped(100, 50, (640, 480)).center.tolist() == [855.0, 491.0]
    assert camera.letterboxed((640, 640)).size == (640, 640)


def test_error_bars_travel_exactly() -> None:
    """The sigma of a projected pixel, in input pixels, is that of the full image times the scale."""
    camera = camera_of("opencv5")
    root = torch.randn(10, 10, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 1e-3
    names = dict.fromkeys(camera.names, 0.5) | {"skew": None}
    camera.calibration = CameraCalibration(name="left", sigma=names, covariance=root @ root.T)
    transform = TRANSFORMS["resize"]
    small = camera.transformed(transform)
    assert small.calibration is not None
    assert small.calibration.name == "left"
    assert small.calibration.sigma is not None
    assert small.calibration.sigma["skew"] is None
    assert math.isclose(small.calibration.sigma["cx"] or 0.0, 0.5 * 800 / 1920)
    points = torch.tensor([[0.3, 0.2, 1.0]], dtype=torch.float64)
    found = []
    for one in (camera, small):
        slope = torch.autograd.functional.jacobian(
            lambda values, one=one: _with(one, values).project(points)[0][0],
            one.params.detach(),
        )
        assert one.calibration is not None
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
        (lambda: camera_of("opencv5").transformed(ImageTransform.resize((640, 480), (320, 240))), "the camera has"),
        (lambda: TRANSFORMS["crop"].then(TRANSFORMS["resize"]), "the second begins with"),
        (lambda: TRANSFORMS["crop"].to_full(torch.ones(3, 2, dtype=torch.int64)), "floating point"),
    ],
)
def test_what_cannot_be(make: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        make()  # type: ignore[operator]
