"""Frames of a live stream with calendar times; connected again when it breaks off."""

from __future__ import annotations

import struct
import threading
import time
from collections.abc import Callable, Iterator

import av
from av.container import InputContainer

from kcal.errors import FileError
from kcal.files import source_name
from kcal.pipeline.stream import CALENDAR
from kcal.pipeline.video_frames import TimedFrame, check_size, decoded, open_video

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
