"""Limit the time of calls into C++ libraries that cannot be interrupted by a signal."""

from __future__ import annotations

import multiprocessing
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from kcal.child_processes import deaf_to_interrupts
from kcal.errors import InputError, KcalError

T = TypeVar("T")


class TookTooLongError(KcalError):
    """A call exceeded its time limit, or its process died."""


class Limited:
    """Make calls one after the other, each with a time limit.

    The first calls run in a thread of this process, at no cost. A thread that exceeds the limit cannot be stopped. It
    is left behind, and all later calls run in a separate process, which can be killed. So at most one call goes on
    until this process ends.

    Args:
        seconds: the limit of each call; None for no limit.

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

    def __enter__(self) -> Limited:
        return self

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
        outcome: list[Any] = []
        thread = threading.Thread(target=lambda: outcome.append(_result_or_error(function, arguments)), daemon=True)
        thread.start()
        thread.join(self.seconds)
        if outcome:
            return outcome[0]
        self._processes = True
        return self._too_long()

    def _in_process(self, function: Callable[..., T], arguments: tuple[Any, ...]) -> Any:
        if self._pipe is None:
            # Spawned: a fork would copy the threads of OpenCV and torch in an undefined state.
            context = multiprocessing.get_context("spawn")
            self._pipe, theirs = context.Pipe()
            self._process = context.Process(target=_serve, args=(theirs,), daemon=True)
            with deaf_to_interrupts():
                self._process.start()
            theirs.close()
        try:
            self._pipe.send((function, arguments))
            self._pipe.recv()  # the process is there and has imported what it needs
            if self._pipe.poll(self.seconds):
                return self._pipe.recv()
        except (EOFError, OSError):
            self.close()
            return TookTooLongError(
                "the process that searched this image died (out of memory, or a crash); leave it out"
            )
        self.close()
        return self._too_long()

    def _too_long(self) -> TookTooLongError:
        return TookTooLongError(
            f"stopped at the time limit of {self.seconds:g} s (--time-limit); leave the image out, or allow more time"
        )


def _serve(pipe: Connection) -> None:
    while True:
        try:
            function, arguments = pipe.recv()
        except EOFError:
            return
        pipe.send(None)
        pipe.send(_result_or_error(function, arguments))


def _result_or_error(function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    try:
        return function(*arguments)
    except Exception as error:
        return error
