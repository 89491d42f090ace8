"""Settings of a folder: `kcal.toml`, written by `kcal init`, gives options of the commands that are run there."""

from __future__ import annotations

import difflib
import sys
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

from kcal.errors import FileError
from kcal.files import read_bytes

NAME = "kcal.toml"
_MOST_BYTES = 2**20
# Parameters of the running command that the file gave.
taken: set[str] = set()


class _Setting(NamedTuple):
    """One key: its type, the commands' parameters that it gives, and what it is."""

    kind: type
    takers: tuple[tuple[str, str], ...]
    about: str
    example: str


def _for(parameter: str, *commands: str) -> tuple[tuple[str, str], ...]:
    return tuple((command, parameter) for command in commands)


_JUDGING = ("calibrate", "report", "rig solve")
SETTINGS = {
    "board": _Setting(
        str, _for("size", "detect", "capture", "board print", "batch"), "Pattern, as for kcal detect --board.", '"9x6"'
    ),
    "square": _Setting(
        str, _for("square", "detect", "capture", "board print", "batch"), "Side of a square, with its unit.", '"25mm"'
    ),
    "camera": _Setting(
        str, _for("source", "capture"), "Where kcal capture gets images: a device, a stream or a folder.", '"camera:0"'
    ),
    "origin": _Setting(
        str,
        _for("origin", "locate", "live"),
        "The site: latitude, longitude, height above WGS84, where the rig's file has none.",
        '"19.07,72.87,14"',
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
    "require": _Setting(str, _for("require", *_JUDGING), "Ranges, and the largest σ of each.", '"5km:10%"'),
    "baseline": _Setting(
        float, _for("baseline", "calibrate", "report", "budget"), "Distance between the cameras, meters.", "10.0"
    ),
}


def read_settings(folder: str | Path = ".") -> dict[str, Any]:
    """The settings of a folder by name; none if it has no kcal.toml.

    Raises:
        FileError: not TOML, an unknown key, or a value of another type.
    """
    path = Path(folder, NAME)
    if not path.is_file():
        return {}
    try:
        content = tomllib.loads(read_bytes(path, _MOST_BYTES).decode("utf-8-sig"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise FileError(f"{NAME}: not TOML: {error}. To write a new one: kcal init --force") from error
    return {key: _checked_setting(key, value) for key, value in content.items()}


def _checked_setting(key: str, value: Any) -> Any:
    if key not in SETTINGS:
        near = difflib.get_close_matches(key, SETTINGS, 1, 0.0)[0]
        raise FileError(f"{NAME}: unknown key {key[:40]!r}; did you mean {near}? Known are {', '.join(SETTINGS)}")
    wanted = SETTINGS[key].kind
    # An integer of TOML may be larger than any float.
    number = wanted is float and type(value) in (int, float) and abs(value) <= sys.float_info.max
    if not number and (wanted is float or not isinstance(value, str)):
        what = "a number" if wanted is float else "a text in quotation marks"
        raise FileError(f"{NAME}: {key} must be {what}, for example {key} = {SETTINGS[key].example}")
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


def settings_text(values: dict[str, Any]) -> str:
    """What was taken from the file, in one line.

    Example:
        >>> settings_text({"size": "9x6", "pixel_sigma": 0.1})
        'from kcal.toml: board 9x6, pixel_sigma 0.1'
    """
    keys = {parameter: key for key, setting in SETTINGS.items() for _, parameter in setting.takers}
    return f"from {NAME}: {', '.join(f'{keys[name]} {value}' for name, value in values.items())}"


def toml_text(given: dict[str, Any]) -> str:
    """A kcal.toml with these settings; all others stand in it as comments."""
    lines = ["# Options of kcal's commands in this folder; what is typed goes first.", ""]
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
