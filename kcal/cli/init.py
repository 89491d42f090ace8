"""`kcal init`: a kcal.toml for a folder, so that the commands that are run there are short."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from kcal.cli.console import print_wrote
from kcal.cli.settings import NAME, SETTINGS, read_settings, toml_text
from kcal.errors import FileError, InputError
from kcal.files import check_writable, write_atomic


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
    """Write a kcal.toml: board, camera and site, which the commands that are run in this folder then know.

    What is typed on a command line goes before what the file says, and each command says in one line what it took from
    it. Without options all lines are comments, to be filled in by hand.

    **Examples**

    `kcal init --board 9x6 --square 25mm --origin 19.07,72.87,14 --pixel-sigma 0.1`

    `kcal detect left/ -o left.obs.json`
    """
    path = folder / NAME
    if path.exists() and not force:
        raise FileError(f"{path}: is there already; edit it, or write it anew: kcal init --force")
    if not any(value is not None for value in given.values()) and not folder.is_dir():
        raise InputError(f"{folder}: no such folder")
    check_writable(path)
    write_atomic(path, toml_text(given))
    read_settings(folder)
    print_wrote(path)
