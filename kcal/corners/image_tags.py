"""What a camera wrote into an image besides its pixels: when it was taken, and how it was held."""

from __future__ import annotations

import datetime
import io
import re
from collections.abc import Sequence
from pathlib import Path

from PIL import ExifTags, Image, UnidentifiedImageError
from PIL.JpegImagePlugin import JpegImageFile

from kcal.errors import FileError
from kcal.files import read_head

# When an image was taken: from its name, or from what the camera wrote into it.

# 20260501T120000, 2026-05-01_12-00-00 and the like, perhaps with a fraction of a second; or Unix seconds.
DATE_IN_NAME = re.compile(r"(\d{4})-?(\d{2})-?(\d{2})[T_ -](\d{2})[-_:]?(\d{2})[-_:]?(\d{2})(?:\.(\d{1,6})(?!\d))?")
_UNIX = re.compile(r"(?<![\d.])(1\d{9}(?:\.\d+)?)(?![\d])")
_HEAD = 1 << 18


def image_time(path: Path) -> float:
    """Unix seconds at which an image was taken: from a date or Unix seconds in its name (UTC), or from EXIF.

    The time of the file is not taken: a copy has another one.

    Raises:
        FileError: it has no time.

    Example:
        >>> image_time(Path("left_20260101T000000Z.png")), image_time(Path("right_1767225600.5.png"))
        (1767225600.0, 1767225600.5)
    """
    if found := DATE_IN_NAME.search(path.name):
        year, month, day, hour, minute, second = (int(part) for part in found.groups()[:6])
        try:
            moment = datetime.datetime(year, month, day, hour, minute, second, tzinfo=datetime.UTC)
        except ValueError:
            pass
        else:
            return moment.timestamp() + float(f"0.{found.group(7) or 0}")
    if unix := _UNIX.search(path.name):
        return float(unix.group(1))
    try:
        tags = Image.open(io.BytesIO(read_head(path, _HEAD))).getexif().get_ifd(ExifTags.IFD.Exif)
        text, zone = (
            str(tags.get(ExifTags.Base.DateTimeOriginal, "")),
            str(tags.get(ExifTags.Base.OffsetTimeOriginal, "")),
        )
        moment = datetime.datetime.strptime(f"{text} {zone or '+00:00'}", "%Y:%m:%d %H:%M:%S %z")
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError):
        raise FileError(
            f"{path}: no time of capture, neither in its name nor in it; name it like 20260501T120000Z.png (UTC)"
        ) from None
    return moment.timestamp()


# Read the EXIF orientation of JPEG files. kcal ignores it, and says so.

_EXIF_HEAD = 1 << 17  # bytes: the EXIF block is among the first 64 KiB, another block may precede it


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
        if exif_orientation(read_head(path, _EXIF_HEAD)) != 1:
            found.append(path)
    return found
