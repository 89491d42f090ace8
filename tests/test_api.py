"""What kcal promises to its users: the names in `kcal` and its namespaces."""

import dataclasses
import importlib
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
from scripts.make_reference import INSIDE, returned_by

# Taking a name away breaks users; adding one is a promise. Either is a line here and one in CHANGELOG.md.
PUBLIC = {
    "kcal": """
        Baseline Board Boards CalibrationOptions Camera DegenerateError Features FileError InputError
        KcalError KcalWarning Landmarks Localizer MeasuredPosition Observations Origin PositionStatus Rig
        RigData RigOptions View calibrate_camera calibrate_rig detect load_camera load_rig locate_points
        save_camera save_rig solve_rig
    """,
    "kcal.lens": """
        CameraCalibration CameraLike CameraRays ExtendedDistortion ImageTransform LensModel LensSetting
        StereoRectification Undistort UndistortImage Unproject bake camera_difference ceres_prior cylinder_view
        export_cameras import_cameras load_lookup looking pinhole_view pixel_covariance refit_camera
        rotation_from_vector save_lookup save_onnx undistort_maps vector_from_rotation
    """,
    "kcal.corners": """
        CornerStatus MatchOptions MatchStatus RefineCorners detect_board detect_video match_points
        recognize_board refine_point save_board
    """,
    "kcal.calibrate": """
        CalibrationLayer OutlierRejection calibrate_cameras calibrate_views compare_models examine
        load_measured_board measure_board save_measured_board
    """,
    "kcal.rig": """
        Effect ImagePair Mounting MovingOptions RasterError RigCovariance SkylineImage Survey Watched
        check_rig import_survey match_landmarks match_moving mounting_covariance
        pair_by_name paired_boards placed_rig planned_rig read_features read_sightings read_tracks
        scene_features skyline_attitude skyline_source stated_mounting station_rig
    """,
    "kcal.locate": """
        BudgetErrors DisparityRanges Marks Site area_of check_ranges enu_from_cam enu_to_geodetic find_geoid
        geodetic_to_enu level_ground range_errors rank_sites read_marks terrain triangulate
        write_positions
    """,
    "kcal.track": """
        AssociationOptions ClockPrior Detections DisparityOptions Motion ObjectDisparity PairBoxes
        TrackOptions Tracker group_objects matched_pixels pair_objects
    """,
    "kcal.report": """
        Requirement calibration_figure camera_verdict log_view positions_figure rig_figure rig_verdict save_map
        save_picture save_view
    """,
    "kcal.stars": """
        Air SkyView StarCatalog calibrate_by_stars detect_stars name_stars star_source
    """,
    "kcal.solve": """
        LMOptions LevenbergMarquardt RobustLoss SolverStatus
    """,
    "kcal.nets": """
        FieldTraining InverseNet InverseNetOptions JointOptions NetworkModes ResidualNet train_inverse
        train_jointly
    """,
}
NAMES = [(door, name) for door, names in PUBLIC.items() for name in names.split()]
NAMESPACES = {door.removeprefix("kcal.") for door in PUBLIC} - {"kcal"}
# What functions return, and blocks of files: examples are those of the functions.
_RECORDS = """
    cylinder_view CornerStatus Baseline ClockPrior Motion Boards Features ImagePair Landmarks Marks
    MatchStatus MeasuredPosition ObjectDisparity OutlierRejection Effect SkylineImage BudgetErrors
    PositionStatus SolverStatus Survey View
"""
RECORDS = set(_RECORDS.split())
# They write a picture or page of a whole result, or need a video, raster or observations: see the tests of their rooms.
WITHOUT_EXAMPLE = {"ceres_prior", "terrain", "detect_video", "paired_boards", "save_map"}


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


def results() -> list[type]:
    """The classes of what public functions return."""
    homes = [home for homes in returned_by().values() for home in homes]
    values = [getattr(importlib.import_module(module), name) for name, module in homes]
    assert [value.__module__ for value in values] == [module for _, module in homes]
    return values


def test_each_result() -> None:
    assert [value for value in results() if len((inspect.getdoc(value) or "").splitlines()[0]) <= 20] == []


def test_every_type_in_a_public_signature_is_public_or_a_result() -> None:
    public = {getattr(importlib.import_module(door), name) for door, name in NAMES}
    known = public | set(results())
    values = [value for value in public if not (inspect.isclass(value) and issubclass(value, Exception))]
    others = {value.__qualname__: signature_types(value) - known for value in values}
    assert {kind.__qualname__ for kinds in others.values() for kind in kinds} <= INSIDE, others
    assert not INSIDE & {kind.__qualname__ for kind in public}


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
    stubs.add(package / "cli" / "rooms.pyi")
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
    """One version in the package, the project, the citation and the newest entry of the changelog."""
    root = Path(__file__).parents[1]
    names = "pyproject.toml", "CITATION.cff", "CHANGELOG.md"
    project, citation, changes = ((root / name).read_text(encoding="utf-8") for name in names)
    assert tomllib.loads(project)["project"]["version"] == kcal.__version__
    assert f"\nversion: {kcal.__version__}\n" in citation
    assert changes.split("\n## [")[2].startswith(f"{kcal.__version__}] - ")


def test_imports_are_light() -> None:
    """Of each door, and of the command line, whose help needs none of them."""
    heavy = {"torch", "cv2", "numpy", "scipy", "skimage", "matplotlib", "pyproj"}
    code = f"import importlib, sys\nfor name in {[*PUBLIC, 'kcal.cli.main']}:\n    dir(importlib.import_module(name))\n"
    code += f"    assert not {heavy} & set(sys.modules), name"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
