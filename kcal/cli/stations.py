"""Rigs of any number of cameras: what is printed of them, and how three and more, or one alone, are solved."""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import kcal.cli.rig_sources as rig_sources
from kcal.cli import kinds
from kcal.cli.console import err, out, print_table, print_wrote, steps, tell
from kcal.cli.options import Only
from kcal.cli.report import NO, stored_tables, told_usable, warned_of
from kcal.cli.rig_options import Sources
from kcal.errors import InputError
from kcal.files import check_writable
from kcal.texts import length_text, measured_length, measured_text, number_text

if TYPE_CHECKING:
    from kcal.calibrate.rig.result import RigResult
    from kcal.calibrate.rig.solve import RigOptions
    from kcal.lens.rig import Rig
    from kcal.report.verdict import Requirement


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
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip() for row in rows]


def rig_lines(result: RigResult, rig: Rig, unpaired: int) -> list[str]:
    """What a result says: residuals by source, the relative pose with its sigmas, the board's squares, the mounting."""
    from kcal.report.judge_rig import triangulated_sides

    lines = source_lines(result)
    boards, mounting = result.data.boards, rig.mounting
    lines += [
        f"RMS [bold]{result.rms:.4f} px[/] (left {result.rms_px[0]:.4f}, right {result.rms_px[1]:.4f}); "
        f"{result.status.message}",
        f"baseline [bold]{measured_length(float(rig.baseline), result.sigma_baseline)}[/]",
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


def _exact_line(result: RigResult, rig: Rig) -> str:
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
        out.print(line)
    for turned in result.flipped:
        text = f"turned by 180°: {turned.board} ({turned.camera}; the board was read from its other end)"
        out.print(text, markup=False)
    for source in dict.fromkeys(item.source for item in result.left_out):
        gone = [item for item in result.left_out if item.source == source]
        for item in gone[:_MOST_NAMED]:
            err.print("[yellow]left out:[/]", f"{item.label}: {item.reason}")
        if len(gone) > _MOST_NAMED:
            err.print("[yellow]left out:[/]", f"{len(gone) - _MOST_NAMED} more {source}")
    for text in result.warnings:
        err.print("[yellow]warning:[/]", text)


# Rigs of three and more cameras, and one alone, for `kcal rig`, `kcal station` and `kcal locate`.


def camera_names(paths: Sequence[Path]) -> tuple[str, ...]:
    """Names of camera files up to their first dots; NAME-1, NAME-2 ... for one file at several places.

    Raises:
        InputError: two files of one name.
    """
    names = rig_sources.place_names(paths)
    for path, name in zip(paths, names, strict=True):
        if names.count(name) > 1:
            raise InputError(f"{path}: two cameras are named {name!r}; rename a file: marks are told apart by them")
    return names


def solve_stations(
    paths: Sequence[Path],
    sources: Sources,
    options: RigOptions,
    output: Path,
    *,
    needs: tuple[Requirement, ...] = (),
    report: Path | None = None,
    picture: Path | None = None,
) -> None:
    """Solve one camera, or three and more, write the rig, print how each stands and whether it may be used."""
    from kcal.io.rig_file import save_rig
    from kcal.locate.mirrored import solve_surveyed

    names = camera_names(paths)
    for given, option, instead in (
        (sources.match, "--match", "views belong together by their names"),
        (sources.scene, "--scene", "give matches as a table by --features"),
    ):
        if given is not None:
            raise InputError(f"{option} is for rigs of two cameras; {instead}")
    check_writable(output, *paths, *sources.files)
    read = rig_sources.read_sources(rig_sources.load_cameras(paths), sources, names)
    with steps("solving the stations", None) as advance:
        result = solve_surveyed(read.data, read.origin, options, advance)
    rig = result.stations(read.origin)
    assert rig.calibration is not None
    rig.calibration = dataclasses.replace(rig.calibration, pixel_sigma=sources.marks_sigma)
    tell(
        rms_px=result.rms, cameras=told_stands(rig), warnings=list(result.warnings),
        undetermined=list(result.undetermined), left_out={item.label: item.reason for item in result.left_out},
    )  # fmt: skip
    save_rig(rig, output)
    if picture is not None:
        from kcal.report.figures import save_picture
        from kcal.report.rig import rig_figure

        save_picture(picture, rig_figure(result))
    _print_stations(result, rig, read.told(result))
    print_wrote(output, picture)
    if needs or report is not None:
        from kcal.report.judge_rig import rig_verdict
        from kcal.report.verdict_pictures import rig_pictures

        subject = output.name.split(".")[0]
        verdict = rig_verdict(rig, needs, mark_sigma=sources.marks_sigma, result=result, subject=subject)
        tell(verdict=verdict.to_dict())
        pictures = functools.partial(rig_pictures, result)
        if not told_usable(verdict, pictures, stored_tables(rig), report, warned=warned_of(result)):
            raise typer.Exit(NO)


def _print_stations(result: RigResult, rig: Rig, notes: Sequence[str]) -> None:

    print_rig(result, [*source_lines(result), *notes])
    print_table(station_rows(rig))
    if rig.root is None:
        err.print("[yellow]warning:[/] the data leave something open, so that the rig has no error bars")
    if rig.origin is None:
        out.print("No latitudes were given: positions are meters of the local frame. --site anchors it on the Earth.")


def station_rows(rig: Rig) -> list[list[str]]:
    """A table of how each camera stands, heads first, with error bars: on the Earth, or in the rig's own frame."""
    import torch

    from kcal.locate.stations import station_stands

    where = ["lat", "lon", "height m"] if rig.origin else ["east m", "north m", "up m"]
    rows = [["camera", "RMS px", *where, "± level", "± up", "heading °", "pitch °", "roll °"]]
    # The frame of the first camera has no north.
    own = not rig.origin and torch.equal(rig.rotation[0], torch.eye(3).to(rig.rotation))
    if own:
        rows = [["camera", "RMS px", "x m", "y m", "z m"]]
    residuals = rig.calibration.rms_px if rig.calibration else (None,) * len(rig)
    for c, (name, residual) in enumerate(zip(rig.names, residuals, strict=True)):
        rms = "" if residual is None else f"{residual:.3f}"
        place, angles, covariance = station_stands(rig, c)
        digits = (7, 7, 2) if rig.origin else (3, 3, 3)
        told = [f"{value:.{many}f}" for value, many in zip(place, digits, strict=True)]
        if own:
            rows.append([name, rms, *told])
            continue
        if rig.root is None or covariance is None:
            rows.append([name, rms, *told, "", "", *(f"{angle:.4f}" for angle in angles)])
            continue
        sigma = covariance.diagonal().sqrt().tolist()
        if not rig.origin:
            told[:2] = (number_text(value, one) for value, one in zip(place[:2], sigma[:2], strict=True))
        level = math.degrees(max(sigma[3:5]))
        rows.append(
            [name, rms, *told[:2], number_text(place[2], sigma[2]), length_text(max(sigma[:2]), digits=2),
             length_text(sigma[2], digits=2), measured_text(angles[0], math.degrees(sigma[5])),
             measured_text(angles[1], level), number_text(angles[2], level)]
        )  # fmt: skip
    return rows


def told_stands(rig: Rig) -> dict[str, dict[str, float]]:
    """How each camera stands, for --json."""
    from kcal.locate.stations import station_stands

    told, where = {}, ("lat", "lon", "height") if rig.origin else ("east_m", "north_m", "up_m")
    for c, name in enumerate(rig.names):
        place, angles, covariance = station_stands(rig, c)
        told[name] = dict(zip((*where, "heading_deg", "pitch_deg", "roll_deg"), (*place, *angles), strict=True))
        if rig.root is not None and covariance is not None:
            sigma = covariance.diagonal().sqrt().tolist()
            told[name] |= {"sigma_m": max(sigma[:3]), "sigma_deg": math.degrees(max(sigma[3:6]))}
    return told


# The sources of one camera.
_OF_ONE = (
    "landmarks", "marks", "positions", "site", "skyline", "terrain", "terrain_sigma", "skyline_picture", "geoid",
    "pixel_sigma",
)  # fmt: skip


def station_command(
    camera: kinds.CalibratedCamera,
    *,
    output: kinds.Output,
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
    from kcal.calibrate.rig.solve import RigOptions

    if sources.landmarks is None and sources.terrain is None:
        raise typer.BadParameter("give surveyed places and --marks, or a raster of the terrain (--terrain)")
    solve_stations([camera], sources, RigOptions(), output)
