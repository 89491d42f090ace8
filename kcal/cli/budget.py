"""`kcal budget`: how far a rig can measure, before it is built or after."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcal.cli.console import out, print_table, print_wrote
from kcal.cli.inputs import RIG, PixelSigma, pixel_sigma_of
from kcal.cli.stars import print_star_budget
from kcal.errors import InputError
from kcal.files import check_picture
from kcal.texts import length_text, range_text

# Ranges in the table, if none are given.
_BASELINES = (10.0, 25.0, 50.0, 100.0, 250.0, 500.0)


def budget_command(
    rig: Annotated[
        Path | None, typer.Argument(help="Rig file; the planned rig of --focal and --baseline if not given."), RIG
    ] = None,
    focal: Annotated[float, typer.Option(metavar="PX", help="Focal length of the planned rig, pixels.")] = 1600.0,
    baseline: Annotated[
        float, typer.Option(metavar="M", help="Distance between the cameras of the planned rig, meters.")
    ] = 10.0,
    distances: Annotated[
        str | None,
        typer.Option(metavar="M,M,...", help="Ranges in the table, meters; 10 to 500 baselines if not given."),
    ] = None,
    pixel_sigma: PixelSigma = None,
    yaw: Annotated[float, typer.Option(metavar="DEG", help="Relative yaw error, degrees.", min=0)] = 0.01,
    baseline_error: Annotated[float, typer.Option(metavar="M", help="Baseline error, meters.", min=0)] = 0.001,
    timing: Annotated[float, typer.Option(metavar="S", help="Time between the two images, seconds.", min=0)] = 0.01,
    speed: Annotated[
        float, typer.Option(metavar="M/S", help="Speed of the target along the baseline, meters a second.", min=0)
    ] = 20.0,
    picture: Annotated[Path | None, typer.Option(help="PNG file to write: a plot of the errors.")] = None,
    stars: Annotated[bool, typer.Option("--stars", help="Also: how many stars, and what they give.")] = False,
    aperture: Annotated[
        float, typer.Option(metavar="MM", help="Of --stars: diameter of the lens's opening, focal length / f-number.")
    ] = 2.9,
    altitude: Annotated[
        float, typer.Option(metavar="DEG", help="Of --stars: of the middle of the image; 0 for a level camera.")
    ] = 0.0,
    clock_sigma: Annotated[
        float, typer.Option(metavar="S", help="Of --stars: of the offset between the cameras' clocks.", min=0)
    ] = 0.01,
) -> None:
    """Print range errors from disparity, relative yaw, baseline and timing, each alone, at several ranges.

    The errors are exact. One that makes the disparity smaller moves a far point much farther out than the same error
    of the other sign moves it in, and may move it beyond infinity. The last column is the first-order error, which the
    formula Z² Δd / (f B) gives.

    For a rig file with a covariance, a second table splits the standard deviation of ranges by what to improve: marks;
    lenses (better calibrated cameras); the relative pose, as it would be with exact lenses (better landmarks and far
    features). Errors of the mounting move points sideways and leave ranges as they are.

    **Examples**

    `kcal budget`

    `kcal budget --focal 2400 --baseline 4 --pixel-sigma 0.2 --picture budget.png`

    `kcal budget rig.json --distances 500,1000,2000`
    """
    import math

    from kcal.io.rig_file import load_rig
    from kcal.locate.budget import BudgetErrors, planned_rig, range_errors, range_sigmas, usual_ranges
    from kcal.report.tables import range_sigma_rows

    if picture is not None:
        check_picture(picture)
    chosen = planned_rig(focal_px=focal, baseline_m=baseline) if rig is None else load_rig(rig)
    noise = pixel_sigma_of(pixel_sigma, None if rig is None else chosen)
    disparity = math.sqrt(2.0) * noise
    errors = BudgetErrors(
        disparity_px=disparity, yaw_deg=yaw, baseline_m=baseline_error, timing_s=timing, speed_mps=speed
    )
    try:
        far = [float(value) for value in distances.split(",")] if distances else usual_ranges(chosen, _BASELINES)
    except ValueError:
        raise InputError(f"distances {distances!r}: write numbers of meters, for example 250,1000,5000") from None
    labels = {
        "disparity": f"disparity {disparity:.3g} px",
        "yaw": f"relative yaw {yaw:g}°",
        "baseline": f"baseline {range_text(baseline_error)}",
        "timing": f"{1000 * timing:g} ms apart at {speed:g} m/s",
    }
    found = range_errors(chosen, far, errors)
    if rig is None:
        out.print(f"planned rig: f {focal:g} px, baseline {baseline:g} m, f B {focal * baseline:g} px m")
    else:
        out.print(f"{rig}: baseline {length_text(float(chosen.baseline), digits=6)}", markup=False)
    rows = [["range", "error", "nearer", "farther", "first order"]]
    for i, distance in enumerate(far):
        for name, error in found.items():
            cells = (length_text(float(value[i]), sign=True) for value in error)
            rows.append([range_text(distance), labels[name], *cells])
    print_table(rows, left=(1,))
    if chosen.covariance is not None:
        out.print(f"\nWhat the rig file knows, and {noise:g} px of noise in each mark:")
        print_table(range_sigma_rows(range_sigmas(chosen, far, pixel_sigma=noise)))
    if stars:
        print_star_budget(
            float(chosen.left.params[0]), chosen.left.size, float(chosen.baseline), 5000.0, aperture, altitude,
            clock_sigma,
        )  # fmt: skip
    if picture is not None:
        from kcal.report.positions import plotted_ranges, save_budget_picture

        sweep = plotted_ranges(far)
        save_budget_picture(picture, sweep, range_errors(chosen, sweep, errors), labels)
    print_wrote(picture)
