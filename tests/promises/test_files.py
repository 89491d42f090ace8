"""Files of every version load to the numbers that the version itself computed from them."""

import json
from pathlib import Path

import pytest
import torch

from kcal import Camera, Observations
from kcal.calibrate import load_measured_board, save_measured_board
from kcal.io.camera_file import CameraFile, load_camera, save_camera
from kcal.io.file_summary import sigma_of
from kcal.io.rig_file import RigFile, load_rig, save_rig
from kcal.lens import load_lookup

FILES = Path(__file__).parent / "files"
VERSIONS = sorted(path.parent.name for path in FILES.glob("*/rig.json"))
CAMERAS = sorted(f"{path.parent.name}/{path.name}" for path in FILES.glob("*/*.camera.json"))


def close(found: torch.Tensor, stored: list[object]) -> None:
    # Rays of an inverse that is iterated may end elsewhere within its tolerance, 1e-12 of a ray.
    torch.testing.assert_close(found, torch.tensor(stored, dtype=torch.float64), rtol=1e-12, atol=2e-12, equal_nan=True)


def same_camera(camera: Camera, known: dict[str, list[object]], whole: dict[str, list[object]]) -> None:
    close(camera.params.detach(), known["params"])
    close(camera.project(torch.tensor(whole["points"], dtype=torch.float64))[0].detach(), known["pixels"])
    close(camera.unproject(torch.tensor(whole["marks"], dtype=torch.float64))[0].detach(), known["rays"])


def computed(version: str) -> dict[str, dict[str, list[object]]]:
    return json.loads((FILES / version / "computed.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("file", CAMERAS)
def test_cameras(file: str, tmp_path: Path) -> None:
    version, _, name = file.partition("/")
    whole = computed(version)
    camera = load_camera(FILES / file)
    same_camera(camera, whole[name], whole)
    # Error bars are those that the file states, to 1e-9: the present version may keep them as a square root.
    stored = json.loads((FILES / file).read_text(encoding="utf-8"))["standard_deviations"]
    found = sigma_of(camera)
    for parameter, value in stored.items():
        assert found[parameter] == pytest.approx(value, rel=1e-9) if value else not found[parameter]
    # And what the present version writes of them.
    same_camera(load_camera(save_camera(camera, tmp_path / "again.json")), whole[name], whole)


@pytest.mark.parametrize("version", VERSIONS)
def test_other_files(version: str) -> None:
    folder, whole = FILES / version, computed(version)
    total = sum(sum(map(sum, view.pixels)) for view in Observations.load(folder / "observations.json").views)
    assert total == pytest.approx(whole["observations.json"]["sum"], rel=1e-12)
    rig, known = load_rig(folder / "rig.json"), whole["rig.json"]
    close(rig.right_from_left_rotation, known["rotation"])
    close(rig.right_from_left_translation, known["translation"])
    same_camera(rig.left, known["left"], whole)
    same_camera(rig.right, known["right"], whole)
    lookup = load_lookup(folder / "lookup.npz")
    close(lookup.project(torch.tensor(whole["points"][3:], dtype=torch.float64))[0], whole["lookup.npz"]["pixels"])
    if "board.json" in whole:
        close(load_measured_board(folder / "board.json").points, whole["board.json"]["points"])


@pytest.mark.parametrize(
    "folder", sorted(path.parent for path in FILES.glob("*/camera-rig.json")), ids=lambda f: f.name
)
def test_rigs_of_several_cameras(folder: Path, tmp_path: Path) -> None:
    whole = computed(folder.name)
    known = whole["camera-rig.json"]
    first = load_rig(folder / "camera-rig.json")
    for rig in (first, load_rig(save_rig(first, tmp_path / "again.json"))):
        close(rig.rotation, known["rotation"])
        close(rig.center, known["center"])
        close(rig.root.square().sum(0), known["variance"])
        for camera, numbers in zip(rig.each, known["cameras"], strict=True):
            same_camera(camera, numbers, whole)


def fields(content: object, at: str = "") -> set[str]:
    """Places of all fields of a decoded JSON value."""
    if isinstance(content, list):
        return set().union(*(fields(each, f"{at}[]") for each in content))
    if not isinstance(content, dict):
        return set()
    return set().union(*({f"{at}.{key}"} | fields(value, f"{at}.{key}") for key, value in content.items()))


WRITTEN_AGAIN = {
    "camera": lambda path, to: save_camera(load_camera(path), to),
    "rig": lambda path, to: save_rig(load_rig(path), to),
    "observations": lambda path, to: Observations.load(path).save(to),
    "board": lambda path, to: save_measured_board(load_measured_board(path), to),
}


def newest(path: Path) -> bool:
    """Whether a file has the version that its kind is written in."""
    stored = json.loads(path.read_text(encoding="utf-8"))
    return stored["kcal"] != "rig" or stored["version"] == RigFile.VERSION


@pytest.mark.parametrize(
    "path",
    [path for path in sorted(FILES.glob("*/*.json")) if path.name != "computed.json" and newest(path)],
    ids=lambda path: f"{path.parent.name}/{path.name}",
)
def test_the_newest_version_has_the_fields_of_its_first_files(path: Path, tmp_path: Path) -> None:
    """An older kcal that reads the version refuses any field that it does not know."""
    stored = json.loads(path.read_text(encoding="utf-8"))
    again = json.loads(WRITTEN_AGAIN[stored["kcal"]](path, tmp_path / "again.json").read_text(encoding="utf-8"))
    assert (again["version"], fields(again)) == (stored["version"], fields(stored))


def test_each_format_that_is_read_has_files() -> None:
    """A new version of a format brings its files with it."""
    for kind, name, versions in (
        (CameraFile, "opencv5.camera.json", {2}),
        (RigFile, "rig.json", {2, 4}),
        (RigFile, "camera-rig.json", {3, 4}),
    ):
        there = {json.loads(path.read_text(encoding="utf-8"))["version"] for path in FILES.glob(f"*/{name}")}
        assert there == versions
        assert max(there) == kind.VERSION
