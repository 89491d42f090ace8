"""The catalog of stars, and chance matches."""

import datetime

import numpy as np
import pytest

from kcal import InputError, Origin
from kcal.stars.sky import _NAMES, Air, StarCatalog, _by_chance, celestial_directions, observed_directions
from kcal.values import instant

# The catalog in the package, and where its stars are seen.


SIRIUS, POLARIS = 2491, 424

CATALOG = StarCatalog.bundled()


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
