"""Ctrl-C in commands of sites: stars, capture, marking, stations, rigs by the scene or by stars."""

import json
from pathlib import Path

import pytest
import torch
from capture_frames import images
from interrupted import interrupt
from scene_pairs import pair, small_rig

from kcal import Camera, Rig, save_camera, save_rig
from kcal.cli.demo_practice import practice_site
from kcal.io.images import write_png

pytestmark = pytest.mark.slow
pytest.importorskip("av", reason="the extra `video` is not installed")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small practice site with cameras and marks, frames of a board, and a scene with its cameras."""
    folder = tmp_path_factory.mktemp("sites") / "site"
    practice_site(folder, 1, views=2, frames=4, scale=0.25)
    near = Camera.build(focal=(400, 400), center=(239.5, 134.5), size=(480, 270), model="pinhole")
    other = Camera.build(focal=(401, 401), center=(239.5, 134.5), size=(480, 270), model="pinhole")
    for side, camera in (("left", near), ("right", other)):
        save_camera(camera, folder / f"{side}.camera.json")
        save_camera(getattr(small_rig(), side), folder / f"{side}-scene.camera.json")
        write_png(folder / f"{side}-scene.png", getattr(pair(1), side))
    save_rig(Rig.pair(near, near, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0])), folder / "planned.json")
    truth = json.loads((folder / ".truth" / "truth.json").read_text())
    marks = [f"{name},left,{u},{v}" for name, (u, v, *_) in truth["marks"].items() if name in truth["landmarks"]]
    (folder / "marks.csv").write_text("\n".join(["name,camera,u,v", *marks]) + "\n")
    (folder / "frames").mkdir()
    for i, image in enumerate(images()):
        write_png(folder / "frames" / f"{i}.png", image)
    return folder


@pytest.mark.parametrize(
    ("line", "moments"),
    [
        ("stars night --camera left.camera.json --picture named.png", ["step:2"]),
        ("stars night --picture named.png", ["step:1"]),
        ("rig left.camera.json right.camera.json --baseline 10±0.01 --stars LEFT RIGHT -o rig.json", ["step:1"]),
        ("rig left-scene.camera.json right-scene.camera.json --baseline 10±0.01 --scene left-scene.png right-scene.png "
         "-o rig.json", ["step:2", "write:1"]),
        ("station left.camera.json --landmarks survey.csv --marks marks.csv --pixel-sigma 5 -o mast.rig.json",
         ["step:1", "write:1"]),
        ("capture frames --board 6x5 --square 20mm -o seen.obs.json --no-page", ["write:2", "written:4"]),
        ("capture frames --board 6x5 --square 20mm -o seen.obs.json --port 0 --no-browser", ["written:4"]),
        ("mark site/left.png site/right.png --rig planned.json --landmarks survey.csv -o own.csv --port 0 "
         "--no-browser", ["write:1", "written:1"]),
        ("report planned.json -o planned.html --require 1km:5%", ["write:1"]),
    ],
)  # fmt: skip
def test_long_work(line: str, moments: list[str], site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # An empty cache, as on the first day: what is kept there is nothing that the user asked for.
    monkeypatch.setenv("KCAL_CACHE", str(tmp_path))
    nights = {side.upper(): next(site.glob(f"night/{side}-*.png")).relative_to(site) for side in ("left", "right")}
    line = " ".join(str(nights.get(word, word)) for word in line.split())
    for moment in moments:
        before = {path: path.read_bytes() for path in site.rglob("*") if path.is_file()}
        said = interrupt(site, moment, line)
        assert said.startswith("interrupted; "), said
        assert all(path.read_bytes() == content for path, content in before.items())
        new = [path for path in site.rglob("*") if path.is_file() and path not in before]
        kept = said.partition("kept: ")[2]
        # The log of marks is written line by line and never replaced.
        assert (not new) == (not kept) or [path.name for path in new] == ["own.log"]
        for path in new:
            path.unlink()


def test_a_capture_goes_on_where_it_was_interrupted(site: Path) -> None:
    from kcal.corners.observations import Observations

    line = "capture frames --board 6x5 --square 20mm -o again.obs.json --no-page"
    interrupt(site, "written:4", line)
    first = Observations.load(site / "again.obs.json")
    interrupt(site, "written:2", line)
    second = Observations.load(site / "again.obs.json")
    # Two files for each view.
    assert (len(first.views), len(second.views)) == (2, 3)
    assert second.views[:2] == first.views
