"""The EXIF orientation of a JPEG file: kcal ignores it, and says so."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

from kcal.errors import FileError

UPRIGHT = 1
_TAG = 0x0112
_HEAD = 1 << 17  # bytes: the EXIF block is among the first 64 KiB, another may lie before it


def exif_orientation(data: bytes) -> int:
    """The orientation (1 to 8) that a JPEG's EXIF block asks viewers for; 1, upright, where there is none.

    1 is as stored, 3 turned by 180°, 6 and 8 by 90°; the others are mirrored as well. Pixels in kcal are always as
    stored. Source: JEITA CP-3451 (Exif 2.3), tag 0x0112.

    Args:
        data: the file's bytes.

    Example:
        >>> exif_orientation(b"no JPEG")
        1
    """
    place = 2
    if data[:2] != b"\xff\xd8":
        return UPRIGHT
    while data[place : place + 1] == b"\xff" and place + 4 <= len(data):
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if marker == 0xE1 and data[place + 4 : place + 10] == b"Exif\0\0":
            return _from_tiff(data[place + 10 : place + 2 + length])
        if marker == 0xDA or length < 2:  # the picture itself begins, or damage
            break
        place += 2 + length
    return UPRIGHT


def _from_tiff(block: bytes) -> int:
    order = {b"II": "<", b"MM": ">"}.get(block[:2])
    if order is None:
        return UPRIGHT
    try:
        (first,) = struct.unpack_from(f"{order}I", block, 4)
        (count,) = struct.unpack_from(f"{order}H", block, first)
        for i in range(count):
            tag, kind, _, value = struct.unpack_from(f"{order}HHIH", block, first + 2 + 12 * i)
            if tag == _TAG and kind == 3 and 1 <= value <= 8:
                return int(value)
    except struct.error:
        pass
    return UPRIGHT


def turned_images(paths: Sequence[str | Path]) -> list[Path]:
    """Those of the files whose EXIF block asks viewers to turn or mirror them.

    Raises:
        FileError: a file that cannot be read.
    """
    found = []
    for path in map(Path, paths):
        try:
            with path.open("rb") as file:
                head = file.read(_HEAD)
        except OSError as error:
            raise FileError(f"{path}: cannot read: {error.strerror or error}") from error
        if exif_orientation(head) != UPRIGHT:
            found.append(path)
    return found
