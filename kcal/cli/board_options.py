"""Options of several commands that look for a board."""

from __future__ import annotations

from enum import StrEnum
from typing import Annotated, TypeAlias

import typer


class Refine(StrEnum):
    """Names of the refinements, for the command line."""

    erf = "erf"
    saddle = "saddle"
    opencv = "opencv"
    skimage = "skimage"
    none = "none"


BoardSize: TypeAlias = Annotated[
    str,
    typer.Option(
        "--board",
        metavar="BOARD",
        help="Inner corners, columns by rows: 9x6 has 10x7 squares; charuco:9x6[:DICTIONARY][:MARKER]; circles:7x6; "
        "asymmetric:4x11; aprilgrid:6x6[:SPACING]; or a target file of Kalibr, april.yaml.",
    ),
]
SquareSide: TypeAlias = Annotated[
    str | None,
    typer.Option(
        "--square",
        metavar="LENGTH",
        help="Side of a square or tag, or distance of circles (of rows of asymmetric ones), with its unit: 25mm, "
        "2.5cm, 1in. Not with a target file.",
        show_default=False,
    ),
]
RefineMethod: TypeAlias = Annotated[
    Refine, typer.Option("--refine", metavar="METHOD", help="erf (most accurate), saddle, opencv, skimage or none.")
]
