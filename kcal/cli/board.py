"""`kcal board`: a board to print."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcal.cli.console import out
from kcal.errors import InputError
from kcal.files import check_writable, write_atomic


def board_command(
    size: Annotated[
        str,
        typer.Option(
            "--board",
            metavar="CxR",
            help="Inner corners, columns by rows: 9x6 has 10x7 squares; charuco:9x6[:DICTIONARY[:MARKER]].",
        ),
    ],
    square: Annotated[
        str, typer.Option("--square", metavar="LENGTH", help="Side of a square with its unit: 25mm, 2.5cm, 1in.")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="File to write, .svg or .pdf.")],
    page: Annotated[
        str,
        typer.Option(
            "--page",
            metavar="PAGE",
            help="Page size: A5, A4, A3, A2, A1, A0, letter, legal, tabloid, or auto for as large as needed.",
        ),
    ] = "auto",
) -> None:
    """Draw a checkerboard or a ChArUco board to print at true scale.

    Print it at 100 % ("actual size"), check the printed ruler, and glue the board to something flat and stiff. Choose
    one odd and one even number (9x6, 7x6): such a board looks different when it is turned by 180°.

    **Examples**

    `kcal board --board 9x6 --square 25mm --page A4 -o board.pdf`

    `kcal board --board charuco:9x6 --square 25mm --page A4 -o charuco.pdf`

    `kcal board --board 7x6 --square 50mm --page A2 -o board.svg`
    """
    from kcal.corners.board import Board
    from kcal.corners.drawing import to_pdf, to_svg
    from kcal.corners.print_board import board_sheet

    suffix = output.suffix.lower()
    if suffix not in (".svg", ".pdf"):
        raise InputError(f"{output}: give a file name that ends in .svg or .pdf")
    pattern = Board.parse(size, square)
    sheet = board_sheet(pattern, page)
    check_writable(output)
    write_atomic(output, to_svg(sheet.drawing) if suffix == ".svg" else to_pdf(sheet.drawing))
    out.print(f"{output}: {pattern}, page {sheet.drawing.width:g}x{sheet.drawing.height:g} mm")
    if sheet.quiet < 1:
        out.print(f"note: only {sheet.quiet:.1f} squares of white around the board; keep the background light")
    if not pattern.unambiguous:
        out.print("note: this board looks the same turned by 180°; for stereo use one odd and one even number")
