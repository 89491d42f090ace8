"""Cameras calibrated together share the board that they saw, and only that."""

import copy
import dataclasses
import functools
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch
from calibrate_scenes import observe
from command_line import invoked
from printed_boards import printed_points, printed_views, shape_error
from torch import Tensor

from kcal import Board, Camera, DegenerateError, InputError, KcalError, Observations, load_camera, save_camera
from kcal.calibrate import OutlierRejection
from kcal.calibrate.camera.calibrate import (
    CalibrationOptions,
    CameraCalibrationResult,
    calibrate_camera,
    calibrate_cameras,
    sharing,
)
from kcal.calibrate.hybrid.board_modes import turned_corners
from kcal.calibrate.rig.unknowns import gathered, joint_unknowns
from kcal.finding import Finding

BOARD = Board(columns=8, rows=6, square=0.03)
SIZE = (1280, 960)
PRINT = printed_points(BOARD, 3)
# Half of the five views of the second camera, read from the other end.
ENDS = torch.tensor([2, 0, 2, 0, 2])
# Five views would be allowed the motion of a hand; these stood still.
STILL = CalibrationOptions(motion=False)


def camera(number: int) -> Camera:
    return Camera.build(
        focal=(800.0 + 7 * number,) * 2,
        center=(640.0 - 5 * number, 484.0),
        size=SIZE,
        coefficients=[-0.12 - 0.01 * number, 0.03, 4e-4, -3e-4, 0.0],
        model="opencv5",
    )


def seen_by(number: int, points: Tensor = PRINT, count: int = 5, turns: Tensor | None = None) -> Observations:
    pixels = printed_views(camera(number), BOARD, points, count, 10 + number, noise=0.1, pupil=2e-3)
    return observe(pixels if turns is None else turned_corners(pixels, BOARD, turns), board=BOARD, size=SIZE)


@functools.cache
def alone(number: int) -> CameraCalibrationResult:
    return calibrate_camera(seen_by(number), STILL)


@functools.cache
def pair() -> tuple[CameraCalibrationResult, ...]:
    return tuple(map(result_of, calibrate_cameras([seen_by(1), seen_by(2)], STILL)))


def result_of(outcome: object) -> CameraCalibrationResult:
    assert isinstance(outcome, CameraCalibrationResult)
    return outcome


@pytest.mark.slow
def test_a_shared_board_is_better_known() -> None:
    """Five views each: errors of the board fall to less than 0.8, and σ of the camera tells."""
    found = pair()
    shared = sum(shape_error(result.board_points, PRINT) ** 2 for result in found)
    assert shared < 0.8**2 * sum(shape_error(alone(k).board_points, PRINT) ** 2 for k in (1, 2))
    for number, other, result in ((1, 1, found[0]), (2, 0, found[1])):
        assert result.shared_board.others == (other,)
        assert result.shared_board.evidence > 10
        sigma = result.sigma["fx"], alone(number).sigma["fx"]
        assert sigma[0] is not None
        assert sigma[1] is not None
        assert sigma[0] < sigma[1]
    # Both boards are one, to what their σ say.
    one, two = (result.measured_board for result in found)
    spread = one.half.square().sum(0).sqrt()
    assert float(((one.amplitudes - two.amplitudes) / spread).abs().max()) < 1.0


def test_what_was_said_of_the_views_stays() -> None:
    """Warnings of a fit alone are found anew; those of its views are not, and must not be lost."""
    doubts = tuple(Finding("excluded", "doubt", f"{which} left out") for which in ("2 of 5 views were", "1 of 5 was"))
    one = dataclasses.replace(alone(1), findings=(Finding("model", "doubt", "of this fit alone"), *doubts))
    found = result_of(sharing([one, alone(2)], STILL)[0])
    assert found.shared_board is not None
    assert found.findings[:2] == doubts
    assert "of this fit alone" not in found.warnings


def test_what_others_said_is_told_apart(tmp_path: Path) -> None:
    """The file holds each camera's own rows beside those of others; together they are the covariance."""
    for result, other in zip(pair(), reversed(pair()), strict=True):
        known, said = result.information, other.information
        assert said is not None
        assert known.others is not None
        assert known.board_size == 28
        # By its own modes, and by the variables of the fit: in units of σ.
        sigma = result.covariance.diagonal().sqrt().clamp_min(1e-300)
        unit = known.covariance() / sigma / sigma[:, None]
        torch.testing.assert_close(unit, result.covariance / sigma / sigma[:, None], rtol=0, atol=1e-6)
        # Where data and priors are largest together, nothing pulls any more.
        rows = known.whole.rows
        pull = known.half() @ (rows[:, :-1].T @ rows[:, -1])
        assert float(pull.abs().max()) < 0.2
        # Without others: the camera's own data and its prior.
        assert float(dataclasses.replace(known, others=None).covariance()[0, 0]) > float(known.covariance()[0, 0])
        path = result.save(tmp_path / "camera.json")
        again = load_camera(path)
        kept = again.calibration
        assert kept.information.others is not None
        torch.testing.assert_close(kept.information.covariance() / sigma / sigma[:, None], unit, rtol=0, atol=1e-9)
        assert save_camera(again, tmp_path / "again.json").read_bytes() == path.read_bytes()


@pytest.mark.slow
def test_a_rig_counts_each_camera_once() -> None:
    """Cameras that told each other of their board bring a rig what they know alone: nothing is counted twice."""
    shared = joint_half([result.camera for result in pair()])
    single = joint_half([alone(1).camera, alone(2).camera])
    assert shared.shape == single.shape
    # The lenses are linearized elsewhere, and amplitudes of the board's prior are those that both found.
    torch.testing.assert_close(shared.log(), single.log(), rtol=0, atol=0.15)


def joint_half(cameras: list[Camera]) -> Tensor:
    """σ of the leading parameters of both cameras in a rig."""
    known = [None if camera.calibration is None else camera.calibration.information for camera in cameras]
    parts = gathered(cameras, known, BOARD)[0]
    assert all(part is not None and part.board_size for part in parts)
    unknowns, _ = joint_unknowns(cameras, parts, BOARD)
    return torch.cat([onto.square().sum(1).sqrt()[[0, 2, 3]] for onto in unknowns.cameras])


@pytest.mark.slow
def test_cameras_with_nothing_in_common_stay_as_they_are() -> None:
    """Another print, another kind of board, a set that fails, exact boards, a parametric lens."""
    other = seen_by(2, printed_points(BOARD, 4))
    larger = seen_by(2).model_copy(update={"board": Board(columns=8, rows=6, square=0.031)})
    bad = seen_by(2).subset(["v00", "v01"])
    for second in (other, larger, bad):
        first, last = calibrate_cameras([seen_by(1), second], STILL)
        assert torch.equal(result_of(first).camera.params, alone(1).camera.params)
        assert result_of(first).shared_board is None
        assert isinstance(last, DegenerateError) == (second is bad)
    for options in (CalibrationOptions(board="exact"), CalibrationOptions(model="opencv5")):
        both = calibrate_cameras([seen_by(1, count=4), seen_by(2, count=4)], options)
        assert all(result_of(one).shared_board is None for one in both)


@pytest.mark.slow
def test_views_read_from_the_other_end_and_views_left_out() -> None:
    """The result holds the views in one order, and what was left out of the camera alone stays out."""
    wrong = seen_by(1, count=6)
    swapped = [wrong.views[5].pixels[k] for k in torch.randperm(48, generator=torch.Generator().manual_seed(0))]
    wrong = wrong.model_copy(
        update={"views": (*wrong.views[:5], wrong.views[5].model_copy(update={"pixels": tuple(swapped)}))}
    )
    options = CalibrationOptions(reject=OutlierRejection(limit=0.3), motion=False)
    twice = seen_by(2, turns=ENDS)
    twice = twice.model_copy(update={"views": (*twice.views, twice.views[0].model_copy(update={"name": "copy"}))})
    first, second = (result_of(one) for one in calibrate_cameras([wrong, twice], options))
    assert first.shared_board is not None
    assert [view.view for view in first.rejected_views] == ["v05"]
    assert bool(first.residuals[5].isnan().all())
    assert [view.view for view in second.rejected_views] == ["copy"]
    assert any("copy of v00" in text for text in second.warnings)
    read = seen_by(2, turns=ENDS).pixels()
    back = second.observations.pixels()
    changed = [not torch.equal(read[k], back[k]) for k in range(5)]
    assert changed in ([True, False, True, False, True], [False, True, False, True, False])
    assert second.rms < 0.16
    projected, _ = second.camera.project(
        second.board_points @ second.cam_from_board_rotation.mT + second.cam_from_board_translation[:, None]
    )
    used = second.residuals.isfinite().all(-1)
    assert int(used.sum()) > 230
    torch.testing.assert_close((projected - back)[used], second.residuals[used], rtol=0, atol=1e-9)


def test_one_type_is_refused_before_anything_is_calibrated(monkeypatch: pytest.MonkeyPatch) -> None:
    never = Mock(side_effect=AssertionError("calibrated"))
    monkeypatch.setattr("kcal.calibrate.camera.calibrate.calibrate_camera", never)
    with pytest.raises(InputError, match="hybrid lens only"):
        calibrate_cameras([seen_by(1)], CalibrationOptions(model="opencv5"), one_type=True)
    other = seen_by(2).model_copy(update={"image_size": (1280, 961)})
    with pytest.raises(InputError, match="images of one size"):
        calibrate_cameras([seen_by(1), other], one_type=True)


def test_cameras_of_one_size_may_be_of_one_type() -> None:
    bad = [seen_by(number).subset(["v00", "v01"]) for number in (1, 2)]
    assert all(isinstance(one, DegenerateError) for one in calibrate_cameras(bad, one_type=True))


@pytest.mark.slow
def test_cameras_that_saw_other_boards_are_not_fitted_together(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is common to them: each stays as it is alone, and no time is spent."""
    never = Mock(side_effect=AssertionError("fitted together"))
    monkeypatch.setattr("kcal.calibrate.camera.calibrate.fit_cameras", never)
    # A result writes what it knows into its camera, also one that is made by `replace`.
    found = [alone(1), copy.deepcopy(alone(2))]
    other = Board(columns=BOARD.columns, rows=BOARD.rows, square=0.031)
    found[1] = dataclasses.replace(found[1], observations=found[1].observations.model_copy(update={"board": other}))
    assert sharing(found, CalibrationOptions()) == found
    with pytest.raises(AssertionError, match="fitted together"):
        sharing([found[0], found[0]], CalibrationOptions())


@pytest.mark.slow
def test_cameras_that_cannot_be_fitted_together_stay_as_they_are_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    fails = Mock(side_effect=DegenerateError("nothing fits"))
    monkeypatch.setattr("kcal.calibrate.camera.calibrate.fit_cameras", fails)
    found = result_of(calibrate_cameras([seen_by(1), seen_by(2)], STILL)[0])
    assert torch.equal(found.camera.params, alone(1).camera.params)
    assert found.warnings[-1].endswith("what other cameras tell of the board: nothing fits")


@pytest.mark.slow
def test_command_line(tmp_path: Path) -> None:
    for name, number in (("left", 1), ("right", 2)):
        seen_by(number).save(tmp_path / f"{name}.obs.json")
    files = [tmp_path / f"{name}.obs.json" for name in ("left", "right")]
    text = " ".join(invoked("calibrate", *files, "--without", "motion", "-o", tmp_path / "out").split())
    assert "the board is that of right" in text
    assert "the board is that of left" in text
    for name, result in zip(("left", "right"), pair(), strict=True):
        camera = load_camera(tmp_path / "out" / f"{name}.camera.json")
        assert torch.equal(camera.params, result.camera.params)
        assert camera.calibration.name == name
    for arguments, complaint in (
        ([*files, "-o", tmp_path / "out", "--name", "west"], "names one camera"),
        ([files[0], files[0], "-o", tmp_path / "out"], "would overwrite each other"),
        ([*files, "-o", files[0]], "cannot make this folder"),
        ([*files, "-o", tmp_path / "out", "--one-type", "--model", "opencv5"], "hybrid lens only"),
    ):
        with pytest.raises(KcalError, match=complaint):
            invoked("calibrate", *arguments)
    seen_by(2).subset(["v00", "v01"]).save(tmp_path / "right.obs.json")
    with pytest.raises(KcalError, match="1 of 2 cameras failed: right"):
        invoked("calibrate", *files, "-o", tmp_path / "half")
    assert [path.name for path in (tmp_path / "half").iterdir()] == ["left.camera.json"]
