"""Stars and names just within and just beyond each limit, and their numbers by hand."""

import datetime
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from kcal import Camera, InputError
from kcal.lens import rotation_from_vector
from kcal.stars.detect import _reasons, _windowed, detect_stars
from kcal.stars.night import _names_at
from kcal.stars.sky import (
    EARTH_RATE,
    Air,
    StarCatalog,
    _angle,
    _best_turn,
    _julian,
    _met,
    _middle,
    _table_on_disk,
    identify,
    pole_in_enu,
    refraction_sigma,
    require_erfa,
    turn_between,
    unit_vectors,
    year_of,
)
from kcal.values import instant

WIDTH = 1.3  # px, of the window
AROUND = np.arange(-7, 8)


def star(x: float, y: float, spread: NDArray[np.float64], around: NDArray[np.int64] = AROUND) -> NDArray[np.float64]:
    """A box with a Gaussian of this covariance at (x, y) from its middle."""
    d = np.stack(np.meshgrid(around - x, around - y), -1)
    light: NDArray[np.float64] = np.exp(-0.5 * (d @ np.linalg.inv(spread) * d).sum(-1))
    return light


class TestPoints:
    def test_centers_and_moments_under_the_window(self) -> None:
        """A Gaussian times one of the window's width has the sum of their inverse covariances."""
        spread = np.array([[1.5, 0.4], [0.4, 0.9]])
        around = np.arange(-12, 13)
        shift, moments = _windowed(np.stack([star(0.4, -0.3, spread, around), 0 * star(0, 0, spread, around)]), around)
        assert shift[0].tolist() == pytest.approx([0.4, -0.3], abs=3e-4)
        both = np.linalg.inv(np.linalg.inv(spread) + np.eye(2) / WIDTH**2)
        assert moments[0].tolist() == pytest.approx([both[0, 0], both[1, 1], both[0, 1]], abs=3e-4)
        assert bool(np.isnan(shift[1]).all())
        assert bool(np.isnan(_windowed(star(3.0, 0.0, spread, around)[None], around)[0]).all())

    @pytest.mark.parametrize(("xx", "yy", "xy", "why"), [
        (0.84, 0.84, 0.0, ""), (0.86, 0.86, 0.0, "wider than a star"), (0.065, 0.065, 0.0, ""),
        (0.055, 0.055, 0.0, "hot pixels"), (0.6, 0.31, 0.0, ""), (0.6, 0.29, 0.0, "streaks"),
        (0.4, 0.4, 0.13, ""), (0.4, 0.4, 0.14, "streaks"), (0.29, 0.6, 0.0, "streaks"),
    ])  # fmt: skip
    def test_which_are_stars(self, xx: float, yy: float, xy: float, why: str) -> None:
        """By their variances over that of the window, 1.69 px², and half as wide as long at least."""
        moments = WIDTH**2 * np.array([[xx, yy, xy], *[[0.4, 0.4, 0.0]] * 4])
        boxes = np.stack([star(0.0, 0.0, np.eye(2))] * 5)
        assert _reasons(boxes, 7, np.zeros((5, 2)), moments, np.zeros(5, bool)).tolist() == [why, "", "", "", ""]

    def test_in_long_exposures_half_as_round_as_usual(self) -> None:
        moments = WIDTH**2 * np.array([[0.4, 0.4 * share, 0.0] for share in (0.3, 0.3, 0.3, 0.16, 0.14)])
        found = _reasons(np.stack([star(0.0, 0.0, np.eye(2))] * 5), 7, np.zeros((5, 2)), moments, np.zeros(5, bool))
        assert found.tolist() == ["", "", "", "", "streaks"]

    def test_other_reasons_and_which_comes_first(self) -> None:
        boxes = np.stack([star(0.0, 0.0, np.eye(2))] * 6)
        for number, beside in ((1, 0.13), (2, 0.11)):
            boxes[number] = 0.0
            boxes[number, 7, 7], boxes[number, 6, 8] = 1.0, beside
        shift = np.zeros((6, 2))
        shift[3, 0] = np.nan
        moments = WIDTH**2 * np.full((6, 3), [0.4, 0.4, 0.0])
        moments[5, 0] = WIDTH**2 * 0.1
        found = _reasons(boxes, 7, shift, moments, np.array([False, False, False, False, True, True]))
        assert found.tolist() == ["", "", "hot pixels", "wider than a star", "saturated", "streaks"]

    def sky(self, height: float, x: float = 60.0, y: float = 50.0, noise: float = 2.0) -> NDArray[np.float64]:
        rows, columns = np.mgrid[0:128, 0:160]
        draw = np.random.default_rng(3).normal(0.0, noise, rows.shape)
        light: NDArray[np.float64] = 50 + draw + height * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 1.2**2))
        return light

    def test_sigma_follows_signal_over_noise(self) -> None:
        """A star of 1.2 px smoothed by 1.3 px keeps 1.44 / 3.13 of its height, noise 1 / 2 sqrt(pi) 1.3 of it."""
        for height in (60.0, 400.0):
            found = detect_stars(self.sky(height))
            signal = height * 1.44 / 3.13 / (2.0 / (2.0 * math.sqrt(math.pi) * WIDTH))
            assert found.sigma.tolist() == pytest.approx([math.hypot(0.04, WIDTH * math.sqrt(2.0) / signal)], rel=0.06)
            assert len(detect_stars(self.sky(height), threshold=0.9 * signal).pixels) == 1
            assert len(detect_stars(self.sky(height), threshold=1.1 * signal).pixels) == 0

    def test_stars_have_room_of_seven_pixels(self) -> None:
        for x, y, seen in ((7.0, 50.0, 1), (6.0, 50.0, 0), (152.0, 50.0, 1), (153.0, 50.0, 0), (60.0, 7.0, 1),
                           (60.0, 6.0, 0), (60.0, 120.0, 1), (60.0, 121.0, 0)):  # fmt: skip
            assert len(detect_stars(self.sky(400.0, x, y)).pixels) == seen, (x, y)

    def test_saturated_from_98_percent_of_the_scale(self) -> None:
        for peak, seen in ((249, 1), (250, 0)):
            image = np.clip(self.sky(0.0, noise=1.0), 0, 255).round()
            bright = star(0.0, 0.0, 1.44 * np.eye(2)) * (peak - 50) + 50
            image[43:58, 53:68] = np.maximum(image[43:58, 53:68], bright.round())
            found = detect_stars(image.astype(np.uint8))
            assert len(found.pixels) == seen
            assert found.left_out == ({} if seen else {"saturated": 1})
            assert found.background == pytest.approx(50.0 / 255.0)
        # Floating point has no scale.
        assert len(detect_stars(image).pixels) == 1

    def test_what_is_no_image(self) -> None:
        assert len(detect_stars(np.zeros((16, 16))).pixels) == 0
        for wrong in (np.zeros((15, 40)), np.zeros((40, 15)), np.zeros((4, 40, 40))):
            with pytest.raises(InputError, match="16 pixels or more"):
                detect_stars(wrong)


class TestTurns:
    RAYS = unit_vectors(np.array([0.1, 0.3, -0.2, 0.5, 0.0]), np.array([0.2, -0.1, 0.3, 0.1, -0.3]))

    def test_rotations_and_no_mirror_images(self) -> None:
        turn = rotation_from_vector(torch.tensor([0.3, -0.4, 0.2]).double()).numpy()
        np.testing.assert_allclose(turn_between(self.RAYS, self.RAYS @ turn.T), turn, atol=1e-12)
        several = turn_between(np.stack([self.RAYS, self.RAYS @ turn.T]), self.RAYS)
        np.testing.assert_allclose(several, [np.eye(3), turn.T], atol=1e-12)
        assert float(np.linalg.det(turn_between(self.RAYS, self.RAYS * [-1.0, 1.0, 1.0]))) == pytest.approx(1.0)

    def test_angles_and_the_middle(self) -> None:
        x, y = np.array([1.0, 0.0, 0.0]), np.array([math.cos(0.3), math.sin(0.3), 0.0])
        assert float(_angle(x, y)) == pytest.approx(0.3)
        assert float(_angle(x, -x)) == pytest.approx(math.pi)
        assert _middle(np.stack([x, y])).tolist() == pytest.approx([math.cos(0.15), math.sin(0.15), 0.0])

    def test_each_star_has_the_nearest_ray(self) -> None:
        """Within the reach; a star that two rays meet is that of the nearer one."""
        turn = rotation_from_vector(torch.tensor([0.3, -0.4, 0.2]).double()).numpy()
        tree = cKDTree(self.RAYS)
        off = self.RAYS[[3, 1, 1, 0]] + [[0.0, 0, 0.009], [0.0, 0, 0.002], [0.0, 0, 0.001], [0.0, 0, 0.011]]
        assert _met(turn, off @ turn.T, tree, 0.01).tolist() == [3, -1, 1, -1]
        best, hits = _best_turn(np.stack([turn.T, turn, np.eye(3)]), off @ turn.T, tree, 0.01)
        np.testing.assert_array_equal(best, turn)
        assert hits == 3

    def test_a_scale_that_is_wrong_by_a_percent(self) -> None:
        """Names are found where it may be wrong by so much, and not where it is said to be exact."""
        catalog = StarCatalog.bundled()
        bright = catalog.directions()[np.argsort(catalog.magnitude)]
        ahead = bright[bright[:, 2] > 0.95][:14]
        plane = 1.01 * ahead[:, :2] / ahead[:, 2:]
        rays = np.c_[plane, np.ones(len(plane))]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        found = identify(rays, 2e-4, scale_error=0.012)
        assert found.matches >= 10
        assert float(catalog.directions()[found.star[0]] @ ahead[0]) > 1.0 - 1e-9
        assert identify(rays, 2e-4) is None


class TestNames:
    CAMERA = Camera.build(focal=(1000, 1000), center=(319.5, 239.5), size=(640, 480), model="pinhole")
    STILL = torch.eye(3).double()

    def rays(self, *pixels: tuple[float, float]) -> torch.Tensor:
        rays, _ = self.CAMERA.unproject(torch.tensor(pixels).double())
        return torch.nn.functional.normalize(rays, dim=1)

    def test_within_reach_of_the_nearer_pixel_only(self) -> None:
        directions = self.rays((100.0, 100.0), (400.0, 300.0))
        pixels = np.array([[101.9, 100.0], [100.0, 101.0], [400.0, 302.1], [400.0, 298.1]])
        star = _names_at(pixels, np.full(4, 2.0), directions, np.zeros(2), self.CAMERA, self.STILL, 0.5)
        assert star.tolist() == [-1, 0, -1, 1]
        near = _names_at(pixels[[0, 2]], np.full(2, 2.0), directions, np.zeros(2), self.CAMERA, self.STILL, 0.5)
        assert near.tolist() == [0, -1]


class TestTables:
    @pytest.mark.parametrize("change", [
        {"pairs": np.zeros((2, 3), np.uint16)}, {"pairs": np.zeros((3, 2), np.uint16)},
        {"pairs": np.zeros((2, 2), np.int64)}, {"stars": np.array(0)}, {"angle": np.array([0.2, 0.1], np.float32)},
        {"pairs": np.array([[0, 1], [1, 4]], np.uint16)},
    ])  # fmt: skip
    def test_files_that_are_not_whole(self, change: dict[str, NDArray[Any]], tmp_path: Path) -> None:
        good: dict[str, NDArray[Any]] = {
            "pairs": np.array([[0, 1], [1, 3]], np.uint16), "angle": np.array([0.1, 0.1], np.float32),
            "stars": np.array(4),
        }  # fmt: skip
        path = tmp_path / "table.npz"
        np.savez(path, allow_pickle=False, **good)
        assert _table_on_disk(path)[2] == 4
        np.savez(path, allow_pickle=False, **(good | change))
        assert _table_on_disk(path) is None

    def test_a_single_star_has_no_pairs(self, tmp_path: Path) -> None:
        path = tmp_path / "table.npz"
        for stars, whole in ((1, True), (0, False)):
            np.savez(path, pairs=np.zeros((0, 2), np.uint16), angle=np.zeros(0, np.float32), stars=np.array(stars))
            assert (_table_on_disk(path) is not None) is whole


class TestSky:
    def test_years_with_their_fraction(self) -> None:
        assert year_of(instant("2021-01-01T00:00:00Z", "time")) == 2021.0
        assert year_of(instant("2021-07-02T15:00:00Z", "time")) == pytest.approx(2021.5)
        for wrong in ("1971-12-31T23:59:59Z", "2100-01-01T00:00:00Z"):
            with pytest.raises(InputError, match="outside 1972 to 2100"):
                year_of(instant(wrong, "time"))
        assert year_of(instant("1972-01-01T00:00:00Z", "time")) == 1972.0

    def test_julian_dates_are_those_of_utc(self) -> None:
        erfa = require_erfa()
        time = datetime.datetime(2000, 1, 1, 14, 0, 0, 500_000, tzinfo=datetime.timezone(datetime.timedelta(hours=2)))
        assert sum(_julian(erfa, time)) == pytest.approx(2451545.0 + 0.5 / 86400.0, abs=1e-9)

    def test_pole_and_refraction(self) -> None:
        assert pole_in_enu(30.0).tolist() == pytest.approx([0.0, math.sqrt(0.75), 0.5])
        second = math.radians(1.0 / 3600.0)
        sigma = refraction_sigma(np.radians([10.0, 5.0, 20.0, 1.0, 2.0]))
        assert (sigma / second).tolist() == pytest.approx([0.3, 4.8, 0.3 / 16.0, 187.5, 187.5])
        assert pytest.approx(2.0 * math.pi / 86164.1, rel=1e-6) == EARTH_RATE

    def test_air(self) -> None:
        """Standard air has 898.7 hPa at 1000 m and 226.3 hPa at 11 km (ISO 2533)."""
        assert Air.at_height(0.0).hectopascal == 1013.25
        assert Air.at_height(1000.0).hectopascal == pytest.approx(898.75, abs=0.05)
        assert Air.at_height(11_000.0).hectopascal == pytest.approx(226.3, abs=0.1)
        assert Air.at_height(0.0, hectopascal=900.0, celsius=3.0) == Air(hectopascal=900.0, celsius=3.0)
        for name, good, bad in (
            ("hectopascal", 1100.0, 1101.0), ("hectopascal", 0.0, -1.0), ("celsius", 60.0, 61.0),
            ("celsius", -90.0, -91.0), ("humidity", 1.0, 1.01), ("humidity", 0.0, -0.1),
            ("hectopascal_sigma", 0.0, -1.0), ("celsius_sigma", 0.0, math.inf),
        ):  # fmt: skip
            Air(**{"hectopascal": 1000.0, name: good})
            with pytest.raises(InputError, match="air"):
                Air(**{"hectopascal": 1000.0, name: bad})


class TestCatalogs:
    def test_motions_by_hand(self) -> None:
        """A tenth of a radian a century in declination; in right ascension over the cosine of the declination."""
        one = StarCatalog(
            number=np.array([7]), ra=np.array([0.5]), dec=np.array([1.0]), pm_ra=np.array([1e-3]),
            pm_dec=np.array([-2e-3]), magnitude=np.array([3.0]),
        )  # fmt: skip
        ra, dec = 0.5 + 50.0 * 1e-3 / math.cos(1.0), 1.0 - 50.0 * 2e-3
        wanted = [math.cos(ra) * math.cos(dec), math.sin(ra) * math.cos(dec), math.sin(dec)]
        assert one.directions(2050.0)[0].tolist() == pytest.approx(wanted)
        assert one.directions()[0].tolist() == pytest.approx(unit_vectors(one.ra, one.dec)[0].tolist())
        assert one.name_of(7) == "HR 7"
        for year in (1900.0, 2100.0):
            one.directions(year)
        for year in (1899.9, 2100.1):
            with pytest.raises(InputError, match=r"the year \d+ is outside"):
                one.directions(year)

    @pytest.mark.parametrize("change", [
        {"ra": np.zeros(2)}, {"dec": np.array([1.6])}, {"dec": np.array([-1.6])}, {"magnitude": np.array([np.nan])},
        {"number": np.array([[1]])},
    ])  # fmt: skip
    def test_what_is_no_catalogue(self, change: dict[str, NDArray[Any]]) -> None:
        columns: dict[str, NDArray[Any]] = {"number": np.array([1])}
        columns |= {name: np.zeros(1) for name in ("ra", "dec", "pm_ra", "pm_dec", "magnitude")}
        StarCatalog(**(columns | {"dec": np.array([-np.pi / 2])}))
        with pytest.raises(InputError, match="star catalog"):
            StarCatalog(**(columns | change))
