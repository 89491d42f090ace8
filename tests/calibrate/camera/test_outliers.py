"""Wrong corners and views are found, listed and left out; good ones stay."""

from __future__ import annotations

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, observe, pixels_of
from torch import Tensor

from kcal.calibrate.camera.calibrate import CalibrationOptions, CameraCalibrationResult, calibrate_camera
from kcal.calibrate.camera.checks import OutlierRejection, corners_beyond
from kcal.errors import InputError

REJECT = CalibrationOptions(model="opencv5", reject=OutlierRejection())
NOISE = 0.1


def scene(count: int = 14, seed: int = 2) -> Tensor:
    truth = camera()
    return pixels_of(truth, motions(truth, count, 5), noise=NOISE, seed=seed)


def spoil(pixels: Tensor, seed: int, share: float = 0.02) -> tuple[Tensor, set[tuple[int, int]]]:
    """A share of the corners moved by 5 to 60 pixels in any direction that does not lead out of the image."""
    generator = torch.Generator().manual_seed(seed)
    wrong = torch.rand(pixels.shape[:2], generator=generator) < share
    turn = 6.2831853 * torch.rand(pixels.shape[:2], generator=generator, dtype=torch.float64)
    length = 5.0 + 55.0 * torch.rand(pixels.shape[:2], generator=generator, dtype=torch.float64)
    shift = torch.stack([length * torch.cos(turn), length * torch.sin(turn)], -1)
    size = torch.tensor(SIZE, dtype=torch.float64)
    stays = ((pixels + shift >= 0) & (pixels + shift <= size - 1)).all(-1, keepdim=True)
    moved = torch.where(wrong[..., None], pixels + torch.where(stays, shift, -shift), pixels)
    return moved, {(i, n) for i, n in wrong.nonzero().tolist()}


def listed(result: CameraCalibrationResult) -> set[tuple[int, int]]:
    return {(int(corner.view[1:]), corner.corner) for corner in result.rejected_corners}


def test_normal_noise_loses_one_corner_in_a_hundred_calibrations() -> None:
    """A hundredth of a corner is expected beyond the limit in each; 7 of 300 or more have a chance of 3 %."""
    generator = torch.Generator().manual_seed(0)
    draws = torch.randn(300, 14, 42, 2, generator=generator, dtype=torch.float64)
    assert sum(int(corners_beyond(NOISE * draw).sum()) for draw in draws) < 7


def assert_same_solution(one: CameraCalibrationResult, other: CameraCalibrationResult) -> None:
    """Within a ten-thousandth of each σ: vector kernels round by where memory lies, and iterations stop accordingly."""
    moved = (one.camera.params - other.camera.params).abs()
    for name, change in zip(one.camera.names, moved.tolist(), strict=True):
        assert change <= 1e-4 * (one.sigma.get(name) or 0.0), name
    assert one.rms == pytest.approx(other.rms, rel=1e-9)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_clean_data_keep_all_corners_and_the_same_result(seed: int) -> None:
    seen = observe(scene(seed=seed))
    result, plain = calibrate_camera(seen, REJECT), calibrate_camera(seen, CalibrationOptions(model="opencv5"))
    assert result.rejected_corners == ()
    assert result.rejected_views == ()
    assert result.rejected_share == 0.0
    assert_same_solution(result, plain)
    assert plain.warnings == ()


@pytest.mark.parametrize(("model", "views", "seed"), [("opencv5", 14, 4), ("opencv5", 14, 5), ("opencv8", 25, 4)])
def test_gross_outliers_are_found_and_move_nothing(model: str, views: int, seed: int) -> None:
    """By more than a σ. 14 views do not determine the eight coefficients (flat valley), so that one has more views."""
    clean = scene(views)
    pixels, wrong = spoil(clean, seed)
    assert len(wrong) >= 5
    options = CalibrationOptions(weak_prior=None, model=model, reject=OutlierRejection())
    result = calibrate_camera(observe(pixels), options)
    reference = calibrate_camera(observe(clean), CalibrationOptions(weak_prior=None, model=model))
    assert listed(result) == wrong
    assert result.rejected_share == pytest.approx(len(wrong) / (views * 42))
    before, after = (dict(zip(r.camera.names, r.camera.params.tolist(), strict=True)) for r in (reference, result))
    for name, sigma in reference.sigma.items():
        assert sigma is not None
        assert abs(after[name] - before[name]) < sigma, name
    for corner in result.rejected_corners:
        i, n = int(corner.view[1:]), corner.corner
        assert bool(result.residuals[i, n].isnan().all())
        assert corner.residual == pytest.approx(float((pixels - clean)[i, n].norm()), abs=1.0)
        assert "noise explains" in corner.reason


def test_the_result_is_that_of_the_data_that_are_left() -> None:
    pixels, wrong = spoil(scene(), 4)
    result = calibrate_camera(observe(pixels), REJECT)
    for i, n in wrong:
        pixels[i, n] = torch.nan
    again = calibrate_camera(observe(pixels), CalibrationOptions(model="opencv5"))
    assert_same_solution(result, again)
    assert result.sigma == pytest.approx(again.sigma, rel=1e-5)


def test_a_view_of_another_board_is_left_out_whole() -> None:
    """Its corners are those of a board whose squares are a tenth longer than wide."""
    truth = camera()
    poses = motions(truth, 14, 5)
    pixels = pixels_of(truth, poses, noise=NOISE, seed=2)
    stretched = BOARD.points * torch.tensor([1.1, 1.0, 1.0], dtype=torch.float64)
    # Curved as well, or the pose would take most of it.
    stretched = stretched + 0.006 * torch.sin(40.0 * BOARD.points[:, [1, 0, 2]])
    pixels[6] = truth.project(stretched @ poses[0][6].T + poses[1][6])[0]
    result = calibrate_camera(observe(pixels), REJECT)
    assert [view.view for view in result.rejected_views] == ["v06"]
    assert result.rejected_views[0].corners == 42
    assert result.rejected_share >= 1 / 14
    assert bool(result.per_view_rms[6].isnan())
    assert bool(result.cam_from_board_rotation[6].isnan().all())
    assert bool(result.per_view_rms[torch.arange(14) != 6].isfinite().all())
    assert result.rms == pytest.approx(NOISE * 2**0.5, rel=0.15)


def test_too_much_is_refused() -> None:
    pixels, _ = spoil(scene(), 6, share=0.2)
    with pytest.raises(InputError, match=r"more than the 10 % that may be left out"):
        calibrate_camera(observe(pixels), REJECT)
    with pytest.raises(InputError, match="limit must be between"):
        OutlierRejection(limit=0.5)


def test_without_rejection_a_warning_names_the_worst_corner() -> None:
    pixels = scene()
    pixels[3, 17] += 5.0
    result = calibrate_camera(observe(pixels), CalibrationOptions(model="opencv5"))
    assert any("corner 17 of view v03" in text for text in result.warnings)
    assert result.rejected_corners == ()
