"""What all commands share: where to print, and a progress bar for long work."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

T = TypeVar("T")

# A table cut to fit the 80 columns of a pipe would lose names and digits.
_PIPE_WIDTH = 200


def _console(stderr: bool) -> Console:
    console = Console(stderr=stderr, soft_wrap=True, highlight=False)
    if not console.is_terminal:
        console.width = _PIPE_WIDTH
    return console


out, err = _console(stderr=False), _console(stderr=True)


def _progress() -> Progress:
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        console=err,
        transient=True,
        disable=not err.is_terminal,
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
            progress.update(task, advance=1, description=f"{description}: {escape(text)}")

        yield advance
