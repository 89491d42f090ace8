"""Ctrl-C: whether it was heard, also where a library makes another error of it."""

from __future__ import annotations

import _thread
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

_heard = False


def listen() -> None:
    """Remember interruptions from now on, unless they are ignored as in the background of a shell."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _hear)
    sys.unraisablehook = _unraisable


@contextmanager
def only_interruptions() -> Iterator[None]:
    """Any error after an interruption is one: extension modules that load meanwhile end in others."""
    try:
        yield
    except Exception as error:
        if _heard and not hasattr(error, "exit_code"):  # of a command that has ended in its own words
            raise KeyboardInterrupt from error
        raise


def _hear(*_: object) -> None:
    global _heard
    _heard = True
    raise KeyboardInterrupt


def _unraisable(what: sys.UnraisableHookArgs) -> None:
    """Interrupt again, a moment later, where Python drops an interruption: in callbacks of its import system."""
    if issubclass(what.exc_type, KeyboardInterrupt):
        threading.Timer(0.01, _thread.interrupt_main).start()
    else:
        sys.__unraisablehook__(what)
