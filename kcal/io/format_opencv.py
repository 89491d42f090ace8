"""Files of OpenCV's lens models: OpenCV itself, ROS, Anipose and Caliscope (TOML), and MATLAB."""

from __future__ import annotations

import dataclasses
import io
import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from kcal.errors import InputError
from kcal.files import read_bytes, read_text, write_atomic
from kcal.io.foreign import (
    MOST_BYTES,
    CameraPose,
    Hints,
    ImportedCameras,
    camera_name,
    checked_pose,
    core_of,
    dump_yaml,
    known_size,
    load_yaml,
    named_camera,
    numbers,
    paths_for,
    plain,
    whole_size,
    with_sigmas,
)
from kcal.io.format_kalibr import omni_camera
from kcal.lens.camera import Camera
from kcal.lens.camera_conversions import OPENCV_MODELS
from kcal.lens.pose import rotation_from_vector, vector_from_rotation
from kcal.mat_file import read_mat
from kcal.opencv_storage import read_storage

# OpenCV's YAML, XML and JSON files of one camera or a stereo pair, as its samples write and read them.
#
# One camera: `image_width`, `image_height`, `camera_matrix`, `distortion_coefficients` (k1 k2 p1 p2 k3 k4 k5 k6 s1 s2
# s3 s4 τx τy), `fisheye_model`; `xi` of an omnidir camera; `stdDeviationsIntrinsics` of `calibrateCamera`. A pair:
# `M1`, `D1`, `M2`, `D2` and `R`, `T`, in one file or in two.

_MATRICES = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "mtx")
_SIGMAS = ("stdDeviationsIntrinsics", "std_deviations_intrinsics", "stdDeviations", "std_deviations")
_COEFFICIENTS = ("distortion_coefficients", "distCoeffs", "Distortion_Coefficients", "D", "dist")


def read_opencv(path: Path, hints: Hints) -> ImportedCameras:
    """Read one camera, a pair, or the R and T of a pair whose cameras are in another file."""
    stored = read_storage(read_bytes(path, MOST_BYTES), str(path))
    notes: list[str] = []
    size = hints.size or _stored_size(stored)
    pairs = [("M1", "D1", "left"), ("M2", "D2", "right")]
    if "M1" not in stored and "cameraMatrix1" in stored:
        pairs = [("cameraMatrix1", "distCoeffs1", "left"), ("cameraMatrix2", "distCoeffs2", "right")]
    poses: tuple[CameraPose, ...] = ()
    if "R" in stored and "T" in stored:
        meters = hints.meters or 1.0
        rotation, translation = numbers(stored["R"], 9, "R"), [meters * t for t in numbers(stored["T"], 3, "T")]
        poses = (checked_pose(np.eye(3).tolist(), [0.0, 0.0, 0.0]), checked_pose(rotation, translation))
        if hints.meters is None:
            notes.append("the unit of T is not in the file: taken as meters (--unit mm for millimeters)")
    if pairs[0][0] not in stored:
        matrix, coefficients = _present(stored, _MATRICES), _present(stored, _COEFFICIENTS)
        pairs = [(matrix, coefficients, path.stem)] if matrix else []
        if not pairs and not poses:
            raise ValueError(f"no camera; {_MATRICES[0]}, M1 or R and T are needed")
    cameras = tuple(
        _opencv_camera(stored, matrix, coefficients, name, size, hints.fisheye, notes)
        for matrix, coefficients, name in pairs
    )
    return ImportedCameras(format="opencv", cameras=cameras, poses=poses, notes=tuple(dict.fromkeys(notes)))


def _present(stored: Mapping[str, Any], names: Sequence[str]) -> str:
    return next((name for name in names if name in stored), "")


def _stored_size(stored: Mapping[str, Any]) -> tuple[int, int] | None:
    width, height = (
        _present(stored, [f"image_{side}", f"image_{side.capitalize()}", side]) for side in ("width", "height")
    )
    if width and height:
        return whole_size(*numbers([stored[width], stored[height]], 2, "the image size"))
    name = _present(stored, ("image_size", "imageSize", "size"))
    return whole_size(*numbers(stored[name], 2, name)) if name else None


def _opencv_camera(
    stored: Mapping[str, Any],
    matrix: str,
    coefficients: str,
    name: str,
    size: Any,
    fisheye: bool | None,
    notes: list[str],
) -> Camera:
    size = known_size(size)
    core, skew = core_of(stored[matrix], matrix)
    if skew:
        notes.append(f"{matrix} has a skew of {skew:g}, which OpenCV does not use and kcal does not take over")
    lens = numbers(stored.get(coefficients, []), tuple(OPENCV_MODELS), coefficients)
    if "xi" in stored:
        if len(lens) != 4 or skew:
            raise ValueError("an omnidir camera has 4 coefficients and, here, no skew")
        camera, note = omni_camera(name, [*numbers(stored["xi"], 1, "xi"), *core, *lens], size)
        notes.append(note)
        return camera
    known = fisheye
    if known is None and "fisheye_model" in stored:
        known = bool(numbers([stored["fisheye_model"]], 1, "fisheye_model")[0])
    if known and len(lens) != 4:
        raise ValueError(f"a fisheye has 4 coefficients, {coefficients} has {len(lens)}")
    if known is None and len(lens) == 4:
        notes.append("4 coefficients read as k1 k2 p1 p2; if they are a fisheye's, use --fisheye")
    model = "fisheye4" if known else OPENCV_MODELS[len(lens)]
    camera = named_camera(name, core, size, model, lens)
    if (sigmas := _present(stored, _SIGMAS)) and matrix in _MATRICES:
        # OpenCV always states those of 14 coefficients.
        given = numbers(stored[sigmas], (4 + len(lens), 18), sigmas)
        notes.append(with_sigmas(camera, given[: 4 + len(lens)]))
    return camera


def write_opencv(cameras: Sequence[Camera], poses: Sequence[CameraPose], path: Path) -> list[Path]:
    """Write one camera, or two with their relative pose."""
    kind = {".xml": ".xml", ".json": ".json"}.get(path.suffix.lower(), ".yml")
    file = cv2.FileStorage(kind, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    if cameras[0].size != cameras[-1].size:
        raise InputError(
            f"OpenCV's stereo file has one image size; these cameras have {cameras[0].size} and {cameras[-1].size}"
        )
    if cameras[0].model.fisheye != cameras[-1].model.fisheye:
        raise InputError("OpenCV's stereo file has two fisheyes or none: write the cameras one by one")
    file.write("image_width", cameras[0].size[0])
    file.write("image_height", cameras[0].size[1])
    keys = [("camera_matrix", "distortion_coefficients")] if len(cameras) == 1 else [("M1", "D1"), ("M2", "D2")]
    for camera, (matrix, coefficients) in zip(cameras, keys, strict=True):
        lens = camera.coefficients.tolist()
        # Four coefficients could be a fisheye's.
        lens += [0.0] * (5 - len(lens)) if not camera.model.fisheye else []
        file.write(matrix, np.array(plain(camera.matrix)))
        file.write(coefficients, np.array([lens]))
    file.write("fisheye_model", int(cameras[0].model.fisheye))
    if len(cameras) == 2 and poses:
        pair = ImportedCameras(format="opencv", cameras=tuple(cameras), poses=tuple(poses)).rig()
        file.write("R", np.array(plain(pair.right_from_left_rotation)))
        file.write("T", np.array(plain(pair.right_from_left_translation))[:, None])
    return [write_atomic(path, file.releaseAndGetString())]


# ROS's `camera_info` files, as camera_calibration writes and camera_info_manager reads them: one file per camera.
#
# A pair has the rectification of both cameras: a point of the rectified frame of the left camera is at R^T (p + (Tx /
# fx, 0, 0)) of the right one, with Tx the fourth column of its projection matrix.

_ROS_LENSES = {
    "plumb_bob": ("opencv5", (4, 5)),
    "rational_polynomial": ("opencv8", (8,)),
    "equidistant": ("fisheye4", (4,)),
}


def read_ros(path: Path, hints: Hints) -> ImportedCameras:
    """Read one camera, and how it is rectified."""
    content = load_yaml(path)
    name = str(content.get("camera_name") or path.stem)
    kind = str(content.get("distortion_model") or "plumb_bob")
    if kind not in _ROS_LENSES:
        raise ValueError(f"distortion_model {kind!r}: kcal reads {', '.join(_ROS_LENSES)}")
    model, counts = _ROS_LENSES[kind]
    core, skew = core_of(content["camera_matrix"]["data"], "camera_matrix")
    lens = numbers(content["distortion_coefficients"]["data"], (*counts, 0), "distortion_coefficients")
    notes = [f"camera_matrix has a skew of {skew:g}, which kcal does not take over"] if skew else []
    size = whole_size(content["image_width"], content["image_height"])
    camera = named_camera(name, core, size, model if lens else "pinhole", lens)
    poses: tuple[CameraPose, ...] = ()
    if "rectification_matrix" in content and "projection_matrix" in content:
        rotation = np.array(numbers(content["rectification_matrix"]["data"], 9, "rectification_matrix")).reshape(3, 3)
        projection = np.array(numbers(content["projection_matrix"]["data"], 12, "projection_matrix")).reshape(3, 4)
        if not projection[0, 0] > 0 or not projection[1, 1] > 0:
            raise ValueError("projection_matrix has no focal length")
        beside = np.array([projection[0, 3] / projection[0, 0], projection[1, 3] / projection[1, 1], 0.0])
        poses = (checked_pose(rotation.T.tolist(), (rotation.T @ beside).tolist()),)
    return ImportedCameras(format="ros", cameras=(camera,), poses=poses, notes=tuple(notes))


def write_ros(cameras: Sequence[Camera], poses: Sequence[CameraPose], path: Path) -> list[Path]:
    """Write a file for each camera; two with poses are rectified as by `cv2.stereoRectify`."""
    rectified = [(np.eye(3), _projection(camera)) for camera in cameras]
    if len(cameras) == 2 and poses:
        rectified = _rectify(ImportedCameras(format="ros", cameras=tuple(cameras), poses=tuple(poses)))
    paths = paths_for(path, len(cameras))
    for camera, (rotation, projection), target in zip(cameras, rectified, paths, strict=True):
        kind = (
            "equidistant" if camera.model.fisheye else "rational_polynomial" if camera.model.size > 5 else "plumb_bob"
        )
        lens = camera.coefficients.tolist()
        lens += [0.0] * (5 - len(lens)) if kind == "plumb_bob" else []
        content: dict[str, Any] = {
            "image_width": camera.size[0],
            "image_height": camera.size[1],
            "camera_name": camera_name(camera, target.stem),
            "camera_matrix": _matrix_block(np.array(plain(camera.matrix))),
            "distortion_model": kind,
            "distortion_coefficients": _matrix_block(np.array([lens])),
            "rectification_matrix": _matrix_block(rotation),
            "projection_matrix": _matrix_block(projection),
        }
        write_atomic(target, dump_yaml(content))
    return paths


def _projection(camera: Camera) -> np.ndarray:
    return np.pad(np.array(plain(camera.matrix)), ((0, 0), (0, 1)))


def _matrix_block(values: np.ndarray) -> dict[str, Any]:
    return {"rows": values.shape[0], "cols": values.shape[1], "data": values.ravel().tolist()}


def _rectify(pair: ImportedCameras) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rotation (3, 3) and projection (3, 4) of both cameras; the lens only affects how much of the image is kept."""
    rig = pair.rig()
    matrices = [np.array(plain(camera.matrix)) for camera in pair.cameras]
    none = np.zeros(5)
    rotation, translation = np.array(plain(rig.right_from_left_rotation)), plain(rig.right_from_left_translation)
    found = cv2.stereoRectify(
        matrices[0], none, matrices[1], none, pair.cameras[0].size, rotation, np.array(translation)[:, None], alpha=0
    )
    left, right, project_left, project_right = found[:4]
    # Rows of the frame shared by both cameras; its x axis is the baseline, so nothing is left along y and z.
    return [(left, project_left), (right, project_right)]


# TOML files of aniposelib, pose2sim and Caliscope: a table per camera, in OpenCV's conventions.
#
# `matrix`, `distortions`, `size`, and from the world's frame `rotation` (a vector) and `translation`. Caliscope has the
# tables inside `cameras`. No unit of length is in these files: pose2sim and Caliscope have meters, aniposelib has
# whatever its board was given in.

# A thousand cameras take half of it.
_MOST_BYTES = 2**20


def read_toml(path: Path, hints: Hints) -> ImportedCameras:
    """Read all cameras of a file; poses are from the frame of the world, if every camera has one."""
    content = tomllib.loads(read_text(path, _MOST_BYTES))
    inside = content.get("cameras")
    tables = {**content, **inside} if isinstance(inside, Mapping) else content
    parts = {key: part for key, part in tables.items() if isinstance(part, Mapping) and "matrix" in part}
    if not parts:
        raise ValueError("no camera: a table with matrix, distortions and size is needed")
    cameras = tuple(_toml_camera(key, part, hints) for key, part in parts.items())
    poses = tuple(_toml_pose(part, hints.meters or 1.0) for part in parts.values() if part.get("rotation") is not None)
    complete = len(poses) == len(cameras)
    unsaid = complete and hints.meters is None and any(bool(pose.translation.any()) for pose in poses)
    notes = (
        ["the unit of translation is not in the file: taken as meters (--unit mm for millimeters)"] if unsaid else []
    )
    if poses and not complete:
        notes.append("some cameras have no rotation: no pose is read")
    return ImportedCameras(format="toml", cameras=cameras, poses=poses if complete else (), notes=tuple(notes))


def _toml_camera(key: str, part: Mapping[str, Any], hints: Hints) -> Camera:
    name = str(part.get("name", key))
    size = known_size(whole_size(*numbers(part["size"], 2, f"{name} size")) if "size" in part else hints.size)
    core, skew = core_of(part["matrix"], f"{name} matrix")
    if skew:
        raise ValueError(f"{name}: matrix has a skew of {skew:g}, which aniposelib does not know")
    lens = numbers(part.get("distortions", []), tuple(OPENCV_MODELS), f"{name} distortions")
    fisheye = bool(part.get("fisheye", False))
    if (fisheye and len(lens) < 4) or (fisheye and any(lens[4:])):
        raise ValueError(f"{name}: a fisheye has 4 coefficients, distortions has {len(lens)}")
    return named_camera(
        name, core, size, "fisheye4" if fisheye else OPENCV_MODELS[len(lens)], lens[:4] if fisheye else lens
    )


def _toml_pose(part: Mapping[str, Any], meters: float) -> CameraPose:
    turn = numbers(part["rotation"], (3, 9), "rotation")
    rotation = plain(rotation_from_vector(torch.tensor(turn, dtype=torch.float64))) if len(turn) == 3 else turn
    return checked_pose(rotation, [meters * value for value in numbers(part["translation"], 3, "translation")])


def write_toml(cameras: Sequence[Camera], poses: Sequence[CameraPose], path: Path) -> list[Path]:
    """Write cameras as aniposelib does, with translations in meters."""
    lines: list[str] = []
    for index, camera in enumerate(cameras):
        lens = camera.coefficients.tolist()
        lens += [0.0] * (5 - len(lens)) if not camera.model.fisheye else []
        rotation, translation = [0.0] * 3, [0.0] * 3
        if poses:
            rotation, translation = plain(vector_from_rotation(poses[index].rotation)), plain(poses[index].translation)
        lines += [
            f"[cam_{index}]",
            # JSON's texts are TOML's.
            f"name = {json.dumps(camera_name(camera, f'cam_{index}'))}",
            f"size = {[float(side) for side in camera.size]}",
            f"matrix = {plain(camera.matrix)}",
            f"distortions = {lens}",
            f"rotation = {rotation}",
            f"translation = {translation}",
            f"fisheye = {str(camera.model.fisheye).lower()}",
            "",
        ]
    return [write_atomic(path, "\n".join([*lines, "[metadata]", ""]))]


# MATLAB's camera parameters as a struct in a `.mat` file (version 5 to 7.2), as `toStruct` makes it.
#
# Pixel (1, 1) is the center of the first pixel there. Old releases have the intrinsic matrix and rotations transposed,
# because points were rows.

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
