"""Attitude from a skyline: found without a rough pose, with its σ, and refused where it is not determined."""

import dataclasses
import functools
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from kcal import DegenerateError, InputError, Origin
from kcal.locate import enu_from_cam
from kcal.rig import RasterError
from kcal.skyline import attitude
from kcal.skyline.attitude import SkylineAttitude, skyline_attitude
from kcal.skyline.fit import Candidate
from scripts.check.skyline import Hills, HillWeather, skyline_image
from tests.helpers.skyline_site import (
    ANGLES,
    CELL,
    ERROR,
    HILLS,
    PLACE_SIGMA,
    REACH,
    eye,
    heights,
    image,
    raster_of,
    small_site,
)


def found(**changed: Any) -> SkylineAttitude:
    """The site's attitude, with something changed."""
    site = small_site()
    known = {
        "image": site.image, "camera": site.camera, "place": site.place, "raster": site.raster, "error": ERROR,
        "place_sigma": PLACE_SIGMA,
    }  # fmt: skip
    return skyline_attitude(**{**known, **changed})


@functools.cache
def as_it_is() -> SkylineAttitude:
    """The site's attitude, as it is."""
    return found()


def errors(one: SkylineAttitude) -> NDArray[np.float64]:
    """Heading, pitch, roll less the truth, in sigmas."""
    off = np.array([one.heading_deg, one.pitch_deg, one.roll_deg]) - ANGLES
    return off / one.sigma_deg


def test_it_needs_no_rough_pose() -> None:
    one = as_it_is()
    assert np.abs(errors(one)).max() < 3.0
    assert one.sigma_deg.max() < 0.03
    assert one.used.mean() > 0.9
    assert one.second_worse > 20.0
    assert sum(one.shares.values()) == pytest.approx(np.ones(3))
    assert one.shares["lens"].max() == 0.0  # a camera without a calibration is exact
    np.testing.assert_allclose(one.rotation @ one.rotation.T, np.eye(3), atol=1e-12)
    assert np.sqrt(np.mean((one.expected - one.border.row)[one.used] ** 2)) < 0.3


def test_the_covariance_is_of_turns_about_east_north_up() -> None:
    one = as_it_is()
    # Of a camera that is nearly level, the turn about up is its heading.
    assert np.degrees(np.sqrt(one.covariance[2, 2])) == pytest.approx(one.sigma_deg[0], rel=0.1)


def test_shifts_of_the_raster_are_within_their_sigma() -> None:
    # The whole raster 2 m higher: ridges at several distances tell it from a camera that looks up, if it is stated.
    one = found(raster=raster_of(heights() + 2.0), error=RasterError(sigma=0.5, offset=2.0, refraction_sigma=0.03))
    assert abs(errors(one)).max() < 2.0
    assert one.sigma_deg[1] > 1.3 * as_it_is().sigma_deg[1]


def test_larger_errors_are_stated_larger() -> None:
    rough = found(error=RasterError(sigma=4.0, offset=0.2, refraction_sigma=0.03))
    assert (rough.sigma_deg > 2.0 * as_it_is().sigma_deg).all()
    assert (rough.shares["raster"] > as_it_is().shares["raster"]).all()
    assert found(place_sigma=(5.0, 5.0, 5.0)).sigma_deg[0] > 1.5 * as_it_is().sigma_deg[0]


def test_trees_above_the_raster_are_left_out() -> None:
    woods = dataclasses.replace(HILLS, trees=20.0, woods=0.2)
    view = skyline_image(
        woods, small_site().camera, enu_from_cam(*ANGLES), eye(), HillWeather(haze=9_000.0), farthest=REACH
    )
    one = found(image=view.image)
    assert 0.5 < one.used.mean() < 0.97
    assert np.abs(errors(one)).max() < 4.0
    off = one.border.row - one.expected
    assert np.nanmedian(off[one.border.clear & ~one.used]) < -1.0  # what was left out is above the raster
    assert any("trees and buildings" in text for text in one.warnings)


def test_a_rough_heading_chooses() -> None:
    assert found(heading=(45.0, 20.0)).heading_deg == pytest.approx(as_it_is().heading_deg, abs=1e-6)
    with pytest.raises(InputError, match=r"contradicts|equally|flat"):
        found(heading=(200.0, 20.0))


def other_terrain() -> NDArray[np.float64]:
    """Heights of somewhere else."""
    x = -REACH + CELL * (np.arange(480) + 0.5)
    return Hills(seed=9, relief=260.0, clear=700.0, far=4_500.0).ground(*np.meshgrid(x, -x))


def sea() -> NDArray[np.float64]:
    """An image of a level horizon."""
    level = np.full((270, 480), 200.0)
    level[130:] = 90.0
    return level + np.random.default_rng(0).normal(0.0, 1.0, level.shape)


@pytest.mark.parametrize(
    ("change", "kind", "said"),
    [
        (lambda: {"raster": raster_of(other_terrain())}, InputError, "the raster contradicts the image"),
        (lambda: {"raster": raster_of(heights() - 48.0)}, InputError, r"60 m above the raster's ground.*--geoid"),
        (lambda: {"raster": raster_of(heights()[200:280, 200:280])}, InputError, "has no horizon in .* directions"),
        (
            lambda: {
                "image": sea(), "raster": raster_of(np.zeros((480, 480)), 200.0),
                "place": Origin(lat=47.0, lon=11.0, height=12.0),
            },
            DegenerateError, "too flat to tell the heading",
        ),
        (lambda: {"image": image(air=HillWeather(haze=9_000.0, light=0.004))}, InputError, "clear in .* columns only"),
        (lambda: {"image": np.roll(small_site().image, 135, 0)}, InputError, "clear in|contradicts"),
        (lambda: {"image": small_site().image[:-1]}, InputError, "480 x 269 pixels, the camera 480 x 270"),
        (lambda: {"place_sigma": (1.0, 0.0, 1.0)}, InputError, "three positive numbers"),
    ],
    ids=["elsewhere", "geoid", "too small", "sea", "night", "no sky", "size", "sigma"],
)  # fmt: skip
def test_refusals(change: Any, kind: type[InputError], said: str) -> None:
    with pytest.raises(kind, match=said):
        found(**change())


def test_a_second_heading_that_fits_as_well_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    few = [Candidate(as_it_is().rotation, 10.0), Candidate(_turned(as_it_is().rotation, 90.0), 12.0)]
    monkeypatch.setattr(attitude.fits, "candidates", lambda *_: few)
    with pytest.raises(DegenerateError, match=r"two headings .* equally well: 40\.\d and 130\.\d .* by 2\.0; 14 are"):
        found()


def _turned(rotation: NDArray[np.float64], degrees: float) -> NDArray[np.float64]:
    sine, cosine = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    return rotation @ np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    "wrong", [{"sigma": -1.0}, {"offset": float("nan")}, {"correlation": 0.0}, {"refraction_sigma": 3.0}]
)
def test_errors_that_cannot_be(wrong: dict[str, float]) -> None:
    with pytest.raises(InputError):
        RasterError(**wrong)
