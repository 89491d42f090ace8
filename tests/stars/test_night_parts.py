"""Parts of reading a night: the sky's level, what is a star, names beside other stars, times, moments and plans."""

import datetime
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from kcal import Camera, InputError
from kcal.io.images import write_png, write_video
from kcal.lens import CameraCalibration
from kcal.stars.detect import (
    NightPlan,
    PlannedStars,
    _night_sky,
    _uncrowded,
    detect_stars,
    expand_nights,
    planned_stars,
    read_night,
    time_of,
)
from kcal.stars.night import _names_at, field_angle, turn_by_lens
from kcal.stars.sky import Identification, StarCatalog

CAMERA = Camera.build(focal=(1000, 1000), center=(319.5, 239.5), size=(640, 480), model="pinhole")
ROWS, COLUMNS = np.mgrid[0:240, 0:320].astype(float)


class TestSky:
    def test_light_that_grows_across_the_image_is_followed(self) -> None:
        """A gradient of the sky is its level, tile by tile, but at the rim, where the outermost tile's level holds."""
        level, noise = _night_sky(100.0 + 0.2 * COLUMNS + 0.1 * ROWS, quantum=0.0)
        assert np.abs(level[60:180, 60:260] - (100.0 + 0.2 * COLUMNS + 0.1 * ROWS)[60:180, 60:260]).max() < 1.5
        assert level.shape == noise.shape == (240, 320)

    def test_noise_of_the_sky(self) -> None:
        level, noise = _night_sky(np.random.default_rng(1).normal(100.0, 4.0, (240, 320)), quantum=0.0)
        assert abs(level.mean() - 100.0) < 0.2
        assert noise.mean() == pytest.approx(4.0, rel=0.05)
        # Steps of gray levels are noise of their own.
        assert _night_sky(np.full((64, 64), 7.0), quantum=1.0)[1].mean() == pytest.approx(1.0 / math.sqrt(12.0))


def sky_of(*stars: tuple[float, float, float, float]) -> np.ndarray[Any, Any]:
    """An image with Gaussian stars (x, y, length along x, height)."""
    image = 50 + np.random.default_rng(0).normal(0, 2, COLUMNS.shape)
    for x, y, long, height in stars:
        image += height * np.exp(-((COLUMNS - x) ** 2) / (2 * long**2) - (ROWS - y) ** 2 / (2 * 1.2**2))
    return image


PLACES = [(40.0 + 60 * (i % 5) + 0.3, 30.0 + 55 * (i // 5) + 0.2) for i in range(20)]


class TestStars:
    def test_in_a_long_exposure_all_stars_are_streaks(self) -> None:
        found = detect_stars(sky_of(*((x, y, 2.4, 300.0) for x, y in PLACES)))
        assert len(found.pixels) == 20
        assert np.abs(found.pixels[np.lexsort(found.pixels.round().T)] - np.array(PLACES)).max() < 0.2

    def test_the_brightest_come_first_and_no_more_than_asked(self) -> None:
        heights = [100.0 + 10 * i for i in range(20)]
        image = sky_of(*((x, y, 1.2, height) for (x, y), height in zip(PLACES, heights, strict=True)))
        found = detect_stars(image, most=5)
        assert len(found.pixels) == 5
        torch.testing.assert_close(torch.from_numpy(found.pixels), torch.tensor(PLACES[:14:-1]), rtol=0, atol=0.2,
                                   check_dtype=False)  # fmt: skip
        assert bool((np.diff(found.flux) < 0).all())
        # What is in three widths of a Gaussian of 1.2 px.
        assert found.flux[0] == pytest.approx(290.0 * 2 * math.pi * 1.2**2, rel=0.05)


class TestNames:
    def names(self, magnitude: list[float], apart: float) -> list[int]:
        """Of two stars, so many pixels apart, at the first one's pixel and far from both."""
        x = torch.tensor([0.0, apart / 1000.0], dtype=torch.float64)
        directions = torch.nn.functional.normalize(torch.stack([x, 0 * x, 1 + 0 * x], 1), dim=1)
        pixels, reach = np.array([[319.8, 239.5], [100.0, 100.0]]), np.array([2.0, 2.0])
        found = _names_at(pixels, reach, directions, np.array(magnitude), CAMERA, torch.eye(3).double(), 0.8)
        return [int(star) for star in found]

    def test_a_neighbor_of_like_brightness_takes_the_name_away(self) -> None:
        """It pulls the center; one that is 2.5 magnitudes fainter does not, and one that is too far neither."""
        assert self.names([3.0, 4.0], 5.0) == [-1, -1]
        assert self.names([3.0, 1.0], 5.0) == [-1, -1]
        assert self.names([3.0, 5.6], 5.0) == [0, -1]
        assert self.names([3.0, 3.0], 6.5) == [0, -1]

    def test_stars_behind_have_no_name(self) -> None:
        behind = torch.tensor([[0.0, 0.0, -1.0]], dtype=torch.float64)
        found = _names_at(np.array([[319.5, 239.5]]), np.array([9.0]), behind, np.array([1.0]), CAMERA,
                          torch.eye(3).double(), 0.8)  # fmt: skip
        assert found.tolist() == [-1]


def test_how_wide_a_camera_sees() -> None:
    assert field_angle(CAMERA) == pytest.approx(2.0 * math.atan(math.hypot(319.5, 239.5) / 1000.0))
    # The corner that is farthest from the principal point tells.
    aside = Camera.build(focal=(1000, 1000), center=(200, 100), size=(640, 480), model="pinhole")
    assert field_angle(aside) == pytest.approx(2.0 * math.atan(math.hypot(439, 379) / 1000.0))
    # A fisheye whose lens does not reach the image's corners: as far as it goes, not the whole sphere.
    fisheye = Camera.build(
        focal=(200, 200), center=(319.5, 239.5), size=(640, 480), coefficients=[0.0] * 4, model="fisheye4"
    )
    assert 2.0 < field_angle(fisheye) < 2.0 * math.pi


def test_how_many_have_a_name() -> None:
    assert Identification(np.eye(3), np.array([3, -1, 0, -1, 7]), 0.0).matches == 3


class TestFiles:
    def test_a_video_is_its_mean_frame(self, tmp_path: Path) -> None:
        frames = [np.full((32, 48), level, np.uint8) for level in (10, 20, 60)]
        night = read_night(write_video(tmp_path / "a.mp4", iter(frames), 5, quality=0))
        assert night.shape == (32, 48)
        assert np.abs(night - 30.0).max() < 1.0
        gray = np.arange(768, dtype=np.uint16).reshape(24, 32) * 80
        assert np.array_equal(read_night(write_png(tmp_path / "b.png", gray)), gray)

    def test_of_a_video_the_first_frame_is_told_and_the_middle_is_meant(self, tmp_path: Path) -> None:
        frame = np.full((32, 48), 10, np.uint8)
        first = datetime.datetime(2026, 11, 24, 8, 47, 26, tzinfo=datetime.UTC)
        for count, summed in ((9, 9), (130, 100)):
            path = write_video(tmp_path / "2026-11-24T084726.avi", itertools.repeat(frame, count), 25)
            for text in ("name:Z", "2026-11-24T08:47:26Z"):
                time = time_of(text, path)
                assert time is not None
                assert (time - first).total_seconds() == pytest.approx((summed - 1) / 2 / 25)

    def test_files_folders_and_wildcards(self, tmp_path: Path) -> None:
        for name in ("b.png", "a.png", "c.fits", "d.mp4"):
            (tmp_path / name).touch()
        own = [str(tmp_path / name) for name in ("d.mp4", "c.fits", "b.png")]
        found = expand_nights([*own, str(tmp_path / "*.png")])
        assert [path.name for path in found] == ["d.mp4", "c.fits", "b.png", "a.png"]

    def test_times(self) -> None:
        image = Path("2019-07-29T204726_Alt40.png")
        assert time_of(None, image) is None
        assert time_of("name:+02:00", image) == datetime.datetime(2019, 7, 29, 18, 47, 26, tzinfo=datetime.UTC)
        assert time_of("2020-01-02T03:04:05Z", image) == datetime.datetime(2020, 1, 2, 3, 4, 5, tzinfo=datetime.UTC)
        assert time_of("name:Z", Path("20260102-030405.png")) == datetime.datetime(
            2026, 1, 2, 3, 4, 5, tzinfo=datetime.UTC
        )
        half = time_of("name:Z", Path("2026-11-24T084726.750.png"))
        assert half == datetime.datetime(2026, 11, 24, 8, 47, 26, 750_000, tzinfo=datetime.UTC)
        zoned = Path("20261124T104726+0200.png")
        assert time_of("name:+02:00", zoned) == datetime.datetime(2026, 11, 24, 8, 47, 26, tzinfo=datetime.UTC)
        for text, path, message in (
            ("name", image, "zone"), ("name:Z", Path("a.png"), "no time in this name"),
            ("name:Z", zoned, "the zone in this name is not that of --time name:Z"),
        ):  # fmt: skip
            with pytest.raises(InputError, match=message):
                time_of(text, path)


class TestPlans:
    @pytest.mark.parametrize(
        "wrong",
        [
            {"size": (1920, 0)}, {"focal_px": 0.0}, {"aperture_mm": 0.0}, {"seconds": 0.0}, {"altitude_deg": 91.0},
            {"altitude_deg": -1.0}, {"sky_magnitude": 9.0}, {"sky_magnitude": 24.0},
        ],
    )  # fmt: skip
    def test_refused(self, wrong: dict[str, Any]) -> None:
        with pytest.raises(InputError, match="night"):
            NightPlan(**{"focal_px": 1600.0, "size": (1920, 1080), "aperture_mm": 2.9} | wrong)

    def test_where_all_stars_are_seen_they_are_the_image_s_share_of_the_sky(self) -> None:
        plan = NightPlan(focal_px=1600, size=(1920, 1080), aperture_mm=400.0, seconds=1.0, altitude_deg=45.0)
        x, y = np.meshgrid((np.arange(1920) - 959.5) / 1600, (np.arange(1080) - 539.5) / 1600)
        solid = float(((1 + x * x + y * y) ** -1.5).sum()) / 1600**2
        found = planned_stars(plan)
        catalog = StarCatalog.bundled().magnitude
        assert found.stars == pytest.approx(len(catalog) * solid / (4 * math.pi), rel=1e-3)
        assert found.faintest == pytest.approx(float(catalog.max()))
        # 15.04 seconds of arc in a second of time.
        assert found.trail_px == pytest.approx(15.04 / (math.degrees(1 / 1600) * 3600))

    def test_what_they_tell(self) -> None:
        found = PlannedStars(30.0, 5.0, 0.1, 0.2, 1e-5)
        assert found.range_share(5000.0, 10.0) == pytest.approx(5e-3)
        assert found.range_share(5000.0, 10.0, 4) == pytest.approx(2.5e-3)
        # The Earth turns by 7.3e-5 rad in a second.
        assert found.range_share(5000.0, 10.0, 4, 0.1) == pytest.approx(500.0 * math.hypot(5e-6, 7.292e-6), rel=1e-3)

    def test_a_narrow_field_tells_as_much_as_its_stars_do(self) -> None:
        """A level camera sees no stars below the horizon; behind a bright sky none at all."""
        level = planned_stars(NightPlan(focal_px=1600, size=(1920, 1080), aperture_mm=400.0))
        up = planned_stars(NightPlan(focal_px=1600, size=(1920, 1080), aperture_mm=400.0, altitude_deg=45.0))
        # Of the upper half, what is higher than 5 degrees; the sky is summed in nine strips.
        share = 0.5 * (1.0 - math.tan(math.radians(5.0)) * 1600 / 540)
        assert level.stars == pytest.approx(share * up.stars, rel=0.15)
        none = planned_stars(NightPlan(focal_px=1600, size=(1920, 1080), aperture_mm=0.01, sky_magnitude=10.0))
        assert (none.stars, none.yaw_sigma) == (0.0, math.inf)
        one = planned_stars(NightPlan(focal_px=1600, size=(1920, 1080), aperture_mm=3.0, altitude_deg=45.0))
        # Both cameras' noise of all stars, whose centers are about as good as the median one.
        by_hand = math.sqrt(2.0 / one.stars) * one.sigma_px / 1600
        assert 0.4 * by_hand < one.yaw_sigma < 1.2 * by_hand


def test_crowded_within_five_pixels_by_what_is_not_far_fainter() -> None:
    """A twentieth of the brightness pulls a center, less does not; the fainter one is always pulled."""
    place = np.array([[0.0, 0.0], [4.9, 0.0], [100.0, 0.0], [100.0, 5.1], [200.0, 0.0], [203.0, 0.0], [np.nan, 0.0]])
    peak = np.array([1.0, 0.06, 1.0, 1.0, 1.0, 0.04, 1.0])
    assert _uncrowded(place, peak).tolist() == [False, False, True, True, True, False, True]
    assert _uncrowded(place[:1], peak[:1]).tolist() == [True]
    assert _uncrowded(np.zeros((0, 2)), np.zeros(0)).tolist() == []


def test_a_principal_point_passes_for_a_turn() -> None:
    """2 px of it, near the middle of an image with a focal length of 1000 px."""
    camera = Camera.build(focal=(1000, 1000), center=(319.5, 239.5), size=(640, 480), model="pinhole")
    pixels = np.array([[319.5, 239.5], [330.0, 239.5], [319.5, 250.0], [310.0, 235.0]])
    assert turn_by_lens(camera, pixels) == 0.0
    covariance = torch.diag(torch.tensor([0.0, 0.0, 4.0, 0.0, 0.0], dtype=torch.float64))
    camera.calibration = CameraCalibration(sigma=dict.fromkeys(camera.names), covariance=covariance)
    assert turn_by_lens(camera, pixels) == pytest.approx(math.degrees(0.002), rel=1e-3)
