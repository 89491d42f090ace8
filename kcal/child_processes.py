"""Start processes that leave Ctrl-C to the one that started them, and end those that work for too long."""

from __future__ import annotations

import faulthandler
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker

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
    """End this process if it takes more processor time meanwhile (on Windows, if more time passes).

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
