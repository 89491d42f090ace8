# ruff: noqa: I001
# Where each name is defined, for type checkers and for `door`; a comment begins a group of the reference page.

# Lens models
from kcal.lens.model import LensModel as LensModel
from kcal.lens.camera_parameters import ExtendedDistortion as ExtendedDistortion
from kcal.calibrate.camera.export import refit_camera as refit_camera
from kcal.lens.difference import camera_difference as camera_difference

# Images
from kcal.lens.images import Undistort as Undistort
from kcal.lens.images import UndistortImage as UndistortImage
from kcal.lens.images import undistort_maps as undistort_maps
from kcal.lens.views import cylinder_view as cylinder_view
from kcal.lens.views import pinhole_view as pinhole_view
from kcal.lens.views import looking as looking
from kcal.lens.images import StereoRectification as StereoRectification
from kcal.lens.camera_like import CameraRays as CameraRays
from kcal.lens.camera_conversions import ImageTransform as ImageTransform

# Error bars
from kcal.lens.uncertainty import pixel_covariance as pixel_covariance

# Calibration records
from kcal.lens.calibration import CameraCalibration as CameraCalibration
from kcal.lens.calibration import LensSetting as LensSetting

# Other programs
from kcal.io.formats import import_cameras as import_cameras
from kcal.io.format_prior import ceres_prior as ceres_prior
from kcal.calibrate.camera.export import export_cameras as export_cameras
from kcal.io.lookup_file import save_onnx as save_onnx

# Cameras of other makes, tables and learned starts
from kcal.lens.camera_like import CameraLike as CameraLike
from kcal.lens.baking import bake as bake
from kcal.io.lookup_file import load_lookup as load_lookup
from kcal.io.lookup_file import save_lookup as save_lookup
from kcal.lens.camera_like import Unproject as Unproject

# Rotations
from kcal.lens.pose import rotation_from_vector as rotation_from_vector
from kcal.lens.pose import vector_from_rotation as vector_from_rotation
