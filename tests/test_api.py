"""What kcal promises to its users: the names in `kcal` and its namespaces."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import inspect
import subprocess
import sys
import tomllib
import typing
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing
import pydantic
import pytest
import torch

import kcal
from kcal.lens.information import CameraInformation
from kcal.locate.max_likelihood import PointFit

# Taking a name away breaks users; adding one is a promise. Either is a line here and one in CHANGELOG.md.
PUBLIC = {
    "kcal": """
        Baseline Board Boards CalibrationOptions Camera CameraCalibrationResult DegenerateError Features
        FileError InputError KcalError KcalWarning Landmarks Located MeasuredPosition Observations Origin PositionStatus
        RigData RigOptions RigResult StereoLocalizer StereoRig View calibrate_camera calibrate_rig detect
        load_camera load_rig locate_points save_camera save_rig solve_rig
    """,
    "kcal.lens": """
        BoardRecord CalibrationRecord CameraCalibration CameraDifference CameraInformation CameraPose CameraRays
        Cylinder Exclusion StereoRectification cylinder_view looking pinhole_view pixel_errors pupil_shift ray_error
        ExportedCameras HybridForm ImageTransform ImportedCameras LearnedStart LensModel LookupCamera Misfit
        ParaxialFocal RefittedCamera Undistort UndistortImage
        UndistortMaps Unproject ZernikeModes bake camera_difference export_cameras image_sigma import_cameras
        load_lookup new_pinhole paraxial_focal pixel_covariance projection_sigma
        refit_camera rotation_from_vector save_lookup save_onnx undistort_maps
        vector_from_rotation LensSetting ExtendedDistortion
        CameraLike
    """,
    "kcal.corners": """
        Detection Failure MatchOptions MatchStatus Matches RefinedPoint detect_board detect_video expand_images
        import_corners match_points read_gray refine_point save_board RefineCorners Refined CornerStatus
    """,
    "kcal.calibrate": """
        CalibratedViews CalibrationLayer CalibrationSummary ComparisonResult Examination HalvesDifference
        IntervalCheck Refit against_capture interval_check simulated_refits
        MeasuredBoard OutlierRejection PlainLens RejectedCorner RejectedView ResidualStructure SharedBoard
        calibrate_cameras calibrate_views compare_models examine load_measured_board measure_board
        save_measured_board summarize camera_at_setting InterpolatedCamera
    """,
    "kcal.rig": """
        RasterError SkylineAttitude SkylineImage SkylineSource skyline_attitude skyline_source
        Effect Identity MovingControl MovingOptions MovingTrack Sighting match_moving
        read_sightings
        read_tracks CameraRig CameraRigCalibration load_camera_rig save_camera_rig station_mounting stations_of
        Drift DriftEffect ImagePair ItemResidual MarkedLandmarks Mounting PairCounts RigCalibration RigCovariance
        RigSource SceneMatches Sides Survey TurnedBoard Watched camera_positions check_rig drift_effect
        import_survey match_landmarks measure_drift mounting_covariance pair_by_name paired_boards placed_rig
        planned_rig read_features read_pairs read_survey relocked scene_features triangulated_sides
    """,
    "kcal.locate": """
        MultiViewLocalizer ViewMarks ViewsLocalization locate_views read_views
        Area RankedSite Raster Site SitingMap area_of rank_sites read_sites siting_map sites_of
        BudgetErrors DisparityRanges Geoid GroundPlaces Localization Marks RangeImage Position PositionColumns
        RangeError Sensitivity Triangulate TriangulateViews Triangulation Viewpoint ViewsResult
        circular_error enu_from_cam enu_to_geodetic
        find_geoid forgotten_yaw geodetic_to_enu level_ground locate_on_ground position_errors range_errors read_marks
        read_truth terrain true_from_grid write_positions
    """,
    "kcal.track": """
        Association AssociationOptions ClockEstimate ClockPrior Detections DisparityOptions Motion
        ObjectDisparities ObjectDisparity ObjectPairs SmoothedTrack TrackOptions TrackStates Tracker Tracks
        associate pair_objects group_objects ObjectViews PairBoxes BoxPairs
        PixelPairs matched_pixels
    """,
    "kcal.report": """
        FailedImage Finding RangeAnswer Requirement Verdict calibration_figure camera_verdict positions_figure
        rig_figure rig_verdict save_board_picture save_budget_picture save_calibration_picture save_coverage
        save_difference_picture save_gallery save_interval_picture save_map save_positions_picture
        save_rig_picture save_siting_picture save_verdict_page siting_figure
        stored_verdict
    """,
    "kcal.stars": """
        NightPlan PlannedStars StarCamera StarLens calibrate_by_stars planned_stars
        Agreement Air Attitude DetectedStars Identification NamedStars SkyView StarCatalog celestial_directions
        clock_doubts detect_stars identify moments_of name_stars observed_directions parse_time star_source
        StarSource
    """,
    "kcal.solve": """
        LMOptions LevenbergMarquardt RobustLoss SolverStatus
    """,
    "kcal.nets": """
        InverseFit InverseNet InverseNetOptions JointFit JointOptions ResidualNet train_inverse train_jointly
        FieldTraining NetworkModes
    """,
}
NAMES = [(door, name) for door, names in PUBLIC.items() for name in names.split()]
NAMESPACES = {door.removeprefix("kcal.") for door in PUBLIC} - {"kcal"}
# Types of attributes in which only those look who work on kcal.
INSIDE = {
    "Border",
    "SkylineFit",
    "GroundSurface",
    "FieldModes",
    "HybridFit",
    "BoardState",
    "Spline",
    "HistoryRow",
    "TurnModel",
}
# What functions return, and blocks of files: examples are those of the functions.
RECORDS = {
    "SkylineAttitude",
    "SkylineImage",
    "SkylineSource",
    "InterpolatedCamera",
    "Area",
    "RankedSite",
    "Raster",
    "SitingMap",
    "CameraRigCalibration",
    "ViewMarks",
    "ViewsLocalization",
    "IntervalCheck",
    "RangeImage",
    "Refit",
    "against_capture",
    "cylinder_view",
    "interval_check",
    "Attitude",
    "DetectedStars",
    "Identification",
    "NamedStars",
    "StarCamera",
    "StarLens",
    "PlannedStars",
    "StarSource",
    "moments_of",
    "Examination",
    "Finding",
    "HalvesDifference",
    "RangeAnswer",
    "PlainLens",
    "ResidualStructure",
    "Association",
    "BoxPairs",
    "PixelPairs",
    "Refined",
    "CornerStatus",
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
    "ImagePair",
    "ImportedCameras",
    "InverseFit",
    "ItemResidual",
    "JointFit",
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
    "ObjectDisparities",
    "ObjectDisparity",
    "ObjectPairs",
    "OutlierRejection",
    "Position",
    "PairCounts",
    "PositionColumns",
    "PositionStatus",
    "RefinedPoint",
    "RejectedCorner",
    "RejectedView",
    "RigCalibration",
    "RigResult",
    "RigSource",
    "Sensitivity",
    "SceneMatches",
    "SharedBoard",
    "Sides",
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
    "detect_video",
    "paired_boards",
    "read_pairs",
    "save_board_picture",
    "save_budget_picture",
    "save_calibration_picture",
    "save_coverage",
    "save_difference_picture",
    "save_gallery",
    "save_interval_picture",
    "save_map",
    "save_positions_picture",
    "save_rig_picture",
}


@pytest.mark.parametrize("door", PUBLIC)
def test_the_list(door: str) -> None:
    names = PUBLIC[door].split()
    module = importlib.import_module(door)
    more = NAMESPACES if door == "kcal" else set()
    assert module.__all__ == sorted({*names, *more})
    assert {name for name in dir(module) if not name.startswith("__")} == set(module.__all__)


def test_a_name_has_one_place() -> None:
    names = [name for _, name in NAMES]
    assert sorted(names) == sorted(set(names))


@pytest.mark.parametrize(("door", "name"), NAMES)
def test_each_name(door: str, name: str) -> None:
    value = getattr(importlib.import_module(door), name)
    assert value is getattr(importlib.import_module(value.__module__), name)
    docstring = inspect.getdoc(value) or ""
    # Options are shown where they are used, and errors by the messages they carry.
    plain = dataclasses.is_dataclass(value) and name.endswith("Options")
    without = name.endswith(("Error", "Warning")) or name in RECORDS | WITHOUT_EXAMPLE
    wanted = "Args:" if plain else "" if without else "Example:"
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
    # What is imported for type checkers only.
    known = {"NDArray": numpy.typing.NDArray, "np": np, "Tensor": torch.Tensor, "CameraInformation": CameraInformation}
    hints = typing.get_type_hints(value, localns=known)
    return set().union(*(named_types(hint) for name, hint in hints.items() if not name.startswith("_")))


def test_every_type_in_a_public_signature_is_public() -> None:
    public = {getattr(importlib.import_module(door), name) for door, name in NAMES}
    values = [value for value in public if not (inspect.isclass(value) and issubclass(value, Exception))]
    others = {value.__qualname__: signature_types(value) - public for value in values}
    assert {kind.__qualname__ for kinds in others.values() for kind in kinds} == INSIDE, others


def test_a_type_that_is_not_public_is_seen() -> None:
    def function(fits: Sequence[PointFit | None]) -> kcal.Camera: ...

    assert {kind.__name__ for kind in signature_types(function)} == {"PointFit", "Camera"}


def test_stubs_travel_with_the_package() -> None:
    """They are the table of names, for type checkers and for the package itself."""
    settings = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    package = Path(kcal.__file__).parent
    shipped = {
        path for pattern in settings["tool"]["setuptools"]["package-data"]["kcal"] for path in package.glob(pattern)
    }
    stubs = {Path(str(importlib.import_module(door).__file__)).with_suffix(".pyi") for door in PUBLIC}
    assert stubs == set(package.rglob("*.pyi"))
    assert stubs <= shipped


@pytest.mark.parametrize("door", PUBLIC)
def test_no_name_hides_a_module(door: str) -> None:
    """`kcal.corners.detect` is a module; a function of that name would be replaced by it at the first import."""
    folder = Path(str(importlib.import_module(door).__file__)).parent
    inside = {path.stem for path in folder.glob("*.py")} | {path.parent.name for path in folder.glob("*/__init__.py")}
    assert inside.isdisjoint(PUBLIC[door].split())


def test_unknown_names() -> None:
    with pytest.raises(AttributeError, match="module 'kcal' has no attribute 'nothing'"):
        _ = kcal.nothing
    with pytest.raises(AttributeError, match=r"module 'kcal\.lens' has no attribute 'Camera'"):
        _ = kcal.lens.Camera


def test_version() -> None:
    assert importlib.metadata.version("kcal") == kcal.__version__


@pytest.mark.parametrize("module", [*PUBLIC, "kcal.cli.main"])
def test_import_is_light(module: str) -> None:
    heavy = {"torch", "cv2", "numpy", "skimage", "matplotlib"}
    code = f"import sys, {module}; dir({module}); print(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
