"""Frames of video files with their own times, decoded by PyAV (the extra `video`)."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import NamedTuple, cast

import av
import numpy as np
import torch
from av.container import InputContainer
from av.format import Flags
from av.video.stream import VideoStream
from numpy.typing import NDArray
from torch import Tensor

from kcal.errors import FileError

# A file whose frames end this much before it says, in seconds or as a share of its length, is damaged or cut off.
_SHORT_S, _SHORT_SHARE = 1.0, 0.02
# Seconds before a wanted frame to which a file is wound: decoders are exact again after the next key frame.
_RUN_UP = 1.0
# No playlists and descriptions of sessions, which name other files and addresses.
_CONTAINERS = "mov,matroska,avi,mpegts,mpeg,flv,asf,ogg,nut,mxf,h264,hevc,mjpeg,m4v"


class TimedFrame(NamedTuple):
    """A decoded frame, and the seconds at which it was captured or is to be shown."""

    time: float
    picture: av.VideoFrame

    @property
    def place(self) -> int:
        """The time in whole microseconds, from 1 at second zero."""
        return round(1e6 * self.time) + 1

    def colors(self) -> NDArray[np.uint8]:
        """(H, W, 3) red, green and blue."""
        return np.asarray(self.picture.to_ndarray(format="rgb24", threads=1), np.uint8)

    def gray(self) -> Tensor:
        """(H, W) uint8 gray levels."""
        return torch.from_numpy(self.picture.to_ndarray(format="gray", threads=1))


def check_size(frame: av.VideoFrame | VideoStream, size: tuple[int, int], name: str) -> None:
    """Raise unless a frame or stream is as large as the camera's images.

    Raises:
        FileError: another size. Whether it was scaled or cropped cannot be seen, and the two differ by far.
    """
    if (frame.width, frame.height) != size:
        raise FileError(
            f"{name}: frames of {frame.width}x{frame.height} px, but the camera has {size[0]}x{size[1]}; record at "
            "the size of the calibration, or make a rig of cameras that are `resized` or `cropped` like the video"
        )


def file_frames(
    path: Path,
    size: tuple[int, int],
    since: float = 0.0,
    undecoded: Callable[[], None] = lambda: None,
    tell: Callable[[str], None] = lambda _: None,
) -> Iterator[TimedFrame]:
    """The frames of a file in the order of their times, in the orientation in which the sensor wrote them.

    Args:
        path: any container with times: MP4, MOV, MKV, AVI, MPEG-TS.
        size: (width, height) of the camera's images.
        since: seconds of the first frame that is wanted; some frames before it come too.
        undecoded: called for each frame that is damaged or not later than the one before; it is left out.
        tell: called if the frames end long before the file says.

    Raises:
        FileError: no such file, no video, one without times, no frame that can be decoded, or frames of another size.
    """
    if since > 0:
        with contextlib.closing(_wound(path, size, since, lambda: None, lambda _: None)) as frames:
            first = next(frames, None)
        # Where winding overshoots, the whole file is decoded.
        since = since if first is not None and first.time <= since else 0.0
    count = 0
    for frame in _wound(path, size, since, undecoded, tell):
        count += 1
        yield frame
    if not count:
        raise FileError(f"{path}: no frame can be decoded")


def _wound(
    path: Path, size: tuple[int, int], since: float, undecoded: Callable[[], None], tell: Callable[[str], None]
) -> Generator[TimedFrame]:
    if not path.is_file():
        raise FileError(f"{path}: no such file")
    allowed = {"protocol_whitelist": "file", "format_whitelist": _CONTAINERS}
    with open_video(f"file:{path}", str(path), **allowed) as container:
        if container.format.flags & cast(int, Flags.no_timestamps.value):
            raise FileError(f"{path}: a raw stream has no times; put it into a container with the times of the camera")
        stream = container.streams.video[0]
        base = stream.time_base
        if base is None:
            raise FileError(f"{path}: the video has no unit of time")
        if stream.width and stream.height:
            check_size(stream, size, str(path))
        if since > 0:
            container.seek(max(0, round((since - _RUN_UP) / base)), stream=stream)
        latest = 0
        for picture in decoded(container, undecoded):
            if picture.pts is None:
                raise FileError(f"{path}: a frame has no time; put the video into a container with times, such as MP4")
            check_size(picture, size, str(path))
            frame = TimedFrame(float(picture.pts * base), picture)
            if frame.place <= latest:
                undecoded()
                continue
            latest = frame.place
            yield frame
        begin, length = container.start_time or 0, (container.duration or 0) / av.time_base
        missing = begin / av.time_base + length - 1e-6 * latest
        if missing > max(_SHORT_S, _SHORT_SHARE * length):
            tell(f"{path}: its frames end {missing:.1f} s before its stated end: it is damaged or was cut off")


def open_video(address: str, name: str, **options: str) -> InputContainer:
    """Open a file or address; `name` stands for it in messages, because an address may have a password.

    The decoder has no threads of its own. Closing a video would wait for them, forever in a process that was forked
    meanwhile, such as a worker of a `DataLoader`: threads are not there.

    Raises:
        FileError: it cannot be opened, or has no video.
    """
    try:
        container = av.open(address, options=options, timeout=10.0)
    except (av.FFmpegError, OSError) as error:
        raise FileError(f"{name}: cannot be opened as a video: {error.strerror or type(error).__name__}") from error
    if not container.streams.video:
        container.close()
        raise FileError(f"{name}: no video in it")
    container.streams.video[0].codec_context.thread_count = 1
    return container


def decoded(
    container: InputContainer, undecoded: Callable[[], None], look: Callable[[av.Packet], None] = lambda _: None
) -> Iterator[av.VideoFrame]:
    """The frames of the first video stream; damaged ones are told and left out, with what was built on them.

    Args:
        container: that is read.
        undecoded: called for each frame that is left out.
        look: called with each packet before it is decoded.
    """
    damaged = False
    for packet in container.demux(container.streams.video[0]):
        look(packet)
        try:
            pictures = packet.decode()
        except av.InvalidDataError:
            damaged = True
            undecoded()
            continue
        for picture in pictures:
            damaged = picture.is_corrupt or (damaged and not picture.key_frame)
            if damaged:
                undecoded()
            else:
                yield picture
