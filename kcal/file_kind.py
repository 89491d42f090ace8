"""What a file is, by its content: for messages about files that were given in place of others."""

from __future__ import annotations

import os
import re
import stat
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import pydantic

from kcal.errors import FileError
from kcal.strict_json import MOST_BYTES, read_json

# Enough for the first line of a table and the first keys of a JSON text.
_HEAD = 65536
_NATIVE = re.compile(rb'\A\s*\{\s*"kcal"\s*:\s*"(\w{1,40})"')
_VIDEO = ((4, b"ftyp"), (0, b"\x1aE\xdf\xa3"), (8, b"AVI "), (0, b"\0\0\1\xba"), (0, b"FLV"), (0, b"G@"))
# ROS 1, MCAP, and SQLite, in which ROS 2 recorded first.
_BAG = (b"#ROSBAG V", b"\x89MCAP0\r\n", b"SQLite format 3\0")
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
    "bag": "a bag of ROS",
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
            return "bag" if _is_bag_folder(path) else "folder"
        if not stat.S_ISREG(about.st_mode):
            return "device"
        with Path(path).open("rb") as file:  # a number is refused: it would be a file that is open already
            head = file.read(_HEAD)
    except (OSError, ValueError):
        return "missing"
    if not head.strip():
        return "empty"
    if native := _NATIVE.match(head):
        return native[1].decode()
    return _foreign_kind(Path(path), head, about.st_size)


def _is_bag_folder(path: str | Path) -> bool:
    try:
        with open(os.path.join(path, "metadata.yaml"), "rb") as file:
            return b"rosbag2_bagfile_information" in file.read(_HEAD)
    except OSError:
        return False


def _foreign_kind(path: Path, head: bytes, size: int) -> str:
    if head.startswith(_BAG) and (head[:3] != b"SQL" or path.suffix.lower() == ".db3"):
        return "bag"
    still = is_heif(head) or head[4:12] == b"ftypcrx "
    if any(head[place:].startswith(mark) for place, mark in _VIDEO) and not still:
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
    if (len(columns) > 1 or columns == {"name"}) and not text.startswith(("%", "<", "#", "{", "[")):
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


# The size of an image, as kcal's files have it; apart from other checks, because torch takes long to load.

# Of one image. The largest sensors of 2025 have about 410 megapixels.
MOST_PIXELS = 500_000_000


def check_pixel_count(size: tuple[int, int]) -> tuple[int, int]:
    """Return (width, height) unless no camera has so many pixels.

    Raises:
        ValueError: more than 500 megapixels.

    Example:
        >>> check_pixel_count((1920, 1080))
        (1920, 1080)
    """
    width, height = size
    if width * height > MOST_PIXELS:
        shown = f"{width}x{height}" if max(size) < 1e12 else "more than 1e12"
        raise ValueError(f"{shown} pixels; an image may have at most {MOST_PIXELS // 10**6} megapixels")
    return size


# (width, height) in pixels, in kcal's files.
ImageSize = Annotated[tuple[pydantic.PositiveInt, pydantic.PositiveInt], pydantic.AfterValidator(check_pixel_count)]


# Read the size of an image from its first bytes, before a decoder allocates memory for it.

Size = tuple[int, int]


def check_image_header(data: bytes, source: str | Path) -> Size:
    """(width, height) of an image of a known format with at most 500 megapixels; (0, 0) of WebP, which is smaller.

    The formats are JPEG, PNG, TIFF, BMP, WebP, PNM (PBM, PGM, PPM) and JPEG 2000. Whether the rest of the file is whole
    is found out by the decoder.

    Raises:
        FileError: empty, another format, or too many pixels; `source` names it.

    Example:
        >>> check_image_header(b"P5 60000 60000 255 ", "huge.pgm")
        Traceback (most recent call last):
        kcal.errors.FileError: huge.pgm: 60000x60000 pixels; an image may have at most 500 megapixels
    """
    if not data:
        raise FileError(f"{source}: the file is empty; copy it again")
    size_of = next((size_of for start, size_of in _FORMATS.items() if data.startswith(start)), None)
    if size_of is None:
        raise FileError(f"{source}: not an image that can be read; use JPEG, PNG, TIFF, BMP, WebP or PGM")
    try:
        size = size_of(data)
    except (struct.error, IndexError, TypeError, ValueError):
        raise FileError(f"{source}: the image is truncated or corrupt; copy it again or leave it out") from None
    try:
        return check_pixel_count(size)
    except ValueError as error:
        raise FileError(f"{source}: {error}") from error


def is_image(data: bytes) -> bool:
    """Whether bytes begin like an image of a known format, or a raw one that does not begin like TIFF."""
    if is_heif(data) or data.startswith(_RAW) or data[4:12] == b"ftypcrx ":
        return True
    start, size_of = next(((start, of) for start, of in _FORMATS.items() if data.startswith(start)), (b"", None))
    if size_of is None:
        return False
    if len(start) > 2 or size_of is _jpeg:
        return True
    try:
        # Two letters begin many a text.
        return all(0 < side < 2**20 for side in size_of(data))
    except (struct.error, IndexError, TypeError, ValueError):
        return False


# Of Fujifilm, Panasonic and Olympus.
_RAW = (b"FUJIFILMCCD-RAW", b"IIU\0", b"IIRO", b"IIRS", b"MMOR")


def is_heif(data: bytes) -> bool:
    r"""Whether bytes begin like HEIC, HEIF or AVIF, as phones write them.

    Example:
        >>> is_heif(bytes(3) + b"\x18ftypheic"), is_heif(bytes(3) + b"\x18ftypisom")
        (True, False)
    """
    brands = (b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1", b"avif", b"avis")
    return data[4:8] == b"ftyp" and data[8:12] in brands


def _png(data: bytes) -> Size:
    width, height = struct.unpack_from(">II", data, 16)
    # Deflate makes a byte of 1032 at most: a larger image is damaged, and would be decoded for long.
    if MOST_PIXELS >= width * height > 8 * 1032 * len(data):
        raise ValueError("more pixels than its bytes can have")
    # The decoder takes memory for a chunk by the length that it states, up to 2 GiB, before it reads it.
    place = 8
    while place + 12 <= len(data) and data[place + 4 : place + 8] != b"IEND":
        place += 12 + int(struct.unpack_from(">I", data, place)[0])
        if place > len(data):
            raise ValueError("a chunk is longer than the file")
    return width, height


def _jpeg(data: bytes) -> Size:
    at = 2
    while True:
        at = data.index(b"\xff", at)
        while data[at] == 0xFF:
            at += 1
        marker = data[at]
        # A start of frame; 0xC4, 0xC8 and 0xCC are tables.
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, at + 4)
            return width, height
        at += 1 + struct.unpack_from(">H", data, at + 1)[0]


def _tiff(data: bytes) -> Size:
    order = "<" if data.startswith(b"II") else ">"
    big = struct.unpack_from(order + "H", data, 2)[0] == 43
    (place,) = struct.unpack_from(order + ("Q" if big else "I"), data, 8 if big else 4)
    (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, place)
    first, step = (place + 8, 20) if big else (place + 2, 12)
    sizes = {3: "H", 4: "I", 16: "Q"}
    found: dict[int, int] = {}
    for entry in range(first, first + step * min(count, 65535), step):
        tag, kind = struct.unpack_from(order + "HH", data, entry)
        if tag in (256, 257) and kind in sizes:
            (found[tag],) = struct.unpack_from(order + sizes[kind], data, entry + (12 if big else 8))
    return found.get(256, 0), found.get(257, 0)


def _bmp(data: bytes) -> Size:
    if struct.unpack_from("<I", data, 14)[0] == 12:
        return struct.unpack_from("<HH", data, 18)
    width, height = struct.unpack_from("<ii", data, 18)
    return abs(width), abs(height)


def _webp(data: bytes) -> Size:
    # The format has at most 16383 x 16383 pixels.
    return 0, 0


_PNM_SIZE = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,9})(?:\s|#[^\n]*\n)+(\d{1,9})\s")


def _pnm(data: bytes) -> Size:
    found = _PNM_SIZE.match(data)
    return int(found[1]), int(found[2])  # type: ignore[index]


def _jpeg2000(data: bytes) -> Size:
    at = data.index(b"\xff\x4f\xff\x51")
    right, bottom, left, top = struct.unpack_from(">IIII", data, at + 8)
    return right - left, bottom - top


_FORMATS: dict[bytes, Callable[[bytes], Size]] = {
    b"\x89PNG\r\n\x1a\n": _png,
    b"\xff\xd8": _jpeg,
    **dict.fromkeys((b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"), _tiff),
    b"BM": _bmp,
    b"RIFF": _webp,
    **dict.fromkeys((b"P1", b"P2", b"P3", b"P4", b"P5", b"P6"), _pnm),
    **dict.fromkeys((b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51"), _jpeg2000),
}
