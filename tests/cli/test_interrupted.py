"""Ctrl-C: a command ends with one line and exit code 130, whatever it is doing, and leaves nothing torn behind."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from board_render import render
from calibrate_scenes import BOARD, camera, motions, observe, pixels_of
from interrupted import interrupt

from kcal import load_rig, save_camera
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera

SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"
POINTS = SAMPLE.with_name("sample-points.csv")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_camera(load_rig(SAMPLE).left, tmp_path / "left.camera.json")
    return tmp_path


@pytest.mark.parametrize("module", ["kcal.cli.main", "torch"])
def test_while_it_loads(module: str, folder: Path) -> None:
    said = interrupt(folder, f"import:{module}", "export left.camera.json -o left.yaml")
    assert said == "interrupted; nothing was written"


def test_a_file_that_came_into_place_is_named(folder: Path) -> None:
    line = f"locate {SAMPLE} {POINTS} -o a.csv -o b.geojson"
    said = interrupt(folder, "written:1", line)
    assert (folder / "b.geojson").exists() == ("b.geojson" in said)
    assert (folder / "a.csv").exists() == ("a.csv" in said)
    assert (folder / "a.csv").exists() != (folder / "b.geojson").exists()
    said = interrupt(folder, "written:1", "diff left.camera.json left.camera.json --picture d.png")
    assert said == "interrupted; written and kept: d.png"


def test_an_old_file_stays_until_the_new_one_is_whole(folder: Path) -> None:
    (folder / "left.yaml").write_text("old")
    assert interrupt(folder, "write:1", "export left.camera.json -o left.yaml") == "interrupted; nothing was written"
    assert (folder / "left.yaml").read_text() == "old"


def test_while_an_image_is_searched(folder: Path) -> None:
    """OpenCV's search goes on in a thread, from which Python's end would abort the process."""
    corners = np.array([[200, 150], [440, 160], [430, 330], [190, 320]], np.float32)
    flat = np.array([[0, 0], [6, 0], [6, 5], [0, 5]], np.float32)
    image, _ = render(BOARD, (640, 480), cv2.getPerspectiveTransform(flat, corners), supersample=3)
    cv2.imwrite(str(folder / "a.png"), image)
    line = "detect a.png --board 7x6 --square 50mm -o new.obs.json"
    assert interrupt(folder, "search:1", line) == "interrupted; nothing was written"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "moments"),
    [
        ("calibrate left.obs.json -o new.camera.json", ["step:2", "write:1"]),
        ("report near.camera.json --observations left.obs.json -o left.html", ["step:3"]),
        ("compare left.obs.json pinhole opencv5", ["step:2"]),
        ("board measure left.obs.json -o plate.board.json --picture plate.png", ["step:1", "write:2"]),
        ("detect images --board 7x6 --square 50mm -o new.obs.json --refine saddle", ["step:1", "write:1"]),
        ("rectify near.camera.json images -o straight", ["write:2"]),
        ("rig left.camera.json right.camera.json --landmarks survey.csv --marks marks.csv -o rig.json", ["step:4"]),
        ("bake left.camera.json -o table.npz", ["write:1"]),
        ("demo -o site", ["step:1", "write:2"]),
        ("batch cameras --board 7x6 --square 50mm -o results --workers 2", ["step:1"]),
    ],
)
def test_long_work(line: str, moments: list[str], site: Path) -> None:
    for moment in moments:
        written = {path: path.read_bytes() for path in site.rglob("*") if path.is_file()}
        said = interrupt(site, moment, line)
        assert said.startswith("interrupted; ")
        new = [path for path in site.rglob("*") if path.is_file() and path not in written]
        # One file for each that was to be written before that moment; of the work of others `batch` has a folder.
        assert len(new) <= int(moment[-1])
        assert all(path.read_bytes() == content for path, content in written.items())
        assert all(path.name in said for path in new if ".work" not in path.parts)
        for path in new:
            path.unlink()


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Observations and images of a camera, and a rig of others with marked landmarks."""
    folder = tmp_path_factory.mktemp("site")
    truth = camera("opencv5")
    seen = observe(pixels_of(truth, motions(truth, 10, 1), noise=0.05))
    seen.save(folder / "left.obs.json")
    calibrate_camera(seen, CalibrationOptions(model="opencv5")).save(folder / "near.camera.json", name="near")
    for place in ("images", "cameras/a", "cameras/b"):
        (folder / place).mkdir(parents=True)
        for i, view in enumerate(seen.pixels()[:3]):
            corners = view[[0, 6, 41, 35]].numpy().astype(np.float32)
            flat = np.array([[0, 0], [6, 0], [6, 5], [0, 5]], np.float32)
            image, _ = render(BOARD, (640, 480), cv2.getPerspectiveTransform(flat, corners), seed=i, supersample=3)
            cv2.imwrite(str(folder / place / f"{i}.png"), image)
    rig = load_rig(SAMPLE)
    save_camera(rig.left, folder / "left.camera.json")
    save_camera(rig.right, folder / "right.camera.json")
    places = torch.tensor([[x, 4.0 * (i % 3 - 1), 150.0 + 40 * i] for i, x in enumerate(range(-42, 48, 12))]).double()
    right = places @ rig.right_from_left_rotation.T + rig.right_from_left_translation
    marks = torch.cat([rig.left.project(places)[0], rig.right.project(right)[0]], 1)
    names = "abcdefgh"
    survey = [f"{n},{x},{z},{-y},0.02" for n, (x, y, z) in zip(names, places.tolist(), strict=True)]
    (folder / "survey.csv").write_text("\n".join(["name,east,north,up,sigma", *survey]))
    rows = [",".join([n, *map(str, row)]) for n, row in zip(names, marks.tolist(), strict=True)]
    (folder / "marks.csv").write_text("\n".join(["name,left_u,left_v,right_u,right_v", *rows]))
    return folder
