# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Cameras and rigs
from kcal.lens.camera import Camera as Camera
from kcal.lens.rig import Rig as Rig
from kcal.io.camera_file import load_camera as load_camera
from kcal.io.camera_file import save_camera as save_camera
from kcal.io.rig_file import load_rig as load_rig
from kcal.io.rig_file import save_rig as save_rig

# Boards and observations
from kcal.corners.board import Board as Board
from kcal.corners.observations import View as View
from kcal.corners.observations import Observations as Observations
from kcal.corners.detect import detect as detect

# Calibrate a camera
from kcal.calibrate.camera.calibrate import calibrate_camera as calibrate_camera
from kcal.calibrate.camera.result import CalibrationOptions as CalibrationOptions

# Solve a rig
from kcal.calibrate.rig.solve import calibrate_rig as calibrate_rig
from kcal.calibrate.rig.solve import solve_rig as solve_rig
from kcal.calibrate.rig.solve import RigOptions as RigOptions
from kcal.calibrate.rig.sources import RigData as RigData
from kcal.calibrate.rig.sources import Boards as Boards
from kcal.calibrate.rig.marks import Landmarks as Landmarks
from kcal.calibrate.rig.marks import Features as Features
from kcal.calibrate.rig.sources import Baseline as Baseline
from kcal.calibrate.rig.sources import MeasuredPosition as MeasuredPosition

# Locate
from kcal.locate.localizer import Localizer as Localizer
from kcal.locate.points import locate_points as locate_points
from kcal.locate.stereo import PositionStatus as PositionStatus
from kcal.lens.rig import Origin as Origin

# Errors
from kcal.errors import KcalError as KcalError
from kcal.errors import InputError as InputError
from kcal.errors import DegenerateError as DegenerateError
from kcal.errors import FileError as FileError
from kcal.errors import KcalWarning as KcalWarning

# Namespaces
from kcal import lens as lens
from kcal import corners as corners
from kcal import calibrate as calibrate
from kcal import rig as rig
from kcal import locate as locate
from kcal import track as track
from kcal import report as report
from kcal import solve as solve
from kcal import stars as stars
from kcal import nets as nets

__version__: str
