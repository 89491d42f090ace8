"""`kcal compare`: how well lens models predict views that were held out."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcal.cli.console import out, print_table, steps, warn
from kcal.cli.inputs import OBSERVATIONS
from kcal.errors import InputError
from kcal.quantities import number_text


def compare_command(
    observations: Annotated[Path, typer.Argument(help="Observations file from `kcal detect`."), OBSERVATIONS],
    models: Annotated[list[str] | None, typer.Argument(metavar="[MODEL]...", help="More models.")] = None,
    model: Annotated[
        list[str] | None, typer.Option(metavar="NAME", help="Models to compare, for example hybrid opencv5 opencv14.")
    ] = None,
    groups: Annotated[
        str, typer.Option(metavar="KIND", help="Hold out blocks of views together, or views one by one.")
    ] = "blocks",
    parts: Annotated[int, typer.Option(min=2, help="Number of times that a part of the groups is held out.")] = 5,
) -> None:
    """Compare lens models on views that were held out. A tool for research: calibrating needs no model to choose.

    Every model is fitted without a part of the views, and its RMS is measured on these, with only the board's poses
    solved again. The standard error of each difference tells what the capture can decide.

    **Example**

    `kcal compare left.obs.json --model hybrid opencv5 opencv14`
    """
    if groups not in ("blocks", "views"):
        raise InputError(f"--groups {groups}: write blocks or views")
    names = [*(model or []), *(models or [])]
    if not names:
        raise InputError("name the models to compare, for example --model hybrid opencv5 opencv14")

    from kcal.calibrate.camera.compare import compare_models
    from kcal.corners.observations import Observations

    seen = Observations.load(observations)
    with steps("comparing", parts * len(names)) as advance:
        result = compare_models(
            seen, names, groups="views" if groups == "views" else "blocks", parts=parts, progress=advance
        )
    count = len(result.corners)
    out.print(f"{len(seen.views)} views; held out in {count} groups, {parts} parts; RMS per corner")
    ranking = sorted(result.rms.items(), key=lambda entry: entry[1])
    best = ranking[0][0]
    rows = [["model", "held-out RMS, px", "more than the best, px", "± standard error"]]
    for name, rms in ranking:
        more, error = result.difference(name, best)
        cells = ["", ""] if name == best else [number_text(more, error), number_text(error, error)]
        rows.append([name, number_text(rms, digits=4), *cells])
    print_table(rows)
    for name, reason in result.failures.items():
        warn(f"{name} could not be fitted to some of the views: {reason}")
