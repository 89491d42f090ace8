"""ROS's `camera_info` files, as camera_calibration writes and camera_info_manager reads them: one file per camera.

A pair has the rectification of both cameras: a point of the rectified frame of the left camera is at R^T (p + (Tx / fx,
0, 0)) of the right one, with Tx the fourth column of its projection matrix.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from kcal.files import write_atomic
from kcal.io.foreign import (
    CameraPose,
    Hints,
    ImportedCameras,
    camera_name,
    checked_pose,
    core_of,
    dump_yaml,
    load_yaml,
    named_camera,
    numbers,
    paths_for,
    plain,
    whole_size,
)
from kcal.lens.camera import Camera

MODELS = ("pinhole", "opencv4", "opencv5", "opencv8", "fisheye4")
_LENSES = {
    "plumb_bob": ("opencv5", (4, 5)),
    "rational_polynomial": ("opencv8", (8,)),
    "equidistant": ("fisheye4", (4,)),
}


def read_ros(path: Path, hints: Hints) -> ImportedCameras:
    """Read one camera, and how it is rectified."""
    content = load_yaml(path)
    name = str(content.get("camera_name") or path.stem)
    kind = str(content.get("distortion_model") or "plumb_bob")
    if kind not in _LENSES:
        raise ValueError(f"distortion_model {kind!r}: kcal reads {', '.join(_LENSES)}")
    model, counts = _LENSES[kind]
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
