"""What a file is, by its first bytes; each of the kinds that messages name."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from kcal.file_kind import WORDS, file_kind

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("a", b"", "empty"),
        ("a", b" \n\t", "empty"),
        ("a.txt", b'{"kcal": "camera", "version": 1}', "camera"),
        ("a.txt", b' \n{ "kcal" : "rig"}', "rig"),
        ("a.json", b'{"version": 1, "kcal": "board"}', "board"),
        ("a.json", b'{"version": 1, "kcal": 5}', "json"),
        ("a.json", b'{"version": 1, "kcal": "board"', "json"),
        ("a.json", b'[1, "kcal"]', "json"),
        ("a.json", b'{"a": 1}', "json"),
        ("a.json", b'\xef\xbb\xbf{"a": 1}', "json"),
        ("a.json", b'{"type": "FeatureCollection", "features": []}', "geojson"),
        ("a.json", b'{"type": "Feature"}', "geojson"),
        ("a.png", b'{"type": "Point"}', "json"),
        ("a.csv", PNG + bytes(50), "image"),
        ("a.txt", b"\xff\xd8\xff\xe0" + bytes(50), "image"),
        ("a.txt", b"BMW, a car, and more than thirty letters of it", "table"),
        ("a", b"\0\0\0\x18ftypmp42", "video"),
        ("a", b"\x1aE\xdf\xa3" + bytes(9), "video"),
        ("a", b"RIFF....AVI LIST", "video"),
        ("a", b"\0\0\1\xba" + bytes(9), "video"),
        ("a.xml", b'<?xml version="1.0"?>\n<gpx version="1.1">', "gpx"),
        ("a.xml", b"<?xml version='1.0'?><opencv_storage>", "foreign"),
        ("a.yml", b"%YAML:1.0\n---\n", "foreign"),
        ("a.yaml", b"cam0:\n  resolution: [1, 2]", "foreign"),
        ("a.yaml", b"image_width: 640", "foreign"),
        ("a.cameramodel", b"# generated\n{ 'lensmodel': 1 }", "foreign"),
        ("a.mat", b"MATLAB 5.0" + bytes(120), "foreign"),
        ("a.npz", b"PK\3\4" + bytes(120), "foreign"),
        ("a.xyz", b"PK\3\4" + bytes(120), "unknown"),
        ("a.html", b"<!DOCTYPE HTML>\n<p>", "page"),
        ("a.html", b"\n<html lang=en>", "page"),
        ("a.csv", b"name,left_u,left_v,right_u,right_v\n", "marks"),
        ("a.csv", b'name;"LEFT_U"\n', "marks"),
        ("a.csv", b"name\tlat\tlon\n", "survey"),
        ("a.csv", b"name, East, up\n", "survey"),
        ("a.csv", b"name,place\n1,2\n", "table"),
        ("a.csv", b"words without a comma\n1,2\n", "unknown"),
    ],
)
def test_kinds(name: str, content: bytes, kind: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    assert file_kind(path) == kind
    assert kind in WORDS


def test_what_is_no_file(tmp_path: Path) -> None:
    assert file_kind(tmp_path) == "folder"
    assert file_kind(tmp_path / "none") == "missing"
    assert file_kind("a\0b") == "missing"
    os.mkfifo(tmp_path / "pipe")
    assert file_kind(tmp_path / "pipe") == "device"
