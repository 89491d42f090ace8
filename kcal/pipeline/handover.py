"""`Handover`: items from a thread that makes them to the one that uses them, in bounded memory."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class Handover(Generic[T]):
    """Run an iterable in a thread of its own and iterate over what it gives; its errors are raised here.

    Args:
        items: runs in the thread.
        most: items that wait at most.
        waits: when so many wait, the thread waits too; else the oldest item is dropped and counted in `dropped`.

    Example:
        >>> list(Handover(range(5), 2, waits=True))
        [0, 1, 2, 3, 4]
    """

    def __init__(self, items: Iterable[T], most: int, *, waits: bool) -> None:
        self.dropped = 0
        self._waiting: deque[T] = deque()
        self._most, self._waits = most, waits
        self._change = threading.Condition()
        self._ended = False
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._fill, args=(items,), daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[T]:
        while True:
            with self._change:
                while not self._waiting and not self._ended:
                    self._change.wait()
                if not self._waiting:
                    break
                item = self._waiting.popleft()
                self._change.notify_all()
            yield item
        if self._error is not None:
            raise self._error

    def close(self) -> None:
        """End both sides; the thread ends when its iterable gives the next item."""
        with self._change:
            self._ended = True
            self._waiting.clear()
            self._change.notify_all()

    def _fill(self, items: Iterable[T]) -> None:
        try:
            for item in items:
                with self._change:
                    while self._waits and len(self._waiting) == self._most and not self._ended:
                        self._change.wait()
                    if self._ended:
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
                self._ended = True
                self._change.notify_all()
