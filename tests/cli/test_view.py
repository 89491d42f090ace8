"""`kcal view`: the same scene from marks, from positions and from tracks, and what does not belong together."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import Command
from locate_rigs import real_rig, spread_points, tensor
from PIL import Image

from kcal import Origin, Rig, load_rig, save_camera, save_rig
from kcal.locate import enu_from_cam
from kcal.rig import Mounting

chunk = pytest.importorskip("rerun.chunk")
ORIGIN = Origin(lat=19.07, lon=72.87, height=14.0)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A rig on a mast, and marks of three targets at two times."""
    monkeypatch.chdir(tmp_path)
    rig = real_rig()
    save_rig(rig, "own.rig.json")
    rig.mounting = Mounting(origin=ORIGIN, heading_deg=35.0)
    save_rig(rig, "rig.json")
    save_camera(rig.left, "left.camera.json")
    lines = ["name,left_u,left_v,right_u,right_v,time"]
    for i, pair in enumerate(rig(spread_points(tensor(100.0, 900.0, 4000.0)))[0].flatten(1).tolist()):
        lines.append(f"target {i},{','.join(map(repr, pair))},{1767225600 + i // 2}")
    Path("points.csv").write_text("\n".join(lines) + "\n")


def centers(path: str) -> list[list[float]]:
    rows = [
        rows
        for part in chunk.RrdReader(path).stream()
        if part.entity_path == "/targets/ellipsoids" and "Ellipsoids3D:centers" in part.to_record_batch().schema.names
        for rows in part.to_record_batch()["Ellipsoids3D:centers"].to_pylist()
    ]
    return [place for row in rows for place in row]


def entities(path: str) -> set[str]:
    return {part.entity_path for part in chunk.RrdReader(path).stream()}


def test_marks_and_the_positions_of_them_are_one_scene(command: Command) -> None:
    said = command("view rig.json points.csv -o marks.rrd")
    assert "points.csv: 3 rows: 3 ok" in said.out
    assert "wrote marks.rrd" in said.out
    command("locate rig.json points.csv -o positions.csv")
    command("view rig.json positions.csv -o positions.rrd")
    assert centers("marks.rrd") == centers("positions.rrd")
    assert np.linalg.norm(centers("marks.rrd")[2]) == pytest.approx(4000.0, rel=0.02)


def test_lines_of_a_detector_are_located_at_their_times(command: Command) -> None:
    """As marks with the same noise: the last one too, that has no end of line, and a category with a line separator."""
    rows = [row.split(",") for row in Path("points.csv").read_text().splitlines()[1:]]
    lines = [
        f'{{"time": {time}, "categories": ["a\u2028b"], "sigma": 0.3, '
        f'"left": [[{", ".join(numbers[:2])}]], "right": [[{", ".join(numbers[2:])}]]}}'
        for _, *numbers, time in rows
    ]
    Path("lines.jsonl").write_text("\n\n".join(lines), encoding="utf-8")
    assert "lines.jsonl: 3 rows: 3 ok" in command("view rig.json lines.jsonl --pixel-sigma 0.3 -o lines.rrd").out
    command("view rig.json points.csv --pixel-sigma 0.3 -o marks.rrd")
    assert np.abs(np.array(centers("lines.rrd")) - np.array(centers("marks.rrd"))).max() < 1e-3
    assert "/targets/at\\ all\\ times" in entities("lines.rrd")
    Path("boxes.jsonl").write_text(
        '{"left": {"time": 1.0, "boxes": [[500, 500, 510, 510]]}, "right": {"time": 1.0, "boxes": []}}\n{"left": 1}\n'
    )
    assert "boxes.jsonl: line 2: " in command("view rig.json boxes.jsonl -o no.rrd", code=1).err
    Path("boxes.jsonl").write_text(Path("boxes.jsonl").read_text().splitlines()[0])
    assert (
        "boxes.jsonl: nothing was seen by the cameras in 1 lines"
        in command("view rig.json boxes.jsonl -o no.rrd", code=1).err
    )


def test_of_a_rig_that_stands_nowhere_in_its_own_frame(command: Command) -> None:
    command("locate own.rig.json points.csv -o own.csv")
    command("view own.rig.json own.csv -o own.rrd")
    there = np.array(centers("own.rrd"))
    assert np.abs(there - spread_points(tensor(100.0, 900.0, 4000.0)).numpy()).max() < 1.0
    command("view own.rig.json points.csv --site 19.07,72.87,14 --heading 35 -o sited.rrd")
    # The same places, turned: x is south of east, z is north.
    assert np.linalg.norm(centers("sited.rrd"), axis=-1) == pytest.approx(np.linalg.norm(there, axis=-1), rel=1e-3)
    assert entities("sited.rrd") >= {"/targets/ellipsoids", "/targets/intervals", "/targets/at\\ all\\ times"}


def test_stations_landmarks_and_images(command: Command) -> None:
    look = torch.stack([enu_from_cam(heading).T for heading in (0.0, 315.0)])
    places = tensor([0.0, 0, 30], [5000.0, 0, 40])
    rig = Rig([real_rig().left, real_rig().right], ["mill", "church"], look, center=places, origin=ORIGIN)
    rig.root = rig.with_errors(attitude_deg=0.01)
    save_rig(rig, "stations.json")
    target = tensor([100.0, 5000.0, 100.0])
    rows = [f"ship,{name},{u!r},{v!r}" for name, (u, v) in zip(rig.names, rig(target)[0][0].tolist(), strict=True)]
    Path("sightings.csv").write_text("\n".join(["name,camera,u,v", *rows]) + "\n")
    Path("survey.csv").write_text("name,east,north,up,sigma\nspire,100,3000,50,0.1\n")
    for name in rig.names:
        Image.fromarray(np.random.default_rng(0).integers(0, 255, (1080, 1920), np.uint8)).save(f"{name}.png")
    command("view stations.json sightings.csv survey.csv mill.png church.png -o a.rrd")
    assert {"/landmarks", "/targets", "/cameras/mill/image", "/cameras/church/image"} <= entities("a.rrd")
    command("locate stations.json sightings.csv -o positions.csv")
    command("view stations.json positions.csv -o b.rrd")
    assert centers("b.rrd") == centers("a.rrd")
    assert centers("a.rrd")[0] == pytest.approx(target[0].tolist(), abs=1.0)
    command("view stations.json --site 19.07,72.87,14 --heading 35 -o c.rrd", code=2)
    Path("positions.csv").write_text(Path("positions.csv").read_text().replace("mill church", "mast church"))
    assert "this one has no camera 'mast'" in command.refuses("view stations.json positions.csv -o c.rrd")


def test_one_camera(command: Command) -> None:
    command("view left.camera.json -o a.rrd")
    assert {"/cameras/left", "/cameras/left/field\\ of\\ view"} <= entities("a.rrd")
    command("view rig.json:right -o b.rrd")
    assert "/cameras/right" in entities("b.rrd")


def test_what_does_not_belong_together(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    command("locate rig.json points.csv -o positions.csv")
    command("locate own.rig.json points.csv -o own.csv")
    assert "of another rig" in command.refuses("view own.rig.json positions.csv -o a.rrd")
    assert "of another rig" in command.refuses("view rig.json own.csv -o a.rrd")
    rig = load_rig("rig.json")
    rig.mounting = Mounting(origin=Origin(lat=19.08, lon=72.87, height=14.0), heading_deg=35.0)
    save_rig(rig, "other.json")
    assert "this one counts from Origin(lat=19.08" in command.refuses("view other.json positions.csv -o a.rrd")
    Path("table.csv").write_text("a,b\n1,2\n")
    assert "table.csv" in command.refuses("view rig.json table.csv -o a.rrd")
    Path("broken.csv").write_text(Path("positions.csv").read_text().replace(",ok,", ",fine,"))
    assert "'fine' is none of kcal" in command.refuses("view rig.json broken.csv -o a.rrd")
    assert "a recording of rerun ends in .rrd" in command.refuses("view rig.json -o a.html")
    command("view rig.json", code=2)
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert "pip install 'kcal[view]'" in command.refuses("view rig.json -o a.rrd")


def test_the_viewer_is_opened_without_statistics(command: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[tuple[list[str], dict[str, str]]] = []
    monkeypatch.setattr(subprocess, "Popen", lambda words, env, **rest: started.append((words, env)))
    command("view rig.json -o a.rrd --open")
    ((words, env),) = started
    assert words[1:] == ["-m", "rerun_cli", "--bind", "127.0.0.1", "a.rrd"]
    # The viewer records what is done in it unless this is set.
    assert env["CI"] == "1"
