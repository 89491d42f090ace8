"""`kcal rig` of one camera that stood at two places, its file given twice, and `kcal locate` with that rig."""

from pathlib import Path

import pytest
import torch
from command_line import Command, rows_of
from rig_scenes import CAMERAS, CENTER, ROTATION, normal, spread_points
from torch import Tensor

from kcal import load_rig, save_camera
from kcal.lens.calibration import CameraCalibration

CAMERA, NOISE = CAMERAS[0], 0.1
TARGET = CENTER[0] + 1500.0 * ROTATION[0, 2] + 200.0 * ROTATION[0, 0]
SURVEYED = "--landmarks survey.csv --refraction 0±0 --pixel-sigma 0.1 -o rig.json"


def see(points: Tensor, place: int) -> Tensor:
    pixels, valid = CAMERA.project((points - CENTER[place]) @ ROTATION[place].T)
    assert bool(valid.all())
    return pixels


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    sigma = torch.tensor([0.7, 0.7, 0.8, 0.8, 0, 7e-4, 1.5e-3, 9e-5, 9e-5, 1e-3], dtype=torch.float64)
    found = CAMERA.with_parameters(CAMERA.params + sigma * normal(sigma.shape, 1))
    found.calibration = CameraCalibration(name="mast", covariance=torch.diag(sigma**2))
    save_camera(found, tmp_path / "mast.camera.json")
    truth = spread_points(10, 60.0, 600.0, 5)
    survey = truth + 0.02 * normal(truth.shape, 2)
    lines = [f"p{i},{x:.4f},{y:.4f},{z:.4f},0.02" for i, (x, y, z) in enumerate(survey.tolist())]
    (tmp_path / "survey.csv").write_text("\n".join(["name,east,north,up,sigma", *lines]) + "\n")
    for name, points in (("marks", truth), ("target", TARGET[None])):
        pixels = torch.stack([see(points, place) for place in (0, 1)], 1)
        pixels = pixels + NOISE * normal(pixels.shape, 3)
        lines = [f"p{i}," + ",".join(f"{x:.3f}" for x in row) for i, row in enumerate(pixels.flatten(1).tolist())]
        (tmp_path / f"{name}.csv").write_text("\n".join(["name,left_u,left_v,right_u,right_v", *lines]) + "\n")
        lines = [
            f"p{i},mast-{k + 1},{u:.3f},{v:.3f}"
            for i, row in enumerate(pixels.tolist())
            for k, (u, v) in enumerate(row)
        ]
        (tmp_path / f"long-{name}.csv").write_text("\n".join(["name,camera,u,v", *lines]) + "\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    return tmp_path


@pytest.mark.slow
@pytest.mark.parametrize("marks", ["marks.csv", "long-marks.csv"])
def test_a_file_given_twice_is_one_camera_at_two_places(folder: Path, command: Command, marks: str) -> None:
    said = command("rig mast.camera.json mast.camera.json --marks", marks, SURVEYED)
    assert "left and right are one camera that stood at 2 places: its lens is the same unknown" in said.out
    rig = load_rig(folder / "rig.json")
    assert rig.names == ("left", "right")
    assert torch.equal(rig.left.params, rig.right.params)
    assert float(rig.baseline) == pytest.approx(float((CENTER[0] - CENTER[1]).norm()), abs=0.05)
    command("locate rig.json target.csv --pixel-sigma 0.1 -o out.csv")
    (row,) = rows_of(folder / "out.csv")
    assert row["status"] == "ok"
    low, high = float(row["range_low_m"]), float(row["range_high_m"])
    assert low < float((TARGET - CENTER[0]).norm()) < high < 1.2 * low
