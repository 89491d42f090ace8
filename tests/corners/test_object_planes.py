"""Planes of objects in both images, shifts on them with their gradients, keypoints, and points found again."""

import math

import numpy as np
import pytest
import torch
from locate_rigs import real_rig, spread_points, tensor
from torch import Tensor

from kcal.corners.match import Keypoints, MatchOptions, MatchStatus, find_again, keypoints, pose_between
from kcal.corners.patches import (
    ShiftFit,
    fit_shifts,
    grid_of,
    image_windows,
    object_planes,
    plane_pixels,
    plane_places,
    sample,
)
from kcal.errors import InputError
from kcal.lens.pose import rotation_from_vector

RIG = real_rig()


class TestPlanes:
    POINTS = spread_points(torch.tensor([80.0, 200.0, 500.0, 3000.0], dtype=torch.float64))

    def test_one_place_of_any_distance_is_in_one_row(self) -> None:
        """A point and one behind it differ in the column alone, by the parallax; whatever the lenses."""
        left, right = RIG(self.POINTS)[0].unbind(-2)
        planes = object_planes(RIG, left, right, torch.zeros(4))
        assert bool(planes.valid.all())
        torch.testing.assert_close(
            planes.axes @ planes.axes.mT, torch.eye(3).double().expand(4, 3, 3), rtol=0, atol=1e-14
        )
        torch.testing.assert_close(torch.linalg.det(planes.axes), torch.ones(4).double())
        shown, seen = plane_pixels(RIG.left, planes, planes.left[:, None])
        assert bool(seen.all())
        torch.testing.assert_close(shown[:, 0], left, rtol=0, atol=1e-8)
        beside, _ = plane_pixels(RIG.right, planes, planes.right[:, None], RIG.right_from_left_rotation)
        torch.testing.assert_close(beside[:, 0], right, rtol=0, atol=1e-8)
        torch.testing.assert_close(planes.left[:, 1], torch.zeros(4).double())
        torch.testing.assert_close(planes.right[:, 1], planes.left[:, 1], rtol=0, atol=1e-10)
        # Baseline over distance across it: z is what the plane's third axis sees.
        depth = (planes.axes[:, 2] * self.POINTS).sum(-1)
        torch.testing.assert_close(planes.left[:, 0] - planes.right[:, 0], RIG.baseline / depth, rtol=1e-9, atol=0)

    def test_a_step_is_a_pixel_of_the_left_image_along_the_baseline(self) -> None:
        left, right = RIG(self.POINTS)[0].unbind(-2)
        for level in (0, 2):
            planes = object_planes(RIG, left, right, torch.full((4,), level))
            ends = planes.left[:, None] + planes.step[:, None, None] * tensor([-0.5, 0.0], [0.5, 0.0])
            pixels, _ = plane_pixels(RIG.left, planes, ends)
            length = (pixels[:, 1] - pixels[:, 0]).norm(dim=-1)
            torch.testing.assert_close(length, torch.full((4,), 2.0**level).double(), rtol=1e-4, atol=0)

    def test_pixels_and_places_are_each_others_inverse(self) -> None:
        left, right = RIG(self.POINTS)[0].unbind(-2)
        planes = object_planes(RIG, left, right, torch.zeros(4))
        places = planes.left + tensor([0.01, 0.02], [-0.03, 0.0], [0.0, 0.05], [0.02, -0.02])
        pixels, valid = plane_pixels(RIG.left, planes, places[:, None])
        # Any axes between, also none.
        assert torch.equal(plane_pixels(RIG.left, planes, places)[0], pixels[:, 0])
        assert torch.equal(plane_pixels(RIG.left, planes, places[:, None, None])[1], valid[:, None])
        found, seen = plane_places(RIG.left, planes, pixels[:, 0])
        assert bool(seen.all())
        torch.testing.assert_close(found, places, rtol=0, atol=1e-10)

    def test_what_has_no_plane_is_said(self) -> None:
        left, right = RIG(self.POINTS[:3])[0].unbind(-2)
        left[0], right[1] = math.nan, math.nan
        assert object_planes(RIG, left, right, torch.zeros(3)).valid.tolist() == [False, False, True]


def texture(seed: int, size: int = 72) -> Tensor:
    """Smooth noise, gray levels of 0 to 255."""
    draw = torch.rand(1, 1, size // 6, size // 6, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return 200.0 * torch.nn.functional.interpolate(draw, size=(size, size), mode="bicubic")[0, 0] + 20.0


def patches(shift: tuple[float, float], gain: float = 1.0, half: int = 8) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Template, image, places at zero shift and slopes: the image shows the template moved by `shift`."""
    image = texture(3)
    places = tensor([36.0, 36.0])[:, None, None] + grid_of((half, half), image.device)[None]
    slopes = torch.eye(2, dtype=torch.float64).expand(1, 2 * half + 1, 2 * half + 1, 2, 2)
    template = (sample(image_windows(image, places, 0, math.inf), places + tensor(*shift)) - 10.0) / gain
    return template, image, places, slopes


def fitted(template: Tensor, image: Tensor, places: Tensor, slopes: Tensor, **options: bool) -> ShiftFit:
    """The shifts of all patches in an image."""
    windows, wanted = image_windows(image, places, 0, math.inf), torch.ones(len(places), dtype=torch.bool)
    return fit_shifts(template, windows, places, slopes, torch.ones_like(template), wanted, **options)


class TestShifts:
    @pytest.mark.parametrize("sheared", [False, True])
    @pytest.mark.parametrize("robust", [False, True])
    def test_a_shift_is_found_whatever_light_there_is(self, robust: bool, sheared: bool) -> None:
        found = fitted(*patches((0.7, -0.4), gain=1.3), robust=robust, sheared=sheared)
        assert bool(found.converged.all())
        torch.testing.assert_close(found.shift, tensor([0.7, -0.4]), rtol=0, atol=2e-4)
        assert float(found.share[0]) > 0.8

    def test_an_image_that_is_stretched_needs_shear(self) -> None:
        template, image, places, slopes = patches((0.0, 0.0))
        middle = tensor(36.0, 36.0)
        away = places - middle
        squeezed = middle + torch.stack([away[..., 0] * 0.97 - 0.02 * away[..., 1] + 0.5, away[..., 1]], -1)
        plain, sheared = (fitted(template, image, squeezed, slopes, sheared=sheared) for sheared in (False, True))
        assert abs(float(sheared.shift[0, 0]) + 0.5) < 2e-3
        assert sheared.shear[0].tolist() == pytest.approx([0.03, 0.02], rel=0.1)
        assert plain.shear[0].tolist() == [0.0, 0.0]
        assert float((sheared.covariance[0] - plain.covariance[0]).diagonal().max()) < 0

    def test_what_stands_in_front_loses_its_weight(self) -> None:
        template, image, places, slopes = patches((0.3, 0.2))
        noisy = image + torch.randn(image.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
        spoilt = noisy.clone()
        spoilt[28:34, 28:34] += 90.0
        clean, robust, plain = (
            fitted(template, shown, places, slopes, robust=robust)
            for shown, robust in ((noisy, True), (spoilt, True), (spoilt, False))
        )
        wanted = tensor([0.3, 0.2])
        assert float((robust.shift - wanted).norm()) < 0.05
        assert float((plain.shift - wanted).norm()) > 3.0 * float((robust.shift - wanted).norm())
        assert float(robust.share[0]) < float(clean.share[0]) - 0.1

    def test_sigma_is_that_of_repeated_noise(self) -> None:
        template, image, places, slopes = patches((0.3, 0.2))
        count, generator = 60, torch.Generator().manual_seed(5)
        found: list[ShiftFit] = []
        for _ in range(count):
            noisy = image + 3.0 * torch.randn(image.shape, generator=generator, dtype=torch.float64)
            found.append(fitted(template, noisy, places, slopes))
        error = torch.cat([one.shift for one in found]) - tensor([0.3, 0.2])
        stated = torch.cat([one.covariance for one in found]).mean(0).diagonal()
        ratio = error.square().mean(0) / stated
        # 60 repetitions know a variance to 18 %.
        assert bool(((ratio > 0.45) & (ratio < 1.7)).all())

    @pytest.mark.parametrize("half", [4, 6])
    def test_intervals_of_small_objects_hold(self, half: int) -> None:
        """Of two images with noise: weights that follow it make residuals smaller than the noise is."""
        image, generator = texture(3, 600), torch.Generator().manual_seed(6)
        middle = 20.0 + 560.0 * torch.rand(300, 1, 1, 2, generator=generator, dtype=torch.float64)
        places = middle + grid_of((half, half), image.device)
        first, second = image + 12.0 * torch.randn(2, *image.shape, generator=generator, dtype=torch.float64)
        slopes = torch.eye(2, dtype=torch.float64).expand(*places.shape, 2)
        found = fitted(sample(image_windows(first, places, 0, math.inf), places), second, places, slopes)
        ratio = (found.shift / found.covariance.diagonal(dim1=1, dim2=2).sqrt())[found.converged]
        assert len(ratio) > 270
        # 540 numbers know their RMS to 3 %.
        assert 0.6 < float(ratio.square().mean().sqrt()) < 1.03
        assert float((ratio.abs() < 1.96).double().mean()) > 0.94

    def test_objects_that_are_not_wanted_are_zero(self) -> None:
        template, image, places, slopes = (
            torch.cat([one, one]) if one.ndim > 2 else one for one in patches((0.7, -0.4))
        )
        windows = image_windows(image, places, 0, math.inf)
        found = fit_shifts(template, windows, places, slopes, torch.ones_like(template), torch.tensor([False, True]))
        assert found.converged.tolist() == [False, True]
        assert found.shift[0].tolist() == [0.0, 0.0]
        torch.testing.assert_close(found.shift[1], tensor(0.7, -0.4), rtol=0, atol=2e-4)
        nothing = fit_shifts(template, windows, places, slopes, torch.ones_like(template), torch.zeros(2).bool())
        assert nothing.shift.shape == (2, 2)
        assert not bool(nothing.converged.any())

    @pytest.mark.parametrize("sheared", [False, True])
    def test_gradients_are_those_of_the_fit(self, sheared: bool) -> None:
        """By differences of whole fits, with noise, so that residuals count."""
        template, image, places, slopes = patches((0.3, 0.2))
        noise = torch.randn(template.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        template = (template + 2.0 * noise).requires_grad_()
        image = image.requires_grad_()
        direction = torch.randn(template.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
        other = texture(9) - 120.0

        def shift(step: float) -> Tensor:
            # A fixed scale of residuals: weights that do not depend on it.
            moved = template + step * direction, image + step * other
            return fitted(*moved, places, slopes, robust=False, sheared=sheared).shift[0]

        for axis in (0, 1):
            by_template, by_image = torch.autograd.grad(shift(0.0)[axis], (template, image))
            along = float((by_template * direction).sum() + (by_image * other).sum())
            with torch.no_grad():
                numeric = float(shift(1e-3)[axis] - shift(-1e-3)[axis]) / 2e-3
            assert along == pytest.approx(numeric, rel=0.02, abs=1e-5)


class TestKeypoints:
    def test_they_are_of_unit_length_one_at_a_place_and_the_strongest_first(self) -> None:
        image = texture(7, 240).clamp(0, 255).numpy().astype(np.uint8)
        many, few = keypoints(image, 10_000), keypoints(image, 20)
        assert len(many.pixels) > 40
        assert len(few.pixels) == len(few.descriptors) == 20
        assert torch.equal(few.pixels, many.pixels[:20])
        torch.testing.assert_close(many.descriptors.norm(dim=1), torch.ones(len(many.pixels)), rtol=1e-5, atol=0)
        assert len(np.unique(many.pixels.numpy().round(1), axis=0)) == len(many.pixels)
        part = many.at(torch.tensor([3, 1]))
        assert torch.equal(part.pixels, many.pixels[[3, 1]])
        assert torch.equal(part.descriptors, many.descriptors[[3, 1]])

    def test_a_shifted_image_has_them_shifted(self) -> None:
        image = texture(7, 240).clamp(0, 255).numpy().astype(np.uint8)
        first, second = (keypoints(part, 200) for part in (image[:200, :200], image[10:210, 20:220]))
        moved = first.pixels - second.pixels[(first.descriptors @ second.descriptors.T).argmax(1)]
        assert moved.median(0).values.tolist() == pytest.approx([20.0, 10.0], abs=0.05)

    def test_an_empty_image_has_none(self) -> None:
        found = keypoints(np.full((60, 80), 90, np.uint8), 100)
        assert found == Keypoints(found.pixels, found.descriptors)
        assert found.pixels.shape == (0, 2)
        assert found.descriptors.shape == (0, 128)

    def test_a_pose_from_rays_with_wrong_pairs(self) -> None:
        generator = torch.Generator().manual_seed(1)
        points = torch.rand(120, 3, generator=generator, dtype=torch.float64) * tensor(8.0, 6.0, 30.0) + tensor(
            -4.0, -3.0, 8.0
        )
        turn = rotation_from_vector(tensor(0.02, -0.05, 0.03))
        shift = tensor(-0.9, 0.1, 0.2)
        second = points @ turn.T + shift
        second[::6] = torch.rand(20, 3, generator=generator, dtype=torch.float64) * 2.0 + tensor(-1.0, -1.0, 3.0)
        rotation, translation, inside = pose_between(points, second, 1e-4)
        torch.testing.assert_close(rotation, turn, rtol=0, atol=1e-4)
        torch.testing.assert_close(translation, shift / shift.norm(), rtol=0, atol=1e-3)
        right = torch.ones(120, dtype=torch.bool)
        right[::6] = False
        assert bool(inside[right].all())
        assert int(inside[~right].sum()) <= 2


class TestAgain:
    IMAGE = texture(11, 160)

    def test_where_things_went(self) -> None:
        after = 0.8 * self.IMAGE.roll((-5, 3), (0, 1)) + 12.0
        found = find_again(self.IMAGE, after, tensor([80.0, 60.0], [70.0, 90.0], [math.nan, 3.0]), reach=12)
        assert found.status.tolist() == [MatchStatus.GOOD, MatchStatus.GOOD, MatchStatus.NO_RAY]
        torch.testing.assert_close(found.pixels[:2], tensor([83.0, 55.0], [73.0, 85.0]), rtol=0, atol=0.01)
        assert float(found.score[:2].min()) > 0.99
        assert bool(found.covariance[:2].isfinite().all())
        assert bool(found.pixels[2].isnan().all())

    def test_what_went_farther_than_the_reach_is_not_found(self) -> None:
        after = self.IMAGE.roll((0, 9), (0, 1))
        assert int(find_again(self.IMAGE, after, tensor([80.0, 60.0]), reach=6).status[0]) != MatchStatus.GOOD
        assert find_again(self.IMAGE, after, tensor([80.0, 60.0]), reach=10).status.tolist() == [MatchStatus.GOOD]

    def test_refusals_and_what_has_no_texture(self) -> None:
        options = MatchOptions(half=6)
        flat = torch.full_like(self.IMAGE, 90.0)
        pixels, edge = tensor([80.0, 60.0]), tensor([3.0, 60.0])
        assert find_again(flat, self.IMAGE, pixels, 5, options).status.tolist() == [MatchStatus.FLAT]
        assert find_again(self.IMAGE, self.IMAGE, edge, 5, options).status.tolist() == [MatchStatus.OUTSIDE]
        for before, after, places in ((self.IMAGE[None], self.IMAGE, pixels), (self.IMAGE, self.IMAGE[:90], pixels),
                                      (self.IMAGE, self.IMAGE, pixels[0])):  # fmt: skip
            with pytest.raises(InputError, match="one size are needed"):
                find_again(before, after, places)
