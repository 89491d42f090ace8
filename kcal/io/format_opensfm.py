"""OpenSfM's and OpenDroneMap's `camera_models.json` and `cameras.json`: lengths in units of the image's longer side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from kcal.files import dump_json, read_bytes, write_atomic
from kcal.io.foreign import MOST_BYTES, CameraPose, Hints, ImportedCameras, camera_name, named_camera, whole_size
from kcal.lens.camera import Camera
from kcal.strict_json import read_json

MODELS = ("pinhole", "opencv4", "opencv5", "fisheye4")
# Coefficients by projection type, in kcal's order, and kcal's model.
_LENSES = {
    "perspective": (("k1", "k2"), "opencv4"),
    "simple_radial": (("k1",), "opencv4"),
    "radial": (("k1", "k2"), "opencv4"),
    "brown": (("k1", "k2", "p1", "p2", "k3"), "opencv5"),
    "fisheye": (("k1", "k2"), "fisheye4"),
    "fisheye_opencv": (("k1", "k2", "k3", "k4"), "fisheye4"),
}


def read_opensfm(path: Path, hints: Hints) -> ImportedCameras:
    """Read all cameras, by their names."""
    content = read_json(read_bytes(path, MOST_BYTES), str(path))
    if isinstance(content, list):
        content = content[0]
    content = content.get("cameras", content)
    cameras = tuple(_opensfm_camera(name, value) for name, value in content.items())
    if not cameras:
        raise ValueError("no cameras")
    return ImportedCameras(format="opensfm", cameras=cameras)


def _opensfm_camera(name: str, value: Mapping[str, Any]) -> Camera:
    kind = str(value["projection_type"])
    if kind not in _LENSES:
        raise ValueError(f"{name}: projection_type {kind}: kcal reads {', '.join(_LENSES)}")
    names, model = _LENSES[kind]
    size = whole_size(value["width"], value["height"])
    longer = max(size)
    fx = longer * float(value.get("focal_x", value.get("focal")))
    fy = longer * float(value["focal_y"]) if "focal_y" in value else fx
    cx, cy = (
        longer * float(value.get(key, 0.0)) + 0.5 * (side - 1) for key, side in zip(("c_x", "c_y"), size, strict=True)
    )
    return named_camera(name, (fx, fy, cx, cy), size, model, [float(value.get(key, 0.0)) for key in names])


def write_opensfm(cameras: Sequence[Camera], poses: Sequence[CameraPose], path: Path) -> list[Path]:
    """Write all cameras, by their names."""
    content: dict[str, Any] = {}
    for i, camera in enumerate(cameras):
        fx, fy, cx, cy = camera.params[:4].tolist()
        (width, height), longer = camera.size, max(camera.size)
        lens = dict(zip(camera.model.names, camera.coefficients.tolist(), strict=True))
        kind = "fisheye_opencv" if camera.model.fisheye else "brown"
        content[camera_name(camera, f"camera {i}")] = {
            "projection_type": kind,
            "width": width,
            "height": height,
            "focal_x": fx / longer,
            "focal_y": fy / longer,
            "c_x": (cx - 0.5 * (width - 1)) / longer,
            "c_y": (cy - 0.5 * (height - 1)) / longer,
            **{key: lens.get(key, 0.0) for key in _LENSES[kind][0]},
        }
    return [write_atomic(path, dump_json(content))]
