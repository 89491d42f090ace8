"""Rigs of any number of cameras: how they are solved, and what is printed of them."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import kcal
import kcal.cli.rig_sources as rig_sources
from kcal.cli import console, kinds
from kcal.cli.console import aligned, out, print_label, print_styled, print_table, print_wrote, steps, tell, warn
from kcal.cli.inputs import pixel_sigma_and_source
from kcal.cli.options import Only
from kcal.cli.report import NO, judged_sides, side_pictures, stored_tables, told_usable, warned_of
from kcal.cli.rig_options import Sources
from kcal.errors import InputError
from kcal.texts import length_text, measured_length, measured_text, number_text

if TYPE_CHECKING:
    from kcal.calibrate.rig.result import RigResult


# What `kcal rig` prints of a solved rig.

# Items of a source that are named when they are left out; of thousands of matches more are no news.
_MOST_NAMED = 12


def source_lines(result: RigResult) -> list[str]:
    """Residuals by source."""
    rows = [["source", "used", "left out", "RMS px", "RMS", "sigmas"]]
    for source in result.sources:
        cells = [
            "" if source.rms_px is None else f"{source.rms_px:.4f}",
            "" if source.rms_m is None else length_text(source.rms_m),
        ]
        sigmas = "" if source.sigmas is None else f"{source.sigmas:.2f}"
        rows.append([source.name, f"{source.used}", f"{source.left_out}", *cells, sigmas])
    return aligned(rows)


def rig_lines(result: RigResult, rig: kcal.Rig, unpaired: int) -> list[str]:
    """What a result says: residuals by source, the relative pose with its sigmas, the board's squares, the mounting."""
    from kcal.report.judge_rig import triangulated_sides

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
            side, spread = triangulated_sides(rig, board.columns, board.rows, result.pixels, board.points)
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
        if mounting.refraction is not None and result.data.landmarks is not None:
            lines.append(f"refraction of light {measured_text(mounting.refraction, sigma[6])} of the Earth's curvature")
    return lines


def _exact_line(result: RigResult, rig: kcal.Rig) -> str:
    """Which cameras were taken as exact, what an error of their lenses does, and which files had no error bars."""
    far, share = 100.0 * float(rig.baseline), 10.0 / float(rig.left.focal.mean())
    text = (
        f"taken as exact, so that errors of these lenses are in no σ: {' and '.join(result.exact)}. An error of 0.1 px "
        f"in one of them is {number_text(100.0 * share, digits=2)} % of a range of {length_text(far, digits=2)}"
    )
    cameras = dict(zip(result.names, result.data.cameras, strict=True))
    known = {name: cameras[name].calibration for name in result.exact}
    bare = [name for name, one in known.items() if one is None or one.covariance is None]
    if not bare:
        return text
    return f"{text}. Without error bars came {' and '.join(bare)}: calibrate with kcal, or import a file that has them"


def print_rig(result: RigResult, lines: list[str]) -> None:
    """Print the lines of a result, and what was turned, left out and should be doubted."""
    for line in lines:
        print_styled(line, r"(?<=^RMS )\S+ px|(?<=^baseline ).+")
    for turned in result.flipped:
        text = f"turned by 180°: {turned.board} ({turned.camera}; the board was read from its other end)"
        out.print(text)
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


def _cure_of_sources(paths: Sequence[Path], sources: Sources, error: object) -> str:
    """The command after a refusal of what a rig of two cameras was to be solved from."""
    if len(paths) != 2:
        return ""
    if sources.pairs and sources.landmarks is None and isinstance(error, InputError):
        return console.look_at_views(kcal.Observations.load(sources.pairs[0]), sources.pairs[0])
    survey = sources.landmarks or "survey.csv"
    return console.mark_again("--cameras", *paths, "--landmarks", survey, marks=sources.marks)


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
    from kcal.locate.mirrored import solve_surveyed

    two = len(paths) == 2
    names = camera_names(paths, told_apart=not two)
    if not two and sources.match:
        raise InputError("--match is for rigs of two cameras; views belong together by their names")
    if not two and sources.scene:
        raise InputError("--scene is for rigs of two cameras; give matches as a table by --features")
    cameras = rig_sources.load_cameras(paths)
    if two:
        rig_sources.check_sides(cameras, paths)
    with console.ending_with(functools.partial(_cure_of_sources, paths, sources)):
        read = rig_sources.read_sources(cameras, sources, names)
        with steps("solving the rig" if two else "solving the stations", None) as advance:
            result = solve_surveyed(read.data, read.origin, options, advance)
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
    tell(rms_px=result.rms, warnings=console.told().get("warnings", []), left_out=left_out)
    print_rig(result, [*lines, *read.told(result)])
    kcal.save_rig(rig, output)
    if picture is not None:
        kcal.report.save_picture(picture, kcal.report.rig_figure(result))
    if two:
        baseline = float(rig.baseline)
        tell(baseline_m=baseline, baseline_sigma_m=result.sigma_baseline, pairs=list(result.pairs))
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
        from kcal.report.judge_rig import named_cameras
        from kcal.report.verdict_pictures import rig_pictures

        pairs = sources.pairs or ()
        sides = judged_sides(named_cameras(rig), pairs if two and _calibrated_from(rig, pairs) else (), noise)
        verdict = kcal.report.rig_verdict(
            rig, needs, mark_sigma=noise, result=result, cameras=[found[0] for found in sides],
            subject=output.name.split(".")[0],
        )  # fmt: skip
        tell(verdict=verdict.to_dict())

        def drawn() -> dict[str, bytes]:
            return {**rig_pictures(result), **side_pictures(sides)}

        if not told_usable((verdict, drawn, stored_tables(rig)), report, warned_of(result)):
            raise typer.Exit(NO)


def _print_ranges(rig: kcal.Rig, noise: float, note: str) -> None:
    """Print what the errors of ranges consist of."""
    from kcal.locate.budget import range_sigmas
    from kcal.report.tables import range_sigma_rows

    try:
        print_table(range_sigma_rows(range_sigmas(rig, pixel_sigma=noise), rig.covariance is not None))
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
    from kcal.report.shown import stands

    rows, told = stands(rig)
    print_table(rows)
    tell(cameras=told)


# The sources of one camera.
_OF_ONE = (
    "landmarks", "marks", "positions", "site", "skyline", "terrain", "terrain_sigma", "skyline_picture", "geoid",
    "pixel_sigma",
)  # fmt: skip


def station_command(
    camera: kinds.CalibratedCamera,
    *,
    output: kinds.NewFile,
    sources: Annotated[Sources, Only(_OF_ONE)],
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
