"""`kcal batch`: many cameras at once, in parallel, continued after an interruption."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import kcal
from kcal.cli import kinds
from kcal.cli.console import err, out, print_table, print_wrote, steps
from kcal.cli.detect import given_board
from kcal.cli.options import Kind
from kcal.errors import DegenerateError

if TYPE_CHECKING:
    from kcal.calibrate.batch.results import SummaryRow


def batch_command(
    cameras: Path,
    *,
    output: kinds.Output,
    board: kinds.BoardOrAuto = "auto",
    square: kinds.Square | None = None,
    model: Annotated[str, Kind(metavar="NAME")] = "hybrid",
    refine: kinds.RefineMethod = kinds.Refine.erf,
    board_warp: bool = False,
    one_type: bool = False,
    workers: Annotated[int, Kind(least=0)] = 0,
    scheduler: Annotated[str | None, Kind(metavar="ADDRESS")] = None,
    time_limit: Annotated[float, Kind(metavar="S", least=1)] = 300.0,
) -> None:
    """Calibrate many cameras: images in, observations, camera files and one table out.

    Writes NAME.obs.json and NAME.camera.json for each camera, and summary.csv. Cameras that saw one printed board
    measure its errors together.

    Finished work is kept in a folder .work: the same command continues an interrupted run, and does only what is new
    when images, options or cameras were added. A camera or an image that fails is listed with its reason and does not
    stop the others; the exit code is then 1. Dask workers should have one thread each (--nthreads 1).

    **Examples**

    `kcal batch cameras/ --board 9x6 --square 25mm -o results`

    `kcal batch cameras.csv -o results --workers 4`

    `kcal batch /shared/cameras --board 9x6 --square 25mm -o /shared/results --scheduler tcp://10.0.0.1:8786`

    Args:
        cameras: A folder with a folder of images for each camera, or a CSV with the columns camera,images and, where
            they differ, board,square,model.
        output: Folder for the results; made if it is missing.
        model: Lens model, see `kcal calibrate`.
        board_warp: Also estimate how each board bends.
        one_type: The cameras, four or more, are of one type: each learns from the others.
        workers: Processes on this machine; one per core if 0.
        scheduler: Dask scheduler whose workers see the same files: tcp://host:8786.
        time_limit: Seconds of processor time for one image or one calibration.
    """
    from kcal.calibrate.batch.jobs import BatchOptions, pieces, read_jobs
    from kcal.calibrate.batch.results import calibrate_batch

    given = given_board(board, square)
    if model != "hybrid":
        kcal.lens.LensModel.named(model)
    with steps("looking at the images", None):
        jobs = read_jobs(cameras, given, model, square)
    if given is None:
        for job in jobs:
            if job.board is not None:
                out.print(f"{job.name}: board {job.board}")
    options = BatchOptions(refine=refine.value, board_warp=board_warp, one_type=one_type, time_limit=time_limit)
    try:
        with steps("images and cameras", pieces(jobs)) as advance:
            report = calibrate_batch(jobs, output, options, workers=workers, scheduler=scheduler, progress=advance)
    except KeyboardInterrupt:
        err.print("interrupted; what is finished is kept: run the same command to continue")
        raise typer.Exit(130) from None
    heads = ["camera", "views", "RMS px", "focal px", "± σ", "cx", "cy", "model", "note"]
    print_table([heads, *map(_cells, report.rows)], left=(0, 7, 8))
    out.print(f"{report.reused} of {report.total} pieces of work were there already")
    print_wrote(report.summary)
    failed = [row.camera for row in report.rows if row.error]
    if failed:
        raise DegenerateError(
            f"{len(failed)} of {len(report.rows)} cameras failed: {', '.join(failed[:5])}; see the table"
        )


def _cells(row: SummaryRow) -> list[str]:
    numbers = ["", "", "", "", ""]
    if row.rms is not None:
        spread = "" if row.sigma_focal is None else f"{row.sigma_focal:.3f}"
        numbers = [f"{row.rms:.4f}", f"{row.focal:.3f}", spread, f"{row.cx:.3f}", f"{row.cy:.3f}"]
    note = f"failed: {row.error}" if row.error else row.warnings
    return [row.camera, f"{row.views} of {row.images}", *numbers, row.model, note]
