"""How pieces of work are handed out, tried again and given up; with workers that are none."""

from __future__ import annotations

from concurrent.futures import BrokenExecutor, Future
from typing import Any

import cv2
import pytest
import torch

from kcal.calibrate.batch import results as module
from kcal.calibrate.batch.results import WORKERS_BACK, Pool, Task, WorkerDiedError, pool, run_tasks
from kcal.errors import FileError


class Crew:
    """Workers whose process dies at the tasks named in `deadly`, as often as stated; all that wait die with it."""

    def __init__(self, ahead: int, deadly: dict[int, int] | None = None) -> None:
        self.ahead, self.deadly = ahead, deadly or {}
        self.waiting: list[tuple[Future[Any], Task]] = []
        self.most = self.restarts = 0
        self.broken = False
        self.tried: list[int] = []

    def submit(self, task: Task) -> Future[Any]:
        if self.broken:
            raise BrokenExecutor
        self.tried.append(task.tag)
        future: Future[Any] = Future()
        self.waiting.append((future, task))
        self.most = max(self.most, len(self.waiting))
        if len(self.waiting) == self.ahead or self.restarts or task.tag in self.deadly:
            self.work()
        return future

    def work(self) -> None:
        for future, task in self.waiting:
            if self.deadly.get(task.tag, 0) > 0:
                self.deadly[task.tag] -= 1
                self.broken = True
            if self.broken:
                future.set_exception(BrokenExecutor())
                continue
            try:
                future.set_result(task.function(*task.arguments))
            except Exception as error:
                future.set_exception(error)
        self.waiting.clear()

    def restart(self) -> None:
        self.restarts += 1
        self.broken = False

    def check(self) -> None:
        self.work()


@pytest.fixture(autouse=True)
def _quickly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_LOOK", 0.01)


def outcomes(crew: Crew, count: int, more: int = 0) -> dict[int, Any]:
    found: dict[int, Any] = {}

    def done(task: Task, outcome: Any) -> list[Task]:
        assert task.tag not in found
        found[task.tag] = outcome
        return [Task(100 + task.tag, abs, (-task.tag,))] if task.tag < more else []

    run_tasks((Task(i, divmod, (i, 3)) for i in range(count)), done, crew)  # type: ignore[arg-type]
    return found


def test_all_is_done_and_few_tasks_wait() -> None:
    crew = Crew(3)
    assert outcomes(crew, 10, more=4) == {**{i: divmod(i, 3) for i in range(10)}, **{100 + i: i for i in range(4)}}
    assert crew.most == 3
    # What was added comes before what is left.
    assert crew.tried.index(100) < crew.tried.index(9)
    assert outcomes(Crew(3), 0) == {}


def test_an_error_is_an_outcome() -> None:
    found: list[Any] = []
    run_tasks([Task(0, divmod, (1, 0))], lambda task, outcome: found.append(outcome) or [], Crew(1))  # type: ignore[arg-type, func-returns-value]
    assert isinstance(found[0], ZeroDivisionError)


def test_whose_worker_dies_is_tried_once_more_alone() -> None:
    crew = Crew(3, {1: 1})
    assert outcomes(crew, 5) == {i: divmod(i, 3) for i in range(5)}
    assert crew.restarts == 1
    assert crew.tried.count(1) == 2
    crew = Crew(3, {1: 2})
    found = outcomes(crew, 5)
    assert isinstance(found.pop(1), WorkerDiedError)
    assert found == {i: divmod(i, 3) for i in (0, 2, 3, 4)}
    # Once for all, and once more because it died alone, too.
    assert crew.restarts == 2
    assert crew.tried.count(1) == 2


class KilledWorker(Exception):  # noqa: N818
    """What Dask says of a task that ended several workers."""


def test_a_task_that_dask_gave_up_is_not_tried_again() -> None:
    """Dask tried several times itself; the others go on."""

    def killed(tag: int) -> int:
        if tag == 1:
            raise KilledWorker
        return tag

    crew, found = Crew(2), {}

    def done(task: Task, outcome: Any) -> list[Task]:
        found[task.tag] = outcome
        return []

    run_tasks((Task(i, killed, (i,)) for i in range(4)), done, crew)  # type: ignore[arg-type]
    assert isinstance(found.pop(1), WorkerDiedError)
    assert found == {0: 0, 2: 2, 3: 3}
    assert crew.restarts == 0
    assert crew.tried.count(1) == 1


def test_a_pool_forgets_its_workers(client: Client) -> None:
    crew = Pool(2, "tcp://x")
    crew.submit(Task(0, abs, (-4,)))
    first = crew._executor
    assert first is client
    crew.submit(Task(0, abs, (-4,)))
    assert crew._executor is first
    crew.restart()
    assert client.shut == 1
    assert crew._executor is None
    crew.restart()
    assert client.shut == 1


class Client:
    """A Dask client that is as told."""

    def __init__(self) -> None:
        self.status, self.threads, self.closed, self.shut = "running", {"a": 3, "b": 2}, 0.0, 0

    def nthreads(self) -> dict[str, int]:
        if self.threads is None:
            raise TimeoutError
        return self.threads

    def get_executor(self, pure: bool) -> Client:
        assert not pure
        return self

    def submit(self, function: Any, *arguments: Any) -> Future[Any]:
        if self.status == "closed":
            raise RuntimeError("closed")
        future: Future[Any] = Future()
        future.set_result(function(*arguments))
        return future

    def shutdown(self, wait: bool) -> None:
        assert not wait
        self.shut += 1

    def close(self, timeout: float) -> None:
        self.closed = timeout
        raise OSError("it is gone already")


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> Client:
    made = Client()
    monkeypatch.setattr(module, "_connect", lambda address: made)
    return made


def test_a_scheduler_counts_its_threads(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    with pool(7, "tcp://x") as crew:
        assert crew.ahead == 15
        client.threads = {"a": 1, "b": 1, "c": 1}
        now[0] += 0.005
        assert crew.ahead == 15  # not asked every time
        now[0] += 0.01
        assert crew.ahead == 9
        client.threads = None
        now[0] += 0.02
        assert crew.ahead == 9  # as it was
        client.threads = {"a": 3}
        assert crew.submit(Task(0, abs, (-4,))).result() == 4
        client.status = "closed"
        with pytest.raises(FileError, match="the Dask scheduler or its last worker is gone"):
            crew.submit(Task(0, abs, (-4,)))
    assert client.closed == 5
    client.threads = {}
    assert Pool(7, "tcp://x").ahead == 3
    assert Pool(7).ahead == 21


def test_each_task_of_a_scheduler_has_one_thread(client: Client) -> None:
    """Also on a worker that was started after the connection."""
    before = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(2)
    cv2.setNumThreads(2)
    try:
        crew = Pool(1, "tcp://x")
        assert crew.submit(Task(0, lambda: (torch.get_num_threads(), cv2.getNumThreads()), ())).result() == (1, 1)
    finally:
        torch.set_num_threads(before[0])
        cv2.setNumThreads(before[1])


def test_workers_have_a_minute_to_come_back(client: Client, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    crew = Pool(1, "tcp://x")
    for threads in ({}, None):
        for status in ("running", "connecting"):
            client.status, client.threads = status, threads  # type: ignore[assignment]
            crew.check()
            now[0] += WORKERS_BACK
            crew.check()
            client.status, client.threads = "running", {"a": 1}
            crew.check()  # they came back: the minute begins again
            client.threads = threads  # type: ignore[assignment]
            crew.check()
            now[0] += WORKERS_BACK
            crew.check()
            now[0] += 1.0
            with pytest.raises(FileError, match="finished work is kept"):
                crew.check()
            client.threads = {"a": 1}
            crew.check()
    for status in ("closing", "closed"):
        client.status = status
        with pytest.raises(FileError, match="finished work is kept"):
            crew.check()
    Pool(1).check()


def test_what_a_lost_scheduler_leaves_is_an_error() -> None:
    cancelled: Future[Any] = Future()
    cancelled.cancel()
    with pytest.raises(FileError, match="the Dask scheduler"):
        module._result_of(cancelled)
    killed: Future[Any] = Future()
    killed.set_exception(KilledWorker())
    assert isinstance(module._result_of(killed), WorkerDiedError)
