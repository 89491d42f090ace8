"""Hybrid cameras in kcal's files: exact, whole, and never mixed up."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from kcal.errors import FileError, InputError
from kcal.io.camera_file import camera_to_file, load_camera, save_camera
from kcal.io.rig_file import load_rig, rig_to_file, save_rig
from kcal.lens.camera import Camera
from kcal.lens.hybrid import HybridCamera
from kcal.lens.residual import FieldGrid, FieldResidual
from kcal.lens.rig import StereoRig

GRID = FieldGrid.covering((-0.4, -0.3), (0.4, 0.3), widths=[1 / 3, 0.2])


def hybrid(seed: int = 0) -> HybridCamera:
    camera = Camera.build(focal=(1600 / 3, 540), center=(319.5, 239.5), size=(640, 480), coefficients=[-0.1, 1e-300])
    weights = 1e-3 * torch.randn(2, GRID.count, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    return HybridCamera.of(camera, FieldResidual(GRID, weights))


def test_round_trip_is_exact(tmp_path: Path) -> None:
    before = hybrid()
    after = load_camera(save_camera(before, tmp_path / "camera.json"))
    assert isinstance(after, HybridCamera)
    assert after.fingerprint == before.fingerprint
    assert torch.equal(after.residual.weights, before.residual.weights)
    assert after.residual.grid == before.residual.grid
    assert torch.equal(after.unproject(before.grid(5, 4))[0], before.unproject(before.grid(5, 4))[0])


def test_a_parametric_camera_has_no_residual_field_in_its_file() -> None:
    assert "residual" not in camera_to_file(hybrid().parametric).dump()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (lambda part: part["along_x"].pop(), "as many weights"),
        (lambda part: part.update(columns=part["columns"] + 1), "as many weights"),
        (lambda part: part.update(width=0.0), "width"),
        (lambda part: part.update(along_y=[9.0] * len(part["along_y"])), "its slope reaches"),
        (lambda part: part["along_x"].__setitem__(0, None), "along_x"),
    ],
)
def test_damaged_fields_are_refused(change, complaint: str, tmp_path: Path) -> None:
    path = save_camera(hybrid(), tmp_path / "camera.json")
    content = json.loads(path.read_text())
    change(content["residual"][0])
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=complaint):
        load_camera(path)


def test_rig_holds_its_cameras_and_no_others(tmp_path: Path) -> None:
    rig = StereoRig(hybrid(), hybrid(1), torch.eye(3), torch.tensor([-1.0, 0.0, 0.0]))
    after = load_rig(save_rig(rig, tmp_path / "rig.json"))
    assert (after.left.fingerprint, after.right.fingerprint) == (rig.left.fingerprint, rig.right.fingerprint)
    # One weight's last bit makes another camera, for which the rig was not solved.
    weights = rig.left.residual.weights.detach().clone()
    weights[0, 0] = torch.nextafter(weights[0, 0], torch.tensor(9.0).double())
    other = HybridCamera.of(rig.left, FieldResidual(GRID, weights))
    with pytest.raises(InputError, match="another camera"):
        rig_to_file(rig, left=camera_to_file(other))
    with pytest.raises(InputError, match="another camera"):
        rig_to_file(rig, left=camera_to_file(rig.left.parametric))
