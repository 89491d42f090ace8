"""`interval_check`: true error bars are found true, false ones false; and the command with its files and exit codes."""

import dataclasses
import json
import math
import sys
from pathlib import Path

import pytest
import torch

import kcal.calibrate.camera.trust as module
from kcal import Camera, Observations, calibrate_camera, load_camera
from kcal.calibrate.camera.result import CalibrationOptions, CameraCalibrationResult
from kcal.calibrate.camera.trust import interval_check, simulated_refits
from kcal.cli.main import main
from kcal.cli.report import calibrated_again
from kcal.finding import Finding
from kcal.lens import CameraCalibration
from kcal.lens.calibration import Exclusion
from kcal.lens.uncertainty import pixel_covariance, pixel_errors
from kcal.report.judge_camera import fault_of_views
from scripts.shared.views import observed, simulate

OPTIONS = CalibrationOptions(model="opencv5", weak_prior=None)
# The default lens is fitted in one test only: its refits take longer.
AT = [math.inf]


def capture(seed: int, noise: float = 0.2) -> Observations:
    truth = Camera.build(focal=(1600, 1600), center=(963, 536), size=(1920, 1080), coefficients=[-0.25, 0.08])
    return observed(simulate(6, truth, seed=seed, noise=noise)["pixels"].tolist())


def test_copies_are_left_out_without_being_asked() -> None:
    """A camera whose file names a copy was not calibrated with --reject, and is not calibrated again with it."""
    seen = capture(1)
    twice = seen.model_copy(update={"views": (*seen.views, seen.views[0].model_copy(update={"name": "copy.png"}))})
    camera = calibrate_camera(twice, OPTIONS).camera
    assert camera.calibration is not None
    record = camera.calibration.record
    assert record is not None
    assert [one.reason for one in record.excluded] == [f"it is a copy of {seen.views[0].name}"]
    assert module.stored_options(camera).reject is None
    gone = dataclasses.replace(record, excluded=(Exclusion(name="a corner 3", reason="3 px off"), *record.excluded))
    camera.calibration = dataclasses.replace(camera.calibration, record=gone)
    assert module.stored_options(camera).reject is not None


@pytest.mark.slow
def test_a_camera_calibrated_without_motion_is_found_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four views would be allowed the motion of a hand: the file does not say that they were not."""
    # With motion these views give nearly the same camera, by a fifth of its error bars.
    monkeypatch.setattr("kcal.report.judge_camera._ITSELF", 0.01)
    seen = capture(1).subset([view.name for view in capture(1).views[:4]])
    still = CalibrationOptions(motion=False)
    path = calibrate_camera(seen, still).save(tmp_path / "a.camera.json")
    seen.save(tmp_path / "a.obs.json")
    found, options = calibrated_again(load_camera(path), tmp_path / "a.obs.json", "calibrating")
    assert options == still
    assert torch.equal(found.camera.params, load_camera(path).params)


@pytest.fixture(scope="module")
def result() -> CameraCalibrationResult:
    return calibrate_camera(capture(1), OPTIONS)


@pytest.fixture(scope="module")
def refits(result: CameraCalibrationResult) -> list[module.Refit]:
    return list(simulated_refits(result, OPTIONS, AT, range(16)))


def test_true_intervals(result: CameraCalibrationResult, refits: list[module.Refit]) -> None:
    found = interval_check(result, AT, refits)
    assert found.true
    assert found.failed == 0
    assert all(0.85 < share < 1.0 for share, _ in found.shares)
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
    assert torch.allclose(again.errors, refits[7].errors, atol=1e-6)
    assert not torch.allclose(again.errors, refits[8].errors, atol=1e-2)


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


@pytest.mark.slow
def test_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], result: CameraCalibrationResult
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
        view.model_copy(update={"pixels": tuple((u * 0.98, v * 0.98) for u, v in view.pixels)}) for view in wrong.views
    )
    wrong.model_copy(update={"views": views}).save("wrong.obs.json")

    whole = module.simulated_refits

    def interrupted(*arguments: object) -> object:
        for number, refit in enumerate(whole(*arguments)):  # type: ignore[arg-type]
            if number == 10:
                raise KeyboardInterrupt
            yield refit

    monkeypatch.setattr(module, "simulated_refits", interrupted)
    monkeypatch.setattr("kcal.report.judge_camera.fault_of_views", lambda *_: None)
    assert run(monkeypatch, "left.camera.json", "--refits", "11") == 130
    printed = capsys.readouterr()
    assert "of 10 refits" in printed.out
    assert "interrupted after 10 of 11 refits" in printed.err
    monkeypatch.setattr(module, "simulated_refits", whole)
    command = ("left.camera.json", "--refits", "11", "--picture", "map.png", "--against", "second.obs.json", "--json")
    assert run(monkeypatch, *command) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["true"] is True
    assert told["refits"] == 11
    assert told["against_same"] is True
    assert "10 refits are done already" in told["text"][0]
    assert Path("map.png").stat().st_size > 10_000
    fault = Finding(name="model", severity="doubt", text="halves differ", action="take more views")
    monkeypatch.setattr("kcal.report.judge_camera.fault_of_views", lambda *_: fault)
    assert run(monkeypatch, "left.camera.json", "--refits", "11", "--against", "wrong.obs.json") == 3
    printed = capsys.readouterr()
    assert "the second capture contradicts the stated intervals" in printed.out
    assert "its own views contradict the stated intervals: halves differ; take more views" in printed.out
    assert run(monkeypatch, "left.camera.json", "--observations", "second.obs.json") == 1
    assert "not the views that the camera was calibrated from" in capsys.readouterr().err


@pytest.mark.slow
def test_own_views_find_a_wrong_model() -> None:
    """A lens that needs three coefficients, fitted with one, is contradicted by the default lens."""
    truth = Camera.build(focal=(900, 900), center=(963, 536), size=(1920, 1080), coefficients=[-0.3, 0.15, 0, 0, -0.03])
    seen = observed(simulate(12, truth, seed=5, noise=0.05)["pixels"].tolist())
    options = CalibrationOptions(model="opencv4", fixed={"k2": 0.0, "p1": 0.0, "p2": 0.0})
    assert fault_of_views(calibrate_camera(seen, options), options) is not None


@pytest.mark.slow
def test_default_lens() -> None:
    """Refits of the hybrid lens begin at the found one, and its intervals are true."""
    result = calibrate_camera(capture(4))
    found = interval_check(
        result, [math.inf, 5.0], simulated_refits(result, CalibrationOptions(), [math.inf, 5.0], range(3))
    )
    assert found.errors.shape == (3, 2, 17, 25, 2)
    assert all(0.3 < seen / told < 2.5 for seen, told in found.rms)
