"""Read night images: ordinary image files of 8 or 16 bits, FITS, and videos whose frames are summed."""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcal.corners.image_time import DATE_IN_NAME
from kcal.corners.images import VIDEO_SUFFIXES, expand_images, read_gray
from kcal.corners.video import read_frames
from kcal.errors import FileError, InputError
from kcal.files import read_bytes
from kcal.stars.sky import parse_time

FITS_SUFFIXES = frozenset({".fits", ".fit", ".fts"})
# Of a video: more frames show no more stars than drift blurs.
_MOST_FRAMES = 100


def read_night(path: str | Path) -> NDArray[Any]:
    """Read the gray levels (H, W) of a night image, of a FITS file, or the mean of a video's frames.

    Raises:
        FileError: missing, or not such a file.
        InputError: a FITS file without astropy.
    """
    suffix = Path(path).suffix.lower()
    if suffix in FITS_SUFFIXES:
        return _read_fits(Path(path))
    if suffix not in VIDEO_SUFFIXES:
        return read_gray(path)
    total, count = None, 0
    for frame in read_frames(path):
        gray = np.asarray(frame.image, np.float64)
        total = gray if total is None else total + gray
        count += 1
        if count == _MOST_FRAMES:
            break
    if total is None:
        raise FileError(f"{path}: the video has no frames")
    return total / count


def _read_fits(path: Path) -> NDArray[Any]:
    try:
        from astropy.io import fits  # type: ignore[import-not-found, unused-ignore]
    except ImportError as error:
        raise InputError(
            f"{path}: FITS files need astropy (pip install astropy); or convert it to PNG of 16 bits"
        ) from error
    import io

    try:
        with fits.open(io.BytesIO(read_bytes(path))) as parts:
            image = next((part.data for part in parts if part.data is not None and part.data.ndim == 2), None)
    except (OSError, ValueError, TypeError, LookupError, AttributeError, OverflowError) as error:  # of a damaged header
        raise FileError(f"{path}: not a FITS file that can be read: {error}") from error
    if image is None:
        raise FileError(f"{path}: no image (H, W) in this FITS file")
    if bad := int((~np.isfinite(image)).sum()):
        raise FileError(f"{path}: {bad} pixels are no finite numbers; fill them with the gray level around them")
    # Row 0 of a FITS image is the lowest.
    return np.asarray(image[::-1], np.float64)


def expand_nights(inputs: list[str]) -> list[Path]:
    """The files that files, folders and wildcards stand for, as `expand_images`, and FITS and video files."""
    found: list[Path] = []
    for one in inputs:
        other = Path(one).suffix.lower() in FITS_SUFFIXES | VIDEO_SUFFIXES and Path(one).is_file()
        found += [Path(one)] if other else expand_images([one])
    return list(dict.fromkeys(found))


def time_of(text: str | None, path: Path) -> datetime.datetime | None:
    """When an image was taken: `text` itself, or what its name says where the text is `name:Z` or `name:+02:00`.

    Raises:
        InputError: no zone, or a name without a time.

    Example:
        >>> time_of("name:Z", Path("2019-07-29T204726_Alt40.png")).isoformat()
        '2019-07-29T20:47:26+00:00'
    """
    if text is None:
        return None
    kind, _, zone = text.partition(":")
    if kind != "name":
        return parse_time(text)
    if not zone:
        raise InputError("--time name: say the zone of the times in the names, name:Z for UTC or name:+02:00")
    found = DATE_IN_NAME.search(path.name)
    if found is None:
        raise InputError(f"{path.name}: no time in this name; it should be like 2026-11-24T204726")
    year, month, day, hour, minute, second = found.groups()[:6]
    return parse_time(f"{year}-{month}-{day}T{hour}:{minute}:{second}{zone}")
