"""`kcal budget`: how far a rig can measure, before it is built or after."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from kcal.locate.budget import RangeError


def budget(
    rig: Annotated[Path | None, typer.Argument(help="A calibrated rig; without one, the planned rig below.")] = None,
    focal: Annotated[float, typer.Option(metavar="PX", help="Of the planned rig: focal length in pixels.")] = 1600.0,
    baseline: Annotated[float, typer.Option(metavar="M", help="Of the planned rig: distance of the cameras.")] = 10.0,
    distances: Annotated[
        str, typer.Option(metavar="M,M,...", help="Ranges for the table.")
    ] = "100,250,500,1000,2500,5000",
    disparity: Annotated[float, typer.Option(metavar="PX", help="Error of the match.", min=0)] = 0.1,
    yaw: Annotated[float, typer.Option(metavar="DEG", help="Error of the relative yaw.", min=0)] = 0.01,
    baseline_error: Annotated[float, typer.Option(metavar="M", help="Error of the baseline.", min=0)] = 0.001,
    timing: Annotated[float, typer.Option(metavar="S", help="Time between the two images.", min=0)] = 0.01,
    speed: Annotated[float, typer.Option(metavar="M/S", help="Of the target, along the baseline.", min=0)] = 20.0,
    picture: Annotated[Path | None, typer.Option(help="A .png file for the plot.")] = None,
) -> None:
    """Range errors against distance: by disparity, relative yaw, baseline and timing, each alone.

    Exact, not to first order: an error that makes the disparity smaller moves a far point much farther out than the
    same error of the other sign moves it in, and may move it beyond infinity. The last column is the slope, which is
    what the formula Z² Δd / (f B) gives.

    **Examples**

    `kcal budget`

    `kcal budget --focal 2400 --baseline 4 --disparity 0.2 --picture budget.png`

    `kcal budget rig.json --distances 500,1000,2000`
    """
    import math

    import torch

    from kcal.cli.console import out
    from kcal.errors import InputError
    from kcal.files import check_writable
    from kcal.io.rig_file import load_rig
    from kcal.locate.budget import BudgetErrors, planned_rig, range_errors
    from kcal.report.budget import save_budget_picture
    from kcal.report.figures import check_picture_format

    if picture is not None:
        check_picture_format(picture)
        check_writable(picture)
    try:
        far = [float(value) for value in distances.split(",")]
    except ValueError:
        raise InputError(f"distances {distances!r}: write numbers of meters, for example 250,1000,5000") from None
    errors = BudgetErrors(
        disparity_px=disparity, yaw_deg=yaw, baseline_m=baseline_error, timing_s=timing, speed_mps=speed
    )
    chosen = planned_rig(focal_px=focal, baseline_m=baseline) if rig is None else load_rig(rig)
    labels = {
        "disparity": f"disparity {disparity:g} px",
        "yaw": f"relative yaw {yaw:g}°",
        "baseline": f"baseline {1000 * baseline_error:g} mm",
        "timing": f"{1000 * timing:g} ms apart at {speed:g} m/s",
    }
    found = range_errors(chosen, far, errors)
    if rig is None:
        out.print(f"planned rig: f {focal:g} px, baseline {baseline:g} m, f B {focal * baseline:g} px m")
    else:
        out.print(f"{rig}: baseline {float(chosen.baseline):g} m", markup=False)
    for line in _table(far, found, labels):
        out.print(line, markup=False)
    if picture is not None:
        sweep = torch.logspace(math.log10(min(far)), math.log10(max(far)), 121, dtype=torch.float64)
        # The ends themselves, which rounding of the logarithm may push out of view.
        sweep = sweep.clamp(min(far), max(far))
        if len(far) < 2:
            raise InputError("distances: two at least are needed for a plot")
        save_budget_picture(picture, sweep, range_errors(chosen, sweep, errors), labels)
        out.print(f"wrote {picture}", markup=False)


def _table(far: list[float], found: dict[str, RangeError], labels: dict[str, str]) -> list[str]:
    rows = [["range m", "error", "nearer m", "farther m", "first order m"]]
    for i, distance in enumerate(far):
        for name, error in found.items():
            values = (_meters(float(value[i])) for value in error)
            rows.append([f"{distance:g}", labels[name], *values])
    widths = [max(len(row[column]) for row in rows) for column in range(5)]
    lines = []
    for first, name, *numbers in rows:
        cells = [first.rjust(widths[0]), name.ljust(widths[1])]
        cells += [number.rjust(width) for number, width in zip(numbers, widths[2:], strict=True)]
        lines.append("  ".join(cells))
    return lines


def _meters(value: float) -> str:
    if value == float("inf"):
        return "∞"
    return f"{value:+.3f}" if abs(value) < 1 else f"{value:+.2f}" if abs(value) < 100 else f"{value:+.1f}"
