"""Workers of a batch that are this process."""

from concurrent.futures import Future
from typing import Any

from kcal.calibrate.batch.results import Task


class Here:
    """A pool that works at once, and notes what it was given."""

    ahead = 2

    def __init__(self) -> None:
        self.tasks: list[Task] = []

    def submit(self, task: Task) -> Future[Any]:
        self.tasks.append(task)
        future: Future[Any] = Future()
        try:
            future.set_result(task.function(*task.arguments))
        except Exception as error:
            future.set_exception(error)
        return future

    @property
    def done(self) -> list[str]:
        """Names of functions."""
        return [task.function.__name__ for task in self.tasks]
