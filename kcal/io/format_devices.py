"""Files of devices and data sets: depthai, Azure Kinect, RealSense, ZED, EuRoC, KITTI, Open3D, nuScenes, DJI.

Each reader says by the names of `kcal.io.keyed` what its file means. Sizes, lenses and poses are checked there.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from kcal.file_kind import check_image_header, is_image
from kcal.files import read_bytes
from kcal.io.foreign import (
    Hints,
    ImportedCameras,
    checked_pose,
    ini_sections,
    known_size,
    moved_by,
    numbers,
    plain,
    pose_of,
    poses_from_root,
    reading,
)
from kcal.io.keyed import read_keyed
from kcal.lens.pose import Pose, rotation_from_vector
from kcal.strict_formats import read_storage
from kcal.strict_json import read_json

# Cameras by their names, each with its values by the names of `kcal.io.keyed`, and notes.
Found = tuple[dict[str, dict[str, Any]], list[str]]
# An image of a drone, with room.
_MOST = 256 * 2**20


def _give_pose(part: dict[str, Any], pose: Pose) -> None:
    """Give a camera its pose from the frame of the file."""
    part |= {"R": plain(pose.rotation), "T": plain(pose.translation)}


def _stated_matrix(values: Any, columns: int, what: str) -> np.ndarray:
    return np.array(numbers(values, (12, 16) if columns == 4 else 9, what)).reshape(-1, columns)


def _depthai(text: str, path: Path, hints: Hints) -> Found:
    """OpenCV's 14 coefficients, or a fisheye's four; a socket's extrinsics lead to `toCameraSocket`, in centimeters.

    Source: depthai-core, CalibrationHandler and CameraInfo.
    """
    entries = read_json(text.encode(), str(path))["cameraData"]
    cameras: dict[str, dict[str, Any]] = {}
    notes, steps = [], dict[str, tuple[str, Pose]]()
    for socket, info in sorted(entries.items() if isinstance(entries, Mapping) else entries):
        name = f"CAM_{chr(65 + int(socket))}"
        if not any(numbers(info["intrinsicMatrix"], (0, 9), "intrinsicMatrix")):
            notes.append(f"{name} is not calibrated")
            continue
        kind = ("opencv", "fisheye", "equirectangular", "radial division")[int(info.get("cameraType", 0))]
        cameras[name] = {"K": info["intrinsicMatrix"], "D": info["distortionCoeff"], "lens_model": kind}
        cameras[name] |= {key: info[key] for key in ("width", "height")}
        stated = info.get("extrinsics") or {}
        if int(stated.get("toCameraSocket", -1)) >= 0:
            shift = [0.01 * float(stated["translation"][axis]) for axis in "xyz"]
            pose = checked_pose(numbers(stated["rotationMatrix"], 9, "rotationMatrix"), shift)
            steps[name] = f"CAM_{chr(65 + int(stated['toCameraSocket']))}", pose
    for name, pose in zip(cameras, poses_from_root(steps, list(cameras)), strict=False):
        _give_pose(cameras[name], pose)
    return cameras, notes


# Modes of the Azure Kinect: the sensor's size after binning, and the corner of what is cut from it. Color images are
# cut from 4:3. Source: Azure-Kinect-Sensor-SDK, mode_specific_calibration.c.
_DEPTH_MODES = {(320, 288): (512, 96, 90), (640, 576): (1024, 192, 180), (512, 512): (512, 0, 0),
                (1024, 1024): (1024, 0, 0)}  # fmt: skip
_COLOR_MODES = ((1280, 720), (1920, 1080), (2560, 1440), (2048, 1536), (3840, 2160), (4096, 3072))


def _azure(text: str, path: Path, hints: Hints) -> Found:
    """Lengths in units of the sensor, from its corner; OpenCV's 8 coefficients, and poses from the depth camera."""
    cameras: dict[str, dict[str, Any]] = {}
    if hints.size not in (None, *_DEPTH_MODES, *_COLOR_MODES):
        raise ValueError(f"no mode has images of {hints.size}; kcal knows {[*_DEPTH_MODES, *_COLOR_MODES]}")
    for own in read_json(text.encode(), str(path))["CalibrationInformation"]["Cameras"]:
        place = str(own["Location"]).removeprefix("CALIBRATION_CameraLocation")
        name = {"D0": "depth", "PV0": "color"}.get(place, place)
        lens, width, height = own["Intrinsics"], int(own["SensorWidth"]), int(own["SensorHeight"])
        given = numbers(lens["ModelParameters"], (14, 15), "ModelParameters")
        cx, cy, fx, fy, *radial = given[:10]
        center_x, center_y, p2, p1 = given[10:14]
        kind = str(lens["ModelType"]).removeprefix("CALIBRATION_LensDistortionModel")
        if kind == "Rational6KT" and not (p1 or p2 or center_x or center_y):
            kind = "BrownConrady"
        left, top = 0.0, 0.0
        if name == "color":
            # Early calibrations are of 16:9.
            full = 0.75 * width
            cy, fy, height = (cy * height + 0.5 * (full - height)) / full, fy * height / full, int(full)
        size, sensor = (width, height), (width, height)
        if hints.size and (hints.size in _DEPTH_MODES) == (name == "depth"):
            size = hints.size
            if name == "depth":
                side, left, top = _DEPTH_MODES[size]
                sensor = side, side
            else:
                sensor = size[0], 3 * size[0] // 4
                top = 0.5 * (sensor[1] - size[1])
        center = {"cx": cx * sensor[0] - left - 0.5, "cy": cy * sensor[1] - top - 0.5}
        lengths = {"fx": fx * sensor[0], "fy": fy * sensor[1], "width": size[0], "height": size[1]}
        cameras[name] = center | lengths | {"D": [*radial[:2], p1, p2, *radial[2:]], "lens_model": kind}
        _give_pose(cameras[name], checked_pose(numbers(own["Rt"]["Rotation"], 9, "Rotation"), own["Rt"]["Translation"]))
    notes = [] if hints.size else ["cameras of the whole sensors: say --size 1920x1080 for images of such a mode"]
    return cameras, notes


def _enumerated(text: str, path: Path, hints: Hints) -> Found:
    """What `rs-enumerate-devices -c` prints; a camera for each stream and size."""
    cameras: dict[str, dict[str, Any]] = {}
    for part in re.split(r"^[ \t]*Intrinsic of ", text, flags=re.MULTILINE)[1:]:
        stated = dict(
            re.findall(r"^[ \t]*(\w+):[ \t]*(\S.*?)[ \t]*$", re.split("Extrinsic|Motion", part)[0], re.MULTILINE)
        )
        size = f"{stated['Width']}x{stated['Height']}"
        if hints.size in (None, tuple(map(int, size.split("x")))):
            own = {key: stated[key] for key in ("Width", "Height", "PPX", "PPY", "Fx", "Fy")}
            own |= {"lens_model": stated["Distortion"], "D": stated["Coeffs"].split()}
            cameras.setdefault(f"{part.split(chr(34))[1]} {size}", own)
    return cameras, ["how the cameras stand to each other is not read"]


_ZED_SIZES = {"2K": (2208, 1242), "FHD": (1920, 1080), "HD": (1280, 720), "VGA": (672, 376), "FHD1200": (1920, 1200),
              "SVGA": (960, 600), "4K": (3840, 2160), "QHDPLUS": (3200, 1800)}  # fmt: skip


def _zed(text: str, path: Path, hints: Hints) -> Found:
    """A pair for each resolution; the pose in millimeters, as Stereolabs' program of stereo calibration writes it.

    `CV` is the rotation about y. Coefficients stand with the camera, or for all resolutions in `[LEFT_DISTO]`.
    """
    own = {name.upper(): section for name, section in ini_sections(text).items()}
    kinds = [name.removeprefix("LEFT_CAM_") for name in own if name.startswith("LEFT_CAM_")]
    if unknown := set(kinds) - set(_ZED_SIZES):
        raise ValueError(f"resolution {min(unknown)}: kcal knows {', '.join(_ZED_SIZES)}")
    chosen = [kind for kind in kinds if hints.size in (None, _ZED_SIZES[kind])]
    if not chosen:
        raise ValueError(f"no camera of {hints.size}; the file has {[_ZED_SIZES[kind] for kind in kinds]}")
    cameras: dict[str, dict[str, Any]] = {}
    for kind in chosen:
        for side in ("LEFT", "RIGHT"):
            part: dict[str, Any] = own[f"{side}_CAM_{kind}"] | own.get(f"{side}_DISTO", {})
            part |= {"size": _ZED_SIZES[kind], "fisheye": "k4" in part and "p1" not in part}
            cameras[side.lower() if len(chosen) == 1 else f"{side.lower()}_{kind}"] = part
    if len(chosen) > 1:
        return cameras, [f"one resolution with the pose of its pair: --size {'x'.join(map(str, _ZED_SIZES[kinds[0]]))}"]
    pose = {key: float(value) for key, value in own.get("STEREO", {}).items()}
    turn = [pose.get(f"{key}_{chosen[0].lower()}", pose.get(key, 0.0)) for key in ("rx", "cv", "rz")]
    ty, tz = (pose.get(f"{key}_{chosen[0].lower()}", pose.get(key, 0.0)) for key in ("ty", "tz"))
    notes = []
    if pose.get("baseline"):
        rotation = rotation_from_vector(torch.tensor(turn, dtype=torch.float64))
        shift = 1e-3 * torch.tensor([-pose["baseline"], ty, tz], dtype=torch.float64)
        _give_pose(cameras["left"], Pose.still())
        _give_pose(cameras["right"], Pose(rotation, shift))
        if ty or tz:
            turned = 2e3 * np.hypot(ty, tz) / pose["baseline"]
            notes.append("the signs of TY and TZ are those of Stereolabs' calibration; its sample for OpenCV exchanges "
                         f"them, which turns the rig by {turned:.2g} mrad")  # fmt: skip
    return cameras, notes


def _euroc(text: str, path: Path, hints: Hints) -> Found:
    """T_BS leads from the sensor to the body; the files of two cameras are a rig."""
    content = read_storage(text.encode(), str(path))
    name = path.parent.name if path.stem == "sensor" else path.stem
    _give_pose(content, pose_of(content.pop("T_BS"), "T_BS").inverse())
    return {name: content | {"name": name}}, []


def _kitti(text: str, path: Path, hints: Hints) -> Found:
    """Projections P = K [I | t] of rectified images, or K, D, R and T of raw ones; poses are from camera 0.

    Source: Geiger et al. 2013, "Vision meets robotics: the KITTI dataset", and its development kit.
    """
    lines = dict(re.findall(r"^(\w+):[ \t]*(\S.*)$", text, re.MULTILINE))
    given = {key: list(map(float, value.split())) for key, value in lines.items() if key != "calib_time"}
    raw = [key[2:] for key in given if re.fullmatch(r"K_\d+", key)]
    rectified = [key for key in given if re.fullmatch(r"P(_rect_)?\d+", key)]
    cameras: dict[str, dict[str, Any]] = {}
    notes = []
    if raw and hints.size in (None, *(tuple(given[f"S_{one}"]) for one in raw)):
        for one in raw:
            cameras[f"camera_{one}"] = {"K": given[f"K_{one}"], "D": given[f"D_{one}"], "size": given[f"S_{one}"],
                                        "R": given[f"R_{one}"], "T": given[f"T_{one}"]}  # fmt: skip
        wide, high = given.get(f"S_rect_{raw[0]}", (0, 0))
        notes = [f"cameras of raw images; for rectified ones (_sync): --size {wide:.0f}x{high:.0f}"] if wide else []
        return cameras, notes if hints.size is None else []
    for key in rectified:
        projection = _stated_matrix(given[key], 4, key)
        size = given.get(key.replace("P", "S"), hints.size)
        if hints.size not in (None, tuple(size or ())):
            raise ValueError(f"no camera of {hints.size}; rectified images have {size}")
        part = {"K": projection[:, :3].ravel().tolist(), "size": known_size(hints.size) if size is None else size}
        _give_pose(
            part, checked_pose(np.eye(3).tolist(), np.linalg.solve(projection[:, :3], projection[:, 3]).tolist())
        )
        cameras["camera_" + re.sub(r"\D", "", key)] = part
    return cameras, ["rectified cameras, without distortion"]


def _open3d(text: str, path: Path, hints: Hints) -> Found:
    """Column by column; the extrinsic matrix leads from the world to the camera."""
    content = read_json(text.encode(), str(path))
    items = content.get("parameters", [content])
    cameras: dict[str, dict[str, Any]] = {}
    for number, item in enumerate(items):
        own = item.get("intrinsic", item)
        part = {"K": _stated_matrix(own["intrinsic_matrix"], 3, "intrinsic_matrix").T.ravel().tolist(),
                "width": own["width"], "height": own["height"]}  # fmt: skip
        if "extrinsic" in item and len(items) == 1:
            _give_pose(part, pose_of(_stated_matrix(item["extrinsic"], 4, "extrinsic").T, "extrinsic"))
        if part not in cameras.values():
            cameras[f"camera_{number}" if len(items) > 1 else path.stem] = part
    return cameras, ["the poses of the trajectory are not kept"] if len(items) > 1 else []


def _nuscenes(text: str, path: Path, hints: Hints) -> Found:
    """Images without distortion; poses lead to the vehicle, their rotations are quaternions w, x, y, z."""
    records = [one for one in read_json(text.encode(), str(path)) if one.get("camera_intrinsic")]
    single = len({one["sensor_token"] for one in records}) == len(records)
    cameras: dict[str, dict[str, Any]] = {}
    for one in records:
        part = {"K": one["camera_intrinsic"], "size": known_size(hints.size)}
        if single:
            turn, shift = (numbers(one[key], count, key) for key, count in (("rotation", 4), ("translation", 3)))
            _give_pose(part, moved_by(turn, shift).inverse())
        cameras[str(one["token"])] = part
    return cameras, [] if single else ["cameras of several vehicles or logs: their poses are not read"]


# Where what begins a file is of a program, and how it is read.
_READERS: dict[str, tuple[str, Callable[[str, Path, Hints], Found]]] = {
    "depthai": (r'"cameraData"\s*:', _depthai),
    "Azure Kinect": (r'"CalibrationInformation"\s*:', _azure),
    "RealSense": (r'^[ \t]*Intrinsic of "', _enumerated),
    "ZED": (r"^\[LEFT_CAM_\w+\]", _zed),
    "EuRoC": (r"^T_BS\s*:", _euroc),
    "KITTI": (r"^(?:P0|P_rect_0\d|K_0\d):\s*[-\d]", _kitti),
    # The second and third number are zero in a matrix that is written column by column.
    "Open3D": (r'"PinholeCamera(?:Parameters|Traj)|"intrinsic_matrix"\s*:\s*\[[^,\[\]]+(?:,\s*0(?:\.0*)?\s*){2},',
               _open3d),
    "nuScenes": (r'"sensor_token"\s*:', _nuscenes),
}  # fmt: skip


def device_of(text: str) -> str | None:
    """The device or data set whose file this is; None if it is of none that kcal knows."""
    return next((name for name, (mark, _) in _READERS.items() if re.search(mark, text, re.MULTILINE)), None)


def read_device(path: Path, hints: Hints) -> ImportedCameras:
    """Read the cameras of a device, or what a drone wrote into a photo."""
    data = read_bytes(path, _MOST)
    photo = is_image(data)
    text = "" if photo else data.decode("utf-8-sig", "replace")
    program = "DJI" if photo else device_of(text)
    if program is None:
        raise ValueError(f"no file of {', '.join(_READERS)}, and no photo of a drone")
    with reading(path, program):
        cameras, notes = _dji(data, path) if photo else _READERS[program][1](text, path, hints)
        if not cameras:
            raise ValueError("no camera of these images" if hints.size else "no camera")
        # The files say sizes and units, or are refused.
        found = read_keyed({"cameras": cameras}, next(iter(cameras)), Hints(None, hints.fisheye, 1.0), program)
    return dataclasses.replace(found, notes=(*found.notes, *notes))


def _dji(data: bytes, path: Path) -> Found:
    """Of XMP: fx, fy, cx, cy, k1, k2, p1, p2, k3 (then k4, k5, k6), the center from the middle of the image.

    Source: DJI, Matrice 4 Series User Manual (2025), and Mavic 3M Image Processing Guide (2023): for OpenCV's
    `undistort`, with a center of half the width and height plus cx and cy.
    """
    size = check_image_header(data, path)
    stated = {
        key.decode(): value.decode("ascii", "replace")
        for key, value in re.findall(rb"drone-dji:(\w+)\s*(?:=\s*\"|>)\s*([^\"<]{1,400})", data)
    }
    part: dict[str, Any] = {"width": size[0], "height": size[1]}
    lens = stated.get("DewarpDataK6") or stated.get("DewarpData", "")
    if stated.get("DewarpFlag", "0").strip() not in ("", "0"):
        raise ValueError("the drone removed the distortion (DewarpFlag 1), and DJI does not say which camera is left; "
                         "take photos with the correction of the distortion off, or calibrate")  # fmt: skip
    if given := numbers(
        [float(word) for word in lens.rpartition(";")[2].split(",") if word.strip()], (0, 9, 12), "DewarpData"
    ):
        fx, fy, cx, cy, *terms = given
        part |= {"fx": fx, "fy": fy, "cx": 0.5 * size[0] + cx, "cy": 0.5 * size[1] + cy, "D": terms}
        return {path.stem: part}, []
    if "CalibratedFocalLength" not in stated:
        raise ValueError("an image without its camera: kcal reads DewarpData and CalibratedFocalLength of DJI's "
                         "drones; photos of a board are for kcal calibrate")  # fmt: skip
    part |= {"f": stated["CalibratedFocalLength"], "cx": stated["CalibratedOpticalCenterX"],
             "cy": stated["CalibratedOpticalCenterY"]}  # fmt: skip
    return {path.stem: part}, ["the design of the camera, not a calibration: DJI Terra writes DewarpData into photos"]
