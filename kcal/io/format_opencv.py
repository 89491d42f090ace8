"""OpenCV's YAML, XML and JSON files of one camera or a stereo pair, as its samples write and read them.

One camera: `image_width`, `image_height`, `camera_matrix`, `distortion_coefficients` (k1 k2 p1 p2 k3 k4 k5 k6 s1 s2 s3
s4 τx τy), `fisheye_model`; `xi` of an omnidir camera; `stdDeviationsIntrinsics` of `calibrateCamera`. A pair: `M1`,
`D1`, `M2`, `D2` and `R`, `T`, in one file or in two.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from kcal.errors import InputError
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
from kcal.io.kalibr_omni import omni_camera
from kcal.lens.camera import Camera
from kcal.lens.camera_conversions import OPENCV_MODELS
from kcal.opencv_storage import read_storage

MODELS = (*OPENCV_MODELS.values(), "fisheye4")
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
