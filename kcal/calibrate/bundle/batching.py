"""Solve many calibrations together: alike minimizations of different cameras become one batch.

A calibration is a plain function that calls `minimize`. On its own, that is `kcal.solve.lm.minimize`. Under `together`
each calibration runs in a thread of its own, but only one thread runs at any time, in a fixed order: when a calibration
calls `minimize`, it waits and the next one runs. When all of them wait, alike requests are joined into one batch
(`BoardProblem.joined`), solved, and split again. A calibration that takes a way of its own (a flipped board, another
focal length) is served first, until it waits for the same as the others. Results equal those of single calls to
rounding, because every element of a batch has its own damping and its own reason for stopping.
"""

from __future__ import annotations

import itertools
import queue
import threading
from collections.abc import Callable, Hashable, Sequence
from typing import Any, Generic, TypeVar, cast

import torch

import kcal.solve.lm
from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.calibrate.bundle.compressed_problem import CompressedProblem, LensState
from kcal.errors import KcalError
from kcal.solve.lm import LMOptions
from kcal.solve.result import Result

T = TypeVar("T")
S = TypeVar("S", BoardState, LensState)
# Corners (elements x views x corners) in one batch: some 300 MB of normal equations.
_MOST_CORNERS = 400_000
# Calibrations that run at a time, each in a thread.
_MOST_THREADS = 256
_thread = threading.local()


def minimize(problem: BoardProblem | CompressedProblem, start: S, options: LMOptions) -> Result[S]:
    """Minimize a problem of one camera, in one batch with those of other cameras where `together` calls for it."""
    worker: _Worker[Any] | None = getattr(_thread, "worker", None)
    if worker is None:
        return kcal.solve.lm.minimize(cast(Any, problem), start, options)
    return cast(Result[S], worker.answer_to(_Request(problem, start, options)))


class _Request:
    """What a calibration waits for."""

    def __init__(self, problem: Any, start: Any, options: LMOptions) -> None:
        self.problem, self.start, self.options = problem, start, options
        # Requests for which this is equal can be answered together.
        self.alike: Hashable = (type(problem), problem.alike, options)
        self.elements, self.corner_slots = problem.elements, problem.corner_slots


class _Stopped(BaseException):
    """Ends a calibration whose result is no longer wanted."""


class _Worker(threading.Thread, Generic[T]):
    """A calibration in a thread that runs only while `resume` waits for it."""

    def __init__(self, function: Callable[[], T]) -> None:
        super().__init__(daemon=True)
        self._function = function
        self._answers: queue.SimpleQueue[Result[Any] | None] = queue.SimpleQueue()
        self._messages: queue.SimpleQueue[_Request | None] = queue.SimpleQueue()
        self._wanted = True
        # PyTorch keeps these per thread.
        self._grad, self._inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()
        self._torch_threads = torch.get_num_threads()
        self.outcome: T | BaseException

    def run(self) -> None:
        """Run the calibration; its result, or the exception that ended it, becomes `outcome`."""
        _thread.worker = self
        torch.set_num_threads(self._torch_threads)
        try:
            with torch.inference_mode(self._inference), torch.set_grad_enabled(self._grad):
                self.outcome = self._function()
        except BaseException as error:
            self.outcome = error
        self._messages.put(None)

    def answer_to(self, request: _Request) -> Result[Any]:
        """Called by the calibration: hand over a request and wait for its result."""
        if self._wanted:
            self._messages.put(request)
            answer = self._answers.get()
            if answer is not None:
                return answer
        raise _Stopped

    def resume(self, answer: Result[Any] | None) -> _Request | None:
        """Let the calibration run until its next request; None once it has ended."""
        if answer is None:
            self.start()
        else:
            self._answers.put(answer)
        return self._messages.get()

    def stop(self) -> None:
        """End the calibration, if it has not ended yet, and wait for the thread."""
        self._wanted = False
        self._answers.put(None)
        if self.ident is not None:
            self.join()


def together(
    calibrations: Sequence[Callable[[], T]], device: torch.device, finished: Callable[[int], object]
) -> list[T | KcalError]:
    """Run many calibrations.

    Args:
        calibrations: plain functions that call `minimize` of this module.
        device: where batches are minimized; everything else stays on the CPU.
        finished: called with the number of those that have ended.

    Returns:
        what each returns, or the `KcalError` that it raised. Any other exception ends all of them and is raised here.
    """
    outcomes: list[T | KcalError] = []
    ended = itertools.count(1)
    for begin in range(0, len(calibrations), _MOST_THREADS):
        some = calibrations[begin : begin + _MOST_THREADS]
        outcomes += _run([_Worker(one) for one in some], device, lambda: finished(next(ended)))
    return outcomes


def _run(workers: Sequence[_Worker[T]], device: torch.device, finished: Callable[[], object]) -> list[T | KcalError]:
    outcomes: dict[int, T | KcalError] = {}
    waiting: dict[int, _Request] = {}
    order: dict[Hashable, int] = {}

    def resume(i: int, answer: Result[Any] | None) -> None:
        waiting.pop(i, None)
        request = workers[i].resume(answer)
        if request is not None:
            waiting[i] = request
            return
        outcome = workers[i].outcome
        if isinstance(outcome, BaseException) and not isinstance(outcome, KcalError):
            raise outcome
        outcomes[i] = outcome
        finished()

    try:
        for i in range(len(workers)):
            resume(i, None)
        while waiting:
            groups: dict[Hashable, list[int]] = {}
            for i, request in waiting.items():
                groups.setdefault(request.alike, []).append(i)
            # What was requested first is an early step: a calibration that still waits for it is behind the others.
            group = groups[min(groups, key=lambda key: order.setdefault(key, len(order)))]
            for part in _portions(group, waiting):
                for i, answer in zip(part, _answers([waiting[i] for i in part], device), strict=True):
                    resume(i, answer)
    finally:
        for worker in workers:
            worker.stop()
    return [outcomes[i] for i in range(len(workers))]


def _portions(group: list[int], waiting: dict[int, _Request]) -> list[list[int]]:
    """A group in parts that limit memory, each with problems of nearly the same size."""
    parts: list[list[int]] = []
    count = 0
    for i in sorted(group, key=lambda i: (waiting[i].corner_slots, waiting[i].elements), reverse=True):
        count += waiting[i].elements
        # The first of a part is the largest; the others are padded to it.
        if not parts or count * waiting[parts[-1][0]].corner_slots > _MOST_CORNERS:
            parts.append([])
            count = waiting[i].elements
        parts[-1].append(i)
    return parts


def _answers(requests: list[_Request], device: torch.device) -> list[Result[Any]]:
    """Solve alike requests in one batch."""
    first = requests[0]
    if len(requests) == 1 and device.type == "cpu":
        return [kcal.solve.lm.minimize(first.problem, first.start, first.options)]
    problems = [request.problem for request in requests]
    joined, start = type(first.problem).joined(problems, [request.start for request in requests], device)
    answers: list[Result[Any]] = joined.split(kcal.solve.lm.minimize(joined, start, first.options), problems)
    return answers
