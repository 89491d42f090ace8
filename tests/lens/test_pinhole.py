from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from image_cameras import BARREL, F64, FOLDING, PINCUSHION, build

from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.images import NOWHERE, undistort_maps
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
