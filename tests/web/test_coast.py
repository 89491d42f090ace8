"""The coastline in the package, against capes and inland places that everyone knows."""

import itertools
import math
from importlib import resources

import pytest

from kcal.web.coast import coast_near


def nearest_km(lat: float, lon: float) -> float:
    """To the nearest point on a line of the coast."""
    wide = math.cos(math.radians(lat))

    def far(a: list[float], b: list[float]) -> float:
        ax, ay, bx, by = ((p[i] - (lat, lon)[i]) * (1.0, wide)[i] for p in (a, b) for i in (1, 0))
        length = (bx - ax) ** 2 + (by - ay) ** 2
        along = 0.0 if length == 0 else min(max(-(ax * (bx - ax) + ay * (by - ay)) / length, 0.0), 1.0)
        return math.hypot(ax + along * (bx - ax), ay + along * (by - ay))

    lines = coast_near(lat, lon)
    return 111.2 * min((far(a, b) for line in lines for a, b in itertools.pairwise(line)), default=math.inf)


@pytest.mark.parametrize(
    ("lat", "lon"),
    [
        (-34.357, 18.474),  # Cape of Good Hope
        (50.066, -5.715),  # Land's End
        (71.171, 25.783),  # North Cape
        (36.109, -5.346),  # Europa Point
        (8.078, 77.551),  # Kanyakumari
        (-16.9, 179.98),  # Fiji, at the antimeridian
        (38.7, -9.45),  # Cascais
    ],
)
def test_capes_are_at_the_coast(lat: float, lon: float) -> None:
    assert nearest_km(lat, lon) < 8.0


def test_no_coast_far_inland() -> None:
    assert coast_near(51.96, 85.96, 3.0) == []
    assert nearest_km(46.8, 8.2) > 200.0


@pytest.mark.parametrize("lon", [179.9, -179.9])
def test_lines_do_not_jump_at_the_antimeridian(lon: float) -> None:
    lines = coast_near(66.0, lon)
    assert lines
    for line in lines:
        assert all(abs(place[1] - lon) <= 30.0 for place in line)
        assert all(abs(a[1] - b[1]) < 2.0 for a, b in itertools.pairwise(line))


def test_its_source_is_named() -> None:
    text = (resources.files("kcal.web") / "map" / "COAST.txt").read_text(encoding="utf-8")
    assert "Natural Earth" in text
    assert "public domain" in text
