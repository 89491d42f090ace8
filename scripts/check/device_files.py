"""Cameras of devices and data sets: how far kcal's reading of a file is from the program's published formula.

Files in the published form of each program, whose devices and programs are not here; 10,000 points all over the image.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

from kcal.lens import import_cameras
from scripts.check.exchange import random_points
from scripts.check.foreign_lenses import opencv_formula
from scripts.shared.page import in_folder, section, table

SIZE = (1280, 720)
K, D = np.array([[900.5, 0, 640.3], [0, 901.3, 359.2], [0, 0, 1]]), [-0.055, 0.066, 7e-4, -9e-4, -0.021]
EIGHT, WIDE = [0.3, -0.06, -4e-5, 8e-5, -0.002, 0.65, -0.04, -0.01], [0.05, -0.01, 0.003, -0.001]
FOURTEEN, NONE = [*EIGHT, 1e-3, -2e-4, 5e-4, 1e-4, 2e-3, -1e-3], [0.0] * 5
CORE = {"width": 1280, "height": 720, "fx": K[0, 0], "fy": K[1, 1], "ppx": K[0, 2], "ppy": K[1, 2]}
Formula = Callable[[np.ndarray], np.ndarray]
# Program, lens, pose, file and its text, and the published projection; None for the direction from pixels to rays.
Given = tuple[str, str, str, str, Any, Formula | None]


def opencv(lens: list[float], fisheye: bool = False) -> Formula:
    return lambda p: opencv_formula(p, K, np.array(lens), fisheye)


def modified(points: np.ndarray) -> np.ndarray:
    """rs2_project_point_to_pixel of RS2_DISTORTION_MODIFIED_BROWN_CONRADY."""
    x, y = (points[:, :2] / points[:, 2:]).T
    r2, (k1, k2, p1, p2, k3) = x * x + y * y, D
    f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    a, b = x * f, y * f
    across, down = a + 2 * p1 * a * b + p2 * (r2 + 2 * a * a), b + 2 * p2 * a * b + p1 * (r2 + 2 * b * b)
    return np.stack([across * K[0, 0] + K[0, 2], down * K[1, 1] + K[1, 2]], 1)


def ftheta(points: np.ndarray) -> np.ndarray:
    """rs2_project_point_to_pixel of RS2_DISTORTION_FTHETA."""
    plane = points[:, :2] / points[:, 2:]
    r = np.linalg.norm(plane, axis=1, keepdims=True)
    return plane / r * np.arctan(2 * r * math.tan(0.45)) / 0.9 * np.diag(K)[:2] + K[:2, 2]


def inverse(pixels: np.ndarray) -> np.ndarray:
    """Rays of RealSense's documentation for RS2_DISTORTION_INVERSE_BROWN_CONRADY."""
    x, y = ((pixels - K[:2, 2]) / np.diag(K)[:2]).T
    r2, (k1, k2, p1, p2, k3) = x * x + y * y, D
    f = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    across, down = x * f + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * f + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    return np.stack([across, down, np.ones_like(x)], 1)


def files() -> Iterator[Given]:
    data: Any
    text: Any
    camera: dict[str, Any]
    still = {"rotationMatrix": np.eye(3).tolist(), "translation": dict.fromkeys("xyz", 0.0), "toCameraSocket": -1}
    for kind, values, name in ((0, FOURTEEN, "perspective, 14"), (1, [*WIDE, *[0.0] * 10], "fisheye")):
        camera = {"cameraType": kind, "distortionCoeff": values, "intrinsicMatrix": K.tolist(), "extrinsics": still}
        data = {"cameraData": [[0, camera | {"width": 1280, "height": 720}]]}
        yield "depthai", name, "yes", "oak.json", data, opencv(WIDE, True) if kind else opencv(FOURTEEN)
    unit = np.array([1280, 960])
    core = [*((K[:2, 2] + [0.5, 120.5]) / unit), *(np.diag(K)[:2] / unit)]
    k1, k2, p1, p2, *more = EIGHT
    lens = {"ModelParameters": [*core, k1, k2, *more, 0, 0, p2, p1], "ModelParameterCount": 14,
            "ModelType": "CALIBRATION_LensDistortionModelBrownConrady"}  # fmt: skip
    sensor = {"SensorWidth": 4096, "SensorHeight": 3072}
    camera = {"Intrinsics": lens, "Location": "CALIBRATION_CameraLocationPV0", **sensor,
              "Rt": {"Rotation": np.eye(3).ravel().tolist(), "Translation": [0.0] * 3}}  # fmt: skip
    data = {"CalibrationInformation": {"Cameras": [camera]}}
    yield "Azure Kinect", "BrownConrady, 720P", "yes", "calibration.json", data, opencv(EIGHT)
    lenses: list[tuple[str, list[float], Formula | None]] = [
        ("brown_conrady", D, opencv(D)), ("kannala_brandt4", [*WIDE, 0.0], opencv(WIDE, True)),
        ("modified_brown_conrady → hybrid", D, modified), ("inverse_brown_conrady → hybrid", D, None),
        ("ftheta → hybrid", [0.9, 0, 0, 0, 0], ftheta),
    ]  # fmt: skip
    for name, values, formula in lenses:
        text = CORE | {"model": f"distortion.{name.split()[0]}", "coeffs": values}
        yield "RealSense", name, "no", "color.json", text, formula
    rows = "".join(
        f"{key}={float(K[i, j])!r}\n" for key, i, j in (("fx", 0, 0), ("fy", 1, 1), ("cx", 0, 2), ("cy", 1, 2))
    )
    rows += "".join(f"{key}={value}\n" for key, value in zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True))
    text = f"[LEFT_CAM_HD]\n{rows}[RIGHT_CAM_HD]\n{rows}[STEREO]\nBaseline=120\nTY=0\nTZ=0\n"
    yield "ZED", "5 coefficients", "yes", "SN1.conf", text, opencv(D)
    text = (f"sensor_type: camera\nT_BS: {{cols: 4, rows: 4, data: {np.eye(4).ravel().tolist()}}}\n"
            f"resolution: [1280, 720]\ncamera_model: pinhole\nintrinsics: {K[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()}\n"
            f"distortion_model: radial-tangential\ndistortion_coefficients: {D[:4]}\n")  # fmt: skip
    yield "EuRoC", "radial-tangential", "yes", "sensor.yaml", text, opencv(D[:4])
    joined = " ".join(map(repr, np.pad(K, ((0, 0), (0, 1))).ravel().tolist()))
    yield "KITTI", "rectified", "yes", "calib.txt", f"P0: {joined}\n", opencv(NONE)
    parts: dict[str, Any] = {"S": SIZE, "K": K.ravel(), "D": D, "R": np.eye(3).ravel(), "T": [0, 0, 0]}
    raw = "".join(f"{key}_00: {' '.join(map(repr, map(float, values)))}\n" for key, values in parts.items())
    yield "KITTI", "raw, 5 coefficients", "yes", "calib_cam_to_cam.txt", raw, opencv(D)
    data = {"width": 1280, "height": 720, "intrinsic_matrix": K.T.ravel().tolist()}
    yield "Open3D", "pinhole", "yes", "intrinsic.json", data, opencv(NONE)
    record = {"token": "a", "sensor_token": "b", "translation": [1.7, 0, 1.5], "rotation": [1.0, 0, 0, 0]}
    yield ("nuScenes", "pinhole", "yes", "calibrated_sensor.json", [record | {"camera_intrinsic": K.tolist()}],
           opencv(NONE))  # fmt: skip
    block = {"rows": 3, "cols": 3, "type": 6, "data": K.ravel().tolist()}
    data = {"resolution": {"width": 1280.0, "height": 720.0}, "cameraIntrinsics": block,
            "distCoeffs": {"rows": 1, "cols": 8, "type": 6, "data": EIGHT}}  # fmt: skip
    yield "PhotonVision", "8 coefficients", "no", "photon.json", data, opencv(EIGHT)
    text = (f"header:\n  frame_id: cam\nheight: 720\nwidth: 1280\ndistortion_model: plumb_bob\nd: {D}\n"
            f"k: {K.ravel().tolist()}\n---\n")  # fmt: skip
    yield "ROS, echoed", "plumb_bob", "as rectification", "info.yaml", text, opencv(D)
    words = ",".join(map(repr, map(float, [K[0, 0], K[1, 1], K[0, 2] - 640, K[1, 2] - 360, *D])))
    yield "DJI", "DewarpData", "no", "DJI_0001.JPG", f'drone-dji:DewarpData="2026-01-01;{words}"', opencv(D)


def device_rows(folder: Path) -> Iterator[list[str]]:
    for program, lens, pose, name, content, formula in files():
        path = folder / name
        if name.endswith("JPG"):
            Image.new("L", SIZE).save(path, xmp=f"<rdf:Description {content}/>".encode())
        else:
            path.write_text(content if isinstance(content, str) else json.dumps(content))
        camera = import_cameras(path, size=SIZE if program in ("Azure Kinect", "ZED", "KITTI", "nuScenes") else None)
        first = camera.cameras[0]
        points, pixels = random_points(first)
        if formula is None:
            pixels = first.grid(100, 100).reshape(-1, 2).numpy()
            points, there = inverse(pixels), pixels
        else:
            there = formula(points)
        error = np.abs(first.project(torch.from_numpy(points))[0].numpy() - there).max()
        yield [program, "in", lens, pose, f"{error:.0e}"]


@section("other-programs.md", "devices")
def devices() -> Iterator[str]:
    return table(["program", "direction", "lens", "pose", "largest error, px"], in_folder(device_rows))
