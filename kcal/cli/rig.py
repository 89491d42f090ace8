"""Rigs of any number of cameras: solved, checked later, and placed by poses that are known, for `kcal rig`."""

from __future__ import annotations

import dataclasses
import datetime
import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer

import kcal
import kcal.cli.rig_sources as rig_sources
from kcal.cli import console, kinds, rooms
from kcal.cli.console import aligned, err, out, print_label, print_styled, print_table, print_wrote, steps, tell, warn
from kcal.cli.inputs import pixel_sigma_and_source, pixel_sigma_of
from kcal.cli.options import Kind, Only, Rare, Several
from kcal.cli.report import NO, judged_rig, told_usable, warned_of
from kcal.cli.rig_sources import Sources
from kcal.errors import InputError
from kcal.files import check_writable, write_atomic
from kcal.texts import length_text, measured_length, measured_text, number_text
from kcal.values import WithSigma

# What `kcal rig` prints of a solved rig.

# Items of a source that are named when they are left out; of thousands of matches more are no news.
_MOST_NAMED = 12


def source_lines(result: rooms.RigResult) -> list[str]:
    """Residuals by source."""
    rows = [["source", "used", "left out", "RMS px", "RMS", "sigmas"]]
    for source in result.sources:
        pixels = "" if source.rms_px is None else f"{source.rms_px:.4f}"
        length = "" if source.rms_m is None else length_text(source.rms_m)
        sigmas = "" if source.sigmas is None else f"{source.sigmas:.2f}"
        rows.append([source.name, f"{source.used}", f"{source.left_out}", pixels, length, sigmas])
    return aligned(rows)


def rig_lines(result: rooms.RigResult, rig: kcal.Rig, unpaired: int) -> list[str]:
    """What a result says: residuals by source, the relative pose with its sigmas, the board's squares, the mounting."""
    lines = source_lines(result)
    boards, mounting = result.data.boards, rig.mounting
    lines += [
        f"RMS {result.rms:.4f} px (left {result.rms_px[0]:.4f}, right {result.rms_px[1]:.4f}); {result.status.message}",
        f"baseline {measured_length(float(rig.baseline), result.sigma_baseline)}",
    ]
    if result.exact:
        lines.append(_exact_line(result, rig))
    if boards is not None:
        lines.append(f"{len(result.pairs)} of {len(boards.names)} pairs used, {unpaired} views without partner")
        if result.pairs:
            board = boards.board
            side, spread = rooms.triangulated_sides(rig, board.columns, board.rows, result.pixels, board.points)
            true = float((board.points[1] - board.points[0]).norm())
            what = {"checkerboard": "squares", "aprilgrid": "tags"}.get(board.pattern, "distances of circles")
            lines.append(
                f"triangulated {what}: {measured_length(side, spread)}, the board's are {length_text(true, digits=4)}"
            )
    if result.board_warp is not None:
        x, y = (1e3 * result.board_warp).tolist()
        lines.append(f"board warp: {x:+.3f} mm along its rows, {y:+.3f} mm along its columns")
    if mounting is not None and mounting.covariance is not None:
        sigma = mounting.covariance.diagonal().sqrt().tolist()
        place, level = mounting.origin, math.degrees(max(sigma[3:5]))
        heading = measured_text(mounting.heading_deg, math.degrees(sigma[5]))
        pitch, roll = number_text(mounting.pitch_deg, level), number_text(mounting.roll_deg, level)
        lines.append(
            f"left camera at {place.lat:.7f}, {place.lon:.7f}, {number_text(place.height, sigma[2])} m above the "
            f"ellipsoid (± {length_text(max(sigma[:2]), digits=2)} level, {length_text(sigma[2], digits=2)} up), "
            f"heading {heading}°, pitch {pitch}°, roll {roll}°"
        )
        if result.data.landmarks is not None:
            lines.append(f"refraction of light {measured_text(mounting.refraction, sigma[6])} of the Earth's curvature")
    return lines


def _exact_line(result: rooms.RigResult, rig: kcal.Rig) -> str:
    """Which cameras were taken as exact, what an error of their lenses does, and which files had no error bars."""
    far, share = 100.0 * float(rig.baseline), 10.0 / float(rig.left.focal.mean())
    text = (
        f"taken as exact, so that errors of these lenses are in no σ: {' and '.join(result.exact)}. An error of 0.1 px "
        f"in one of them is {number_text(100.0 * share, digits=2)} % of a range of {length_text(far, digits=2)}"
    )
    cameras = dict(zip(result.names, result.data.cameras, strict=True))
    bare = [name for name in result.exact if (one := cameras[name].calibration) is None or one.covariance is None]
    if not bare:
        return text
    return f"{text}. Without error bars came {' and '.join(bare)}: calibrate with kcal, or import a file that has them"


def print_rig(result: rooms.RigResult, lines: list[str]) -> None:
    """Print the lines of a result, and what was turned, left out and should be doubted."""
    for line in lines:
        print_styled(line, r"(?<=^RMS )\S+ px|(?<=^baseline ).+")
    for turned in result.flipped:
        out.print(f"turned by 180°: {turned.board} ({turned.camera}; the board was read from its other end)")
    for source in dict.fromkeys(item.source for item in result.left_out):
        gone = [item for item in result.left_out if item.source == source]
        for item in gone[:_MOST_NAMED]:
            print_label("left out", f"{item.label}: {item.reason}")
        if len(gone) > _MOST_NAMED:
            print_label("left out", f"{len(gone) - _MOST_NAMED} more {source}")
    warn(*result.warnings)


# How rigs of any number of cameras are solved, for `kcal rig` and `kcal station`.


def camera_names(paths: Sequence[Path], *, told_apart: bool = True) -> tuple[str, ...]:
    """Names of camera files up to their first dots; NAME-1, NAME-2 ... for one file at several places.

    Raises:
        InputError: two files of one name, where marks are `told_apart` by it.
    """
    names = []
    for number, path in enumerate(paths):
        name, turn = path.name.split(".")[0], paths[: number + 1].count(path)
        names.append(f"{name}-{turn}" if paths.count(path) > 1 else name)
        if told_apart and names.count(names[-1]) > 1:
            raise InputError(f"{path}: two cameras are named {name!r}; rename a file: marks are told apart by them")
    return tuple(names)


def solve_and_write(
    paths: Sequence[Path],
    sources: Sources,
    options: kcal.RigOptions,
    output: Path,
    *,
    needs: tuple[kcal.report.Requirement, ...] = (),
    report: Path | None = None,
    picture: Path | None = None,
) -> None:
    """Solve a rig of two cameras, one camera, or three and more.

    The rig is written; it is printed how each camera stands, and whether the rig may be used.
    """
    two = len(paths) == 2
    names = camera_names(paths, told_apart=not two)
    if not two and sources.match:
        raise InputError("--match is for rigs of two cameras; views belong together by their names")
    if not two and sources.scene:
        raise InputError("--scene is for rigs of two cameras; give matches as a table by --features")
    cameras = rig_sources.load_cameras(paths)
    if two:
        rig_sources.check_sides(cameras, paths, sources.pairs or ())
    read = rig_sources.read_sources(cameras, sources, names, paths)
    with (
        console.ending_with(lambda error: rig_sources.cure_of_all(error, sources, paths)),
        steps("solving the rig" if two else "solving the stations", None) as advance,
    ):
        result = rooms.solve_surveyed(read.data, read.origin, options, advance)
    if not two:
        rig = result.stations(read.origin)
    else:
        rig = result.stereo() if read.origin is None else kcal.rig.placed_rig(result, read.origin)
    known = read.pixel_sigma if two and sources.pixel_sigma is None else sources.marks_sigma
    if rig.calibration is not None and known is not None:
        rig.calibration = dataclasses.replace(rig.calibration, pixel_sigma=known)
    noise, note = pixel_sigma_and_source(sources.pixel_sigma, rig)
    # Everything that can fail comes before the file.
    lines = rig_lines(result, rig, read.unpaired) if two else source_lines(result)
    left_out = {item.label: item.reason for item in result.left_out}
    tell(rms_px=result.rms, warnings=console.told.get("warnings", []), left_out=left_out)
    print_rig(result, [*lines, *read.told(result)])
    kcal.save_rig(rig, output)
    console.draw_picture(picture, lambda: kcal.report.rig_figure(result))
    if two:
        tell(baseline_m=float(rig.baseline), baseline_sigma_m=result.sigma_baseline, pairs=list(result.pairs))
        _print_ranges(rig, noise, note)
    else:
        tell(undetermined=list(result.undetermined))
        print_stands(rig)
        if rig.root is None:
            warn("the data leave something open, so that the rig has no error bars")
        if rig.origin is None:
            out.print(
                "No latitudes were given: positions are meters of the local frame. --site anchors it on the Earth."
            )
    print_wrote(output, picture)
    if needs or report is not None:
        pairs = sources.pairs or ()
        found = judged_rig(
            rig, pairs if two and _calibrated_from(rig, pairs) else (), needs, mark_sigma=noise,
            name=output.name.split(".")[0], cameras=rooms.named_cameras(rig), result=result,
        )  # fmt: skip
        tell(verdict=found.verdict.to_dict())
        if not told_usable(found, report, warned_of(result)):
            raise typer.Exit(NO)


def _print_ranges(rig: kcal.Rig, noise: float, note: str) -> None:
    """Print what the errors of ranges consist of."""
    try:
        print_table(rooms.range_sigma_rows(rooms.range_sigmas(rig, pixel_sigma=noise), rig.covariance is not None))
        if note:
            out.print(note)
    except InputError as error:
        warn(f"range errors are not split: {error}")


def _calibrated_from(rig: kcal.Rig, pairs: Sequence[Path]) -> bool:
    """Whether these are the views from which both cameras were calibrated, as far as their names tell."""
    records = [camera.calibration.record if camera.calibration else None for camera in (rig.left, rig.right)]
    return bool(pairs) and all(
        record is not None and set(record.per_view_rms) <= set(kcal.Observations.load(file).names)
        for record, file in zip(records, pairs, strict=True)
    )


def print_stands(rig: kcal.Rig) -> None:
    """Print how each camera stands, with error bars: on the Earth, or in the rig's own frame."""
    rows, told = rooms.stands(rig)
    print_table(rows)
    tell(cameras=told)


# The sources of one camera.
_OF_ONE = (
    "landmarks", "marks", "positions", "site", "skyline", "terrain", "terrain_sigma", "skyline_picture", "geoid",
    "pixel_sigma",
)  # fmt: skip


def station_command(
    camera: kinds.CalibratedCamera, *, output: kinds.NewFile, sources: Annotated[Sources, Only(_OF_ONE)]
) -> None:
    """Solve how one camera stands on the Earth: position, heading, pitch and roll, with error bars.

    Four landmarks are needed, six or more are good; or images of the skyline, a raster of the terrain (--terrain) and
    the measured position. Light of landmarks is bent as for `kcal rig`; east, north and up are those at the camera.
    `kcal locate` then gives bearings, or positions of what stands at a known height.

    **Example**

    `kcal station mast.camera.json --landmarks survey.csv --marks marks.csv -o mast.rig.json`

    `kcal station mast.camera.json --positions gnss.csv --skyline noon.jpg --terrain dem.tif -o mast.rig.json`

    Args:
        camera: Camera file.
        output: Rig file to write, with one camera.
    """
    if sources.landmarks is None and sources.terrain is None:
        raise typer.BadParameter("give surveyed places and --marks, or a raster of the terrain (--terrain)")
    solve_and_write([camera], sources, kcal.RigOptions(), output)


# `kcal place`: stations whose pose is known, from a drone's log or by a compass: no landmarks are needed.


@dataclasses.dataclass(frozen=True, kw_only=True)
class TypedStands:
    """How cameras stand, as it is typed.

    Args:
        site: Place of each camera; heights are above the WGS84 ellipsoid, ± along each axis, 1 m if not given.
        heading: Azimuth of each camera's axis from true north.
        pitch: Elevation of each camera's axis above the horizon.
        roll: Of each camera, clockwise as seen from behind it; level within the pitch's ± if not given.
    """

    site: Several[kinds.Place] | None = None
    heading: Several[kinds.MeasuredDegrees] | None = None
    pitch: Several[kinds.MeasuredDegrees] | None = None
    roll: Several[kinds.MeasuredDegrees] | None = None

    def mountings(self, count: int) -> list[kcal.rig.Mounting]:
        """Of so many cameras.

        Raises:
            InputError: another number of values, or an angle without ±.
        """
        site, heading, pitch, roll = self.site or [], self.heading or [], self.pitch or [], self.roll
        if roll is None:
            roll = [WithSigma(0.0, one.sigma) for one in pitch]
            err.print("roll: 0, known as well as the pitch; --roll states it")
        typed: dict[str, Sequence[kinds.KnownPlace | WithSigma]]
        typed = {"--site": site, "--heading": heading, "--pitch": pitch, "--roll": roll}
        for option, given in typed.items():
            if len(given) != count:
                raise InputError(f"{option}: one value for each of {count} cameras is needed, got {len(given)}")
            if vague := [one for one in given if one.sigma is None and option != "--site"]:
                raise InputError(f"{option} {vague[0]}: say how well it is known, for example {vague[0]}±1")
        return [
            kcal.rig.stated_mounting(
                place.origin,
                heading_deg=(turn.value, turn.sigma or 0.0),
                pitch_deg=(rise.value, rise.sigma or 0.0),
                roll_deg=(tip.value, tip.sigma or 0.0),
                sigma_m=(1.0 if place.sigma is None else place.sigma,) * 3,
            )
            for place, turn, rise, tip in zip(site, heading, pitch, roll, strict=True)
        ]


def place_command(
    cameras: list[kinds.CalibratedCamera],
    *,
    output: kinds.NewFile,
    stands: TypedStands,
    places: kinds.Table | None = None,
) -> None:
    """Make a station, or a rig of several, from positions and angles that are known: no landmarks are needed.

    North, up and the horizon are those at each camera. `kcal locate` then gives the position of what one camera sees at
    a known height (`--height`, `--terrain`), and of what several see. State how well you know each value: ±1 or more
    for the compass of a drone or a phone. Where there are landmarks, `kcal station` finds the pose far better.

    **Examples**

    `kcal place drone.camera.json --site 46.02,7.75,1720±3 --heading 212±2 --pitch -30±0.5 -o drone.rig.json`

    `kcal place west.camera.json east.camera.json --places places.csv -o towers.rig.json`

    Args:
        cameras: Camera file of each; of one file and a table, each line of the table is a place of that camera.
        output: Rig file to write.
        places: In place of these a table: name (of the camera), lat, lon, height, sigma, heading, heading_sigma, pitch,
            pitch_sigma, and if need be sigma_up, roll, roll_sigma.
    """
    needed = (stands.site, stands.heading, stands.pitch)
    if (places is None) == any(value is None for value in needed) or (places and (stands.roll or any(needed))):
        raise typer.BadParameter("give --site, --heading and --pitch of each camera, or all of them in --places")

    names = camera_names(cameras)
    if places is None:
        poses = dict(zip(names, stands.mountings(len(names)), strict=True))
    else:
        poses = rooms.read_stands(places, None if len(names) == 1 else names)
    lenses = rig_sources.load_cameras(cameras * len(poses) if len(cameras) == 1 else cameras)
    rig = kcal.rig.station_rig(dict(zip(poses, lenses, strict=True)), [*poses.values()])
    kcal.save_rig(rig, output)
    print_stands(rig)
    print_wrote(output)
    out.print(
        f"next: kcal locate {output} marks.csv, with lines of name,camera,u,v; --height or --terrain where one camera "
        "alone sees a point"
    )


# `kcal rig`.


def rig_solve_command(
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
    lens_change: Rare[kinds.Pixels] = 0.0,
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
        lens_change: Standard deviation of each lens's change since its calibration, at the image's corner
            (temperature, focus, transport).
        picture: a plan, and residuals.
    """
    pixel_sigma_and_source(sources.pixel_sigma)
    if not sources.given:
        raise typer.BadParameter("give boards (--pairs), landmarks (--landmarks and --marks) or features (--features)")
    options = kcal.RigOptions(
        intrinsics=intrinsics, board_warp=board_warp, reject=not keep_all, refraction=sources.refraction.value,
        refraction_sigma=sources.refraction_sigma, lens_change=lens_change,
    )  # fmt: skip
    paths = [left, right, *(others or [])]
    solve_and_write(paths, sources, options, output, needs=require or (), report=report, picture=picture)


# Check whether the cameras of a rig have turned, and correct the rig file (`kcal rig check`).

# The exit code of a rig that has turned, apart from errors (1) and wrong usage (2).
DRIFTED = 3


def rig_check_command(
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

    The exit code is 3 if a camera has turned or moved beyond chance, relocked or not; 0 if none has; 1 if that could
    not be measured, or if a camera that moved is to be relocked.

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
    if reference is None and landmarks is None:
        raise InputError("give --reference (marks of the same points in old images) or --landmarks (a survey)")
    if reference is not None and landmarks is not None:
        raise InputError("give --reference or --landmarks, not both: with old marks no survey is needed")
    if relock is not None:
        check_writable(relock, marks, *filter(None, (reference, landmarks)))
    old = rooms.load_pair(rig)
    noise = pixel_sigma_of(pixel_sigma, old)
    now = kcal.locate.read_marks(marks, single=True)
    then = None if reference is None else kcal.locate.read_marks(reference, single=True)
    features = None if then is None else rooms.seen_again(then, now, noise)
    surveyed = None if landmarks is None else _landmarks(old, landmarks, now, noise)
    drift = kcal.rig.check_rig(old, features=features, landmarks=surveyed)
    print_turns(drift, f"{sum(item.used for item in drift.items)} of {len(drift.items)}")
    for distance, found, sigma in zip(*(value.tolist() for value in drift.effect()), strict=True):
        shift = "infinity" if math.isinf(found) else f"{found:.1f} m ({found - distance:+z.1f} ± {sigma:.1f} m)"
        out.print(f"with the old rig a target at {distance:g} m is found at {shift}")
    for item in drift.left_out:
        print_label("left out", f"{item.name}: {item.reason}")
    if drift.variance > 1:
        times = f"{drift.variance**0.5:.1f} times"
        warn(f"residuals are {times} as large as the marks' noise says; sigmas were multiplied by that")
    warn(*(f"{text}: its turn is wrong" for text in drift.moved))
    if drift.significant:
        print_styled("the relative attitude has changed beyond chance: ranges by the old rig are wrong", "changed")
    elif not drift.moved:
        out.print("no change of the relative attitude beyond chance")
    if drift.left_significant:
        print_styled("the left camera has turned beyond chance: directions by the old rig are wrong", "turned")
    if not (drift.significant or drift.left_significant or drift.moved):
        if relock is not None:
            out.print("nothing was written")
        return
    if relock is not None:
        replace_rig(relock, drift.relocked(f"{now_stamp()}, from {marks.name}"))
    raise typer.Exit(DRIFTED)


def _landmarks(rig: kcal.Rig, path: Path, now: kcal.locate.Marks, sigma: float) -> kcal.Landmarks:
    if rig.mounting is None:
        raise InputError("the rig file does not say where the rig stands; solve it with landmarks, or use --reference")
    return kcal.rig.match_landmarks(rooms.read_survey(path, rig.mounting.origin), now, now.sigmas(sigma)).landmarks


def print_turns(drift: rooms.Drift, used: str = "") -> None:
    """Print what has turned by how much, and of how many points that was found, if that is known."""
    rows = [["turn of", "pitch °", "yaw °", "roll °", *(["used"] if used else [])]]
    for name, turn, covariance in drift.turns:
        both = zip(turn.tolist(), covariance.diagonal().sqrt().tolist(), strict=True)
        cells = [f"{math.degrees(value):+z.5f} ± {math.degrees(sigma):.5f}" for value, sigma in both]
        rows.append([name, *cells, *([used] if used else [])])
    print_table(rows, left=range(len(rows[0])))


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
