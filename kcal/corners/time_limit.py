"""Limit the CPU time of calls into C++ libraries that cannot be interrupted by a signal."""

from __future__ import annotations

import ctypes
import multiprocessing
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from kcal.errors import InputError, KcalError
from kcal.threads import OVER_LIMIT, UNSTOPPABLE, deaf_to_interrupts, work_limit

T = TypeVar("T")


class TookTooLongError(KcalError):
    """A call exceeded its time limit, or its process died."""


class Limited(AbstractContextManager["Limited"]):
    """Make calls one after the other, each with a limit of the time that processors work on it.

    Other work on the machine does not count. The first calls run in a thread of this process, at no cost. A thread that
    exceeds the limit, or whose caller is interrupted, ends when its C++ library returns. Later calls run in a separate
    process, which can be killed.

    Args:
        seconds: the limit of each call, in seconds of one processor; None for no limit.

    Raises:
        InputError: a limit that is not positive.

    Example:
        >>> with Limited(60.0) as limited:
        ...     limited(divmod, 7, 2)
        (3, 1)
    """

    def __init__(self, seconds: float | None) -> None:
        if seconds is not None and not seconds > 0:
            raise InputError(f"time limit {seconds}: a positive number of seconds is needed")
        self.seconds = seconds
        self._processes = False
        self._process: multiprocessing.process.BaseProcess | None = None
        self._pipe: Connection | None = None

    def __exit__(self, *_: object) -> None:
        self.close()

    def __call__(self, function: Callable[..., T], *arguments: Any) -> T:
        """The function's result. The function and its arguments must be picklable.

        Raises:
            TookTooLongError: the limit was exceeded, or the process died.
            Exception: what the function raised.
        """
        if self.seconds is None:
            return function(*arguments)
        outcome = self._in_process(function, arguments) if self._processes else self._in_thread(function, arguments)
        if isinstance(outcome, BaseException):
            raise outcome
        result: T = outcome
        return result

    def close(self) -> None:
        """End the process, if there is one."""
        if self._process is not None:
            self._process.kill()
            self._process.join()
        if self._pipe is not None:
            self._pipe.close()
        self._process = self._pipe = None

    def _in_thread(self, function: Callable[..., T], arguments: tuple[Any, ...]) -> Any:
        assert self.seconds is not None
        outcome: list[Any] = []

        def run() -> None:
            with suppress(SystemExit):
                outcome.append(_result_or_error(function, arguments))

        # No daemon: Python aborts if it ends while such a thread is in a C++ library.
        thread = threading.Thread(target=run, name=UNSTOPPABLE)
        thread.start()
        try:
            end = time.process_time() + self.seconds
            while thread.is_alive() and (left := end - time.process_time()) > 0:
                thread.join(max(left, 0.01))
        finally:
            if thread.is_alive():
                self._processes = True
                identity = ctypes.c_ulong(thread.ident or 0)
                ctypes.pythonapi.PyThreadState_SetAsyncExc(identity, ctypes.py_object(SystemExit))
        return outcome[0] if outcome else self._too_long()

    def _in_process(self, function: Callable[..., T], arguments: tuple[Any, ...]) -> Any:
        if self._pipe is None:
            # Spawned: a fork would copy the threads of OpenCV and torch in an undefined state.
            context = multiprocessing.get_context("spawn")
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
            with deaf_to_interrupts():
                self._process.start()
            theirs.close()
        assert self._process is not None
        try:
            self._pipe.send((self.seconds, function, arguments))
            return self._pipe.recv()
        except (EOFError, OSError):
            self._process.join()
            too_long = self._process.exitcode == OVER_LIMIT
            self.close()
        if too_long:
            return self._too_long()
        return TookTooLongError("the process that searched this image died (out of memory, or a crash); leave it out")

    def _too_long(self) -> TookTooLongError:
        return TookTooLongError(
            f"stopped at the time limit of {self.seconds:g} s of CPU time (--time-limit); leave the image out, "
            "or allow more time"
        )


def _serve(pipe: Connection) -> None:
    while True:
        try:
            seconds, function, arguments = pipe.recv()
        except EOFError:
            return
        with work_limit(seconds):
            outcome = _result_or_error(function, arguments)
        pipe.send(outcome)


def _result_or_error(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    try:
        return function(*arguments)
    except Exception as error:
        return error
