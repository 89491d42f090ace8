"""What a file is, by its content: for messages about files that were given in place of others."""

from __future__ import annotations

import os
import re
import stat
from pathlib import Path

from kcal.errors import FileError
from kcal.image_header import is_image
from kcal.strict_json import MOST_BYTES, read_json

# Enough for the first line of a table and the first keys of a JSON text.
_HEAD = 65536
_NATIVE = re.compile(rb'\A\s*\{\s*"kcal"\s*:\s*"(\w{1,40})"')
_VIDEO = ((4, b"ftyp"), (0, b"\x1aE\xdf\xa3"), (8, b"AVI "), (0, b"\0\0\1\xba"), (0, b"FLV"), (0, b"G@"))
# Version of rig files of any number of cameras; those of two have a lower one.
CAMERA_RIG_VERSION = 3
# In words, for messages.
WORDS = {
    "missing": "missing",
    "folder": "a folder",
    "empty": "an empty file",
    "device": "a pipe or a device",
    "camera": "a kcal camera file",
    "rig": "a kcal rig file",
    "observations": "a kcal observations file",
    "board": "a kcal board file",
    "image": "an image",
    "video": "a video",
    "marks": "a table of marks",
    "survey": "a table of places",
    "table": "a table without known columns",
    "geojson": "GeoJSON",
    "gpx": "GPX",
    "json": "not a kcal file, but other JSON",
    "foreign": "not a kcal file, but one of another program",
    "page": "an HTML page",
    "settings": "a kcal.toml",
    "unknown": "not a kcal file, nor a table or an image",
}


def file_kind(path: str | Path) -> str:
    """One of the keys of `WORDS`, or the kind that a file of kcal states; the name of the file does not matter.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "a.json").write_text('{"kcal": "rig", "version": 2}')
        ...     file_kind(folder), file_kind(Path(folder, "a.json")), file_kind(Path(folder, "b.json"))
        ('folder', 'rig', 'missing')
    """
    try:
        about = os.stat(path)
        if stat.S_ISDIR(about.st_mode):
            return "folder"
        if not stat.S_ISREG(about.st_mode):
            return "device"
        with open(path, "rb") as file:
            head = file.read(_HEAD)
    except (OSError, ValueError):
        return "missing"
    if not head.strip():
        return "empty"
    if native := _NATIVE.match(head):
        return native[1].decode()
    return _foreign_kind(Path(path), head, about.st_size)


def _foreign_kind(path: Path, head: bytes, size: int) -> str:
    if any(head[place:].startswith(mark) for place, mark in _VIDEO):
        return "video"
    if is_image(head):
        return "image"
    text = head.decode("utf-8-sig", errors="replace").lstrip()
    if "\0" in text:
        return "foreign" if path.suffix.lower() in (".mat", ".bin", ".npz", ".pb") else "unknown"
    if text.startswith(("{", "[")) and '"left"' not in text[:40]:
        return _json_kind(path, text, size)
    low = text[:2000].lower()
    if "<gpx" in low:
        return "gpx"
    if "<html" in low or "<!doctype html" in low:
        return "page"
    columns = {cell.strip().strip('"').lower() for cell in re.split("[,;\t]", text.partition("\n")[0])}
    if columns & {"left_u", "right_u", "left_v", "right_v"} or columns >= {"camera", "u", "v"}:
        return "marks"
    if columns & {"lat", "lon", "east", "north"}:
        return "survey"
    if len(columns) > 1 and not text.startswith(("%", "<", "#", "{", "[")):
        return "table"
    return "foreign" if text.startswith(("%YAML", "<?xml", "#", "cam0", "{", "image_width")) else "unknown"


def _json_kind(path: Path, text: str, size: int) -> str:
    if '"kcal"' in text and size <= MOST_BYTES:
        try:
            content = read_json(path.read_bytes(), str(path))
        except (OSError, FileError):
            return "json"
        if isinstance(content, dict) and isinstance(content.get("kcal"), str):
            return str(content["kcal"])
    return "geojson" if '"FeatureCollection"' in text or '"Feature"' in text else "json"
