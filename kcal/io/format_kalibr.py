"""Kalibr: camchains and results of its calibrations."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import kcal.io.foreign as foreign
from kcal.files import read_text, write_atomic
from kcal.io.foreign_lenses import ForeignCamera, as_written, foreign_camera
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose
from kcal.strict_formats import MOST_YAML, read_yaml

# Kalibr's camchain YAML: `cam0`, `cam1`, ... with `T_cn_cnm1` from each camera to the next.

_LENSES = {"radtan": "opencv4", "equidistant": "fisheye4", "none": "pinhole"}
# Of a text of results: names of lenses, and lines with numbers and their standard deviations.
_GEOMETRIES = {"DistortedPinholeCamera": "opencv4", "EquidistantDistortedPinholeCamera": "fisheye4"}
_RESULTS = re.compile(r"^[ \t]*(distortion|projection): \[([^\]\n]*)\] \+- \[([^\]\n]*)\]", re.MULTILINE)


def read_kalibr(path: Path, hints: foreign.Hints) -> foreign.ImportedCameras:
    """Read all cameras of a chain, with poses from the first camera's frame; or of a `results-cam.txt`, with σ."""
    text = read_text(path, MOST_YAML)
    if _RESULTS.search(text):
        return _read_results(text, hints)
    content = read_yaml(text, str(path))
    names = [name for name in content if re.fullmatch(r"cam\d+", str(name))]
    parts = {name: foreign.Keys(content[name]) for name in names}
    notes: list[str] = []
    cameras, unread = foreign.each_readable((name, partial(_chain_camera, name, parts[name], notes)) for name in names)
    if not names:
        raise ValueError("no cam0")
    whole, poses = np.eye(4), dict[str, Pose]()
    first: np.ndarray | None = None
    for i, (name, part) in enumerate(parts.items()):
        imu = next((_transform(part, key, name) for key in ("T_cam_imu", "T_imu_cam") if key in part), None)
        if imu is not None:
            imu = imu if "T_cam_imu" in part else np.linalg.inv(imu)
            first = imu if not i else first
        if "T_cn_cnm1" in part:
            whole = _transform(part, "T_cn_cnm1", name) @ whole
        elif i and imu is not None and first is not None:
            whole = imu @ np.linalg.inv(first)
        elif i:
            poses = {}
            notes.append(f"{name} has neither T_cn_cnm1 nor T_cam_imu: no pose is read")
            break
        poses[name] = foreign.checked_pose(whole[:3, :3].tolist(), whole[:3, 3].tolist())
    if first is not None:
        notes.append("where the IMU is (T_cam_imu) is not kept")
    for name in parts:
        notes += parts[name].rest(f"{name}.") if name not in unread else []
    return foreign.ImportedCameras(
        format="kalibr",
        cameras=cameras,
        poses=tuple(pose for name, pose in poses.items() if name not in unread) if len(poses) > 1 else (),
        notes=tuple(dict.fromkeys(notes)),
        unread=unread,
    )


def _transform(part: Mapping[str, Any], key: str, name: str) -> np.ndarray:
    return np.array(foreign.numbers(part[key], 16, f"{name} {key}")).reshape(4, 4)


# Kinds of `kcal.io.foreign_lenses.LENSES`: the camera model, how many of the parameters come before the focal lengths,
# and the distortion model of the others.
KALIBR_LENSES = {
    "omni-radtan": ("omni", 1, "radtan"),
    "ds": ("ds", 2, "none"),
    "eucm": ("eucm", 2, "none"),
    "fov": ("pinhole", 0, "fov"),
}


def _chain_camera(name: str, part: Mapping[str, Any], notes: list[str]) -> Camera:
    model, lens = str(part["camera_model"]), str(part.get("distortion_model", "none"))
    size, plain = foreign.whole_size(*part["resolution"]), model == "pinhole" and lens in _LENSES
    kinds = {(model, lens): (kind, before) for kind, (model, before, lens) in KALIBR_LENSES.items()}
    kind, before = kinds.get((model, "radtan" if (model, lens) == ("omni", "none") else lens), ("", 0))
    if not kind and not plain:
        readable = [*(("pinhole", lens) for lens in _LENSES), ("omni", "none"), *kinds]
        raise ValueError(
            f"camera_model {model} with distortion_model {lens}: kcal reads "
            + ", ".join(f"{model} with {lens}" for model, lens in readable)
        )
    *values, fu, fv, pu, pv = foreign.numbers(part["intrinsics"], before + 4, f"{name} intrinsics")
    count = {"none": (0, 4) if before else 0, "fov": 1}.get(lens, 4)
    terms = foreign.numbers(part.get("distortion_coeffs", []), count, f"{name} distortion_coeffs")
    if lens == "none" and any(terms):
        raise ValueError("distortion_model none with coefficients")
    if plain:
        return foreign.named_camera(name, (fu, fv, pu, pv), size, _LENSES[lens], terms)
    own = [*values, *(terms if lens != "none" else [])]
    camera, note = foreign_camera(kind, name, (fu, fv, pu, pv), size, own)
    notes.append(note)
    return camera


def _read_results(text: str, hints: foreign.Hints) -> foreign.ImportedCameras:
    """The cameras of Kalibr's text of results, which has standard deviations and no image size."""
    size = foreign.known_size(hints.size)
    cameras, notes = [], {"poses are read from the camchain, not from the text of results"}
    for part in re.split(r"^(?=cam\d+ \()", text, flags=re.MULTILINE)[1:]:
        name, found = part.split(" ", 1)[0], {key: (value, sigma) for key, value, sigma in _RESULTS.findall(part)}
        kind = re.search(r"type:.*?\.(\w+)Geometry", part)
        if kind is None or kind[1] not in _GEOMETRIES:
            raise ValueError(f"{name}: {kind[1] if kind else 'no type'}: kcal reads {', '.join(_GEOMETRIES)}")
        lens = foreign.numbers(found["distortion"][0].split(), 4, f"{name} distortion")
        core = foreign.numbers(found["projection"][0].split(), 4, f"{name} projection")
        camera = foreign.named_camera(name, core, size, _GEOMETRIES[kind[1]], lens)
        sigmas = [foreign.numbers(found[key][1].split(), 4, f"{name} {key}") for key in ("projection", "distortion")]
        notes.add(foreign.with_sigmas(camera, [*sigmas[0], *sigmas[1]]))
        cameras.append(camera)
    return foreign.ImportedCameras(format="kalibr", cameras=tuple(cameras), notes=tuple(sorted(notes)))


def write_kalibr(cameras: Sequence[Camera | ForeignCamera], poses: Sequence[Pose], path: Path) -> list[Path]:
    """Write a chain of cameras, and the pose of each from the one before."""
    names, content = {model: name for name, model in _LENSES.items()}, dict[str, Any]()
    for i, camera in enumerate(cameras):
        _, kind, (fu, fv, pu, pv, _, *own) = as_written(camera)
        model, count, lens = KALIBR_LENSES.get(kind) or ("pinhole", 0, names[kind] if own else "radtan")
        part: dict[str, Any] = {
            "cam_overlaps": [k for k in range(len(cameras)) if k != i],
            "camera_model": model,
            "distortion_coeffs": own[count:] or [0.0] * 4,
            "distortion_model": lens,
            "intrinsics": [*own[:count], fu, fv, pu, pv],
            "resolution": list(camera.size),
            "rostopic": f"/cam{i}/image_raw",
        }
        if i and poses:
            step = poses[i].after(poses[i - 1].inverse())
            whole = np.eye(4)
            whole[:3, :3], whole[:3, 3] = np.array(foreign.plain(step.rotation)), foreign.plain(step.translation)
            part["T_cn_cnm1"] = whole.tolist()
        content[f"cam{i}"] = part
    return [write_atomic(path, foreign.dump_yaml(content))]
