"""`Handover`: items from a thread that makes them to the one that uses them, in bounded memory."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")
# Seconds between looks at `stop`, which a signal may set at any moment.
_LOOK = 0.2


class Handover(Generic[T]):
    """Run an iterable in a thread of its own and iterate over what it gives; its errors are raised here.

    Args:
        items: runs in the thread.
        most: items that wait at most.
        waits: when so many wait, the thread waits too; else the oldest item is dropped and counted in `dropped`.
        stop: ends both sides when it is set; the thread ends when its iterable gives the next item.

    Example:
        >>> list(Handover(range(5), 2, waits=True))
        [0, 1, 2, 3, 4]
    """

    def __init__(self, items: Iterable[T], most: int, *, waits: bool, stop: threading.Event | None = None) -> None:
        self.dropped = 0
        self._waiting: deque[T] = deque()
        self._most, self._waits = most, waits
        self._change = threading.Condition()
        self._stop, self._done = stop or threading.Event(), False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._fill, args=(items,), daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[T]:
        while True:
            with self._change:
                while not (self._waiting or self._done or self._stop.is_set()):
                    self._change.wait(_LOOK)
                if self._stop.is_set() or not self._waiting:
                    break
                item = self._waiting.popleft()
                self._change.notify_all()
            yield item
        if self._error is not None:
            raise self._error

    def close(self, wait: float = 0.0) -> None:
        """Set `stop`, and wait so many seconds for the thread to end."""
        self._stop.set()
        with self._change:
            self._change.notify_all()
        self._thread.join(wait)

    def _fill(self, items: Iterable[T]) -> None:
        try:
            for item in items:
                with self._change:
                    while self._waits and len(self._waiting) == self._most and not self._stop.is_set():
                        self._change.wait(_LOOK)
                    if self._stop.is_set():
                        return
                    if len(self._waiting) == self._most:
                        self._waiting.popleft()
                        self.dropped += 1
                    self._waiting.append(item)
                    self._change.notify_all()
        except BaseException as error:  # whatever it is, it belongs to the other thread, which must not wait for ever
            self._error = error
        finally:
            with self._change:
                self._done = True
                self._change.notify_all()
