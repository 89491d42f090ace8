"""Frames for a capture: a camera or stream, a video, or a folder into which images come."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from kcal.corners.images import IMAGE_SUFFIXES, Gray, decode_gray
from kcal.corners.video import read_frames, sharpest
from kcal.errors import FileError
from kcal.files import read_bytes
from kcal.pipeline.handover import Handover
from kcal.sources import is_stream, source_name

# Seconds between two looks into a folder.
_LOOK = 0.5


class Shot(NamedTuple):
    """A frame with a name; `moving` tells frames of a moving board from single images."""

    name: str
    image: Gray
    moving: bool


def shots(source: str, stopped: Callable[[], bool], tell: Callable[[str], None]) -> Iterator[Shot]:
    """Frames of a source, until it ends or `stopped` says so.

    Of a video or stream the sharpest of every few frames; of a folder the images that are there and those that come.

    Args:
        source: `camera:0`, `rtsp://...`, a video file, or a folder.
        stopped: looked at before each frame.
        tell: called with the reason for each image of a folder that cannot be read.

    Raises:
        FileError: no such file or folder, no video, or a stream that does not answer.
    """
    if not is_stream(source) and os.path.isdir(source):
        yield from _of_folder(Path(source), stopped, tell)
        return
    name = source_name(source)
    # A live source ends when it is told to.
    frames = sharpest(read_frames(source, float("inf")))
    # Of a stream, frames that come while one is looked at are left out.
    newest = Handover(frames, 1, waits=False) if is_stream(source) else None
    try:
        for frame in newest or frames:
            if stopped():
                return
            yield Shot(f"{name}#{frame.number:06d}", frame.image, True)
    finally:
        if newest is not None:
            newest.close(wait=5.0)


def _of_folder(folder: Path, stopped: Callable[[], bool], tell: Callable[[str], None]) -> Iterator[Shot]:
    sizes: dict[str, int] = {}
    done: set[str] = set()
    while not stopped():
        try:
            entries = sorted(os.scandir(folder), key=lambda entry: entry.name)
            images = [entry for entry in entries if Path(entry.name).suffix.lower() in IMAGE_SUFFIXES]
            found = {entry.name: entry.stat().st_size for entry in images if entry.is_file() and entry.name not in done}
        except OSError as error:
            raise FileError(f"{folder}: cannot be read: {error.strerror}") from error
        # An image that still grows is looked at again when it has come to rest.
        ready = [name for name, size in found.items() if size and sizes.get(name) == size]
        for name in ready:
            if stopped():
                return
            done.add(name)
            try:
                yield Shot(name, decode_gray(read_bytes(folder / name), name), False)
            except FileError as error:
                tell(str(error))
        sizes = found
        if not ready:
            time.sleep(_LOOK)
