"""The `kcal` command."""

from __future__ import annotations

import importlib
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
from kcal.cli.console import ERRORS, err, error_text, print_label, print_replaced, warn, working
from kcal.cli.options import Command, declared, defaults_of, group_with_default, read_settings
from kcal.errors import KcalWarning
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


# Each command, and the module here that has its function.
COMMANDS = {
    "demo": "demo", "init": "options", "capture": "pages", "detect": "board", "calibrate": "calibrate",
    "interpolate": "cameras", "compare": "cameras", "batch": "calibrate", "mark": "pages", "station": "rig",
    "place": "rig", "stars": "stars", "locate": "locate", "live": "live", "watch": "live", "budget": "sites",
    "sites": "sites", "rectify": "rectify", "rays": "rectify", "bake": "cameras", "export": "cameras",
    "import": "cameras", "schema": "cameras", "show": "show", "view": "show", "diff": "cameras", "check": "report",
    "report": "report", "board print": "board", "board measure": "board", "rig solve": "rig", "rig check": "rig",
}  # fmt: skip
# They run on, or write where they are told.
WITHOUT_JSON = ("capture", "mark", "live", "watch")
GROUPS = {
    "board": ("print", "Draw a board to print, and measure it later."),
    "rig": ("solve", "Solve a rig, and check it later."),
}
groups = {"": app}
for group, (default, about) in GROUPS.items():
    groups[group] = typer.Typer(cls=group_with_default(default), rich_markup_mode="markdown", help=about)
    app.add_typer(groups[group], name=group)
for words, module in COMMANDS.items():
    group, _, name = words.rpartition(" ")
    function = getattr(importlib.import_module(f"kcal.cli.{module}"), f"{words.replace(' ', '_')}_command")
    run = declared(function, json=name not in WITHOUT_JSON)
    groups[group].command(name, cls=Command, hidden=words == "rig solve")(run)


def main() -> None:
    """Run the command line; an error of kcal is one line on the error stream and exit code 1."""
    shown = warnings.showwarning
    warnings.showwarning = lambda message, kind, *where: (
        warn(str(message)) if issubclass(kind, KcalWarning) else shown(message, kind, *where)
    )
    try:
        sys.exit(app())
    except ERRORS as error:
        print_label("error", error_text(error), "bold red")
        sys.exit(1)
