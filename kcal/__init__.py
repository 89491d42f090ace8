"""kcal: camera calibration and long-range stereo localization for PyTorch.

The names below are loaded when they are first used, so that `import kcal` and `kcal --help` do not wait for torch.
Everything else is found in its folder, for example `kcal.locate.positions.locate`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera, calibrate_cameras
    from kcal.calibrate.camera.layer import CalibrationLayer
    from kcal.calibrate.lensfit.hybrid import HybridOptions, calibrate_hybrid
    from kcal.calibrate.rig.drift import measure_drift
    from kcal.calibrate.rig.from_boards import calibrate_rig
    from kcal.calibrate.rig.solve import RigOptions, solve_rig
    from kcal.calibrate.rig.sources import RigData
    from kcal.corners.board import Board
    from kcal.corners.detect import detect_images
    from kcal.corners.observations import Observations
    from kcal.errors import KcalError
    from kcal.io.camera_file import load_camera, save_camera
    from kcal.io.rig_file import load_rig, save_rig
    from kcal.lens.bake import bake
    from kcal.lens.camera import Camera
    from kcal.lens.hybrid import HybridCamera
    from kcal.lens.images import Undistort, undistort_maps
    from kcal.lens.lookup import LookupCamera
    from kcal.lens.model import LensModel
    from kcal.lens.modules import Unproject
    from kcal.lens.pinhole import new_pinhole
    from kcal.lens.rig import StereoRig
    from kcal.locate.covariances import RigCovariance
    from kcal.locate.geodesy import Origin
    from kcal.locate.localizer import StereoLocalizer
    from kcal.locate.multiview import TriangulateViews
    from kcal.locate.stereo import Triangulate
    from kcal.nets.inverse import InverseNet
    from kcal.nets.inverse_fit import train_inverse
    from kcal.solve.lm import LevenbergMarquardt, LMOptions

__version__ = "0.1.0"

__all__ = [
    "Board",
    "CalibrationLayer",
    "CalibrationOptions",
    "Camera",
    "HybridCamera",
    "HybridOptions",
    "InverseNet",
    "KcalError",
    "LMOptions",
    "LensModel",
    "LevenbergMarquardt",
    "LookupCamera",
    "Observations",
    "Origin",
    "RigCovariance",
    "RigData",
    "RigOptions",
    "StereoLocalizer",
    "StereoRig",
    "Triangulate",
    "TriangulateViews",
    "Undistort",
    "Unproject",
    "bake",
    "calibrate_camera",
    "calibrate_cameras",
    "calibrate_hybrid",
    "calibrate_rig",
    "detect_images",
    "load_camera",
    "load_rig",
    "measure_drift",
    "new_pinhole",
    "save_camera",
    "save_rig",
    "solve_rig",
    "train_inverse",
    "undistort_maps",
]

_HOME = {
    "Board": "kcal.corners.board",
    "CalibrationLayer": "kcal.calibrate.camera.layer",
    "CalibrationOptions": "kcal.calibrate.camera.calibrate",
    "Camera": "kcal.lens.camera",
    "HybridCamera": "kcal.lens.hybrid",
    "HybridOptions": "kcal.calibrate.lensfit.hybrid",
    "InverseNet": "kcal.nets.inverse",
    "KcalError": "kcal.errors",
    "LMOptions": "kcal.solve.lm",
    "LensModel": "kcal.lens.model",
    "LevenbergMarquardt": "kcal.solve.lm",
    "LookupCamera": "kcal.lens.lookup",
    "Observations": "kcal.corners.observations",
    "Origin": "kcal.locate.geodesy",
    "RigCovariance": "kcal.locate.covariances",
    "RigData": "kcal.calibrate.rig.sources",
    "RigOptions": "kcal.calibrate.rig.solve",
    "StereoLocalizer": "kcal.locate.localizer",
    "StereoRig": "kcal.lens.rig",
    "Triangulate": "kcal.locate.stereo",
    "TriangulateViews": "kcal.locate.multiview",
    "Undistort": "kcal.lens.images",
    "Unproject": "kcal.lens.modules",
    "bake": "kcal.lens.bake",
    "calibrate_camera": "kcal.calibrate.camera.calibrate",
    "calibrate_cameras": "kcal.calibrate.camera.calibrate",
    "calibrate_hybrid": "kcal.calibrate.lensfit.hybrid",
    "calibrate_rig": "kcal.calibrate.rig.from_boards",
    "detect_images": "kcal.corners.detect",
    "load_camera": "kcal.io.camera_file",
    "load_rig": "kcal.io.rig_file",
    "measure_drift": "kcal.calibrate.rig.drift",
    "new_pinhole": "kcal.lens.pinhole",
    "save_camera": "kcal.io.camera_file",
    "save_rig": "kcal.io.rig_file",
    "solve_rig": "kcal.calibrate.rig.solve",
    "train_inverse": "kcal.nets.inverse_fit",
    "undistort_maps": "kcal.lens.images",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'kcal' has no attribute {name!r}")
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
