"""Printing for all commands: output, warnings, tables, JSON, progress, and commands to paste at the end of refusals."""

from __future__ import annotations

import gc
import re
import shlex
import signal
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TextColumn
from rich.text import Text

import kcal
from kcal.errors import DegenerateError, InputError, KcalError
from kcal.files import replaced, write_atomic
from kcal.table import Table
from kcal.texts import one_line, visible

_T = TypeVar("_T")

# Printing for all commands: output, warnings, tables, JSON for programs, and progress bars for long work.


class _PlainConsole(Console):
    """A console on which a text of another origin is shown: escape sequences in it do not reach the terminal."""

    def render_str(self, text: str, **options: Any) -> Text:
        """Called by `print` for every text."""
        return super().render_str(visible(text), **options)

    def print(self, *texts: Any, **options: Any) -> None:
        """Print, above the line that shows the progress if there is one."""
        shown = self is out and _line.live.is_started  # that of the error stream does so by itself
        if shown:
            _line.stop()
        super().print(*texts, **options)
        # A pager that reads the output has the terminal from now on.
        if shown and self.is_terminal:
            _line.start()


out = _PlainConsole(soft_wrap=True, highlight=False, emoji=False, markup=False)
err = _PlainConsole(stderr=True, soft_wrap=True, highlight=False, emoji=False, markup=False)


def print_styled(text: str, part: str, style: str = "bold", *, to: Console = out) -> None:
    """Print a text; what matches the regular expression `part` is in another style."""
    shown = Text(visible(text))
    shown.highlight_regex(part, style)
    to.print(shown)


def print_label(label: str, text: str, style: str = "yellow") -> None:
    """Print to the error stream a text after a label: `warning`, `left out`, `error`."""
    print_styled(f"{label}: {text}", f"^{label}:", style, to=err)


# What ends a command with one line and exit code 1.
ERRORS = (KcalError, OSError, MemoryError)


def error_text(error: BaseException) -> str:
    """The line that tells a person and a program why a command failed."""
    if isinstance(error, MemoryError):
        return "not enough memory; use fewer or smaller inputs"
    if isinstance(error, OSError) and not isinstance(error, KcalError):
        # What no command foresaw of files and folders: a disk that was taken away, a folder that may not be listed.
        return f"{f'{error.filename}: ' if error.filename else ''}{error.strerror or error}"
    return " ".join(str(error).split())


# What the running command tells programs, if it was asked to.
told: dict[str, Any] = {}


def tell(**content: Any) -> None:
    """Add to what `--json` prints: plain numbers, texts, lists and dictionaries by name."""
    told.update(content)


def _tell_more(name: str, *items: Any) -> None:
    told.setdefault(name, []).extend(items)


def warn(*texts: str) -> None:
    """Print warnings to the error stream."""
    for text in texts:
        _tell_more("warnings", visible(text))
        print_label("warning", text)


def print_wrote(*paths: Path | None) -> None:
    """Print which files were written or replaced; None stands for a file that was not asked for."""
    for path in paths:
        if path is not None:
            _tell_more("wrote", str(path))
            out.print(f"{'replaced' if replaced(path) else 'wrote'} {path}")


def draw_picture(path: Path | None, figure: Callable[[], Any]) -> None:
    """Draw and save a picture, if one was asked for."""
    if path is not None:
        kcal.report.save_picture(path, figure())


def print_replaced(written: Mapping[Path, bool]) -> None:
    """Name on the error stream the files that were replaced and of which nothing was said."""
    if names := [str(path) for path, anew in written.items() if anew and str(path) not in told.get("wrote", ())]:
        others = [f"{len(names) - 3} other files"] if len(names) > 3 else []
        err.print(f"replaced {', '.join([*names[:3], *others])}")


_MOST_LINES = 12  # of a list on the screen


def print_left_out(lines: Sequence[str], beside: Path, head: str) -> None:
    """Print what was left out, a line each; of more than a screen of them one line and the file with all of them."""
    if len(lines) <= _MOST_LINES:
        for line in lines:
            out.print(f"  {line}")
        return
    reasons = [line.partition(": ")[2] for line in lines]
    kinds = [re.sub(r"[\d.]+", "N", reason) for reason in reasons]
    most, count = Counter(kinds).most_common(1)[0]
    path = beside.with_name(f"{beside.name.split('.')[0]}.left-out.txt")
    write_atomic(path, "".join(f"{line}\n" for line in lines))
    _tell_more("wrote", str(path))
    out.print(f"{head}, {count} of them: {reasons[kinds.index(most)]}; all of them: {path}")


def print_table(rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> None:
    """Print rows of cells in columns that are as wide as they need to be: a pipe cuts neither names nor digits.

    Args:
        rows: the first row has the heads.
        left: columns that are aligned to the left; all others are aligned to the right.
    """
    rows = [[one_line(cell) for cell in row] for row in rows]
    _tell_more("tables", rows)
    out.print("\n".join(aligned(rows, left)))


def aligned(rows: Sequence[Sequence[str]], left: Collection[int] = (0,)) -> list[str]:
    """A line for each row, in columns that are as wide as they need to be; see `print_table`."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    for row in rows:
        cells = zip(row, widths, strict=True)
        lines.append("  ".join(cell.ljust(w) if i in left else cell.rjust(w) for i, (cell, w) in enumerate(cells)))
    return [line.rstrip() for line in lines]


def tell_table(name: str, table: Table, left: Collection[int] = (0,)) -> None:
    """Print a table, and tell programs its rows under this name."""
    print_table(table.cells, left)
    tell(**{name: table.records})


def print_answer(yes: bool, text: str) -> None:
    """Print a yes or no, and why."""
    print_styled(f"{'YES' if yes else 'NO'}: {text}", "^(YES|NO)")


def show_page(address: str, what: str, *, browser: bool) -> None:
    """Print the address of a local page, and open it in the browser if that is wanted."""
    _line.stop()
    out.print(f"{what}: {address}", soft_wrap=True)
    if browser:
        import webbrowser

        webbrowser.open(address)


@contextmanager
def on_signals(stop: Callable[..., object]) -> Iterator[None]:
    """Call `stop` meanwhile in place of what Ctrl-C and SIGTERM do otherwise."""
    before = {number: signal.signal(number, stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# From so many steps on their share is told.
_MANY = 10_000


class _Left(ProgressColumn):
    """How many steps are done of how many, and the time that is left; of unknown many, the time that has passed."""

    def render(self, task: Task) -> Text:
        """The text at the end of the line."""
        if task.total is None:
            return Text(str(timedelta(seconds=int(task.elapsed or 0.0))))
        left = "" if task.time_remaining is None else f", {timedelta(seconds=int(task.time_remaining))} left"
        many = task.total >= _MANY  # bytes
        return Text((f"{task.percentage:.0f} %" if many else f"{task.completed:.0f}/{task.total:.0f}") + left)


class _Bar(BarColumn):
    def render(self, task: Task) -> Any:
        return "" if task.total is None else super().render(task)


# At the foot of a terminal: what the command does now, how much of it is done, and what is left.
_line = Progress(
    SpinnerColumn(),
    TextColumn("{task.description}"),
    _Bar(),
    _Left(),
    console=err,
    transient=True,
    redirect_stdout=False,
    redirect_stderr=False,
    refresh_per_second=5,
)


def end_line() -> None:
    """Take the line of the progress away for good, where the output is a terminal to which something else writes."""
    if out.is_terminal:
        _line.stop()
        for task in _line.tasks:
            _line.update(task.id, visible=False)


@contextmanager
def working(command: str) -> Iterator[None]:
    """Show on a terminal, from the first moment, that a command works, and what it does (`steps`); "" for none."""
    if not (command and err.is_terminal and err.is_interactive):
        yield
        return
    task = _line.add_task(f"kcal {command}", total=None)
    _line.start()
    try:
        yield
    finally:
        _line.stop()
        _line.remove_task(task)


@contextmanager
def steps(description: str, total: int | None) -> Iterator[Callable[..., None]]:
    """Show a bar on the terminal: call the value with a text, and how many if not one, after each step.

    Blocks may be nested. Of unknown many steps (None), the last text and the time that has passed are shown.
    """
    shown = any(task.visible for task in _line.tasks)
    # What has no end in sight makes room for what it consists of.
    before = [task.id for task in _line.tasks if task.visible and task.total is None]
    # Long work: meanwhile the garbage collector need not search the imported libraries, which takes 50 ms each time.
    gc.freeze()
    for other in before:
        _line.update(other, visible=False)
    task = _line.add_task(description, total=total)
    if shown:
        _line.start()
    try:

        def advance(text: str, by: float = 1) -> None:
            about = f"{description}: {escape(one_line(text))}" if text else description
            _line.update(task, advance=by, description=about)

        yield advance
    finally:
        _line.remove_task(task)
        for other in before:
            _line.update(other, visible=True)
        gc.unfreeze()


def followed(description: str, items: Collection[_T], name: Callable[[_T], str]) -> Iterator[_T]:
    """The items one after the other, with a bar (`steps`) that is told the name of each when it is done."""
    with steps(description, len(items)) as advance:
        for item in items:
            yield item
            advance(name(item))


# Commands that can be pasted, at the end of refusals.


@contextmanager
def ending_with(cure: Callable[[KcalError], str]) -> Iterator[None]:
    """Data that are refused meanwhile are refused with a command after it, unless there is one in the text."""
    try:
        yield
    except (InputError, DegenerateError) as error:
        raise type(error)(with_command(str(error), cure(error))) from error


def with_command(text: str, cure: str) -> str:
    """The refusal and the command, which is the last.

    Example:
        >>> with_command("left.obs.json: too few views", "To add views: kcal capture camera:0")
        'left.obs.json: too few views. To add views: kcal capture camera:0'
    """
    stop = "" if text.endswith("?") else "."
    return f"{text.rstrip('.')}{stop} {cure}" if cure and "kcal " not in text else text


def board_words(board: kcal.Board) -> str:
    """The options that name a board.

    Example:
        >>> from kcal import Board
        >>> board_words(Board.parse("aprilgrid:6x6:0.3", "88mm"))
        '--board aprilgrid:6x6:26.4mm --square 88mm'
    """
    each = 2 if board.pattern == "aprilgrid" else 1
    parts = [f"{board.columns // each}x{board.rows // each}"]
    if board.dictionary is not None and board.marker is not None:
        parts = ["charuco", *parts, board.dictionary, _millimeters(board.marker)]
    elif board.pattern != "checkerboard":
        parts = [board.pattern, *parts]
    parts += [_millimeters(side) for side in (board.gap, board.diameter) if side is not None]
    parts += [f"id{board.first}"] if board.first else []
    return f"--board {':'.join(parts)} --square {_millimeters(board.square)}"


def more_views(board: kcal.Board, observations: Path) -> str:
    """The command that adds views to an observations file.

    Example:
        >>> from kcal import Board
        >>> more_views(Board(columns=9, rows=6, square=0.025), Path("left.obs.json"))
        'To add views: kcal capture camera:0 --board 9x6 --square 25mm -o left.obs.json'
    """
    return f"To add views: kcal capture camera:0 {board_words(board)} -o {shlex.quote(str(observations))}"


def look_at_views(seen: kcal.Observations, observations: Path) -> str:
    """The command that shows what was found in each image."""
    folders = {str(Path(view.image).parent) for view in seen.views if view.image is not None}
    images = shlex.join(sorted(folders)) if len(folders) == 1 else "images/"
    name = observations.name.split(".")[0]
    picture = shlex.quote(str(observations.with_name(f"{name}.gallery.png")))
    file = shlex.quote(str(observations))
    return f"To look at the views: kcal detect {images} {board_words(seen.board)} -o {file} --gallery {picture}"


def views_cure(error: object, seen: kcal.Observations, observations: Path) -> str:
    """More views where they do not determine the camera; another look where they contradict each other."""
    if isinstance(error, DegenerateError):
        return more_views(seen.board, observations)
    return look_at_views(seen, observations)


def mark_again(*words: object, marks: Path | None = None) -> str:
    """The command that shows marks in the images and takes more."""
    line = ["kcal", "mark", "left.png", "right.png", *map(str, words), "-o", str(marks or "marks.csv")]
    return f"To mark in the images: {shlex.join(line)}"


def _millimeters(meters: float) -> str:
    return f"{1e3 * meters:.10g}mm"
