"""What kcal promises to its users at the top level."""

from __future__ import annotations

import dataclasses
import importlib
import importlib.metadata
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import kcal

# Taking a name away breaks users; adding one is a promise. Either is a line here and one in CHANGELOG.md.
PUBLIC = {
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
    wanted = "Args:" if plain else "" if name.endswith("Error") else "Example:"
    assert wanted in docstring
    assert len(docstring.splitlines()[0]) > 20


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
