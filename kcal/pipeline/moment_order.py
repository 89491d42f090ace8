"""Times of a stream in their order: one that its neighbors contradict is left out, a clock that was set is followed."""

from __future__ import annotations

import math
from typing import Generic, NamedTuple, TypeVar

# Seconds: a step ahead beyond it, and beyond ten times the last step, waits until later times bear it out.
_AHEAD_S, _STEPS = 1.0, 10.0
# Seconds: times that go back by less are of moments that came before, once more or out of order; less ahead is a gap.
_BACK_S = 15.0
# Moments in their order that make a jump true.
_RUN = 3
# Seconds, the year 5138: a larger number is no time in seconds.
MOST_SECONDS = 1e11
T = TypeVar("T")


class Released(NamedTuple, Generic[T]):
    """What is to be done after one more moment.

    Attributes:
        moments: to be taken in now, in the order in which they came.
        jump_s: by how many seconds the clock was set before the first of them; 0 if it was not, or by a short gap.
        contradicted: how many that waited are left out.
        repeated: whether this moment is left out, because its time is not after the last one.
    """

    moments: list[T]
    jump_s: float = 0.0
    contradicted: int = 0
    repeated: bool = False


class MomentOrder(Generic[T]):
    """Decide moment by moment which are taken in.

    A time that jumps, ahead or back, waits. If the next ones go on from where the clock was, it is left out. If they go
    on from it, the clock was set (or nothing was seen for a while), and they are taken in.

    Args:
        time: seconds of the last moment; -inf before the first.
        step: seconds between the last two.
        until: times up to this one are repeated, until one is later: a source that begins somewhat earlier again.

    Example:
        >>> order = MomentOrder[str]()
        >>> [order.put(name, time).moments for name, time in (("a", 1.0), ("b", 1.1), ("wrong", 9e4), ("c", 1.2))]
        [['a'], ['b'], [], ['c']]
        >>> [order.put(name, time).moments for name, time in (("d", 9e4), ("e", 90000.1), ("f", 90000.2))]
        [[], [], ['d', 'e', 'f']]
    """

    def __init__(self, time: float = -math.inf, step: float = 0.0, until: float = -math.inf) -> None:
        self.time, self.step, self.until = max(time, until), step, until
        self._waiting: list[tuple[T, float]] = []

    @property
    def waiting(self) -> int:
        """Moments whose times nothing has borne out yet."""
        return len(self._waiting)

    def put(self, moment: T, time: float) -> Released[T]:
        """Take one more moment."""
        ahead = time - self.time
        if 0.0 < ahead <= max(_AHEAD_S, _STEPS * self.step) or self.time == -math.inf:
            return self._release([(moment, time)], contradicted=len(self._waiting))
        if -_BACK_S <= ahead <= 0.0 or time <= self.until:
            return Released([], repeated=True)
        contradicted = 0
        if self._waiting and time <= self._waiting[-1][1]:
            contradicted, self._waiting = len(self._waiting), []
        self._waiting.append((moment, time))
        if len(self._waiting) < _RUN:
            return Released([], contradicted=contradicted)
        jump = self._waiting[0][1] - self.time
        return self._release(self._waiting, 0.0 if 0.0 < jump <= _BACK_S else jump)

    def end(self) -> Released[T]:
        """The source has ended: a short gap before what waits needs no proof; what jumped waits for the next run."""
        if self._waiting and 0.0 < self._waiting[0][1] - self.time <= _BACK_S:
            return self._release(self._waiting)
        return Released([])

    def _release(self, run: list[tuple[T, float]], jump: float = 0.0, contradicted: int = 0) -> Released[T]:
        before = run[-2][1] if len(run) > 1 else self.time
        self.time, self._waiting, self.until = run[-1][1], [], -math.inf
        self.step = self.time - before if math.isfinite(before) else 0.0
        return Released([moment for moment, _ in run], jump, contradicted)
