"""Options that have another name now: the old one works in version 1, with a warning."""

from __future__ import annotations

import math
from typing import NamedTuple

from kcal.errors import InputError


class _Renamed(NamedTuple):
    """What an old option is now; its value is divided by `divisor`."""

    now: str
    divisor: float = 1.0


# By command, "" for all, and old name.
_RENAMED = {
    ("", "--mark-sigma"): _Renamed("--pixel-sigma"),
    # Both marks of a pair err.
    ("budget", "--disparity"): _Renamed("--pixel-sigma", math.sqrt(2.0)),
    ("calibrate", "--board"): _Renamed("--board-shape"),
    ("live", "--map"): _Renamed("--port"),
}
_NEEDLESS = {("calibrate", "--analog"): "the views tell whether pixels are square"}


def with_new_names(words: list[str]) -> tuple[list[str], list[str]]:
    """The words of a command line with the options' names of today, and warnings.

    Example:
        >>> with_new_names(["live", "rig.json", "--map", "8350"])
        (['live', 'rig.json', '--port', '8350'], ['--map is called --port now; the old name goes in version 2.0'])
    """
    command = words[0] if words else ""
    found: list[str] = []
    warnings: list[str] = []
    divisor = 1.0
    for word in words:
        if divisor != 1.0:
            word, divisor = _divided(word, divisor), 1.0
        option, equals, value = word.partition("=")
        if reason := _NEEDLESS.get((command, option)):
            warnings.append(f"{option} is not needed any more and goes in version 2.0: {reason}")
            continue
        renamed = _RENAMED.get((command, option)) or _RENAMED.get(("", option))
        if renamed is None:
            found.append(word)
            continue
        warnings.append(f"{option} is called {renamed.now} now; the old name goes in version 2.0")
        if renamed.divisor != 1.0:
            warnings[-1] += ", and the value of the new one is divided by √2: noise of one mark along each axis"
        if equals:
            value = _divided(value, renamed.divisor) if renamed.divisor != 1.0 else value
            found.append(f"{renamed.now}={value}")
        else:
            found.append(renamed.now)
            divisor = renamed.divisor
    return found, warnings


def _divided(value: str, divisor: float) -> str:
    try:
        return repr(float(value) / divisor)
    except ValueError:
        raise InputError(f"{value!r} is not a number of pixels") from None
