"""Run many pieces of work on many processes; each returns a result or a reason, even if its process dies."""

from __future__ import annotations

import math
import multiprocessing
import os
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import contextmanager, suppress
from typing import Any, NamedTuple

from kcal.child_processes import deaf_to_interrupts
from kcal.errors import FileError, InputError, KcalError


class Task(NamedTuple):
    """A function call for a worker; `tag` tells the caller which call it was."""

    tag: Any
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


class WorkerDiedError(KcalError):
    """The process of a piece of work ended: out of memory, over its time limit, or crashed."""


# Seconds after which the workers are looked after, and that a scheduler may be without any.
_LOOK, WORKERS_BACK = 5.0, 60.0
_GONE = "the Dask scheduler or its last worker is gone; start them and run the same command: finished work is kept"

# Called with a finished task and its result or exception; returns tasks that can now be done.
Done = Callable[[Task, Any], Iterable[Task]]


class Pool:
    """Processes on this machine, started again when one of them dies, or a Dask scheduler's workers.

    Args:
        workers: processes, if there is no scheduler.
        scheduler: address of a Dask scheduler, or None.

    Raises:
        InputError: a scheduler is given but `distributed` is not installed.
        FileError: the scheduler does not answer.
    """

    def __init__(self, workers: int, scheduler: str | None = None) -> None:
        self.workers = workers
        self._client: Any = None
        self._executor: Executor | None = None
        self._alone_since: float | None = None
        if scheduler is not None:
            self._client = _connect(scheduler)
            self.workers, self._counted_at = 1, -math.inf

    @property
    def ahead(self) -> int:
        """How many tasks to hand out at a time: enough to keep workers busy, few enough to hold in memory.

        Workers of a scheduler come and go, so they are counted again from time to time.
        """
        if self._client is not None and time.monotonic() - self._counted_at > _LOOK:
            self._counted_at = time.monotonic()
            with suppress(OSError, TimeoutError, CancelledError):  # `check` tells what is missing
                self.workers = max(1, sum(self._client.nthreads().values()))
        return 3 * self.workers

    def submit(self, task: Task) -> Future[Any]:
        """Hand out a task."""
        if self._executor is None:
            if self._client is not None:
                # Dask would answer a pure task from its memory of the same arguments, even if files have changed.
                self._executor = self._client.get_executor(pure=False)
            else:
                # Not forked: a fork copies the locks of OpenCV's and torch's threads, but not the threads.
                context = multiprocessing.get_context("spawn")
                self._executor = ProcessPoolExecutor(self.workers, mp_context=context, initializer=_begin)
        try:
            with deaf_to_interrupts():
                if self._client is not None:
                    return self._executor.submit(_in_one_thread, task.function, *task.arguments)
                return self._executor.submit(task.function, *task.arguments)
        except (RuntimeError, OSError, ValueError) as error:
            # What a closed Dask client raises; a broken pool of processes is the caller's to mend.
            if self._client is None:
                raise
            raise FileError(_GONE) from error

    def restart(self) -> None:
        """Forget the processes; the next task starts new ones."""
        if isinstance(self._executor, ProcessPoolExecutor):
            self._executor.shutdown(wait=False, cancel_futures=True)
        elif self._executor is not None:
            self._executor.shutdown(wait=False)
        self._executor = None

    def check(self) -> None:
        """Raise `FileError` if nobody is left to do the tasks: the scheduler, or all its workers, are gone.

        Processes on this machine tell so themselves. Workers have a minute to come back.
        """
        if self._client is None:
            return
        try:
            if self._client.status in ("closing", "closed"):
                raise FileError(_GONE)
            alive = self._client.status == "running" and bool(self._client.nthreads())
        except (OSError, TimeoutError, CancelledError):
            alive = False
        if alive:
            self._alone_since = None
        elif self._alone_since is None:
            self._alone_since = time.monotonic()
        elif time.monotonic() - self._alone_since > WORKERS_BACK:
            raise FileError(_GONE)

    def close(self) -> None:
        """Release all workers."""
        self.restart()
        if self._client is not None:
            # What happens while a connection ends that may be broken already does not matter.
            with suppress(Exception):
                self._client.close(timeout=5)


@contextmanager
def pool(workers: int, scheduler: str | None = None) -> Iterator[Pool]:
    """A `Pool` that is closed at the end, also after an interruption."""
    opened = Pool(workers, scheduler)
    try:
        yield opened
    finally:
        opened.close()


def run_tasks(tasks: Iterable[Task], done: Done, workers: Pool) -> None:
    """Do all tasks, and those that `done` adds; `done` is called in this process, once per task, in any order.

    A task whose worker dies is tried once more, alone; if its worker dies again it is given up with
    `WorkerDiedError`.
    """
    source = iter(tasks)
    added: deque[Task] = deque()
    pending: dict[Future[Any], Task] = {}
    casualties: list[Task] = []
    while True:
        while len(pending) < workers.ahead and not casualties:
            task = added.popleft() if added else next(source, None)
            if task is None:
                break
            try:
                pending[workers.submit(task)] = task
            except BrokenExecutor:
                casualties.append(task)
        if not pending and not casualties:
            return
        finished, _ = wait(pending, _LOOK, return_when=FIRST_COMPLETED) if pending else (set(), None)
        if pending and not finished:
            workers.check()
        for future in finished:
            task = pending.pop(future)
            outcome = _result_of(future)
            if isinstance(outcome, WorkerDiedError) and isinstance(future.exception(), BrokenExecutor):
                casualties.append(task)
            else:
                added.extend(done(task, outcome))
        if casualties and not pending:
            workers.restart()
            for task in casualties:
                outcome = _result_of(workers.submit(task))
                if isinstance(outcome, WorkerDiedError):
                    workers.restart()
                added.extend(done(task, outcome))
            casualties.clear()


def _result_of(future: Future[Any]) -> Any:
    """The result, or the exception instead of raising it.

    Raises:
        FileError: the task was given up because the scheduler is gone.
    """
    try:
        error = future.exception()
    except CancelledError:
        raise FileError(_GONE) from None
    if error is None:
        return future.result()
    if isinstance(error, BrokenExecutor) or type(error).__name__ == "KilledWorker":
        return WorkerDiedError("its process ended: out of memory, over the time limit (--time-limit), or crashed")
    return error


def _begin() -> None:
    """In a new process: leave Ctrl-C to the parent, end when the parent is gone, use one thread."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _one_thread()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _one_thread() -> None:
    """Use one thread in this process: there are as many processes as cores."""
    from kcal.corners.detect import limit_threads

    limit_threads(1)


def _in_one_thread(function: Callable[..., Any], *arguments: Any) -> Any:
    """A task on a worker of a scheduler, which may have been started a moment ago, after another one died."""
    _one_thread()
    return function(*arguments)


def _connect(address: str) -> Any:
    try:
        from distributed import Client
    except ImportError:
        raise InputError('--scheduler needs Dask: pip install "kcal[dask]"') from None
    try:
        return Client(address, timeout=15, set_as_default=False)
    except (OSError, ValueError) as error:
        raise FileError(f"{address}: no Dask scheduler answers here: {error}") from error
