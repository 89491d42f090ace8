"""From images to a camera and its report: the main job, its messages, and settings of the lens."""

import functools
import json
import math
import re
import shlex
import shutil
from pathlib import Path

import pytest
import torch
from calibrate_scenes import camera, corner_pixels, motions, observe, pixels_of
from command_line import Command, ran, rows_of

import kcal.sim.scene
from kcal import Board, Camera, DegenerateError, Observations, calibrate_camera
from kcal.cli.console import more_views
from kcal.io.camera_file import CameraFile, load_camera, save_camera
from kcal.io.rig_file import RigFile
from kcal.lens.calibration import CameraCalibration, LensSetting
from kcal.lens.uncertainty import paraxial_focal

# The main job from images to positions, through the command line as a user types it.


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, command: Command) -> Command:
    """`kcal` in an empty folder."""
    monkeypatch.chdir(tmp_path)
    return command


def assert_the_printed_command_gives_the_same(run: Command, text: str) -> None:
    """The command at the end of a demonstration writes the demonstration's positions, intervals included."""
    command = shlex.split(text.split("Locate again by hand:")[1])
    assert command[:2] == ["kcal", "locate"]
    run(*command[1:])
    again, first = (json.loads(Path(name).read_text()) for name in ("again.geojson", "out/points.geojson"))
    assert len(again["features"]) == len(first["features"]) > 0
    for one, other in zip(again["features"], first["features"], strict=True):
        assert one["properties"].keys() == other["properties"].keys()
        for key, value in other["properties"].items():
            # Where memory lies decides the order of sums, and with it the last digits.
            number = isinstance(value, float)
            assert one["properties"][key] == (pytest.approx(value, rel=1e-6) if number else value), key


class TestRealImages:
    @pytest.mark.slow
    def test_from_images_to_positions(self, run: Command, kcal_data: Path, tmp_path: Path) -> None:
        folder = kcal_data / "opencv_stereo"
        for side in ("left", "right"):
            text, error = run("detect", folder / f"{side}*.jpg", f"--board 9x6 --square 25mm -o {side}.obs.json")
            assert error == ""
            assert "board found in 13 of 13 images" in text
            _, error = run(f"calibrate {side}.obs.json -o {side}.camera.json --picture {side}.png")
            # These cameras, or their board, moved a little.
            assert error.count("warning:") == error.count("moved while rows were read")
            assert (tmp_path / f"{side}.png").stat().st_size > 10_000
        files = [CameraFile.load(f"{side}.camera.json") for side in ("left", "right")]
        # The peers' best refiner ends at 0.158 and 0.156 px, cornerSubPix at 0.195 and 0.207.
        assert [file.calibration.rms < 0.17 for file in files if file.calibration] == [True, True]
        pairs = "--pairs left.obs.json right.obs.json -o r.json --keep-all"
        text, error = run("rig left.camera.json right.camera.json", pairs)
        # One pair of this capture is four times as far off as the others, which motion while rows are read explains
        # since corners of the board have places of their own; at most two are named.
        assert error.count("warning") <= 2
        assert "13 of 13 pairs used" in text
        rig = RigFile.load("r.json")
        assert rig.calibration is not None
        # stereoCalibrate finds 3.345 squares of 25 mm with less accurate corners.
        assert math.isclose(float(rig.rig().baseline), 3.345 * 0.025, rel_tol=0.01)

        # The board's first and last corner of one pair, whose distance is known.
        left, right = (Observations.load(f"{side}.obs.json").views[0].pixels for side in ("left", "right"))
        lines = ["name,left_u,left_v,right_u,right_v"]
        for name, i in (("first", 0), ("last", 53)):
            lines.append(",".join([name, *map(repr, (*(left[i] or ()), *(right[i] or ())))]))
        Path("points.csv").write_text("\n".join(lines))
        outputs = "-o p.geojson -o p.csv --picture map.png"
        _, error = run("locate r.json points.csv --site -33.9,151.2,10 --heading 250", outputs)
        # What its solution warned of travels with the rig.
        *told, noise = error.splitlines()
        assert all(line.startswith(("warning: r.json: the boards differ", " ")) for line in told), error
        assert noise == "noise of marks: 0.3 px, assumed; --pixel-sigma states it"
        ends = [[float(row[f"{axis}_m"]) for axis in ("east", "north", "up")] for row in rows_of("p.csv")]
        assert math.isclose(math.dist(*ends), 0.025 * math.hypot(8, 5), rel_tol=5e-3)
        features = json.loads(Path("p.geojson").read_text())["features"]
        longitude, latitude, _ = features[0]["geometry"]["coordinates"]
        assert math.isclose(latitude, -33.9, abs_tol=1e-4)
        assert math.isclose(longitude, 151.2, abs_tol=1e-4)

    @pytest.mark.slow
    def test_demo_on_a_folder_of_pairs(self, run: Command, kcal_data: Path) -> None:
        Path("pairs").mkdir()
        for image in (kcal_data / "opencv_stereo").glob("*0[1-4].jpg"):
            shutil.copy(image, "pairs")
        text, error = run("demo --images pairs -o out")
        assert "no --site was given" in error
        assert "4 of 4 pairs" in text
        for name in ("map.png", "points.geojson", "positions.csv", "left.png", "right.png", "rig.json", "points.csv"):
            assert Path("out", name).stat().st_size > 100
        page = Path("out", "summary.html").read_text()
        assert page.count("data:image/png;base64,") == 3
        assert "left01" in page
        assert_the_printed_command_gives_the_same(run, text)


class TestDemo:
    @pytest.mark.slow
    def test_simulated_site(self, run: Command, monkeypatch: pytest.MonkeyPatch) -> None:
        # A third of the images, so that the test takes seconds.
        small = functools.partial(kcal.sim.scene.DemoScene, near_views=5)
        monkeypatch.setattr(kcal.sim.scene, "DemoScene", small)
        shown = run("demo -o out --seed 3").out
        assert "True against estimated positions" in shown
        assert "of 7 intervals. Of 7 intervals of 95 %, " in shown
        assert re.search(r"^(YES|NO)(, with \d+ doubts?)?: at 5 km the range is known to ", shown, re.MULTILINE)
        scene = small(seed=3)
        rows = {row["name"]: row for row in rows_of("out/positions.csv")}
        for name, true in zip(scene.targets.names, scene.targets.enu.tolist(), strict=True):
            distance = math.hypot(*true)
            estimate = float(rows[name]["range_m"])
            # Marks of 0.1 px leave 4.4 % at 5 km and less before; five sigma of that and of the few views.
            assert abs(estimate / distance - 1) < 0.004 + 0.22 * distance / 5000
        for name in ("map.png", "points.geojson", "left.png", "right.png", "rig.png"):
            assert Path("out", name).stat().st_size > 1000
        page = Path("out", "summary.html").read_text()
        assert page.count("data:image/png;base64,") == 4
        assert all(f"<td>{name}</td>" in page for name in scene.targets.names)
        # The rig file says where the rig stands: positions follow from it and the marks alone.
        assert_the_printed_command_gives_the_same(run, shown)

    def test_output_that_is_a_file(self, run: Command) -> None:
        Path("taken").write_text("mine")
        said = run.refuses("demo -o taken")
        assert "taken" in said
        assert "folder" in said


class TestCompare:
    @pytest.mark.slow
    def test_table_and_picture(self, run: Command) -> None:
        write(Path("a.obs.json"), 8, model="pinhole")
        command = "compare a.obs.json --model pinhole opencv4 --groups views --parts 2 -o m.csv --picture m.svg"
        shown, error = run(command)
        assert error == ""
        first, other = rows_of("m.csv")
        table = [line.split() for line in shown.splitlines()[1:4]]
        assert [row[0] for row in table] == ["model", first["model"], other["model"]]
        assert {first["model"], other["model"]} == {"pinhole", "opencv4"}
        assert [len(row) for row in table[1:]] == [2, 4]
        assert first["more_than_best_px"] == first["standard_error_px"] == ""
        more, error_px = float(other["more_than_best_px"]), float(other["standard_error_px"])
        assert float(other["held_out_rms_px"]) - float(first["held_out_rms_px"]) == pytest.approx(more, rel=1e-12)
        assert more > 0 < error_px
        shown_px = [float(value) for value in table[2][1:]]
        assert shown_px == pytest.approx([float(other["held_out_rms_px"]), more, error_px], abs=1e-4)
        # One run's numbers are the same for programs and in the table. (Two runs' last digits differ: where memory
        # lies decides the order of sums.)
        told = json.loads(run(command, "--json").out)["models"]
        rows = rows_of("m.csv")
        assert [(one["model"], one["held_out_rms_px"]) for one in told] == [
            (row["model"], float(row["held_out_rms_px"])) for row in rows
        ]
        assert told[0]["more_than_best_px"] is None
        assert told[1]["more_than_best_px"] == float(rows[1]["more_than_best_px"]) == pytest.approx(more, rel=1e-6)
        assert Path("m.svg").read_bytes().startswith(b"<?xml")

    @pytest.mark.parametrize(
        ("words", "said"),
        [
            ("--model opencv5 -o m.txt", "must end with .csv"), ("", "name the models"), ("", "--model"),
            ("--model opencv5 --groups days", "blocks or views"), ("--model opencv6", "unknown lens model 'opencv6'"),
            ("--model pinhole --parts 6", "5 groups"), ("--model pinhole --parts 6", "6 parts"),
        ],
    )  # fmt: skip
    def test_bad_input(self, run: Command, words: str, said: str) -> None:
        write(Path("a.obs.json"), 5)
        assert said in run.refuses("compare a.obs.json", words)


def test_output_over_an_input(run: Command) -> None:
    said = run.refuses("calibrate", write(Path("a.obs.json"), 5), "-o a.obs.json")
    assert "a.obs.json" in said
    assert "input" in said


@pytest.mark.parametrize("name", ["demo", "board", "detect", "calibrate", "rig", "locate"])
def test_help_has_examples(run: Command, name: str) -> None:
    text = run(name, "--help").out
    assert "Examples" in text
    assert f"kcal {name}" in text


# What `kcal calibrate` says to people: focal lengths on the axis, and errors that end with the command to run.


def write(path: Path, count: int, seed: int = 1, model: str = "opencv4") -> Path:
    observe(corner_pixels(count, seed, model, noise=0.1, seed=seed)).save(path)
    return path


def test_too_few_views_end_with_the_command_that_adds_some(tmp_path: Path) -> None:
    path = write(tmp_path / "my left.obs.json", 2)
    result = ran("calibrate", path, "-o", tmp_path / "left.camera.json")
    assert isinstance(result.exception, DegenerateError)
    text = str(result.exception)
    assert text.startswith("2 views of the board: at least 3")
    command = shlex.split(text.split("To add views: ")[1])
    assert command[:2] == ["kcal", "capture"]
    options = dict(zip(command[3::2], command[4::2], strict=True))
    assert options == {"--board": "7x6", "--square": "50mm", "-o": str(path)}
    assert not (tmp_path / "left.camera.json").exists()


def test_the_command_names_the_same_board() -> None:
    sizes = ["9x6", "charuco:9x6:5x5_100:15mm", "charuco:9x6:5x5_100:15mm:id3", "circles:7x6", "circles:7x6:10mm"]
    for size in (*sizes, "asymmetric:4x11", "aprilgrid:6x6:0.3", "aprilgrid:6x5:2mm:id7"):
        board = Board.parse(size, "24.23mm")
        words = shlex.split(more_views(board, Path("a.obs.json")))
        assert Board.parse(words[words.index("--board") + 1], words[words.index("--square") + 1]) == board


def test_one_of_several_cameras(tmp_path: Path) -> None:
    paths = [write(tmp_path / "a.obs.json", 8), write(tmp_path / "b.obs.json", 2)]
    result = ran("calibrate", *paths, "-o", tmp_path / "out")
    assert "1 of 2 cameras failed: b" in str(result.exception)
    cure = f"To add views: kcal capture camera:0 --board 7x6 --square 50mm -o {paths[1]}"
    assert cure in result.output.replace("\n", "")
    assert (tmp_path / "out" / "a.camera.json").exists()


@pytest.mark.slow
def test_focal_lengths_are_those_on_the_axis(tmp_path: Path) -> None:
    """Printed by calibrate, show and diff alike, and told to programs; fx of the file is another number."""
    path, file = write(tmp_path / "a.obs.json", 8), tmp_path / "a.camera.json"
    told = json.loads(ran("calibrate", path, "-o", file, "--json").stdout)
    saved = load_camera(file)
    found = paraxial_focal(saved)
    assert any(f"focal length {found}; principal point" in line for line in told["text"])
    assert abs(found.mean[0] - float(saved.focal[0])) > 0.1
    assert f"focal length {found}, on its axis; fx and fy below" in ran("show", file).output
    assert ran("diff", file, file).output.count(f"focal length {found}") == 2
    numbers = told["cameras"]["a"]
    assert numbers["focal_px"] == pytest.approx(found.value.tolist())
    assert numbers["focal_sigma_px"] == pytest.approx(found.sigma.tolist(), rel=1e-6)


def test_parametric_lenses_show_their_parameter(tmp_path: Path) -> None:
    path, file = write(tmp_path / "a.obs.json", 8), tmp_path / "a.camera.json"
    ran("calibrate", path, "-o", file, "--model", "opencv4")
    fx, fy = load_camera(file).focal.tolist()
    text = ran("show", file).output
    match = re.search(r"focal length ([\d.]+) ± [\d.]+ px along rows, ([\d.]+) ± [\d.]+ px along columns\n", text)
    assert match is not None
    # Rounded to two digits of sigma.
    assert [float(value) for value in match.groups()] == pytest.approx([fx, fy], abs=1e-2)


def test_the_library_names_no_command() -> None:
    with pytest.raises(DegenerateError) as caught:
        calibrate_camera(observe(torch.zeros(2, 42, 2).double() + torch.rand(2, 42, 2).double() * 100))
    assert "kcal capture" not in str(caught.value)


# `kcal calibrate --setting` and `kcal interpolate`.


def stored(folder: Path, focus: float) -> str:
    made = Camera.build(focal=(500 + focus**2,) * 2, center=(320, 240), size=(640, 480), model="pinhole")
    covariance = torch.diag(torch.tensor([1.0, 1, 1, 1, 0])).double()
    made.calibration = CameraCalibration(covariance=covariance, setting=LensSetting(values={"focus": focus}))
    return str(save_camera(made, folder / f"f{focus:g}.camera.json"))


def test_several_settings_in_one_call(tmp_path: Path, command: Command) -> None:
    truth = camera("opencv4")
    seen = [tmp_path / name for name in ("near.obs.json", "far.obs.json")]
    for i, path in enumerate(seen):
        observe(pixels_of(truth, motions(truth, 6, i + 1), noise=0.1, seed=i + 1)).save(path)
    words = ["calibrate", *map(str, seen), "-o", str(tmp_path / "out"), "--model", "opencv4"]
    command(*words, "--setting focus=1,2.5 --setting zoom=12")
    found = [load_camera(tmp_path / "out" / f"{name}.camera.json").calibration for name in ("near", "far")]
    values = [one and one.setting and one.setting.values for one in found]
    assert values == [{"focus": 1.0, "zoom": 12.0}, {"focus": 2.5, "zoom": 12.0}]
    assert "setting focus=2.5 zoom=12" in ran("show", tmp_path / "out/far.camera.json").output
    for option, message in (
        ("focus=1,2,3", "3 numbers for 2 cameras"),
        ("focus", "write NAME=NUMBER"),
        ("focus=a", "--setting focus 'a': write NAME=NUMBER"),
    ):
        assert message in str(ran(*words, "--setting", option).exception)
    assert "focus is stated twice" in str(ran(*words, "--setting", "focus=1", "--setting", "focus=2").exception)


def test_interpolate(tmp_path: Path, command: Command) -> None:
    paths = [stored(tmp_path, focus) for focus in (0.0, 1.0, 2.0, 3.0)]
    made = tmp_path / "now.camera.json"
    words = ["interpolate", *paths, "--setting", "focus=1.5", "-o", str(made)]
    done = command("interpolate", *paths, "--setting focus=1.5±0.1 -o", made)
    assert "focus=1.5, interpolated: points at infinity ± " in done.out
    assert all(f" by {part}" in done.out for part in ("calibrations", "interpolation", "setting"))
    known = load_camera(made).calibration
    assert known is not None
    assert known.setting is not None
    assert (known.name, known.setting.interpolated_from) == ("now", tuple(paths))
    assert f"setting focus=1.5, interpolated from {paths[0]}, " in ran("show", made).output
    told = json.loads(ran(*words, "--json").stdout)
    assert told["sigma_px"]["setting"] == 0.0 < told["sigma_px"]["interpolation"]
    assert sum(row["weight"] for row in told["cameras"]) == pytest.approx(1.0)
    same = ran("interpolate", *paths, "--setting", "focus=2", "-o", made)
    assert "focus=2, calibrated: points at infinity ± " in same.output
    assert load_camera(made).focal.tolist() == [504.0, 504.0]
    made.unlink()
    beyond = ran("interpolate", *paths, "--setting", "focus=3.5", "-o", made)
    assert "focus=3.5 is outside the calibrated focus of 0 to 3" in str(beyond.exception)
    for setting, message in (("focus=1,2", "--setting focus '1,2': write VALUE±SIGMA"), ("focus=1", "is stated twice")):
        assert message in str(ran(*words, "--setting", setting).exception)
    assert not made.exists()
