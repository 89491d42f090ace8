"""What `kcal demo` prints at its end."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

    from kcal.corners.board import Board
    from kcal.locate.positions import Located, Position


_HEADS = ("target", "true m", "estimate m", "95 % interval m", "error m", "%", "across m", "calibration m")


def print_truth(located: Located, exact: Located, truth: torch.Tensor) -> None:
    """Range and error of each target, and the share of the error that marks without noise leave."""
    from rich.table import Table

    from kcal.cli.console import out

    head, *rows = truth_rows(located, exact, truth)
    table = Table(box=None, pad_edge=False, header_style="bold", title="True against estimated positions")
    for number, column in enumerate(head):
        table.add_column(column, justify="right" if number else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row)
    out.print(table)


def truth_rows(located: Located, exact: Located, truth: torch.Tensor) -> list[list[str]]:
    """The same as cells, the heads first."""
    rows = [list(_HEADS)]
    for position, noiseless, true in zip(located.positions, exact.positions, truth, strict=True):
        distance = float(true.norm())
        if position.enu is None or position.range_m is None:
            rows.append([position.name, f"{distance:.1f}", "-", "-", "-", "-", "-", position.reason])
            continue
        along, across = _along_and_across(position, true)
        low, high = position.range_low_m or 0.0, position.range_high_m or 0.0
        share = "-" if noiseless.enu is None else f"{_along_and_across(noiseless, true)[0]:+.2f}"
        estimate, interval = f"{position.range_m:.1f}", f"{low:.1f} – {high:.1f}"
        error = [f"{along:+.2f}", f"{100 * along / distance:+.2f}", f"{across:.2f}"]
        rows.append([position.name, f"{distance:.1f}", estimate, interval, *error, share])
    return rows


def _along_and_across(position: Position, true: torch.Tensor) -> tuple[float, float]:
    """Error along the line of sight, signed, and across it, meters."""
    error = true.new_tensor(position.enu) - true
    sight = true / true.norm()
    along = float(error @ sight)
    return along, float((error - along * sight).norm())


def print_diagonals(located: Located, board: Board) -> None:
    """The board's diagonal, known and triangulated, of every pair of which both ends were located."""
    import math

    from rich.table import Table

    from kcal.cli.console import out

    true = board.square * math.hypot(board.columns - 1, board.rows - 1)
    table = Table(box=None, pad_edge=False, header_style="bold", title="The board's diagonal, true against estimated")
    for column in ("pair", "range m", "true mm", "estimated mm", "error mm"):
        table.add_column(column, justify="left" if column == "pair" else "right", no_wrap=True)
    ends = {position.name: position for position in located.positions if position.enu is not None}
    for name in sorted({name.rsplit(" ", 1)[0] for name in ends}):
        first, last = ends.get(f"{name} first"), ends.get(f"{name} last")
        if first is None or last is None or first.enu is None or last.enu is None:
            continue
        length = math.dist(first.enu, last.enu)
        error = 1e3 * (length - true)
        table.add_row(name, f"{first.range_m:.3f}", f"{1e3 * true:.2f}", f"{1e3 * length:.2f}", f"{error:+.2f}")
    out.print(table)


def print_results(output: Path, again: str, *, summary: bool = False) -> None:
    """Where the results are, what they are, and the command that makes the positions again."""
    from kcal.cli.console import out

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
    out.print(f"Locate again by hand:\n  {again}", markup=False)
