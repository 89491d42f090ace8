"""Images of both cameras, frame by frame, as tiles at every scale: what is not looked at is not prepared."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from kcal.calibrate.rig.pairs import pair_by_name
from kcal.corners.images import VIDEO_SUFFIXES, Gray, expand_images, read_gray
from kcal.corners.video import VideoFrames
from kcal.errors import InputError
from kcal.mark.items import Side

TILE = 512  # pixels along a side of a tile
_KEPT_FRAMES = 4  # per camera


class FrameSource(Protocol):
    """Frames by number."""

    def __getitem__(self, number: int) -> Gray: ...


class _Files(NamedTuple):
    paths: tuple[Path, ...]

    def __getitem__(self, number: Any) -> Any:
        return read_gray(self.paths[number])


class Pyramid:
    """An image at halved sizes, each made when it is first asked for."""

    def __init__(self, image: Gray) -> None:
        self._levels: list[Gray] = [np.ascontiguousarray(image)]
        self._lock = threading.Lock()
        low, high = (float(v) for v in np.percentile(image[::16, ::16] if image.size > 1 << 20 else image, (0.1, 99.9)))
        self.span = (low, high if high > low else low + 1.0)

    @property
    def image(self) -> Gray:
        """The image as it was read."""
        return self._levels[0]

    def level(self, number: int) -> Gray:
        """The image, each pixel being the mean of 2^number x 2^number; incomplete blocks at the end are left out."""
        with self._lock:
            while len(self._levels) <= number:
                self._levels.append(_halved(self._levels[-1]))
            return self._levels[number]

    def tile(self, number: int, column: int, row: int, span: tuple[float, float] | None = None) -> NDArray[np.uint8]:
        """A tile as 8 bits: the gray levels themselves, or `span` stretched to 0 to 255.

        Raises:
            InputError: no such tile.
        """
        whole = self.image.shape
        if not 0 <= number <= top_level(whole) or column < 0 or row < 0:
            raise InputError(f"no tile {column}, {row} at level {number}")
        part = self.level(number)[row * TILE : (row + 1) * TILE, column * TILE : (column + 1) * TILE]
        if part.size == 0:
            raise InputError(f"no tile {column}, {row} at level {number}")
        if part.dtype == np.uint8 and span is None:
            return part.astype(np.uint8, copy=False)
        low, high = span or self.span
        scaled = (part.astype(np.float32) - low) * (255.0 / max(high - low, 1e-6))
        return np.clip(np.rint(scaled), 0, 255).astype(np.uint8)


def top_level(shape: tuple[int, ...]) -> int:
    """The level at which the image fits one tile."""
    level = 0
    while max(shape) >> level > TILE:
        level += 1
    return level


def _halved(image: Gray) -> Gray:
    height, width = (size // 2 * 2 for size in image.shape)
    even = image[:height, :width]
    if image.dtype == np.uint8:
        return np.asarray(Image.fromarray(np.ascontiguousarray(even)).reduce(2))
    wide = even.astype(np.uint32)
    total = wide[::2, ::2] + wide[1::2, ::2] + wide[::2, 1::2] + wide[1::2, 1::2]
    return ((total + 2) >> 2).astype(np.uint16)


class Pictures:
    """The frames of both cameras.

    Args:
        names: of each pair of frames.
        left: frames of the left camera.
        right: frames of the right camera.
        files: names of the files of each pair, for notes.
    """

    def __init__(self, names: Sequence[str], left: FrameSource, right: FrameSource) -> None:
        self.names = tuple(names)
        self._sources = {"left": left, "right": right}
        self._kept: dict[str, OrderedDict[int, Pyramid]] = {"left": OrderedDict(), "right": OrderedDict()}
        self._locks = {"left": threading.Lock(), "right": threading.Lock()}

    def pyramid(self, side: Side, frame: int) -> Pyramid:
        """A frame with its smaller sizes; the last four of each camera are kept.

        Raises:
            InputError: no such frame.
            FileError: it cannot be read.
        """
        if not 0 <= frame < len(self.names):
            raise InputError(f"there is no frame {frame}; the last one is {len(self.names) - 1}")
        with self._locks[side]:
            kept = self._kept[side]
            if frame not in kept:
                kept[frame] = Pyramid(self._sources[side][frame])
            kept.move_to_end(frame)
            while len(kept) > _KEPT_FRAMES:
                kept.popitem(last=False)
            return kept[frame]

    def image(self, side: Side, frame: int) -> Gray:
        """A frame as it was read."""
        return self.pyramid(side, frame).image

    def number(self, name: str) -> int | None:
        """The number of the pair with this name."""
        return self.names.index(name) if name in self.names else None


def open_pictures(left: Path, right: Path) -> Pictures:
    """Images, folders of images that are paired by name, or two videos that are paired by frame.

    Raises:
        FileError: nothing there, or nothing that can be read.
        InputError: a video and an image, videos of different rates, or names that cannot be paired.
    """
    videos = [path.suffix.lower() in VIDEO_SUFFIXES for path in (left, right)]
    if videos[0] != videos[1]:
        raise InputError(f"{left} and {right}: two images, two folders or two videos are needed")
    if videos[0]:
        first, second = VideoFrames(left), VideoFrames(right)
        if abs(first.rate - second.rate) > 1e-3 * first.rate:
            raise InputError(
                f"the videos have {first.rate:g} and {second.rate:g} frames a second: frames of one number are not of "
                "one moment; convert one of them"
            )
        return Pictures([f"#{n:06d}" for n in range(min(first.count, second.count))], first, second)
    lefts, rights = expand_images([left]), expand_images([right])
    if len(lefts) == len(rights) == 1:
        names, pairs = [lefts[0].stem], [(0, 0)]
    else:
        by_name = [{path.name: i for i, path in enumerate(paths)} for paths in (lefts, rights)]
        found = pair_by_name(list(by_name[0]), list(by_name[1]))
        pairs = [(by_name[0][a], by_name[1][b]) for a, b in found]
        names = [Path(a).stem for a, _ in found]
    return Pictures(names, _Files(tuple(lefts[i] for i, _ in pairs)), _Files(tuple(rights[i] for _, i in pairs)))
