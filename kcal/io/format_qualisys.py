"""Qualisys Track Manager's `.qca.txt`: XML with OpenCV's five coefficients of each camera, and its pose in millimeters.

Lengths in the image are 1/64 px; the center of the first pixel is at 31.5/64 px of the sensor, and `fov_video` says
which part of the sensor the video is. Cameras look along -z there, with y upwards.
"""

from __future__ import annotations

from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from kcal.files import read_bytes
from kcal.io.foreign import (
    MOST_BYTES,
    CameraPose,
    Hints,
    ImportedCameras,
    checked_pose,
    named_camera,
    numbers,
    whole_size,
)
from kcal.lens.camera import Camera
from kcal.strict_xml import read_xml

_UNITS = 64.0
_FIRST = 31.5 / _UNITS
_CORE = ("focalLengthU", "focalLengthV", "centerPointU", "centerPointV", "skew")
_LENS = ("radialDistortion1", "radialDistortion2", "tangentalDistortion1", "tangentalDistortion2", "radialDistortion3")


def read_qualisys(path: Path, hints: Hints) -> ImportedCameras:
    """Read all cameras; those that were not calibrated are left out, with a note."""
    root = read_xml(read_bytes(path, MOST_BYTES), str(path))
    cameras, poses, notes = [], [], []
    for number, part in enumerate(root.iterfind(".//cameras/camera"), 1):
        name = part.get("serial") or f"camera {number}"
        if part.find("intrinsic") is None or part.get("calibrated") == "false":
            notes.append(f"camera {name} is not calibrated")
            continue
        cameras.append(_qualisys_camera(part, name))
        poses.append(_qualisys_pose(part))
    if not cameras:
        raise ValueError("no calibrated camera")
    return ImportedCameras(format="qualisys", cameras=tuple(cameras), poses=tuple(poses), notes=tuple(notes))


def _attributes(part: Element, tag: str, names: tuple[str, ...]) -> list[float]:
    found = part.find(tag)
    if found is None:
        raise ValueError(f"a camera has no {tag}")
    return numbers([found.attrib[name] for name in names], len(names), tag)


def _qualisys_camera(part: Element, name: str) -> Camera:
    left, top, right, bottom = _attributes(part, "fov_video", ("left", "top", "right", "bottom"))
    fx, fy, cx, cy, skew = (value / _UNITS for value in _attributes(part, "intrinsic", _CORE))
    size = whole_size(right - left + 1.0, bottom - top + 1.0)
    center = cx - _FIRST - left, cy - _FIRST - top
    return named_camera(name, (fx, fy, *center), size, "opencv5", _attributes(part, "intrinsic", _LENS), skew)


def _qualisys_pose(part: Element) -> CameraPose:
    names = tuple(f"r{row}{column}" for row in "123" for column in "123")
    axes = np.array(_attributes(part, "transform", names)).reshape(3, 3)
    # From axes to the right, up and backwards to those to the right, down and ahead.
    rotation = np.diag([1.0, -1.0, -1.0]) @ axes
    center = 1e-3 * np.array(_attributes(part, "transform", ("x", "y", "z")))
    return checked_pose(rotation.tolist(), (-rotation @ center).tolist())
