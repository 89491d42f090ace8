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
        metavar="CxR",
        help="Inner corners, columns by rows: 9x6 has 10x7 squares; charuco:9x6[:DICTIONARY[:MARKER]].",
    ),
]
SquareSide: TypeAlias = Annotated[
    str, typer.Option("--square", metavar="LENGTH", help="Side of a square with its unit: 25mm, 2.5cm, 1in.")
]
RefineMethod: TypeAlias = Annotated[
    Refine, typer.Option("--refine", metavar="METHOD", help="erf (most accurate), saddle, opencv, skimage or none.")
]
