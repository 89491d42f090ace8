"""Refinement of corners: the saddle point, and the edges with their blur."""

import functools
import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from board_render import homography, render
from hypothesis import given, settings
from hypothesis import strategies as st

from kcal import Board, CalibrationOptions, Camera, InputError, calibrate_camera, detect
from kcal.corners.erf import erf_saddle
from kcal.corners.erf_board import NAMES, LineDistances, crossing
from kcal.corners.grid import line_bend, local_side, neighbors
from kcal.corners.refine import _saturation_levels, refine_corners
from kcal.corners.saddle import CornerStatus, saddle
from kcal.sim.captures import BoardSize, project_board
from kcal.sim.scene import RenderOptions, render_light

BOARD = Board(columns=5, rows=4, square=0.02)


def scene(square, blur=1.0, noise=2.0, seed=0, tilt=(0.1, -0.05), roll=0.1, near=False, **options):
    """An image, its corners, where to begin, and sides; `near`: as near to the corners as the saddle point comes."""
    rng = np.random.default_rng(seed)
    size = int(square * 7.5) + 24, int(square * 6.5) + 24
    H = homography(BOARD, size, square, tilt, roll, rng.uniform(-0.5, 0.5, 2))
    image, truth = render(BOARD, size, H, blur, noise, seed, **options)
    side = local_side(truth, BOARD.columns, BOARD.rows)
    off = torch.from_numpy(rng.normal(0, 1, truth.shape))
    if near:
        return image, truth, truth + (0.1 * off).clamp(-0.3, 0.3), side
    return image, truth, truth + off.clamp(-2, 2) * (0.07 * side[:, None]).clamp(max=0.5), side


edge_scene = functools.partial(scene, near=True)
# The erf fits of a batch go on until the last corner stands still.
BOTH = pytest.mark.parametrize(("by", "of", "atol"), [(saddle, scene, 1e-12), (erf_saddle, edge_scene, 1e-6)])


def rms(pixels, truth):
    """Root of the mean squared distance along each axis."""
    return float((pixels - truth).square().mean().sqrt())


# 0.009 and 0.0065 over many boards at this noise and blur; the limits leave room for the chance of 80 corners. No bias:
# the mean of 80 errors of 0.009 has a sigma of 0.001.
@pytest.mark.parametrize(
    ("by", "of", "largest", "bias"), [(saddle, scene, 0.012, 0.004), (erf_saddle, edge_scene, 0.008, 0.003)]
)
def test_twenty_pixel_squares_are_found_to_a_hundredth_of_a_pixel(by, of, largest, bias):
    errors = []
    for seed in range(4):
        image, truth, start, side = of(20, seed=seed)
        found = by(torch.from_numpy(image).double(), start, side)
        assert bool((found.status == CornerStatus.GOOD).all())
        errors.append(found.pixels - truth)
    errors = torch.cat(errors)
    assert float(errors.square().mean().sqrt()) < largest
    assert float(errors.mean(0).abs().max()) < bias


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


@BOTH
def test_transposed_image_gives_transposed_corners(by, of, atol):
    image, _, start, side = of(16)
    image = torch.from_numpy(image).double()
    one, two = by(image, start, side), by(image.T, start.flip(-1), side)
    torch.testing.assert_close(one.pixels, two.pixels.flip(-1), rtol=0, atol=max(atol, 1e-10))
    if by is erf_saddle:
        torch.testing.assert_close(one.covariance, two.covariance.flip(-1, -2), rtol=1e-3, atol=0)


@BOTH
def test_batch_equals_one_by_one(by, of, atol):
    scenes = [of(16, seed=seed) for seed in range(3)]
    images = torch.stack([torch.from_numpy(s[0]).double() for s in scenes])
    starts, sides = torch.stack([s[2] for s in scenes]), torch.stack([s[3] for s in scenes])
    together = by(images, starts, sides)
    for k, (image, start, side) in enumerate(zip(images, starts, sides, strict=True)):
        one = by(image, start, side)
        torch.testing.assert_close(together.pixels[k], one.pixels, rtol=0, atol=atol)
        assert bool((together.status[k] == one.status).all())


def test_saddles_may_be_mapped():
    image, _, start, side = scene(16)
    light = torch.from_numpy(image).double()
    mapped = torch.func.vmap(lambda one: saddle(one, start, side).pixels)(light[None])
    torch.testing.assert_close(mapped[0], saddle(light, start, side).pixels, rtol=0, atol=1e-10)


def test_gradient_with_respect_to_the_image():
    x = torch.arange(33.0, dtype=torch.float64)
    image = torch.outer(torch.tanh((x - 16.2) / 2), torch.tanh((x - 15.7) / 2))
    image = image + 0.05 * torch.sin(0.9 * x)[None] * torch.cos(0.7 * x)[:, None]
    start = torch.tensor([[16.0, 16.0]], dtype=torch.float64)

    def corner(center):
        return saddle(torch.nn.functional.pad(center, (14, 14, 14, 14)) + image, start, 20.0).pixels

    # Bilinear sampling has kinks, none of them within the finite difference here.
    assert torch.autograd.gradcheck(corner, (torch.zeros(5, 5, dtype=torch.float64, requires_grad=True),), eps=1e-6)


@pytest.mark.parametrize("by", [saddle, erf_saddle])
def test_gradient_is_finite_with_bad_corners_about(by):
    image = torch.rand(50, 50, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    found = by(image, torch.tensor([[25.0, 25.0], [math.nan, 3.0], [1.0, 1.0]], dtype=torch.float64), 20.0)
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
        for u, v in [(margin, 30.0), (width - 1 - margin, 30.0), (35.0, margin), (35.0, height - 1 - margin)]:
            found = saddle(torch.tanh((x - u) / 2) * torch.tanh((y - v) / 2), torch.tensor([[u, v]]).double(), 20.0)
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


def ideal(parameters, size=41):
    """An image that is the model itself, its corner relative to the middle pixel."""
    axis = torch.arange(size, dtype=torch.float64) - size // 2
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    where = torch.stack([x, y], -1).reshape(-1, 2)
    levels, _ = crossing(torch.tensor(parameters).double(), where, torch.zeros(2, dtype=torch.float64))
    return levels.reshape(size, size)


def blurred(pattern, where, reach, step, sigma):
    """A pattern at places (N, 2), integrated against a Gaussian on a fine grid: no series, no error functions."""
    fine = torch.arange(-reach, reach, step, dtype=torch.float64) + step / 2
    v, u = torch.meshgrid(fine, fine, indexing="ij")
    kernel = torch.exp(-0.5 * (u**2 + v**2) / sigma**2)
    kernel = kernel / kernel.sum()
    return torch.stack([(pattern(x - u, y - v) * kernel).sum() for x, y in where.tolist()])


class TestCrossing:
    def test_order_of_the_parameters(self):
        assert NAMES == (
            "dx", "dy", "angle1", "angle2", "log_blur", "mean", "contrast", "ramp_x", "ramp_y", "bow",
        )  # fmt: skip

    @settings(max_examples=25, deadline=None)
    @given(st.integers(0, 10**6))
    def test_jacobian(self, seed):
        generator = torch.Generator().manual_seed(seed)
        draw = torch.rand(10, generator=generator, dtype=torch.float64) - 0.5
        parameters = draw * torch.tensor([1, 1, 0.8, 0.8, 1, 100, 160, 0.02, 0.02, 30]).double()
        parameters = parameters + torch.tensor([0, 0, 0.2, 1.7, 0.3, 128, 0, 0, 0, 0]).double()
        where = 6 * torch.randn(50, 2, generator=generator, dtype=torch.float64)
        bend = 0.02 * torch.randn(2, generator=generator, dtype=torch.float64)
        by_autograd = torch.func.jacfwd(lambda p: crossing(p, where, bend)[0])(parameters).T
        torch.testing.assert_close(crossing(parameters, where, bend)[1], by_autograd, rtol=1e-12, atol=1e-11)
        distance = 4 + 4 * torch.rand(2, 2, 50, generator=generator, dtype=torch.float64)
        beside = LineDistances(distance, torch.tensor([[1.0, 0.5], [0.0, 1.0]]).double()[..., None])
        by_autograd = torch.func.jacfwd(lambda p: crossing(p, where, bend, beside)[0])(parameters).T
        torch.testing.assert_close(crossing(parameters, where, bend, beside)[1], by_autograd, rtol=1e-12, atol=1e-11)

    @pytest.mark.parametrize("opening", [90.0, 70.0, 50.0])
    def test_values_are_the_blurred_pattern(self, opening):
        angles = 0.3, 0.3 + math.radians(opening)

        def pattern(x, y):
            sides = [(math.cos(a) * y - math.sin(a) * x).sign() for a in angles]
            return sides[0] * sides[1]

        where = torch.tensor([[0.0, 0.0], [0.5, 0.2], [-1.0, 0.7], [2.0, 1.0], [0.3, -1.8]], dtype=torch.float64)
        wanted = blurred(pattern, where, 9, 0.02, 1.3)
        parameters = torch.tensor([0, 0, *angles, math.log(1.3), 0, 1, 0, 0, 0]).double()
        levels, _ = crossing(parameters, where, torch.zeros(2, dtype=torch.float64))
        # 4e-4: steps of 0.02 px in the integral; at 50° the series leaves out 2e-3.
        torch.testing.assert_close(levels, wanted, rtol=0, atol=3e-3 if opening == 50.0 else 6e-4)

    def test_values_of_bent_lines_are_the_blurred_pattern(self):
        """A blurred bent edge lies beside the line itself, by half the bend times the blur squared."""
        bend, blur = torch.tensor([0.02, 0.0], dtype=torch.float64), 1.0

        def pattern(x, y):
            # Edge 1 lies along x with its normal along y, edge 2 along y with its normal along -x.
            return (y - 0.5 * bend[0] * x**2).sign() * (-x).sign()

        # Three sigmas beside the other edge: nearer, both bend into each other, which is left out.
        where = torch.tensor([[3.0, 0.0], [3.0, 0.5], [-3.0, 0.2], [-3.0, -0.4]], dtype=torch.float64)
        wanted = blurred(pattern, where, 6, 0.02, blur)
        parameters = torch.tensor([0, 0, 0, math.pi / 2, math.log(blur), 0, 1, 0, 0, 0]).double()
        # 0.01 px of shift changes these by 0.008.
        torch.testing.assert_close(crossing(parameters, where, bend)[0], wanted, rtol=0, atol=2e-3)

    def test_values_are_those_of_the_next_squares_too(self):
        def pattern(x, y):
            # Lines 4 px to the right (more squares) and 5 px below (the margin, light).
            across = x.sign() * torch.where(x > 4, -1.0, 1.0)
            return torch.where(y > 5, 1.0, across * y.sign())

        where = torch.tensor([[0.0, 0.0], [2.0, 1.0], [3.0, -2.0], [-2.0, 3.5], [3.0, 3.0]], dtype=torch.float64)
        wanted = blurred(pattern, where, 16, 0.04, 2.0)
        # Edge 1 lies along y (its normal is -x), edge 2 along x.
        parameters = torch.tensor([0, 0, math.pi / 2, 0.0, math.log(2.0), 0, -1, 0, 0, 0]).double()
        turn = torch.tensor([[0.0, 1.0], [0.5, 0.0]]).double()[..., None]
        distance = torch.tensor([[1e6, 4.0], [5.0, 1e6]]).double()[..., None]
        levels, _ = crossing(parameters, where, torch.zeros(2, dtype=torch.float64), LineDistances(distance, turn))
        # The margin begins beyond the last square, whose tail there is left out: 2 % at the last place, which is 1 px
        # from both lines.
        torch.testing.assert_close(levels[:4], wanted[:4], rtol=0, atol=6e-3)
        assert float((levels[4] - wanted[4]).abs()) < 0.1


class TestFit:
    @pytest.mark.parametrize("opening", [90.0, 75.0, 60.0])
    def test_finds_the_parameters_of_its_own_model(self, opening):
        truth = [0.31, -0.22, 0.2, 0.2 + math.radians(opening), math.log(1.1), 120.0, 70.0, 0.0, 0.0, 6.0]
        found = erf_saddle(ideal(truth), torch.tensor([[20.0, 20.0]]), 24.0)
        # The last step is below 1e-5 px, and of what was left before it a damping of 1e-4 remains.
        torch.testing.assert_close(found.pixels, torch.tensor([[20.31, 19.78]], dtype=torch.float64), rtol=0, atol=1e-8)
        assert float(found.blur[0]) == pytest.approx(1.1, abs=1e-8)
        assert found.status.tolist() == [CornerStatus.GOOD]

    @pytest.mark.parametrize(("square", "blur"), [(12, 0.7), (20, 1.0), (40, 2.0)])
    def test_covariance_is_the_spread_of_the_errors(self, square, blur):
        errors, predicted = [], []
        for seed in range(6):
            image, truth, start, side = edge_scene(square, blur, 3.0, seed, supersample=4)
            found = erf_saddle(torch.from_numpy(image).double(), start, side)
            keep = found.status == CornerStatus.GOOD
            errors.append((found.pixels - truth)[keep])
            predicted.append(found.covariance[keep])
        errors, predicted = torch.cat(errors), torch.cat(predicted)
        ratio = predicted.diagonal(dim1=-2, dim2=-1).mean().sqrt() / errors.square().mean().sqrt()
        # 240 numbers know their own spread to 5 %; the aim is 20 %.
        assert 0.8 < float(ratio) < 1.2
        normalized = torch.linalg.solve_triangular(torch.linalg.cholesky(predicted), errors[..., None], upper=False)
        assert 0.8 < float(normalized.square().mean().sqrt()) < 1.2

    def test_bent_lines_do_not_move_the_corner(self):
        # Through strong barrel distortion the lines through an outer corner bend to one side.
        camera = Camera.build(focal=(420, 420), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.3, 0.1])
        size = BoardSize(5, 4, 0.02)
        pose = torch.eye(3, dtype=torch.float64), torch.tensor([0.07, 0.04, 0.22], dtype=torch.float64)
        truth, visible = project_board(camera, pose, size)
        light = render_light(camera, pose, size, RenderOptions(blur=0.8, vignetting=0))
        side = local_side(truth, 5, 4)
        assert bool(visible.all())
        straight = erf_saddle(light, truth, side).pixels - truth
        bent = erf_saddle(light, truth, side, bend=line_bend(truth, 5, 4)).pixels - truth
        assert float(straight.square().mean().sqrt()) > 3 * float(bent.square().mean().sqrt())
        # At this tilt and distortion a circle is not all of the bend either.
        assert float(bent.abs().max()) < 0.008

    def test_vignetting_does_not_move_the_corner(self):
        # Light that grows to one side makes the squares there count more; the whole board tells by how much.
        image, truth, start, side = edge_scene(10, noise=0, supersample=8, dtype=np.float64)
        y, x = np.mgrid[: image.shape[0], : image.shape[1]]
        found = erf_saddle(torch.from_numpy(image * (1 + 0.003 * x - 0.002 * y)), start, side)
        # The renderer's sampling alone is some 0.001.
        assert float((found.pixels - truth).square().mean().sqrt()) < 0.002

    def test_blur_of_a_fifth_of_the_square_is_fitted_with_the_next_lines(self):
        errors, alone, predicted = [], [], []
        for seed in range(4):
            image, truth, start, side = edge_scene(10, 2.0, 1.0, seed, tilt=(0.15, -0.1))
            found = refine_corners(image, start, side, "erf", (5, 4))
            assert int((found.status == CornerStatus.GOOD).sum()) >= 18
            errors.append((found.pixels - truth)[found.status == CornerStatus.GOOD])
            predicted.append(found.covariance[found.status == CornerStatus.GOOD])
            single = refine_corners(image, start, side, "erf")
            alone.append((single.pixels - truth)[single.status == CornerStatus.GOOD])
        errors, alone, predicted = torch.cat(errors), torch.cat(alone), torch.cat(predicted)
        assert float(errors.square().mean().sqrt()) < 0.6 * float(alone.square().mean().sqrt())
        ratio = predicted.diagonal(dim1=-2, dim2=-1).mean().sqrt() / errors.square().mean().sqrt()
        assert 0.7 < float(ratio) < 1.3  # 160 numbers know their own spread to 6 %

    def test_tone_curve_does_not_move_the_corner(self):
        image, truth, start, side = edge_scene(20, noise=0, supersample=8, dtype=np.float64)
        found = erf_saddle(255 * (torch.from_numpy(image) / 255) ** 0.45, start, side)
        assert bool((found.status == CornerStatus.GOOD).all())
        # 0.001 without the curve: the renderer's sampling.
        assert float((found.pixels - truth).square().mean().sqrt()) < 0.002

    def test_gray_scale_does_not_matter(self):
        # An offset does, a little: light multiplies what is there, and black would not be black.
        image, _, start, side = edge_scene(20)
        image = torch.from_numpy(image).double()
        one, two = erf_saddle(image, start, side), erf_saddle(image * 257, start, side)
        # Both stop within 1e-5 px of the minimum, and converge quadratically to far below.
        torch.testing.assert_close(one.pixels, two.pixels, rtol=0, atol=1e-6)
        torch.testing.assert_close(one.covariance, two.covariance, rtol=1e-3, atol=0)


class TestGradient:
    @pytest.mark.slow
    def test_with_respect_to_the_image(self):
        image = ideal([0.2, -0.1, 0.1, 1.5, 0.2, 120.0, 70.0, 0.0, 0.0, 3.0], 33)
        image = image + 3.0 * torch.randn(33, 33, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        start = torch.tensor([[16.0, 16.0]], dtype=torch.float64)

        def corner(middle):
            return erf_saddle(image + torch.nn.functional.pad(middle, (14, 14, 14, 14)), start, 16.0).pixels

        middle = torch.zeros(5, 5, dtype=torch.float64, requires_grad=True)
        # The minimum is found to about 1e-7 px, over a difference of 0.1 gray levels.
        assert torch.autograd.gradcheck(corner, (middle,), eps=0.1, atol=2e-6)


class TestRejection:
    def test_outside_missing_and_flat(self):
        image, _, start, side = edge_scene(20)
        start = start.clone()
        start[0], start[1] = math.nan, torch.tensor([4.0, 60.0])
        found = erf_saddle(torch.from_numpy(image), start, side)
        assert found.status[:2].tolist() == [CornerStatus.MISSING, CornerStatus.OUTSIDE]
        for value in (found.pixels, found.covariance.flatten(-2), found.blur[:, None]):
            assert bool(torch.isnan(value[:2]).all())
            assert bool(torch.isfinite(value[2:]).all())
        flat = erf_saddle(torch.full((50, 50), 128.0), torch.tensor([[25.0, 25.0]]), 20.0)
        assert flat.status.tolist() == [CornerStatus.NO_SADDLE]

    def test_covered_corner(self):
        image, truth, _, side = edge_scene(30, noise=1)
        y, x = np.mgrid[: image.shape[0], : image.shape[1]]
        column, row = truth[7].tolist()
        image[np.hypot(x - column - 9, y - row - 5) < 8] = 130
        found = refine_corners(image, truth, side, "erf", (5, 4))
        assert int(found.status[7]) in (CornerStatus.OCCLUDED, CornerStatus.NO_SADDLE)
        assert int((found.status == CornerStatus.GOOD).sum()) == 19

    def test_saturated_corners(self):
        image, truth, start, side = edge_scene(24)
        glaring = np.clip(image.astype(float) * 8, 0, 255).astype(np.uint8)
        found = refine_corners(glaring, start, side, "erf", (5, 4))
        assert bool(torch.isnan(found.pixels).all())
        assert int((found.status == CornerStatus.SATURATED).sum()) > 10
        # White paper at the end of the scale alone is no harm.
        white = np.clip(image.astype(float) * 1.25, 0, 255).astype(np.uint8)
        found = refine_corners(white, start, side, "erf", (5, 4))
        assert bool((found.status == CornerStatus.GOOD).all())
        assert float((found.pixels - truth).square().mean().sqrt()) < 0.01

    @pytest.mark.parametrize(
        ("brightest", "kind", "level"),
        [(200, np.uint8, 255), (255, np.uint8, 255), (4000, np.uint16, 4095), (4095, np.uint16, 4095),
         (4094, np.uint16, 4094), (65535, np.uint16, 65535), (0, np.uint8, 255)],
    )  # fmt: skip
    def test_a_pixel_is_saturated_at_the_end_of_its_bits(self, brightest, kind, level):
        """A camera's 10, 12 or 14 bits; a level nearly as high that is the brightest of all counts as the end."""
        assert _saturation_levels(brightest) == (0.0, float(level))

    def test_blurred_corners(self):
        image, _, start, side = edge_scene(12, blur=5.0, noise=0.2)
        found = erf_saddle(torch.from_numpy(image).double(), start, side)
        assert int((found.status == CornerStatus.BLURRED).sum()) >= 18

    def test_sixteen_bits_of_a_twelve_bit_camera(self):
        image, _, start, side = edge_scene(20)
        found = refine_corners(image.astype(np.uint16) * 16, start, side, "erf", (5, 4))
        assert bool((found.status == CornerStatus.GOOD).all())

    def test_noisy_images_are_judged_by_their_own_noise(self):
        image, _, start, side = edge_scene(24, noise=22)
        found = erf_saddle(torch.from_numpy(image).double(), start, side)
        assert int((found.status == CornerStatus.GOOD).sum()) >= 19

    def test_bad_arguments(self):
        image, pixels = torch.zeros(40, 40), torch.zeros(3, 2)
        with pytest.raises(InputError, match="bend"):
            erf_saddle(image, pixels, 10.0, bend=torch.zeros(3, 2))
        with pytest.raises(InputError, match="positive"):
            erf_saddle(image, pixels, -1.0)
        with pytest.raises(InputError, match="around"):
            erf_saddle(image, pixels, 10.0, around=neighbors(torch.zeros(4, 2), 2, 2))
        assert erf_saddle(image, torch.zeros(0, 2), torch.zeros(0)).pixels.shape == (0, 2)


class TestBend:
    def test_perspective_bends_nothing(self):
        _, truth, _, _ = edge_scene(20, tilt=(0.5, 0.4))
        assert float(line_bend(truth, 5, 4).abs().max()) < 1e-12

    def test_circle_and_unseen_corners(self):
        angle = torch.linspace(-0.3, 0.3, 7, dtype=torch.float64)
        row = torch.stack([500 * angle.sin(), 500 - 500 * angle.cos()], -1)
        grid = torch.cat([row, row + torch.tensor([0.0, 30.0]).double(), row + torch.tensor([0.0, 60.0]).double()])
        grid[8] = math.nan
        across = line_bend(grid, 7, 3)[:, 0]
        radius = 1 / torch.linalg.vector_norm(across, dim=-1)
        # A quadratic of the board does not give a circle's components exactly.
        torch.testing.assert_close(radius[:7], torch.full((7,), 500.0).double(), rtol=1e-3, atol=0)
        assert bool(torch.isfinite(across).all())
        # To the middle of the circle, below.
        assert bool((across[:7, 1] > 0).all())


class TestNoise:
    """White noise is no part of these images: JPEG's, rounding and smoothed noise must be found out."""

    @pytest.mark.parametrize("kind", ["rounding", "jpeg", "smooth"])
    def test_covariance(self, kind):
        errors, predicted = [], []
        for seed in range(6):
            image, truth, start, side = edge_scene(16, 1.0, 0.0, seed, supersample=8, dtype=np.float64)
            rng = np.random.default_rng(seed)
            if kind == "smooth":
                image = image + 4 * cv2.GaussianBlur(rng.standard_normal(image.shape), (0, 0), 0.7)
            else:
                image = 60 + 0.3 * image
            image = image.round().clip(0, 255).astype(np.uint8)
            if kind == "jpeg":
                image = cv2.imdecode(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 85])[1], 0)
            found = refine_corners(image, start, side, "erf", (5, 4))
            keep = found.status == CornerStatus.GOOD
            errors.append((found.pixels - truth)[keep])
            predicted.append(found.covariance[keep])
        errors, predicted = torch.cat(errors), torch.cat(predicted)
        ratio = predicted.diagonal(dim1=-2, dim2=-1).mean().sqrt() / errors.square().mean().sqrt()
        assert 0.75 < float(ratio) < 1.25  # 240 numbers know their own spread to 5 %; the aim is 20 %


class TestNeighbors:
    def test_perspective_is_foreseen_at_the_border(self):
        _, truth, _, _ = edge_scene(20, tilt=(0.2, 0.15))
        around = neighbors(truth, 5, 4)
        size = int(20 * 7.5) + 24, int(20 * 6.5) + 24
        # The board with one more square on each side has the outer squares' ends among its corners.
        bigger = Board(columns=7, rows=6, square=0.02)
        H = homography(
            bigger, size, 20, (0.2 * 8 / 6, 0.15 * 7 / 5), 0.1, np.random.default_rng(0).uniform(-0.5, 0.5, 2)
        )
        squares = np.concatenate([bigger.points[:, :2].numpy() / 0.02, np.ones((42, 1))], 1) @ H.T
        all_corners = torch.from_numpy(squares[:, :2] / squares[:, 2:]).reshape(6, 7, 2)
        torch.testing.assert_close(all_corners[1:-1, 1:-1].reshape(-1, 2), truth, rtol=0, atol=1e-9)
        wanted = (
            torch.stack(
                [all_corners[1:-1, :-2], all_corners[1:-1, 2:], all_corners[:-2, 1:-1], all_corners[2:, 1:-1]], 2
            )
            - all_corners[1:-1, 1:-1][:, :, None]
        )
        miss = (around.step - wanted.reshape(-1, 4, 2)).norm(dim=-1)
        # Of 14 to 31 px: c is not quite the same on all lines.
        assert float(miss.max()) < 0.8
        assert int(around.outer.sum()) == 2 * (5 + 4)

    def test_unseen_corners(self):
        _, truth, _, _ = edge_scene(20)
        seen = truth.clone()
        truth[6] = math.nan
        around = neighbors(truth, 5, 4)
        # Corner 7's step follows from the corners on its other side; corner 6 has nothing.
        torch.testing.assert_close(around.step[7, 0], neighbors(seen, 5, 4).step[7, 0], rtol=0, atol=1e-9)
        assert bool(torch.isnan(around.step[6]).all())
        assert bool(torch.isfinite(around.change).all())


@pytest.mark.slow
@pytest.mark.parametrize("side", ["left", "right"])
def test_real_images_calibrate_to_sixteen_hundredths(side):
    data = os.environ.get("KCAL_DATA")
    if not data:
        pytest.skip("KCAL_DATA is not set: no real images")
    paths = sorted(Path(data, "opencv_stereo").glob(f"{side}*.jpg"))
    seen = detect(paths, Board(columns=9, rows=6, square=0.025))
    assert len(seen.views) == len(paths) == 13
    assert sum(view.pixels.count(None) for view in seen.views) <= 2
    plain = calibrate_camera(seen, CalibrationOptions(model="opencv5", weighted=False))
    # 0.1575 and 0.1540; the saddle alone has 0.165 and 0.163.
    assert plain.rms < 0.160
    # Weights hardly change it: board and lens leave more than the corners' noise.
    assert plain.rms <= calibrate_camera(seen, CalibrationOptions(model="opencv5")).rms < 1.001 * plain.rms
