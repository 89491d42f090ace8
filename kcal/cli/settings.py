"""Settings of a folder: `kcal.toml` gives options of the commands that are run there or below."""

from __future__ import annotations

import difflib
import os
import shlex
import sys
import tomllib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from kcal import values
from kcal.errors import FileError, InputError
from kcal.files import is_stream, read_bytes

NAME = "kcal.toml"
_MOST_BYTES = 2**20
# Parameters of the running command that the file gave.
taken: set[str] = set()


class Setting(NamedTuple):
    """One key: its type, an example, and what reads its text. Options of its name whose `Kind` says so take it."""

    kind: type
    example: str
    read: Callable[[str, str], Any] | None = None


SETTINGS = {
    "board": Setting(str, '"9x6"'),
    "square": Setting(str, '"25mm"', values.length),
    "source": Setting(str, '"camera:0"'),
    "site": Setting(str, '"19.07,72.87,14"', values.place_on_earth),
    "heading": Setting(float, "35.0"),
    "pixel_sigma": Setting(float, "0.3"),
    "require": Setting(str, '"5km:10%"', values.ranges_and_errors),
    "baseline": Setting(float, "10.0"),
}


def settings_file(folder: str | Path = ".") -> Path:
    """The nearest kcal.toml: that of the folder or of one that it lies in, up to the root of its file system.

    Where there is none, it is the one that `kcal init` would write.
    """
    shown = Path(folder)
    with suppress(OSError):  # where the folder itself was removed meanwhile
        for place in (shown.resolve(), *shown.resolve().parents):
            if os.path.isfile(shown / NAME):
                return shown / NAME
            if os.path.ismount(place):
                break
            shown /= ".."
    return Path(folder, NAME)


def read_settings(folder: str | Path = ".") -> dict[str, Any]:
    """The settings of a folder by name; none if neither it nor a folder that it lies in has a kcal.toml.

    Raises:
        FileError: not TOML, an unknown key, or a value of another type.
    """
    path = settings_file(folder)
    if not path.is_file():
        return {}
    try:
        content = tomllib.loads(read_bytes(path, _MOST_BYTES).decode("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        again = shlex.join(["kcal", "init", *([] if path.parent == Path() else [str(path.parent)]), "--force"])
        raise FileError(f"{path}: not TOML: {error}. To write a new one: {again}") from error
    found = {key: checked_setting(key, value, path) for key, value in content.items()}
    if not is_stream(found.get("source", "camera:0")):  # a folder of images, which is named from where the file is
        found["source"] = os.path.join(os.path.relpath(path.parent, folder), found["source"]).removeprefix("./")
    return found


def checked_setting(key: str, value: Any, path: Path) -> Any:
    """A value as a key of the file has it.

    Raises:
        FileError: an unknown key, or a value of another type.
    """
    if key not in SETTINGS:
        near = difflib.get_close_matches(key, SETTINGS, 1, 0.0)[0]
        raise FileError(f"{path}: unknown key {key[:40]!r}; did you mean {near}? Known are {', '.join(SETTINGS)}")
    wanted = SETTINGS[key].kind
    # An integer of TOML may be larger than any float.
    number = wanted is float and type(value) in (int, float) and abs(value) <= sys.float_info.max
    if not number and (wanted is float or not isinstance(value, str)):
        what = "a number" if wanted is float else "a text in quotation marks"
        raise FileError(f"{path}: {key} must be {what}, for example {key} = {SETTINGS[key].example}")
    if (read := SETTINGS[key].read) is not None:
        try:
            read(value, key)
        except InputError as error:
            raise FileError(f"{path}: {error}") from None
    return wanted(value)


def defaults_of(settings: dict[str, Any], command: Any) -> dict[str, Any]:
    """Defaults of a command's parameters, and of its subcommands by their names, as the command line takes them."""
    if not hasattr(command, "commands"):
        return {key: settings[key] for key in getattr(command.callback, "settings", set()) & settings.keys()}
    own = {name: defaults_of(settings, one) for name, one in command.commands.items()}
    return {name: defaults for name, defaults in own.items() if defaults}


def settings_text(found: dict[str, Any], path: Path) -> str:
    """What was taken from the file, in one line.

    Example:
        >>> settings_text({"board": "9x6", "pixel_sigma": 0.1}, Path("../kcal.toml"))
        'from ../kcal.toml: board 9x6, pixel_sigma 0.1'
    """
    return f"from {path}: {', '.join(f'{name} {value}' for name, value in found.items())}"
