"""Stars found in rendered images, named without pointing, and what is refused.

The catalog of stars, and chance matches.
"""

import builtins
import datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from kcal import Camera, FileError, InputError, Origin
from kcal.locate import enu_from_cam
from kcal.stars.detect import detect_stars, read_night
from kcal.stars.night import SkyView, field_angle, name_stars
from kcal.stars.sky import (
    _NAMES,
    Air,
    StarCatalog,
    _by_chance,
    _table_of,
    cache_folder,
    celestial_directions,
    identify,
    observed_directions,
    pair_table,
)
from kcal.values import instant
from scripts.check.stars import PLACE, TIME, night_camera, rendered, star_pixels

CATALOG = StarCatalog.bundled()
CAMERA = night_camera()
LOOK = (130.0, 35.0, 2.0)


@pytest.fixture(scope="module")
def night() -> np.ndarray[Any, Any]:
    pixels, index = star_pixels(CAMERA, LOOK)
    return rendered(CAMERA, pixels, CATALOG.magnitude[index])


def test_centers_and_their_sigmas() -> None:
    pixels, index = star_pixels(CAMERA, LOOK, faintest=5.5)
    errors, sigmas = [], []
    for seed in range(3):
        found = detect_stars(rendered(CAMERA, pixels, CATALOG.magnitude[index], seed=seed))
        apart = np.linalg.norm(found.pixels[:, None] - pixels, axis=-1)
        near = apart.min(1) < 1.0
        errors.append((found.pixels - pixels[apart.argmin(1)])[near])
        sigmas.append(found.sigma[near])
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    assert len(error) > 150
    # By the median: a few stars have a neighbor that is too faint to be seen by itself.
    assert 0.4 < np.median(np.abs(error / sigma[:, None])) / 0.6745 < 1.2
    faint = sigma > 0.06
    assert faint.sum() > 20
    by_noise = np.sqrt(sigma[faint] ** 2 - 0.04**2)  # without what no image of pure noise has
    assert 0.7 < np.median(np.abs(error[faint] / by_noise[:, None])) / 0.6745 < 1.3


def test_what_is_no_star_is_counted(night: Any) -> None:
    image = night.astype(np.float64)
    for row, column in np.random.default_rng(5).integers(30, 560, (12, 2)):
        image[row, column] += 4000.0  # hot pixels
    along = np.arange(200)
    for shift in range(-1, 2):
        image[300 + shift + along // 3, 400 + along] += 900.0 / (1 + shift**2)  # a satellite
    rows, columns = np.mgrid[0:600, 0:960]
    flashes = [(620.0 + 45 * k, 200.0 + 22 * k) for k in range(6)]  # an aircraft's strobe: as sharp as stars
    for u, v in flashes:
        image += 900.0 * np.exp(-((rows - v) ** 2 + (columns - u) ** 2) / (2 * 1.1**2))
    image += 3000.0 * np.exp(-((rows - 480) ** 2 + (columns - 200) ** 2) / (2 * 6.0**2))  # a lamp
    image += 250.0 * np.exp(-((rows - 100) ** 2 + (columns - 700) ** 2) / (2 * 80.0**2))  # a cloud
    found = name_stars(np.clip(image, 0, 65535).astype(np.uint16), CAMERA, SkyView(time=TIME, origin=PLACE))
    assert found.detected.left_out["hot pixels"] >= 9
    assert found.detected.left_out["streaks"] >= 5
    assert found.detected.left_out["wider than a star"] >= 1
    apart = np.linalg.norm(found.detected.pixels[:, None] - flashes, axis=-1)
    assert (apart.min(0) < 0.5).sum() >= 5
    assert bool((found.attitude.star[apart.min(1) < 0.5] == -1).all())
    assert found.heading_pitch_roll == pytest.approx(LOOK, abs=0.01)


def test_attitude_on_earth_within_its_sigma(night: Any) -> None:
    found = name_stars(night, CAMERA, SkyView(time=TIME, origin=PLACE, dut1=0.0, time_sigma=0.0))
    assert found.attitude.count > 30
    assert found.attitude.rms_px < 0.12
    heading, pitch, roll = found.heading_pitch_roll or (0.0, 0.0, 0.0)
    assert heading == pytest.approx(LOOK[0], abs=0.004)
    assert pitch == pytest.approx(LOOK[1], abs=0.004)
    assert roll == pytest.approx(LOOK[2], abs=0.008)
    assert max(found.sigma_deg) < 0.004
    unknown = name_stars(night, CAMERA, SkyView(time=TIME, origin=PLACE))
    # 0.52 s of UT1 by 15 seconds of arc, times the sine of the latitude about the vertical.
    grown = np.sqrt(unknown.sigma_deg[2] ** 2 - found.sigma_deg[2] ** 2)
    assert grown == pytest.approx(np.hypot(0.52, 0.1) * 15.04 / 3600 * np.sin(np.radians(PLACE.lat)), rel=0.02)


def test_stars_below_the_horizon_name_nothing(night: Any) -> None:
    """Points of light at the antipodes of stars below the horizon have no name."""
    pixels, index = star_pixels(CAMERA, LOOK)
    there = observed_directions(CATALOG, TIME, PLACE)
    rays = torch.from_numpy(-there[there[:, 2] < -0.1]) @ enu_from_cam(*LOOK)
    at, valid = CAMERA.project(1e9 * rays)
    phantoms = at[valid & CAMERA.inside(at)].numpy()
    phantoms = phantoms[np.linalg.norm(phantoms[:, None] - pixels, axis=-1).min(1) > 15][:40]
    assert len(phantoms) == 40
    both = np.concatenate([CATALOG.magnitude[index], np.full(40, 5.0)])
    found = name_stars(
        rendered(CAMERA, np.concatenate([pixels, phantoms]), both), CAMERA, SkyView(time=TIME, origin=PLACE)
    )
    assert bool((found.directions[found.attitude.star[found.attitude.star >= 0], 2] > 0.08).all())


def test_eight_bits_name_stars_too(night: Any) -> None:
    image = np.clip((night.astype(float) - 400) / 30.0, 0, 255).astype(np.uint8)
    found = name_stars(image, CAMERA)
    assert found.attitude.count > 20
    assert found.right_ascension_declination is not None


def test_fewer_stars_than_tell_have_no_name() -> None:
    pixels, _ = star_pixels(CAMERA, LOOK)
    rays = CAMERA.unproject(torch.from_numpy(pixels[:4]))[0].numpy()
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    assert identify(rays, 1e-3, field=field_angle(CAMERA)) is None
    assert identify(rays[:3], 1e-4) is None


@pytest.mark.parametrize("focal", [900.0, 5000.0])
def test_random_points_have_no_names(focal: float) -> None:
    generator = np.random.default_rng(int(focal))
    camera = night_camera(focal)
    for _ in range(4):
        pixels = generator.random((int(generator.integers(4, 21)), 2)) * camera.size
        rays = np.c_[(pixels - camera.params[2:4].numpy()) / focal, np.ones(len(pixels))]
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        assert identify(rays, 2.5 / focal, field=field_angle(camera)) is None


def test_mirrored(night: Any) -> None:
    with pytest.raises(InputError, match="the image is mirrored"):
        name_stars(np.ascontiguousarray(night[:, ::-1]), CAMERA)


def test_wrong_time_is_stated(night: Any) -> None:
    antipode = Origin(lat=-PLACE.lat, lon=PLACE.lon + 180.0, height=0.0)
    found = name_stars(night, CAMERA, SkyView(time=TIME, origin=antipode))
    assert found.attitude.count > 30
    assert not found.on_earth
    assert "would stand below the horizon" in found.warnings[0]
    # Half a year and half a day later the same stars stand there by day.
    by_day = name_stars(night, CAMERA, SkyView(time=TIME + datetime.timedelta(days=182.5), origin=PLACE))
    assert by_day.on_earth
    assert "the Sun would stand at +" in by_day.warnings[0]
    assert name_stars(night, CAMERA, SkyView(time=TIME, origin=PLACE)).warnings == ()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.full((600, 960), 3, np.uint8), "is the lens cap on"),
        (np.full((600, 960), 250, np.uint8), "bright as day"),
        (np.random.default_rng(0).normal(600, 20, (600, 960)).astype(np.uint16), "no stars"),
        (np.zeros((600, 900), np.uint8), "900x600 pixels, the camera 960x600"),
    ],
)
def test_what_is_no_night(image: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        name_stars(image, CAMERA)


def test_the_table_is_cached_and_a_broken_one_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KCAL_CACHE", str(tmp_path / "made"))
    made = pair_table(CATALOG, 0.05)
    (file,) = cache_folder().iterdir()
    before = file.stat().st_mtime_ns
    assert pair_table(CATALOG, 0.05) is made  # of the next image of the same camera
    _table_of.cache_clear()
    again = pair_table(CATALOG, 0.05)
    assert file.stat().st_mtime_ns == before
    assert np.array_equal(made.pairs, again.pairs)
    file.write_bytes(file.read_bytes()[:1000])
    _table_of.cache_clear()
    assert np.array_equal(made.angle, pair_table(CATALOG, 0.05).angle)
    assert file.stat().st_size > 1000


def test_without_pyerfa(monkeypatch: pytest.MonkeyPatch, night: Any) -> None:
    real = builtins.__import__

    def without(name: str, *rest: Any, **more: Any) -> Any:
        if name == "erfa":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(InputError, match=r"pip install 'kcal\[stars\]'"):
        name_stars(night, CAMERA, SkyView(time=TIME, origin=PLACE))


def test_wrong_camera(night: Any) -> None:
    other = Camera.build(focal=(1500, 1500), center=(479.5, 299.5), size=(960, 600), model="pinhole")
    with pytest.raises(InputError, match="the camera file is of another lens"):
        name_stars(night, other)


@pytest.mark.parametrize(
    ("hours", "degrees", "share"),
    [(0.0, 0.0, None), (-1.0, 0.0, 0.48), (0.0, 10.0, 0.62)],
    ids=["right", "time", "place"],
)
def test_refraction_tells_a_wrong_time_or_place(night: Any, hours: float, degrees: float, share: float | None) -> None:
    """All stars stay above the horizon; the camera would only stand otherwise."""
    place = Origin(lat=PLACE.lat + degrees, lon=PLACE.lon, height=PLACE.height)
    found = name_stars(night, CAMERA, SkyView(time=TIME + datetime.timedelta(hours=hours), origin=place))
    assert found.on_earth
    if share is None:
        assert found.warnings == ()
    else:
        (text,) = found.warnings
        assert text.startswith("refraction is ")
        assert float(text.split()[2]) == pytest.approx(share, abs=0.1)


def test_fits(night: Any, tmp_path: Path) -> None:
    """The first image of a file whose rows count from below; tables and colors beside it."""
    fits = pytest.importorskip("astropy.io.fits", reason="FITS files need astropy: pip install astropy")
    path = tmp_path / "night.fits"
    table = fits.BinTableHDU.from_columns([fits.Column(name="a", format="E", array=np.zeros(3))])
    fits.HDUList([fits.PrimaryHDU(), table, fits.ImageHDU(night[::-1])]).writeto(path)
    image = read_night(path)
    assert np.array_equal(image, night)
    assert name_stars(image, CAMERA).attitude.count > 30
    fits.HDUList([fits.PrimaryHDU(np.zeros((3, 20, 20)))]).writeto(tmp_path / "color.fits")
    with pytest.raises(FileError, match="no image"):
        read_night(tmp_path / "color.fits")
    (tmp_path / "no.fits").write_bytes(b"nothing")
    with pytest.raises(FileError, match=r"no\.fits: not a FITS file"):
        read_night(tmp_path / "no.fits")


@pytest.mark.parametrize("field", [0.15, 2.0])
def test_narrow_and_wide_fields_have_names(field: float) -> None:
    """Triangles may be as small as the field asks: within 4 degrees all sides are short, of 115 degrees few are."""
    seen = CATALOG.directions()[np.argsort(CATALOG.magnitude, kind="stable")]
    axis = np.array([0.35, -0.6, 0.2]) / np.linalg.norm([0.35, -0.6, 0.2]) if field > 1 else seen[2000]
    ahead = seen[seen @ axis > np.cos(0.5 * field)][:25]
    turn = enu_from_cam(40.0, 10.0, 5.0).numpy()
    found = identify(ahead @ turn, 1e-4, field=field)
    assert found.matches >= 0.8 * len(ahead)
    np.testing.assert_allclose(found.rotation, turn.T, atol=1e-4)


# The catalog in the package, and where its stars are seen.


SIRIUS, POLARIS = 2491, 424


def of(number: int) -> int:
    return int(np.flatnonzero(CATALOG.number == number)[0])


def test_known_places() -> None:
    """Sirius at J2000: 6h 45m 8.92s, -16° 42' 58.0" (SIMBAD)."""
    i = of(SIRIUS)
    assert np.degrees(CATALOG.ra[i]) == pytest.approx(15 * (6 + 45 / 60 + 8.92 / 3600), abs=1e-3)
    assert np.degrees(CATALOG.dec[i]) == pytest.approx(-(16 + 42 / 60 + 58.0 / 3600), abs=1e-3)
    assert len(CATALOG) == 9096


def test_proper_motion() -> None:
    """61 Cygni A (HR 8085) moves by 5.2 seconds of arc a year."""
    i = of(8085)
    turned = np.arccos(np.clip(CATALOG.directions(2000.0)[i] @ CATALOG.directions(2100.0)[i], -1, 1))
    assert np.degrees(turned) * 3600 == pytest.approx(520, rel=0.03)


def test_named_stars_are_bright() -> None:
    assert all(CATALOG.magnitude[of(number)] < 3.4 for number in _NAMES)
    assert len(set(_NAMES.values())) == len(_NAMES)


def test_out_of_range() -> None:
    with pytest.raises(InputError, match="is the clock of the camera right"):
        celestial_directions(CATALOG, datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC))


@pytest.mark.parametrize("text", ["2026-11-24T20:47:26", "yesterday", ""])
def test_a_time_has_a_zone(text: str) -> None:
    with pytest.raises(InputError, match=r"no zone|write it like"):
        instant(text, "time")


def test_aberration_is_twenty_seconds_of_arc() -> None:
    moved = celestial_directions(CATALOG, datetime.datetime(2000, 1, 1, 12, tzinfo=datetime.UTC))
    seconds = np.degrees(np.linalg.norm(moved - CATALOG.directions(), axis=1)) * 3600
    # Near the Sun its light deflection adds up to 1.8.
    assert 20.7 < np.quantile(seconds, 0.99) < 20.9  # 30.29 km/s in January, over the speed of light
    assert seconds.max() < 22.5


def test_the_sky_turns_about_the_pole_by_15_seconds_of_arc_a_second() -> None:
    place, time = Origin(lat=40.0, lon=10.0, height=0.0), datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
    vacuum = Air(hectopascal=0.0)
    now = observed_directions(CATALOG, time, place, vacuum)
    later = observed_directions(CATALOG, time + datetime.timedelta(seconds=10), place, vacuum)
    by_dut1 = observed_directions(CATALOG, time, place, vacuum, dut1=0.5)
    moved = np.degrees(np.linalg.norm(later - now, axis=1)) * 3600
    assert moved.max() == pytest.approx(150.4, abs=0.2)
    assert np.degrees(np.linalg.norm(by_dut1 - now, axis=1)).max() * 3600 == pytest.approx(7.52, abs=0.01)
    assert now[of(POLARIS), 2] == pytest.approx(np.sin(np.radians(40.0)), abs=0.012)


def test_refraction_lifts() -> None:
    place, time = Origin(lat=40.0, lon=10.0, height=0.0), datetime.datetime(2026, 1, 1, tzinfo=datetime.UTC)
    straight = np.degrees(np.arcsin(observed_directions(CATALOG, time, place, Air(hectopascal=0.0))[:, 2]))
    bent = np.degrees(np.arcsin(observed_directions(CATALOG, time, place, Air(hectopascal=1013.0))[:, 2]))
    at_ten = np.abs(straight - 10.0) < 0.2
    assert 60 * (bent - straight)[at_ten].mean() == pytest.approx(5.3, abs=0.15)  # minutes of arc (Bennett 1982)


# How probable it is that chance explains matches: what proves a name.


def test_three_matches_are_those_of_the_triangle() -> None:
    every = np.ones(6, bool)
    # Three sizes are tried; all of six are met, three of them by chance.
    assert _by_chance(every, 0.1) == pytest.approx(3 * 0.1**3)
    assert _by_chance(every[:4], 0.1) == pytest.approx(0.1)
    # One of four met beyond the triangle: that is the best that there is.
    assert _by_chance(np.array([True, True, True, True, False, False]), 0.1) == pytest.approx(3 * 0.1)
    assert _by_chance(~every, 0.1) == pytest.approx(3.0)
    # Of five, two by chance, the first is not met: 1 - (1 - p)^1 at four, then the other sizes.
    assert _by_chance(np.array([False, True, True, True, True]), 0.1) == pytest.approx(2 * (1 - 0.9**2))
