"""The `kcal` command."""

from __future__ import annotations

import sys
from typing import Annotated

import typer
from rich.markup import escape

import kcal
from kcal.cli.bake import bake
from kcal.cli.batch import batch
from kcal.cli.board import board
from kcal.cli.budget import budget
from kcal.cli.calibrate import calibrate
from kcal.cli.console import err
from kcal.cli.demo import demo
from kcal.cli.detect import detect
from kcal.cli.locate import locate
from kcal.cli.rig import app as rig
from kcal.cli.undistort import undistort
from kcal.errors import KcalError

app = typer.Typer(
    name="kcal",
    help="Calibrate cameras, solve stereo rigs, and locate what they see on the Earth.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"kcal {kcal.__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    pass


app.command("demo")(demo)
app.command("board")(board)
app.command("detect")(detect)
app.command("calibrate")(calibrate)
app.command("batch")(batch)
app.add_typer(rig, name="rig")
app.command("locate")(locate)
app.command("budget")(budget)
app.command("undistort")(undistort)
app.command("bake")(bake)


def main() -> None:
    """Run the command line: one line on the error stream and exit code 1 for what kcal refuses."""
    try:
        app()
    except KcalError as error:
        err.print("[bold red]error:[/]", escape(" ".join(str(error).split())))
        sys.exit(1)
    except KeyboardInterrupt:
        err.print("interrupted; nothing was written")
        sys.exit(130)
