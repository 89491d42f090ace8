"""The default of `calibrate_camera`: no model to choose, honest error bars, outliers, and clear refusals."""

import functools
from pathlib import Path

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, observe, pixels_of
from torch import Tensor

from kcal import Camera, DegenerateError, InputError, Observations, load_camera
from kcal.calibrate.camera.advice import what_to_photograph
from kcal.calibrate.camera.calibrate import CalibrationOptions, CameraCalibrationResult, calibrate_camera
from kcal.calibrate.camera.checks import OutlierRejection
from kcal.calibrate.camera.trust import stored_options, summarize
from kcal.solve import LMOptions
from scripts.shared.captures import error_at_infinity

NOISE = 0.1


def truth(focal: float = 500.0) -> Camera:
    """Barrel distortion of opencv5, with square pixels."""
    params = camera("opencv5", focal).params.detach().clone()
    params[1] = params[0]
    return Camera(params, size=SIZE, model="opencv5")


@functools.cache
def capture(views: int = 20, seed: int = 4) -> tuple[Observations, Tensor]:
    pixels = pixels_of(truth(), motions(truth(), views, seed), noise=NOISE, seed=seed)
    return observe(pixels), pixels


@functools.cache
def calibrated() -> CameraCalibrationResult:
    return calibrate_camera(capture()[0])


def test_finds_the_camera_with_its_error_bars() -> None:
    result = calibrated()
    assert result.hybrid is not None
    assert result.noise == pytest.approx(NOISE, rel=0.1)
    brief = summarize(result)
    found = error_at_infinity(result.camera, truth())
    # Errors as large as they are said to be, in the middle and over the image.
    assert found.rms < 2.0 * brief.worst
    assert 0 < brief.center < brief.border <= brief.worst
    assert float(found.errors[14, 24].norm()) < 4.0 * brief.center
    assert 0 < brief.unreached < 0.5
    assert brief.pupil is not None
    assert abs(brief.pupil) < 4.0 * float(brief.pupil_sigma or 0.0)
    assert result.sigma["fx"] == pytest.approx(float(result.covariance[0, 0].sqrt()), rel=1e-12)
    assert "skew" not in result.sigma


@pytest.mark.slow
def test_is_the_same_every_time_and_travels_as_a_file(tmp_path: Path) -> None:
    result, again = calibrated(), calibrate_camera(capture()[0])
    assert torch.equal(result.camera.params, again.camera.params)
    camera = load_camera(result.save(tmp_path / "a.camera.json"))
    assert camera.fingerprint == result.camera.fingerprint
    scale = result.covariance.diagonal().sqrt().clamp_min(1e-300)
    # Once inverted from normal equations, once from their root.
    unit = (camera.calibration.information.covariance() - result.covariance) / scale / scale[:, None]
    assert float(unit.abs().max()) < 1e-6
    assert camera.calibration.record.noise == result.noise


def test_residuals_and_poses_belong_to_the_measured_board() -> None:
    result, (_, pixels) = calibrated(), capture()
    points = result.board_points @ result.cam_from_board_rotation.transpose(-1, -2)
    seen, valid = result.camera.project(points + result.cam_from_board_translation[:, None])
    assert bool(valid.all())
    torch.testing.assert_close(seen - pixels, result.residuals, rtol=0, atol=1e-9)


def test_exact_boards_stay_as_they_are() -> None:
    # Motions would explain some of what an exact board leaves.
    result = calibrate_camera(capture()[0], CalibrationOptions(board="exact", motion=False))
    assert torch.equal(result.board_points, BOARD.points)
    assert result.rms > calibrated().rms
    again = stored_options(result.camera)
    assert (again.board, again.motion, again.bending) == ("exact", False, True)
    assert stored_options(calibrated().camera).motion


def test_noise_free_corners() -> None:
    pixels = pixels_of(truth(), motions(truth(), 8, 2))
    result = calibrate_camera(observe(pixels))
    assert result.rms < 0.01
    assert error_at_infinity(result.camera, truth()).rms < 1.0


@pytest.mark.slow
def test_outliers_are_left_out_and_listed() -> None:
    _, clean = capture()
    pixels = clean.clone()
    pixels[3, 5] += torch.tensor([4.0, -3.0], dtype=torch.float64)
    pixels[11, 20, 0] += 6.0
    # A view whose corners were found one square off.
    pixels[7] = pixels[7].roll(1, 0)
    result = calibrate_camera(observe(pixels), CalibrationOptions(reject=OutlierRejection(limit=0.2)))
    assert {view.view for view in result.rejected_views} == {"v07"}
    assert {("v03", 5), ("v11", 20)} <= {(corner.view, corner.corner) for corner in result.rejected_corners}
    assert len(result.rejected_corners) <= 4
    assert bool(result.residuals[7].isnan().all())
    assert bool(result.residuals[3, 5].isnan().all())
    assert error_at_infinity(result.camera, truth()).rms < 2.0 * summarize(calibrated()).worst


@pytest.mark.slow
def test_with_nothing_to_leave_out_the_camera_is_the_plain_one() -> None:
    """Not that of the robust fit, by which outliers are looked for and whose error bars mean nothing."""
    found = calibrate_camera(capture()[0], CalibrationOptions(reject=OutlierRejection()))
    assert not found.rejected_corners
    assert not found.rejected_views
    torch.testing.assert_close(found.camera.params, calibrated().camera.params, rtol=0, atol=0)
    assert found.covariance is not None
    torch.testing.assert_close(found.covariance, calibrated().covariance, rtol=0, atol=0)


@pytest.mark.slow
def test_corners_weigh_by_their_covariances() -> None:
    seen, clean = capture()
    blurred = clean.clone()
    generator = torch.Generator().manual_seed(9)
    blurred[::2] += 1.0 * torch.randn(blurred[::2].shape, generator=generator, dtype=torch.float64)
    sizes = [1.0 + NOISE**2 if i % 2 == 0 else NOISE**2 for i in range(len(blurred))]
    with_size = tuple(
        view.model_copy(update={"covariance": tuple((size, 0.0, size) for _ in view.pixels)})
        for view, size in zip(observe(blurred).views, sizes, strict=True)
    )
    weighted = calibrate_camera(seen.model_copy(update={"views": with_size}))
    plain = calibrate_camera(observe(blurred))
    assert weighted.weighted_rms is not None
    assert plain.weighted_rms is None
    assert error_at_infinity(weighted.camera, truth()).rms < error_at_infinity(plain.camera, truth()).rms
    assert float(weighted.sigma["fx"] or 0.0) < float(plain.sigma["fx"] or 0.0)


def test_views_parallel_to_the_image_do_not_determine_the_focal_length() -> None:
    poses = torch.eye(3, dtype=torch.float64).expand(6, 3, 3)
    shifts = torch.tensor([[0.02 * i - 0.2, 0.01 * i - 0.15, 0.6] for i in range(6)], dtype=torch.float64)
    with pytest.raises((DegenerateError, InputError)):
        calibrate_camera(observe(pixels_of(truth(), (poses, shifts), noise=NOISE)))


@pytest.mark.parametrize(
    "given",
    [
        {"board_warp": True},
        {"fixed": {"cx": None}},
        {"tied": (("fx", "fy"),)},
        {"free": ("skew",)},
        {"priors": {"fx": (500.0, 5.0)}},
        {"weak_prior": 0.1},
        {"weak_prior": None},
        {"solver": LMOptions(max_iterations=7)},
    ],
)
def test_options_of_parametric_models_are_refused(given: dict[str, object]) -> None:
    with pytest.raises(InputError, match=f"{next(iter(given))} cannot be combined"):
        CalibrationOptions(**given)  # type: ignore[arg-type]


def test_other_refusals() -> None:
    with pytest.raises(InputError, match="printed"):
        CalibrationOptions(board="flat")  # type: ignore[arg-type]
    with pytest.raises(InputError, match='write model="hybrid"'):
        CalibrationOptions(model=calibrated().camera.model)


def test_advice_is_about_its_views() -> None:
    """These have no roll, are tilted enough, and fill the image."""
    found = calibrated()
    assert found.advice == what_to_photograph(found.observations, found.camera, found.cam_from_board_rotation)
    assert any("roll the board" in text for text in found.advice)
