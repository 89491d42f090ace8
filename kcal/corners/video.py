"""Detect the board in the frames of a video, a bag or a live stream that are sharp and show it in a new place."""

from __future__ import annotations

import os
import re
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from torch import Tensor

from kcal.bag import pair_stamps, stamp_in
from kcal.corners.board import Board
from kcal.corners.detect import Detection, detect_board, view_of
from kcal.corners.images import Gray, bag_images, read_gray
from kcal.corners.observations import Failure, Observations, View
from kcal.corners.recognize import spread_order
from kcal.corners.refine import Refinement
from kcal.corners.time_limit import Limited, TookTooLongError
from kcal.errors import FileError, InputError, KcalWarning
from kcal.files import is_stream, source_name, write_atomic
from kcal.opencv import cv2

MOST_VIEWS = 40
DURATION = 120.0  # seconds: how long a live stream is read by default
_STREAM_TIMEOUT_MS = 10_000  # for opening, and for each frame
NEW = 0.04  # of the image's width: how far the board's corners must have moved from every earlier view
_GROUP = 7  # frames, of which only the sharpest is searched
_GROUP_NS = 250_000_000  # of frames that have times: what these last at usual rates; bags for calibration have 4 Hz


class Frame(NamedTuple):
    """A frame: its number from 0, gray levels (H, W) as stored, and the image of a bag that it is."""

    number: int
    image: Gray
    path: Path | None = None

    def name(self, source: str | Path) -> str:
        """The name of its view, where this is its source."""
        return f"{source_name(source)}#{self.number:06d}" if self.path is None else self.path.name


def read_frames(source: str | Path, duration: float | None = None) -> Iterator[Frame]:
    """The gray frames of a video file, a bag or a live stream, in the orientation in which the sensor wrote them.

    Args:
        source: a video file, a bag (`run.mcap:/left/image_raw`), or a live source as in `is_stream`.
        duration: seconds after which a live source is closed.

    Raises:
        FileError: the file is missing or no video, the stream does not answer, or no frame can be decoded.
        InputError: a bag that has no such topic, or several of which none is named.
    """
    if (images := bag_images(source)) is not None:
        yield from (frame for (frame,) in _moments_of([images]))
        return
    live, name = is_stream(source), source_name(source) if is_stream(source) else str(source)
    video = _open_stream(str(source)) if live else _open_file(source)
    until = time.monotonic() + (DURATION if duration is None else duration) if live else float("inf")
    try:
        if not video.isOpened():
            raise FileError(f"{name}: no stream that answers")
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
        self.source, self._video = Path(source), _open_file(source)
        self.count = int(self._video.get(cv2.CAP_PROP_FRAME_COUNT))
        self.rate = float(self._video.get(cv2.CAP_PROP_FPS))
        if self.count < 1:
            raise FileError(f"{source}: not a video that can be read; use MP4, AVI, MOV or MKV")
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


def spread_frames(source: str | Path) -> Iterator[Gray]:
    """Frames of a video from all over it, the first few of them far apart; those of a live stream as they come."""
    if is_stream(source):
        yield from (frame.image for frame in sharpest(read_frames(source)))
        return
    frames = VideoFrames(source)
    yield from (frames[number] for number in spread_order(frames.count))


def _open_file(path: str | Path) -> cv2.VideoCapture:
    if not os.path.isfile(path):
        raise FileError(f"{path}: no such file")
    video = cv2.VideoCapture(str(path))
    if not video.isOpened():
        raise FileError(f"{path}: not a video that can be read; use MP4, AVI, MOV or MKV")
    # A phone's orientation tag would swap width and height; the lens does not turn with it.
    video.set(cv2.CAP_PROP_ORIENTATION_AUTO, 0)
    return video


def _open_stream(stream: str) -> cv2.VideoCapture:
    if stream.lower().startswith("camera:"):
        return cv2.VideoCapture(int(stream.split(":")[1]))
    waits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _STREAM_TIMEOUT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _STREAM_TIMEOUT_MS]
    return cv2.VideoCapture(stream, cv2.CAP_FFMPEG, waits)


def _moments_of(cameras: Sequence[Sequence[Path]]) -> Iterator[list[Frame]]:
    """Images of a bag's cameras that are of one moment, by their stamps; what cannot be read is said at the end."""
    first = {stamp_in(path) or 0: path for path in cameras[0]}
    moments = [[path] for path in first.values()]
    for other in cameras[1:]:
        seconds = {stamp_in(path) or 0: path for path in other}
        partners = dict(pair_stamps([*first], [*seconds]))
        moments = [[*own, seconds[partners[stamp]]] for own in moments if (stamp := stamp_in(own[0])) in partners]
    bad: list[FileError] = []
    for number, moment in enumerate(moments):
        try:
            yield [Frame(number, read_gray(path), path) for path in moment]
        except FileError as error:
            bad.append(error)
    if len(bad) == len(moments):
        raise bad[0]
    if bad:
        warnings.warn(f"{len(bad)} images of {len(moments)} are left out: {bad[0]}", KcalWarning, stacklevel=2)


def sharpest(frames: Iterator[Frame]) -> Iterator[Frame]:
    """The sharpest of every seven consecutive frames, because frames are blurred while the board or the camera moves.

    Those of a bag are at most a quarter of a second apart.

    Sharpness is the mean squared difference of neighboring pixels. It also grows with noise, so it only compares frames
    of the same moment.

    Example:
        >>> frames = [Frame(i, np.full((4, 4), i, np.uint8)) for i in range(7)]
        >>> frames[4].image[1, 1] = 200
        >>> [frame.number for frame in sharpest(iter(frames))]
        [4]
    """
    yield from (frame for (frame,) in _sharpest([frame] for frame in frames))


def _sharpest(moments: Iterable[list[Frame]]) -> Iterator[list[Frame]]:
    # Of a group: its sharpest moment so far, how sharp that is, when it began, and how many moments it has.
    best, sharp, began, count = list[Frame](), 0.0, 0, 0
    for moment in moments:
        taken = stamp_in(moment[0].path or "") or 0
        if count and taken - began > _GROUP_NS:
            yield best
            count = 0
        own = min(_sharpness(frame.image) for frame in moment)
        began = began if count else taken
        if not count or own > sharp:
            best, sharp = moment, own
        count += 1
        if count == _GROUP:
            yield best
            count = 0
    if count:
        yield best


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
    number from 0; those of a stream by its host, and those of a bag by their stamps. Images of a bag that are more than
    a quarter of a second apart are searched each.

    Args:
        source: a video file, a bag (`run.mcap:/left/image_raw`), `rtsp://...` or another address, or `camera:0` for a
            device of this machine.
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
    (found,) = detect_videos(
        [source], board, refine, most=most, progress=progress, time_limit=time_limit, duration=duration, keep=keep
    )
    return found


def detect_videos(
    sources: Sequence[str | Path],
    board: Board,
    refine: Refinement = "erf",
    *,
    most: int = MOST_VIEWS,
    progress: Callable[[str], None] | None = None,
    time_limit: float | None = None,
    duration: float | None = None,
    keep: str | Path | None = None,
) -> list[Observations]:
    """The same for the cameras of a rig, several topics of a bag: views are of common moments.

    A moment is searched where all cameras have an image within 10 ms, and becomes a view of each camera that sees the
    board if it is new for one of them.

    Args:
        sources: one video or stream, or several topics of bags.
        board: the board.
        refine: see `kcal.corners.refine.refine_corners`.
        most: number of views of each camera after which the search ends.
        progress: called with each searched frame's name.
        time_limit: seconds after which the search of a frame is stopped; no limit by default.
        duration: seconds after which a live stream is closed; 120 by default.
        keep: folder for the frames that became views; of one camera.

    Raises:
        FileError: as `detect_video`.
        InputError: no board in any frame of a camera, images of several sizes, or no common moments.
    """
    if most < 1:
        raise InputError(f"most={most}: at least one view is needed")
    topics = [images for source in sources if (images := bag_images(source)) is not None]
    if len(sources) > 1 and (len(topics) < len(sources) or keep is not None):
        raise InputError("several cameras at once are topics of bags, whose images need no folder to be kept in")
    frames = _moments_of(topics) if topics else ([frame] for frame in read_frames(sources[0], duration))
    kept: list[list[Tensor]] = [[] for _ in sources]
    views: list[list[View]] = [[] for _ in sources]
    failures: list[list[Failure]] = [[] for _ in sources]
    sizes: list[tuple[int, int]] = []
    reasons = [""] * len(sources)
    with Limited(time_limit) as limited:
        for moment in _sharpest(frames):
            names = [frame.name(source) for source, frame in zip(sources, moment, strict=True)]
            seen = [(frame.image.shape[1], frame.image.shape[0]) for frame in moment]
            sizes = sizes or seen
            if seen != sizes:
                raise InputError(f"{names[0]}: images of {seen}, those before of {sizes} px")
            found: list[Detection] = []
            for c, frame in enumerate(moment):
                try:
                    found.append(limited(detect_board, frame.image, board, refine))
                except TookTooLongError as error:
                    found.append(Detection(None, str(error)))
                    failures[c].append(Failure(name=names[c], reason=str(error)))
                reasons[c] = found[c].reason or reasons[c]
            if any(
                len(views[c]) < most and one.pixels is not None and is_new_view(one.pixels, kept[c], NEW * sizes[c][0])
                for c, one in enumerate(found)
            ):
                for c, (one, frame) in enumerate(zip(found, moment, strict=True)):
                    if one.pixels is None:
                        continue
                    kept[c].append(one.pixels)
                    image = None if is_stream(sources[c]) else str(frame.path or sources[c])
                    if keep is not None:
                        path = Path(keep) / (re.sub(r"[^\w.-]+", "_", names[c]).removesuffix(".png") + ".png")
                        image = str(write_atomic(path, cv2.imencode(".png", frame.image)[1].tobytes()))
                    views[c].append(view_of(one, names[c], image=image))
            if progress is not None:
                progress(names[0])
            if all(len(own) >= most for own in views):
                break
    for source, own, reason in zip(sources, views, reasons, strict=True):
        if not own:
            raise InputError(f"{source_name(source)}: no board in any frame ({reason})")
    return [
        Observations(board=board, image_size=size, refinement=refine, views=tuple(own), failures=tuple(failed))
        for size, own, failed in zip(sizes, views, failures, strict=True)
    ]


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


def _sharpness(image: Gray) -> float:
    small = image[:: max(1, image.shape[0] // 540)].astype(np.float32)
    return float(np.square(np.diff(small, axis=1)).mean())
