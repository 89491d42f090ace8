"""Many calibrations in one call: who runs when, what is solved in one batch, and how it ends."""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Callable
from typing import Any

import pytest
import torch
from calibrate_scenes import BOARD, camera, motions, pixels_of

import kcal.solve.lm
from kcal.calibrate.bundle import batching
from kcal.calibrate.bundle.batching import minimize, together
from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.errors import KcalError
from kcal.solve.lm import LMOptions
from kcal.solve.result import Result

CPU = torch.device("cpu")
OPTIONS = LMOptions(max_iterations=5)
POSES = motions(camera("pinhole"), 3, 1)
PIXELS = pixels_of(camera("pinhole"), POSES, noise=0.1)


def solve(*free: int, options: LMOptions = OPTIONS) -> Result[BoardState]:
    """A small minimization; alike ones have the same free parameters and options."""
    problem = BoardProblem(BOARD.points, PIXELS, camera("pinhole").model, free)
    return minimize(problem, BoardState.flat(camera("pinhole").params.detach(), *POSES), options)


def nothing(_: int) -> None:
    return None


@pytest.fixture
def batches(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """The batch of every problem that is solved."""
    found: list[tuple[int, ...]] = []
    real = kcal.solve.lm.minimize

    def spy(problem: Any, *given: Any) -> Any:
        found.append(problem.batch)
        return real(problem, *given)

    monkeypatch.setattr(kcal.solve.lm, "minimize", spy)
    return found


@pytest.fixture(autouse=True)
def no_thread_is_left() -> Any:
    before = set(threading.enumerate())
    yield
    assert set(threading.enumerate()) <= before


def test_alike_requests_share_a_batch_and_others_wait(batches: list[tuple[int, ...]]) -> None:
    """Who asks for something else is served when the others have ended; results are in the order of the calls."""

    def plain(free: int) -> float:
        solve(0, 1)
        return float(solve(free).cost)

    found = together([lambda free=free: plain(free) for free in (2, 3, 2)], CPU, nothing)
    assert batches == [(3,), (2,), ()]
    batches.clear()
    assert found == pytest.approx([plain(2), plain(3), plain(2)], rel=1e-12)
    assert batches == [()] * 6


def test_who_is_behind_is_served_first(batches: list[tuple[int, ...]]) -> None:
    def way(detours: int) -> None:
        for _ in range(detours):
            solve(0)
        solve(0, 1)

    together([lambda n=n: way(n) for n in (0, 2, 0)], CPU, nothing)
    # Requests by [0, 1] came first, so that they are answered first: the second camera goes on alone.
    assert batches == [(2,), (), (), ()]


def test_one_runs_at_a_time_and_always_in_the_same_order() -> None:
    trace: list[tuple[int, int]] = []
    running = threading.Lock()

    def work(number: int) -> None:
        for step in range(3):
            assert running.acquire(blocking=False)
            trace.append((step, number))
            running.release()
            solve(0, step + 1)

    for _ in range(2):
        trace.clear()
        together([lambda i=i: work(i) for i in range(4)], CPU, nothing)
        assert trace == [(step, number) for step in range(3) for number in range(4)]


def test_more_calibrations_than_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batching, "_MOST_THREADS", 2)
    ended: list[int] = []
    assert together([lambda i=i: (solve(0), i)[1] for i in range(5)], CPU, ended.append) == list(range(5))
    assert ended == [1, 2, 3, 4, 5]


def failing(error: BaseException) -> Callable[[], None]:
    def calibration() -> None:
        solve(0)
        raise error

    return calibration


def test_an_error_of_one_is_its_outcome() -> None:
    error = KcalError("this one")
    assert together([failing(error), lambda: int(solve(0).status)], CPU, nothing)[0] is error


@pytest.mark.parametrize("error", [ValueError("a defect"), KeyboardInterrupt()])
def test_any_other_exception_ends_all(error: BaseException) -> None:
    closed: list[str] = []

    def waiting() -> None:
        try:
            solve(0)
            solve(1)
        finally:
            closed.append("closed")

    with pytest.raises(type(error)) as caught:
        together([waiting, failing(error), waiting], CPU, nothing)
    assert caught.value is error
    assert closed == ["closed", "closed"]


def test_an_interrupt_while_a_calibration_runs_ends_all() -> None:
    """Signals reach the main thread only, which waits then."""
    went_on: list[int] = []

    def interrupted() -> None:
        solve(0)
        _thread.interrupt_main()
        solve(0)
        went_on.append(1)

    # A shell ignores Ctrl+C in what it starts in the background.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            together([interrupted, lambda: solve(0)], CPU, nothing)
    finally:
        signal.signal(signal.SIGINT, before)
    assert not went_on


def test_a_caller_that_stops_leaves_nothing_behind() -> None:
    def enough(_: int) -> None:
        raise RuntimeError("enough")

    with pytest.raises(RuntimeError, match="enough"):
        together([lambda: solve(0), lambda: solve(0), lambda: solve(1)], CPU, enough)


def test_settings_of_torch_are_those_of_the_caller() -> None:
    def settings() -> tuple[bool, bool, int]:
        return torch.is_grad_enabled(), torch.is_inference_mode_enabled(), torch.get_num_threads()

    before = torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            assert together([settings], CPU, nothing) == [(True, False, threads)]
            with torch.no_grad():
                assert together([settings], CPU, nothing) == [(False, False, threads)]
            with torch.inference_mode():
                assert together([settings], CPU, nothing) == [(False, True, threads)]
    finally:
        torch.set_num_threads(before)


def test_calls_may_be_nested(batches: list[tuple[int, ...]]) -> None:
    def outer() -> list[object]:
        return [float(cost) for cost in together([lambda: solve(0).cost, lambda: solve(0).cost], CPU, nothing)]

    first, second = together([outer, outer], CPU, nothing)
    assert first == second
    assert batches == [(2,), (2,)]
