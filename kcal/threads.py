"""Bound the threads of torch, BLAS and OpenCV in this process, and hand items from one thread to another."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from typing import Any, Generic, TypeVar

from threadpoolctl import ThreadpoolController

# Bound the threads of torch, BLAS and OpenCV in this process, and give the caller's own settings back.

# What brings libraries with threads. To look for these takes milliseconds: only after one of them was imported.
_BRING = ("torch", "numpy", "scipy.linalg", "cv2")
_PROCESS = os.getpid()


class _OpenCV:
    """The threads of OpenCV, as threadpoolctl shows those of others."""

    @property
    def num_threads(self) -> int:
        return int(sys.modules["cv2"].getNumThreads())

    def set_num_threads(self, count: int) -> None:
        sys.modules["cv2"].setNumThreads(count)


class _Bounds:
    """What bounds libraries in a process.

    OpenMP, and with it torch and MKL, has a number of threads for each thread that calls it. OpenBLAS and OpenCV have
    one for the process: the first block that bounds it keeps the number, the last one gives it back.
    """

    def __init__(self) -> None:
        self.process, self.lock, self.loaded = os.getpid(), threading.Lock(), [False] * len(_BRING)
        self.own: list[Any] = []
        self.shared: list[Any] = []
        self.inside: list[int] = []  # blocks that bound it, of each shared library
        self.before: list[int] = []

    def look(self) -> None:
        """Find libraries that were loaded since the last look."""
        if self.loaded == (now := loaded()):
            return
        known = {library.filepath for library in (*self.own, *self.shared) if not isinstance(library, _OpenCV)}
        found = [one for one in ThreadpoolController().lib_controllers if one.filepath not in known]
        self.own += [library for library in found if library.user_api == "openmp"]
        more = [library for library in found if library.user_api == "blas"]
        # In a process that was forked, OpenCV would wait for threads that are not there.
        forked = os.getpid() != _PROCESS or multiprocessing.parent_process() is not None
        if "cv2" in sys.modules and not self.loaded[-1] and not forked:
            more.append(_OpenCV())
        self.shared, self.loaded = self.shared + more, now
        self.inside, self.before = self.inside + len(more) * [0], self.before + len(more) * [1]

    def bound(self, count: int) -> Callable[[], None]:
        """Set the number of threads; what gives the numbers of before back."""
        if "torch" in sys.modules:  # sets its number for this thread when it is first asked
            sys.modules["torch"].get_num_threads()
        with self.lock:
            self.look()
            own = [(library, library.num_threads) for library in self.own]
            for library in self.own:
                set_threads(library, count)
            taken = range(len(self.shared))
            for k in taken:
                if not self.inside[k]:
                    self.before[k] = self.shared[k].num_threads
                self.inside[k] += 1
                set_threads(self.shared[k], count)

        def give_back() -> None:
            with self.lock:
                for library, number in own:
                    set_threads(library, number)
                for k in taken:
                    self.inside[k] -= 1
                    if not self.inside[k]:
                        set_threads(self.shared[k], self.before[k])

        return give_back


_bounds = _Bounds()
_here = threading.local()


def set_threads(library: Any, count: int) -> None:
    """Set the number of a library, from whichever thread.

    From version 3.8 on, threadpoolctl lets the first thread alone set that of OpenBLAS, and others silently do nothing.
    """
    release = getattr(library, "clear_controlling_thread", lambda **_: None)
    release(force=True)
    library.set_num_threads(count)
    release(force=True)


def loaded() -> list[bool]:
    """Which of them were imported."""
    return [name in sys.modules for name in _BRING]


@contextmanager
def one_thread() -> Iterator[None]:
    """Use one thread while many small systems are solved.

    With threads, systems of some hundred unknowns take longer, because threads wait for each other, and by far longer
    where something else runs on the machine. Blocks may be nested, and run in several threads at a time. What was set
    before for torch, OpenMP, BLAS and OpenCV comes back at the end, also after an error.

    Example:
        >>> import torch
        >>> torch.set_num_threads(2)
        >>> with one_thread():
        ...     torch.get_num_threads()
        1
        >>> torch.get_num_threads()
        2
    """
    global _bounds
    if _bounds.process != os.getpid():  # forked, maybe while another thread had the lock
        _bounds = _Bounds()
    outer = getattr(_here, "loaded", None)
    if outer == (now := loaded()):
        yield
        return
    give_back, _here.loaded = _bounds.bound(1), now
    try:
        yield
    finally:
        _here.loaded = outer
        give_back()


# Decorates a function whose calls use `one_thread`.
in_one_thread = one_thread()


# `Handover`: items from a thread that makes them to the one that uses them, in bounded memory.

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


# Start processes that leave Ctrl-C to the one that started them, and end those that work for too long.

# Name of threads for whose end a command does not wait: a C++ library cannot be stopped.
UNSTOPPABLE = "unstoppable"
# Exit code of a process that `work_limit` ended.
OVER_LIMIT = -signal.SIGPROF if hasattr(signal, "SIGPROF") else 1


@contextmanager
def deaf_to_interrupts() -> Iterator[None]:
    """Processes that are started meanwhile do not hear Ctrl-C, which a terminal sends to all processes of a command.

    From their first instruction on: what they import would otherwise end in a traceback each. Whoever starts them ends
    them. An interruption of this process comes when the block ends.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    # Started with the first process, it would unblock the signal.
    resource_tracker.ensure_running()
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def work_limit(seconds: float) -> Iterator[None]:
    """End this process if it takes more CPU time meanwhile (on Windows, if more time passes).

    A Python signal handler would wait for a C++ library to return.
    """
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_PROF, seconds)
        try:
            yield
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0.0)
        return
    with open(os.devnull, "w") as nowhere:
        faulthandler.dump_traceback_later(seconds, exit=True, file=nowhere)
        try:
            yield
        finally:
            faulthandler.cancel_dump_traceback_later()
