"""The `kcal` command."""

from __future__ import annotations

import sys
from typing import Annotated

import typer
from rich.markup import escape

import kcal
from kcal.cli.bake import bake_command
from kcal.cli.batch import batch_command
from kcal.cli.board import app as board
from kcal.cli.budget import budget_command
from kcal.cli.calibrate import calibrate_command
from kcal.cli.compare import compare_command
from kcal.cli.console import err
from kcal.cli.demo import demo_command
from kcal.cli.detect import detect_command
from kcal.cli.diff import diff_command
from kcal.cli.exchange import export_command, import_command
from kcal.cli.live import live_command
from kcal.cli.locate import locate_command
from kcal.cli.mark import mark_command
from kcal.cli.rig import app as rig
from kcal.cli.show import show_command
from kcal.cli.undistort import undistort_command
from kcal.errors import KcalError

app = typer.Typer(
    name="kcal",
    help="Calibrate cameras, solve stereo rigs, and locate on the Earth what they see.",
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
def _global_options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and stop.")
    ] = False,
) -> None:
    pass


app.command("demo")(demo_command)
app.add_typer(board, name="board")
app.command("detect")(detect_command)
app.command("calibrate")(calibrate_command)
app.command("compare")(compare_command)
app.command("batch")(batch_command)
app.command("mark")(mark_command)
app.add_typer(rig, name="rig")
app.command("locate")(locate_command)
app.command("live")(live_command)
app.command("budget")(budget_command)
app.command("undistort")(undistort_command)
app.command("bake")(bake_command)
app.command("export")(export_command)
app.command("import")(import_command)
app.command("show")(show_command)
app.command("diff")(diff_command)


def main() -> None:
    """Run the command line; an error of kcal is one line on the error stream and exit code 1."""
    try:
        app()
    except KcalError as error:
        err.print("[bold red]error:[/]", escape(" ".join(str(error).split())))
        sys.exit(1)
    except OSError as error:
        # What no command foresaw of files and folders: a disk that was taken away, a folder that may not be listed.
        name = f"{error.filename}: " if error.filename else ""
        err.print("[bold red]error:[/]", escape(f"{name}{error.strerror or error}"))
        sys.exit(1)
    except MemoryError:
        err.print("[bold red]error:[/] not enough memory; use fewer or smaller inputs")
        sys.exit(1)
    except KeyboardInterrupt:
        err.print("interrupted; nothing was written")
        sys.exit(130)
