"""What all commands share: where to print, and a progress bar for long work."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

T = TypeVar("T")

out = Console(soft_wrap=True, highlight=False)
err = Console(stderr=True, soft_wrap=True, highlight=False)


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=err,
        transient=True,
    )


def track(items: Iterable[T], description: str, total: int) -> Iterator[T]:
    """Iterate with a progress bar on the error stream, gone when done."""
    with _progress() as progress:
        yield from progress.track(items, description=description, total=total)


@contextmanager
def steps(description: str, total: int) -> Iterator[Callable[[str], None]]:
    """A bar for work that reports itself: call the value with a text after each step."""
    with _progress() as progress:
        task = progress.add_task(description, total=total)

        def advance(text: str) -> None:
            progress.update(task, advance=1, description=f"{description}: {text}")

        yield advance
