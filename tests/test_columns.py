"""The page of columns, and quantities as texts."""

import inspect
import math
import re
from pathlib import Path

import pytest

from kcal.calibrate.batch.jobs import _COLUMNS
from kcal.calibrate.batch.results import SummaryRow
from kcal.locate.marks import COVARIANCE, PIXELS
from kcal.locate.survey import PLACE_COLUMNS, RANGES
from kcal.locate.tables import NUMBERS, TEXTS
from kcal.pipeline.stream import track_columns
from kcal.texts import length_text, length_unit, measured_length, measured_text, number_text, range_text

# The page of columns has each column of the code once in its section, and no other.


ROOT = Path(__file__).parents[1]

PAGE = (ROOT / "docs" / "reference" / "columns.md").read_text(encoding="utf-8")

SOURCE = inspect.getsource(track_columns)


def tables(section: str) -> list[list[str]]:
    """Names in the first column of each table of a section."""
    text = PAGE.split(f"\n## {section}\n")[1].split("\n## ")[0]
    found = []
    for block in re.findall(r"\|---.*\n((?:\|.*\n?)+)", text):
        cells = [line.split("|")[1] for line in block.splitlines()]
        found.append([name for cell in cells for name in re.findall(r"`(\w+)`", cell)])
    return found


def test_marks_and_features() -> None:
    marks, features = tables("Marks")
    assert sorted(marks) == sorted(("name", *PIXELS, *COVARIANCE, "note"))
    assert sorted(features) == sorted(RANGES)


def test_places() -> None:
    assert [sorted(names) for names in tables("Places")] == [sorted(PLACE_COLUMNS)]


def test_positions_and_tracks() -> None:
    positions, tracks = tables("Positions")
    assert positions == [*TEXTS, *NUMBERS]
    plain = re.findall(r'^        (?:extras\[)?"(\w+)"(?:: |\] = )', SOURCE, re.MULTILINE)
    velocity = [f"velocity_{axis}{part}_mps" for part in ("", "_sigma") for axis in ("east", "north", "up")]
    assert tracks == [*plain[:5], *velocity, *plain[5:]]


def test_batches() -> None:
    assert sorted(tables("Cameras of a batch")[0]) == sorted(SummaryRow._fields)
    for name in _COLUMNS:
        assert f"`{name}`" in PAGE.split("## Cameras of a batch")[1].split("summary.csv")[0]


def test_every_name_with_a_unit_has_it_in_its_row() -> None:
    units = {"_m": "m", "_m2": "m²", "_mps": "m/s", "_px": "px", "_deg": "°", "_s": "s"}
    for cells in re.findall(r"^\| (`.*?) \| (.*?) \|", PAGE, re.MULTILINE):
        for name in re.findall(r"`(\w+)`", cells[0]):
            if suffix := re.search(r"_(m|m2|mps|px|deg|s)$", name):
                per = re.search(r"_m_per_(px|deg_yaw)$", name)
                assert cells[1] == (units[suffix[0]] if per is None else cells[1]), name


@pytest.mark.parametrize(
    "word", ["positive to the right", "positive downward", "clockwise from true north", "positive up"]
)
def test_signs_are_said(word: str) -> None:
    assert word in PAGE


# Numbers as texts: two digits of the standard deviation, and a unit that fits.


@pytest.mark.parametrize(
    ("value", "sigma", "text"),
    [
        (0.0832168, 2.17e-5, "0.083217"),
        (0.0832168, 2.17e-4, "0.08322"),
        (1983.4, 586.0, "1980"),
        (9.96, 0.996, "10.0"),
        (9.96, 0.0996, "9.96"),
        (-0.004, 0.5, "0.00"),
        (1.0, 3e5, "0"),
        (5.0, None, "5.00"),
        (5.0, 0.0, "5.00"),
        (5.0, math.inf, "5.00"),
        (0.0, None, "0"),
        (math.nan, 1.0, "–"),
        (-math.inf, None, "-∞"),
        (3.4567e-7, 2e-9, "3.457e-07"),
        (1e-9, 3e-7, "1e-09"),
    ],
)
def test_two_digits_of_sigma(value: float, sigma: float | None, text: str) -> None:
    assert number_text(value, sigma) == text


def test_a_sigma_is_never_written_as_zero() -> None:
    for power in range(-12, 9):
        spread = 2.2 * 10.0**power
        assert float(number_text(spread, spread)) == pytest.approx(spread)
        assert float(measured_text(1.0, spread).split(" ± ")[1]) == pytest.approx(spread)
    assert measured_text(1.0, 0.0) == "1.00 ± 0"


def test_units_fit_the_range() -> None:
    assert [length_text(one) for one in (0.4, 400.0, 4000.0, 40e3)] == ["400 mm", "400 m", "4000 m", "40.0 km"]
    assert [range_text(one) for one in (0.4, 400.0, 4000.0, 40e3)] == ["400 mm", "400 m", "4 km", "40 km"]
    assert measured_length(0.083217, 2.2e-5) == "83.217 ± 0.022 mm"
    assert measured_length(0.083217, None) == "83.2 mm"
    assert length_unit([0.3, math.inf, None]).name == "mm"
    assert length_unit([]).name == "m"
    assert (length_text(0.0), length_text(math.inf)) == ("0", "∞")
    assert length_text(-0.0012, sign=True) == "-1.20 mm"


@pytest.mark.parametrize(
    ("value", "sigma", "digits", "sign", "text"),
    [
        (83.21683, None, 2, False, "83"),
        (83.21683, None, 5, False, "83.217"),
        (999.96, None, 4, False, "1000"),
        (0.0996, None, 2, False, "0.10"),
        (1234.0, None, 2, False, "1200"),
        (5.0, 1.0, 3, True, "+5.0"),
        (-5.0, 1.0, 3, True, "-5.0"),
        (2e-5, None, 3, False, "2.00e-05"),
        (2e-4, None, 3, False, "0.000200"),
        (3.0, 1e-7, 3, False, "3.00000000"),
        (2e-5, 1e-8, 3, True, "+2.0000e-05"),
    ],
)
def test_digits_signs_and_exponents(value: float, sigma: float | None, digits: int, sign: bool, text: str) -> None:
    assert number_text(value, sigma, digits=digits, sign=sign) == text


def test_units_change_where_they_should() -> None:
    lengths = (0.9999, 1.0, 999.9, 9999.0, 1e4)
    assert [length_unit([one]).name for one in lengths] == ["mm", "m", "m", "m", "km"]
    assert [range_text(one) for one in (0.5, 1.0, 999.0, 1000.0)] == ["500 mm", "1 m", "999 m", "1 km"]
    assert length_unit([-2e4, 1.0]).name == "km"
    assert length_text(math.nan) == "–"
    assert measured_text(2.0, math.inf, "px") == "2.00 px"
    assert measured_text(2.0, 0.1, "px", sign=True) == "+2.00 ± 0.10 px"
