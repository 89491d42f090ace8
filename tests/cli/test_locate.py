import json
from pathlib import Path

import pytest
import torch
from command_line import Command, rows_of

from kcal import Camera, load_rig, save_rig
from kcal.io.camera_file import provenance, save_camera
from kcal.lens.calibration import RigCalibration
from kcal.lens.rig import REFRACTION, REFRACTION_SIGMA, Rig

HEADER = "name,left_u,left_v,right_u,right_v\n"
ORIGIN = "-33.9,151.2,10"
POINTS = f"rig.json points.csv --site {ORIGIN}"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    camera = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), model="pinhole")
    save_rig(Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0])), tmp_path / "rig.json")
    save_camera(camera, tmp_path / "mast.camera.json")
    (tmp_path / "long.csv").write_text("name,camera,u,v\ncorner,mast,113,360\n")
    (tmp_path / "points.csv").write_text(HEADER + "[b]mast,975.5,539.5,959.5,539.5\nlost,-40,5,1,5\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "60")
    return tmp_path


@pytest.mark.parametrize("origin", [f"--site {ORIGIN}", f"--site={ORIGIN}"])
def test_writes_files_and_a_table(folder: Path, command: Command, origin: str) -> None:
    outputs = "-o out.geojson -o out.csv --picture map.png"
    printed = command("locate rig.json points.csv", origin, "--heading -90", outputs).out
    line = next(line for line in printed.splitlines() if line.startswith("[b]mast"))
    # 1 km west (0.0108116 degrees) and 10 m north (9.0e-5); a straight line west bends 5 cm north of the parallel.
    assert line.split()[1:5] == ["-33.8999094", "151.1891884", "10.07", "1000"]
    assert "lost: a mark lies outside its image" in printed
    assert "errors in calibration and mounting are not included" in printed
    features = json.loads((folder / "out.geojson").read_text())["features"]
    assert [feature["properties"]["name"] for feature in features[2:]] == ["[b]mast", "lost", "[b]mast"]
    assert [row["status"] for row in rows_of("out.csv")] == ["ok", "outside_image"]
    assert (folder / "map.png").read_bytes().startswith(b"\x89PNG")


def test_a_rig_without_a_place_gives_meters_in_its_own_frame(folder: Path, command: Command) -> None:
    shown = command("locate rig.json points.csv -o out.csv").out
    row = next(line for line in shown.splitlines() if line.startswith("[b]mast")).split()
    assert [float(cell) for cell in row[1:5]] == pytest.approx([10.0, 0.0, 1000.0, 1000.0], abs=0.06)
    assert "no place on the Earth: positions are meters, x right," in " ".join(shown.split())
    mast, lost = rows_of("out.csv")
    assert mast["frame"] == "x right, y down, z forward of the left camera"
    assert [float(mast[name]) for name in ("x_m", "y_m", "z_m")] == pytest.approx([10.0, 0.0, 1000.0], abs=1e-6)
    assert float(mast["cov_zz_m2"]) > 100 * float(mast["cov_xx_m2"]) > 0
    assert float(mast["range_low_m"]) < 1000.0 < float(mast["range_high_m"])
    assert (lost["status"], lost["x_m"], lost["range_m"]) == ("outside_image", "", "")
    assert "lat" not in mast
    (folder / "true.csv").write_text("name,lat,lon,height,sigma\nmast,1,2,3,1\n")
    told = json.loads(command("locate rig.json points.csv --json").out)
    assert told["frame"] == mast["frame"]
    assert "mounting" not in told["interval"]
    for option in ("-o new.geojson", "-o new.kml", "-o - --format cot", "--map new.html", "--picture new.png",
                   "--truth true.csv"):  # fmt: skip
        failed = command("locate rig.json points.csv", option, code=1)
        assert "this rig has no place on the Earth" in failed.err
        assert "give the origin and the heading" in " ".join(failed.err.split())
    assert not list(folder.glob("new.*"))


def test_what_is_doubted_of_a_rig_travels_with_it(folder: Path, command: Command) -> None:
    rig, doubt = load_rig(folder / "rig.json"), "the [landmarks] lie nearly in one line"
    rig.calibration = RigCalibration(
        rms=0.1, rms_px=(0.1, 0.1), pairs=0, per_pair_rms={}, warnings=(doubt,),
        **provenance(),
    )  # fmt: skip
    save_rig(rig, folder / "rig.json")
    shown = command("locate", POINTS, "--heading 0 --json")
    assert f"warning: rig.json: {doubt}" in shown.err
    assert json.loads(shown.out)["warnings"] == [f"rig.json: {doubt}"]
    assert f"warning: {doubt}" in command("show rig.json").out


def test_options_for_errors_grids_and_formats(folder: Path, command: Command) -> None:
    arguments = "rig.json points.csv --site 19.07,72.87,14 --heading 0.0 -o out.csv"
    command("locate", arguments, "--pixel-sigma 0.1 --refraction 0")
    plain = rows_of("out.csv")[0]
    more = "--grid EPSG:32643 --yaw-sigma 0.05 --heading 0±0.1 --refraction 0.13"
    outputs = "-o out.kml -o out.cot"
    printed = command("locate", arguments, "--pixel-sigma 0.1", more, outputs).out
    row = rows_of("out.csv")[0]
    # Grid north of Mumbai's UTM zone is 0.70 degrees west of true north; the mark lies 0.57 degrees to the right.
    assert float(row["azimuth_deg"]) == pytest.approx(float(plain["azimuth_deg"]) - 0.6962 + 360, abs=1e-3)
    # 87 m for 0.05 degrees at 1 km.
    assert float(row["range_high_m"]) - 1000 > 5 * (float(plain["range_high_m"]) - 1000)
    assert float(row["up_m"]) < float(plain["up_m"])
    # The library's own defaults, which the command states for its help.
    command("locate", arguments)
    usual = (folder / "out.csv").read_text()
    defaults = f"--refraction {REFRACTION}±{REFRACTION_SIGMA}"
    command("locate", arguments, defaults)
    assert (folder / "out.csv").read_text() == usual
    assert "noise in the marks and of the errors in calibration and mounting" in printed
    assert "geoid: " in printed
    assert (folder / "out.kml").read_text().startswith("<?xml")
    assert "<event " in (folder / "out.cot").read_text()


def test_nothing_located_is_a_failure_with_its_reasons(folder: Path, command: Command) -> None:
    (folder / "points.csv").write_text(HEADER + "lost,-40,5,1,5\n")
    printed = command("locate", POINTS, "--heading 0", code=1)
    assert "lost: a mark lies outside its image" in printed.out
    assert printed.err.splitlines()[-1].startswith("error: points.csv: none of the 1 pairs")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("rig.json points.csv --site 151.2,-33.9,10 --heading 0", "longitude came first"),
        (f"{POINTS} --heading nan", "heading nan"),
        (f"{POINTS} --heading 0 --pixel-sigma 0", "--pixel-sigma: a positive number"),
        (f"rig.json nothing.csv --site {ORIGIN} --heading 0", "nothing.csv: cannot read"),
        (
            f"points.csv points.csv --site {ORIGIN} --heading 0",
            "points.csv: this is a table of marks; a kcal rig file is needed",
        ),
        (
            "mast.camera.json long.csv",
            "To make one: kcal station mast.camera.json --landmarks survey.csv --marks marks.csv",
        ),
        ("mast.camera.json points.csv", "To make one: kcal rig mast.camera.json right.camera.json"),
        (f"{POINTS} --heading 0 -o a.shp", "a.shp: unknown format"),
        (f"{POINTS} --heading 0 -o no/a.csv", "does not exist"),
        (f"{POINTS} --heading 0 --picture a.gif", "end with .png"),
    ],
)
def test_refusals_are_one_line_and_write_nothing(folder: Path, command: Command, arguments: str, message: str) -> None:
    assert message in command.refuses("locate", arguments)
