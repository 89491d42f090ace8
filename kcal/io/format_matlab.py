"""MATLAB's camera parameters as a struct in a `.mat` file (version 5 to 7.2), as `toStruct` makes it.

Pixel (1, 1) is the center of the first pixel there. Old releases have the intrinsic matrix and rotations transposed,
because points were rows.
"""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from kcal.files import read_bytes, write_atomic
from kcal.io.foreign import (
    MOST_BYTES,
    CameraPose,
    Hints,
    ImportedCameras,
    checked_pose,
    core_of,
    known_size,
    named_camera,
    numbers,
    plain,
    whole_size,
    with_sigmas,
)
from kcal.lens.camera import Camera
from kcal.mat_file import read_mat

MODELS = ("pinhole", "opencv4", "opencv5")
# Fields of the struct with standard deviations, which stands beside the parameters.
_ERRORS = {"IntrinsicsErrors", "Camera1IntrinsicsErrors"}
_METERS = {"mm": 1e-3, "millimeters": 1e-3, "cm": 1e-2, "centimeters": 1e-2, "m": 1.0, "meters": 1.0, "in": 0.0254,
           "inches": 0.0254}  # fmt: skip


def read_matlab(path: Path, hints: Hints) -> ImportedCameras:
    """Read a struct of `cameraParameters`, `cameraIntrinsics` or `stereoParameters`; objects must be made structs."""
    structs = read_mat(read_bytes(path, MOST_BYTES), str(path))
    # A file may hold one struct, or its fields.
    candidates = [*structs.items(), (path.stem, structs)]
    errors = next((value for _, value in candidates if isinstance(value, Mapping) and _ERRORS & set(value)), {})
    for _, value in candidates:
        if isinstance(value, Mapping) and "CameraParameters1" in value:
            return _with_errors(_pair(value, hints), [errors.get(f"Camera{i}IntrinsicsErrors") for i in (1, 2)])
    for name, value in candidates:
        if isinstance(value, Mapping) and {"K", "IntrinsicMatrix", "FocalLength"} & set(value):
            found = ImportedCameras(format="matlab", cameras=(_matlab_camera(value, name, hints),))
            return _with_errors(found, [errors.get("IntrinsicsErrors")])
    raise ValueError("no struct of camera parameters; save one with s = toStruct(params); save('file.mat', 's')")


def _with_errors(found: ImportedCameras, errors: Sequence[Any]) -> ImportedCameras:
    """Standard deviations from the struct of `cameraCalibrationErrors` or `stereoCalibrationErrors`, if it is there."""
    notes = list(found.notes)
    for camera, stated in zip(found.cameras, errors, strict=True):
        if not isinstance(stated, Mapping):
            continue
        core = [*numbers(stated["FocalLengthError"], 2, "FocalLengthError"),
                *numbers(stated["PrincipalPointError"], 2, "PrincipalPointError")]  # fmt: skip
        radial = numbers(stated["RadialDistortionError"], (2, 3), "RadialDistortionError")
        tangential = numbers(stated.get("TangentialDistortionError", [0.0, 0.0]), 2, "TangentialDistortionError")
        lens = [*radial[:2], *tangential, *radial[2:]]
        notes.append(with_sigmas(camera, [*core, *([*lens, 0.0])[: camera.model.size]]))
    return dataclasses.replace(found, notes=tuple(dict.fromkeys(notes)))


def _matlab_camera(value: Mapping[str, Any], name: str, hints: Hints) -> Camera:
    if "K" in value or "IntrinsicMatrix" in value:
        matrix = value["K"] if "K" in value else np.transpose(value["IntrinsicMatrix"])
        (fx, fy, cx, cy), skew = core_of(matrix, "its intrinsic matrix")
    else:
        fx, fy = numbers(value["FocalLength"], 2, "FocalLength")
        cx, cy = numbers(value["PrincipalPoint"], 2, "PrincipalPoint")
        (skew,) = numbers(value.get("Skew", 0.0), 1, "Skew")
    size = value.get("ImageSize")
    stated = None if size is None else numbers(size, (0, 2), "ImageSize")
    size = known_size(hints.size or (whole_size(*stated[::-1]) if stated else None))
    radial = numbers(value.get("RadialDistortion", []), (0, 2, 3), "RadialDistortion")
    tangential = numbers(value.get("TangentialDistortion", []), (0, 2), "TangentialDistortion") or [0.0, 0.0]
    lens = [*radial[:2], *tangential, *radial[2:]] if radial else [0.0, 0.0, *tangential]
    return named_camera(name, (fx, fy, cx - 1, cy - 1), size, f"opencv{len(lens)}", lens, skew)


def _pair(value: Mapping[str, Any], hints: Hints) -> ImportedCameras:
    cameras = tuple(
        _matlab_camera(value[f"CameraParameters{i}"], side, hints) for i, side in ((1, "left"), (2, "right"))
    )
    stated = str(value.get("WorldUnits") or value["CameraParameters1"].get("WorldUnits") or "").strip().lower()
    units = stated or "mm"
    meters = hints.meters or _METERS.get(units)
    if meters is None:
        raise ValueError(f"WorldUnits {units!r}: give the unit (--unit mm)")
    if "RotationOfCamera2" in value:
        # Points are rows there: p2 = p1 R + t.
        rotation = np.array(numbers(value["RotationOfCamera2"], 9, "RotationOfCamera2")).reshape(3, 3).T
        translation = np.array(numbers(value["TranslationOfCamera2"], 3, "TranslationOfCamera2"))
    else:
        pose = value["PoseCamera2"]
        whole = np.array(numbers(pose["A"] if isinstance(pose, Mapping) else pose, 16, "PoseCamera2")).reshape(4, 4)
        rotation, translation = whole[:3, :3], whole[:3, 3]
    # MATLAB's own apps work in millimeters.
    unsaid = hints.meters is None and not stated
    notes = ("WorldUnits is not in the file: the translation is taken as millimeters (--unit)",) if unsaid else ()
    still = checked_pose(np.eye(3).tolist(), [0.0] * 3)
    pose = checked_pose(rotation.tolist(), (meters * translation).tolist())
    return ImportedCameras(format="matlab", cameras=cameras, poses=(still, pose), notes=notes)


def write_matlab(cameras: Sequence[Camera], poses: Sequence[CameraPose], path: Path) -> list[Path]:
    """Write a struct `cameraParams`, or `stereoParams` of two cameras, in millimeters as MATLAB expects."""
    from scipy.io import savemat

    structs = [_struct(camera) for camera in cameras]
    content: dict[str, Any] = {"cameraParams": structs[0]}
    if len(cameras) == 2:
        rig = ImportedCameras(format="matlab", cameras=tuple(cameras), poses=tuple(poses)).rig()
        content = {
            "stereoParams": {
                "CameraParameters1": structs[0],
                "CameraParameters2": structs[1],
                "RotationOfCamera2": np.array(plain(rig.right_from_left_rotation)).T,
                "TranslationOfCamera2": 1e3 * np.array([plain(rig.right_from_left_translation)]),
                "WorldUnits": "mm",
            }
        }
    data = io.BytesIO()
    savemat(data, content)
    return [write_atomic(path, data.getvalue())]


def _struct(camera: Camera) -> dict[str, Any]:
    matrix = np.array(plain(camera.matrix))
    matrix[:2, 2] += 1.0
    lens = dict(zip(camera.model.names, camera.coefficients.tolist(), strict=True))
    radial = [lens.get(name, 0.0) for name in (("k1", "k2", "k3") if "k3" in lens else ("k1", "k2"))]
    return {
        "K": matrix,
        "IntrinsicMatrix": matrix.T,
        "RadialDistortion": np.array([radial]),
        "TangentialDistortion": np.array([[lens.get("p1", 0.0), lens.get("p2", 0.0)]]),
        "ImageSize": np.array([camera.size[::-1]], dtype=float),
        "WorldUnits": "mm",
    }
