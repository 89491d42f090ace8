"""Check whether the cameras of a rig have turned, and correct the rig file (`kcal rig check`)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kcal.cli.console import err, out, print_table, print_wrote, warn
from kcal.cli.inputs import MARKS, RIG, SURVEY, PixelSigma, pixel_sigma_of
from kcal.errors import InputError
from kcal.files import check_writable, write_atomic

if TYPE_CHECKING:
    from kcal.calibrate.rig.drift import Drift
    from kcal.calibrate.rig.sources import Landmarks
    from kcal.lens.rig import StereoRig
    from kcal.locate.marks import Marks

# The exit code of a rig that has turned, apart from errors (1) and wrong usage (2).
DRIFTED = 3


def check(
    rig: Annotated[Path, typer.Argument(help="Rig file from `kcal rig`."), RIG],
    marks: Annotated[
        Path, typer.Option(metavar="CSV", help="Marks in new images: name,left_u,left_v,right_u,right_v."), MARKS
    ],
    reference: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="The same static things, marked in images from when the rig was solved."),
        MARKS,
    ] = None,
    landmarks: Annotated[
        Path | None, typer.Option(metavar="CSV", help="Surveyed places among the marks, as for `kcal rig`."), SURVEY
    ] = None,
    pixel_sigma: PixelSigma = None,
    relock: Annotated[
        bool,
        typer.Option("--relock", help="If it has turned, write the corrected rig in its place; the old one is kept."),
    ] = False,
) -> None:
    """Check whether the cameras have turned since the rig was solved, and what that does to ranges.

    Needs things that do not move, marked in new images: either the same things as in old images (`--reference`; what
    they are and how far away does not matter, and errors of the calibration cancel), or surveyed places (`--landmarks`;
    the rig must have been solved with some). Forty features marked to 0.1 px determine the yaw to a thousandth of a
    degree. Things that moved are left out and named.

    With `--relock` the rig file is replaced by one with the present attitudes, if these have changed beyond chance; the
    old one is kept beside it.

    The exit code is 3 if a camera has turned beyond chance, relocked or not; 0 if none has; 1 if that could not be
    measured.

    **Examples**

    `kcal rig check rig.json --reference then.csv --marks now.csv`

    `kcal rig check rig.json --landmarks survey.csv --marks now.csv --relock`
    """
    from kcal.io.rig_file import load_rig
    from kcal.locate.marks import read_marks
    from kcal.locate.monitor import check_rig, seen_again

    if reference is None and landmarks is None:
        raise InputError("give --reference (marks of the same things in old images) or --landmarks (a survey)")
    if reference is not None and landmarks is not None:
        raise InputError("give --reference or --landmarks, not both: with old marks no survey is needed")
    if relock:
        check_writable(rig, marks, *(path for path in (reference, landmarks) if path is not None))
    old = load_rig(rig)
    noise = pixel_sigma_of(pixel_sigma, old)
    now = read_marks(marks, single=True)
    features = None if reference is None else seen_again(read_marks(reference, single=True), now, noise)
    surveyed = None if landmarks is None else _landmarks(old, landmarks, now, noise)
    drift = check_rig(old, features=features, landmarks=surveyed)
    _print_turns(old, drift)
    for item in drift.left_out:
        err.print("[yellow]left out:[/]", f"{item.name}: {item.reason}")
    if drift.variance > 1:
        times = f"{drift.variance**0.5:.1f} times"
        warn(f"residuals are {times} as large as the marks' noise says; sigmas were multiplied by that")
    if drift.significant:
        out.print("the relative attitude has [bold]changed[/] beyond chance: ranges by the old rig are wrong")
    else:
        out.print("no change of the relative attitude beyond chance")
    if drift.left_significant:
        out.print("the left camera has [bold]turned[/] beyond chance: directions by the old rig are wrong")
    if not (drift.significant or drift.left_significant):
        if relock:
            out.print("nothing was written")
        return
    if relock:
        kept = _relock(rig, old, drift, marks)
        out.print(f"kept the old rig as {kept}", markup=False)
        print_wrote(rig)
    raise typer.Exit(DRIFTED)


def _landmarks(rig: StereoRig, path: Path, now: Marks, sigma: float) -> Landmarks:
    from kcal.locate.survey import match_landmarks, read_survey

    if rig.mounting is None:
        raise InputError("the rig file does not say where the rig stands; solve it with landmarks, or use --reference")
    return match_landmarks(read_survey(path, rig.mounting.origin), now, now.sigmas(sigma)).landmarks


def _print_turns(rig: StereoRig, drift: Drift) -> None:
    import math

    from kcal.locate.monitor import drift_effect

    rows = [["turn of", "pitch °", "yaw °", "roll °", "used"]]
    used = f"{sum(item.used for item in drift.items)} of {len(drift.items)}"
    parts = [
        ("left camera", drift.left, drift.left_covariance),
        ("right camera", drift.right, drift.right_covariance),
        ("right from left", drift.relative, drift.relative_covariance),
    ]
    for name, turn, covariance in parts:
        if turn is None or covariance is None:
            continue
        sigma = covariance.diagonal().sqrt()
        cells = [
            f"{math.degrees(value):+z.5f} ± {math.degrees(spread):.5f}"
            for value, spread in zip(turn.tolist(), sigma.tolist(), strict=True)
        ]
        rows.append([name, *cells, used])
    print_table(rows, left=range(len(rows[0])))
    effect = drift_effect(rig, drift.rig, drift.relative_covariance)
    for distance, found, sigma in zip(*(value.tolist() for value in effect), strict=True):
        shift = "infinity" if math.isinf(found) else f"{found:.1f} m ({found - distance:+z.1f} ± {sigma:.1f} m)"
        out.print(f"with the old rig a target at {distance:g} m is found at {shift}")


def _relock(path: Path, old: StereoRig, drift: Drift, marks: Path) -> Path:
    """Replace the rig file; returns where the old one is kept."""
    import datetime

    from kcal.io.rig_file import save_rig
    from kcal.locate.monitor import relocked

    stamp = datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%SZ")
    kept = path.with_name(f"{path.stem}.before-{stamp}{path.suffix}")
    number = 1
    while kept.exists():
        number += 1
        kept = path.with_name(f"{path.stem}.before-{stamp}-{number}{path.suffix}")
    new = relocked(old, drift, f"{stamp}, from {marks.name}")
    # The old one first: whatever happens in between, there is a good rig.
    write_atomic(kept, path.read_bytes())
    save_rig(new, path)
    return kept
