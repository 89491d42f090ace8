"""`interval_check`: true error bars are found true, false ones false; and the command with its files and exit codes."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from pathlib import Path

import pytest
import torch

import kcal.calibrate.camera.interval_check as module
from kcal.calibrate.camera.calibrate import calibrate_camera
from kcal.calibrate.camera.interval_check import interval_check, simulated_refits
from kcal.calibrate.camera.options import CalibrationOptions
from kcal.calibrate.camera.result import CameraCalibrationResult
from kcal.cli.main import main
from kcal.corners.observations import Observations
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.uncertainty import pixel_covariance, pixel_errors
from scripts.shared.views import observed, simulate

OPTIONS = CalibrationOptions(model="opencv5", weak_prior=None)
# The default lens is fitted in the last test only: its refits take longer.
AT = [math.inf, 5.0]


def capture(seed: int, noise: float = 0.2) -> Observations:
    truth = Camera.build(focal=(1600, 1600), center=(963, 536), size=(1920, 1080), coefficients=[-0.25, 0.08])
    return observed(simulate(8, truth, seed=seed, noise=noise)["pixels"].tolist())


@pytest.fixture(scope="module")
def result() -> CameraCalibrationResult:
    return calibrate_camera(capture(1), OPTIONS)


@pytest.fixture(scope="module")
def refits(result: CameraCalibrationResult) -> list[module.Refit]:
    return list(simulated_refits(result, OPTIONS, AT, range(30)))


def test_true_intervals(result: CameraCalibrationResult, refits: list[module.Refit]) -> None:
    found = interval_check(result, AT, refits)
    assert found.true
    assert found.failed == 0
    assert all(0.88 < share < 1.0 for share, _ in found.shares)
    assert all(0.75 < factor < 1.3 for factor in found.factors)
    assert all(0.8 < seen / told < 1.25 for seen, told in found.rms)


def test_false_intervals(result: CameraCalibrationResult, refits: list[module.Refit]) -> None:
    """A file that states half of σ is found out, and told to double it."""
    half = dataclasses.replace(result)
    half.camera.calibration = CameraCalibration(covariance=result.covariance / 4)
    try:
        found = interval_check(half, AT, refits)
    finally:
        result.__post_init__()
    assert not found.true
    assert found.shares[0][0] < 0.8
    assert 1.6 < found.factors[0] < 2.4


def test_refits_are_the_same_again(result: CameraCalibrationResult, refits: list[module.Refit]) -> None:
    """A seed determines its refit, so that a run may be continued."""
    again = next(simulated_refits(result, OPTIONS, AT, [7]))
    assert torch.equal(again.errors, refits[7].errors)
    assert not torch.equal(again.errors, refits[8].errors)


def test_errors_are_what_the_covariance_predicts() -> None:
    """A small change of the parameters moves pixels by its derivative, the turn taken out alike."""
    truth = Camera.build(focal=(800, 800), center=(320, 240), size=(640, 480), coefficients=[-0.1, 0.02])
    change = torch.zeros_like(truth.params)
    change[5] = 1e-4
    places = truth.grid(5, 4).reshape(-1, 2)
    error = pixel_errors(truth.with_parameters(truth.params + change), truth, places)
    squared = pixel_covariance(truth, places, torch.outer(change, change))
    assert torch.allclose(error[:, :, None] * error[:, None], squared, atol=1e-3 * float(squared.max()))


def run(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["kcal", "check", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    return int(stop.value.code or 0)


def test_command(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    result: CameraCalibrationResult,
) -> None:
    """Interrupted, continued, drawn, and told; against a second capture, and against one of another lens."""
    monkeypatch.chdir(tmp_path)
    options = CalibrationOptions(model="opencv5")
    seen = capture(1)
    seen.save("left.obs.json")
    calibrate_camera(seen, options).save("left.camera.json", source="left.obs.json")
    capture(2).save("second.obs.json")
    wrong = capture(3)
    views = tuple(
        view.model_copy(update={"pixels": tuple((u * 0.98, v * 0.98 + 1e-5 * u * u) for u, v in view.pixels)})
        for view in wrong.views
    )
    wrong.model_copy(update={"views": views}).save("wrong.obs.json")

    whole = module.simulated_refits

    def interrupted(*arguments: object) -> object:
        for number, refit in enumerate(whole(*arguments)):  # type: ignore[arg-type]
            if number == 11:
                raise KeyboardInterrupt
            yield refit

    monkeypatch.setattr(module, "simulated_refits", interrupted)
    assert run(monkeypatch, "left.camera.json", "--refits", "14") == 130
    printed = capsys.readouterr()
    assert "of 11 refits" in printed.out
    assert "interrupted after 11 of 14 refits" in printed.err
    monkeypatch.setattr(module, "simulated_refits", whole)
    assert run(monkeypatch, "left.camera.json", "--refits", "14", "--picture", "map.png", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["true"] is True
    assert told["refits"] == 14
    assert "11 refits are done already" in told["text"][0]
    assert Path("map.png").stat().st_size > 10_000
    assert run(monkeypatch, "left.camera.json", "--refits", "14", "--against", "second.obs.json") == 0
    assert "the second capture agrees with the stated intervals" in capsys.readouterr().out
    assert run(monkeypatch, "left.camera.json", "--refits", "14", "--against", "wrong.obs.json") == 3
    assert "the second capture contradicts the stated intervals" in capsys.readouterr().out
    assert run(monkeypatch, "left.camera.json", "--refits", "10", "--observations", "second.obs.json") == 1
    assert "not the views that the camera was calibrated from" in capsys.readouterr().err
    Path("left.obs.json").unlink()
    assert run(monkeypatch, "left.camera.json") == 1
    assert "name them with --observations" in capsys.readouterr().err


def test_default_lens() -> None:
    """Refits of the hybrid lens begin at the found one, and its intervals are true."""
    result = calibrate_camera(capture(4))
    found = interval_check(result, AT, simulated_refits(result, CalibrationOptions(), AT, range(4)))
    assert found.errors.shape == (4, 2, 17, 25, 2)
    assert all(0.3 < seen / told < 2.5 for seen, told in found.rms)
