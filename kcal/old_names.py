"""Names that version 0.1 had in `kcal` itself: they warn in version 1 and are gone in version 2.0."""

from __future__ import annotations

import importlib
import warnings
from typing import Any

# Where the names are now.
_MOVED = {
    "kcal.lens": """
        BoardRecord CalibrationRecord CameraCalibration CameraDifference CameraInformation CameraPose Exclusion
        ExportedCameras HybridForm ImageTransform ImportedCameras LearnedStart LensModel LookupCamera Misfit
        ParaxialFocal RefittedCamera Undistort UndistortImage
        UndistortMaps Unproject ZernikeModes bake camera_difference export_cameras image_sigma import_cameras
        load_lookup new_pinhole paraxial_focal pixel_covariance projection_sigma
        refit_camera save_lookup save_onnx undistort_maps
    """,
    "kcal.corners": """
        Detection Failure MatchOptions MatchStatus Matches RefinedPoint detect_board detect_video expand_images
        import_corners match_points read_gray refine_point save_board
    """,
    "kcal.calibrate": """
        CalibratedViews CalibrationLayer CalibrationSummary ComparisonResult Examination HalvesDifference
        MeasuredBoard OutlierRejection RejectedCorner RejectedView ResidualStructure SharedBoard
        calibrate_cameras compare_models examine load_measured_board measure_board save_measured_board summarize
    """,
    "kcal.rig": """
        Drift DriftEffect ItemResidual MarkedLandmarks Mounting RigCalibration RigCovariance RigSource Sides
        SourceResidual Survey TurnedBoard camera_positions check_rig drift_effect import_survey match_landmarks
        measure_drift mounting_covariance pair_by_name paired_boards placed_rig planned_rig read_features
        read_pairs read_survey relocked triangulated_sides
    """,
    "kcal.locate": """
        BudgetErrors Geoid GroundPlaces Localization Marks Position RangeError Sensitivity Triangulate
        TriangulateViews Triangulation Viewpoint ViewsResult circular_error enu_from_cam enu_to_geodetic
        find_geoid geodetic_to_enu level_ground locate_on_ground position_errors range_errors read_marks
        read_truth terrain true_from_grid write_positions
    """,
    "kcal.track": """
        Association AssociationOptions ClockEstimate ClockPrior Detections DisparityOptions Motion
        ObjectDisparities ObjectDisparity ObjectPairs SmoothedTrack TrackOptions TrackStates Tracker Tracks
        associate pair_objects
    """,
    "kcal.report": """
        FailedImage Finding RangeAnswer Requirement Verdict calibration_figure camera_verdict positions_figure
        rig_figure rig_verdict save_board_picture save_budget_picture save_calibration_picture save_coverage
        save_difference_picture save_gallery save_map save_positions_picture save_rig_picture save_verdict_page
        stored_verdict
    """,
    "kcal.solve": """
        LMOptions LevenbergMarquardt RobustLoss SolverStatus
    """,
    "kcal.nets": """
        InverseFit InverseNet InverseNetOptions NetworkModes train_inverse
    """,
}
_RENAMED = {"detect_images": "kcal.detect"}
# Parts of kcal that no user needs, and where they are defined.
_INTERNAL = {
    "kcal.calibrate.hybrid.board_modes": "BoardModes",
    "kcal.calibrate.hybrid.families": "PriorFamilies",
    "kcal.calibrate.hybrid.fit": "HybridFit",
    "kcal.calibrate.problem.readout": "Readout",
    "kcal.lens.field_modes": "FieldModes",
    "kcal.lens.gaussian_modes": "GaussianModes",
    "kcal.lens.spline": "Spline",
}
_PUBLIC = {name: f"{module}.{name}" for module, names in _MOVED.items() for name in names.split()} | _RENAMED
# Old name -> full name.
PLACES = _PUBLIC | {name: f"{module}.{name}" for module, name in _INTERNAL.items()}
PLACES["HybridState"] = "kcal.calibrate.problem.state.BoardState"
# Old names that mean nothing any more, and what takes their place.
GONE = {
    "projection_covariance": "kcal.lens.pixel_covariance and kcal.lens.projection_sigma",
    "train_features": "kcal.nets.FieldTraining and CalibrationOptions(field=...)",
}


def find_old(name: str) -> Any:
    """What an old name meant, with a warning that says where it is now. Call it from `kcal.__getattr__` only."""
    module, _, new_name = PLACES[name].rpartition(".")
    now = f"is now {PLACES[name]}" if name in _PUBLIC else "is internal, and not public any more"
    # The third frame is the one that asked `kcal` for the name.
    warnings.warn(f"kcal.{name} {now}; the old name is gone in version 2.0", DeprecationWarning, stacklevel=3)
    return getattr(importlib.import_module(module), new_name)
