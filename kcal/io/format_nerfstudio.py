"""nerfstudio's `transforms.json`: intrinsics of one camera, or of each frame. Pixel (0.5, 0.5) is the first center."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from kcal.errors import InputError
from kcal.files import dump_json, read_bytes, write_atomic
from kcal.io.foreign import MOST_BYTES, CameraPose, Hints, ImportedCameras, named_camera, numbers, whole_size
from kcal.lens.camera import Camera
from kcal.strict_json import read_json

MODELS = ("pinhole", "opencv4", "opencv5", "fisheye4")
_HALF = 0.5
_FIELDS = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_model", "k1", "k2", "k3", "k4", "p1", "p2")


def read_nerfstudio(path: Path, hints: Hints) -> ImportedCameras:
    """Read the cameras; frames with intrinsics of their own that are equal are one camera."""
    content = read_json(read_bytes(path, MOST_BYTES), str(path))
    frames = content.get("frames", [])
    shared = {key: content[key] for key in _FIELDS if key in content}
    found: dict[str, dict[str, Any]] = {}
    for i, frame in enumerate(frames or [{}]):
        values = shared | {key: frame[key] for key in _FIELDS if key in frame}
        found.setdefault(json.dumps(values, sort_keys=True), values | {"name": str(frame.get("file_path", i))})
    single = len(found) == 1
    cameras = tuple(_nerfstudio_camera(values, path.stem if single else values["name"]) for values in found.values())
    notes = ("the poses of the frames are not kept",) if any("transform_matrix" in frame for frame in frames) else ()
    return ImportedCameras(format="nerfstudio", cameras=cameras, notes=notes)


def _nerfstudio_camera(values: dict[str, Any], name: str) -> Camera:
    kind = str(values.get("camera_model", "OPENCV"))
    if kind not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV_FISHEYE"):
        raise ValueError(f"camera_model {kind}: kcal reads OPENCV, PINHOLE and OPENCV_FISHEYE")
    size = whole_size(values["w"], values["h"])
    fx, cx, cy = numbers([values["fl_x"], values["cx"], values["cy"]], 3, "fl_x, cx, cy")
    fy = float(values.get("fl_y", fx))
    k1, k2, k3, k4, p1, p2 = (float(values.get(key, 0.0)) for key in ("k1", "k2", "k3", "k4", "p1", "p2"))
    intrinsics = (fx, fy, cx - _HALF, cy - _HALF)
    if kind == "OPENCV_FISHEYE":
        return named_camera(name, intrinsics, size, "fisheye4", [k1, k2, k3, k4])
    if k4:
        raise ValueError("k4 is a fourth radial coefficient here, which kcal's models with OpenCV's names do not have")
    lens = [k1, k2, p1, p2, k3] if kind == "OPENCV" else []
    while lens and lens[-1] == 0.0 and len(lens) > 4:
        lens.pop()
    return named_camera(name, intrinsics, size, {0: "pinhole", 4: "opencv4", 5: "opencv5"}[len(lens)], lens)


def write_nerfstudio(cameras: Sequence[Camera], poses: Sequence[CameraPose], path: Path) -> list[Path]:
    """Write the intrinsics of one camera, and no frames."""
    if len(cameras) != 1:
        raise InputError("transforms.json has one camera; write the cameras one by one")
    camera = cameras[0]
    fx, fy, cx, cy = camera.params[:4].tolist()
    lens = dict(zip(camera.model.names, camera.coefficients.tolist(), strict=True))
    content: dict[str, Any] = {
        "w": camera.size[0],
        "h": camera.size[1],
        "fl_x": fx,
        "fl_y": fy,
        "cx": cx + _HALF,
        "cy": cy + _HALF,
        "camera_model": "OPENCV_FISHEYE" if camera.model.fisheye else "OPENCV",
        **lens,
        "frames": [],
    }
    return [write_atomic(path, dump_json(content))]
