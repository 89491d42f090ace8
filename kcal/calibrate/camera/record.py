"""Error bars and history of a finished calibration, in the form that travels with the camera and is stored."""

from __future__ import annotations

import torch

from kcal.calibrate.camera.options import CameraCalibrationResult
from kcal.corners.observations import Observations
from kcal.io.camera_file import provenance
from kcal.lens.calibration import BoardRecord, CalibrationRecord, CameraCalibration, Exclusion


def camera_calibration(result: CameraCalibrationResult, observations: Observations) -> CameraCalibration:
    """Error bars and history of `result.camera`; `observations` are those that the camera was calibrated from."""
    warp, board = result.board_warp, observations.board
    views = [Exclusion(name=view.view, reason=view.reason) for view in result.rejected_views]
    corners = [Exclusion(name=f"{c.view} corner {c.corner}", reason=c.reason) for c in result.rejected_corners]
    rms = zip(observations.names, result.per_view_rms.tolist(), strict=True)
    left_out = {view.view for view in result.rejected_views}
    record = CalibrationRecord(
        rms=result.rms,
        views=len(observations.views) - len(left_out),
        points=int(torch.isfinite(result.residuals[..., 0]).sum()),
        per_view_rms={name: value for name, value in rms if name not in left_out},
        excluded=(*views, *corners),
        board=BoardRecord(columns=board.columns, rows=board.rows, square=board.square),
        board_warp=None if warp is None else (float(warp[0]), float(warp[1])),
        stop_reason=result.status.message,
        iterations=result.iterations,
        **provenance(),
    )
    return CameraCalibration(
        sigma={name: result.sigma.get(name) for name in result.camera.names},
        covariance=result.covariance if bool(result.covariance.isfinite().all()) else None,
        record=record,
    )
