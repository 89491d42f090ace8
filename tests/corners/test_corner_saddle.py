import math

import numpy as np
import pytest
import torch
from board_render import homography, render
from hypothesis import given, settings
from hypothesis import strategies as st

from kcal.corners.board import Board
from kcal.corners.grid import local_side
from kcal.corners.refine import refine_corners
from kcal.corners.saddle import CornerStatus, saddle
from kcal.errors import InputError

BOARD = Board(columns=5, rows=4, square=0.02)


def scene(square, blur=1.0, noise=2.0, seed=0, tilt=(0.1, -0.05), roll=0.1, **options):
    rng = np.random.default_rng(seed)
    size = int(square * 7.5) + 24, int(square * 6.5) + 24
    H = homography(BOARD, size, square, tilt, roll, rng.uniform(-0.5, 0.5, 2))
    image, truth = render(BOARD, size, H, blur, noise, seed, **options)
    side = local_side(truth, BOARD.columns, BOARD.rows)
    start = truth + torch.from_numpy(rng.normal(0, 1, truth.shape)).clamp(-2, 2) * (0.07 * side[:, None]).clamp(max=0.5)
    return image, truth, start, side


def rms(pixels, truth):
    """Root of the mean squared distance along each axis."""
    return float((pixels - truth).square().mean().sqrt())


def test_twenty_pixel_squares_are_found_to_a_hundredth_of_a_pixel():
    errors = []
    for seed in range(4):
        image, truth, start, side = scene(20, seed=seed)
        found = saddle(torch.from_numpy(image).double(), start, side)
        assert bool((found.status == CornerStatus.GOOD).all())
        errors.append(found.pixels - truth)
    errors = torch.cat(errors)
    # 0.009 over many boards at this noise and blur; 0.012 leaves room for the chance of 80 corners.
    assert float(errors.square().mean().sqrt()) < 0.012
    # No bias: the mean of 80 errors of 0.009 has a sigma of 0.001.
    assert float(errors.mean(0).abs().max()) < 0.004


@pytest.mark.parametrize("square", [8, 10, 14, 20, 30, 45, 60])
@pytest.mark.parametrize("method", ["saddle", "opencv"])
def test_window_follows_the_square(square, method):
    # A fixed half-window of 11 px loses most corners of 10 px squares. At 8 px cornerSubPix has a window of 2 px only
    # and reaches 0.063; from 14 px on both are below 0.03.
    image, truth, start, side = scene(square, roll=0.3, tilt=(0.2, 0.1), supersample=4)
    found = refine_corners(image, start, side, method)
    assert bool((found.status == CornerStatus.GOOD).all())
    assert rms(found.pixels, truth) < (0.02 if method == "saddle" else 0.08)


@pytest.mark.parametrize("blur", [0.5, 1.0, 2.0])
def test_noise_free_bias_is_below_a_hundredth(blur):
    image, truth, start, side = scene(20, blur=blur, noise=0, supersample=8, dtype=np.float64)
    found = saddle(torch.from_numpy(image), start, side)
    # 0.001 to 0.002 is the saddle's own floor (curvature of the blurred corner under perspective), the rest is the
    # renderer's finite sampling.
    assert rms(found.pixels, truth) < 0.005


def test_methods_agree():
    image, _, start, side = scene(24, blur=0.8, noise=1)
    ours = refine_corners(image, start, side, "saddle").pixels
    for method in ("opencv", "skimage"):
        other = refine_corners(image, start, side, method)
        assert int((other.status == CornerStatus.GOOD).sum()) >= 19
        # Each method is good to 0.01 to 0.03 px a corner at this noise.
        assert float((other.pixels - ours).abs().nan_to_num().max()) < 0.08


def test_gray_scale_and_offset_do_not_matter():
    image, _, start, side = scene(20)
    image = torch.from_numpy(image).double()
    one = saddle(image, start, side).pixels
    two = saddle(image * 257 + 1000, start, side).pixels
    torch.testing.assert_close(one, two, rtol=0, atol=1e-10)  # rounding of 1e-16 x 6e4 levels, over the contrast


def test_uint8_equals_float():
    image, _, start, side = scene(20)
    as_bytes = saddle(torch.from_numpy(image), start, side).pixels
    assert bool((as_bytes == saddle(torch.from_numpy(image).double(), start, side).pixels).all())


def test_result_does_not_depend_on_the_start():
    image, truth, _, side = scene(20)
    image = torch.from_numpy(image).double()
    one = saddle(image, truth + torch.tensor([0.7, -0.4]), side)
    two = saddle(image, truth - torch.tensor([0.5, -0.8]), side)
    assert bool((one.status == CornerStatus.GOOD).all())
    # Both stop at the same stationary point, to what is left after six repeats of the bilinear fit.
    torch.testing.assert_close(one.pixels, two.pixels, rtol=0, atol=1e-4)


@settings(max_examples=15, deadline=None)
@given(st.integers(-8, 8), st.integers(-8, 8))
def test_moving_the_image_moves_the_corner(dx, dy):
    image, _, start, side = scene(16, noise=1)
    image = torch.nn.functional.pad(torch.from_numpy(image).double()[None], (12, 12, 12, 12), "replicate")[0]
    here = saddle(image, start + 12, side).pixels
    there = saddle(image.roll((dy, dx), (0, 1)), start + 12 + torch.tensor([dx, dy]), side).pixels
    torch.testing.assert_close(there, here + torch.tensor([dx, dy]), rtol=0, atol=1e-9)  # starts round differently


def test_transposed_image_gives_transposed_corners():
    image, _, start, side = scene(16)
    image = torch.from_numpy(image).double()
    one = saddle(image, start, side).pixels
    two = saddle(image.T, start.flip(-1), side).pixels.flip(-1)
    torch.testing.assert_close(one, two, rtol=0, atol=1e-10)


def test_batch_equals_one_by_one():
    scenes = [scene(16, seed=seed) for seed in range(3)]
    images = torch.stack([torch.from_numpy(s[0]).double() for s in scenes])
    starts, sides = torch.stack([s[2] for s in scenes]), torch.stack([s[3] for s in scenes])
    together = saddle(images, starts, sides)
    for k, (image, start, side) in enumerate(zip(images, starts, sides, strict=True)):
        one = saddle(image, start, side)
        torch.testing.assert_close(together.pixels[k], one.pixels, rtol=0, atol=1e-12)
        assert bool((together.status[k] == one.status).all())


def test_gradient_with_respect_to_the_image():
    x = torch.arange(33.0, dtype=torch.float64)
    image = torch.outer(torch.tanh((x - 16.2) / 2), torch.tanh((x - 15.7) / 2))
    image = image + 0.05 * torch.sin(0.9 * x)[None] * torch.cos(0.7 * x)[:, None]
    start = torch.tensor([[16.0, 16.0]], dtype=torch.float64)

    def corner(center):
        canvas = torch.nn.functional.pad(center, (14, 14, 14, 14)) + image
        return saddle(canvas, start, 20.0).pixels

    # Bilinear sampling has kinks, none of them within the finite difference here.
    assert torch.autograd.gradcheck(corner, (torch.zeros(5, 5, dtype=torch.float64, requires_grad=True),), eps=1e-6)


def test_gradient_is_finite_with_bad_corners_about():
    image = torch.rand(40, 40, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    start = torch.tensor([[20.0, 20.0], [math.nan, 3.0], [1.0, 1.0]], dtype=torch.float64)
    found = saddle(image, start, 20.0)
    found.pixels.nan_to_num().sum().backward()
    assert bool(torch.isfinite(image.grad).all())


def test_statuses():
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    hill = torch.exp(-((x - 20) ** 2 + (y - 30) ** 2) / 50)
    corner = torch.tanh((x - 60) / 2) * torch.tanh((y - 30) / 2) * (x > 40)
    far = torch.tensor([[20.3, 30.2], [60.4, 29.8], [62.0, 31.5], [math.nan, 0], [2.0, 2.0], [-40.0, 1e7]])
    found = saddle(hill + corner, far.double(), torch.tensor([20.0, 20.0, 6.0, 20.0, 20.0, 20.0]))
    expected = [
        CornerStatus.NO_SADDLE,
        CornerStatus.GOOD,
        CornerStatus.MOVED,
        CornerStatus.MISSING,
        CornerStatus.OUTSIDE,
        CornerStatus.OUTSIDE,
    ]
    assert found.status.tolist() == expected
    assert torch.isfinite(found.pixels).all(-1).tolist() == [status == CornerStatus.GOOD for status in expected]


def test_corners_keep_a_margin_from_all_four_sides():
    """The disc and two sigma of its blur, 6 px, lie on the image; half a pixel less does not."""
    width, height = 70, 60
    y, x = torch.meshgrid(torch.arange(60.0).double(), torch.arange(70.0).double(), indexing="ij")
    for margin, status in ((6.25, CornerStatus.GOOD), (5.75, CornerStatus.OUTSIDE)):
        places = [(margin, 30.0), (width - 1 - margin, 30.0), (35.0, margin), (35.0, height - 1 - margin)]
        for u, v in places:
            image = torch.tanh((x - u) / 2) * torch.tanh((y - v) / 2)
            found = saddle(image, torch.tensor([[u, v]]).double(), 20.0)
            assert int(found.status[0]) == status, (u, v)


def test_flat_image_gives_no_number():
    found = saddle(torch.full((50, 50), 128.0), torch.tensor([[25.0, 25.0]]), 20.0)
    assert int(found.status[0]) == CornerStatus.NO_SADDLE
    assert bool(found.pixels.isnan().all())


@pytest.mark.parametrize("method", ["opencv", "skimage", "none", "saddle"])
def test_other_methods_flag_what_they_cannot_do(method):
    image, truth, _, side = scene(20)
    start = truth.clone()
    start[0] = math.nan
    start[1] = torch.tensor([-5.0, 3.0])
    found = refine_corners(image, start, side, method)
    assert found.status[:2].tolist() == [CornerStatus.MISSING, CornerStatus.OUTSIDE]
    assert bool(found.pixels[:2].isnan().all())
    assert int((found.status[2:] == CornerStatus.GOOD).sum()) >= 17
    if method == "none":
        assert bool((found.pixels[2:] == truth[2:]).all())


def test_bad_arguments():
    image, pixels = torch.zeros(40, 40), torch.zeros(3, 2)
    with pytest.raises(InputError, match="differ"):
        saddle(image[None], pixels, 10.0)
    with pytest.raises(InputError, match="positive"):
        saddle(image, pixels, 0.0)
    with pytest.raises(InputError, match="does not fit"):
        saddle(image, pixels, torch.ones(4))
    with pytest.raises(InputError, match="uint8"):
        saddle(image.long(), pixels, 10.0)
    with pytest.raises(InputError, match="floating"):
        saddle(image, pixels.long(), 10.0)
    with pytest.raises(InputError, match="choose one of"):
        refine_corners(np.zeros((40, 40), np.uint8), pixels, torch.ones(3), "best")


def test_how_far_a_corner_may_move_depends_on_its_squares():
    """At most 2 px, and 0.3 of the side: 1.7 px are too far in squares of 5 px, and not in squares of 8 px."""
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")
    image = torch.tanh((x - 40) / 2) * torch.tanh((y - 30) / 2)
    start = torch.tensor([[41.2, 31.2]]).double()
    statuses = [int(saddle(image, start, torch.tensor([side])).status) for side in (5.0, 8.0)]
    assert statuses == [CornerStatus.MOVED, CornerStatus.GOOD]
