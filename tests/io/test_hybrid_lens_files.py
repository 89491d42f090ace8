"""Cameras with a hybrid lens in kcal's files: exact, by name, and refused when they do not fit."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from lenses import FEW_MODES, hybrid_camera
from wrong_files import assert_refused

from kcal import Camera, FileError, Rig, load_rig, save_rig
from kcal.io.camera_file import CameraFile, camera_to_file, load_camera, save_camera
from kcal.lens import CameraCalibration


@pytest.mark.parametrize("kind", ["webcam", "wide"])
def test_round_trip_is_exact(tmp_path: Path, kind: str) -> None:
    before = hybrid_camera(kind)
    after = load_camera(save_camera(before, tmp_path / "camera.json", name="left"))
    assert type(after) is Camera
    assert torch.equal(after.params, before.params)
    assert (after.model, after.size, after.fingerprint) == (before.model, before.size, before.fingerprint)
    pixels = before.grid(5, 4).flatten(0, 1)
    assert torch.equal(after.unproject(pixels)[0], before.unproject(pixels)[0])
    save_camera(after, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_text() == (tmp_path / "camera.json").read_text()


def test_stored_form() -> None:
    """Spelled out, because whoever reads these files elsewhere depends on it."""
    camera = hybrid_camera("pinhole", modes=FEW_MODES)
    stored = camera_to_file(camera).dump()
    assert stored["model"].pop("hybrid") == {
        "shape": 1.0,
        "radius": camera.model.hybrid.radius,
        "modes": {"radial": 5, "decentered": 4, "astigmatic": 3, "other": 3},
    }
    assert set(stored["model"].values()) == {0}
    assert tuple(stored["coefficients"]) == camera.model.names
    assert stored["coefficients"]["pupil1"] == 2e-3
    assert stored["coefficients"]["z5+1"] == float(camera.params[camera.names.index("z5+1")])
    # Files of other lenses do not mention it.
    plain = Camera.build(focal=(1, 1), center=(0, 0), size=(4, 3))
    assert "hybrid" not in camera_to_file(plain).dump()["model"]


def test_covariance_and_rig(tmp_path: Path) -> None:
    camera = hybrid_camera("webcam", modes=FEW_MODES)
    factor = torch.randn(len(camera.names), 9, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    camera.calibration = CameraCalibration(covariance=factor @ factor.T)
    file = CameraFile.load(camera_to_file(camera).save(tmp_path / "camera.json"))
    again = file.covariance_matrix()
    assert again is not None
    assert torch.equal(again, factor @ factor.T)
    rig = Rig.pair(camera, hybrid_camera("wide", modes=FEW_MODES), torch.eye(3), torch.tensor([-0.5, 0.0, 0.0]))
    back = load_rig(save_rig(rig, tmp_path / "rig.json"))
    assert (back.left.fingerprint, back.right.fingerprint) == (rig.left.fingerprint, rig.right.fingerprint)


@pytest.mark.parametrize(
    ("path_in_file", "value", "message"),
    [
        (["model", "hybrid", "modes", "radial"], 7, "z7.1 is missing"),
        (["model", "hybrid", "modes", "other"], 2, "z3.3 is unknown"),
        (["model", "hybrid", "modes", "radial"], 99, "radial must be a whole number from 0 to 40"),
        (["model", "hybrid", "modes", "coma"], 3, "modes.coma.*Extra"),
        (["model", "hybrid", "radius"], 0.0, "radius of its disc must be positive"),
        (["model", "hybrid", "shape"], 99.0, "within ±10"),
        (["model", "hybrid", "kind"], "spline", "hybrid.kind.*Extra"),
        (["model", "tangential"], True, "terms of its own"),
        (["model", "hybrid"], None, "is unknown"),
        (["coefficients", "z9+9"], 0.0, r"z9.9 is unknown; the lens model needs exactly shape, pupil1"),
        (["coefficients", "z5+1"], float("nan"), "finite"),
    ],
)
def test_wrong_field(tmp_path: Path, path_in_file: list[str], value: Any, message: str) -> None:
    content = camera_to_file(hybrid_camera("webcam", modes=FEW_MODES)).dump()
    assert_refused(load_camera, tmp_path, content, path_in_file, value, message)


def test_a_long_list_of_names_is_cut(tmp_path: Path) -> None:
    content = camera_to_file(hybrid_camera("webcam")).dump()
    del content["coefficients"]["z33+1"]
    path = tmp_path / "short.json"
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=r"z33.1 is missing; .* needs exactly shape, .*, \.\.\., z") as error:
        load_camera(path)
    assert len(str(error.value)) < 400
