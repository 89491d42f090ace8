"""Files of OpenCV's lens models: OpenCV itself, ROS, Anipose and Caliscope (TOML), multical, calib.io, and MATLAB."""

from __future__ import annotations

import dataclasses
import io
import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from kcal.errors import InputError
from kcal.files import dump_json, read_bytes, read_text, write_atomic
from kcal.io.foreign import (
    MOST_BYTES,
    Hints,
    ImportedCameras,
    camera_name,
    checked_pose,
    core_of,
    dump_yaml,
    flat,
    ini_sections,
    known_size,
    named_camera,
    numbers,
    paths_for,
    plain,
    whole_size,
    with_sigmas,
)
from kcal.io.foreign_lenses import nearest_hybrid
from kcal.io.keyed import read_keyed
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.pose import Pose, vector_from_rotation
from kcal.opencv import cv2
from kcal.strict_formats import read_mat, read_npz, read_storage, read_yaml
from kcal.strict_json import read_json

# OpenCV's YAML, XML and JSON files of one camera or a stereo pair, as its samples write and read them.
#
# One camera: `image_width`, `image_height`, `camera_matrix`, `distortion_coefficients` (k1 k2 p1 p2 k3 k4 k5 k6 s1 s2
# s3 s4 τx τy), `fisheye_model`; `xi` of an omnidir camera; `stdDeviationsIntrinsics` of `calibrateCamera`. A pair:
# `M1`, `D1`, `M2`, `D2` and `R`, `T`, in one file or in two.


def read_opencv(path: Path, hints: Hints) -> ImportedCameras:
    """Read one camera, a pair, or the R and T of a pair whose cameras are in another file."""
    data = read_bytes(path, MOST_BYTES)
    # `np.savez` of the tutorials.
    packed = data[:2] == b"PK"
    stored = read_npz(data, str(path), MOST_BYTES, "camera") if packed else read_storage(data, str(path))
    return read_keyed(stored, path.stem, hints, "opencv")


def write_opencv(cameras: Sequence[Camera], poses: Sequence[Pose], path: Path) -> list[Path]:
    """Write one camera, or two with their relative pose."""
    kind = {".xml": ".xml", ".json": ".json"}.get(path.suffix.lower(), ".yml")
    file = cv2.FileStorage(kind, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    if cameras[0].size != cameras[-1].size:
        raise InputError(
            f"OpenCV's stereo file has one image size; these cameras have {cameras[0].size} and {cameras[-1].size}: "
            "write each by itself (rig.json:left), or a format that has both, such as kalibr"
        )
    if cameras[0].model.fisheye != cameras[-1].model.fisheye:
        raise InputError("OpenCV's stereo file has two fisheyes or none: write the cameras one by one")
    file.write("image_width", cameras[0].size[0])
    file.write("image_height", cameras[0].size[1])
    keys = [("camera_matrix", "distortion_coefficients")] if len(cameras) == 1 else [("M1", "D1"), ("M2", "D2")]
    for camera, (matrix, coefficients) in zip(cameras, keys, strict=True):
        file.write(matrix, np.array(plain(camera.matrix)))
        file.write(coefficients, np.array([_five(camera)]))
    file.write("fisheye_model", int(cameras[0].model.fisheye))
    if len(cameras) == 2 and poses:
        pair = ImportedCameras(format="opencv", cameras=tuple(cameras), poses=tuple(poses)).rig()
        file.write("R", np.array(plain(pair.right_from_left_rotation)))
        file.write("T", np.array(plain(pair.right_from_left_translation))[:, None])
    return [write_atomic(path, file.releaseAndGetString())]


def _five(camera: Camera) -> list[float]:
    """The coefficients, five at least where the lens is no fisheye: four could be a fisheye's."""
    lens: list[float] = camera.coefficients.tolist()
    return lens if camera.model.fisheye else lens + [0.0] * (5 - len(lens))


# ROS's `camera_info` files, as camera_calibration writes and camera_info_manager reads them: one file per camera.
#
# A pair has the rectification of both cameras: a point of the rectified frame of the left camera is at R^T (p + (Tx /
# fx, 0, 0)) of the right one, with Tx the fourth column of its projection matrix.


def read_ros(path: Path, hints: Hints) -> ImportedCameras:
    """Read a camera, and how it is rectified: YAML, echoed messages, or the calibrator's text, `ost.txt`."""
    text = read_text(path, MOST_BYTES)
    if ROS_TEXT.search(text):
        return ros_camera(_sections(text), path.stem, hints)
    # Messages of one camera differ in their times alone.
    timeless = re.sub(r"\A\s*%YAML:.*|^[ \t]*(?:seq|n?secs?|nanosec): .*", "", text, flags=re.MULTILINE)
    parts = list(dict.fromkeys(part.strip() for part in re.split(r"^---[ \t]*$", timeless, flags=re.MULTILINE)))
    contents = [read_yaml(part, str(path)) for part in parts if part]
    if len(contents) == 1:
        return ros_camera(contents[0], path.stem, hints)
    found = [ros_camera(each, str(each["header"]["frame_id"]), hints) for each in contents]
    names = [camera_name(each.cameras[0], "") for each in found]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"messages of {twice[0]} differ: leave those of one calibration in the file")
    return dataclasses.replace(
        found[0],
        cameras=tuple(each.cameras[0] for each in found),
        poses=tuple(pose for each in found for pose in each.poses),
        notes=tuple(dict.fromkeys(note for each in found for note in each.notes)),
    )


def ros_camera(content: Mapping[str, Any], name: str, hints: Hints) -> ImportedCameras:
    """The camera of the values of a file of ROS, or of a message, and how it is rectified."""
    found = read_keyed(content, str(content.get("camera_name") or name), hints, "ros")
    turn, projected = (
        flat(content.get(long, content.get(short, content.get(short.lower()))))
        for long, short in (("rectification_matrix", "R"), ("projection_matrix", "P"))
    )
    # Zeros are what a message has before anybody fills it in.
    if not any(turn or ()) or not any(projected or ()) or len(found.cameras) != 1:
        return found
    rotation = np.array(numbers(turn, 9, "rectification_matrix")).reshape(3, 3)
    projection = np.array(numbers(projected, 12, "projection_matrix")).reshape(3, 4)
    if not projection[0, 0] > 0 or not projection[1, 1] > 0:
        raise ValueError("projection_matrix has no focal length")
    beside = np.array([projection[0, 3] / projection[0, 0], projection[1, 3] / projection[1, 1], 0.0])
    pose = checked_pose(rotation.T.tolist(), (rotation.T @ beside).tolist())
    return dataclasses.replace(found, poses=(pose,))


# The calibrator's `ost.txt`: names of values, each above its numbers.
ROS_TEXT = re.compile(r"^[ \t]*camera matrix[ \t]*$", re.MULTILINE)


def _sections(text: str) -> dict[str, Any]:
    """Its values by their names; the name of the last section is the camera's."""
    found: dict[str, Any] = {}
    name = ""
    for line in map(str.strip, text.splitlines()):
        if line.startswith("["):
            found["camera_name"] = line.strip("[]")
        elif re.match("[A-Za-z]", line):
            name = {"width": "image_width", "height": "image_height", "distortion": "distortion_coefficients"}.get(
                line, f"{line}_matrix" if line in ("rectification", "projection") else line.replace(" ", "_")
            )
            if name in found:
                raise ValueError(f"{line} is there twice: two cameras in one file; split it")
            found[name] = []
        elif line and not line.startswith("#"):
            found[name] += [float(word) for word in line.split()]
    return found


def write_ros(cameras: Sequence[Camera], poses: Sequence[Pose], path: Path) -> list[Path]:
    """Write a file for each camera; two with poses are rectified as by `cv2.stereoRectify`."""
    paths = paths_for(path, len(cameras))
    for (size, kind, matrices), camera, target in zip(ros_values(cameras, poses), cameras, paths, strict=True):
        blocks = [{"rows": len(one), "cols": one.shape[1], "data": one.ravel().tolist()} for one in matrices]
        content: dict[str, Any] = {
            "image_width": size[0],
            "image_height": size[1],
            "camera_name": camera_name(camera, target.stem),
            "camera_matrix": blocks[0],
            "distortion_model": kind,
            "distortion_coefficients": blocks[1],
            "rectification_matrix": blocks[2],
            "projection_matrix": blocks[3],
        }
        write_atomic(target, dump_yaml(content))
    return paths


def ros_values(
    cameras: Sequence[Camera], poses: Sequence[Pose]
) -> Iterator[tuple[tuple[int, int], str, list[np.ndarray]]]:
    """Size, name of the lens model, and K, D (1, N), R and P of each camera; two with poses are rectified."""
    matrices = [np.array(plain(camera.matrix)) for camera in cameras]
    rectified: list[tuple[np.ndarray, np.ndarray]]
    rectified = [(np.eye(3), np.pad(matrix, ((0, 0), (0, 1)))) for matrix in matrices]
    if len(cameras) == 2 and poses:
        rig = ImportedCameras(format="ros", cameras=tuple(cameras), poses=tuple(poses)).rig()
        rotation, translation = np.array(plain(rig.right_from_left_rotation)), plain(rig.right_from_left_translation)
        none, shift = np.zeros(5), np.array(translation)[:, None]
        # The lens only affects how much of the image is kept. Rows of the frame shared by both cameras; its x axis is
        # the baseline, so nothing is left along y and z.
        left, right, project_left, project_right = cv2.stereoRectify(
            matrices[0], none, matrices[1], none, cameras[0].size, rotation, shift, alpha=0
        )[:4]
        rectified = [(left, project_left), (right, project_right)]
    for camera, matrix, turned in zip(cameras, matrices, rectified, strict=True):
        lens = _five(camera)
        kind = "equidistant" if camera.model.fisheye else "rational_polynomial" if len(lens) > 5 else "plumb_bob"
        yield camera.size, kind, [matrix, np.array([lens]), *turned]


# TOML files of aniposelib, pose2sim and Caliscope: a table per camera, in OpenCV's conventions.
#
# `matrix`, `distortions`, `size`, and from the world's frame `rotation` (a vector) and `translation`. Caliscope has the
# tables inside `cameras`. No unit of length is in these files: pose2sim and Caliscope have meters, aniposelib has
# whatever its board was given in.

# A thousand cameras take half of it.
_MOST_BYTES = 2**20


def read_toml(path: Path, hints: Hints) -> ImportedCameras:
    """Read all cameras of a file; poses are from the frame of the world, if every camera has one."""
    text = read_text(path, _MOST_BYTES)
    try:
        content: Mapping[str, Any] = tomllib.loads(text)
    except tomllib.TOMLDecodeError:
        if path.suffix.lower() == ".toml":
            raise
        content = ini_sections(text)
    return read_keyed(content, path.stem, hints, "toml")


def write_toml(cameras: Sequence[Camera], poses: Sequence[Pose], path: Path) -> list[Path]:
    """Write cameras as aniposelib does, with translations in meters."""
    lines: list[str] = []
    for index, camera in enumerate(cameras):
        rotation, translation = [0.0] * 3, [0.0] * 3
        if poses:
            rotation, translation = plain(vector_from_rotation(poses[index].rotation)), plain(poses[index].translation)
        lines += [
            f"[cam_{index}]",
            # JSON's texts are TOML's.
            f"name = {json.dumps(camera_name(camera, f'cam_{index}'))}",
            f"size = {[float(side) for side in camera.size]}",
            f"matrix = {plain(camera.matrix)}",
            f"distortions = {_five(camera)}",
            f"rotation = {rotation}",
            f"translation = {translation}",
            f"fisheye = {str(camera.model.fisheye).lower()}",
            "",
        ]
    return [write_atomic(path, "\n".join([*lines, "[metadata]", ""]))]


# multical's `calibration.json`: OpenCV's cameras by name, and cam_from_rig of each; `left_to_right` is left_from_right.


def read_multical(path: Path, hints: Hints) -> ImportedCameras:
    """Read all cameras; poses are from the frame of the rig, or of the camera that has none to another."""
    content = read_json(read_bytes(path, MOST_BYTES), str(path))
    found = read_keyed({"cameras": content["cameras"]}, path.stem, hints, "multical")
    stated = {
        name: checked_pose(value["R"], numbers(value["T"], 3, f"T of {name}"))
        for name, value in content.get("camera_poses", {}).items()
    }

    def posed(name: str, depth: int = 0) -> Pose | None:
        if name in stated or depth > len(stated):
            return stated.get(name)
        key = next((key for key in stated if key.startswith(f"{name}_to_")), None)
        other = None if key is None else posed(key.removeprefix(f"{name}_to_"), depth + 1)
        return None if key is None or other is None else stated[key].after(other)

    poses = [posed(name) for name in found.names]
    whole = tuple(pose for pose in poses if pose is not None)
    lacking = [name for name, pose in zip(found.names, poses, strict=True) if pose is None]
    notes = (f"no pose of {', '.join(lacking)}: no pose is read",) if lacking and whole else ()
    return dataclasses.replace(found, poses=() if lacking else whole, notes=(*found.notes, *notes))


def write_multical(cameras: Sequence[Camera], poses: Sequence[Pose], path: Path) -> list[Path]:
    """Write all cameras, with their poses if there are any."""
    names = [camera_name(camera, f"cam{i}") for i, camera in enumerate(cameras)]
    kinds = {8: "rational", 12: "thin_prism", 14: "tilted"}
    lenses = {
        name: {
            "model": kinds.get(camera.model.size, "standard"),
            "image_size": list(camera.size),
            "K": plain(camera.matrix),
            "dist": [_five(camera)],
        }
        for name, camera in zip(names, cameras, strict=True)
    }
    places = {name: {"R": plain(R), "T": plain(t)} for name, (R, t) in zip(names, poses, strict=False)}
    return [write_atomic(path, dump_json({"cameras": lenses} | ({"camera_poses": places} if places else {})))]


# calib.io's JSON: OpenCV's lens, or MATLAB's with a skew; f is fx, and ar = fy / fx.


def read_calibio(path: Path, hints: Hints) -> ImportedCameras:
    """Read all cameras; which way their transforms lead is not published, and so they are not read."""
    parts = read_json(read_bytes(path, MOST_BYTES), str(path))["Calibration"]["cameras"]
    cameras = {f"camera_{i}": _calibio_camera(part["model"]) for i, part in enumerate(parts)}
    found = read_keyed({"cameras": cameras}, path.stem, hints, "calibio")
    lost = ("how the cameras stand to each other is not read: solve the rig with kcal rig",) if len(parts) > 1 else ()
    return dataclasses.replace(found, notes=(*found.notes, *lost))


def _calibio_camera(model: Mapping[str, Any]) -> dict[str, Any]:
    kind, data = str(model["polymorphic_name"]), model["ptr_wrapper"]["data"]
    if kind not in ("libCalib::CameraModelOpenCV", "libCalib::CameraModelMatlab"):
        raise ValueError(f"model {kind}: kcal reads libCalib::CameraModelOpenCV and libCalib::CameraModelMatlab")
    given = {name: numbers(part["val"], 1, name)[0] for name, part in data["parameters"].items()}
    order = LensModel.named("opencv14").names if kind.endswith("CV") else LensModel.named("opencv5").names
    terms = {name: given.pop(name.replace("tau_x", "tauX").replace("tau_y", "tauY"), 0.0) for name in order}
    f, ratio, cx, cy, skew = (given.pop(name, otherwise) for name, otherwise in _CALIBIO.items())
    if strange := [name for name, value in given.items() if value]:
        raise ValueError(f"{', '.join(strange)}: parameters that kcal does not know")
    base = data["CameraModelCRT"]["CameraModelBase"]
    size = base.get("imageSize") or {"width": base["imageWidth"], "height": base["imageHeight"]}
    return {"fx": f, "fy": f * ratio, "cx": cx, "cy": cy, "skew": skew, "dist": list(terms.values()), **size}


_CALIBIO = {"f": 0.0, "ar": 1.0, "cx": 0.0, "cy": 0.0, "skew": 0.0}


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
    data = read_bytes(path, MOST_BYTES)
    structs = read_json(data, str(path)) if data[:1] == b"{" else read_mat(data, str(path))
    if {"fc", "cc"} <= set(structs) or {"fc_left", "fc_right"} <= set(structs):
        return _bouguet(structs, path.stem, hints)
    # A file may hold one struct, or its fields.
    candidates = [*structs.items(), (path.stem, structs)]
    errors = next((value for _, value in candidates if isinstance(value, Mapping) and _ERRORS & set(value)), {})
    for _, value in candidates:
        if isinstance(value, Mapping) and "CameraParameters1" in value:
            return _with_errors(_pair(value, hints), [errors.get(f"Camera{i}IntrinsicsErrors") for i in (1, 2)])
    for name, value in candidates:
        inner = value.get("Intrinsics", value) if isinstance(value, Mapping) else {}
        if isinstance(inner, Mapping) and "MappingCoefficients" in inner:
            notes: list[str] = []
            camera = _scaramuzza(inner, name, hints, notes)
            return ImportedCameras(format="matlab", cameras=(camera,), notes=tuple(notes))
        if isinstance(value, Mapping) and {"K", "IntrinsicMatrix", "FocalLength"} & set(value):
            found = ImportedCameras(format="matlab", cameras=(_matlab_camera(value, name, hints),))
            return _with_errors(found, [errors.get("IntrinsicsErrors")])
    raise ValueError("no struct of camera parameters; save one with s = toStruct(params); save('file.mat', 's')")


def _bouguet(value: Mapping[str, Any], name: str, hints: Hints) -> ImportedCameras:
    """What Bouguet's toolbox saves: pixels from 0, the skew as a fraction of fx, and errors of three deviations.

    Source: Camera Calibration Toolbox for Matlab, "Description of the calibration parameters".
    """
    content = {
        new: value[old] for new, old in (("width", "nx"), ("height", "ny"), ("R", "R"), ("T", "T")) if old in value
    }
    for side in ("", "_left", "_right"):
        if f"fc{side}" in value:
            fx, fy, cx, cy = (*numbers(value[f"fc{side}"], 2, "fc"), *numbers(value[f"cc{side}"], 2, "cc"))
            alpha = numbers(value.get(f"alpha_c{side}", 0.0), 1, "alpha_c")[0]
            own = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "skew": alpha * fx, "kc": value.get(f"kc{side}", [])}
            content |= {f"{key}{side}": number for key, number in own.items()}
    if {"fc_error", "cc_error", "kc_error"} <= set(value):
        errors = (numbers(value[key], range(6), key) for key in ("fc_error", "cc_error", "kc_error"))
        content["std_dev"] = [error / 3.0 for part in errors for error in part]
    found = read_keyed(content, name, hints._replace(meters=hints.meters or 1e-3), "matlab")
    unsaid = (
        ("the unit of T is not in the file: taken as millimeters (--unit)",) if found.poses and not hints.meters else ()
    )
    return dataclasses.replace(found, notes=(*found.notes, *unsaid))


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


def _scaramuzza(value: Mapping[str, Any], name: str, hints: Hints, notes: list[str]) -> Camera:
    """MATLAB's `fisheyeIntrinsics`: the ray of a place (x, y) on the sensor is (x, y, a0 + a2 ρ² + a3 ρ³ + a4 ρ⁴).

    Source: Scaramuzza, Martinelli and Siegwart 2006, and MATLAB's documentation of `fisheyeIntrinsics`.
    """
    a0, *rest = numbers(value["MappingCoefficients"], 4, "MappingCoefficients")
    u, v = numbers(value["DistortionCenter"], 2, "DistortionCenter")
    stretch = numbers(value.get("StretchMatrix", [1.0, 0.0, 0.0, 1.0]), 4, "StretchMatrix")
    size = known_size(hints.size or whole_size(*numbers(value["ImageSize"], 2, "ImageSize")[::-1]))
    back = torch.linalg.inv(torch.tensor(stretch, dtype=torch.float64).reshape(2, 2))

    def unproject(pixels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        plane = (pixels + 1.0 - pixels.new_tensor([u, v])) @ back.T
        radius = plane.norm(dim=-1)
        depth = a0 + sum(a * radius**n for n, a in enumerate(rest, 2))
        # Where angles from the axis grow with the radius.
        grows = a0 - sum((n - 1) * a * radius**n for n, a in enumerate(rest, 2)) > 0
        return torch.nn.functional.normalize(torch.cat([plane, depth[:, None]], -1), dim=-1), grows

    like = named_camera(name, (a0, a0, u - 1.0, v - 1.0), size, "pinhole")
    return nearest_hybrid(unproject, like, "its fisheye lens of MATLAB", notes)


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
    pose = checked_pose(rotation.tolist(), (meters * translation).tolist())
    return ImportedCameras(format="matlab", cameras=cameras, poses=(Pose.still(), pose), notes=notes)


def write_matlab(cameras: Sequence[Camera], poses: Sequence[Pose], path: Path) -> list[Path]:
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
