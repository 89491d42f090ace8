"""Frames of a video that are worth calibrating with: sharp ones that show the board in a place not seen yet."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.detect import Detection, detect_board, view_of
from kcal.corners.limited import Limited, TookTooLongError
from kcal.corners.observations import Failure, Observations, View
from kcal.corners.refine import Refinement
from kcal.errors import FileError, InputError

SUFFIXES = frozenset({".mp4", ".avi", ".mov", ".mkv", ".m4v", ".webm", ".mpg", ".mpeg"})
MOST_VIEWS = 40
_NOVELTY = 0.04  # of the image's width: how far the board's corners must have moved, root mean square
_PEAK = 3  # frames on each side than which a frame must not be less sharp


class Frame(NamedTuple):
    """A frame of a video: its number from 0 and grey levels (H, W) uint8."""

    number: int
    image: npt.NDArray[np.uint8]


def read_frames(path: str | Path) -> Iterator[Frame]:
    """The frames of a video file, grey, turned as the sensor wrote them.

    Raises:
        FileError: the file is missing or no video, or no frame of it can be decoded.
    """
    if not Path(path).is_file():
        raise FileError(f"{path}: no such file")
    video = cv2.VideoCapture(str(path))
    try:
        if not video.isOpened():
            raise FileError(f"{path}: not a video that can be read; use MP4, AVI, MOV or MKV")
        # A phone's orientation tag would swap width and height; the lens does not turn with it.
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        number = -1
        while True:
            done, frame = video.read()
            if not done:
                break
            number += 1
            grey = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            yield Frame(number, np.asarray(grey, np.uint8))
        if number < 0:
            raise FileError(f"{path}: the video has no frame that can be decoded")
    finally:
        video.release()


def sharpest(frames: Iterator[Frame]) -> Iterator[Frame]:
    """Of every seven frames in a row at most the sharpest: while the board or the camera moves, all are blurred.

    Sharpness is the mean squared difference of neighbouring pixels, which also grows with noise: it compares frames of
    one moment with each other, nothing else.

    Example:
        >>> frames = [Frame(i, np.full((4, 4), i, np.uint8)) for i in range(7)]
        >>> frames[4].image[1, 1] = 200
        >>> [frame.number for frame in sharpest(iter(frames))]
        [4]
    """
    held: list[tuple[float, Frame]] = []
    for frame in frames:
        held.append((_sharpness(frame.image), frame))
        if len(held) == 2 * _PEAK + 1:
            yield max(held, key=lambda item: item[0])[1]
            held.clear()
    if held:
        yield max(held, key=lambda item: item[0])[1]


def detect_video(
    path: str | Path,
    board: Board,
    refine: Refinement = "erf",
    *,
    most: int = MOST_VIEWS,
    progress: Callable[[str], None] | None = None,
    time_limit: float | None = None,
) -> Observations:
    """Find the board in the frames of a video of one camera.

    Of every seven frames the sharpest is searched, and kept where the board's corners are, root mean square, at least
    4 % of the image's width away from those of every frame kept before. Views are named `video.mp4#000123` by the
    frame's number from 0.

    Args:
        path: a video file.
        board: the board.
        refine: see `kcal.corners.refine.refine_corners`.
        most: views after which the search ends.
        progress: called with each searched frame's name.
        time_limit: seconds after which a frame is given up; none by default.

    Raises:
        FileError: the file is missing or no video.
        InputError: no board in any frame.
    """
    if most < 1:
        raise InputError("most: at least one view is needed")
    kept: list[Tensor] = []
    views: list[View] = []
    size = (1, 1)
    reason = ""
    failures: list[Failure] = []
    with Limited(time_limit) as limited:
        for frame in sharpest(read_frames(path)):
            name = f"{Path(path).name}#{frame.number:06d}"
            size = frame.image.shape[1], frame.image.shape[0]
            try:
                found = limited(detect_board, frame.image, board, refine)
            except TookTooLongError as error:
                found = Detection(None, str(error))
                failures.append(Failure(name=name, reason=found.reason))
            reason = found.reason or reason
            if found.pixels is not None and _novel(found, kept, _NOVELTY * size[0]):
                kept.append(found.pixels)
                views.append(view_of(found, name, image=str(path)))
            if progress is not None:
                progress(name)
            if len(views) == most:
                break
    if not views:
        raise InputError(f"{path}: no board in any frame ({reason})")
    return Observations(board=board, image_size=size, refinement=refine, views=tuple(views), failures=tuple(failures))


def _novel(found: Detection, kept: list[Tensor], least: float) -> bool:
    assert found.pixels is not None
    for before in kept:
        both = torch.isfinite(found.pixels - before).all(-1)
        if not bool(both.any()):
            continue  # other parts of a ChArUco board
        moved = (found.pixels - before)[both].square().sum(-1).mean().sqrt()
        if float(moved) < least:
            return False
    return True


def _sharpness(image: npt.NDArray[np.uint8]) -> float:
    small = image[:: max(1, image.shape[0] // 540)].astype(np.float32)
    return float(np.square(np.diff(small, axis=1)).mean())
