"""TOML files of aniposelib, pose2sim and Caliscope: a table per camera, in OpenCV's conventions.

`matrix`, `distortions`, `size`, and from the world's frame `rotation` (a vector) and `translation`. Caliscope has the
tables inside `cameras`. No unit of length is in these files: pose2sim and Caliscope have meters, aniposelib has
whatever its board was given in.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from kcal.files import read_text, write_atomic
from kcal.io.foreign import (
    CameraPose,
    Hints,
    ImportedCameras,
    camera_name,
    checked_pose,
    core_of,
    known_size,
    named_camera,
    numbers,
    plain,
    whole_size,
)
from kcal.lens.camera import Camera
from kcal.lens.camera_conversions import OPENCV_MODELS
from kcal.lens.pose import rotation_from_vector, vector_from_rotation

MODELS = ("pinhole", "opencv4", "opencv5", "opencv8", "opencv12", "opencv14", "fisheye4")
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
