"""Steps that both demonstrations share: run a command, locate the points, list the results."""

from __future__ import annotations

import shlex
from pathlib import Path

import typer
from rich.markup import escape
from typer.main import get_command

from kcal.cli.calibrate import calibrate_command
from kcal.cli.console import out
from kcal.cli.detect import detect_command
from kcal.cli.locate import locate_command
from kcal.cli.report import report_command
from kcal.cli.rig import app as rig

SIDES = ("left", "right")


def run(name: str, *arguments: object) -> None:
    """Print a command as a user would type it, and run it: detect, calibrate, rig, locate or report."""
    words = [str(argument) for argument in arguments]
    out.print(f"\n[bold]kcal {escape(shlex.join([name, *words]))}[/]")
    app = rig
    if name != "rig":
        app = typer.Typer()
        commands = {
            "detect": detect_command,
            "calibrate": calibrate_command,
            "locate": locate_command,
            "report": report_command,
        }
        app.command()(commands[name])  # type: ignore[type-var]
    get_command(app).main(words, standalone_mode=False)


def locate_again(output: Path, *options: object) -> str:
    """Locate `points.csv`, write positions and maps, and return the command that locates the points once more."""
    words = [output / "rig.json", output / "points.csv", *options]
    files = ["-o", output / "points.geojson", "-o", output / "positions.csv"]
    run("locate", *words, *files, "--picture", output / "map.png", "--map", output / "map.html")
    return shlex.join(map(str, ["kcal", "locate", *words, "-o", "again.geojson"]))


def print_results(output: Path, command: str) -> None:
    """Print where the results are, what they are, and the command that locates the points once more."""
    out.print(f"\nResults are in {output.resolve()}:", markup=False)
    for name, what in (
        ("summary.html", "what was done and what came out, on one page"),
        ("map.png", "the map"),
        ("map.html", "the map, interactive, for any browser"),
        ("points.geojson", "positions for a GIS"),
        ("positions.csv", "the same as a table"),
        ("left.png, right.png", "coverage and residuals of each camera"),
        ("rig.json", "the rig; left.camera.json and right.camera.json are its cameras"),
    ):
        out.print(f"  {name:22s} {what}", markup=False)
    out.print(f"Locate again by hand:\n  {command}", markup=False)
