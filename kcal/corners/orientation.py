"""Read the EXIF orientation of JPEG files. kcal ignores it, and says so."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

from PIL import ExifTags
from PIL.JpegImagePlugin import JpegImageFile

from kcal.files import read_head

_HEAD = 1 << 17  # bytes: the EXIF block is among the first 64 KiB, another block may precede it


def exif_orientation(data: bytes) -> int:
    """The orientation (1 to 8) that a JPEG's EXIF block asks viewers for; 1 (as stored) where there is none.

    3 is turned by 180°, 6 and 8 by 90°; 2, 4, 5 and 7 are mirrored as well. Pixels in kcal are always as stored.
    Source: JEITA CP-3451 (Exif 2.3), tag 0x0112.

    Args:
        data: the file's bytes, or the first of them.

    Example:
        >>> exif_orientation(b"no JPEG")
        1
    """
    try:
        orientation = JpegImageFile(io.BytesIO(data)).getexif().get(ExifTags.Base.Orientation, 1)
    except (SyntaxError, OSError, ValueError):  # no JPEG, or a damaged one: `decode_gray` reports it
        return 1
    return int(orientation) if orientation in range(1, 9) else 1


def turned_images(paths: Sequence[str | Path]) -> list[Path]:
    """Those of the files whose EXIF block asks viewers to turn or mirror them.

    Raises:
        FileError: a file that cannot be read.
    """
    found = []
    for path in map(Path, paths):
        if exif_orientation(read_head(path, _HEAD)) != 1:
            found.append(path)
    return found
