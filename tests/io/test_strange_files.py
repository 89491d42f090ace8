"""Camera files as strangers write them: each is read as the program that wrote it means it, or refused with its reason.

What is right is computed by OpenCV or by the lens's own formula, and compared as pixels of points.
"""

import dataclasses
import gzip
import json
import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from command_line import Command
from numpy.typing import NDArray
from scipy.io import savemat

from kcal.errors import FileError, InputError
from kcal.io.formats import import_cameras
from kcal.io.rig_file import RigFile
from kcal.lens.pose import Pose

K = np.array([[500.0, 0, 330], [0, 505, 236], [0, 0, 1]])
D = [-0.2, 0.05, 0.001, -0.002, 0.01]
F = [0.05, -0.01, 0.002, 0.001]
RATIONAL = [*D, 0.02, 0.01, -0.003]
POINTS = np.array([[x, y, 1.0] for x in (-0.5, -0.1, 0.4) for y in (-0.3, 0.2)])
Pixels = Callable[[np.ndarray], np.ndarray]


def plain(k: Any = K, d: Any = D) -> Pixels:
    return lambda p: cv2.projectPoints(p, np.zeros(3), np.zeros(3), np.array(k, float), np.array(d, float))[0][:, 0]


def fisheye(k: Any = K, d: Any = F) -> Pixels:
    k = np.array(k, float)
    return lambda p: cv2.fisheye.projectPoints(p[:, None], np.zeros(3), np.zeros(3), k, np.array(d, float),
                                               alpha=k[0, 1] / k[0, 0])[0][:, 0]  # fmt: skip


def half(pixels: Pixels) -> Pixels:
    """Of programs whose first pixel has its center at 0.5."""
    return lambda p: pixels(p) - 0.5


def ds(xi: float, alpha: float, k: Any = K) -> Pixels:
    def project(p: np.ndarray) -> np.ndarray:
        z = xi * np.linalg.norm(p, axis=1) + p[:, 2]
        below = alpha * np.hypot(np.hypot(p[:, 0], p[:, 1]), z) + (1 - alpha) * z
        return p[:, :2] / below[:, None] * np.diag(k)[:2] + k[:2, 2]

    return project


def omnidir(xi: float, d: Any = F, k: Any = K) -> Pixels:
    return lambda p: cv2.omnidir.projectPoints(p[:, None], np.zeros(3), np.zeros(3), np.array(k, float), xi,
                                               np.array(d, float))[0][:, 0]  # fmt: skip


def radial4(k1: float, k2: float, k3: float, k4: float, k: Any = K) -> Pixels:
    def project(p: np.ndarray) -> np.ndarray:
        plane = p[:, :2] / p[:, 2:]
        q = (plane**2).sum(1)[:, None]
        return plane * (1 + k1 * q + k2 * q**2 + k3 * q**3 + k4 * q**4) * np.diag(k)[:2] + k[:2, 2]

    return project


def written(folder: Path, name: str, content: str | bytes | dict[str, Any]) -> Path:
    path = folder / name
    if name.endswith(".mat"):
        savemat(path, content)
    elif name.endswith(".npz"):
        np.savez(path, **content)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


SIZE = {"image_width": 640, "image_height": 480}
M, C = K.tolist(), [500.0, 505.0, 330.0, 236.0]


def opencv(matrix: str, lens: str, values: list[float] = D, more: str = "") -> str:
    block = f"!!opencv-matrix\n   rows: 1\n   cols: {len(values)}\n   dt: d\n   data: {values}\n"
    return (f"%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"
            f"{matrix}: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
            f"   data: {K.ravel().tolist()}\n{lens}: {block}{more}")  # fmt: skip


def ros(model: str = "distortion_model: plumb_bob", lens: list[float] = D, more: str = "", k: Any = K) -> str:
    return (f"image_width: 640\nimage_height: 480\ncamera_name: cam\ncamera_matrix: {{rows: 3, cols: 3, data: "
            f"{np.ravel(k).tolist()}}}\n{model}\n"
            f"distortion_coefficients: {{rows: 1, cols: {len(lens)}, data: {lens}}}\n"
            f"rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}\n{more}")  # fmt: skip


def kalibr(model: str, lens: str, values: list[float], terms: list[float], more: str = "") -> str:
    return (f"cam0:\n  camera_model: {model}\n  distortion_model: {lens}\n  intrinsics: {[*values, *C]}\n"
            f"  distortion_coeffs: {terms}\n  resolution: [640, 480]\n{more}")  # fmt: skip


def nerf(**values: Any) -> dict[str, Any]:
    return {"w": 640, "h": 480, "fl_x": 500, "fl_y": 505, "cx": 330, "cy": 236, "frames": []} | values


XML = ("<opencv_storage><image_width>640</image_width><image_height>480</image_height><K type_id='opencv-matrix'>"
       f"<rows>3</rows><cols>3</cols><dt>d</dt><data>{' '.join(map(str, K.ravel()))}</data></K>"
       "<{}>{}</{}></opencv_storage>")  # fmt: skip
ORB = ("%YAML:1.0\nCamera.type: {}\n{}.fx: 500.0\n{}.fy: 505.0\n{}.cx: 330.0\n{}.cy: 236.\nCamera.width: 640\n"
       "Camera.height: 480\nCamera.fps: 30\n").format  # fmt: skip
SKEWED = [[500.0, 2, 330], [0, 505, 236], [0, 0, 1]]
TOML = "[cam]\nname = 'a'\nsize = [640, 480]\nmatrix = {}\n{} = {}\n"
BINNED = [[250.0, 0, 164.75], [0, 252.5, 117.75], [0, 0, 1]]
CUT = [[500.0, 0, 310], [0, 505, 226], [0, 0, 1]]
BOUGUET: dict[str, Any] = {"fc": [[500.0], [505]], "cc": [[330.0], [236]], "kc": [[d] for d in D]}
BOUGUET |= {"alpha_c": 0.004, "nx": 640.0, "ny": 480.0}
COLMAP = "1 {} 640 480 {} {}\n"
NERF_LENS = {"distortion_params": [-0.1, 0.02, 0, 0, 0.001, 0.002]}
NERF_FRAME = {"file_path": "a", "transform_matrix": np.eye(4).tolist()} | NERF_LENS
FIELDS = " ".join(map(str, C))
PANORAMA = COLMAP.format("EQUIRECTANGULAR", "", "640 480").replace("  ", " ")

NUMBERS = dict(zip(("fx", "fy", "cx", "cy"), C, strict=True))
VIKIT = {"model": "Pinhole", "width": 640, "height": 480, "scale": 0.5} | NUMBERS
VIKIT |= {f"d{i}": d for i, d in enumerate(D[:4])}
OKVIS = {"image_dimension": [640, 480], "distortion_coefficients": D[:4], "distortion_type": "radialtangential",
         "focal_length": C[:2], "principal_point": C[2:]}  # fmt: skip
MEI = ("%YAML:1.0\nmodel_type: MEI\nimage_width: 640\nimage_height: 480\nmirror_parameters: {xi: 1.2}\n"
       "distortion_parameters: {k1: 0.05, k2: -0.01, p1: 0.002, p2: 0.001}\n"
       "projection_parameters: {gamma1: 500, gamma2: 505, u0: 330, v0: 236}\n")  # fmt: skip
BODY = f"T_BS: {{cols: 4, rows: 4, data: {np.eye(4).ravel().tolist()}}}\n"

LENS_KEYS = ("distortion_coefficients", "dist_coeffs", "dist_coeff", "distortion_coeffs", "distortion", "distCoeffs",
             "Distortion_Coefficients", "D", "dist", "distortion_parameters", "DistCoef")  # fmt: skip
READ: dict[str, tuple[str, Any, Pixels]] = {
    **{f"YAML {key}": (f"{key}.yml", opencv("camera_matrix", key), plain()) for key in LENS_KEYS},
    **{f"XML {key}": ("a.xml", XML.format(key, " ".join(map(str, D)), key), plain()) for key in ("dist_coeffs", "D")},
    **{
        f"JSON {keys}": ("a.json", SIZE | dict(zip(keys.split(), (M, [D]), strict=True)), plain())
        for keys in (
            "camera_matrix dist_coeffs",
            "mtx dist",
            "K d",
            "intrinsics distortion",
            "cameraMatrix distCoeffs",
            "intrinsic_matrix distortion_coefficients",
        )
    },
    **{
        f"TOML {key}": ("a.toml", TOML.format(M, key, D), plain())
        for key in ("distortions", "dist_coeffs", "distortion_coeffs")
    },
    # As older files of PhotonVision have them, and coefficients as text or counted.
    "PhotonVision": (
        "a.json",
        {
            "resolution": {"width": 640, "height": 480},
            "cameraIntrinsics": {"rows": 3, "cols": 3, "data": M},
            "cameraExtrinsics": {"rows": 1, "cols": 5, "data": D},
        },
        plain(),
    ),
    **{
        f"text {text}": ("a.json", SIZE | {"K": M, "dist_coeffs": text}, plain())
        for text in (
            str(D),
            str(np.array(D)),
            str([D]),
            " ".join(map(str, D)),
            ",".join(map(str, D)),
            ";".join(map(str, D)),
        )
    },
    "counted": ("a.json", SIZE | {"K": M, "distCoeffs": {str(k): value for k, value in enumerate(D)}}, plain()),
    "MRPT": ("a.ini", f"[CAMERA]\nresolution=[640 480]\nfx=500\nfy=505\ncx=330\ncy=236\ndist={np.array(D)}\n", plain()),
    "ROS, not rectified": (
        "a.yaml",
        ros("distortion_model: plumb_bob") + f"rectification_matrix: {[0.0] * 9}\nprojection_matrix: {[0.0] * 12}\n",
        plain(),
    ),
    "nested": ("a.json", {"camera": {"K": M, "D": D, "width": 640, "height": 480}}, plain()),
    "named numbers": (
        "a.json",
        SIZE
        | dict(zip(("fx", "fy", "cx", "cy"), C, strict=True))
        | dict(zip(("k1", "k2", "p1", "p2", "k3"), D, strict=True)),
        plain(),
    ),
    "ORB-SLAM": (
        "a.yaml",
        ORB("PinHole", *["Camera"] * 4) + "Camera.k1: -0.2\nCamera.k2: 0.05\nCamera.p1: 0.001\n"
        "Camera.p2: -0.002\nCamera.k3: 0.01\n",
        plain(),
    ),
    "ORB-SLAM fisheye": (
        "a.yaml",
        ORB("KannalaBrandt8", *["Camera1"] * 4) + "Camera1.k1: 0.05\nCamera1.k2: -0.01\n"
        "Camera1.k3: 0.002\nCamera1.k4: 0.001\n",
        fisheye(),
    ),
    "VINS": (
        "a.yaml",
        "%YAML:1.0\n---\nmodel_type: KANNALA_BRANDT\ncamera_name: camera\nimage_width: 640\n"
        "image_height: 480\nprojection_parameters:\n   k2: 0.05\n   k3: -0.01\n   k4: 0.002\n   k5: 0.001\n"
        "   mu: 500\n   mv: 505\n   u0: 330\n   v0: 236\n",
        fisheye(),
    ),
    "two in a list": (
        "a.json",
        {"cameras": [{"name": "a", "type": "hd", "resolution": [640, 480], "K": M, "distCoef": D}]},
        plain(),
    ),
    "INI": (
        "a.ini",
        "; mine\n[camera]\nfx: 500\nfy: 505\ncx: 330\ncy: 236\nwidth: 640\nheight: 480\nk1: -0.2\n",
        plain(d=[-0.2, 0, 0, 0]),
    ),
    "np.savez": ("a.npz", {"mtx": M, "dist": [D], "image_size": [640, 480], "rvecs": np.zeros((3, 3, 1))}, plain()),
    "tight": ("a.yml", opencv("K", "D").replace("data: [", "data:[").replace("rows: ", "rows:"), plain()),
    "gzip": ("a.yml.gz", gzip.compress(opencv("K", "D").encode()), plain()),
    "lists": ("a.yml", f"image_width: 640\nimage_height: 480\ncamera_matrix: {M}\ndist_coeff: {[D]}\n", plain()),
    "OpenCV says fisheye": ("a.yml", opencv("K", "D", F, more="fisheye_model: 1\n"), fisheye()),
    "said by name": ("a.yml", opencv("K", "D", F, more="distortion_model: equidistant\n"), fisheye()),
    # image_pipeline's calibrator of 2019 and 2020 wrote camera_model, and called OpenCV's fisheye so.
    "ROS camera_model": ("ost.yaml", ros("camera_model: fisheye", F, k=SKEWED), fisheye(SKEWED)),
    "ROS fisheye": ("ost.yaml", ros("distortion_model: fisheye", F), fisheye()),
    "ROS equidistant": ("ost.yaml", ros("distortion_model: equidistant", F), fisheye()),
    "ROS camera_model plumb_bob": ("ost.yaml", ros("camera_model: plumb_bob"), plain()),
    "ROS rational 8": ("ost.yaml", ros("distortion_model: rational_polynomial", RATIONAL), plain(d=RATIONAL)),
    "ROS rational 5": ("ost.yaml", ros("distortion_model: rational_polynomial"), plain()),
    "ROS rational 14": (
        "ost.yaml",
        ros("distortion_model: rational_polynomial", [*RATIONAL, *[1e-3] * 4, 0, 0]),
        plain(d=[*RATIONAL, *[1e-3] * 4, 0, 0]),
    ),
    # image_geometry gives all of them to OpenCV, whatever the name.
    "ROS plumb_bob 8": ("ost.yaml", ros(lens=RATIONAL), plain(d=RATIONAL)),
    "ROS none": ("ost.yaml", ros("distortion_model: none", [0.0] * 5), plain(d=np.zeros(5))),
    "ROS none, empty": ("ost.yaml", ros("distortion_model: ''", []), plain(d=np.zeros(5))),
    # sensor_msgs/CameraInfo: K is of the full image, of which these are delivered.
    "ROS binning": ("ost.yaml", ros(more="binning_x: 2\nbinning_y: 2\n"), plain(BINNED)),
    "ROS binned K": (
        "ost.yaml",
        ros(more="binning_x: 4\nbinning_y: 4\n").replace("640", "2640").replace("480", "1888"),
        plain(),
    ),
    "ROS window": ("ost.yaml", ros(more="roi: {x_offset: 20, y_offset: 10, width: 600, height: 460}\n"), plain(CUT)),
    "nerfstudio k4": (
        "t.json",
        nerf(camera_model="OPENCV", k1=-0.1, k2=0.02, k3=0.003, k4=-0.004),
        half(radial4(-0.1, 0.02, 0.003, -0.004)),
    ),
    "nerfstudio distortion_params": (
        "t.json",
        nerf(distortion_params=[-0.1, 0.02, 0.003, 0, 0.001, 0.002]),
        half(plain(d=[-0.1, 0.02, 0.001, 0.002, 0.003])),
    ),
    "nerfstudio of a frame": (
        "t.json",
        nerf(frames=[NERF_FRAME]),
        half(plain(d=[-0.1, 0.02, 0.001, 0.002])),
    ),
    "nerfstudio SIMPLE_RADIAL": ("t.json", nerf(camera_model="SIMPLE_RADIAL", k1=-0.1), half(plain(d=[-0.1, 0, 0, 0]))),
    "nerfstudio RADIAL": ("t.json", nerf(camera_model="RADIAL", k1=-0.1, k2=0.02), half(plain(d=[-0.1, 0.02, 0, 0]))),
    "nerfstudio PINHOLE with k1": ("t.json", nerf(camera_model="PINHOLE", k1=-0.1), half(plain(d=[-0.1, 0, 0, 0]))),
    "nerfstudio angle": (
        "t.json",
        {"camera_angle_x": 2 * math.atan(0.64), "w": 640, "h": 480, "frames": []},
        half(plain([[500, 0, 320], [0, 500, 240], [0, 0, 1]], np.zeros(5))),
    ),
    "instant-ngp": (
        "t.json",
        nerf(k1=0.05, k2=-0.01, is_fisheye=True, aabb_scale=4),
        half(fisheye(d=[0.05, -0.01, 0, 0])),
    ),
    "Kalibr radtan": ("c.yaml", kalibr("pinhole", "radtan", [], D[:4]), plain(d=D[:4])),
    "Kalibr equidistant": ("c.yaml", kalibr("pinhole", "equidistant", [], F), fisheye()),
    "Kalibr of OpenVINS": ("c.yaml", "%YAML:1.0\n\n" + kalibr("pinhole", "radtan", [], D[:4]), plain(d=D[:4])),
    "vikit": ("a.yaml", "".join(f"cam_{key}: {value}\n" for key, value in VIKIT.items()), plain(d=D[:4])),
    "parameters of a node": ("a.json", {"/**": {"ros__parameters": {"camera": VIKIT}}}, plain(d=D[:4])),
    "two levels deep": ("a.json", {"0815": {"color": SIZE | {"K": M, "D": D}, "depth": SIZE | {"K": M}}}, plain()),
    "OKVIS": ("a.yaml", f"%YAML:1.0\ncameras: {[OKVIS]}\nimu_params: {{tau: 3600.0}}\n", plain(d=D[:4])),
    "two digits": ("a.json", SIZE | {"K_01": M, "dist_01": D, "K_12": M, "dist_12": F}, plain()),
    "no Kalibr": ("a.yaml", f"cam0:\n  width: 640\n  height: 480\n  K: {M}\n  d: {D}\n  t: [0, 0, 1]\n", plain()),
    "twice alike": (
        "a.json",
        {"width": 640, "height": 480, "intrinsic": {"width": 640} | NUMBERS, "K": M, "lens": {"k1": D[0]}, "D": D},
        plain(),
    ),
    "a size of its own": (
        "a.json",
        {"width": 1280, "height": 960, "a": {"K": M, "D": D, "resolution": [640, 480]}, "b": {"K": M, "D": D}},
        plain(),
    ),
    "a lens for all": ("a.json", SIZE | {"model": "fisheye", "a": {"K": M, "D": F}, "b": {"K": M, "D": F}}, fisheye()),
    "calibration_model": ("a.json", SIZE | {"K": M, "D": F, "calibration_model": "cv2.fisheye"}, fisheye()),
    "rectilinear": ("a.json", SIZE | {"K": M, "D": D, "distortion_model": "rectilinear"}, plain()),
    "lengths in mm": ("a.json", SIZE | {"K": M, "D": D, "chip": {"focal_length_mm": 4.7}}, plain()),
    "R3LIVE": ("a.json", {"vio": SIZE | {"camera_intrinsic": M, "camera_dist": D, "camera_ext_R": M}}, plain()),
    "VINS with a mask": ("a.yaml", MEI + "fisheye: 1\n", omnidir(1.2)),
    "omnidir with skew": (
        "a.yml",
        opencv("K", "D", F, "xi: 1.2\n").replace("500.0, 0.0", "500., 2."),
        omnidir(1.2, k=SKEWED),
    ),
    "xi of zero": ("a.yml", opencv("K", "D", more="xi: 0.\ncalibration_model: generic\n"), plain()),
    "EuRoC by OpenCV": ("a.yaml", opencv("K", "D", more=BODY), plain()),
    "Bouguet": ("Calib_Results.mat", BOUGUET, plain(SKEWED, D)),
    "MATLAB JSON": (
        "m.json",
        {
            "K": [[500, 0, 331], [0, 505, 237], [0, 0, 1]],
            "ImageSize": [480, 640],
            "RadialDistortion": [D[0], D[1], D[4]],
            "TangentialDistortion": D[2:4],
            "NumRadialDistortionCoefficients": 3,
            "EstimateSkew": False,
        },
        plain(),
    ),
}


@pytest.mark.parametrize("case", READ)
def test_read_as_it_is_meant(tmp_path: Path, case: str) -> None:
    name, content, pixels = READ[case]
    found = import_cameras(written(tmp_path, name, content))
    assert found.cameras[0].size in ((640, 480), (600, 460)) or case in ("ROS binning", "ROS binned K")
    seen = found.cameras[0].project(torch.from_numpy(POINTS))[0].numpy()
    wanted = pixels(POINTS)
    if case == "Bouguet":
        # There the skew is of the distorted point, as in kcal, and OpenCV ignores it.
        wanted = wanted + np.stack([2.0 * (wanted[:, 1] - 236) / 505, np.zeros(len(wanted))], 1)
    assert np.abs(seen - wanted).max() < (2e-2 if "hybrid" in str(found.cameras[0].model) else 1e-6)
    assert not any("may describe" in note for note in found.notes)


TWO = {"image_size": [640, 480], "R": np.eye(3).tolist(), "T": [-60.0, 0, 0]}
REFUSED: dict[str, tuple[str, Any, str]] = {
    # By name, by shape, and where two keys contradict each other.
    "Python objects": ("a.yaml", "K: !!python/object/apply:numpy.array []\n", "array.tolist"),
    "no Basalt": ("a.json", {"value0": {"frame": []}}, "bad basalt file: intrinsics is missing"),
    "turned": ("a.json", SIZE | {"K": K.T.tolist(), "D": D}, "exchange its rows and columns"),
    "no center": ("a.json", SIZE | {"fx": 500, "fy": 505, "k1": -0.1}, "cx and cy of the principal point are missing"),
    "none, but bent": ("a.yaml", ros("distortion_model: none"), "none, but there are coefficients"),
    "four of K": ("a.json", SIZE | {"K": C, "D": D}, "K has 4 numbers"),
    "twice": (
        "a.json",
        SIZE | {"projection_parameters": {"fx": 1.0}, "calib_parameters": {"fx": 2.0}},
        "fx is there twice",
    ),
    "twice, one inside": (
        "a.json",
        {"intrinsic": NUMBERS | {"width": 640}, "width": 1280, "height": 480},
        "width is there",
    ),
    "its own width": ("a.json", SIZE | {"camera": NUMBERS | {"width": 1280}}, "image size is not in the file"),
    "two centers": ("a.json", SIZE | {"K": M, "D": D, "cx": 320}, "K and cx are both there and differ"),
    "two lenses": ("a.json", SIZE | {"K": M, "D": D, "k2": 0.06}, "D and k2 are both there and differ"),
    "d1 without d0": ("a.json", SIZE | NUMBERS | {"d1": -0.1}, "d1 .-0.1. may describe the lens"),
    "r1 and t1": ("a.json", SIZE | NUMBERS | {"r1": -0.1, "t1": 0.01}, "r1 .-0.1. may describe the lens"),
    "a lens by name of a block": (
        "a.json",
        SIZE | {"fisheye_params": {"K": M, "D": F}},
        "speaks of a fisheye: say --f",
    ),
    "four with a skew": ("a.json", SIZE | {"K": SKEWED, "D": F}, "D may be .* K has a skew: say --fisheye"),
    "size of a board": (
        "a.json",
        {"K": M, "D": D, "board": {"width": 9, "height": 6}},
        "image size is not in the file",
    ),
    "vikit's ATAN": ("a.json", VIKIT | {"model": "ATAN"}, "model ATAN: kcal reads"),
    "DSO": ("camera.txt", "0.53 0.67 0.49 0.51 0.9\n640 480\ncrop\n640 480\n", "a file of DSO"),
    "Middlebury": ("calib.txt", "cam0=[500 0 330; 0 500 236; 0 0 1]\ndoffs=12\n", "a file of Middlebury"),
    "Gyroflow": ("a.json", {"calib_dimension": {"w": 640}, "fisheye_params": {"camera_matrix": M}}, "of Gyroflow"),
    "misspelled": ("a.yml", opencv("K", "distrotion_coeffs"), "distrotion_coeffs .5 numbers. may describe the lens"),
    "by shape": ("a.json", SIZE | {"K": M, "verzeichnung": D}, "verzeichnung .5 numbers. may describe the lens"),
    "a word among numbers": ("a.json", SIZE | {"K": M, "D": [-0.3, "none", 0.0, 0.0]}, "D must be numbers"),
    "another matrix": (
        "a.json",
        SIZE | {"K": M, "D": D, "kamera": (K + 1).tolist()},
        "kamera .9 numbers. may describe",
    ),
    "two matrices": (
        "a.json",
        SIZE | {"K": M, "D": D, "mtx": (2 * K - np.diag([0, 0, 1.0])).tolist()},
        "K and mtx .*differ",
    ),
    "a stray skew": ("a.toml", TOML.format(M, "distortions", D) + "alpha = 0.4\n", "alpha .0.4. may describe"),
    "inside": (
        "a.json",
        SIZE | {"K": M, "D": D, "extra": {"tangential_coeffs": [0.1, 0.2]}},
        "extra.tangential_coeffs",
    ),
    "other lens": ("a.yaml", ros("distortion_model: double_sphere", F), "distortion_model double_sphere: kcal reads"),
    "contradiction": (
        "a.yml",
        opencv("K", "D", F, more="distortion_model: plumb_bob\nfisheye_model: 1\n"),
        "contradict",
    ),
    "none with coefficients": ("c.yaml", kalibr("pinhole", "none", [], [0.1]), "distortion_coeffs has 1 numbers"),
    "Kalibr key": (
        "c.yaml",
        kalibr("pinhole", "radtan", [], D[:4], "  dist_k3: 0.1\n"),
        "cam0.dist_k3 .0.1. may describe",
    ),
    "nerfstudio key": ("t.json", nerf(ftheta_p1=0.1, distortion=[0.1, 0.2]), "distortion .2 numbers. may describe"),
    "nerfstudio model": ("t.json", nerf(camera_model="EQUIRECTANGULAR"), "EQUIRECTANGULAR: kcal reads"),
    "fisheye with p1": ("t.json", nerf(is_fisheye=True, p1=0.1), "p1: a fisheye has no such term"),
    "fraction": ("a.json", SIZE | {"K": [[0.8, 0, 0.49], [0, 1.05, 0.5], [0, 0, 1]], "D": D}, "fraction of the image"),
    "no camera in text": ("notes.txt", "camera number four\nlens cap lost\n", "not a camera file that kcal knows"),
    "COLMAP's panorama": ("cameras.txt", PANORAMA, "camera model EQUIRECTANGULAR"),
    "cut gzip": ("a.yml.gz", gzip.compress(opencv("K", "D").encode())[:-20], "cut short"),
    # Parts of a name that mean other things elsewhere.
    **{
        key: ("a.json", SIZE | {"K": M, key: D}, f"{key} .5 numbers. may describe the lens")
        for key in (
            "calibrated_distortion",
            "generated_dist",
            "dist_parms",
            "lens_profile_coeffs",
            "pointgrey_distortion",
            "distortion_world",
            "undistort_coeffs",
            "projection_distortion",
            "estimated_distortion",
        )
    },
    "tilt": ("a.json", SIZE | NUMBERS | {"tau_x": 0.02}, "tau_x .0.02. may describe"),
    "tang": ("a.json", SIZE | NUMBERS | {"tang": [0.1, 0.2]}, "tang .2 numbers. may describe"),
    "decimal commas": (
        "a.json",
        SIZE | {"K": M, "D": "-0,26 0,04 0,001 0,002"},
        "D .*must be numbers with decimal points",
    ),
    "a decimal comma": ("a.json", SIZE | NUMBERS | {"k1": "-0,26"}, "k1 has 2 numbers, and cannot have so many"),
    "a matrix of commas": ("a.json", SIZE | {"camera_matrix": [1] * 11, "D": D}, "camera_matrix has 11 numbers, and"),
    "a fisheye by name": (
        "a.json",
        SIZE | dict(zip(("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"), [*C, *F], strict=True)),
        "may be a fisheye's, or those of a rational lens: say --fisheye",
    ),
    "degrees": ("a.json", TWO | {"K": M, "D": D, "M2": M, "D2": D, "R": [0.3, -42.5, 1.2]}, "42.52 rad.* degrees"),
    "no size": ("a.json", {"K": M, "D": D}, "image size is not in the file"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused_with_its_reason(tmp_path: Path, case: str) -> None:
    name, content, reason = REFUSED[case]
    with pytest.raises(FileError, match=reason):
        import_cameras(written(tmp_path, name, content))


@pytest.mark.parametrize("text", ["\n" * 1_000_000, "# " * 100_000, "# a\n" * 100_000])
@pytest.mark.parametrize("form", [None, "kalibr", "ros"])
def test_blank_lines_and_comments_take_no_time(tmp_path: Path, text: str, form: str | None) -> None:
    """Patterns that look back at each line would take minutes."""
    with pytest.raises(FileError):
        import_cameras(written(tmp_path, "a.txt", text), format=form)


@pytest.mark.parametrize(
    "more",
    [
        {"rms": 0.3, "board_size": [9, 6], "calibration_time": "today", "flags": 4, "image_points": [[1, 2]] * 5},
        {"per_view_errors": [0.1] * 6, "rvecs": [[0.1, 0.2, 0.3]] * 3, "new_camera_matrix": M, "camera_name": "x"},
        {
            "R": np.eye(3).tolist(),
            "Q": np.eye(4).tolist(),
            "R1": np.eye(3).tolist(),
            "P1": [[1.0, 0, 0, 5]] * 3,
            "E": M,
        },
        {"skew": 0, "xi2": 0.0, "distortion_model": "plumb_bob", "serial": 123456},
    ],
)
def test_metadata_is_no_lens(tmp_path: Path, more: dict[str, Any]) -> None:
    found = import_cameras(written(tmp_path, "a.json", SIZE | {"K": M, "D": D} | more))
    assert found.cameras[0].params.tolist() == [*C, 0.0, *D]
    assert found.notes == ()


@pytest.mark.parametrize(
    ("size", "center", "words"),
    [
        ((640, 480), (960, 540), "outside"),
        ((1280, 720), (320, 240), "far from the middle"),
        ((640, 480), (330, 236), ""),
    ],
)
def test_centers_of_other_images_are_said(
    tmp_path: Path, size: tuple[int, int], center: tuple[int, int], words: str
) -> None:
    matrix = [[500.0, 0, center[0]], [0, 500, center[1]], [0, 0, 1]]
    path = written(tmp_path, "a.json", {"K": matrix, "D": D, "image_size": size})
    notes = import_cameras(path).notes
    assert (words in notes[0] and "(" in notes[0]) if words else notes == ()
    assert import_cameras(path, size=(2 * center[0], 2 * center[1])).notes == ()


def test_one_camera_that_cannot_be_read_does_not_refuse_the_others(tmp_path: Path, command: Command) -> None:
    text = COLMAP.format("PINHOLE", FIELDS, "") + PANORAMA.replace("1 E", "2 E")
    path, out = written(tmp_path, "cameras.txt", text), tmp_path / "out.json"
    found = import_cameras(path)
    assert (found.names, list(found.unread)) == (("1",), ["2"])
    for camera, code, words in (
        (":1", 0, "camera 2 cannot be read"), (":2", 1, "EQUIRECT"), ("", 1, "2 cameras; name")
    ):  # fmt: skip
        assert words in "".join(command("import", Path(f"{path}{camera}"), "-o", out, code=code))
    chain = kalibr("pinhole", "radtan", [], D[:4]) + kalibr("pinhole", "strange", [], []).replace("cam0", "cam1")
    assert import_cameras(written(tmp_path, "c.yaml", chain)).names == ("cam0",)


@pytest.mark.parametrize("imu", ["T_cam_imu", "T_imu_cam"])
def test_cameras_beside_an_imu_are_a_rig(tmp_path: Path, imu: str) -> None:
    """Kalibr's T_cam_imu maps from the IMU to the camera, OpenVINS's T_imu_cam back."""
    place = np.eye(4)
    place[:3, :3], place[:3, 3] = cv2.Rodrigues(np.array([0.1, 0.2, 0.3]))[0], [0.3, 0.1, -0.2]
    second = np.eye(4)
    second[0, 3] = -0.11
    matrices = [place, second @ place] if imu == "T_cam_imu" else [np.linalg.inv(place), np.linalg.inv(second @ place)]
    text = "".join(kalibr("pinhole", "radtan", [], D[:4], f"  {imu}: {matrix.tolist()}\n").replace("cam0", f"cam{i}")
                   for i, matrix in enumerate(matrices))  # fmt: skip
    rig = import_cameras(written(tmp_path, "c.yaml", text)).rig()
    assert np.abs(rig.right_from_left_translation.numpy() - [-0.11, 0, 0]).max() < 1e-12
    assert np.abs(rig.right_from_left_rotation.numpy() - np.eye(3)).max() < 1e-12


def test_poses_that_are_stated_twice_agree(tmp_path: Path) -> None:
    """Kalibr's chain, and each camera's place by the IMU."""
    second = np.eye(4)
    second[0, 3] = -0.11
    for wrong in (False, True):
        chain = np.linalg.inv(second) if wrong else second
        text = "".join(
            kalibr("pinhole", "radtan", [], D[:4], f"  T_cam_imu: {place.tolist()}\n{more}").replace("cam0", f"cam{i}")
            for i, (place, more) in enumerate(((np.eye(4), ""), (second, f"  T_cn_cnm1: {chain.tolist()}\n")))
        )
        path = written(tmp_path, "c.yaml", text)
        if wrong:
            with pytest.raises(FileError, match=r"T_cn_cnm1 and T_cam_imu are both there and differ by up to 0\.22"):
                import_cameras(path)
        else:
            assert float(import_cameras(path).rig().baseline) == pytest.approx(0.11)


@pytest.mark.parametrize(("stated", "unit", "meters"), [(120.0, None, 120.0), (120.0, 1e-3, 0.12), (0.12, None, 0.12)])
def test_the_unit_counts_for_formats_that_have_meters(
    tmp_path: Path, stated: float, unit: float | None, meters: float
) -> None:
    paths = []
    for side, beside in (("left", 0.0), ("right", -500.0 * stated)):
        more = f"rectification_matrix: {np.eye(3).ravel().tolist()}\n"
        more += f"projection_matrix: [500, 0, 330, {beside}, 0, 505, 236, 0, 0, 0, 1, 0]\n"
        paths.append(written(tmp_path, f"{side}.yaml", ros("distortion_model: plumb_bob") + more))
    found = import_cameras(*paths, meters=unit)
    assert float(found.rig().baseline) == pytest.approx(meters)
    assert any("120 m apart, as the format has meters" in note for note in found.notes) is (meters > 10)
    same = import_cameras(paths[1], paths[1])
    same = dataclasses.replace(same, poses=(same.poses[0], Pose(same.poses[0][0], same.poses[0][1] + 1e-15)))
    with pytest.raises(InputError, match="stand in one place"):
        same.rig()
    zed = written(tmp_path, "SN1.conf", "[LEFT_CAM_HD]\nfx=500\n")
    with pytest.raises(FileError):
        import_cameras(zed, meters=1e-3)


def test_three_cameras_are_a_rig(tmp_path: Path, command: Command) -> None:
    step = np.eye(4)
    step[:3, 3] = [-0.1, 0, 0.02]
    text = "".join(kalibr("pinhole", "radtan", [], D[:4], f"  T_cn_cnm1: {step.tolist()}\n" if i else "")
                   .replace("cam0", f"cam{i}") for i in range(3))  # fmt: skip
    said = command("import", written(tmp_path, "c.yaml", text), "-o", tmp_path / "rig.json")
    assert "cam0, cam1, cam2" in said.out
    rig = RigFile.load(tmp_path / "rig.json").rig()
    assert np.abs(rig.center.numpy() - np.outer([0, 1, 2], [0.1, 0, -0.02])).max() < 1e-12


@pytest.mark.parametrize(
    "keys",
    [
        "K1 D1 K2 D2", "CM1 D1 CM2 D2", "mtxL distL mtxR distR", "cameraMatrix1 distCoeffs1 cameraMatrix2 distCoeffs2",
        "left_camera_matrix left_distortion right_camera_matrix right_distortion", "LEFT.K LEFT.D RIGHT.K RIGHT.D",
    ],
)  # fmt: skip
def test_pairs(tmp_path: Path, keys: str) -> None:
    content = dict(zip(keys.split(), (M, D, [[501.0, 0, 332], [0, 506, 239], [0, 0, 1]], D[:4]), strict=True)) | TWO
    found = import_cameras(written(tmp_path, "a.json", content), meters=1e-2)
    assert found.names == ("left", "right")
    assert found.cameras[1].params.tolist() == [501, 506, 332, 239, 0, *D[:4]]
    assert found.rig().right_from_left_translation.tolist() == pytest.approx([-0.6, 0, 0])
    unsaid = import_cameras(tmp_path / "a.json").notes
    assert any("taken as meters, 60 m" in note and "--unit cm" in note for note in unsaid)


MOVE = np.eye(4)
MOVE[:3, :3], MOVE[:3, 3] = cv2.Rodrigues(np.array([0.02, -0.1, 0.05]))[0], [-0.6, 0.01, 0.02]
BACK = np.linalg.inv(MOVE)
PART = SIZE | {"K": M, "D": D}
TURN = {"R": MOVE[:3, :3].tolist(), "T": MOVE[:3, 3].tolist()}


def mc_calib(camera_in_first: NDArray[Any], *, lens: Sequence[float] = D, kind: int = 0, group: int = 0) -> Any:
    """A camera of `calibrated_cameras_data.yml`."""
    matrices = {"camera_matrix": M, "distortion_vector": [list(lens)], "camera_pose_matrix": camera_in_first.tolist()}
    return matrices | {"distortion_type": kind, "camera_group": group, "img_width": 640, "img_height": 480}


def test_lenses_and_groups_of_mc_calib(tmp_path: Path) -> None:
    fisheye = mc_calib(BACK, lens=[0.01, -0.005, 0.002, 0.0], kind=1)
    found = import_cameras(written(tmp_path, "a.json", {"camera_0": mc_calib(np.eye(4)), "camera_1": fisheye}))
    assert [camera.model.fisheye for camera in found.cameras] == [False, True]
    assert [note for note in found.notes if "unit" not in note] == []
    apart = {"camera_0": mc_calib(np.eye(4)), "camera_1": mc_calib(BACK, group=1)}
    found = import_cameras(written(tmp_path, "b.json", apart))
    assert found.poses == ()
    assert "the cameras are not of one group" in found.notes[0]


@pytest.mark.parametrize(
    "content",
    [
        {"right": PART, "left": PART, "stereo": TURN},
        TURN | {"cam1": PART, "cam0": PART},
        {"Camera1.K": M, "Camera1.D": D, "Camera2.K": M, "Camera2.D": D, "Stereo.T_c1_c2": BACK.tolist()} | SIZE,
        {"Camera.K": M, "Camera.D": D, "Camera2.K": M, "Camera2.D": D, "Tlr": BACK[:3].tolist()} | SIZE,
        {"cameras": [OKVIS | {"T_SC": np.eye(4).ravel().tolist()}, OKVIS | {"T_SC": BACK.ravel().tolist()}]},
        {"nb_camera": 2, "camera_0": mc_calib(np.eye(4)), "camera_1": mc_calib(BACK)},
    ],
)
def test_poses_of_pairs(tmp_path: Path, content: dict[str, Any]) -> None:
    found = import_cameras(written(tmp_path, "a.yaml", f"%YAML:1.0\n{json.dumps(content)}"))
    assert found.names in (("left", "right"), ("cam0", "cam1"), ("0", "1"), ("camera_0", "camera_1"))
    assert np.abs(found.rig().right_from_left_rotation.numpy() - MOVE[:3, :3]).max() < 1e-12
    assert found.rig().right_from_left_translation.tolist() == pytest.approx(MOVE[:3, 3])


def test_of_other_pairs_it_is_said_which_is_the_second(tmp_path: Path) -> None:
    notes = import_cameras(written(tmp_path, "a.json", {"rgb": PART, "ir": PART} | TURN)).notes
    assert "R and T are taken as those of ir from rgb" in notes


def test_cameras_of_each_device_keep_their_names(tmp_path: Path) -> None:
    content = {"a": {"color": PART, "depth": PART}, "b": {"color": PART}, "rest": {"fps": 30.0, "info": {"gain": 2.0}}}
    found = import_cameras(written(tmp_path, "a.json", content))
    assert found.names == ("a color", "a depth", "b")
    assert found.notes == ()


def test_sections_of_an_ini_are_cameras(tmp_path: Path) -> None:
    text = "".join(f"[{side}_EYE]\nfx={f}\nfy=505\ncx=330\ncy=236\nk1=-0.1\nk2=0.02\np1=0\np2=0\nk3=0\n\n"
                   for side, f in (("LEFT", 500), ("RIGHT", 501)))  # fmt: skip
    found = import_cameras(written(tmp_path, "eyes.conf", text + "[STEREO]\nBaseline=120\n"), size=(640, 480))
    assert found.names == ("LEFT_EYE", "RIGHT_EYE")
    assert [camera.params[:6].tolist() for camera in found.cameras] == [[f, 505, 330, 236, 0, -0.1] for f in (500, 501)]
    assert found.notes == ()


def test_bouguet_pair_and_errors(tmp_path: Path) -> None:
    errors = {"fc_error": [0.3, 0.6], "cc_error": [0.9, 1.2], "kc_error": [0.003] * 5}
    (camera,) = import_cameras(written(tmp_path, "one.mat", BOUGUET | errors)).cameras
    assert camera.calibration is not None
    assert camera.calibration.covariance is not None
    # The toolbox states three standard deviations.
    assert camera.calibration.covariance.diagonal().sqrt()[:4].tolist() == pytest.approx([0.1, 0.2, 0.3, 0.4])
    pair = {f"{key}_{side}": value for side in ("left", "right") for key, value in BOUGUET.items() if key[0] != "n"}
    stereo = pair | {"nx": 640.0, "ny": 480.0, "R": np.eye(3), "T": [[-100.0], [0], [0]]}
    rig = import_cameras(written(tmp_path, "Calib_Results_stereo.mat", stereo)).rig()
    assert rig.right_from_left_translation.tolist() == pytest.approx([-0.1, 0, 0])


FIELD = Path(os.environ.get("KCAL_DATA", ".")) / "field"
WIDE = np.array([[0.9, 0.4, 1.0], [-0.5, 0.3, 1], [0.1, -0.2, 1]])
TUTORIAL = plain([[535.9, 0, 342.3], [0, 535.9, 235.6], [0, 0, 1]], [-0.266, -0.0386, 0.00178, -0.00028, 0.2384])
IN_FIELD: dict[str, Pixels] = {
    "dropdist/b.json": TUTORIAL,
    "yaml/list.yml": TUTORIAL,
    "yaml/tight.yml": TUTORIAL,
    "ros/ost.yaml": fisheye([[404.0, -1, 871], [0, 404.7, 597.4], [0, 0, 1]], [0.18, -0.03, 0.0004, -0.0007]),
    "nerf/ingp.json": half(fisheye([[500.0, 0, 640], [0, 500, 360], [0, 0, 1]], [0.05, -0.01, 0, 0])),
    "binning/info.yaml": plain(
        [[299.54396, 0, 254.14465], [0, 300.14093, 183.94307], [0, 0, 1]], [-0.097715, 0.08086, -0.003701, 0.001999, 0]
    ),
    "binning/roi.yaml": plain([[1000.0, 0, 960], [0, 1000, 540], [0, 0, 1]], [-0.1, 0.08, 0, 0, 0]),
    "imports/bouguet.mat": plain(
        [[657.46, 0, 303.13], [0, 657.94, 242.56], [0, 0, 1]], [-0.256, 0.127, -2e-4, 3e-5, 0]
    ),
    "imports/ost.txt": plain(
        [[438.783367, 0, 305.593336], [0, 437.302876, 243.738352], [0, 0, 1]],
        [-0.361976, 0.11051, 0.001014, 0.000505, 0],
    ),
    "imports/kalibr_openvins.yaml": plain(
        [[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1]], [-0.28, 0.07, 2e-4, 2e-5]
    ),
    "imports/colmap_mixed.txt": half(plain([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], np.zeros(5))),
    "imports/kalibr_mixed.yaml": plain(
        [[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1]], [-0.28, 0.07, 2e-4, 2e-5]
    ),
}


@pytest.mark.skipif(not FIELD.is_dir(), reason="KCAL_DATA does not name the data")
@pytest.mark.parametrize("name", IN_FIELD)
def test_files_of_the_field(name: str) -> None:
    seen = import_cameras(FIELD / name).cameras[0].project(torch.from_numpy(WIDE))[0].numpy()
    assert np.abs(seen - IN_FIELD[name](WIDE)).max() < 1e-6


@pytest.mark.skipif(not FIELD.is_dir(), reason="KCAL_DATA does not name the data")
def test_what_the_field_says_besides() -> None:
    assert "outside" in import_cameras(FIELD / "binning/roi.yaml").notes[0]
    assert import_cameras(FIELD / "binning/info.yaml").cameras[0].size == (516, 386)
    mixed = import_cameras(FIELD / "imports/kalibr_mixed.yaml").cameras[1]
    wanted = ds(-0.2925, 0.5557, np.array([[373.459, 0, 639.49], [0, 372.398, 473.647], [0, 0, 1]]))(WIDE)
    assert np.abs(mixed.project(torch.from_numpy(WIDE))[0].numpy() - wanted).max() < 0.01
    pair = import_cameras(FIELD / "imports/cv_stereo_cm.yml", size=(640, 480), meters=1e-2)
    assert float(pair.rig().baseline) == pytest.approx(0.0169535, abs=1e-6)
