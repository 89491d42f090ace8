"""The `kcal` command."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

import kcal
from kcal.cli import inputs
from kcal.cli.board import app as board
from kcal.cli.board import detect_command
from kcal.cli.calibrate import batch_command, calibrate_command
from kcal.cli.compare import bake_command, compare_command, diff_command, interpolate_command
from kcal.cli.console import err, print_label, print_replaced, warn, working
from kcal.cli.demo import demo_command
from kcal.cli.exchange import export_command, import_command, schema_command
from kcal.cli.init import init_command
from kcal.cli.live import live_command
from kcal.cli.locate import locate_command
from kcal.cli.options import Command, declared, defaults_of, read_settings
from kcal.cli.pages import capture_command, mark_command
from kcal.cli.rectify import rays_command, rectify_command
from kcal.cli.report import check_command, report_command
from kcal.cli.rig import app as rig
from kcal.cli.rig import place_command, station_command
from kcal.cli.show import show_command, view_command
from kcal.cli.sites import budget_command, sites_command
from kcal.cli.stars import stars_command
from kcal.cli.watch import watch_command
from kcal.errors import KcalError, KcalWarning
from kcal.files import written_files
from kcal.interrupts import only_interruptions
from kcal.texts import visible


@contextmanager
def usage_errors_shown() -> Iterator[None]:
    """Escape control characters in messages of Typer, some versions of which repeat what was typed as it is."""
    try:
        yield
    except Exception as error:
        if format_message := getattr(error, "format_message", None):
            shown = visible(format_message())
            setattr(error, "format_message", lambda: shown)  # noqa: B010
        raise


class _Commands(TyperGroup):
    def make_context(self, *arguments: Any, **options: Any) -> Any:
        name, words, *rest = *arguments, *(options.pop(key) for key in ("info_name", "args") if key in options)
        inputs.typed[:] = words
        if words[:1] != ["init"] and not {"--help", "--help-all"} & set(words):
            options.setdefault("default_map", defaults_of(read_settings(), self))
        with usage_errors_shown():
            return super().make_context(name, words, *rest, **options)

    def invoke(self, ctx: Any) -> Any:
        # Help and the version come at once.
        name = " ".join(word for word in inputs.typed[:1] if not {"--help", "--help-all"} & set(inputs.typed))
        # Typer ends an interrupted command without a word.
        with usage_errors_shown(), written_files() as written, working(name):
            try:
                try:
                    with only_interruptions():
                        return super().invoke(ctx)
                finally:
                    print_replaced(written)
            except KeyboardInterrupt:
                err.print(kept_text(written))
                raise typer.Exit(130) from None


def kept_text(written: Iterable[Path]) -> str:
    """What is said after an interruption: the last files that were written, and how many others."""
    names = list(map(str, written))
    if not names:
        return "interrupted; nothing was written"
    more = f"{len(names) - 3} other files, " if len(names) > 3 else ""
    return f"interrupted; written and kept: {more}{', '.join(names[-3:])}"


app = typer.Typer(
    name="kcal",
    cls=_Commands,
    help="Calibrate cameras, solve stereo rigs, and locate on the Earth what they see.",
    no_args_is_help=True,
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


COMMANDS = (
    demo_command, init_command, capture_command, detect_command, calibrate_command, interpolate_command,
    compare_command, batch_command, mark_command, station_command, place_command, stars_command, locate_command,
    live_command, watch_command, budget_command, sites_command, rectify_command, rays_command, bake_command,
    export_command, import_command, schema_command, show_command, view_command, diff_command, check_command,
    report_command,
)  # fmt: skip
# They run on, or write where they are told.
WITHOUT_JSON = (capture_command, mark_command, live_command, watch_command)
for command in COMMANDS:
    run = declared(command, json=command not in WITHOUT_JSON)
    app.command(command.__name__.removesuffix("_command"), cls=Command)(run)
app.add_typer(board, name="board")
app.add_typer(rig, name="rig")


def main() -> None:
    """Run the command line; an error of kcal is one line on the error stream and exit code 1."""
    shown = warnings.showwarning
    warnings.showwarning = lambda message, kind, *where: (
        warn(str(message)) if issubclass(kind, KcalWarning) else shown(message, kind, *where)
    )
    try:
        app()
    except KcalError as error:
        print_label("error", " ".join(str(error).split()), "bold red")
        sys.exit(1)
    except OSError as error:
        # What no command foresaw of files and folders: a disk that was taken away, a folder that may not be listed.
        name = f"{error.filename}: " if error.filename else ""
        print_label("error", f"{name}{error.strerror or error}", "bold red")
        sys.exit(1)
    except MemoryError:
        print_label("error", "not enough memory; use fewer or smaller inputs", "bold red")
        sys.exit(1)
