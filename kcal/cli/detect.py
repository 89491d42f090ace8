"""`kcal detect`: images to an observations file."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from kcal.cli.console import out, steps
from kcal.files import check_writable


class Refine(StrEnum):
    """Names of the refinements, for the command line."""

    erf = "erf"
    saddle = "saddle"
    opencv = "opencv"
    skimage = "skimage"
    none = "none"


def detect(
    images: Annotated[
        list[str],
        typer.Argument(
            metavar="IMAGES", help="Images of one camera: files, folders or quoted wildcards.", show_default=False
        ),
    ],
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
    output: Annotated[Path, typer.Option("-o", "--output", help="Observations file to write.")],
    refine: Annotated[
        Refine, typer.Option("--refine", metavar="METHOD", help="erf (most accurate), saddle, opencv, skimage or none.")
    ] = Refine.erf,
) -> None:
    """Find the board in the images of one camera.

    Writes the corners of every view and the reason for every image that gave none. EXIF orientation is ignored: pixels
    count as the sensor wrote them. Only when no image shows the board is nothing written.

    **Examples**

    `kcal detect left/ --board 9x6 --square 25mm -o left.obs.json`

    `kcal detect left/ --board charuco:9x6:5x5_100:18mm --square 25mm -o left.obs.json`

    `kcal detect "shots/left*.png" --board 9x6 --square 25mm -o left.obs.json --refine opencv`
    """
    from kcal.corners.board import Board

    check_writable(output)
    board = Board.parse(size, square)

    from kcal.corners.detect import detect_images
    from kcal.corners.images import expand_images

    paths = expand_images(images)
    with steps("detecting", len(paths)) as advance:
        observations = detect_images(paths, board, refine.value, progress=lambda name: advance(escape(name)))
    observations.save(output)

    width, height = observations.image_size
    found, unseen = len(observations.views), sum(view.pixels.count(None) for view in observations.views)
    out.print(f"{escape(str(output))}: board found in {found} of {len(paths)} images of {width}x{height} px")
    if unseen:
        out.print(f"corners left out as uncertain: {unseen} of {found * board.corners}")
    for failure in observations.failures:
        out.print(f"  [yellow]failed[/] {escape(failure.name)}: {escape(failure.reason)}")
    if not board.unambiguous:
        out.print("note: this board looks the same turned by 180°; for stereo use one odd and one even number")
