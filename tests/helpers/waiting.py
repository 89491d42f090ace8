"""Wait for what happens in another thread, process or browser; a deadline only ends a test that has failed."""

import contextlib
import faulthandler
import os
import signal
import threading
import time
from collections.abc import Callable, Generator
from pathlib import Path

import pytest

PATIENCE = 300.0  # seconds: the slowest machine is faster


def wait_for(true: Callable[[], bool], pause: Callable[[float], object] = time.sleep) -> None:
    """Wait until something is true.

    Args:
        true: looked at again and again.
        pause: what is done for some seconds between two looks.
    """
    until = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < until, "waited in vain"
        pause(0.02)


class Waiting(Exception):  # noqa: N818  what a test does, in the report
    """Nothing worked in a test for too long."""


class Watch:
    """Plugin of pytest that ends a test in which neither this process nor any below it works for a minute (Linux).

    Time that processes compute is what counts, not the clock: on a busy machine a test that works is slow, but what
    waits for a lock, a thread or a child that is not there computes nothing at all.

    Args:
        limit: seconds; the environment's KCAL_WAIT, otherwise a minute.
    """

    SHARE = 0.02  # of the clock: who computes less waits. Idle servers take half of it, work on a busy machine more.

    def __init__(self, limit: float) -> None:
        self.limit, self.test = limit, ""
        signal.signal(signal.SIGUSR2, self._end)
        threading.Thread(target=self._look, daemon=True).start()

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None, object, object]:
        """Name what runs; pytest reports an error that is raised meanwhile."""
        self.test = item.nodeid
        try:
            return (yield)
        finally:
            self.test = ""

    pytest_runtest_setup = pytest_runtest_teardown = pytest_runtest_call

    def _look(self) -> None:
        test, since, before = "", time.monotonic(), 0.0
        while True:
            time.sleep(self.limit / 10)
            now, computed = time.monotonic(), computed_below(os.getpid())
            if not self.test or self.test != test or abs(computed - before) > self.SHARE * (now - since):
                test, since, before = self.test, now, computed
            elif now - since > 1.5 * self.limit:  # inside a library, which hears no signal
                os._exit(70)
            elif now - since > self.limit:
                signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGUSR2)

    def _end(self, *_: object) -> None:
        if self.test:
            faulthandler.dump_traceback()
            raise Waiting(f"{self.test}: nothing has worked for {self.limit:g} s")


def computed_below(root: int) -> float:
    """Seconds that a process and those below it computed, also those that have ended; without this thread's own."""
    ticks, below = 0, [root]
    for process in below:
        with contextlib.suppress(OSError):
            fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
            ticks += sum(map(int, fields[11:15]))
            for children in Path(f"/proc/{process}/task").glob("*/children"):
                below += map(int, children.read_text().split())
    return ticks / os.sysconf("SC_CLK_TCK") - time.thread_time()
