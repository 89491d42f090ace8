"""Which frames of videos belong together: the nearest in time, each frame once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Protocol, TypeVar


class Timed(Protocol):
    """What has a time in seconds."""

    @property
    def time(self) -> float:
        """Seconds."""


F = TypeVar("F", bound=Timed)


def paired_by_time(
    left: Iterator[F], right: Iterator[F], late: Callable[[], float], apart_s: float
) -> Iterator[tuple[F, F]]:
    """Pair frames that are nearest to each other, so that the noise of no frame counts twice.

    Frame rates may differ and vary. A frame without a partner is left out; what remains when one video ends, too.

    Args:
        left: frames in the order of their times.
        right: the same of the other camera.
        late: seconds by which the right images are later than their times say, as known at present.
        apart_s: frames that are farther apart are not paired.

    Example:
        >>> from collections import namedtuple
        >>> Frame = namedtuple("Frame", "time")
        >>> slow, fast = (map(Frame, times) for times in ([0.0, 0.1, 0.2], [0.01, 0.05, 0.09, 0.13, 0.17, 0.21]))
        >>> [(one.time, other.time) for one, other in paired_by_time(slow, fast, lambda: 0.0, 0.05)]
        [(0.0, 0.01), (0.1, 0.09), (0.2, 0.21)]
    """
    now, before, after = next(left, None), None, next(right, None)
    used = -math.inf
    while now is not None:
        upcoming = next(left, None)
        wanted = now.time - late()
        while after is not None and after.time <= wanted:
            before, after = after, next(right, None)
        if after is None and before is not None and before.time + apart_s < wanted:
            return
        around = [frame for frame in (before, after) if frame is not None]
        if not around:
            return
        partner = min(around, key=lambda frame: abs(frame.time - wanted))
        apart = abs(partner.time - wanted)
        taken = upcoming is not None and abs(partner.time - wanted - (upcoming.time - now.time)) < apart
        if apart <= apart_s and partner.time > used and not taken:
            used = partner.time
            yield now, partner
        now = upcoming


def frames_together(
    cameras: Sequence[Iterator[F]], late: Callable[[int], float], apart_s: float
) -> Iterator[tuple[float, list[F | None]]]:
    """Groups of frames in the order of their times, each with the time of its first one; None where there is no frame.

    A frame waits for the next group if that is nearer. Frame rates may differ and vary, and a video may end earlier.

    Args:
        cameras: frames of each in the order of their times.
        late: seconds by which the images of a camera (its number) are later than their times say, as known at present.
        apart_s: frames that are later than the first one of a group by more are not in it.

    Example:
        >>> from collections import namedtuple
        >>> Frame = namedtuple("Frame", "time")
        >>> slow, fast = (map(Frame, times) for times in ([0.0, 0.1], [0.01, 0.05, 0.09, 0.13]))
        >>> [[f and f.time for f in group] for _, group in frames_together([slow, fast], lambda _: 0.0, 0.05)]
        [[0.0, 0.01], [None, 0.05], [0.1, 0.09], [None, 0.13]]
    """
    now = [next(frames, None) for frames in cameras]
    upcoming = [None if frame is None else next(frames, None) for frame, frames in zip(now, cameras, strict=True)]
    while any(frame is not None for frame in now):
        times, following = (
            [math.inf if frame is None else frame.time + late(c) for c, frame in enumerate(frames)]
            for frames in (now, upcoming)
        )
        begin = min(times)
        leader = times.index(begin)
        taken = [time - begin <= min(apart_s, abs(following[leader] - time)) for time in times]
        taken[leader] = True
        yield begin, [frame if there else None for frame, there in zip(now, taken, strict=True)]
        for c, there in enumerate(taken):
            if there:
                now[c], upcoming[c] = upcoming[c], None if upcoming[c] is None else next(cameras[c], None)
