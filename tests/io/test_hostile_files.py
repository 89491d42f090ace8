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
