"""Small decisions of commands: which options go together, what stars are told of landmarks, how meters are written."""

import dataclasses
import json
import math
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from calibrate_scenes import corner_pixels, observe
from command_line import Command, invoked, ran
from typer.testing import Result

import kcal
from kcal import Camera, InputError, Rig, save_camera, save_rig
from kcal.cli.board import _of_each_camera
from kcal.cli.console import print_left_out
from kcal.cli.demo import locate_again
from kcal.cli.demo_practice import _first
from kcal.cli.main import app
from kcal.cli.rig import camera_names
from kcal.cli.rig_sources import READERS, RigReading, Sources, parse_baselines, read_sources
from kcal.io.images import write_png
from kcal.lens.calibration import CameraCalibration
from kcal.report.practice_score import _meters, _signed

ROOT = Path(__file__).parents[2]
CAMERAS = [
    Camera.build(focal=(1600 + 5 * k, 1600), center=(960, 540), size=(1920, 1080), model="pinhole") for k in range(2)
]


@pytest.mark.parametrize(("value", "text"), [
    (12.4, "12"), (10.0, "10"), (-10.6, "-11"), (9.94, "9.9"), (0.012, "0.012"), (0.01, "0.01"), (0.0096, "0.010"),
    (0.0004, "0.000"), (-0.25, "-0.25"), (math.nan, ""),
])  # fmt: skip
def test_meters(value: float, text: str) -> None:
    assert _meters(value) == text


@pytest.mark.parametrize(("value", "text"), [(12.4, "+12"), (-12.4, "-12"), (-0.5, "-0.5"), (0.0, "+0.000")])
def test_errors_have_their_sign(value: float, text: str) -> None:
    assert _signed(value) == text


def test_the_first_result_that_is_there(tmp_path: Path) -> None:
    assert _first(tmp_path, ("a", "b")) is None
    (tmp_path / "b").touch()
    assert _first(tmp_path, ("a", "b")) == tmp_path / "b"
    (tmp_path / "a").touch()
    assert _first(tmp_path, ("a", "b")) == tmp_path / "a"


@pytest.mark.parametrize(("words", "message"), [
    ("-o hills.asc", "hills.asc: this is an input"), ("-o no/map.csv", "the folder no does not exist"),
    ("--picture towers.png", "towers.png: this is an input"), ("-o .", ".: is a folder"),
])  # fmt: skip
def test_what_cannot_be_written_is_refused_first(
    words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    """Whatever option names the file that would be lost."""
    monkeypatch.chdir(tmp_path)
    for name in ("hills.asc", "towers.png"):
        (tmp_path / name).write_text("mine")
    assert message in command.refuses("sites towers.png --area 1,2,3,4 --terrain hills.asc", words)


class Server:
    """In place of the one that answers browsers: it ends at once."""

    def __init__(self, make_app: Callable[..., object], port: int, *, fallback: bool) -> None:
        self.address = "http://127.0.0.1:8347/#" + 60 * "t"

    def run(self) -> None: ...


class TestMark:
    @pytest.fixture
    def folder(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr("kcal.web.serving.LocalServer", Server)
        lens = Camera.build(focal=(60, 60), center=(31, 24), size=(64, 48), model="pinhole")
        for name in ("l", "r"):
            write_png(tmp_path / f"{name}.png", np.arange(48 * 64).reshape(48, 64).astype(np.uint8))
            save_camera(lens, tmp_path / f"{name}.json")
        save_rig(Rig.pair(lens, lens, torch.eye(3), torch.tensor([-1.0, 0.0, 0.0])), tmp_path / "rig.json")
        (tmp_path / "old.csv").write_text("name,left_u,left_v,right_u,right_v\np,30,20,29,20\n")
        return tmp_path

    def marking(self, *options: str) -> Result:
        return ran(*["mark", "l.png", "r.png", "-o", "marks.csv", "--no-browser", *options], env={"COLUMNS": "40"})

    @pytest.mark.usefixtures("folder")
    @pytest.mark.parametrize("port", ["70000", "-1", "x"])
    def test_a_port_that_cannot_be_is_wrong_usage(self, port: str) -> None:
        found = self.marking("--port", port)
        assert found.exit_code == 2
        assert "0 to 65535" in " ".join(found.output.replace("│", " ").split())

    @pytest.mark.usefixtures("folder")
    def test_what_goes_together(self) -> None:
        """A rig or its cameras, not both; old marks with the images that they are in."""
        cameras, rig = ["--cameras", "l.json", "r.json"], ["--rig", "rig.json"]
        assert "not both: a rig file contains its cameras" in str(self.marking(*cameras, *rig).exception)
        old, images = ["--reference", "old.csv"], ["--reference-images", "l.png", "r.png"]
        for options in (old, images):
            assert "belong together" in str(self.marking(*options).exception)
        for options in ([], cameras, rig, [*rig, *old, *images]):
            done = self.marking(*options)
            assert done.exit_code == 0, done.output
            assert f"marking page: {Server(app, 0, fallback=True).address}\n" in done.output


class TestSources:
    @pytest.mark.parametrize("landmarks", [False, True])
    def test_stars_know_whether_landmarks_place_the_cameras(
        self, landmarks: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        told: list[tuple[list[str], bool]] = []

        def stars(read: RigReading, _: object) -> None:
            told.append((list(read.cameras), read.placed))
            read.notes.append("a note of the stars")

        monkeypatch.setitem(READERS, "stars", stars)
        survey, marks = tmp_path / "survey.csv", tmp_path / "marks.csv"
        survey.write_text("name,east,north,up,sigma\n" + "".join(f"p{k},{k},{100 + k},2,0.02\n" for k in range(3)))
        marks.write_text("name,left_u,left_v,right_u,right_v\n" + "".join(f"p{k},{k},1,2,3\n" for k in range(3)))
        given = Sources(stars=["l", "r"])
        if landmarks:
            given = dataclasses.replace(given, landmarks=survey, marks=marks)
        found = read_sources(CAMERAS, given)
        assert told == [(["left", "right"], landmarks)]
        assert found.notes == ["a note of the stars"]
        assert (found.data.landmarks is not None) is landmarks

    def test_names_of_places(self) -> None:
        """A file given several times is one camera at several places."""
        paths = [Path(f"{name}.camera.json") for name in ("mill", "mast", "mill")]
        assert camera_names(paths) == ("mill-1", "mast", "mill-2")
        alike = [Path("a/cam.json"), Path("b/cam.json")]
        assert camera_names(alike, told_apart=False) == ("cam", "cam")
        with pytest.raises(InputError, match="two cameras are named 'cam'"):
            camera_names(alike)
        mill = CAMERAS[0].with_parameters(CAMERAS[0].params)
        mill.calibration = CameraCalibration(name="mill")
        told = read_sources((mill, CAMERAS[1], mill), Sources(), camera_names(paths)).one_camera
        assert told == ["mill-1 and mill-2 are one camera that stood at 2 places: its lens is the same unknown"]

    def test_baselines(self) -> None:
        (one,) = parse_baselines(" 10.02+-0.005")
        assert (one.first, one.second, one.length, one.sigma) == (0, 1, 10.02, 0.005)
        names = ("mill", "mast", "church")
        found = parse_baselines("church:mill=812.4±0.02, mill:mast=30±1", names)
        assert [(b.first, b.second, b.length, b.sigma) for b in found] == [(2, 0, 812.4, 0.02), (0, 1, 30.0, 1.0)]
        for text, message in (("10", "LENGTH±SIGMA in meters"), ("mill:tree=3±1", "the names being mill, mast, church"),
                              ("mill=3±1", "FIRST:SECOND=LENGTH"), ("3±1", "of 3 cameras")):  # fmt: skip
            with pytest.raises(InputError, match=message):
                parse_baselines(text, names)


@pytest.mark.parametrize("moved", [(), ("the left camera has moved by some 0.3 m",)])
def test_a_rig_whose_camera_moved_is_not_as_it_was(
    moved: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Command
) -> None:
    """Even where no turn is beyond chance; and turns do not correct it."""
    monkeypatch.chdir(tmp_path)
    save_rig(Rig.pair(*CAMERAS, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0])), tmp_path / "rig.json")
    rows = [f"p{k},{100 * k},{k * k % 7 * 150},{100 * k - 8},{k * k % 7 * 150}" for k in range(1, 19)]
    Path("marks.csv").write_text("\n".join(["name,left_u,left_v,right_u,right_v", *rows]) + "\n")
    check = kcal.rig.check_rig
    monkeypatch.setattr("kcal.rig.check_rig", lambda *a, **k: dataclasses.replace(check(*a, **k), moved=moved))
    words = "rig check rig.json --reference marks.csv --marks marks.csv --pixel-sigma 0.1"
    said = command(words, code=3 if moved else 0)
    assert ("no change of the relative attitude" in said.out) is not bool(moved)
    assert ("warning: the left camera has moved by some 0.3 m: its turn is wrong" in said.err) is bool(moved)
    said = command(words, "--relock new.json", code=1 if moved else 0)
    assert ("turns alone do not correct the rig" in said.err) is bool(moved)
    assert not Path("new.json").exists()


class TestTold:
    @pytest.mark.parametrize("count", [12, 13])
    def test_a_list_longer_than_a_screen_goes_into_a_file(
        self, count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ) -> None:
        monkeypatch.setenv("COLUMNS", "500")
        lines = [f"failed {k}.png: no board in {k} px" for k in range(count - 1)] + ["failed x.png: unreadable"]
        print_left_out(lines, tmp_path / "left.obs.json", "images failed")
        shown, path = capsys.readouterr().out, tmp_path / "left.left-out.txt"
        if count == 12:
            assert not path.exists()
            assert shown.splitlines() == [f"  {line}" for line in lines]
        else:
            assert path.read_text().splitlines() == lines
            assert shown.startswith(f"images failed, 12 of them: no board in 0 px; all of them: {path}")

    def test_files_of_each_camera(self, tmp_path: Path) -> None:
        found = [[path.name for path in _of_each_camera(tmp_path / "a.obs.json", count)] for count in (2, 3)]
        assert found == [["a_left.obs.json", "a_right.obs.json"], [f"a_{k}.obs.json" for k in (1, 2, 3)]]

    def test_the_demo_says_how_to_locate_again(self, tmp_path: Path) -> None:
        for name, kind in (("rig", "json"), ("points", "csv")):
            shutil.copy(ROOT / "assets" / f"sample-{name}.{kind}", tmp_path / f"{name}.{kind}")
        words = shlex.split(locate_again(tmp_path, "--pixel-sigma", 0.4))
        made = {path.name for path in tmp_path.iterdir()} - {"rig.json", "points.csv"}
        assert made == {"points.geojson", "positions.csv", "map.png", "map.html"}
        assert words[:2] == ["kcal", "locate"]
        assert [*words[4:6], words[-1]] == ["--pixel-sigma", "0.4", "again.geojson"]
        (again,) = [tmp_path / words[-1]]
        invoked(*words[1:-1], again)
        assert (
            json.loads(again.read_text())["features"]
            == json.loads((tmp_path / "points.geojson").read_text())["features"]
        )

    def test_a_group_has_a_command_that_needs_no_name(self, command: Command) -> None:
        for words in ("board", "board print", "board measure"):
            name = words.partition(" ")[2] or "print"
            assert f"kcal board {name} [OPTIONS]" in command(f"{words} --help").out
        for words in ("board", "board nowhere"):
            assert "kcal board print [OPTIONS]" in command(words, code=2).err

    def test_a_camera_is_named_where_there_are_several(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.chdir(tmp_path)
        for name in ("left", "right"):
            observe(corner_pixels(8, 3, noise=0.05)).save(tmp_path / f"{name}.obs.json")
        assert "left" not in invoked("calibrate", "left.obs.json", "-o", "a.json", "--model", "pinhole").splitlines()
        both = invoked("calibrate", "left.obs.json", "right.obs.json", "-o", ".", "--model", "pinhole").splitlines()
        assert "left" in both
        assert "right" in both
