"""Many calibrations at once: each tells what it must have minimized next, and those that ask alike are answered by one.

A calibration is written once, for one camera, as a generator: it yields what is to be minimized and is sent the result.
`alone` answers one such generator. `together` answers many: whatever its members wait for is joined into batches, one
element for each start of each camera, views padded and masked. A camera that takes a way of its own (a flipped board,
another focal length) is served first, until it waits for the same as the others. The answers are those of `alone`, to
rounding, because every element of a batch has its own damping and its own reason for stopping (`kcal.solve.lm`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Hashable, Sequence
from typing import TypeVar

import torch

from kcal.calibrate.bundle.board_problem import BoardProblem
from kcal.calibrate.bundle.compressed_problem import CompressedProblem
from kcal.calibrate.bundle.padding import join_boards, join_compressed, split_boards, split_compressed
from kcal.errors import KcalError
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import Result, State

T = TypeVar("T")
# Places for corners (elements x views x corners) in one batch: some 300 MB of normal equations.
_MOST_CORNERS = 400_000


@dataclasses.dataclass(frozen=True)
class Solve:
    """What a calibration waits for."""

    problem: BoardProblem | CompressedProblem
    start: State
    options: LMOptions

    @property
    def alike(self) -> Hashable:
        """Those that agree in this can be answered together."""
        return self.problem.alike, self.options


Steps = Generator[Solve, Result, T]


def alone(steps: Steps[T]) -> T:
    """Answer one calibration."""
    try:
        ask = next(steps)
        while True:
            ask = steps.send(minimize(ask.problem, ask.start, ask.options))
    except StopIteration as end:
        value: T = end.value
        return value


def together(
    calibrations: Sequence[Steps[T]], device: torch.device, finished: Callable[[int], None]
) -> list[T | KcalError]:
    """Answer many calibrations.

    Args:
        calibrations: not yet begun.
        device: where batches are minimized; everything else stays on the CPU.
        finished: told how many have come to their end.

    Returns:
        what each returns, or the error that it raised.
    """
    outcomes: dict[int, T | KcalError] = {}
    waiting: dict[int, Solve] = {}
    order: dict[Hashable, int] = {}

    def advance(i: int, result: Result | None) -> None:
        waiting.pop(i, None)
        try:
            waiting[i] = next(calibrations[i]) if result is None else calibrations[i].send(result)
            return
        except StopIteration as end:
            outcomes[i] = end.value
        except KcalError as error:
            outcomes[i] = error
        finished(len(outcomes))

    for i in range(len(calibrations)):
        advance(i, None)
    while waiting:
        groups: dict[Hashable, list[int]] = {}
        for i, ask in waiting.items():
            groups.setdefault(ask.alike, []).append(i)
        # What was asked for first is an early step: who still waits for it lags behind the others.
        group = groups[min(groups, key=lambda key: order.setdefault(key, len(order)))]
        for part in _portions(group, waiting):
            for i, result in zip(part, _answer([waiting[i] for i in part], device), strict=True):
                advance(i, result)
    return [outcomes[i] for i in range(len(calibrations))]


def _portions(group: list[int], waiting: dict[int, Solve]) -> list[list[int]]:
    """A group in parts that keep memory bounded, each of problems of nearly the same size."""
    sizes = {i: (waiting[i].problem.corner_slots, waiting[i].problem.elements) for i in group}
    parts: list[list[int]] = []
    count = 0
    for i in sorted(group, key=lambda i: sizes[i], reverse=True):
        count += sizes[i][1]
        # The first of a part is the largest; the others are padded to it.
        if not parts or count * sizes[parts[-1][0]][0] > _MOST_CORNERS:
            parts.append([])
            count = sizes[i][1]
        parts[-1].append(i)
    return parts


def _answer(asks: list[Solve], device: torch.device) -> list[Result]:
    if len(asks) == 1 and device.type == "cpu":
        return [minimize(asks[0].problem, asks[0].start, asks[0].options)]
    problems, starts = [ask.problem for ask in asks], [ask.start for ask in asks]
    boards = [problem for problem in problems if isinstance(problem, BoardProblem)]
    if boards:
        joined, start = join_boards(boards, starts, device)
        return split_boards(minimize(joined, start, asks[0].options), boards)
    reduced = [problem for problem in problems if isinstance(problem, CompressedProblem)]
    search, start = join_compressed(reduced, starts, device)
    return split_compressed(minimize(search, start, asks[0].options), reduced)
