"""Commands with short help and subcommands, and their defaults from `kcal.toml`, which `kcal init` writes."""

from __future__ import annotations

import difflib
import inspect
import os
import shlex
import sys
import tomllib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from kcal import values
from kcal.cli.console import print_wrote
from kcal.errors import FileError, InputError
from kcal.files import check_writable, is_stream, read_bytes, write_atomic

# Settings of a folder: `kcal.toml`, written by `kcal init`, gives options of the commands that are run there or below.

NAME = "kcal.toml"
_MOST_BYTES = 2**20
# Parameters of the running command that the file gave.
taken: set[str] = set()


class _Setting(NamedTuple):
    """One key: its type, the commands' parameters that it gives, what it is, and what reads its text if not they."""

    kind: type
    takers: tuple[tuple[str, str], ...]
    about: str
    example: str
    read: Callable[[str, str], Any] | None = None


def _for(parameter: str, *commands: str) -> tuple[tuple[str, str], ...]:
    return tuple((command, parameter) for command in commands)


_JUDGING = ("calibrate", "report", "rig solve")
SETTINGS = {
    "board": _Setting(
        str, _for("board", "detect", "capture", "board print", "batch"), "Pattern, as for kcal detect --board.", '"9x6"'
    ),
    "square": _Setting(
        str,
        _for("square", "detect", "capture", "board print", "batch"),
        "Side of a square, with its unit.",
        '"25mm"',
        values.length,
    ),
    "source": _Setting(
        str, _for("source", "capture"), "Where kcal capture gets images: a device, a stream or a folder.", '"camera:0"'
    ),
    "site": _Setting(
        str,
        _for("site", "locate", "live"),
        "Where the left camera stands: latitude, longitude, height above WGS84, where the rig's file does not say.",
        '"19.07,72.87,14"',
        values.place_on_earth,
    ),
    "heading": _Setting(
        float, _for("heading", "locate", "live"), "Azimuth of the left camera's axis there, degrees.", "35.0"
    ),
    "pixel_sigma": _Setting(
        float,
        _for("pixel_sigma", *_JUDGING, "rig check", "mark", "locate", "live", "budget"),
        "Noise of marks along each axis, pixels.",
        "0.3",
    ),
    "require": _Setting(
        str, _for("require", *_JUDGING), "Ranges, and the largest σ of each.", '"5km:10%"', values.ranges_and_errors
    ),
    "baseline": _Setting(
        float, _for("baseline", "calibrate", "report", "budget"), "Distance between the cameras, meters.", "10.0"
    ),
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
    found = {key: _checked_setting(key, value, path) for key, value in content.items()}
    if not is_stream(found.get("source", "camera:0")):  # a folder of images, which is named from where the file is
        found["source"] = os.path.join(os.path.relpath(path.parent, folder), found["source"]).removeprefix("./")
    return found


def _checked_setting(key: str, value: Any, path: Path) -> Any:
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


def defaults_of(settings: dict[str, Any]) -> dict[str, Any]:
    """Defaults of parameters by command, and by subcommand below that, as the command line takes them."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        for command, parameter in SETTINGS[key].takers:
            place = found
            for word in command.split():
                place = place.setdefault(word, {})
            place[parameter] = value
    return found


def settings_text(found: dict[str, Any], path: Path) -> str:
    """What was taken from the file, in one line.

    Example:
        >>> settings_text({"board": "9x6", "pixel_sigma": 0.1}, Path("../kcal.toml"))
        'from ../kcal.toml: board 9x6, pixel_sigma 0.1'
    """
    keys = {parameter: key for key, setting in SETTINGS.items() for _, parameter in setting.takers}
    return f"from {path}: {', '.join(f'{keys[name]} {value}' for name, value in found.items())}"


def toml_text(given: dict[str, Any]) -> str:
    """A kcal.toml with these settings; all others stand in it as comments."""
    lines = ["# Options of kcal's commands in this folder and those below; what is typed goes first.", ""]
    for key, setting in SETTINGS.items():
        value = given.get(key)
        lines.append(f"# {setting.about}")
        lines.append(f"# {key} = {setting.example}" if value is None else f"{key} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if not isinstance(value, str):
        return repr(float(value))
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'


# `kcal init`: a kcal.toml for a folder, so that the commands that are run there are short.


def _with_settings(command: Callable[..., None]) -> Callable[..., None]:
    """The command with an option for each key of the file."""
    parameters = [*inspect.signature(command, eval_str=True).parameters.values()][:-1]
    for key, setting in SETTINGS.items():
        about = typer.Option(metavar="VALUE", help=f"{setting.about[:-1]}, for example {setting.example}.")
        kind: Any = setting.kind
        annotation = Annotated[kind | None, about]
        parameters.append(inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation))
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return command


@_with_settings
def init_command(
    folder: Annotated[Path, typer.Argument(help="Folder of the images.")] = Path("."),
    force: Annotated[bool, typer.Option("--force", help="Write anew a file that is there.")] = False,
    **given: Any,
) -> None:
    """Write a kcal.toml: board, camera and site, which the commands that are run in this folder or below then know.

    What is typed on a command line goes before what the file says, and each command says in one line what it took from
    it. A folder's own file replaces that of a folder above. Without options all lines are comments, to be filled in by
    hand.

    **Examples**

    `kcal init --board 9x6 --square 25mm --site 19.07,72.87,14 --pixel-sigma 0.1`

    `kcal detect left/ -o left.obs.json`
    """
    path = folder / NAME
    if path.exists() and not force:
        raise FileError(f"{path}: is there already; edit it, or write it anew: kcal init --force")
    if not any(value is not None for value in given.values()) and not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    for key, value in given.items():
        if value is not None:
            _checked_setting(key, value, path)
    check_writable(path)
    write_atomic(path, toml_text(given))
    read_settings(folder)
    print_wrote(path)
