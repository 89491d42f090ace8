import functools
import math

import numpy as np
import pytest
import torch
from skimage.registration import phase_cross_correlation

from kcal import Camera, InputError, Rig
from kcal.corners.match import MatchOptions, MatchStatus, enlarge, match_points, refine_point
from kcal.corners.patches import filtered, gaussian_kernel, has_samples, image_windows, sample
from kcal.lens import rotation_from_vector


def corner_image(u, v, noise=0.0, seed=0, size=60):
    """A light quadrant whose corner is at (u, v), blurred by one pixel."""
    axis = torch.arange(size, dtype=torch.float64)
    image = 60 + 120 * torch.outer(torch.special.ndtr(axis - v), torch.special.ndtr(axis - u))
    return image + noise * torch.randn(size, size, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


class TestEnlarge:
    def test_maps_are_inverse_and_follow_the_half_pixel_rule(self):
        view = enlarge(torch.rand(50, 70), torch.tensor([30.4, 20.0]))
        pixels = torch.tensor([[30.37, 19.81], [18.0, 8.0]], dtype=torch.float64)
        torch.testing.assert_close(view.to_image(view.from_image(pixels)), pixels, rtol=0, atol=1e-12)
        # The crop's first pixel covers ten of the patch, its center lies between the fifth and the sixth.
        assert view.from_image(pixels[1]).tolist() == [4.5, 4.5]

    def test_a_ramp_keeps_its_place(self):
        view = enlarge(torch.arange(60.0, dtype=torch.float64).expand(40, 60), torch.tensor([30.0, 20.0]))
        x = torch.arange(view.patch.shape[1], dtype=torch.float64)
        at = view.to_image(torch.stack([x, torch.zeros_like(x)], -1))[:, 0]
        # Bilinear interpolation reproduces a ramp, but not in the outermost half pixels of the crop.
        torch.testing.assert_close(view.patch[0, 5:-5], at[5:-5], rtol=0, atol=1e-10)

    def test_crop_at_the_border(self):
        image = torch.arange(60.0, dtype=torch.float64).expand(40, 60)
        view = enlarge(image, torch.tensor([1.0, 39.0]))
        assert view.left == 0
        assert view.patch.shape == (130, 140)
        with pytest.raises(InputError, match="outside"):
            enlarge(image, torch.tensor([60.0, 0.0]))
        with pytest.raises(InputError, match="finite"):
            enlarge(image, torch.tensor([math.nan, 0.0]))


class TestRefinePoint:
    def test_quadrant_corner(self):
        # Where a blurred corner's edges meet is a convention: straight edges end 0.1 px inside the sharp one.
        for u, v in ((30.0, 30.0), (30.4, 29.7), (29.85, 30.45)):
            found = refine_point(corner_image(u, v), torch.tensor([31.0, 29.0])).pixel
            assert float((found - torch.tensor([u, v])).abs().max()) < 0.2
        here = refine_point(corner_image(30.0, 30.0), torch.tensor([30.0, 30.0])).pixel
        there = refine_point(corner_image(30.4, 29.7), torch.tensor([30.0, 30.0])).pixel
        # Differences between two such points are good: what is left is the bilinear enlargement.
        assert (there - here).tolist() == pytest.approx([0.4, -0.3], abs=0.02)

    def test_covariance_is_the_spread(self):
        found = [refine_point(corner_image(30.3, 29.8, 4.0, seed), torch.tensor([30.0, 30.0])) for seed in range(30)]
        spread = torch.stack([one.pixel for one in found]).std(0).square().mean().sqrt()
        predicted = torch.stack([one.covariance for one in found]).diagonal(dim1=-2, dim2=-1).mean().sqrt()
        # A rounded corner leaves residuals without any noise: the prediction errs on the large side.
        assert 0.5 < float(predicted / spread) < 4.0

    def test_refusals(self):
        edge = torch.special.ndtr(torch.arange(40.0, dtype=torch.float64) - 20.2).expand(40, 40)
        dead = corner_image(30.0, 30.0)
        dead[25, 25] = math.nan
        for image, place, told in (
            (torch.full((40, 40), 7.0), (20.0, 20.0), "no corner"),
            (edge, (20.0, 20.0), "no corner"),
            (corner_image(5, 5), (3.0, 20.0), "border"),
            (corner_image(30.0, 30.0), (36.0, 36.0), "away"),
            (torch.zeros(3, 40, 40), (20.0, 20.0), r"\(H, W\)"),
            (np.zeros((40, 40)), (20.0, 20.0), "ndarray"),
            (dead, (30.0, 30.0), "image: 1 of 3600 values are not finite"),
        ):
            with pytest.raises(InputError, match=told):
                refine_point(image, torch.tensor(place))


def texture(seed, points):
    """A smooth random pattern evaluated anywhere, so that every camera sees it exactly."""
    generator = torch.Generator().manual_seed(seed)
    frequency = 60 * torch.randn(80, 2, generator=generator, dtype=torch.float64)
    phase = 2 * math.pi * torch.rand(80, generator=generator, dtype=torch.float64)
    return 120 + 9 * torch.cos(points @ frequency.T + phase).sum(-1)


@functools.cache
def exact_stereo():
    """A rig that looks at a textured wall through two different lenses, and its exact images."""
    build = {"focal": (900, 905), "center": (161.0, 119.0), "size": (320, 240)}
    left = Camera.build(**build, coefficients=[-0.2, 0.05])
    right = Camera.build(focal=(930, 925), center=(158.0, 122.0), size=(320, 240), coefficients=[-0.1, 0.02, 1e-3])
    turn = rotation_from_vector(torch.tensor([0.004, -0.01, 0.03], dtype=torch.float64))
    rig = Rig.pair(left, right, turn, torch.tensor([-2.0, 0.05, 0.1], dtype=torch.float64))
    images = []
    for camera, R, t in (
        (left, torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)),
        (right, turn, rig.right_from_left_translation),
    ):
        rays, _ = camera.unproject(camera.grid(320, 240))
        rays = rays @ R  # into the left frame
        center = -R.T @ t
        wall = center + rays * ((60.0 - center[2]) / rays[..., 2])[..., None]
        images.append(texture(3, wall[..., :2] / 60.0))
    return rig, images


def stereo(noise=0.0, seed=0):
    rig, images = exact_stereo()
    generator = torch.Generator().manual_seed(seed)
    drawn = (torch.randn(image.shape, generator=generator, dtype=torch.float64) for image in images)
    return rig, *(image + noise * each for image, each in zip(images, drawn, strict=True))


def truth_of(rig, pixels, distance):
    normalized, _ = rig.left.normalize(pixels)
    return rig(torch.cat([normalized, torch.ones_like(normalized[:, :1])], -1) * distance)[0][..., 1, :]


PIXELS = torch.tensor([[160.0, 120.0], [110.4, 80.7], [220.2, 170.9], [130.5, 160.5]], dtype=torch.float64)


class TestMatch:
    def test_finds_the_point_through_both_lenses(self):
        rig, left, right = stereo()
        found = match_points(rig, left, right, PIXELS, MatchOptions(nearest=30.0))
        assert found.status.tolist() == [MatchStatus.GOOD] * 4
        # 0.01: bilinear samples of images blurred by 0.8 px.
        assert float((found.pixels - truth_of(rig, PIXELS, 60.0)).abs().max()) < 0.01
        assert float(found.score.min()) > 0.99
        assert float(found.off_line.max()) < 0.02

    @pytest.mark.slow
    @pytest.mark.parametrize("noise", [1.0, 8.0])
    def test_covariance_is_the_spread(self, noise):
        errors, predicted = [], []
        for seed in range(12):
            rig, left, right = stereo(noise=noise, seed=seed)
            found = match_points(rig, left, right, PIXELS, MatchOptions(nearest=40.0))
            good = found.status == MatchStatus.GOOD
            errors.append((found.pixels - truth_of(rig, PIXELS, 60.0))[good])
            predicted.append(found.covariance[good])
        errors, predicted = torch.cat(errors), torch.cat(predicted)
        assert len(errors) > 40
        ratio = predicted.diagonal(dim1=-2, dim2=-1).mean().sqrt() / errors.square().mean().sqrt()
        # 90 numbers know their spread to 8 %.
        assert 0.75 < float(ratio) < 1.3

    def test_brightness_and_contrast_do_not_matter(self):
        rig, left, right = stereo()
        one = match_points(rig, left, right, PIXELS, MatchOptions(nearest=30.0))
        two = match_points(rig, left, 0.5 * right + 30, PIXELS, MatchOptions(nearest=30.0))
        torch.testing.assert_close(one.pixels, two.pixels, rtol=0, atol=1e-8)

    def test_a_shifted_camera_shows_beside_the_line(self):
        # Half a pixel of vertical misalignment: the match follows the image, and says how far off the line it is.
        rig, left, right = stereo()
        parameters = rig.right.params.clone()
        parameters[3] += 0.5
        crooked = Rig.pair(
            rig.left,
            Camera(parameters, size=rig.right.size, model=rig.right.model),
            rig.right_from_left_rotation,
            rig.right_from_left_translation,
        )
        found = match_points(crooked, left, right, PIXELS, MatchOptions(nearest=30.0))
        assert found.status.tolist() == [MatchStatus.GOOD] * 4
        assert float((found.pixels - truth_of(rig, PIXELS, 60.0)).abs().max()) < 0.02
        assert found.off_line.tolist() == pytest.approx([0.5] * 4, abs=0.03)

    def test_agrees_with_phase_correlation_on_a_pure_shift(self):
        camera = Camera.build(focal=(400, 400), center=(79.5, 79.5), size=(160, 160))
        rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
        left = texture(5, camera.grid(160, 160) / 160)
        right = texture(5, (camera.grid(160, 160) + torch.tensor([7.37, 0.0])) / 160)
        found = match_points(rig, left, right, torch.tensor([[80.0, 80.0]]))
        shift, _, _ = phase_cross_correlation(
            left[40:120, 40:120].numpy(), right[40:120, 40:120].numpy(), upsample_factor=100, normalization=None
        )
        assert found.pixels[0].tolist() == pytest.approx([72.63, 80.0], abs=0.005)
        # Phase correlation of a window sees other texture enter at its edges.
        assert np.asarray(shift).tolist() == pytest.approx([0.0, 7.37], abs=0.5)

    def test_statuses(self):
        rig, left, right = stereo()
        options = MatchOptions(nearest=30.0)
        odd = torch.tensor([[math.nan, 3.0], [4.0, 4.0], [160.0, 120.0]], dtype=torch.float64)
        found = match_points(rig, left, right, odd, options)
        assert found.status.tolist() == [MatchStatus.NO_RAY, MatchStatus.OUTSIDE, MatchStatus.GOOD]
        assert torch.isnan(found.pixels[:2]).all()
        assert torch.isnan(found.covariance[:2]).all()
        middle = PIXELS[:1]
        assert match_points(rig, torch.full_like(left, 9.0), right, middle).status.tolist() == [MatchStatus.FLAT]
        noise = torch.rand(right.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        assert match_points(rig, left, noise, middle, options).status.tolist() == [MatchStatus.NO_MATCH]
        stripes = torch.sin(torch.arange(320, dtype=torch.float64) * 2 * math.pi / 12).expand(240, 320)
        straight = Rig.pair(rig.left, rig.left, torch.eye(3), torch.tensor([-2.0, 0.0, 0.0]))
        assert match_points(straight, stripes, stripes, middle, options).status.tolist() == [MatchStatus.AMBIGUOUS]
        assert match_points(rig, left, right, torch.zeros(0, 2)).pixels.shape == (0, 2)

    def test_refusals(self):
        rig, left, right = stereo()
        with pytest.raises(InputError, match="right file"):
            match_points(rig, left[:100], right, PIXELS)
        with pytest.raises(InputError, match=r"\(N, 2\)"):
            match_points(rig, left, right, PIXELS[0])
        left[3, 4] = math.nan  # one dead pixel would hide every match whose line it touches
        with pytest.raises(InputError, match="left image: 1 of"):
            match_points(rig, left, right, PIXELS)
        with pytest.raises(InputError, match="half"):
            MatchOptions(half=0)


def test_windows_cover_what_was_asked_for_and_say_where_they_end():
    image = torch.rand(100, 200, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    asked = torch.tensor([[[20.3, 30.8], [90.0, 41.2]], [[1.0, 1.0], [198.0, 98.0]]], dtype=torch.float64)
    windows = image_windows(image, asked, 0, math.inf)
    assert bool(has_samples(windows, asked).all())
    kernel = gaussian_kernel(0.8, 3)
    here = filtered(image, kernel, kernel)
    assert sample(windows, torch.tensor([[[21.0, 40.0]], [[57.0, 98.0]]], dtype=torch.float64)).tolist() == [
        [pytest.approx(float(here[40, 21]))],
        [pytest.approx(float(here[98, 57]))],
    ]
    # In the image, but beside the first window.
    assert has_samples(windows, torch.tensor([5.0, 10.0]).double().expand(2, 1, 2)).tolist() == [[False], [True]]
    # Beyond the image, and where a sample's slope would be.
    for odd in ((400.0, 35.0), (21.0, 99.0), (21.0, -3.0), (0.5, 30.0)):
        assert not bool(has_samples(windows, torch.tensor(odd).double().expand(2, 1, 2)).any())


def test_a_window_far_beyond_the_image_has_no_samples():
    image = torch.rand(100, 200, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    asked = torch.tensor([[[3000.0, -900.0]]], dtype=torch.float64)
    windows = image_windows(image, asked, 0, math.inf)
    assert windows.values.shape[1] < 10
    assert not bool(has_samples(windows, asked).any())
