# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Several cameras, several models
from kcal.calibrate.camera.calibrate import calibrate_cameras as calibrate_cameras
from kcal.calibrate.camera.result import SharedBoard as SharedBoard
from kcal.calibrate.camera.at_setting import compare_models as compare_models
from kcal.calibrate.camera.at_setting import ComparisonResult as ComparisonResult

# Zoom and focus
from kcal.calibrate.camera.at_setting import camera_at_setting as camera_at_setting
from kcal.calibrate.camera.at_setting import InterpolatedCamera as InterpolatedCamera

# Outliers
from kcal.calibrate.camera.result import OutlierRejection as OutlierRejection
from kcal.calibrate.camera.result import RejectedCorner as RejectedCorner
from kcal.calibrate.camera.result import RejectedView as RejectedView

# Judge a calibration
from kcal.calibrate.camera.trust import summarize as summarize
from kcal.calibrate.camera.trust import CalibrationSummary as CalibrationSummary
from kcal.calibrate.camera.trust import examine as examine
from kcal.calibrate.camera.trust import Examination as Examination
from kcal.calibrate.camera.trust import HalvesDifference as HalvesDifference
from kcal.calibrate.camera.trust import PlainLens as PlainLens
from kcal.calibrate.camera.trust import ResidualStructure as ResidualStructure
from kcal.calibrate.camera.interval_check import interval_check as interval_check
from kcal.calibrate.camera.interval_check import IntervalCheck as IntervalCheck
from kcal.calibrate.camera.interval_check import simulated_refits as simulated_refits
from kcal.calibrate.camera.interval_check import Refit as Refit
from kcal.calibrate.camera.interval_check import against_capture as against_capture

# Measured boards
from kcal.calibrate.hybrid.cameras_fit import measure_board as measure_board
from kcal.calibrate.hybrid.measured_board import MeasuredBoard as MeasuredBoard
from kcal.calibrate.hybrid.measured_board import load_measured_board as load_measured_board
from kcal.calibrate.hybrid.measured_board import save_measured_board as save_measured_board

# Calibrate with gradients
from kcal.calibrate.camera.layer import CalibrationLayer as CalibrationLayer
from kcal.calibrate.camera.layer import CalibratedViews as CalibratedViews
from kcal.calibrate.camera.layer import calibrate_views as calibrate_views
