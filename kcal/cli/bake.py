"""`kcal bake`: a camera as lookup tables."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcal.cli.console import out, print_wrote, steps
from kcal.cli.inputs import CAMERA
from kcal.files import check_writable


def bake_command(
    camera: Annotated[Path, typer.Argument(help="Camera file from `kcal calibrate`.", show_default=False), CAMERA],
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="FILE", help="File to write, .npz; beside the camera file if not given."
        ),
    ] = None,
    tolerance: Annotated[
        float, typer.Option("--tolerance", min=1e-8, help="Largest allowed error in pixels, in both directions.")
    ] = 1e-3,
) -> None:
    """Turn a camera into lookup tables, for programs without lens models.

    Writes one .npz file with two bicubic tables, pixels to rays and rays to pixels, as coarse as the tolerance allows.
    `kcal/io/lookup_file.py` explains the arrays and how to read them with numpy alone.

    **Example**

    `kcal bake left.camera.json --tolerance 0.001 -o left.npz`
    """
    name = camera.name.removesuffix(".json").removesuffix(".camera")
    path = check_writable(output or camera.with_name(f"{name}_lookup.npz"), camera)

    from kcal.cli.camera_sources import calibrated_camera
    from kcal.io.lookup_file import save_lookup
    from kcal.lens.baking import bake

    with steps("baking", None):
        lookup = bake(calibrated_camera(camera), tolerance)
    save_lookup(lookup, path)
    for which, table, bound, coverage in zip(
        ("pixels to rays", "rays to pixels"),
        (lookup.chart_from_pixels, lookup.pixels_from_chart),
        lookup.bound[::-1],
        lookup.coverage[::-1],
        strict=True,
    ):
        rows, columns = table.cells.shape
        lost = "" if coverage == 1.0 else f"; answers for {coverage:.1%} of the image's valid pixels"
        out.print(f"{which}: {columns} x {rows} cells, error at most {bound:.1e} px{lost}")
    print_wrote(path)
