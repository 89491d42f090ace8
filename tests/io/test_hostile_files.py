"""Hostile files for every reader: an error of kcal that names the file, in bounded time and memory, and never a crash.

Each reader runs in a process of its own, so that a crash is a finding and not the end of the tests.
"""

from __future__ import annotations

import base64
import io
import json
import math
import os
import random
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import torch
from scipy.io import savemat

from kcal.corners.board import Board
from kcal.corners.foreign_corners import import_corners
from kcal.corners.images import read_gray
from kcal.corners.kalibr_target import target_fields
from kcal.corners.observations import Observations, View
from kcal.corners.orientation import turned_images
from kcal.corners.video import VideoFrames, read_frames
from kcal.errors import KcalError
from kcal.files import read_bytes
from kcal.io.camera_file import load_camera, save_camera
from kcal.io.format_prior import prior_of, write_priors
from kcal.io.formats import FORMATS, import_cameras
from kcal.io.lookup_file import load_lookup, save_lookup
from kcal.io.rig_file import load_rig, save_rig
from kcal.lens.baking import bake
from kcal.lens.calibration import CameraCalibration
from kcal.lens.camera import Camera
from kcal.lens.mounting import Origin
from kcal.lens.rig import StereoRig
from kcal.locate.ground import terrain
from kcal.locate.marks import read_marks
from kcal.locate.survey import read_features, read_survey
from kcal.locate.survey_files import import_survey
from scripts.check.fuzz import damage_bytes, damage_json, damage_table

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="crashes are looked for in child processes")

BOARD = Board(columns=3, rows=2, square=0.1)
CAMERA = Camera.build(focal=(300, 301), center=(159.5, 119.5), size=(320, 240), coefficients=[-0.1, 0.02, 0, 0, 0])
# Seconds and bytes for one file.
_SECONDS, _MEMORY = 20, 3 * 2**30
_DEEP = 200_000


class Reader(NamedTuple):
    """What reads files of a suffix, and how to make a valid one."""

    read: Callable[[Path], Any]
    suffix: str
    write: Callable[[Path], object]


def _points() -> np.ndarray:
    grid = np.stack(np.meshgrid(np.arange(3.0), np.arange(2.0)), -1).reshape(-1, 2)
    return np.stack([40.0 + 30.0 * grid + shift for shift in (0.0, 5.0)])


def _opencv_corners(path: Path) -> None:
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("image_width", 320)
    file.write("image_height", 240)
    file.write("image_points", _points().astype(np.float32))
    file.release()


def _text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content)


def _observations(path: Path) -> None:
    views = [View(name=f"{k}.png", pixels=tuple(map(tuple, view.tolist()))) for k, view in enumerate(_points())]
    Observations(board=BOARD, image_size=(320, 240), views=tuple(views)).save(path)


def _video(path: Path) -> None:
    video = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (64, 48))
    for k in range(3):
        video.write(np.full((48, 64, 3), 40 * k, np.uint8))
    video.release()


def _raster(path: Path) -> None:
    rasterio = pytest.importorskip("rasterio")
    with warnings.catch_warnings(action="ignore"), rasterio.open(
        path, "w", driver="GTiff", width=8, height=8, count=1, dtype="float32", crs="EPSG:4326",
        transform=rasterio.transform.from_origin(20.0, 10.0, 0.01, 0.01),
    ) as raster:  # fmt: skip
        raster.write(np.ones((1, 8, 8), np.float32))


def _foreign(format_name: str, suffix: str) -> Reader:
    known = FORMATS[format_name]
    return Reader(lambda path: import_cameras(path, format=format_name), suffix,
                  lambda path: known.write([CAMERA if "opencv5" in known.models else _four()], [], path))  # fmt: skip


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


_ROWS = "0,40,50,30,50\n1,60,70,50,70\n"
_PLACES = [(f"p{k}", 20.0 + 0.1 * k, 10.0, 3.0) for k in range(3)]
READERS = {
    **{f"{name} {suffix}": _foreign(name, suffix) for name, suffix in (
        ("opencv", ".yml"), ("opencv", ".xml"), ("opencv", ".json"), ("ros", ".yaml"), ("kalibr", ".yaml"),
        ("mrcal", ".cameramodel"), ("colmap", ".txt"), ("colmap", ".bin"), ("nerfstudio", ".json"), ("matlab", ".mat"),
        ("opensfm", ".json"), ("toml", ".toml"), ("gtsam", ".json"))},
    "mrcal inputs": Reader(import_cameras, ".cameramodel", _mrcal_inputs),
    "packed inputs": Reader(_unpacked, ".npz", lambda path: path.write_bytes(_packed_inputs())),
    "prior .json": Reader(import_cameras, ".json", _prior),
    "prior .npz": Reader(import_cameras, ".npz", _prior),
    "omni": Reader(import_cameras, ".yaml", _text(_OMNI)),
    "Kalibr's results": Reader(lambda path: import_cameras(path, size=(320, 240)), ".txt", _text(_RESULTS)),
    "qualisys": Reader(lambda path: import_cameras(path, format="qualisys"), ".txt", _text(_QUALISYS)),
    "agisoft": Reader(lambda path: import_cameras(path, format="agisoft"), ".xml", _text(_AGISOFT)),
    "any camera": Reader(import_cameras, ".yml", lambda path: FORMATS["opencv"].write([CAMERA], [], path)),
    "camera": Reader(load_camera, ".json", lambda path: save_camera(CAMERA, path)),
    "rig": Reader(load_rig, ".json", lambda path: save_rig(
        StereoRig(CAMERA, CAMERA, torch.eye(3), torch.tensor([-2.0, 0.0, 0.0])), path)),
    "lookup": Reader(load_lookup, ".npz", lambda path: save_lookup(bake(CAMERA, 0.1), path)),
    "observations": Reader(Observations.load, ".json", _observations),
    "target": Reader(target_fields, ".yaml", _text(
        "target_type: aprilgrid\ntagCols: 6\ntagRows: 4\ntagSize: 0.08\ntagSpacing: 0.25\n")),
    "corners .vnl": Reader(_corners, ".vnl", _text(
        "# filename x y level\n" + "".join(f"a.png {u} {v} 0\n" for u, v in _points()[0].tolist()))),
    "corners .csv": Reader(_corners, ".csv", _text(
        "image,u,v\n" + "".join(f"a.png,{u},{v}\n" for u, v in _points()[0].tolist()))),
    "corners .yml": Reader(_corners, ".yml", _opencv_corners),
    "corners .xml": Reader(_corners, ".xml", _opencv_corners),
    "corners .mat": Reader(_corners, ".mat", lambda path: savemat(
        path, {"imagePoints": np.moveaxis(_points(), 0, -1), "imageSize": [[240.0, 320.0]]}, do_compression=True)),
    "image .png": Reader(read_gray, ".png", lambda path: cv2.imwrite(str(path), np.eye(40, dtype=np.uint8) * 200)),
    "image .jpg": Reader(lambda path: (turned_images([path]), read_gray(path)), ".jpg",
                         lambda path: cv2.imwrite(str(path), np.eye(40, dtype=np.uint8) * 200)),
    "video": Reader(lambda path: (list(read_frames(path)), VideoFrames(path).count), ".avi", _video),
    "terrain": Reader(terrain, ".tif", _raster),
    "survey .csv": Reader(read_survey, ".csv", _text(
        "name,lat,lon,height,sigma\n" + "".join(f"{n},{b},{a},{h},0.1\n" for n, a, b, h in _PLACES))),
    "survey .geojson": Reader(lambda path: import_survey(path, Origin(lat=10.0, lon=20.0, height=0.0)), ".geojson",
                              _text(json.dumps({"type": "FeatureCollection", "features": [
                                  {"type": "Feature", "properties": {"name": n, "sigma": 0.1},
                                   "geometry": {"type": "Point", "coordinates": at}} for n, *at in _PLACES]}))),
    "survey .gpx": Reader(lambda path: import_survey(path, sigma=0.1, geoid=0.0), ".gpx", _text(
        "<gpx>" + "".join(f'<wpt lat="{b}" lon="{a}"><ele>{h}</ele><name>{n}</name></wpt>' for n, a, b, h in _PLACES)
        + "</gpx>")),
    "marks": Reader(read_marks, ".csv", _text("name,left_u,left_v,right_u,right_v\n" + _ROWS)),
    "features": Reader(lambda path: read_features(path, 0.3), ".csv", _text(
        "name,left_u,left_v,right_u,right_v\n" + _ROWS)),
}  # fmt: skip


def hostile_texts() -> Iterator[tuple[str, bytes]]:
    """Whole files for any reader: nested, endless, repeating themselves, or none at all."""
    yield "empty", b""
    yield "zeros", bytes(100_000)
    yield "no text", bytes(range(256)) * 10
    for opening, closing in (("[", "]"), ("{", "}"), ("(", ")"), ('{"a":', "}"), ("[{'a':", "}]")):
        yield f"deep {opening}", (opening * _DEEP + closing * _DEEP).encode()
    yield "deep XML", b"<opencv_storage>" + b"<a>" * _DEEP + b"</a>" * _DEEP + b"</opencv_storage>"
    yield "deep OpenCV", b"%YAML:1.0\n---\nimage_points: " + b"[" * _DEEP
    yield "deep OpenCV maps", b"%YAML:1.0\n---\n" + b"".join(b" " * k + b"a:\n" for k in range(2000))
    yield "deep dashes", b"%YAML:1.0\n---\na:\n" + b"- " * _DEEP + b"1"
    yield "long sum", b"+".join([b"1"] * _DEEP)
    yield "long sign", b"-" * _DEEP + b"1"
    yield "entities", b'<?xml version="1.0"?><!DOCTYPE a [<!ENTITY a "aaaaaaaaaa">' + b"".join(
        f'<!ENTITY {chr(98 + k)} "{f"&{chr(97 + k)};" * 10}">'.encode() for k in range(12)
    ) + b"]><opencv_storage><a>&m;</a></opencv_storage>"  # fmt: skip
    names = [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n" if k else "a0: &a0 [1, 1]\n" for k in range(20)]
    yield "anchors", ("".join(names) + "cam0: {camera_model: pinhole, distortion_model: none, intrinsics: *a19, "
                      "resolution: [9, 9]}\ncamera_matrix: {data: *a19}\ntarget_type: *a19\n").encode()  # fmt: skip
    yield "itself", b"cam0: &a [*a]\ncamera_matrix: &b {data: *b}\ntarget_type: &c [*c]\n"
    for digits in (400, 5000):
        number = "9" * digits
        yield f"{digits} digits", json.dumps({"w": 1, "h": 1, "fl_x": 0}).replace("0", number).encode()
        yield f"{digits} digits in lines", f"name,lat,lon,height,sigma\na,{number},1,1,{number}\n".encode()
        place = {"properties": {"sigma": 1}, "geometry": {"type": "Point", "coordinates": [1, 2, 3]}}
        text = json.dumps({"features": [place]}).replace("3", number)
        yield f"{digits} digits in a place", text.encode()
        yield f"{digits} digits of COLMAP", f"{number} PINHOLE {number} {number} 1 1 1 1\n".encode()
    yield "one long line", b"a" * 3_000_000
    sides = b"   rows: 2000000000\n   cols: 2000000000\n   dt: 2f\n   data: []\n"
    yield "many rows and columns", b"%YAML:1.0\nimage_points: !!opencv-matrix\n" + sides


def damaged(reader: Reader, whole: bytes, count: int) -> Iterator[tuple[str, bytes]]:
    """A valid file with damage in one place, and with impossible numbers."""
    for number in (b"1e308", b"-1e308", b"1e999", b"nan", b".inf", b"NaN", b"0", b"-1", b"1e18", b"x", b'""'):
        for old in (b"300", b"159.5", b"320", b"240", b"301"):
            if old in whole and b"\0" not in whole:
                yield f"{old.decode()} is {number.decode()}", whole.replace(old, number, 1)
    kinds = {".json": damage_json, ".geojson": damage_json, ".csv": damage_table}
    for case in range(count):
        rng = random.Random(case)
        damage = kinds.get(reader.suffix, damage_bytes) if case % 2 else damage_bytes
        data, done, _ = damage(whole, rng)
        yield f"case {case}: {done}", data


def special_files(folder: Path, suffix: str) -> Iterator[tuple[str, Path]]:
    """Names that are no ordinary files."""
    os.mkfifo(folder / f"pipe{suffix}")
    (folder / f"folder{suffix}").mkdir()
    (folder / f"zero{suffix}").symlink_to("/dev/zero")
    with open(folder / f"sparse{suffix}", "wb") as file:
        file.truncate(6 * 2**30)
    for name in ("pipe", "folder", "zero", "sparse", "missing"):
        yield name, folder / f"{name}{suffix}"


def run_cases(reader: Reader, folder: Path, count: int) -> Iterator[tuple[str, str]]:
    """What each hostile file brings to light: its name and the finding."""
    good = folder / f"good{reader.suffix}"
    reader.write(good)
    reader.read(good)
    path = folder / f"bad{reader.suffix}"

    def given() -> Iterator[tuple[str, Path]]:
        for name, data in (*hostile_texts(), *damaged(reader, good.read_bytes(), count)):
            path.write_bytes(data)
            yield name, path
        yield from special_files(folder, reader.suffix)

    for name, file in given():
        signal.alarm(_SECONDS)
        begin = time.monotonic()
        try:
            found = reader.read(file)
            odd = [] if not hasattr(found, "cameras") else [
                c for c in found.cameras if not bool(c.params.isfinite().all() & (c.focal < 1e9).all())
            ]  # fmt: skip
            if odd or name in ("pipe", "folder", "zero", "sparse", "missing"):
                yield name, "accepted"
        except KcalError as error:
            if file.name not in str(error) and file.stem not in str(error):
                yield name, f"the message names no file: {error!s:.200}"
        except BaseException:
            yield name, traceback.format_exc(limit=-2)[-600:]
        finally:
            signal.alarm(0)
        if time.monotonic() - begin > _SECONDS / 2:
            yield name, f"{time.monotonic() - begin:.0f} s"


def _hang(*_: object) -> None:
    raise TimeoutError(f"longer than {_SECONDS} s")


def _limit_memory() -> None:
    import resource

    pages = int(Path("/proc/self/statm").read_text().split()[0]) if sys.platform == "linux" else 0
    if pages:
        most = pages * resource.getpagesize() + _MEMORY
        resource.setrlimit(resource.RLIMIT_AS, (most, most))


def findings(reader: Reader, folder: Path, count: int) -> list[str]:
    """All findings of a reader, in a child process; its end is one more if it crashes."""
    out = folder / "findings.txt"
    out.touch()
    child = os.fork()
    if child == 0:
        try:
            warnings.simplefilter("ignore")
            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            signal.signal(signal.SIGALRM, _hang)
            _limit_memory()
            with tempfile.TemporaryDirectory(dir=folder) as inside, open(out, "w") as file:
                for name, what in run_cases(reader, Path(inside), count):
                    print(json.dumps([name, what]), file=file, flush=True)
            os._exit(0)
        except BaseException:
            out.write_text(json.dumps(["the run", traceback.format_exc()]))
            os._exit(1)
    status = os.waitpid(child, 0)[1]
    found = [": ".join(json.loads(line)) for line in out.read_text().splitlines()]
    return [*found, f"ended with {status}"] if status else found


@pytest.mark.parametrize("name", READERS)
def test_no_reader_crashes_hangs_or_raises_anything_else(name: str, tmp_path: Path) -> None:
    if name == "terrain":
        pytest.importorskip("rasterio")
    assert findings(READERS[name], tmp_path, 16) == []


def test_findings_are_seen(tmp_path: Path) -> None:
    """A reader that crashes on nested files, and one that reads anything."""

    def crash(path: Path) -> None:
        if b"[[[[" in path.read_bytes():
            os.kill(os.getpid(), signal.SIGKILL)
        raise KcalError(path.name)

    assert f"ended with {int(signal.SIGKILL)}" in findings(Reader(lambda p: p.name == "good.x" or crash(p), ".x",
                                                               _text("x")), tmp_path, 0)  # fmt: skip
    names = [finding.split(":")[0] for finding in findings(Reader(float_of, ".x", _text("1")), tmp_path, 0)]
    assert "empty" in names


def float_of(path: Path) -> float:
    if not path.is_file() or path.stat().st_size > 10**7:
        raise KcalError(path.name)
    value = float(path.read_bytes())
    return value if math.isfinite(value) else 0.0
