"""What kcal promises to its users at the top level."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import inspect
import subprocess
import sys
import typing
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing
import pydantic
import pytest

import kcal
from kcal.locate.max_likelihood import PointFit

# Taking a name away breaks users; adding one is a promise. Either is a line here and one in CHANGELOG.md.
PUBLIC = {
    "Association",
    "AssociationOptions",
    "Baseline",
    "Board",
    "BoardModes",
    "BoardRecord",
    "Boards",
    "BudgetErrors",
    "CalibratedViews",
    "CalibrationLayer",
    "CalibrationOptions",
    "CalibrationRecord",
    "CalibrationSummary",
    "Camera",
    "CameraCalibration",
    "CameraCalibrationResult",
    "CameraInformation",
    "Examination",
    "HalvesDifference",
    "ParaxialFocal",
    "ResidualStructure",
    "examine",
    "camera_verdict",
    "paraxial_focal",
    "stored_verdict",
    "rig_verdict",
    "Finding",
    "RangeAnswer",
    "Requirement",
    "Verdict",
    "save_verdict_page",
    "CameraDifference",
    "CameraPose",
    "ComparisonResult",
    "DegenerateError",
    "Detection",
    "Detections",
    "DisparityOptions",
    "Drift",
    "DriftEffect",
    "Exclusion",
    "ExportedCameras",
    "FailedImage",
    "Failure",
    "Features",
    "FieldModes",
    "FileError",
    "GaussianModes",
    "Geoid",
    "HybridFit",
    "HybridForm",
    "HybridState",
    "Readout",
    "ImageTransform",
    "ImportedCameras",
    "InputError",
    "InverseFit",
    "InverseNet",
    "InverseNetOptions",
    "ItemResidual",
    "KcalError",
    "LMOptions",
    "Landmarks",
    "LearnedStart",
    "LensModel",
    "LevenbergMarquardt",
    "Localization",
    "Located",
    "LookupCamera",
    "MarkedLandmarks",
    "Marks",
    "MatchOptions",
    "MatchStatus",
    "Matches",
    "MeasuredBoard",
    "MeasuredPosition",
    "Misfit",
    "Mounting",
    "Observations",
    "GroundPlaces",
    "Origin",
    "level_ground",
    "locate_on_ground",
    "terrain",
    "Tracks",
    "TrackOptions",
    "Tracker",
    "SmoothedTrack",
    "ObjectPairs",
    "Motion",
    "TrackStates",
    "ClockPrior",
    "ClockEstimate",
    "NetworkModes",
    "ObjectDisparities",
    "ObjectDisparity",
    "OutlierRejection",
    "Position",
    "PositionColumns",
    "PositionStatus",
    "PriorFamilies",
    "RangeError",
    "RefinedPoint",
    "RefittedCamera",
    "RejectedCorner",
    "RejectedView",
    "RigCalibration",
    "RigCovariance",
    "RigData",
    "RigOptions",
    "RigResult",
    "RigSource",
    "RobustLoss",
    "Sensitivity",
    "SharedBoard",
    "Sides",
    "SolverStatus",
    "SourceResidual",
    "Spline",
    "StereoLocalizer",
    "StereoRig",
    "Survey",
    "Triangulate",
    "TriangulateViews",
    "Triangulation",
    "TurnedBoard",
    "Undistort",
    "UndistortImage",
    "UndistortMaps",
    "Unproject",
    "View",
    "Viewpoint",
    "ViewsResult",
    "ZernikeModes",
    "associate",
    "bake",
    "calibrate_camera",
    "calibrate_cameras",
    "calibrate_rig",
    "calibration_figure",
    "camera_difference",
    "camera_positions",
    "check_rig",
    "circular_error",
    "compare_models",
    "detect_board",
    "detect_images",
    "detect_video",
    "drift_effect",
    "enu_from_cam",
    "enu_to_geodetic",
    "expand_images",
    "export_cameras",
    "find_geoid",
    "geodetic_to_enu",
    "image_sigma",
    "import_cameras",
    "import_corners",
    "import_survey",
    "load_camera",
    "load_lookup",
    "load_measured_board",
    "load_rig",
    "locate_points",
    "match_landmarks",
    "match_points",
    "measure_board",
    "measure_drift",
    "mounting_covariance",
    "new_pinhole",
    "pair_by_name",
    "pair_objects",
    "paired_boards",
    "pixel_covariance",
    "projection_sigma",
    "placed_rig",
    "planned_rig",
    "position_errors",
    "positions_figure",
    "projection_covariance",
    "range_errors",
    "read_features",
    "read_gray",
    "read_marks",
    "read_pairs",
    "read_survey",
    "read_truth",
    "refine_point",
    "refit_camera",
    "relocked",
    "rig_figure",
    "save_board",
    "save_board_picture",
    "save_budget_picture",
    "save_calibration_picture",
    "save_camera",
    "save_coverage",
    "save_difference_picture",
    "save_gallery",
    "save_lookup",
    "save_map",
    "save_measured_board",
    "save_onnx",
    "save_positions_picture",
    "save_rig",
    "save_rig_picture",
    "solve_rig",
    "summarize",
    "train_inverse",
    "triangulated_sides",
    "true_from_grid",
    "undistort_maps",
    "write_positions",
}
# What functions return, and blocks of files: examples are those of the functions.
RECORDS = {
    "Examination",
    "Finding",
    "HalvesDifference",
    "RangeAnswer",
    "ResidualStructure",
    "Association",
    "Baseline",
    "ClockEstimate",
    "ClockPrior",
    "GroundPlaces",
    "Motion",
    "SmoothedTrack",
    "TrackStates",
    "Tracks",
    "BoardRecord",
    "Boards",
    "BudgetErrors",
    "CalibratedViews",
    "CalibrationRecord",
    "CameraCalibrationResult",
    "CameraPose",
    "Detection",
    "Drift",
    "DriftEffect",
    "Exclusion",
    "ExportedCameras",
    "FailedImage",
    "Failure",
    "Features",
    "Geoid",
    "ImportedCameras",
    "InverseFit",
    "ItemResidual",
    "Landmarks",
    "LearnedStart",
    "Localization",
    "Located",
    "MarkedLandmarks",
    "Marks",
    "MatchStatus",
    "Matches",
    "MeasuredBoard",
    "MeasuredPosition",
    "Misfit",
    "NetworkModes",
    "ObjectDisparities",
    "ObjectDisparity",
    "ObjectPairs",
    "OutlierRejection",
    "Position",
    "PositionColumns",
    "PositionStatus",
    "RefinedPoint",
    "RejectedCorner",
    "RejectedView",
    "RigCalibration",
    "RigResult",
    "RigSource",
    "Sensitivity",
    "SharedBoard",
    "Sides",
    "SourceResidual",
    "Spline",
    "SolverStatus",
    "Survey",
    "Triangulation",
    "TurnedBoard",
    "UndistortMaps",
    "View",
    "Viewpoint",
    "ViewsResult",
}
# They write a picture or page of a whole result, or need a video, raster or observations: see the tests of their rooms.
WITHOUT_EXAMPLE = {
    "terrain",
    "FieldModes",
    "detect_video",
    "paired_boards",
    "read_pairs",
    "save_board_picture",
    "save_budget_picture",
    "save_calibration_picture",
    "save_coverage",
    "save_difference_picture",
    "save_gallery",
    "save_map",
    "save_positions_picture",
    "save_rig_picture",
}


def test_the_list() -> None:
    assert set(kcal.__all__) == PUBLIC
    assert len(kcal.__all__) == len(PUBLIC)
    assert set(dir(kcal)) >= PUBLIC


@pytest.mark.parametrize("name", sorted(PUBLIC))
def test_each_name(name: str) -> None:
    value = getattr(kcal, name)
    assert value is getattr(importlib.import_module(value.__module__), name)
    docstring = inspect.getdoc(value) or ""
    # Options are shown where they are used, and errors by the messages they carry.
    plain = dataclasses.is_dataclass(value) and name.endswith("Options")
    wanted = "Args:" if plain else "" if name.endswith("Error") or name in RECORDS | WITHOUT_EXAMPLE else "Example:"
    assert wanted in docstring
    assert len(docstring.splitlines()[0]) > 20


def named_types(annotation: object) -> set[type]:
    """The classes of kcal inside an annotation."""
    if isinstance(annotation, type) and not typing.get_origin(annotation):
        return {annotation} if annotation.__module__.startswith("kcal.") else set()
    return set().union(*(named_types(part) for part in typing.get_args(annotation)))


def signature_types(value: object) -> set[type]:
    """The classes of kcal that a function takes or returns, or that a class is made of."""
    if inspect.isclass(value) and not (
        dataclasses.is_dataclass(value) or issubclass(value, (tuple, pydantic.BaseModel))
    ):
        value = value.__init__
    # What lens/images imports for type checkers only.
    hints = typing.get_type_hints(value, localns={"NDArray": numpy.typing.NDArray, "np": np})
    return set().union(*(named_types(hint) for name, hint in hints.items() if not name.startswith("_")))


@pytest.mark.parametrize("name", sorted(name for name in PUBLIC if not name.endswith("Error")))
def test_every_type_in_a_public_signature_is_public(name: str) -> None:
    public = {getattr(kcal, name) for name in PUBLIC}
    assert {kind.__qualname__ for kind in signature_types(getattr(kcal, name)) - public} == set()


def test_a_type_that_is_not_public_is_seen() -> None:
    def function(fits: Sequence[PointFit | None]) -> kcal.Camera: ...

    assert {kind.__name__ for kind in signature_types(function)} == {"PointFit", "Camera"}


def test_type_checkers_see_the_same_names() -> None:
    """The stub is the one table: it must travel with the package."""
    stub = Path(kcal.__file__).with_suffix(".pyi")
    assert stub.is_file()
    assert '"__init__.pyi"' in (Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8")


def test_no_name_hides_a_folder() -> None:
    """`kcal.locate` is a folder; a function of that name would be replaced by it at the first import."""
    folders = {path.parent.name for path in Path(kcal.__file__).parent.glob("*/__init__.py")}
    assert folders.isdisjoint(PUBLIC)


def test_unknown_names() -> None:
    with pytest.raises(AttributeError, match="module 'kcal' has no attribute 'nothing'"):
        _ = kcal.nothing


def test_version() -> None:
    assert importlib.metadata.version("kcal") == kcal.__version__


@pytest.mark.parametrize("module", ["kcal", "kcal.cli.main"])
def test_import_is_light(module: str) -> None:
    code = (
        f"import sys, {module}; print(sorted({{'torch', 'cv2', 'numpy', 'skimage', 'matplotlib'}} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
