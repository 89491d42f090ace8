"""The page of columns has each column of the code once in its section, and no other."""

from __future__ import annotations

import inspect
import re
from pathlib import Path

import pytest

from kcal.calibrate.batch.jobs import _COLUMNS
from kcal.calibrate.batch.results import SummaryRow
from kcal.locate.marks import COVARIANCE, PIXELS
from kcal.locate.survey import FEATURE_COLUMNS, PLACE_COLUMNS
from kcal.locate.tables import NUMBERS, TEXTS
from kcal.pipeline.stream import track_columns

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
    assert sorted(features) == sorted(set(FEATURE_COLUMNS) - set(marks))


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
