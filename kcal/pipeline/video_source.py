"""Frames of videos and live streams, those that belong together, and the objects in them: `Videos`."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import struct
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar, cast

import av
import numpy as np
import torch
from av.container import InputContainer
from av.format import Flags
from av.video.stream import VideoStream
from numpy.typing import NDArray
from torch import Tensor

from kcal.bag import stamp_in
from kcal.corners.images import bag_images, decode_image, image_bytes, to_8bit
from kcal.errors import FileError, InputError
from kcal.files import is_stream, source_name
from kcal.lens.rig import Rig
from kcal.locate.localizer import Localizer
from kcal.pipeline.association import AssociationOptions
from kcal.pipeline.detections import Detections, Detector, detect_in
from kcal.pipeline.grouping import Moment, group_objects
from kcal.pipeline.pairing import ObjectDisparity, ObjectViews, pair_objects
from kcal.pipeline.senders import CALENDAR
from kcal.pipeline.stream import SourceItem
from kcal.threads import Handover

# Frames of video files with their own times, decoded by PyAV (the extra `video`).

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
        path: any container with times: MP4, MOV, MKV, AVI, MPEG-TS; or a bag (`run.mcap:/left/image_raw`), whose times
            are Unix seconds.
        size: (width, height) of the camera's images.
        since: seconds of the first frame that is wanted; some frames before it come too.
        undecoded: called for each frame that is damaged or not later than the one before; it is left out.
        tell: called if the frames end long before the file says.

    Raises:
        FileError: no such file, no video, one without times, no frame that can be decoded, or frames of another size.
    """
    images = bag_images(path)
    if since > 0 and images is None:
        with contextlib.closing(_wound(path, size, since, lambda: None, lambda _: None)) as frames:
            first = next(frames, None)
        # Where winding overshoots, the whole file is decoded.
        since = since if first is not None and first.time <= since else 0.0
    count = 0
    wound = _wound(path, size, since, undecoded, tell)
    for frame in wound if images is None else _of_bag(images, size, since, undecoded):
        count += 1
        yield frame
    if not count:
        raise FileError(f"{path}: no frame can be decoded")


def _of_bag(
    images: Iterable[Path], size: tuple[int, int], since: float, undecoded: Callable[[], None]
) -> Iterator[TimedFrame]:
    for path in images:
        if (time := 1e-9 * (stamp_in(path) or 0)) >= since:
            try:
                image = to_8bit(decode_image(image_bytes(path), path))
            except FileError:
                undecoded()
                continue
            kind = "gray" if image.ndim == 2 else "rgb24" if image.shape[2] == 3 else "rgba"
            picture = av.VideoFrame.from_ndarray(image, format=kind)
            check_size(picture, size, str(path))
            yield TimedFrame(time, picture)


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


# Which frames of videos belong together: the nearest in time, each frame once.


class Timed(Protocol):
    """What has a time in seconds."""

    @property
    def time(self) -> float:
        """Seconds."""


F = TypeVar("F", bound=Timed)


def frames_together(
    cameras: Sequence[Iterator[F]], late: Callable[[int], float], apart_s: float, *, whole: bool = False
) -> Iterator[tuple[float, list[F | None]]]:
    """Groups of frames in the order of their times, each with the time of its first one; None where there is no frame.

    A frame waits for the next group if that is nearer, and the noise of no frame counts twice. Frame rates may differ
    and vary, and a video may end earlier.

    Args:
        cameras: frames of each in the order of their times.
        late: seconds by which the images of a camera (its number) are later than their times say, as known at present.
        apart_s: frames that are later than the first one of a group by more are not in it.
        whole: leave out groups in which a frame is missing, and end with the first video that ends.

    Example:
        >>> from collections import namedtuple
        >>> Frame = namedtuple("Frame", "time")
        >>> slow, fast = (map(Frame, times) for times in ([0.0, 0.1], [0.01, 0.05, 0.09, 0.13]))
        >>> [[f and f.time for f in group] for _, group in frames_together([slow, fast], lambda _: 0.0, 0.05)]
        [[0.0, 0.01], [None, 0.05], [0.1, 0.09], [None, 0.13]]
    """
    now = [next(frames, None) for frames in cameras]
    while (all if whole else any)(frame is not None for frame in now):
        times = [math.inf if frame is None else frame.time + late(c) for c, frame in enumerate(now)]
        begin = min(times)
        leader = times.index(begin)
        following = next(cameras[leader], None)
        until = math.inf if following is None else following.time + late(leader)
        taken = [time - begin <= min(apart_s, abs(until - time)) for time in times]
        taken[leader] = True
        if all(taken) or not whole:
            yield begin, [frame if there else None for frame, there in zip(now, taken, strict=True)]
        for c, there in enumerate(taken):
            if there:
                now[c] = following if c == leader else next(cameras[c], None)
                if whole and now[c] is None:
                    return


# Frames of a live stream with calendar times; connected again when it breaks off.

# Seconds before the first and the last attempts to connect again.
_FIRST_WAIT, _LAST_WAIT = 1.0, 30.0
# Seconds without a sender report after which there are none: RFC 3550 recommends one every five.
_NO_REPORT = 12.0


class _NoReportsError(Exception):
    """The stream tells no calendar times."""


def live_frames(
    address: str,
    size: tuple[int, int],
    ended: threading.Event,
    tell: Callable[[str], None],
    undecoded: Callable[[], None] = lambda: None,
) -> Iterator[TimedFrame]:
    """The frames of a stream, in Unix seconds, until `ended` is set.

    Times are those of RTCP sender reports, the camera's own clock. A stream without them gets the times at which its
    packets arrive, which is told, because they include the network's delay.

    Args:
        address: `rtsp://...`, or what else libav opens; RTSP goes over TCP.
        size: (width, height) of the camera's images.
        ended: ends the frames.
        tell: called with what happens: kind of times, interruptions.
        undecoded: called for each frame that is damaged or not later than the one before; it is left out.

    Raises:
        FileError: the first connection fails, or frames have another size.
    """
    name, latest, wait = source_name(address), 0.0, _FIRST_WAIT
    by_arrival = not address.lower().startswith("rtsp")
    options = {} if by_arrival else {"rtsp_transport": "tcp"}
    while not ended.is_set():
        if by_arrival and not latest:
            tell(
                f"{name}: the stream tells no capture times; those of arrival here are taken, which include the delay "
                "of the network. --clock-sigma estimates its constant part"
            )
        try:
            container = open_video(address, name, **options, use_wallclock_as_timestamps=str(int(by_arrival)))
        except FileError as error:
            if not latest:
                raise
            reason = str(error)
        else:
            reason = f"{name}: the stream ended"
            try:
                with container:
                    for frame in _timed(container, by_arrival, undecoded):
                        if ended.is_set():
                            return
                        check_size(frame.picture, size, name)
                        if frame.time <= latest:
                            undecoded()
                            continue
                        latest, wait = frame.time, _FIRST_WAIT
                        yield frame
            except _NoReportsError:
                by_arrival = True
                continue
            except av.FFmpegError as error:
                reason = f"{name}: {error.strerror or type(error).__name__}"
        tell(f"{reason}; connecting again in {wait:g} s")
        ended.wait(wait)
        wait = min(2 * wait, _LAST_WAIT)


def _timed(container: InputContainer, by_arrival: bool, undecoded: Callable[[], None]) -> Iterator[TimedFrame]:
    # Seconds from the stream's own times to the calendar.
    shift = 0.0 if by_arrival else None
    began = time.monotonic()

    def look(packet: av.Packet) -> None:
        nonlocal shift
        if by_arrival:
            return
        report = packet.get_sidedata("prft") if packet.has_sidedata("prft") else None
        if report is not None and packet.pts is not None and packet.time_base is not None:
            wall = 1e-6 * struct.unpack("<q", bytes(report)[:8])[0]
            # A camera whose clock was never set tells earlier times.
            if wall < CALENDAR:
                raise _NoReportsError
            shift = wall - float(packet.pts * packet.time_base)
        if shift is None and time.monotonic() - began > _NO_REPORT:
            raise _NoReportsError

    for picture in decoded(container, undecoded, look):
        if picture.pts is None or picture.time_base is None or shift is None:
            undecoded()
        else:
            yield TimedFrame(float(picture.pts * picture.time_base) + shift, picture)


# `FramesTogether`: frames of videos that belong together, as they come, in bounded memory.

# Seconds of the first frame, and what each camera has.
Together = tuple[float, list[TimedFrame | None]]
# Decoded frames that wait for their partners: a third of a second of video.
_FRAMES = 8
# Frames of one live stream after which a lack of partners is told: some seconds.
_ALONE = 100


@dataclasses.dataclass(kw_only=True)
class VideoCounts:
    """What became of frames so far.

    Attributes:
        frames: decoded frames of each camera.
        paired: groups of frames that the detector saw.
        undecoded: frames that were damaged or out of order.
        dropped: groups of a live source for which there was no time.
        strangers: pairs of frames with boxes in both, none of which is of one object.
    """

    frames: dict[str, int]
    paired: int = 0
    undecoded: int = 0
    dropped: int = 0
    strangers: int = 0

    def __str__(self) -> str:
        each = [f"{count:,}" for count in self.frames.values()]
        what = "pairs" if len(each) == 2 else "groups"
        parts = [f"videos: {', '.join(each[:-1])} and {each[-1]} frames, {self.paired:,} {what}"]
        for count, words in (
            (self.undecoded, "damaged or out of order, left out"),
            (self.dropped, f"{what} dropped for lack of time"),
            (self.strangers, "with boxes in both, none of one object: are videos and cameras in one order?"),
        ):
            parts += [f"{count:,} {words}"] if count else []
        return "; ".join(parts)


class FramesTogether:
    """Frames of videos that belong together.

    Call it with the offset of the last group that is not wanted any more: microseconds of its time, from 1. Files wait
    until there is time for the next frames; of live streams the newest ones are taken, the others counted.

    Args:
        videos: file or address of each camera.
        sizes: by the name of each camera, (width, height) of its images.
        pairs: of two videos, only frames that both have; otherwise also those that some have.
        late: seconds by which the images of a camera, from 1, are later than their times say, as known at present.
        apart_s: frames that are farther apart in time do not belong together.
        tell: called with what happens to live streams, and of files that end early, from another thread.

    Raises:
        InputError: another number of videos, or a file beside a live stream.
    """

    def __init__(
        self,
        videos: Sequence[str],
        sizes: dict[str, tuple[int, int]],
        *,
        pairs: bool,
        late: Callable[[int], float] = lambda _: 0.0,
        apart_s: float = 0.5,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        if len(videos) != len(sizes):
            raise InputError(f"{len(sizes)} videos are needed, of {', '.join(sizes)}; got {len(videos)}")
        self.counts = VideoCounts(frames=dict.fromkeys(sizes, 0))
        self.live = is_stream(videos[0])
        if any(is_stream(video) != self.live for video in videos):
            named = " and ".join(source_name(video) for video in videos)
            raise InputError(f"{named}: files alone or live streams alone are needed")
        self._videos, self._sizes, self._pairs = tuple(videos), sizes, pairs
        self._late, self._apart, self._tell = late, apart_s, tell
        self._ended, self._met = threading.Event(), False
        self._running: list[Handover[TimedFrame]] = []
        self._newest: Handover[Together] | None = None

    def __call__(self, offset: int) -> Iterator[tuple[int, Together]]:
        """The groups after an offset, each with its own."""
        # Somewhat earlier frames decide which frames belong together.
        frames = [self._frames(0, 1e-6 * offset - self._apart)]
        for c in range(1, len(self._videos)):
            frames.append(self._frames(c, 1e-6 * offset - 2 * self._apart - self._late(c)))
        if not (offset or self.live or self._pairs):
            self._tell_early()
        groups: Iterable[Together] = self._grouped(frames)
        if self.live:
            groups = self._newest = Handover(groups, 1, waits=False)
        for began, group in groups:
            place = round(1e6 * began) + 1
            if place > offset:
                yield place, (began, group)
            if self._newest is not None:
                self.counts.dropped = self._newest.dropped
        if not (self._met or offset or self.live or self._ended.is_set()):
            raise FileError(
                f"{' and '.join(self._videos)}: no frames within {self._apart:g} s of each other; if the "
                "recordings began at different times, say so with --clock-offset"
            )

    def _tell_early(self) -> None:
        """Say what is left out of files that begin before second 0 of the first one, from which times count."""
        first, *others = self._sizes
        for c, name in enumerate(others, 1):
            if (early := -self._late(c)) > 0:
                self._tell(
                    f"{name}: what it shows in the {early:.3g} s before second 0 of {first} is left out, because times "
                    "count from there; put the camera first that begins first"
                )

    def _grouped(self, frames: list[Iterator[TimedFrame]]) -> Iterator[Together]:
        late = lambda c: self._late(c) if c else 0.0  # noqa: E731
        for began, group in frames_together(frames, late, self._apart, whole=self._pairs):
            self._met = self._met or sum(frame is not None for frame in group) > 1
            # The time of a pair is that of the left image.
            first = group[0] if self._pairs else None
            yield (began if first is None else first.time), group

    def close(self) -> None:
        """End the threads that decode."""
        self._ended.set()
        for running in self._running:
            running.close()
        if self._newest is not None:
            self._newest.close()

    def _frames(self, camera: int, since: float) -> Iterator[TimedFrame]:
        (name, size), video = list(self._sizes.items())[camera], self._videos[camera]

        def undecoded() -> None:
            self.counts.undecoded += 1

        if self.live:
            frames = live_frames(video, size, self._ended, self._tell, undecoded)
        else:
            frames = file_frames(Path(video), size, since, undecoded, self._tell)
        running = Handover(frames, _FRAMES, waits=not self.live)
        self._running.append(running)
        for frame in running:
            self.counts.frames[name] += 1
            if self.live and self.counts.frames[name] == _ALONE and not self._met:
                self._tell(
                    f"{_ALONE} frames of the {name} camera came, none within {self._apart:g} s of one of another: do "
                    "the clocks of the cameras agree? --clock-offset corrects a known difference"
                )
            yield frame


# `Videos`: time steps of a rig's videos: a detector in frames that belong together, and matched objects.


class Videos:
    """Detect in frames that belong together; of two cameras of one mast, match the images inside the boxes too.

    Call it with the offset of the last time step that is not wanted any more: it is a source for `Stream.follow`. Files
    wait until there is time for the next frames; of live streams the newest ones are taken, the others counted.

    Args:
        videos: file or address of each camera, in the order of the rig.
        rig: the cameras, with what is known of them where they are many; frames must have their sizes.
        detector: see `detect_in`.
        options: of the pairing of boxes.
        late: seconds by which the images of a camera, from 1, are later than their times say, as known at present.
        match_sigma: pixels, error of a match along each axis besides what its pixels tell; compression makes it: 0.06
            in H.264 of usual quality (CRF 23 of x264, `scripts/check/compression.py`). Make the tracker with
            `TrackOptions.for_video(match_sigma)`. Boxes alone have none of it.
        apart_s: frames that are farther apart in time are not paired.
        tell: called with what happens to live streams, and of files that end early, from another thread.

    Raises:
        InputError: a `match_sigma` that is negative or not finite, a file beside a live stream, or another number of
            videos than of cameras.
    """

    def __init__(
        self,
        videos: Sequence[str],
        rig: Rig | Localizer,
        detector: Detector,
        options: AssociationOptions,
        *,
        late: Callable[[int], float],
        match_sigma: float,
        apart_s: float = 0.5,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        if not 0 <= match_sigma < math.inf:
            raise InputError(f"match_sigma: pixels, not negative, are needed, got {match_sigma}")
        self._compression = match_sigma**2 * torch.diag(torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64))
        self._match = ObjectDisparity(rig) if isinstance(rig, Rig) else None
        names, cameras = (("left", "right"), rig.each) if isinstance(rig, Rig) else (rig.rig.names, rig.rig.each)
        self._sizes = {name: camera.size for name, camera in zip(names, cameras, strict=True)}
        both = self._match is not None
        self._frames = FramesTogether(videos, self._sizes, pairs=both, late=late, apart_s=apart_s, tell=tell)
        self.counts, self.live = self._frames.counts, self._frames.live
        self._rig, self._detector, self._options = rig, detector, options

    def __call__(self, offset: int) -> Iterator[SourceItem]:
        """The time steps after an offset: microseconds of the first frame, from 1."""
        for place, (moment, group) in self._frames(offset):
            yield SourceItem(self._moment(moment, group), place)

    def close(self) -> None:
        """End the threads that decode."""
        self._frames.close()

    def _moment(self, time: float, group: list[TimedFrame | None]) -> Moment | InputError:
        seen = [
            None if frame is None else detect_in(self._detector, frame.colors(), frame.time, f"{name} image")
            for name, frame in zip(self._sizes, group, strict=True)
        ]
        try:
            found = self._objects(seen, group)
        except InputError as error:
            # Too many boxes: one frame, and not the end.
            return error
        self.counts.paired += 1
        return Moment(time, found)

    def _objects(self, seen: list[Detections | None], group: list[TimedFrame | None]) -> ObjectViews:
        if not isinstance(self._rig, Rig):
            return group_objects(self._rig, seen, self._options)
        (left, right), (one, other) = seen, group
        assert left is not None and right is not None and one is not None and other is not None  # noqa: PT018
        images = one.gray(), other.gray()
        pairs = pair_objects(self._rig, left, right, images, options=self._options, disparity=self._match)
        self.counts.strangers += bool(len(left) and len(right) and not len(pairs))
        return dataclasses.replace(pairs, covariance=pairs.covariance + self._compression)
