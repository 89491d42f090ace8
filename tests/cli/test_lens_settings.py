"""`kcal calibrate --setting` and `kcal interpolate`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch
from calibrate_scenes import camera, motions, observe, pixels_of
from typer.testing import CliRunner

from kcal.cli.main import app
from kcal.io.camera_file import load_camera, save_camera
from kcal.lens.calibration import CameraCalibration, LensSetting
from kcal.lens.camera import Camera

RUNNER = CliRunner()


def stored(folder: Path, focus: float) -> str:
    made = Camera.build(focal=(500 + focus**2,) * 2, center=(320, 240), size=(640, 480), model="pinhole")
    covariance = torch.diag(torch.tensor([1.0, 1, 1, 1, 0])).double()
    made.calibration = CameraCalibration(covariance=covariance, setting=LensSetting(values={"focus": focus}))
    return str(save_camera(made, folder / f"f{focus:g}.camera.json"))


def test_several_settings_in_one_call(tmp_path: Path) -> None:
    truth = camera("opencv4")
    seen = [tmp_path / name for name in ("near.obs.json", "far.obs.json")]
    for i, path in enumerate(seen):
        observe(pixels_of(truth, motions(truth, 6, i + 1), noise=0.1, seed=i + 1)).save(path)
    words = ["calibrate", *map(str, seen), "-o", str(tmp_path / "out"), "--model", "opencv4"]
    done = RUNNER.invoke(app, [*words, "--setting", "focus=1,2.5", "--setting", "zoom=12"])
    assert done.exit_code == 0, done.output
    found = [load_camera(tmp_path / "out" / f"{name}.camera.json").calibration for name in ("near", "far")]
    assert [one and one.setting and one.setting.values for one in found] == [
        {"focus": 1.0, "zoom": 12.0},
        {"focus": 2.5, "zoom": 12.0},
    ]
    assert "setting focus=2.5 zoom=12" in RUNNER.invoke(app, ["show", str(tmp_path / "out/far.camera.json")]).output
    for option, message in (
        ("focus=1,2,3", "3 numbers for 2 cameras"),
        ("focus", "write NAME=NUMBER"),
        ("focus=a", "'a' is not a number"),
    ):
        assert message in str(RUNNER.invoke(app, [*words, "--setting", option]).exception)
    twice = RUNNER.invoke(app, [*words, "--setting", "focus=1", "--setting", "focus=2"])
    assert "focus is stated twice" in str(twice.exception)


def test_interpolate(tmp_path: Path) -> None:
    paths = [stored(tmp_path, focus) for focus in (0.0, 1.0, 2.0, 3.0)]
    made = tmp_path / "now.camera.json"
    words = ["interpolate", *paths, "--setting", "focus=1.5", "-o", str(made)]
    done = RUNNER.invoke(app, [*words, "--setting-sigma", "focus=0.1"])
    assert done.exit_code == 0, done.output
    assert "focus=1.5, interpolated: far directions ± " in done.output
    assert all(f" by {part}" in done.output for part in ("calibrations", "interpolation", "setting"))
    known = load_camera(made).calibration
    assert known is not None
    assert known.setting is not None
    assert (known.name, known.setting.interpolated_from) == ("now", tuple(paths))
    assert f"setting focus=1.5, interpolated from {paths[0]}, " in RUNNER.invoke(app, ["show", str(made)]).output
    told = json.loads(RUNNER.invoke(app, [*words, "--json"]).stdout)
    assert told["sigma_px"]["setting"] == 0.0 < told["sigma_px"]["interpolation"]
    assert sum(told["weights"]) == pytest.approx(1.0)
    same = RUNNER.invoke(app, ["interpolate", *paths, "--setting", "focus=2", "-o", str(made)])
    assert "focus=2, calibrated: far directions ± " in same.output
    assert load_camera(made).focal.tolist() == [504.0, 504.0]
    made.unlink()
    beyond = RUNNER.invoke(app, ["interpolate", *paths, "--setting", "focus=3.5", "-o", str(made)])
    assert "focus=3.5 is outside the calibrated focus of 0 to 3" in str(beyond.exception)
    several = RUNNER.invoke(app, [*words, "--setting-sigma", "focus=1,2"])
    assert "--setting-sigma focus: one number is needed" in str(several.exception)
    assert not made.exists()
