"""`kcal board`: a board to print, and a printed board measured."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import typer

import kcal
from kcal.cli import kinds
from kcal.cli.console import out, print_wrote, steps, warn
from kcal.cli.options import Command, Kind, declared, group_with_default
from kcal.errors import InputError
from kcal.files import write_atomic

app = typer.Typer(
    cls=group_with_default("print"), rich_markup_mode="markdown", help="Draw a board to print, and measure it later."
)


def print_command(
    *,
    board: kinds.Board,
    output: kinds.NewFile,
    square: kinds.Square | None = None,
    paper: Annotated[str, Kind(metavar="PAPER")] = "auto",
) -> None:
    """Draw a board to print at true scale: checkerboard, ChArUco board, circles or AprilGrid.

    Print it at 100 % ("actual size"), check the printed ruler, and glue the board to something flat and stiff. Choose
    one odd and one even number (9x6, 7x6): such a board looks different when it is turned by 180°.

    `kcal board measure` finds later how the printed board differs from this drawing.

    **Examples**

    `kcal board --board 9x6 --square 25mm --paper A4 -o board.pdf`

    `kcal board --board charuco:9x6 --square 25mm --paper A4 -o charuco.pdf`

    `kcal board --board 7x6 --square 50mm --paper A2 -o board.svg`

    `kcal board --board aprilgrid:6x6 --square 25mm --paper A4 -o april.pdf`

    `kcal board --board asymmetric:4x11 --square 20mm --paper A4 -o circles.pdf`

    Args:
        output: File to write, .svg or .pdf.
        paper: Size of the paper: A5, A4, A3, A2, A1, A0, letter, legal, tabloid, or auto for as large as needed.
    """
    from kcal.corners.print_board import board_sheet, to_pdf, to_svg

    suffix = output.suffix.lower()
    if suffix not in (".svg", ".pdf"):
        raise InputError(f"{output}: give a file name that ends in .svg or .pdf")
    pattern = kcal.Board.parse(board, square)
    sheet = board_sheet(pattern, paper)
    write_atomic(output, to_svg(sheet.drawing) if suffix == ".svg" else to_pdf(sheet.drawing))
    out.print(f"{output}: {pattern}, page {sheet.drawing.width:g}x{sheet.drawing.height:g} mm")
    if sheet.quiet < 1:
        white = (
            f"{sheet.quiet:.1f} squares"
            if pattern.pattern == "checkerboard"
            else f"{sheet.quiet * sheet.margin:.0f} mm"
        )
        out.print(f"note: only {white} of white around the board; keep the background light")
    if not pattern.unambiguous:
        out.print(f"note: this board looks the same turned by 180°; for stereo {pattern.stereo_advice}")


def measure_command(
    observations: list[kinds.Observed], *, output: kinds.NewFile, picture: kinds.Picture | None = None
) -> None:
    """Measure a printed board: how it bends, and how its print errs, each with its σ.

    Fits each camera and its board, as `kcal calibrate` does. Cameras that saw the same board share it, and measure it
    together; the evidence tells whether they did. Tilt and roll the board in many directions: without rolls, stretch
    and keystone of the board cannot be told from the camera's.

    **Examples**

    `kcal board measure left.obs.json right.obs.json -o plate.board.json --picture plate.png`

    Args:
        observations: Observations files of one or several cameras.
        output: Board file to write.
        picture: Heights as colors, print errors as arrows.
    """
    from kcal.calibrate.hybrid.cameras_fit import fit_cameras
    from kcal.report.calibration import board_figure, board_text

    sets = [kcal.Observations.load(path) for path in observations]
    names = [path.name.split(".")[0] for path in observations]
    if len(set(names)) < len(names):
        names = [str(path) for path in observations]
    with steps("measuring", 2 * len(sets) if len(sets) > 1 else 1) as advance:
        found = fit_cameras(sets, names=names, advance=advance)
    board = dataclasses.replace(found.boards[0], name=output.name.split(".")[0])
    kcal.calibrate.save_measured_board(board, output)
    if picture is not None:
        kcal.report.save_picture(picture, board_figure(board))
    out.print(f"{board.board}, {len(board.observations)} of {len(sets)} observations: {', '.join(board.observations)}")
    for line in board_text(board):
        out.print(f"  {line}")
    out.print(f"evidence against the board as ordered: {board.log_evidence:.0f} nats")
    for name, camera in zip(names, found.cameras, strict=True):
        if turned := int((camera.turns > 0).sum()):
            out.print(f"{name}: {turned} of {len(camera.turns)} views were read from another end of the board")
    if len(board.observations) > 1:
        least = min(camera.nats for camera in found.cameras if camera.board == 0)
        out.print(f"evidence that they saw one board: {least:.0f} nats")
    if len(found.boards) > 1:
        others = ", ".join(name for name, camera in zip(names, found.cameras, strict=True) if camera.board != 0)
        warn(
            f"these observations show {len(found.boards)} boards, not one: {output} is the board of "
            f"{', '.join(board.observations)}. Two prints of one pattern are two boards; measure {others} apart"
        )
    print_wrote(output, picture)


app.command("print", cls=Command)(declared(print_command))
app.command("measure", cls=Command)(declared(measure_command))
