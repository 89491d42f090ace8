"""Reports and sites."""

import json
import math
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from browser import chromium_page, needs_browser
from calibrate_scenes import corner_pixels, observe
from command_line import invoked, ran, rows_of
from locate_rigs import pinhole_rig

from kcal import InputError, save_rig
from kcal.cli.main import app
from kcal.rig import RigCovariance
from scripts.shared.station_scenes import ring

# `kcal report` and `--require`: exit codes, JSON for programs, the page in a browser, completion of shells.


def kcal(*words: object) -> tuple[int, str]:
    found = ran(*words)
    return found.exit_code, found.stdout


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Observations of an opencv5 camera, and that camera calibrated."""
    here = tmp_path_factory.mktemp("report")
    observe(corner_pixels(14, 3, noise=0.05)).save(here / "left.obs.json")
    words = ("calibrate", here / "left.obs.json", "-o", here / "left.camera.json", "--model", "opencv5")
    code, text = kcal(*words, "--temperature", 21.5)
    assert code == 0
    # Centimeters in place of millimeters show here.
    assert "board 7x6 inner corners, 50 mm squares: 300 x 250 mm; nearest view 0.4" in text
    return here


@pytest.mark.slow
def test_a_camera_is_judged_by_its_file_and_by_its_views(folder: Path) -> None:
    code, text = kcal("report", folder / "left.camera.json", "--require", "100m:10%,9km:1%")
    assert code == 3
    assert "NO: at 9 km no range can be told; 1 % are required" in text
    assert "give the observations too" in text
    code, text = kcal(
        "report", folder / "left.camera.json", "--observations", folder / "left.obs.json", "--require", "50m:10%",
        "-o", folder / "left.html", "--json",
    )  # fmt: skip
    told = json.loads(text)
    assert code == told["exit_code"] == 0
    assert told["verdict"]["usable"] is True
    assert told["verdict"]["ranges"][0]["sigma_m"] < 5.0
    assert told["wrote"] == [str(folder / "left.html")]
    page = (folder / "left.html").read_text()
    assert ">YES<" in page
    for name in ("ranges", "coverage", "uncertainty", "residuals", "views", "poses", "halves", "model"):
        assert f'id="{name}"' in page


@pytest.mark.slow
def test_calibration_ends_with_3_where_what_is_required_is_not_met(folder: Path) -> None:
    words = ("calibrate", folder / "left.obs.json", "-o", folder / "again.json", "--model", "pinhole")
    code, text = kcal(*words, "--require", "200m:5%")
    assert code == 3
    assert "NO: the lens model pinhole does not fit this lens" in text
    assert (folder / "again.json").exists()
    code, _ = kcal(*words, "--require", "200m")
    assert code == 1
    (folder / "right.obs.json").write_bytes((folder / "left.obs.json").read_bytes())
    both = [str(folder / f"{side}.obs.json") for side in ("left", "right")]
    found = ran("calibrate", *both, "-o", folder / "both", *words[4:], "--require", "200m:5%")
    assert found.stdout.count("NO: the lens model pinhole") == 2
    assert found.stderr.count("noise of marks: 0.3 px, assumed") == 1


def test_a_rig_is_judged_by_its_covariance(tmp_path: Path) -> None:
    rig = pinhole_rig()
    yaw = torch.diag(torch.tensor([0, (1e-3 * torch.pi / 180) ** 2, 0, 0, 0, 0], dtype=torch.float64))
    rig.covariance = RigCovariance.of(rig, pose=yaw)
    save_rig(rig, tmp_path / "rig.json")
    code, text = kcal("report", tmp_path / "rig.json", "--require", "1km:5%", "--pixel-sigma", 0.1)
    assert (code, text.count("at 1 km the range is known"), "YES" in text) == (0, 1, True)
    code, text = kcal("report", tmp_path / "rig.json", "--require", "500m:5%,1km:5%", "--pixel-sigma", 0.1)
    assert (code, text.count("met: at"), "YES" in text) == (0, 2, True)
    code, text = kcal("report", tmp_path / "rig.json", "--require", "5km:1%", "--pixel-sigma", 0.1)
    assert (code, "most of it is from marks" in text) == (3, True)


def test_the_temperature_is_kept_and_told(folder: Path) -> None:
    warm = json.loads((folder / "left.camera.json").read_text())
    warm["calibration"]["temperature"] = 30.0
    (folder / "warm.json").write_text(json.dumps(warm))
    code, text = kcal("diff", folder / "left.camera.json", folder / "warm.json", "--json")
    told = json.loads(text)
    assert (code, told["temperature_c"], told["same"]) == (0, [21.5, 30.0], True)
    assert "8.5 °C warmer" in told["text"]
    assert "at 21.5 °C" in kcal("show", folder / "left.camera.json")[1]


def commands(app_or_group: Any, *path: str) -> list[tuple[str, ...]]:
    """All commands, as words."""
    found = []
    for name, command in app_or_group.commands.items():
        found += commands(command, *path, name) if getattr(command, "commands", None) else [(*path, name)]
    return found


def test_every_command_has_json_but_those_that_serve_pages_or_streams() -> None:
    from typer.main import get_command

    group: Any = get_command(app)
    for words in commands(group):
        command: Any = group
        for word in words:
            command = command.commands[word]
        options = {name for parameter in command.params for name in parameter.opts}
        assert ("--json" in options) == (words not in (("mark",), ("capture",), ("live",), ("watch",))), words


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_installs(shell: str, tmp_path: Path) -> None:
    environment = {**os.environ, "HOME": str(tmp_path), "ZDOTDIR": str(tmp_path)}
    environment["_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION"] = "1"
    script = [sys.executable, "-c", "import sys; sys.argv[0] = 'kcal'; from kcal.cli.main import main; main()"]
    done = subprocess.run([*script, "--install-completion", shell], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    written = [path for path in tmp_path.rglob("*") if path.is_file() and "kcal" in path.read_text()]
    assert written
    # What the installed script asks for when Tab is pressed.
    asked = {**environment, "_KCAL_COMPLETE": f"complete_{shell}", "COMP_WORDS": "kcal rep", "COMP_CWORD": "1",
             "_TYPER_COMPLETE_ARGS": "kcal rep", "_TYPER_COMPLETE_FISH_ACTION": "get-args"}  # fmt: skip
    assert "report" in subprocess.run(script, env=asked, capture_output=True, text=True).stdout


@needs_browser
@pytest.mark.parametrize(("width", "height"), [(1400, 900), (390, 844)])
def test_a_browser_shows_the_page_without_errors_and_requests(folder: Path, width: int, height: int) -> None:
    page_file = folder / "page.html"
    kcal("report", folder / "left.camera.json", "--require", "100m:10%,1km:5%,5km:10%", "-o", page_file)
    with chromium_page(width, height) as page:
        page.goto(page_file.as_uri())
        # The answer, why, and what to do fit one screen; nothing is wider than it.
        assert page.locator("header").bounding_box()["height"] <= height
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.locator(".answer").inner_text() == "NO"
        assert page.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
        assert page.complaints == []


# `kcal sites`: the map, the order of candidates, the picture, and what is refused.


AREA = "44.98,5.97,45.02,6.03"


@pytest.fixture
def site_folder(tmp_path: Path) -> Path:
    rows = [
        " ".join(f"{100 + 60 * math.exp(-(((j - 45) / 3) ** 2)):.1f}" for j in range(90)) for _ in range(60)
    ]  # a ridge from south to north
    head = "ncols 90\nnrows 60\nxllcorner 5.955\nyllcorner 44.97\ncellsize 0.001\n"
    (tmp_path / "hills.asc").write_text(head + "\n".join(rows) + "\n")
    (tmp_path / "towers.csv").write_text("name,lat,lon,mast\nmill,44.985,5.975,20\nmast,45.015,5.975,20\n")
    (tmp_path / "candidates.csv").write_text("name,lat,lon,mast\nwest,45.0,5.972,20\nridge,45.0,6.0005,20\n")
    return tmp_path


def run(site_folder: Path, *words: str) -> str:
    given = [
        str(site_folder / word) if Path(word).suffix in (".csv", ".asc", ".png", ".json") else word for word in words
    ]
    return invoked("sites", *given, "--cells", "40")


def test_the_site_on_the_ridge_is_better(site_folder: Path) -> None:
    words = ["towers.csv", "--area", AREA, "--terrain", "hills.asc", "--candidates", "candidates.csv"]
    told = json.loads(run(site_folder, *words, "-o", "map.csv", "--picture", "sites.png", "--json"))
    assert [(one["name"], one["order"]) for one in told["candidates"]] == [("ridge", 1), ("west", None)]
    assert told["candidates"][0]["mean_sigma_after_m"] < told["mean_sigma_m"]
    assert (site_folder / "sites.png").stat().st_size > 10_000
    rows = rows_of(site_folder / "map.csv")
    behind = [row for row in rows if float(row["lon"]) > 6.01]
    assert {row["seen_by"] for row in behind} == {"0"}
    assert {row["seen_by_after"] for row in behind} == {"1"}
    before = [row for row in rows if float(row["lon"]) < 5.99]
    assert min(float(row["sigma_m"]) for row in before) < 10.0
    assert "ridge" in run(site_folder, *words)


def test_a_rig_of_stations_on_level_ground(site_folder: Path) -> None:
    rig = ring(3, 3000.0)
    rig.root = rig.with_errors(position_m=0.1, attitude_deg=0.01)
    save_rig(rig, site_folder / "towers.json")
    told = json.loads(
        run(site_folder, "towers.json", "--area", AREA, "--ground", "790", "--pixel-sigma", "1", "--json")
    )
    assert told["covered"] > 0.3
    assert "candidates" in told
    rig.root = None
    save_rig(rig, site_folder / "towers.json")
    assert "no error bars" in run(site_folder, "towers.json", "--area", AREA, "--ground", "790")


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
def test_refusals(site_folder: Path, words: list[str], text: str) -> None:
    with pytest.raises(InputError, match=text):
        run(site_folder, "towers.csv", *words)


def test_ground_that_is_not_known_is_told(site_folder: Path) -> None:
    wide = "44.98,5.97,45.02,6.10"
    assert "no heights in" in run(site_folder, "towers.csv", "--area", wide, "--terrain", "hills.asc")
