"""Visual-inertial programs: camchains and results of Kalibr, and calibrations of Basalt."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import kcal.io.foreign as foreign
from kcal.files import dump_json, read_bytes, read_text, write_atomic
from kcal.io.foreign_lenses import ForeignCamera, as_written, foreign_camera
from kcal.lens.camera import Camera
from kcal.lens.pose import Pose
from kcal.strict_formats import MOST_YAML, read_yaml
from kcal.strict_json import read_json

# Kalibr's camchain YAML: `cam0`, `cam1`, ... with `T_cn_cnm1` from each camera to the next.

_LENSES = {"radtan": "opencv4", "equidistant": "fisheye4", "none": "pinhole"}
# Of a text of results: names of lenses, and lines with numbers and their standard deviations.
_GEOMETRIES = {"DistortedPinholeCamera": "opencv4", "EquidistantDistortedPinholeCamera": "fisheye4"}
_RESULTS = re.compile(r"^[ \t]*(distortion|projection): \[([^\]\n]*)\] \+- \[([^\]\n]*)\]", re.MULTILINE)


# Elements of two poses that are one, m: Kalibr fits each to the other, and files round.
_SAME_POSE = 1e-3


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
            by_imu = None if imu is None or first is None else imu @ np.linalg.inv(first)
            if i and by_imu is not None and np.abs(by_imu - whole).max() > _SAME_POSE:
                raise ValueError(f"{name}: T_cn_cnm1 and T_cam_imu are both there and differ by up to "
                                 f"{np.abs(by_imu - whole).max():.2g}; delete the one that is wrong")  # fmt: skip
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
    own = [*values, *(terms if lens != "none" else [])]
    return foreign_camera(_LENSES[lens] if plain else kind, name, (fu, fv, pu, pv), size, own, notes)


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


# Basalt's `calibration.json`: lenses by their names, sizes, and the pose of each camera in the frame of the IMU.

# Of each camera_type: kcal's model or the lens of `LENSES`, and the parameters after fx, fy, cx, cy in its order.
BASALT_LENSES = {
    "pinhole": ("pinhole", ()),
    "pinhole-radtan8": ("opencv8", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    "kb4": ("fisheye4", ("k1", "k2", "k3", "k4")),
    "ds": ("ds", ("xi", "alpha")),
    "eucm": ("eucm", ("alpha", "beta")),
    "ucm": ("eucm", ("alpha",)),
    "fov": ("fov", ("w",)),
}
_BASALT_POSE = ("px", "py", "pz", "qw", "qx", "qy", "qz")


def read_basalt(path: Path, hints: foreign.Hints) -> foreign.ImportedCameras:
    """Read all cameras; poses are from the frame of the IMU."""
    content = foreign.Keys(read_json(read_bytes(path, foreign.MOST_BYTES), str(path))["value0"])
    lenses, sizes, notes = content["intrinsics"], content["resolution"], ["what is known of the IMU is not kept"]
    if not len(lenses) == len(sizes):
        raise ValueError(f"{len(lenses)} intrinsics and {len(sizes)} resolutions; as many are needed")
    cameras, unread = foreign.each_readable(
        (f"cam{i}", partial(_basalt_camera, f"cam{i}", lens, foreign.whole_size(*size), notes))
        for i, (lens, size) in enumerate(zip(lenses, sizes, strict=True))
    )
    stated = content.get("T_imu_cam", [])
    if len(stated) not in (0, len(lenses)):
        raise ValueError(f"{len(lenses)} intrinsics and {len(stated)} T_imu_cam; as many are needed")
    moves = [foreign.numbers([one[key] for key in _BASALT_POSE], 7, "T_imu_cam") for one in stated]
    poses = tuple(
        foreign.moved_by(move[3:], move[:3]).inverse() for i, move in enumerate(moves) if f"cam{i}" not in unread
    )
    return foreign.ImportedCameras(format="basalt", cameras=cameras, poses=poses, notes=tuple(notes), unread=unread)


def _basalt_camera(name: str, lens: Mapping[str, Any], size: tuple[int, int], notes: list[str]) -> Camera:
    kind, given = str(lens["camera_type"]), foreign.Keys(lens["intrinsics"])
    if kind not in BASALT_LENSES:
        raise ValueError(f"{name}: camera_type {kind}: kcal reads {', '.join(BASALT_LENSES)}")
    model, terms = BASALT_LENSES[kind]
    core, own = ([foreign.numbers(given[key], 1, key)[0] for key in keys] for keys in (("fx", "fy", "cx", "cy"), terms))
    given.get("rpmax")
    given.rest(f"{name}.")
    # The unified lens is the enhanced one with β = 1.
    return foreign_camera(model, name, core, size, [*own, 1.0] if kind == "ucm" else own, notes)


def write_basalt(cameras: Sequence[Camera | ForeignCamera], poses: Sequence[Pose], path: Path) -> list[Path]:
    """Write all cameras, with the rig's frame in place of the IMU's."""
    kinds = {model: kind for kind, (model, _) in BASALT_LENSES.items() if kind != "ucm"}
    intrinsics, places = [], []
    for i, camera in enumerate(cameras):
        _, model, (fx, fy, cx, cy, _, *own) = as_written(camera)
        values = dict(
            zip(("fx", "fy", "cx", "cy", *BASALT_LENSES[kinds[model]][1]), (fx, fy, cx, cy, *own), strict=True)
        )
        if model == "opencv8":
            # Points beyond this distance from the axis, at depth one, are not projected.
            assert isinstance(camera, Camera)
            values["rpmax"] = 1.01 * float(camera.normalize(camera.grid(33, 25))[0].norm(dim=-1).max())
        intrinsics.append({"camera_type": kinds[model], "intrinsics": values})
        pose = (poses[i] if poses else Pose.still()).inverse()
        numbers = [*foreign.plain(pose.translation), *foreign.quaternion_of(pose.rotation)]
        places.append(dict(zip(_BASALT_POSE, numbers, strict=True)))
    content = {"T_imu_cam": places, "intrinsics": intrinsics, "resolution": [list(camera.size) for camera in cameras]}
    return [write_atomic(path, dump_json({"value0": content}))]
