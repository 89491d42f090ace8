"""A result saves itself: the camera, its error bars, and how it was calibrated."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from calibrate_scenes import camera, motions, observe, pixels_of

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.camera.checks import OutlierRejection
from kcal.io.camera_file import CameraFile, load_camera, save_camera


def test_all_that_is_known_is_in_the_file(tmp_path: Path) -> None:
    truth = camera()
    pixels = pixels_of(truth, motions(truth, 8, 2))
    pixels = pixels + 0.1 * torch.randn(pixels.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    pixels[2, 7] += 30.0
    seen = observe(pixels)
    result = calibrate_camera(seen, CalibrationOptions(model="opencv5", reject=OutlierRejection()))
    assert [corner.view for corner in result.rejected_corners] == [seen.names[2]]

    path = result.save(tmp_path / "left.camera.json", name="left", source="left.obs.json")
    file = CameraFile.load(path)
    assert file.name == "left"
    assert file.camera().fingerprint == result.camera.fingerprint
    assert file.standard_deviations is not None
    assert {name: file.standard_deviations[name] for name in result.sigma} == result.sigma
    stored = file.covariance_matrix()
    assert stored is not None
    assert result.information is not None
    assert torch.equal(stored, result.information.covariance())
    # Once inverted from normal equations, once from their root.
    scale = result.covariance.diagonal().sqrt().clamp_min(1e-300)
    assert float(((stored - result.covariance) / scale / scale[:, None]).abs().max()) < 1e-6
    record = file.calibration
    assert record is not None
    assert (record.rms, record.views, record.points) == (result.rms, 8, int(pixels.shape[0] * pixels.shape[1]) - 1)
    assert list(record.per_view_rms) == list(seen.names)
    assert record.excluded == result.excluded
    assert record.excluded[0].name == f"{seen.names[2]} corner 7"
    assert record.observations == "left.obs.json"
    # A board that was taken as ordered was not measured.
    assert record.board_deviation is None

    # The camera itself carries all of it, until its parameters change.
    carried = load_camera(save_camera(result.camera, tmp_path / "again.camera.json")).calibration
    assert carried is not None
    assert carried.record is not None
    assert carried.record.excluded == result.excluded
    assert carried.sigma is not None
    assert carried.sigma["fx"] == result.sigma["fx"]


@pytest.mark.parametrize("options", [{"model": "opencv5"}, {"model": "opencv5", "board_warp": True}, {}])
def test_how_the_board_deviates_is_kept_where_it_was_solved(tmp_path: Path, options: dict) -> None:
    """Of a warped board and of a printed one; a board that was taken as exact has nothing to keep."""
    truth = camera()
    pixels = pixels_of(truth, motions(truth, 8, 2))
    seen = observe(pixels + 0.1 * torch.randn(pixels.shape, generator=torch.Generator().manual_seed(3)))
    result = calibrate_camera(seen, CalibrationOptions(**options))
    path = result.save(tmp_path / "a.camera.json")
    record = CameraFile.load(path).calibration
    assert record is not None
    if options == {"model": "opencv5"}:
        assert record.board_deviation is None
        return
    assert record.board_deviation is not None
    moved = result.board_points - seen.board.points
    assert record.board_deviation == tuple((x, y, z) for x, y, z in moved.tolist())
    assert float(moved.abs().max()) > 0
