"""Steps that both demonstrations share: run a command, write positions and maps, list the results."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING

import typer
from rich.markup import escape
from typer.main import get_command

from kcal.cli.calibrate import calibrate_command
from kcal.cli.console import out
from kcal.cli.detect import detect_command
from kcal.cli.locate import locate_marks
from kcal.cli.rig import app as rig

if TYPE_CHECKING:
    import torch

    from kcal.locate.geodesy import Origin
    from kcal.locate.positions import Located

SIDES = ("left", "right")


def run(name: str, *arguments: object) -> None:
    """Print a command as a user would type it, and run it: detect, calibrate, or rig."""
    words = [str(argument) for argument in arguments]
    out.print(f"\n[bold]kcal {escape(shlex.join([name, *words]))}[/]")
    app = rig
    if name != "rig":
        app = typer.Typer()
        app.command()(detect_command if name == "detect" else calibrate_command)
    get_command(app).main(words, standalone_mode=False)


def locate_points(
    output: Path,
    pixel_sigma: float,
    *,
    origin: Origin | None = None,
    heading: float | None = None,
    truth: torch.Tensor | None = None,
) -> Located:
    """Locate `points.csv` with `rig.json` as `kcal locate` does; write positions and maps to the same folder."""
    from kcal.locate.export import write_positions
    from kcal.locate.marks import read_marks
    from kcal.report.map_page import save_map
    from kcal.report.positions import save_positions_picture

    marks = read_marks(output / "points.csv")
    located = locate_marks(output / "rig.json", marks, origin=origin, heading=heading, pixel_sigma=pixel_sigma)
    write_positions(output / "points.geojson", located)
    write_positions(output / "positions.csv", located)
    save_positions_picture(output / "map.png", located, truth)
    save_map(output / "map.html", located, truth)
    return located


def again(output: Path, pixel_sigma: float, *where: str) -> str:
    """The command that locates the points once more."""
    rig_file, points = output / "rig.json", output / "points.csv"
    words = ["kcal", "locate", rig_file, points, *where, "--pixel-sigma", pixel_sigma, "-o", "again.geojson"]
    return shlex.join(map(str, words))


def print_results(output: Path, command: str, *, summary: bool = False) -> None:
    """Print where the results are, what they are, and the command that locates the points once more."""
    out.print(f"\nResults are in {output.resolve()}:", markup=False)
    for name, what in (
        *((("summary.html", "what was done and what came out, on one page"),) if summary else ()),
        ("map.png", "the map"),
        ("map.html", "the map, interactive, for any browser"),
        ("points.geojson", "positions for a GIS"),
        ("positions.csv", "the same as a table"),
        ("left.png, right.png", "coverage and residuals of each camera"),
        ("rig.json", "the rig; left.camera.json and right.camera.json are its cameras"),
    ):
        out.print(f"  {name:22s} {what}", markup=False)
    out.print(f"Locate again by hand:\n  {command}", markup=False)
