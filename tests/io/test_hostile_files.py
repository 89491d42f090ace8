"""Hostile files for every reader: an error of kcal that names the file, in bounded time and memory, and never a crash.

Each reader runs in a process of its own (`scripts/fuzz/hunt.py`), so that a crash is a finding and not the end.
"""

import json
import os
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

from kcal.errors import KcalError
from scripts.fuzz.hunt import Prepared, replay
from scripts.fuzz.readers import READERS, missing

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="crashes are looked for in child processes")

_DEEP = 200_000
# Of pipes, folders and files without end: what no reader may accept.
_SPECIAL = ("pipe", "folder", "zero", "sparse", "missing")


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
        yield f"{digits} digits in a place", json.dumps({"features": [place]}).replace("3", number).encode()
        yield f"{digits} digits of COLMAP", f"{number} PINHOLE {number} {number} 1 1 1 1\n".encode()
    yield "one long line", b"a" * 3_000_000
    sides = b"   rows: 2000000000\n   cols: 2000000000\n   dt: 2f\n   data: []\n"
    yield "many rows and columns", b"%YAML:1.0\nimage_points: !!opencv-matrix\n" + sides


def impossible(whole: bytes) -> Iterator[bytes]:
    """A valid file with impossible numbers."""
    for number in (b"1e308", b"-1e308", b"1e999", b"nan", b".inf", b"NaN", b"0", b"-1", b"1e18", b"x", b'""'):
        for old in (b"300", b"159.5", b"320", b"240", b"301"):
            if old in whole and b"\0" not in whole:
                yield whole.replace(old, number, 1)


def special_files(folder: Path, suffix: str) -> Iterator[tuple[bytes, Path]]:
    """Names that are no ordinary files."""
    os.mkfifo(folder / f"pipe{suffix}")
    (folder / f"folder{suffix}").mkdir()
    (folder / f"zero{suffix}").symlink_to("/dev/zero")
    with open(folder / f"sparse{suffix}", "wb") as file:
        file.truncate(6 * 2**30)
    for name in _SPECIAL:
        yield name.encode(), folder / f"{name}{suffix}"


def hostile(name: str, folder: Path) -> Prepared:
    """A harness whose cases are names of special files, or contents."""
    reader = READERS[name]
    prepared, special = reader.prepared(folder), dict(special_files(folder, reader.suffix))

    def check(case: bytes) -> None:
        if case not in special:
            prepared.check(case)
            return
        with pytest.raises(KcalError, match=special[case].stem if reader.named else ""):
            reader.read(special[case])

    return Prepared(prepared.cases, check)


@pytest.mark.parametrize("name", [name for name in READERS if name != "file kind"])  # which names what anything is
def test_no_reader_crashes_hangs_or_raises_anything_else(name: str, tmp_path: Path) -> None:
    if package := missing(name):
        pytest.skip(f"{package} is not installed")
    reader = READERS[name]
    cases = [text for _, text in hostile_texts()]
    cases += [case for whole in reader.wholes(tmp_path)[:1] for case in impossible(whole)]
    assert replay(partial(hostile, name), tmp_path, [*cases, *(name.encode() for name in _SPECIAL)]) == []
