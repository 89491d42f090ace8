"""Readers of other programs' files, with a whole file of each."""

from __future__ import annotations

import base64
import io
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.io import savemat

from kcal import Camera, InputError, Observations
from kcal.corners.board import Board, target_fields
from kcal.corners.foreign_corners import import_corners
from kcal.files import read_bytes
from kcal.io.foreign import ImportedCameras
from kcal.io.format_prior import prior_of, write_priors
from kcal.io.formats import FORMATS, import_cameras
from kcal.lens import CameraCalibration, export_cameras
from scripts.check.device_files import files
from scripts.fuzz.reader import Reader, whole_text

BOARD = Board(columns=3, rows=2, square=0.1)
CAMERA = Camera.build(focal=(300, 301), center=(159.5, 119.5), size=(320, 240), coefficients=[-0.1, 0.02, 0, 0, 0])


def board_points() -> np.ndarray:
    """(2, 6, 2) px of two views of the board."""
    grid = np.stack(np.meshgrid(np.arange(3.0), np.arange(2.0)), -1).reshape(-1, 2)
    return np.stack([40.0 + 30.0 * grid + shift for shift in (0.0, 5.0)])


def _opencv_corners(path: Path) -> None:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 320)
    file.write("image_height", 240)
    file.write("image_points", board_points().astype(np.float32))
    file.release()


def _kept(found: ImportedCameras) -> Any:
    """Sizes and parameters that are not zero: a file may say a richer model, whose further terms are."""
    return [
        (camera.size, {name: value for name, value in zip(camera.names, camera.params.tolist(), strict=True) if value})
        for camera in found.cameras
    ]


def _foreign(name: str, suffix: str) -> Reader:
    known = FORMATS[name]

    def save(found: ImportedCameras, path: Path) -> None:
        first = found.cameras[0]
        if len(found.cameras) > 1 or str(first.model) not in known.models:
            raise InputError("several cameras, or a lens that is only read")
        export_cameras(first, path, format=name, model=str(first.model))

    return Reader(
        lambda path: import_cameras(path, format=name), suffix,
        lambda path: known.write and known.write([CAMERA if "opencv5" in known.models else _four()], [], path),
        save, 1e-9, kept=_kept,
    )  # fmt: skip


def _four() -> Camera:
    return Camera.build(focal=(300, 301), center=(159.5, 119.5), size=(320, 240), model="opencv4")


def _prior(path: Path) -> None:
    camera = Camera.build(focal=(300, 301), center=(159.5, 119.5), size=(320, 240), coefficients=[-0.1, 0.02])
    camera.calibration = CameraCalibration(covariance=1e-4 * torch.eye(10, dtype=torch.float64))
    write_priors("ceres", [prior_of("ceres", camera)], path)


_OMNI = ("cam0: {camera_model: omni, distortion_model: radtan, intrinsics: [0.9, 300, 301, 159.5, 119.5], "
         "distortion_coeffs: [-0.1, 0.02, 0, 0], resolution: [320, 240]}\n")  # fmt: skip
_RESULTS = """cam0 (/cam0/image_raw):
     type: <class 'aslam_cv.libaslam_cv_python.DistortedPinholeCameraGeometry'>
     distortion: [-0.1 0.02 0.0 0.0] +- [0.003 0.002 0.0001 0.0001]
     projection: [300 301 159.5 119.5] +- [0.21 0.2 0.3 0.25]
"""
_QUALISYS = """<calibration><cameras><camera serial="1"><fov_video left="0" top="0" right="319" bottom="239"/>
<transform x="0" y="0" z="0" r11="1" r12="0" r13="0" r21="0" r22="1" r23="0" r31="0" r32="0" r33="1"/>
<intrinsic focalLengthU="19200" focalLengthV="19264" centerPointU="10240" centerPointV="7680" skew="0"
 radialDistortion1="-0.1" radialDistortion2="0.02" radialDistortion3="0" tangentalDistortion1="0"
 tangentalDistortion2="0"/></camera></cameras></calibration>"""
_AGISOFT = """<document><chunk><sensors><sensor id="0"><calibration type="frame" class="adjusted">
<resolution width="320" height="240"/><f>300</f><k1>-0.1</k1></calibration>
<covariance><params>f k1</params><coeffs>4 0 0 1e-6</coeffs></covariance></sensor></sensors></chunk></document>"""


def _packed_inputs() -> bytes:
    turned = np.array([[0.3, 0.1 * k, 0.0, 0.1 * k - 0.2, 0.0, 1.0] for k in range(5)])
    grid = np.stack(np.meshgrid(np.arange(7.0), np.arange(6.0), np.ones(1)), -1).reshape(1, 6, 7, 3)
    index = np.array([[k, 0, -1] for k in range(5)])
    data = io.BytesIO()
    np.savez(data, intrinsics=[[300.0, 301, 159.5, 119.5]], frames_rt_toref=turned, calibration_object_spacing=0.05,
             observations_board=grid.repeat(5, 0), indices_frame_camintrinsics_camextrinsics=index)  # fmt: skip
    return data.getvalue()


def _mrcal_inputs(path: Path) -> None:
    content = {"lensmodel": "LENSMODEL_PINHOLE", "intrinsics": [300.0, 301.0, 159.5, 119.5], "extrinsics": [0.0] * 6,
               "imagersize": [320, 240], "optimization_inputs": base64.b85encode(_packed_inputs())}  # fmt: skip
    path.write_text(repr(content))


def _unpacked(path: Path) -> object:
    """Damage below the base 85, which damage of the text hardly ever reaches."""
    model = path.with_suffix(".cameramodel")
    content = {"lensmodel": "LENSMODEL_PINHOLE", "intrinsics": [300.0, 301.0, 159.5, 119.5], "extrinsics": [0.0] * 6,
               "imagersize": [320, 240],
               "optimization_inputs": base64.b85encode(read_bytes(path, 2**26))}  # fmt: skip
    model.write_text(repr(content))
    return import_cameras(model)


def _corners(path: Path) -> Observations:
    return import_corners(path, BOARD, (320, 240))


READERS: dict[str, Reader] = {
    **{f"{name} {suffix}": _foreign(name, suffix) for name, suffix in (
        ("opencv", ".yml"), ("opencv", ".xml"), ("opencv", ".json"), ("ros", ".yaml"), ("kalibr", ".yaml"),
        ("mrcal", ".cameramodel"), ("colmap", ".txt"), ("colmap", ".bin"), ("nerfstudio", ".json"), ("matlab", ".mat"),
        ("opensfm", ".json"), ("toml", ".toml"), ("gtsam", ".json"))},
    "mrcal inputs": Reader(import_cameras, ".cameramodel", _mrcal_inputs),
    "packed inputs": Reader(_unpacked, ".npz", lambda path: path.write_bytes(_packed_inputs())),
    "prior .json": Reader(import_cameras, ".json", _prior),
    "prior .npz": Reader(import_cameras, ".npz", _prior),
    "omni": Reader(import_cameras, ".yaml", whole_text(_OMNI)),
    "Kalibr's results": Reader(lambda path: import_cameras(path, size=(320, 240)), ".txt", whole_text(_RESULTS)),
    "qualisys": Reader(lambda path: import_cameras(path, format="qualisys"), ".txt", whole_text(_QUALISYS)),
    "agisoft": Reader(lambda path: import_cameras(path, format="agisoft"), ".xml", whole_text(_AGISOFT)),
    **{program: Reader(lambda path: import_cameras(path, size=(1280, 720)), Path(name).suffix,
                       whole_text(content if isinstance(content, str) else json.dumps(content)))
       for program, _, _, name, content, _ in files() if program in ("Azure Kinect", "ZED", "KITTI")},
    "any camera": Reader(import_cameras, ".yml",
                         lambda path: export_cameras(CAMERA, path, format="opencv", model="opencv5")),
    "target": Reader(target_fields, ".yaml", whole_text(
        "target_type: aprilgrid\ntagCols: 6\ntagRows: 4\ntagSize: 0.08\ntagSpacing: 0.25\n")),
    "corners .vnl": Reader(_corners, ".vnl", whole_text(
        "# filename x y level\n" + "".join(f"a.png {u} {v} 0\n" for u, v in board_points()[0].tolist()))),
    "corners .csv": Reader(_corners, ".csv", whole_text(
        "image,u,v\n" + "".join(f"a.png,{u},{v}\n" for u, v in board_points()[0].tolist()))),
    "corners .yml": Reader(_corners, ".yml", _opencv_corners),
    "corners .xml": Reader(_corners, ".xml", _opencv_corners),
    "corners .mat": Reader(_corners, ".mat", lambda path: savemat(
        path, {"imagePoints": np.moveaxis(board_points(), 0, -1), "imageSize": [[240.0, 320.0]]}, do_compression=True)),
}  # fmt: skip
