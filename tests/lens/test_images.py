from __future__ import annotations

import copy
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from image_cameras import BARREL, F64, LITTLE, OTHER, PINCUSHION, SMALL, build
from kornia.geometry.transform import remap
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.images import Undistort, undistort_maps
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

    def test_a_point_lands_where_the_new_camera_says(self) -> None:
        camera, new = BARREL, new_pinhole(BARREL)
        points = torch.tensor([[-0.45, -0.3, 1.0], [0.4, 0.28, 1.0], [0.02, -0.01, 1.0]], dtype=F64)
        before, _ = camera.project(points)
        after, _ = new.project(points)
        grid = ramp(camera.size)
        spots = sum(torch.exp(-((grid[0] - u) ** 2 + (grid[1] - v) ** 2) / (2 * 1.2**2)) for u, v in before.tolist())
        assert isinstance(spots, Tensor)
        image, _ = Undistort(camera, new)(spots[None])
        for u, v in after.tolist():
            x, y = round(u), round(v)
            window = image[0, y - 6 : y + 7, x - 6 : x + 7]
            columns, rows = torch.arange(x - 6, x + 7, dtype=F64), torch.arange(y - 6, y + 7, dtype=F64)
            centroid = ((window.sum(0) @ columns) / window.sum(), (window.sum(1) @ rows) / window.sum())
            # A lens whose scale changes across the spot, and bilinear interpolation of so small a one: 0.03 px.
            assert math.hypot(float(centroid[0]) - u, float(centroid[1]) - v) < 0.05

    @pytest.mark.parametrize("camera", [BARREL, PINCUSHION])
    def test_drawn_pattern_against_its_formula(self, camera: Camera) -> None:
        def pattern(normalized: Tensor) -> Tensor:
            x, y = normalized.unbind(-1)
            return 127.5 + 60 * torch.sin(25 * x + 1) + 60 * torch.cos(25 * y - 4 * x)

        new = new_pinhole(camera)
        drawn = pattern(camera.normalize(camera.grid(*camera.size).flatten(0, 1))[0]).unflatten(0, (480, 640))
        truth = pattern(new.normalize(new.grid(*new.size).flatten(0, 1))[0]).unflatten(0, (480, 640))
        image, mask = Undistort(camera, new)(drawn[None])
        assert mask.all()
        # Bilinear interpolation errs by at most 1/8 of the second differences along x and along y.
        bends = [(drawn.diff(n=2, dim=axis).abs().max()) for axis in (0, 1)]
        bound = float(sum(bends)) / 8
        assert bound < 0.2
        assert (image[0] - truth).abs().max() < bound

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
        gray = cv2.imread(str(kcal_data / "opencv_stereo" / "left01.jpg"), cv2.IMREAD_GRAYSCALE)
        assert gray is not None
        image = gray.astype(np.float32)
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

    def test_integers_are_rounded_to_the_nearest_level(self) -> None:
        undistort = Undistort(LITTLE, new_pinhole(LITTLE, 1))
        for kind, top in ((torch.uint8, 255), (torch.uint16, 65535)):
            image = (torch.rand(1, 120, 160) * top).round().to(kind)
            out, _ = undistort(image)
            exact, _ = undistort(image.double())
            assert out.dtype == kind
            # Rounding, and float32 positions: 1e-4 px times differences of the whole range.
            assert (out.double() - exact).abs().max() < 0.5 + 1e-4 * top

    def test_half_precision_keeps_positions(self) -> None:
        image = ramp((160, 120))[:1] / 160
        undistort = Undistort(LITTLE)
        full, _ = undistort(image)
        for kind in (torch.float16, torch.bfloat16):
            out, _ = undistort.to(kind)(image.to(kind))
            assert out.dtype == kind
            # The ramp itself is rounded on the way in and out. Positions rounded to 11 bits would err by up to 0.15 px.
            assert (out.double() - full).abs().max() < 2 * torch.finfo(kind).eps
        assert undistort.grid_x.dtype == torch.float32
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

    def test_compiled_and_exported(self) -> None:
        undistort = Undistort(LITTLE)
        image = torch.rand(2, 1, 120, 160)
        expected, mask = undistort(image)
        program = torch.export.export(undistort, (image,))
        out, seen = program.module()(image)
        assert torch.equal(out, expected)
        assert torch.equal(seen, mask)
        compiled = torch.compile(undistort, backend="eager", fullgraph=True)
        assert torch.equal(compiled(image)[0], expected)

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
        mask = undistort(image)[1]
        assert mask.double().mean() > 0.6

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
        kept = undistort.grid_x
        undistort(image)[0].sum().backward()
        assert undistort.grid_x is kept
        assert image.grad is not None
        undistort.requires_grad_(True)
        undistort(image)[0].sum().backward()
        gradient = undistort.camera.params.grad
        assert gradient is not None
        assert gradient.abs().max() > 0
