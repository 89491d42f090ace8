"""Cameras between settings of zoom and focus: exact at settings, honest between them, refused beyond them."""

import dataclasses
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from calibrate_scenes import calibration_record, corner_pixels, observe
from scipy.interpolate import CubicSpline
from torch import Tensor

from kcal import Camera, InputError, Rig, calibrate_camera, load_camera, load_rig, save_camera, save_rig
from kcal.calibrate.camera.at_setting import SettingSpline, _errors, camera_at_setting
from kcal.lens.calibration import BoardRecord, CameraCalibration, LensSetting
from kcal.lens.information import CameraInformation
from kcal.lens.uncertainty import pixel_covariance, pixel_errors

SIZE, SETTINGS = (640, 480), (0.0, 1.0, 2.0, 3.5, 5.0)
SIGMA = torch.tensor([0.8, 0.8, 0.5, 0.5, 0.0, 2e-3, 4e-3, 1e-4, 1e-4, 2e-3], dtype=torch.float64)


def parameters(focus: float) -> Tensor:
    """Of a lens that changes smoothly, and by 40 px of its focal length."""
    bent = math.sin(0.3 * focus)
    values = [520 + 40 * bent, 522 + 40 * bent, 320 + 0.5 * focus, 238 - 0.3 * focus, 0.0]
    return torch.tensor([*values, -0.2 + 0.03 * bent, 0.05 - 0.01 * bent, 1e-3, -5e-4, 0.0], dtype=torch.float64)


def calibrated(focus: float, random: torch.Generator | None = None, **known: Any) -> Camera:
    """One with errors of its covariance, or without."""
    wrong = 0.0 if random is None else SIGMA * torch.randn(10, generator=random, dtype=torch.float64)
    made = Camera(parameters(focus) + wrong, size=SIZE, model="opencv5")
    known = {"covariance": torch.diag(SIGMA**2), "name": f"f{focus:g}", **known}
    made.calibration = CameraCalibration(setting=LensSetting(values={"focus": focus}), **known)
    return made


def restated(made: Camera, **values: float) -> Camera:
    assert made.calibration is not None
    made.calibration = dataclasses.replace(made.calibration, setting=LensSetting(values=values))
    return made


def covariance_of(made: Camera) -> Tensor:
    assert made.calibration.covariance is not None
    return made.calibration.covariance


def places(made: Camera) -> Tensor:
    return made.grid(7, 5).reshape(-1, 2)


def test_a_setting_that_was_calibrated_is_that_camera() -> None:
    cameras = [calibrated(focus) for focus in SETTINGS]
    found = camera_at_setting(cameras, {"focus": 2.0})
    assert found.camera is cameras[2]
    assert (found.weights, found.interpolation_px) == ((0.0, 0.0, 1.0, 0.0, 0.0), 0.0)


@pytest.mark.slow
def test_beside_a_setting_nothing_jumps() -> None:
    """The general way, through a fit, gives the calibration as well: mean, covariance and entrance pupil."""
    first = calibrate_camera(observe(corner_pixels(8, 1, "opencv4", noise=0.1, seed=1))).camera
    cameras = [restated(first, focus=0.0)]
    for focus in (1.0, 2.0):
        moved = first.with_parameters(first.params * torch.where(torch.arange(len(first.params)) < 2, 1 + focus, 1.0))
        moved.calibration = first.calibration
        cameras.append(restated(moved, focus=focus))
    found = camera_at_setting(cameras, {"focus": 1e-7}).camera
    assert float(pixel_errors(found, first, places(first)).abs().max()) < 1e-4
    own, other = pixel_covariance(found, places(first)), pixel_covariance(first, places(first))
    assert torch.allclose(own, other, rtol=2e-3)
    index = first.names.index("pupil1")
    assert float(found.params[index]) == pytest.approx(float(first.params[index]), rel=1e-4)
    variances = [covariance_of(one)[index, index] for one in (found, first)]
    assert float(variances[0] / variances[1]) == pytest.approx(1.0, rel=0.02)


def test_weights_are_those_of_the_natural_cubic_spline() -> None:
    at = torch.tensor(SETTINGS, dtype=torch.float64)
    spline = SettingSpline(at[:, None])
    for place in (0.3, 2.2, 4.9):
        where = torch.tensor([place], dtype=torch.float64)
        curve = CubicSpline(at.numpy(), np.eye(len(at)), bc_type="natural")
        assert spline.weights(where).numpy() == pytest.approx(curve(place), abs=1e-12)
        assert spline.slopes(where)[:, 0].numpy() == pytest.approx(curve(place, 1), abs=1e-12)


def test_errors_of_the_curve_contain_it_in_95_percent() -> None:
    """Of paths of the prior, at a place between each two settings."""
    random = torch.Generator().manual_seed(1)
    fine = torch.randn(4000, 2001, generator=random, dtype=torch.float64).cumsum(1).cumsum(1)
    for count in (3, 4, 6):
        numbers = torch.linspace(0, 2000, count).round().long()
        spline = SettingSpline(numbers[:, None].double())
        for left, right in itertools.pairwise(numbers):
            at = int(left + right) // 2
            where = torch.tensor([float(at)], dtype=torch.float64)
            values = fine[:, numbers]
            error = values @ spline.weights(where) - fine[:, at]
            sigma = (values @ spline.errors(where).T).norm(dim=1)
            assert float((error.abs() < 1.96 * sigma).double().mean()) == pytest.approx(0.95, abs=0.012)


@pytest.mark.slow
def test_errors_go_through_as_they_do_by_differences() -> None:
    """Each camera's error, and that of the motor, move the interpolated camera as its covariance says."""
    settings = SETTINGS[::2]
    cameras = [calibrated(focus) for focus in settings]
    sigma = {"focus": 0.05}
    found = camera_at_setting(cameras, {"focus": 2.6}, setting_sigma=sigma)
    alone = camera_at_setting(cameras, {"focus": 2.6})
    exact = camera_at_setting(
        [calibrated(f, covariance=1e-12 * torch.diag(SIGMA**2)) for f in settings], {"focus": 2.6}
    )
    covariances = [covariance_of(one.camera) for one in (found, alone, exact)]
    by_calibrations, by_motor = covariances[1] - covariances[2], covariances[0] - covariances[1]
    expected = torch.zeros(10, 10, dtype=torch.float64)
    for i in range(len(settings)):
        for k in (0, 1, 2, 3, 5, 6, 7, 8, 9):
            changed = [calibrated(focus) for focus in settings]
            values = changed[i].params.clone()
            values[k] += 1e-3 * SIGMA[k]
            known = changed[i].calibration
            changed[i] = changed[i].with_parameters(values)
            changed[i].calibration = known
            moved = camera_at_setting(changed, {"focus": 2.6}).camera.params - alone.camera.params
            expected += 1e6 * torch.outer(moved, moved)
    scale = SIGMA + (SIGMA == 0)
    assert float(((by_calibrations - expected) / scale / scale[:, None]).abs().max()) < 0.02
    # The motor was wrong at each calibration too.
    curve = CubicSpline(settings, [float(parameters(focus)[0]) for focus in settings], bc_type="natural")
    weights = torch.tensor([1.0, *found.weights]).double()
    moved = weights * torch.from_numpy(curve([2.6, *settings], 1)) * sigma["focus"]
    assert float(by_motor[0, 0]) == pytest.approx(float(moved.square().sum()), rel=0.1)


def test_one_board_is_wrong_at_all_settings_alike() -> None:
    """The focal length follows the board's size: errors of one board add, those of several average."""

    def known(focus: float) -> CameraInformation:
        # The board's size is known to 1 only by its prior, and the focal length plus that to 1e-3.
        return CameraInformation(
            slots=(0, 0, -1, -1, -1),
            estimate=torch.tensor([500.0 + focus, 0.0]).double(),
            rows=torch.tensor([[1e3, 1e3]]).double(),
            residuals=torch.zeros(1).double(),
            mean=torch.zeros(2).double(),
            sigma=torch.tensor([math.inf, 1.0]).double(),
        )

    def at(middle: float, columns: tuple[int, ...]) -> float:
        cameras = []
        for focus, count in zip((0.0, 1.0, 2.0, 3.0), columns, strict=True):
            made = Camera.build(focal=(500 + focus,) * 2, center=(320, 240), size=SIZE, model="pinhole")
            stood = LensSetting(values={"focus": focus})
            record = calibration_record(BoardRecord(columns=count, rows=6, square=0.05))
            made.calibration = CameraCalibration(information=known(focus), setting=stood, record=record)
            cameras.append(made)
        return float(camera_at_setting(cameras, {"focus": middle}).camera.calibration.covariance[0, 0].sqrt())

    # A larger board makes the focal length smaller, whatever signs a decomposition has.
    assert float(_errors(known(0.0))[1][0, 0]) == pytest.approx(-1.0)
    assert at(1.5, (7, 7, 7, 7)) == pytest.approx(1.0, rel=1e-3)
    assert at(1.5, (7, 7, 7, 8)) == pytest.approx(math.sqrt(2 * 0.575**2 + 2 * 0.075**2), rel=1e-3)


@pytest.mark.slow
def test_intervals_contain_the_truth() -> None:
    random, inside = torch.Generator().manual_seed(5), []
    for focus in torch.rand(20, generator=random, dtype=torch.float64) * 5.0:
        cameras = [calibrated(one, random) for one in SETTINGS]
        found = camera_at_setting(cameras, {"focus": float(focus)}).camera
        error = pixel_errors(found, Camera(parameters(float(focus)), size=SIZE, model="opencv5"), places(found))
        inside.append((error.abs() < 1.96 * pixel_covariance(found, places(found)).diagonal(0, -2, -1).sqrt()).double())
    assert 0.92 < float(torch.stack(inside).mean()) <= 0.995


def test_zoom_and_focus_together() -> None:
    cameras = []
    for zoom in (1.0, 1.5, 2.0):
        for focus in (0.0, 10.0):
            made = Camera.build(focal=(500 * zoom + focus,) * 2, center=(320, 240), size=SIZE, model="pinhole")
            made.calibration = CameraCalibration(covariance=torch.diag(torch.tensor([1.0, 1, 1, 1, 0])).double())
            cameras.append(restated(made, zoom=zoom, focus=focus))
    found = camera_at_setting(cameras, {"focus": 5.0, "zoom": 1.5})
    assert float(found.camera.focal[0]) == pytest.approx(755.0, rel=0.03)
    corner = {"focus": 5.0, "zoom": 1.9}
    with pytest.raises(InputError, match="does not lie between these calibrations"):
        camera_at_setting([*cameras[:4], cameras[4]], {"focus": 9.0, "zoom": 1.9})
    assert sum(camera_at_setting(cameras, corner).weights) == pytest.approx(1.0)
    with pytest.raises(InputError, match="change together"):
        camera_at_setting([cameras[0], restated(cameras[2], zoom=1.5, focus=5.0), cameras[5],
                           restated(cameras[4], zoom=1.25, focus=2.5)], corner)  # fmt: skip


@pytest.mark.parametrize(
    ("change", "setting", "sigma", "message"),
    [
        (lambda c: c, {"focus": 5.1}, {}, r"focus=5.1 is outside the calibrated focus of 0 to 5: a lens is not extra"),
        (lambda c: c, {"focus": math.nan}, {}, "focus=nan: a finite number"),
        (lambda c: c, {"zoom": 2.0}, {}, "f0: it states focus, but zoom is asked for"),
        (lambda c: c, {"focus": 2.5}, {"focus": -1.0}, "setting sigma focus=-1: a number, not negative"),
        (lambda c: c, {"focus": 2.5}, {"zoom": 1.0}, "setting sigma zoom=1: .* of one of focus"),
        (lambda c: c[:2], {"focus": 0.5}, {}, "2 cameras do not tell how the lens changes .* 3 are needed"),
        (lambda c: [*c, calibrated(1.0)], {"focus": 0.5}, {}, "f1 and f1 are at one setting: leave one of them out"),
        (lambda c: [*c, calibrated(1.0)], {"focus": 1.0}, {}, "f1 and f1 are at one setting: leave one of them out"),
        (lambda c: [*c, calibrated(4.0, covariance=None)], {"focus": 2.5}, {}, "f4: it has no error bars: calibrate"),
        (lambda c: [*c, Camera(parameters(4.0), size=SIZE)], {"focus": 2.5}, {}, "camera 6: it does not say at which"),
        (
            lambda c: [*c, Camera(parameters(4.0), size=(640, 481))],
            {"focus": 2.5},
            {},
            "640x481 px, that of f0 640x480",
        ),
        (lambda c: [*c, camera_at_setting(c, {"focus": 4.0}).camera], {"focus": 2.5}, {}, "it is interpolated itself"),
    ],
)
def test_refusals(change: Any, setting: dict[str, float], sigma: dict[str, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        camera_at_setting(change([calibrated(focus) for focus in SETTINGS]), setting, setting_sigma=sigma)


def test_a_setting_that_all_cameras_have() -> None:
    cameras = [restated(calibrated(focus), focus=focus, zoom=3.0) for focus in SETTINGS]
    found = camera_at_setting(cameras, {"focus": 2.5, "zoom": 3.0})
    assert found.weights == camera_at_setting([calibrated(f) for f in SETTINGS], {"focus": 2.5}).weights
    with pytest.raises(InputError, match=r"zoom=3.1 is outside the calibrated zoom of 3 to 3"):
        camera_at_setting(cameras, {"focus": 2.5, "zoom": 3.1})
    with pytest.raises(InputError, match="all cameras have one zoom"):
        camera_at_setting(cameras, {"focus": 2.5, "zoom": 3.0}, setting_sigma={"zoom": 0.1})


def test_files_keep_the_setting(tmp_path: Path) -> None:
    found = camera_at_setting([calibrated(focus) for focus in SETTINGS], {"focus": 2.5}).camera
    read = load_camera(save_camera(found, tmp_path / "camera.json"))
    assert read.calibration.setting == found.calibration.setting
    assert read.calibration.setting == LensSetting(
        values={"focus": 2.5}, interpolated_from=("f0", "f1", "f2", "f3.5", "f5")
    )
    assert torch.allclose(covariance_of(read), covariance_of(found))
    rig = Rig.pair(found, calibrated(1.0), torch.eye(3), torch.tensor([-10.0, 0, 0]))
    both = load_rig(save_rig(rig, tmp_path / "rig.json"))
    assert [one.calibration.setting.values for one in (both.left, both.right)] == [{"focus": 2.5}, {"focus": 1.0}]  # type: ignore[union-attr]
    with pytest.raises(InputError, match="each number needs a name"):
        LensSetting(values={})
