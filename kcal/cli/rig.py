"""Solve a rig from two cameras and what both have seen (`kcal rig`)."""

from __future__ import annotations

import datetime
import itertools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

import kcal
from kcal.cli import kinds
from kcal.cli.console import out, print_label, print_styled, print_table, print_wrote, warn
from kcal.cli.inputs import pixel_sigma_and_source, pixel_sigma_of
from kcal.cli.options import Command, Kind, Rare, declared, group_with_default
from kcal.cli.rig_options import Sources
from kcal.cli.stations import solve_and_write
from kcal.errors import InputError
from kcal.files import check_writable, write_atomic

if TYPE_CHECKING:
    from kcal.watch.turned import Drift


app = typer.Typer(cls=group_with_default("solve"), rich_markup_mode="markdown", help="Solve a rig, and check it later.")


def solve_command(
    left: kinds.CalibratedCamera,
    right: kinds.CalibratedCamera,
    others: list[kinds.CalibratedCamera] | None = None,
    *,
    output: kinds.NewFile,
    sources: Sources,
    require: kinds.Needs | None = None,
    report: Annotated[Path, Kind(writes=True)] | None = None,
    intrinsics: Rare[Literal["prior", "fixed", "free"]] = "prior",
    keep_all: Rare[bool] = False,
    board_warp: Rare[bool] = False,
    picture: Rare[kinds.Picture | None] = None,
) -> None:
    """Solve a rig: where the right camera stands from the left, and where both, or any number, stand on the Earth.

    From boards seen by both cameras, surveyed landmarks, far features, a measured baseline and measured camera
    positions: any of them, or all together in one adjustment. What contradicts the rest is left out and named. Boards
    are paired by name (left01.jpg with right01.jpg) or by a CSV; one that was read from its other end is turned.

    The cameras are refined within what their calibrations know of lenses and board. The table at the end splits the σ
    of ranges by what to improve: marks; lenses (more views of the board, near the image's borders); relative pose
    (landmarks and far features, which determine the yaw better than boards do: 0.01° of it is 436 m at 5 km with a
    baseline of 10 m).

    Stars (--stars) need no survey: pairs of night images and a taped baseline determine ranges once matches of unknown
    range (--features) or measured positions tell the baseline's direction.

    So does the scene itself (--scene): pairs of images, best of several days, and a taped baseline. Drones with RTK,
    ships with AIS and aircraft with ADS-B (--tracks) are landmarks that move. The skyline and a raster of the terrain
    (--skyline, --terrain) tell how the cameras look on the Earth.

    `kcal rig check` tells later whether the cameras have turned since.

    Three cameras and more may stand kilometers apart and see different points: each needs four landmarks or more, of
    its own or in common, and measured positions (--positions, by the cameras' names) help.

    For one camera that is moved from place to place, give its file once for each place. Its lens is then the same
    unknown at all of them. What several places see must stand still in between. Two places are left and right; tables
    with a column `camera` name them by the file, as in mast-1 and mast-2.

    **Examples**

    `kcal rig left.camera.json right.camera.json --pairs left.obs.json right.obs.json -o rig.json`

    `kcal rig left.camera.json right.camera.json --landmarks survey.csv --marks marks.csv --features far.csv
    --baseline 10.02±0.005 -o rig.json --require 5km:10% --report rig.html`

    `kcal rig mill.camera.json mast.camera.json church.camera.json --landmarks survey.csv --marks marks.csv -o rig.json`

    Args:
        left: Camera file of the left camera.
        right: Camera file of the right camera.
        others: More cameras; each is named by its file, up to the first dot.
        output: Rig file to write.
        require: What you need: ranges and the largest σ of each, for example 5km:10% or 800m:20m,5km:10%. Exit code 3
            if it is not met.
        report: HTML page to write: may it be used, and why not.
        intrinsics: Refine the cameras within what their calibrations know, hold them as if they were exact, or let
            them free.
        keep_all: Leave nothing out; only warn.
        board_warp: Also estimate how the board bends.
        picture: a plan, and residuals.
    """
    pixel_sigma_and_source(sources.pixel_sigma)
    if not sources.given:
        raise typer.BadParameter("give boards (--pairs), landmarks (--landmarks and --marks) or features (--features)")
    options = kcal.RigOptions(
        intrinsics=intrinsics, board_warp=board_warp, reject=not keep_all, refraction=sources.refraction.value,
        refraction_sigma=sources.refraction_sigma,
    )  # fmt: skip
    paths = [left, right, *(others or [])]
    solve_and_write(paths, sources, options, output, needs=require or (), report=report, picture=picture)


app.command("solve", hidden=True, cls=Command)(declared(solve_command))


# Check whether the cameras of a rig have turned, and correct the rig file (`kcal rig check`).

# The exit code of a rig that has turned, apart from errors (1) and wrong usage (2).
DRIFTED = 3


def check(
    rig: kinds.RigFile,
    *,
    marks: kinds.Marks,
    reference: kinds.Marks | None = None,
    landmarks: kinds.Survey | None = None,
    pixel_sigma: kinds.PixelSigma | None = None,
    relock: Path | None = None,
) -> None:
    """Check whether the cameras have turned since the rig was solved, and what that does to ranges.

    Needs points that do not move, marked in new images: either the same points as in old images (`--reference`; what
    they are and how far away does not matter, and errors of the calibration cancel), or surveyed places (`--landmarks`;
    the rig must have been solved with some). Forty features marked to 0.1 px determine the yaw to a thousandth of a
    degree. Points that moved are left out and named.

    With `--relock rig.json` a rig with the present attitudes is written, if these have changed beyond chance. It may be
    the same file: the old one is kept beside it.

    The exit code is 3 if a camera has turned beyond chance, relocked or not; 0 if none has; 1 if that could not be
    measured.

    **Examples**

    `kcal rig check rig.json --reference then.csv --marks now.csv`

    `kcal rig check rig.json --landmarks survey.csv --marks now.csv --relock rig.json`

    Args:
        rig: Rig file from `kcal rig`.
        marks: Marks in new images: name,left_u,left_v,right_u,right_v.
        reference: The same static points, marked in images from when the rig was solved.
        landmarks: Surveyed places among the marks, as for `kcal rig`.
        relock: Rig file to write if it has turned; an old one of that name is kept.
    """
    from kcal.io.rig_file import load_pair
    from kcal.watch.turned import seen_again

    if reference is None and landmarks is None:
        raise InputError("give --reference (marks of the same points in old images) or --landmarks (a survey)")
    if reference is not None and landmarks is not None:
        raise InputError("give --reference or --landmarks, not both: with old marks no survey is needed")
    if relock is not None:
        check_writable(relock, marks, *filter(None, (reference, landmarks)))
    old = load_pair(rig)
    noise = pixel_sigma_of(pixel_sigma, old)
    now = kcal.locate.read_marks(marks, single=True)
    features = None if reference is None else seen_again(kcal.locate.read_marks(reference, single=True), now, noise)
    surveyed = None if landmarks is None else _landmarks(old, landmarks, now, noise)
    drift = kcal.rig.check_rig(old, features=features, landmarks=surveyed)
    print_turns(drift, f"{sum(item.used for item in drift.items)} of {len(drift.items)}")
    _print_effect(drift)
    for item in drift.left_out:
        print_label("left out", f"{item.name}: {item.reason}")
    if drift.variance > 1:
        times = f"{drift.variance**0.5:.1f} times"
        warn(f"residuals are {times} as large as the marks' noise says; sigmas were multiplied by that")
    if drift.significant:
        print_styled("the relative attitude has changed beyond chance: ranges by the old rig are wrong", "changed")
    else:
        out.print("no change of the relative attitude beyond chance")
    if drift.left_significant:
        print_styled("the left camera has turned beyond chance: directions by the old rig are wrong", "turned")
    if not (drift.significant or drift.left_significant):
        if relock is not None:
            out.print("nothing was written")
        return
    if relock is not None:
        replace_rig(relock, drift.relocked(f"{now_stamp()}, from {marks.name}"))
    raise typer.Exit(DRIFTED)


def _landmarks(rig: kcal.Rig, path: Path, now: kcal.locate.Marks, sigma: float) -> kcal.Landmarks:
    from kcal.locate.survey import read_survey

    if rig.mounting is None:
        raise InputError("the rig file does not say where the rig stands; solve it with landmarks, or use --reference")
    return kcal.rig.match_landmarks(read_survey(path, rig.mounting.origin), now, now.sigmas(sigma)).landmarks


def print_turns(drift: Drift, used: str = "") -> None:
    """Print what has turned by how much, and of how many points that was found, if that is known."""
    rows = [["turn of", "pitch °", "yaw °", "roll °", *(["used"] if used else [])]]
    for name, turn, covariance in drift.turns:
        both = zip(turn.tolist(), covariance.diagonal().sqrt().tolist(), strict=True)
        cells = [f"{math.degrees(value):+z.5f} ± {math.degrees(sigma):.5f}" for value, sigma in both]
        rows.append([name, *cells, *([used] if used else [])])
    print_table(rows, left=range(len(rows[0])))


def _print_effect(drift: Drift) -> None:
    for distance, found, sigma in zip(*(value.tolist() for value in drift.effect()), strict=True):
        shift = "infinity" if math.isinf(found) else f"{found:.1f} m ({found - distance:+z.1f} ± {sigma:.1f} m)"
        out.print(f"with the old rig a target at {distance:g} m is found at {shift}")


def now_stamp() -> str:
    """The time, for names of files."""
    return datetime.datetime.now(datetime.UTC).strftime("%Y%m%dT%H%M%SZ")


def replace_rig(path: Path, new: kcal.Rig) -> None:
    """Write a corrected rig; a file of that name is kept beside it."""
    # The old one first: whatever happens in between, there is a good rig.
    if path.exists():
        numbers = itertools.chain([""], itertools.count(-2, -1))
        names = (path.with_name(f"{path.stem}.before-{now_stamp()}{more}{path.suffix}") for more in numbers)
        kept = next(name for name in names if not name.exists())
        write_atomic(kept, path.read_bytes())
        out.print(f"kept the old rig as {kept}")
    kcal.save_rig(new, path)
    print_wrote(path)


app.command("check", cls=Command)(declared(check))
