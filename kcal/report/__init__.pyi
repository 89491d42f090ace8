# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Verdicts
from kcal.report.judge_camera import camera_verdict as camera_verdict
from kcal.report.judge_rig import rig_verdict as rig_verdict
from kcal.report.verdict import Requirement as Requirement

# Pictures
from kcal.report.figures import save_picture as save_picture
from kcal.report.calibration import calibration_figure as calibration_figure
from kcal.report.rig import rig_figure as rig_figure
from kcal.report.positions import positions_figure as positions_figure
from kcal.report.map_page import save_map as save_map
from kcal.report.view import log_view as log_view
from kcal.report.view import save_view as save_view
