"""Commands that can be pasted, at the end of refusals."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from kcal.errors import DegenerateError, InputError, KcalError

if TYPE_CHECKING:
    from kcal.corners.board import Board
    from kcal.corners.observations import Observations


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
    return f"{text.rstrip('.')}. {cure}" if cure and "kcal " not in text else text


def board_words(board: Board) -> str:
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


def more_views(board: Board, observations: Path) -> str:
    """The command that adds views to an observations file.

    Example:
        >>> from kcal import Board
        >>> more_views(Board(columns=9, rows=6, square=0.025), Path("left.obs.json"))
        'To add views: kcal capture camera:0 --board 9x6 --square 25mm -o left.obs.json'
    """
    return f"To add views: kcal capture camera:0 {board_words(board)} -o {shlex.quote(str(observations))}"


def look_at_views(seen: Observations, observations: Path) -> str:
    """The command that shows what was found in each image."""
    folders = {str(Path(view.image).parent) for view in seen.views if view.image is not None}
    images = shlex.join(sorted(folders)) if len(folders) == 1 else "images/"
    name = observations.name.split(".")[0]
    picture = shlex.quote(str(observations.with_name(f"{name}.gallery.png")))
    file = shlex.quote(str(observations))
    return f"To look at the views: kcal detect {images} {board_words(seen.board)} -o {file} --gallery {picture}"


def views_cure(error: object, seen: Observations, observations: Path) -> str:
    """More views where they do not determine the camera; another look where they contradict each other."""
    if isinstance(error, DegenerateError):
        return more_views(seen.board, observations)
    return look_at_views(seen, observations)


def mark_again(
    survey: Path | None, marks: Path | None, *, rig: Path | None = None, cameras: tuple[Path, Path] | None = None
) -> str:
    """The command that shows marks in the images and takes more."""
    words = ["kcal", "mark", "left.png", "right.png"]
    words += [] if rig is None else ["--rig", str(rig)]
    words += [] if cameras is None else ["--cameras", *map(str, cameras)]
    words += [] if rig is not None else ["--landmarks", str(survey or "survey.csv")]
    return f"To mark in the images: {shlex.join([*words, '-o', str(marks or 'marks.csv')])}"


def option_for_each(words: Sequence[str], option: str) -> str:
    """The command that was typed with an option once for all of the files after it, with it before each of them.

    Example:
        >>> option_for_each(["report", "rig.json", "--observations", "a.json", "b.json"], "--observations")
        'kcal report rig.json --observations a.json --observations b.json'
    """
    found, follows = ["kcal"], False
    for word in words:
        if word.startswith("-"):
            follows = word == option
            found += [] if follows else [word]
        else:
            found += [option, word] if follows else [word]
    return shlex.join(found)


def _millimeters(meters: float) -> str:
    return f"{1e3 * meters:.10g}mm"
