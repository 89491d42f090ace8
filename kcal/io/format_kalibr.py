"""Kalibr's camchain YAML: `cam0`, `cam1`, ... with `T_cn_cnm1` from each camera to the next."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kcal.files import write_atomic
from kcal.io.foreign import (
    CameraPose,
    Hints,
    ImportedCameras,
    checked_pose,
    dump_yaml,
    load_yaml,
    named_camera,
    numbers,
    plain,
    whole_size,
)
from kcal.lens.camera import Camera

MODELS = ("pinhole", "opencv4", "fisheye4")
_LENSES = {"radtan": "opencv4", "equidistant": "fisheye4", "none": "pinhole"}


def read_kalibr(path: Path, hints: Hints) -> ImportedCameras:
    """Read all cameras of a chain; poses are from the first camera's frame."""
    content = load_yaml(path)
    cameras: list[Camera] = []
    poses: list[CameraPose] = []
    lost: set[str] = set()
    whole = np.eye(4)
    while (name := f"cam{len(cameras)}") in content:
        part = content[name]
        kind, lens = str(part["camera_model"]), str(part["distortion_model"])
        if kind != "pinhole" or lens not in _LENSES:
            raise ValueError(f"{name}: camera_model {kind} with distortion_model {lens}: kcal reads pinhole with "
                             f"{', '.join(_LENSES)}")  # fmt: skip
        model = _LENSES[lens]
        coefficients = numbers(
            part.get("distortion_coeffs", []), 0 if lens == "none" else 4, f"{name} distortion_coeffs"
        )
        intrinsics = numbers(part["intrinsics"], 4, f"{name} intrinsics")
        cameras.append(named_camera(name, intrinsics, whole_size(*part["resolution"]), model, coefficients))
        if "T_cn_cnm1" in part:
            step = np.array(numbers(part["T_cn_cnm1"], 16, f"{name} T_cn_cnm1")).reshape(4, 4)
            whole = step @ whole
        elif len(cameras) > 1:
            poses = []
            lost.add(f"{name} has no T_cn_cnm1")
            continue
        poses.append(checked_pose(whole[:3, :3].tolist(), whole[:3, 3].tolist()))
        lost |= {f"{key} is not kept" for key in ("T_cam_imu", "timeshift_cam_imu") if key in part}
    if not cameras:
        raise ValueError("no cam0")
    return ImportedCameras(
        format="kalibr",
        cameras=tuple(cameras),
        poses=tuple(poses) if len(poses) == len(cameras) > 1 else (),
        notes=tuple(sorted(lost)),
    )


class KalibrLens(NamedTuple):
    """A lens as Kalibr writes it."""

    camera_model: str
    intrinsics: Sequence[float]
    distortion_model: str
    distortion_coeffs: Sequence[float]
    resolution: tuple[int, int]


def write_kalibr(cameras: Sequence[Camera], poses: Sequence[CameraPose], path: Path) -> list[Path]:
    """Write a chain of cameras."""
    names = {model: name for name, model in _LENSES.items()}
    lenses = [
        KalibrLens(
            "pinhole",
            camera.params[:4].tolist(),
            "radtan" if not camera.model.size else names[str(camera.model)],
            camera.coefficients.tolist() or [0.0] * 4,
            camera.size,
        )
        for camera in cameras
    ]
    return write_chain(lenses, poses, path)


def write_omni(
    cameras: Sequence[Camera], values: Sequence[Sequence[float]], poses: Sequence[CameraPose], path: Path
) -> list[Path]:
    """Write a chain of cameras as omni-radtan, with the nine numbers of `kcal.io.kalibr_omni.fit_omni` for each."""
    lenses = [
        KalibrLens("omni", list(own[:5]), "radtan", list(own[5:]), camera.size)
        for camera, own in zip(cameras, values, strict=True)
    ]
    return write_chain(lenses, poses, path)


def write_chain(lenses: Sequence[KalibrLens], poses: Sequence[CameraPose], path: Path) -> list[Path]:
    """Write lenses, and the pose of each from the one before, as a camchain."""
    content: dict[str, Any] = {}
    for i, lens in enumerate(lenses):
        part: dict[str, Any] = {
            "cam_overlaps": [k for k in range(len(lenses)) if k != i],
            "camera_model": lens.camera_model,
            "distortion_coeffs": list(lens.distortion_coeffs),
            "distortion_model": lens.distortion_model,
            "intrinsics": list(lens.intrinsics),
            "resolution": list(lens.resolution),
            "rostopic": f"/cam{i}/image_raw",
        }
        if i and poses:
            before, here = poses[i - 1], poses[i]
            rotation = here.rotation @ before.rotation.T
            translation = here.translation - rotation @ before.translation
            step = np.eye(4)
            step[:3, :3], step[:3, 3] = np.array(plain(rotation)), plain(translation)
            part["T_cn_cnm1"] = step.tolist()
        content[f"cam{i}"] = part
    return [write_atomic(path, dump_yaml(content))]
