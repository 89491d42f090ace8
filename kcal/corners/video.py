"""Detect the board in the frames of a video or a live stream that are sharp and show it in a new place."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.detect import Detection, detect_board, view_of
from kcal.corners.observations import Failure, Observations, View
from kcal.corners.recognize import spread_order
from kcal.corners.refine import Refinement
from kcal.corners.time_limit import Limited, TookTooLongError
from kcal.errors import FileError, InputError
from kcal.files import is_stream, source_name, write_atomic
from kcal.opencv import cv2

MOST_VIEWS = 40
DURATION = 120.0  # seconds: how long a live stream is read by default
_STREAM_TIMEOUT_MS = 10_000  # for opening, and for each frame
NEW = 0.04  # of the image's width: how far the board's corners must have moved from every earlier view
_GROUP = 7  # frames, of which only the sharpest is searched


class Frame(NamedTuple):
    """A frame of a video: its number from 0 and gray levels (H, W) uint8."""

    number: int
    image: npt.NDArray[np.uint8]


def read_frames(source: str | Path, duration: float | None = None) -> Iterator[Frame]:
    """The gray frames of a video file or a live stream, in the orientation in which the sensor wrote them.

    Args:
        source: a video file, or a live source as in `is_stream`.
        duration: seconds after which a live source is closed.

    Raises:
        FileError: the file is missing or no video, the stream does not answer, or no frame can be decoded.
    """
    live, name = is_stream(source), source_name(source) if is_stream(source) else str(source)
    if not live and not os.path.isfile(source):
        raise FileError(f"{source}: no such file")
    video = _open(str(source)) if live else cv2.VideoCapture(str(source))
    until = time.monotonic() + (DURATION if duration is None else duration) if live else float("inf")
    try:
        if not video.isOpened():
            what = "no stream that answers" if live else "not a video that can be read; use MP4, AVI, MOV or MKV"
            raise FileError(f"{name}: {what}")
        # A phone's orientation tag would swap width and height; the lens does not turn with it.
        video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        number = -1
        while number < 0 or time.monotonic() < until:
            done, frame = video.read()
            if not done:
                break
            number += 1
            gray = frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
            yield Frame(number, np.asarray(gray, np.uint8))
        if number < 0:
            raise FileError(f"{name}: no frame that can be decoded")
    finally:
        video.release()


class VideoFrames:
    """Single frames of a video file by their number from 0, gray, as `read_frames` gives them.

    Args:
        source: a video file.

    Raises:
        FileError: the file is missing or no video, or its number of frames is not known.
    """

    def __init__(self, source: str | Path) -> None:
        if not Path(source).is_file():
            raise FileError(f"{source}: no such file")
        self.source = Path(source)
        self._video = cv2.VideoCapture(str(source))
        self.count = int(self._video.get(cv2.CAP_PROP_FRAME_COUNT)) if self._video.isOpened() else 0
        self.rate = float(self._video.get(cv2.CAP_PROP_FPS))
        if self.count < 1:
            raise FileError(f"{source}: not a video that can be read; use MP4, AVI, MOV or MKV")
        self._video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
        self._next = 0

    def __getitem__(self, number: int) -> npt.NDArray[np.uint8]:
        frame = self._frame(number)
        return np.asarray(frame if frame.ndim == 2 else cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY), np.uint8)

    def stored(self, number: int) -> npt.NDArray[np.uint8]:
        """A frame in color (H, W, 3), red first; (H, W) if the video has none."""
        frame = self._frame(number)
        return frame if frame.ndim == 2 else frame[..., ::-1]

    def _frame(self, number: int) -> npt.NDArray[np.uint8]:
        if self._next != number:
            self._video.set(cv2.CAP_PROP_POS_FRAMES, number)
        done, frame = self._video.read()
        self._next = number + 1
        if not done:
            raise FileError(f"{self.source}: frame {number} cannot be decoded")
        return np.asarray(frame, np.uint8)


def spread_frames(source: str | Path) -> Iterator[npt.NDArray[np.uint8]]:
    """Frames of a video from all over it, the first few of them far apart; those of a live stream as they come."""
    if is_stream(source):
        yield from (frame.image for frame in sharpest(read_frames(source)))
        return
    frames = VideoFrames(source)
    yield from (frames[number] for number in spread_order(frames.count))


def _open(stream: str) -> cv2.VideoCapture:
    if stream.lower().startswith("camera:"):
        return cv2.VideoCapture(int(stream.split(":")[1]))
    waits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _STREAM_TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _STREAM_TIMEOUT_MS]
    return cv2.VideoCapture(stream, cv2.CAP_FFMPEG, waits)


def sharpest(frames: Iterator[Frame]) -> Iterator[Frame]:
    """The sharpest of every seven consecutive frames, because frames are blurred while the board or the camera moves.

    Sharpness is the mean squared difference of neighboring pixels. It also grows with noise, so it only compares frames
    of the same moment.

    Example:
        >>> frames = [Frame(i, np.full((4, 4), i, np.uint8)) for i in range(7)]
        >>> frames[4].image[1, 1] = 200
        >>> [frame.number for frame in sharpest(iter(frames))]
        [4]
    """
    held: list[tuple[float, Frame]] = []
    for frame in frames:
        held.append((_sharpness(frame.image), frame))
        if len(held) == _GROUP:
            yield max(held, key=lambda item: item[0])[1]
            held.clear()
    if held:
        yield max(held, key=lambda item: item[0])[1]


def detect_video(
    source: str | Path,
    board: Board,
    refine: Refinement = "erf",
    *,
    most: int = MOST_VIEWS,
    progress: Callable[[str], None] | None = None,
    time_limit: float | None = None,
    duration: float | None = None,
    keep: str | Path | None = None,
) -> Observations:
    """Find the board in the frames of a video or a live stream of one camera.

    The sharpest of every seven frames is searched. It becomes a view if the board's corners are at least 4 % of the
    image's width (root mean square) from those of every earlier view. Views are named `video.mp4#000123` by the frame's
    number from 0; those of a stream by its host.

    Args:
        source: a video file, `rtsp://...` or another address, or `camera:0` for a device of this machine.
        board: the board.
        refine: see `kcal.corners.refine.refine_corners`.
        most: number of views after which the search ends.
        progress: called with each searched frame's name.
        time_limit: seconds after which the search of a frame is stopped; no limit by default.
        duration: seconds after which a live stream is closed; 120 by default.
        keep: folder for the frames that became views, as PNG, because a stream cannot be read again.

    Raises:
        FileError: the file is missing or no video, a stream does not answer, or a frame cannot be kept.
        InputError: no board in any frame.
    """
    if most < 1:
        raise InputError(f"most={most}: at least one view is needed")
    kept: list[Tensor] = []
    views: list[View] = []
    size = (1, 1)
    reason = ""
    failures: list[Failure] = []
    with Limited(time_limit) as limited:
        for frame in sharpest(read_frames(source, duration)):
            name = f"{source_name(source)}#{frame.number:06d}"
            size = frame.image.shape[1], frame.image.shape[0]
            try:
                found = limited(detect_board, frame.image, board, refine)
            except TookTooLongError as error:
                found = Detection(None, str(error))
                failures.append(Failure(name=name, reason=found.reason))
            reason = found.reason or reason
            if found.pixels is not None and is_new_view(found.pixels, kept, NEW * size[0]):
                kept.append(found.pixels)
                image = None if is_stream(source) else str(source)
                if keep is not None:
                    path = Path(keep) / (re.sub(r"[^\w.-]+", "_", name) + ".png")
                    image = str(write_atomic(path, cv2.imencode(".png", frame.image)[1].tobytes()))
                views.append(view_of(found, name, image=image))
            if progress is not None:
                progress(name)
            if len(views) == most:
                break
    if not views:
        raise InputError(f"{source_name(source)}: no board in any frame ({reason})")
    return Observations(board=board, image_size=size, refinement=refine, views=tuple(views), failures=tuple(failures))


def is_new_view(pixels: Tensor, kept: Sequence[Tensor], least: float) -> bool:
    """Whether a board's corners (N, 2) moved, root mean square, by this many pixels at least from each earlier view.

    Args:
        pixels: NaN where not seen.
        kept: likewise of the earlier views.
        least: `NEW` times the image's width is usual.
    """
    # NaN, which is never less, where two views share no corner: other parts of a ChArUco board.
    moves = [float((pixels - before).square().sum(-1).nanmean().sqrt()) for before in kept]
    return not any(moved < least for moved in moves)


def _sharpness(image: npt.NDArray[np.uint8]) -> float:
    small = image[:: max(1, image.shape[0] // 540)].astype(np.float32)
    return float(np.square(np.diff(small, axis=1)).mean())
