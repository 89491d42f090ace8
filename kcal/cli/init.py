"""`kcal init`: a kcal.toml for a folder, so that the commands that are run there are short."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated, Any

from kcal.cli.console import print_wrote
from kcal.cli.options import NAME, SETTINGS, Kind, checked_setting, described, read_settings
from kcal.errors import FileError, InputError
from kcal.files import check_writable, write_atomic


def init_command(folder: Path = Path("."), *, force: bool = False, **given: Any) -> None:
    """Write a kcal.toml: board, camera and site, which the commands that are run in this folder or below then know.

    What is typed on a command line goes before what the file says, and each command says in one line what it took from
    it. A folder's own file replaces that of a folder above. Without options all lines are comments, to be filled in by
    hand.

    **Examples**

    `kcal init --board 9x6 --square 25mm --site 19.07,72.87,14 --pixel-sigma 0.1`

    `kcal detect left/ -o left.obs.json`

    Args:
        folder: Folder of the images.
        force: Write anew a file that is there.
        board: Pattern, as for kcal detect --board
        square: Side of a square, with its unit
        source: Where kcal capture gets images: a device, a stream or a folder
        site: Where the left camera stands: latitude, longitude, height above WGS84, where the rig's file does not say
        heading: Azimuth of the left camera's axis there, degrees
        pixel_sigma: Noise of marks along each axis, pixels
        require: Ranges, and the largest σ of each
        baseline: Distance between the cameras, meters
    """
    path = folder / NAME
    if path.exists() and not force:
        raise FileError(f"{path}: is there already; edit it, or write it anew: kcal init --force")
    if not any(value is not None for value in given.values()) and not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    for key, value in given.items():
        if value is not None:
            checked_setting(key, value, path)
    check_writable(path)
    write_atomic(path, toml_text(given))
    read_settings(folder)
    print_wrote(path)


def _with_settings() -> inspect.Signature:
    """That of the command with an option for each key of the file."""
    parameters = [*inspect.signature(init_command, eval_str=True).parameters.values()][:-1]
    for key, setting in SETTINGS.items():
        kind: Any = setting.kind
        annotation = Annotated[kind | None, Kind(metavar="VALUE", about=f"{{}}, for example {setting.example}.")]
        parameters.append(inspect.Parameter(key, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=annotation))
    return inspect.Signature(parameters)


init_command.__signature__ = _with_settings()  # type: ignore[attr-defined]


def toml_text(given: dict[str, Any]) -> str:
    """A kcal.toml with these settings; all others stand in it as comments."""
    lines = ["# Options of kcal's commands in this folder and those below; what is typed goes first.", ""]
    about = described(init_command.__doc__)[1]
    for key, setting in SETTINGS.items():
        value = given.get(key)
        lines.append(f"# {about[key]}.")
        lines.append(f"# {key} = {setting.example}" if value is None else f"{key} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if not isinstance(value, str):
        return repr(float(value))
    escaped = value.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'
