"""`kcal sites`: the map, the order of candidates, the picture, and what is refused."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kcal.cli.main import app
from kcal.errors import InputError
from kcal.io.rig_file import save_camera_rig
from scripts.shared.station_scenes import ring

AREA = "44.98,5.97,45.02,6.03"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rows = [
        " ".join(f"{100 + 60 * math.exp(-(((j - 45) / 3) ** 2)):.1f}" for j in range(90)) for _ in range(60)
    ]  # a ridge from south to north
    head = "ncols 90\nnrows 60\nxllcorner 5.955\nyllcorner 44.97\ncellsize 0.001\n"
    (tmp_path / "hills.asc").write_text(head + "\n".join(rows) + "\n")
    (tmp_path / "towers.csv").write_text("name,lat,lon,mast\nmill,44.985,5.975,20\nmast,45.015,5.975,20\n")
    (tmp_path / "candidates.csv").write_text("name,lat,lon,mast\nwest,45.0,5.972,20\nridge,45.0,6.0005,20\n")
    return tmp_path


def run(folder: Path, *words: str) -> str:
    given = [str(folder / word) if Path(word).suffix in (".csv", ".asc", ".png", ".json") else word for word in words]
    result = CliRunner().invoke(app, ["sites", *given, "--cells", "40"])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.output


def test_the_site_on_the_ridge_is_better(folder: Path) -> None:
    words = ["towers.csv", "--area", AREA, "--terrain", "hills.asc", "--candidates", "candidates.csv"]
    told = json.loads(run(folder, *words, "-o", "map.csv", "--picture", "sites.png", "--json"))
    assert [(one["name"], one["order"]) for one in told["candidates"]] == [("ridge", 1), ("west", None)]
    assert told["candidates"][0]["mean_sigma_after_m"] < told["mean_sigma_m"]
    assert (folder / "sites.png").stat().st_size > 10_000
    with (folder / "map.csv").open() as file:
        rows = list(csv.DictReader(file))
    behind = [row for row in rows if float(row["lon"]) > 6.01]
    assert {row["seen_by"] for row in behind} == {"0"}
    assert {row["seen_by_after"] for row in behind} == {"1"}
    before = [row for row in rows if float(row["lon"]) < 5.99]
    assert min(float(row["sigma_m"]) for row in before) < 10.0
    assert "ridge" in run(folder, *words)


def test_a_rig_of_stations_on_level_ground(folder: Path) -> None:
    rig = ring(3, 3000.0)
    rig.root = rig.with_errors(position_m=0.1, attitude_deg=0.01)
    save_camera_rig(rig, folder / "towers.json")
    told = json.loads(run(folder, "towers.json", "--area", AREA, "--ground", "790", "--pixel-sigma", "1", "--json"))
    assert told["covered"] > 0.3
    assert "candidates" in told
    rig.root = None
    save_camera_rig(rig, folder / "towers.json")
    assert "no error bars" in run(folder, "towers.json", "--area", AREA, "--ground", "790")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--area", AREA], "give --terrain, or --ground"),
        (["--area", AREA, "--terrain", "hills.asc", "--ground", "3"], "one of them"),
        (["--area", "45,6", "--ground", "3"], "write SOUTH,WEST,NORTH,EAST"),
        (["--area", "46,6,45,7", "--ground", "3"], "SOUTH,WEST,NORTH,EAST in degrees"),
        (["--area", "50,5,51,6", "--terrain", "hills.asc"], "the terrain has no height there"),
        (["--area", AREA, "--terrain", "hills.asc", "--candidates", "towers.csv"], "is a tower and a candidate"),
    ],
)
def test_refusals(folder: Path, words: list[str], text: str) -> None:
    with pytest.raises(InputError, match=text):
        run(folder, "towers.csv", *words)


def test_ground_that_is_not_known_is_told(folder: Path) -> None:
    wide = "44.98,5.97,45.02,6.10"
    text = run(folder, "towers.csv", "--area", wide, "--terrain", "hills.asc")
    assert "no heights in" in text
