# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Verdicts
from kcal.report.judge_camera import camera_verdict as camera_verdict
from kcal.report.judge_camera import stored_verdict as stored_verdict
from kcal.report.judge_rig import rig_verdict as rig_verdict
from kcal.report.verdict import Requirement as Requirement
from kcal.report.verdict import Verdict as Verdict
from kcal.report.verdict import RangeAnswer as RangeAnswer
from kcal.report.verdict import Finding as Finding
from kcal.report.verdict_page import save_verdict_page as save_verdict_page

# Pictures
from kcal.report.calibration import calibration_figure as calibration_figure
from kcal.report.calibration import save_calibration_picture as save_calibration_picture
from kcal.report.rig import rig_figure as rig_figure
from kcal.report.rig import save_rig_picture as save_rig_picture
from kcal.report.positions import positions_figure as positions_figure
from kcal.report.positions import save_positions_picture as save_positions_picture
from kcal.report.map_page import save_map as save_map
from kcal.report.calibration import save_gallery as save_gallery
from kcal.report.calibration import FailedImage as FailedImage
from kcal.report.calibration import save_coverage as save_coverage
from kcal.report.calibration import save_board_picture as save_board_picture
from kcal.report.calibration import save_difference_picture as save_difference_picture
from kcal.report.calibration import save_interval_picture as save_interval_picture
from kcal.report.positions import save_budget_picture as save_budget_picture
from kcal.report.positions import siting_figure as siting_figure
from kcal.report.positions import save_siting_picture as save_siting_picture
