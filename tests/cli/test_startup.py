"""Which large libraries a command loads: `--help` and `show` none, others only what they compute with."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from kcal import Board, Camera, Observations, View, load_rig, save_camera
from kcal.cli.main import app
from scripts.bench.startup import helps, measure

SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"
PIXELS = tuple((100.0 + 50.0 * column, 100.0 + 50.0 * row) for row in range(3) for column in range(4))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("startup")
    rig = load_rig(SAMPLE)
    save_camera(rig.left, folder / "left.json")
    plain = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1, 0.01, 0, 0])
    save_camera(plain, folder / "plain.json", name="plain")
    views = (View(name="a.png", pixels=PIXELS),)
    Observations(board=Board(columns=4, rows=3, square=0.1), image_size=(640, 480), views=views).save(
        folder / "seen.json"
    )
    return folder


def test_help_loads_no_large_library(tmp_path: Path) -> None:
    assert len(helps()) > 20
    code = """import contextlib, io
from kcal.cli.main import app
for words in {}:
    with contextlib.suppress(SystemExit), contextlib.redirect_stdout(io.StringIO()):
        app(words)"""
    _, _, loaded = measure([], tmp_path, code.format(helps()))
    assert loaded == []


@pytest.mark.parametrize("name", ["left.json", "plain.json", "seen.json", str(SAMPLE)])
def test_show_loads_no_large_library(name: str, folder: Path) -> None:
    _, code, loaded = measure(["show", name], folder)
    assert (code, loaded) == (0, [])


@pytest.mark.parametrize(
    ("line", "libraries"),
    [
        ("board --board charuco:9x6 --square 25mm -o board.svg", "cv2"),
        ("diff left.json left.json", "kornia torch"),
        ("export plain.json -o plain.yaml", "cv2 torch"),
        ("report left.json", "torch"),
        (f"report {SAMPLE}", "torch"),
        (f"locate {SAMPLE} {SAMPLE.with_name('sample-points.csv')}", "pyproj torch"),
        ("budget", "kornia pyproj torch"),
    ],
)
def test_a_command_loads_what_it_computes_with_and_no_more(line: str, libraries: str, folder: Path) -> None:
    _, code, loaded = measure(line.split(), folder)
    assert code in (0, 3)
    assert loaded == libraries.split()


@pytest.mark.parametrize(
    ("modules", "without"),
    [
        ("kcal.mark.server, kcal.mark.marking_service", {"kornia", "matplotlib", "scipy.stats", "skimage"}),
        ("kcal.capture.session, kcal.calibrate.camera.calibrate", {"matplotlib", "scipy", "pyproj", "skimage"}),
        ("kcal.corners.detect", {"kornia", "matplotlib", "scipy", "pyproj", "skimage"}),
    ],
)
def test_long_commands_do_not_wait_for_what_they_may_never_use(modules: str, without: set[str], tmp_path: Path) -> None:
    _, code, loaded = measure([], tmp_path, f"import {modules}")
    assert code == 0
    assert "torch" in loaded
    assert not without & set(loaded)


def test_what_is_stored_is_what_is_computed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("left.json", "plain.json", str(SAMPLE)):
        stored = CliRunner().invoke(app, ["show", str(folder / name)]).output
        with monkeypatch.context() as patch:
            patch.setattr("kcal.cli.show._as_written", lambda content: None)
            assert CliRunner().invoke(app, ["show", str(folder / name)]).output == stored


def test_a_file_that_was_changed_is_computed_anew(folder: Path) -> None:
    content = json.loads((folder / "plain.json").read_text())
    assert "focal length 800.000 px" in CliRunner().invoke(app, ["show", str(folder / "plain.json")]).output
    content["intrinsics"] |= {"fx": 900.0, "fy": 900.0}
    (folder / "changed.json").write_text(json.dumps(content))
    assert "focal length 900.000 px" in CliRunner().invoke(app, ["show", str(folder / "changed.json")]).output
