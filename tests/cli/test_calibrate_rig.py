"""`kcal calibrate` and `kcal rig` on simulated observations: what they write, and how they refuse."""

import json
import math
import os
import re
import shutil
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from command_line import Command, invoked, ran
from torch import Tensor

from kcal import Board, Camera, DegenerateError, Observations, Rig, View
from kcal.io.camera_file import CameraFile, camera_to_file
from kcal.io.rig_file import RigFile
from kcal.lens.pose import rotation_from_vector
from kcal.texts import number_text

BOARD = Board(columns=7, rows=6, square=0.05)
SIZE = (640, 480)
LEFT = Camera.build(focal=(500, 505), center=(325, 235), size=SIZE, coefficients=[-0.2, 0.05])
RIGHT = Camera.build(focal=(560, 555), center=(310, 250), size=SIZE, coefficients=[-0.15, 0.03])
TURN = rotation_from_vector(torch.tensor([0.02, 0.1, 0.01], dtype=torch.float64))
RIG = Rig.pair(LEFT, RIGHT, TURN, torch.tensor([-0.12, 0.005, 0.01], dtype=torch.float64))


def observations(side: int, count: int, noise: float = 0.1) -> Observations:
    """Boards tilted by half a radian about axes all round, seen by one camera."""
    generator = torch.Generator().manual_seed(7 + side)
    middle = BOARD.points.mean(0)
    views = []
    for i in range(count):
        angle = 2.0 * math.pi * i / max(count, 5)
        tilt = torch.tensor([0.5 * math.cos(angle), 0.5 * math.sin(angle), 0.1 * i], dtype=torch.float64)
        rotation = rotation_from_vector(tilt)
        center = torch.tensor([0.05 * math.cos(2 * angle), 0.06 * math.sin(3 * angle), 0.75], dtype=torch.float64)
        points = (BOARD.points - middle) @ rotation.T + center
        pixels: Tensor = RIG(points)[0][:, side]
        pixels = pixels + noise * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
        views.append(View(name=f"{('left', 'right')[side]}{i:02}.png", pixels=tuple(map(tuple, pixels.tolist()))))
    return Observations(board=BOARD, image_size=SIZE, views=tuple(views))


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the observations and both cameras; tests work in copies."""
    made = tmp_path_factory.mktemp("calibrated")
    for side, word in enumerate(("left", "right")):
        observations(side, 6).save(made / f"{word}.obs.json")
        invoked(*["calibrate", str(made / f"{word}.obs.json"), "-o", str(made / f"{word}.camera.json")])
    return made


@pytest.fixture
def folder(calibrated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shutil.copytree(calibrated, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


PAIRS = "--pairs left.obs.json right.obs.json"


class TestCalibrate:
    @pytest.mark.slow
    def test_writes_a_camera_file(self, folder: Path, command: Command) -> None:
        arguments = "left.obs.json -o new.camera.json --model opencv4 --name mast --picture left.png"
        printed = command("calibrate", arguments)
        assert "6 views, 252 corners, 640x480 px, model opencv4" in printed.out
        assert "wrote new.camera.json" in printed.out
        assert "wrote left.png" in printed.out
        assert printed.err == ""
        file = CameraFile.load(folder / "new.camera.json")
        assert file.name == "mast"
        assert file.calibration is not None
        assert file.calibration.views == 6
        assert file.calibration.points == 252
        assert sorted(file.calibration.per_view_rms) == [f"left{i:02}.png" for i in range(6)]
        assert f"RMS {file.calibration.rms:.4f} px" in printed.out
        found = file.camera()
        # Six views at 0.1 px: some tenths of a percent; the table shows what the file holds.
        assert float(found.focal[0]) == pytest.approx(500, rel=0.01)
        row = next(line.split() for line in printed.out.splitlines() if line.startswith("fx "))
        assert file.standard_deviations is not None
        assert row[1] == number_text(float(found.focal[0]), file.standard_deviations["fx"])
        assert (folder / "left.png").read_bytes().startswith(b"\x89PNG")

    @pytest.mark.slow
    def test_outliers_are_left_out_and_listed(self, folder: Path, command: Command) -> None:
        content = json.loads((folder / "left.obs.json").read_text())
        u, v = content["views"][2]["pixels"][5]
        content["views"][2]["pixels"][5] = [u + 12.0, v]
        (folder / "one.obs.json").write_text(json.dumps(content))
        printed = command("calibrate one.obs.json -o one.json --reject")
        assert "6 views, 251 corners" in printed.out
        assert "left out: 0.40 % of the corners" in printed.out
        assert "left02.png corner 5: " in printed.out
        calibration = CameraFile.load(folder / "one.json").calibration
        assert calibration is not None
        assert [entry.name for entry in calibration.excluded] == ["left02.png corner 5"]
        assert calibration.points == 251
        assert "corner 5 of view left02.png" in command("calibrate one.obs.json -o one.json").err

    def test_a_known_camera_and_a_weak_prior(self, folder: Path, command: Command) -> None:
        command("calibrate left.obs.json -o left.json --weak-prior 0.3")
        first = CameraFile.load(folder / "left.json")
        matrix = first.covariance_matrix()
        assert first.standard_deviations is not None
        assert matrix is not None
        assert float(matrix[0, 0]) ** 0.5 == pytest.approx(first.standard_deviations["fx"])
        assert "fixed" in command("calibrate left.obs.json -o again.json --camera left.json").out
        again = CameraFile.load(folder / "again.json")
        assert again.camera().fingerprint == first.camera().fingerprint
        assert again.information is None
        both = "--camera left.json --fix cx"
        assert "known camera" in command.refuses("calibrate left.obs.json -o a.json", both)

    def test_parameters_by_name(self, folder: Path, command: Command) -> None:
        arguments = "calibrate left.obs.json -o named.json --model opencv5 --fov 65 --fix cx=321 --fix k3"
        arguments += " --tie fx=fy --prior cy=240+-1 --free skew"
        rows = {words[0]: words[1:] for words in map(str.split, command(arguments).out.splitlines()) if words}
        assert rows["cx"] == ["321.000", "fixed"]
        assert rows["k3"] == ["0", "fixed"]
        assert rows["fx"] == rows["fy"]
        # The constraints are wrong, so that the views tell less than the prior, whose width is printed.
        assert 0 < float(rows["cy"][1]) <= 1
        assert float(rows["skew"][1]) > 0

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ("--fix cz", "unknown parameter 'cz'"),
            ("--fix k4", "opencv5 has no parameter 'k4'"),
            ("--fix cx=a", "--fix cx 'a': write NAME or NAME=NUMBER"),
            ("--fix cx --fix cx=3", "cx is stated twice"),
            ("--prior cx=3", "NAME=VALUE±SIGMA"),
            ("--prior cx=3±0", "positive standard deviation"),
            ("--fix cx --prior cx=3±1", "fixed and given a prior"),
            ("--tie fx", "two parameters"),
        ],
    )
    def test_names_that_do_not_fit(self, folder: Path, command: Command, arguments: str, message: str) -> None:
        assert message in command.refuses("calibrate left.obs.json -o a.json --model opencv5", arguments)

    def test_board_warp_and_a_warning(self, folder: Path, command: Command) -> None:
        content = json.loads((folder / "left.obs.json").read_text())
        for i, pixel in enumerate(content["views"][2]["pixels"]):
            content["views"][2]["pixels"][i] = [pixel[0] + 4 * (i % 2), pixel[1] - 3 * (i % 3)]
        (folder / "bad.obs.json").write_text(json.dumps(content))
        printed = command("calibrate bad.obs.json -o bad.json --model opencv5 --board-warp")
        assert "mm along its rows" in printed.out
        assert "warning: view left02.png: RMS" in printed.err
        assert CameraFile.load(folder / "bad.json").name == "bad"

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            ("none.obs.json -o a.json", "none.obs.json: cannot read: No such file"),
            ("left.obs.json -o no/a.json", "the folder no does not exist; make it first"),
            ("left.obs.json -o .", "is a folder; give a file name"),
            ("left.obs.json -o a.json --model opencv6", "unknown lens model 'opencv6'; choose one of"),
            ("left.obs.json -o a.json --picture a.jpg", "end with .png"),
            ("left.obs.json -o a.json --picture no/a.png", "the folder no does not exist"),
        ],
    )
    def test_refusals(self, folder: Path, command: Command, arguments: str, message: str) -> None:
        assert message in command.refuses("calibrate", arguments)

    @pytest.mark.parametrize(
        ("content", "message"),
        [
            ("", "this is an empty file; a kcal observations file is needed here"),
            ("[1, 2]", "this is not a kcal file, but other JSON; a kcal observations file is needed here"),
            ('{"kcal": "camera", "version": 1}', "a kcal camera file; a kcal observations file is needed here"),
            ('{"kcal": "observations", "version": 9}', "version 9 of the observations format"),
            ('{"kcal": "observations", "version": 1}', "bad observations file: board: "),
        ],
    )
    def test_files_that_are_something_else(self, folder: Path, command: Command, content: str, message: str) -> None:
        (folder / "odd.json").write_text(content)
        text = command.refuses("calibrate odd.json -o a.json")
        assert text.startswith("error: odd.json: ")
        assert message in text

    def test_an_old_file_survives_a_failure(self, folder: Path, command: Command) -> None:
        (folder / "old.json").write_text("precious")
        observations(0, 2).save(folder / "few.obs.json")
        command.refuses("calibrate few.obs.json -o old.json")

    @pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="the superuser may write anywhere")
    def test_no_permission_is_told_before_any_work(self, folder: Path, command: Command) -> None:
        (folder / "shut").mkdir(mode=0o500)
        assert "no permission to write here" in command.refuses("calibrate left.obs.json -o shut/a.json")

    def test_output_is_checked_before_any_work(self, folder: Path, command: Command) -> None:
        """No minute is spent on what cannot be written; a rig's output is checked even before its inputs are read."""
        assert "make it first" in command.refuses("rig none.json none.json", PAIRS, "-o no/a.json")


class TestRig:
    @pytest.mark.slow
    def test_writes_a_rig_file(self, folder: Path, command: Command) -> None:
        printed = command("rig left.camera.json right.camera.json", PAIRS, "-o rig.json")
        assert "6 of 6 pairs used, 0 views without partner" in printed.out
        assert "wrote rig.json" in printed.out
        assert printed.err == ""
        file = RigFile.load(folder / "rig.json")
        assert file.calibration is not None
        assert file.calibration.pairs == 6
        assert float(file.rig().baseline) == pytest.approx(float(RIG.baseline), rel=0.02)
        stated = float(re.search(r"baseline ([\d.]+) ± [\d.]+ mm", printed.out).group(1))  # type: ignore[union-attr]
        assert stated == pytest.approx(1e3 * float(file.rig().baseline), abs=0.1)
        assert "the board's are 50.00 mm" in printed.out
        side = float(next(line for line in printed.out.splitlines() if "triangulated" in line).split()[2])
        assert side == pytest.approx(50.0, rel=2e-3)
        # A picture changes nothing.
        drawn = command("rig left.camera.json right.camera.json", PAIRS, "-o drawn.json --picture rig.png")
        assert drawn.out.replace("drawn", "rig").replace("wrote rig.png\n", "") == printed.out
        assert drawn.err == ""
        assert RigFile.load(folder / "drawn.json").poses == file.poses

    @pytest.mark.slow
    def test_boards_in_the_joint_adjustment(self, folder: Path, command: Command) -> None:
        """With a measured baseline beside them, which agrees with what the boards say to a few of its sigmas."""
        content = json.loads((folder / "right.obs.json").read_text())
        content["views"][1]["pixels"].reverse()
        (folder / "right.obs.json").write_text(json.dumps(content))
        more = f"--baseline {float(RIG.baseline)}±0.0002 -o joint.json --picture rig.png"
        printed = command("rig left.camera.json right.camera.json", PAIRS, more)
        assert printed.out.startswith("source")
        assert "σ of range" in printed.out
        assert "taken as exact" not in printed.out
        assert "turned by 180°: left01.png right01.png (right; the board" in printed.out
        assert (folder / "rig.png").read_bytes().startswith(b"\x89PNG")
        file = RigFile.load(folder / "joint.json")
        assert file.calibration is not None
        assert (file.calibration.pairs, file.calibration.flipped) == (6, ("left01.png right01.png",))
        assert float(file.rig().baseline) == pytest.approx(float(RIG.baseline), abs=0.001)
        assert file.mounting is None
        assert file.rig().covariance is not None

    @pytest.mark.slow
    @pytest.mark.parametrize(("shift", "keep_all"), [(1.5, False), (40.0, True)])
    def test_a_board_that_moved_between_the_two_exposures(
        self, folder: Path, command: Command, shift: float, keep_all: bool
    ) -> None:
        content = json.loads((folder / "right.obs.json").read_text())
        for pixel in content["views"][4]["pixels"]:
            pixel[1] += shift
        (folder / "right.obs.json").write_text(json.dumps(content))
        words = "--keep-all" if keep_all else ""
        printed = command(f"rig left.camera.json right.camera.json {PAIRS} -o plain.json", words)
        plain = RigFile.load(folder / "plain.json")
        assert plain.calibration is not None
        assert plain.calibration.pairs == (6 if keep_all else 5)
        out = [] if keep_all else ["left04.png right04.png"]
        assert [entry.name for entry in plain.calibration.excluded] == out
        assert ("warning: board left04.png right04.png: " in printed.err) == keep_all
        assert ("left out: board left04.png right04.png: " in printed.err) != keep_all

    @pytest.mark.slow
    def test_a_failure_leaves_no_file(self, folder: Path, monkeypatch: pytest.MonkeyPatch, command: Command) -> None:
        fails = Mock(side_effect=DegenerateError("no side of a square could be triangulated"))
        monkeypatch.setattr("kcal.report.judge_rig.triangulated_sides", fails)
        arguments = f"rig left.camera.json right.camera.json {PAIRS} -o rig.json"
        assert "no side of a square" in command.refuses(arguments)

    @pytest.mark.slow
    def test_swapped_throughout(self, folder: Path, command: Command) -> None:
        """Cameras and observations agree; the right camera is on the left: their names may be wrong."""
        pairs = "--pairs right.obs.json left.obs.json"
        said = command("rig", *["right.camera.json", "left.camera.json"], pairs, "-o rig.json").err
        assert "to the left of the left camera: left and right are swapped" in said

    @pytest.mark.slow
    def test_pairs_from_a_csv(self, folder: Path, command: Command) -> None:
        (folder / "pairs.csv").write_text(
            "left,right\n" + "".join(f"left{i:02}.png,right{i:02}.png\n" for i in (1, 3, 4))
        )
        arguments = f"left.camera.json right.camera.json {PAIRS} -o rig.json --match pairs.csv"
        text = command.refuses("rig", arguments, "--intrinsics free")
        assert "hybrid" in text
        for side in ("left", "right"):
            plain = f"{side}.obs.json -o {side}.camera.json --model opencv5"
            command("calibrate", plain)
        printed = command("rig", arguments, "--intrinsics free --board-warp").out
        assert "3 of 3 pairs used, 6 views without partner" in printed
        assert "mm along its rows" in printed
        (folder / "pairs.csv").write_text("left,right\nleft01.png,right77.png\n")
        (folder / "rig.json").unlink()
        text = command.refuses("rig", arguments)
        assert "pairs.csv: line 2: no view of the right camera is named 'right77.png'" in text

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (f"left.obs.json right.camera.json {PAIRS}", "this is a kcal observations file; a kcal camera file"),
            (
                "left.camera.json right.camera.json --pairs left.obs.json right.camera.json",
                "this is a kcal camera file; a kcal observations file is needed here",
            ),
            (f"none.json right.camera.json {PAIRS}", "none.json: cannot read"),
            (f"right.camera.json left.camera.json {PAIRS}", "left and right are exchanged"),
            ("left.camera.json right.camera.json --pairs right.obs.json left.obs.json", "they are exchanged"),
            (f"left.camera.json right.camera.json {PAIRS} --match none.csv", "none.csv: cannot read"),
            (f"left.camera.json left.camera.json {PAIRS}", "or these are views of two cameras"),
            ("left.camera.json left.camera.json --pairs left.obs.json left.obs.json", "camera twice"),
            ("left.camera.json right.camera.json --pairs left.obs.json left.obs.json", "camera twice"),
        ],
    )
    def test_refusals(self, folder: Path, command: Command, arguments: str, message: str) -> None:
        assert message in command.refuses("rig", arguments, "-o rig.json")

    def test_views_that_cannot_be_paired(self, folder: Path, command: Command) -> None:
        content = json.loads((folder / "right.obs.json").read_text())
        for i, view in enumerate(content["views"]):
            view["name"] = "abcdef"[i]
        (folder / "right.obs.json").write_text(json.dumps(content))
        text = command.refuses("rig left.camera.json right.camera.json", PAIRS, "-o r.json")
        assert "give a CSV of pairs" in text


@pytest.mark.parametrize("arguments", [["calibrate"], ["calibrate", "a.json"], ["rig", "a.json", "b.json", "-o", "c"]])
def test_missing_arguments_are_a_usage_error(
    arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("a.json", "b.json"):
        if arguments[0] == "rig":
            camera = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480))
            camera_to_file(camera, name=name).save(Path(name))
        else:
            Path(name).write_text("{}")
    assert ran(*arguments).exit_code == 2
