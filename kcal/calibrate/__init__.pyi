# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Several cameras, several models
from kcal.calibrate.camera.calibrate import calibrate_cameras as calibrate_cameras
from kcal.calibrate.camera.at_setting import compare_models as compare_models

# Outliers
from kcal.calibrate.camera.result import OutlierRejection as OutlierRejection

# Judge a calibration
from kcal.calibrate.camera.trust import examine as examine

# Measured boards
from kcal.calibrate.hybrid.cameras_fit import measure_board as measure_board
from kcal.calibrate.hybrid.measured_board import load_measured_board as load_measured_board
from kcal.calibrate.hybrid.measured_board import save_measured_board as save_measured_board

# Calibrate with gradients
from kcal.calibrate.camera.layer import CalibrationLayer as CalibrationLayer
from kcal.calibrate.camera.layer import calibrate_views as calibrate_views
