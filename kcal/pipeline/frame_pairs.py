"""Which frame of the right video belongs to which of the left one: the nearest in time, each frame once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
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
