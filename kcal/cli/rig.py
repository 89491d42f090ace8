"""Solve a rig from two cameras and what both have seen (`kcal rig`)."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from kcal.cli.console import with_inputs, with_json
from kcal.cli.groups import group_with_default
from kcal.cli.report import NO, REQUIRE_HELP, required, told_usable
from kcal.cli.rig_check import check
from kcal.cli.stars import TIME_HELP
from kcal.errors import InputError

if TYPE_CHECKING:
    from kcal.calibrate.rig.result import RigResult
    from kcal.lens.rig import StereoRig


app = typer.Typer(cls=group_with_default("solve"), rich_markup_mode="markdown", help="Solve a rig, and check it later.")


def solve_command(
    left: Annotated[Path, typer.Argument(help="Camera file of the left camera.")],
    right: Annotated[Path, typer.Argument(help="Camera file of the right camera.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="Rig file to write.")],
    pairs: Annotated[
        tuple[Path, Path] | None,
        typer.Option("--pairs", metavar="LEFT.obs.json RIGHT.obs.json", help="Observations of boards seen by both."),
    ] = None,
    match: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Which views belong together: columns left,right. By name if not given."),
    ] = None,
    landmarks: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Surveyed places: CSV (name,lat,lon,height,sigma or name,east,north,up,sigma), GeoJSON, GPX.",
        ),
    ] = None,
    marks: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Where they are in the images: name,left_u,left_v,right_u,right_v."),
    ] = None,
    features: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="Far things matched between the images: left_u,left_v,right_u,right_v and range,range_sigma or "
            "beyond (meters), if known.",
        ),
    ] = None,
    positions: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="Measured camera positions (GNSS): as --landmarks, names left and right."),
    ] = None,
    baseline: Annotated[
        str | None, typer.Option(metavar="M±SIGMA", help="Measured distance between the cameras, e.g. 10.02±0.005.")
    ] = None,
    origin: Annotated[
        str | None,
        typer.Option(metavar="LAT,LON,HEIGHT", help="Of the local frame; the first surveyed place if not given."),
    ] = None,
    survey_sigma: Annotated[
        float | None,
        typer.Option(metavar="M", help="How well places of GeoJSON and GPX files are known, where these do not say."),
    ] = None,
    geoid: Annotated[
        float | None,
        typer.Option(metavar="M", help="Height of the geoid above the WGS84 ellipsoid, added to elevations of GPX."),
    ] = None,
    stars: Annotated[
        tuple[str, str] | None,
        typer.Option(
            metavar="LEFT RIGHT",
            help="Night images of each camera (folder or quoted wildcard), paired by their times: they determine how "
            "the cameras are turned, yaw included; with --origin and --star-time also on the Earth.",
        ),
    ] = None,
    star_time: Annotated[str | None, typer.Option("--star-time", metavar="TIME", help=TIME_HELP)] = None,
    clock_sigma: Annotated[
        float,
        typer.Option(
            metavar="S", help="Of the offset between the two cameras' clocks: 1 s is 2.3 % of a range of 5 km.", min=0
        ),
    ] = 0.1,
    celsius: Annotated[float | None, typer.Option(metavar="C", help="Temperature at night, for stars.")] = None,
    hectopascal: Annotated[float | None, typer.Option(metavar="HPA", help="Pressure there, for stars.")] = None,
    dut1: Annotated[float | None, typer.Option(metavar="S", help="UT1 - UTC at night, if known.")] = None,
    require: Annotated[
        str, typer.Option(metavar="RANGE:ERROR", help=f"{REQUIRE_HELP} Exit code 3 if it is not met.")
    ] = "",
    report: Annotated[Path | None, typer.Option(help="HTML page to write: may it be used, and why not.")] = None,
    mark_sigma: Annotated[float, typer.Option(metavar="PX", help="Noise of marks and matches along each axis.")] = 0.3,
    intrinsics: Annotated[
        Literal["prior", "fixed", "free"],
        typer.Option(
            help="Refine the cameras within what their calibrations know, hold them as if they were exact, or let them "
            "free."
        ),
    ] = "prior",
    refraction: Annotated[
        float, typer.Option(metavar="K", help="Refraction of light from landmarks beforehand; 0 for straight lines.")
    ] = 0.13,
    refraction_sigma: Annotated[
        float, typer.Option(metavar="K", help="Its standard deviation; 0 holds it.", min=0)
    ] = 0.1,
    keep_all: Annotated[bool, typer.Option("--keep-all", help="Leave nothing out; only warn.")] = False,
    board_warp: Annotated[bool, typer.Option("--board-warp", help="Also estimate how the board bends.")] = False,
    picture: Annotated[Path | None, typer.Option(help="A .png or .svg file: a plan, and residuals.")] = None,
) -> None:
    """Solve a stereo rig: where the right camera stands from the left, and where both stand on the Earth.

    From boards seen by both cameras, surveyed landmarks, far features, a measured baseline and measured camera
    positions: any of them, or all together in one adjustment. What contradicts the rest is left out and named. Boards
    are paired by name (left01.jpg with right01.jpg) or by a CSV; one that was read from its other end is turned.

    The cameras are refined within what their calibrations know of lenses and board. The table at the end splits the σ
    of ranges by what to improve: marks; lenses (more views of the board, near the image's borders); relative pose
    (landmarks and far features, which determine the yaw better than boards do: 0.01° of it is 436 m at 5 km with a
    baseline of 10 m).

    Stars (--stars) need no survey: pairs of night images and a taped baseline determine ranges once matches of unknown
    range (--features) or measured positions tell the baseline's direction.

    `kcal rig check` tells later whether the cameras have turned since.

    **Examples**

    `kcal rig left.camera.json right.camera.json --pairs left.obs.json right.obs.json -o rig.json`

    `kcal rig left.camera.json right.camera.json --landmarks survey.csv --marks marks.csv --features far.csv
    --baseline 10.02±0.005 -o rig.json --require 5km:10% --report rig.html`
    """
    from kcal.calibrate.rig.solve import RigOptions, solve_rig
    from kcal.cli.console import print_table, print_wrote, steps, tell, warn
    from kcal.cli.rig_sources import Sources, read_sources
    from kcal.cli.rig_stars import NightOptions
    from kcal.files import check_writable
    from kcal.io.camera_file import load_camera
    from kcal.io.rig_file import save_rig
    from kcal.locate.mounting import placed_rig
    from kcal.locate.range_sigmas import range_sigmas
    from kcal.report.tables import range_sigma_rows

    night = None
    if stars is not None:
        night = NightOptions(
            images=stars, time=star_time, clock_sigma=clock_sigma, celsius=celsius, hectopascal=hectopascal, dut1=dut1
        )
    sources = Sources(
        pairs=pairs, match=match, landmarks=landmarks, marks=marks, features=features, positions=positions,
        baseline=baseline, origin=origin, mark_sigma=mark_sigma, survey_sigma=survey_sigma, geoid=geoid,
        stars=night,
    )  # fmt: skip
    check_writable(output, left, right, *sources.files)
    needs = required(require)
    if report is not None:
        check_writable(report, left, right, *sources.files)
    if picture is not None:
        from kcal.report.figures import check_picture

        check_picture(picture)
    if not any((pairs, landmarks, marks, features, positions, baseline, stars)):
        raise typer.BadParameter("give boards (--pairs), landmarks (--landmarks and --marks) or features (--features)")
    options = RigOptions(
        intrinsics=intrinsics, board_warp=board_warp, reject=not keep_all, refraction=refraction,
        refraction_sigma=refraction_sigma,
    )  # fmt: skip
    data, frame, unpaired, notes = read_sources((load_camera(left), load_camera(right)), sources)
    with steps("solving the rig", 1) as advance:
        result = solve_rig(data, options)
        advance("done")
    rig = result.stereo() if frame is None else placed_rig(result, frame)
    # Everything that can fail comes before the file.
    lines = rig_lines(result, rig, unpaired)
    tell(
        rms_px=result.rms,
        baseline_m=float(rig.baseline),
        baseline_sigma_m=result.sigma_baseline,
        pairs=list(result.pairs),
        left_out={item.label: item.reason for item in result.left_out},
        warnings=list(result.warnings),
    )
    save_rig(rig, output)
    if picture is not None:
        from kcal.report.rig import save_rig_picture

        save_rig_picture(picture, result)
    print_rig(result, [*lines, *notes])
    try:
        print_table(range_sigma_rows(range_sigmas(rig, pixel_sigma=mark_sigma)))
    except InputError as error:
        warn(f"range errors are not split: {error}")
    print_wrote(output, picture)
    if needs or report is not None:
        from kcal.report.judge_rig import rig_verdict
        from kcal.report.rig import rig_figure
        from kcal.report.verdict_page import camera_tables
        from kcal.report.verdict_pictures import png_bytes

        verdict = rig_verdict(rig, needs, mark_sigma=mark_sigma, result=result, subject=output.name.split(".")[0])
        tables = [*camera_tables(rig.left), *camera_tables(rig.right)]
        tell(verdict=verdict.to_dict())
        if not told_usable(verdict, lambda: {"rig": png_bytes(rig_figure(result))}, tables, report):
            raise typer.Exit(NO)


def rig_lines(result: RigResult, rig: StereoRig, unpaired: int) -> list[str]:
    """What a result says: residuals by source, the relative pose with its sigmas, the board's squares, the mounting."""
    from kcal.locate.check import triangulated_sides

    rows = [["source", "used", "left out", "RMS px", "RMS m", "sigmas"]]
    for source in result.sources:
        cells = ["" if value is None else f"{value:.4f}" for value in (source.rms_px, source.rms_m)]
        sigmas = "" if math.isnan(source.sigmas) else f"{source.sigmas:.2f}"
        rows.append([source.source, f"{source.used}", f"{source.left_out}", *cells, sigmas])
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]).rstrip() for row in rows]
    boards, mounting = result.data.boards, rig.mounting
    lines += [
        f"RMS [bold]{result.rms:.4f} px[/] (left {result.rms_px[0]:.4f}, right {result.rms_px[1]:.4f}); "
        f"{result.status.message}",
        f"baseline [bold]{float(rig.baseline):.6f} m[/] ± {result.sigma_baseline:.6f}",
    ]
    if result.exact:
        lines.append(f"taken as exact, so that errors of these lenses are in no σ: {' and '.join(result.exact)}")
    if boards is not None:
        lines.append(f"{len(result.pairs)} of {len(boards.names)} pairs used, {unpaired} views without partner")
        if result.pairs:
            board = boards.board
            side, spread = triangulated_sides(rig, board.columns, board.rows, result.pixels, board.points)
            true = float((board.points[1] - board.points[0]).norm())
            what = {"checkerboard": "squares", "aprilgrid": "tags"}.get(board.pattern, "distances of circles")
            lines.append(
                f"triangulated {what}: {1e3 * side:.4f} mm ± {1e3 * spread:.4f} mm, the board's are {1e3 * true:.4f} mm"
            )
    if result.board_warp is not None:
        x, y = (1e3 * result.board_warp).tolist()
        lines.append(f"board warp: {x:+.3f} mm along its rows, {y:+.3f} mm along its columns")
    if mounting is not None and mounting.covariance is not None:
        sigma = mounting.covariance.diagonal().sqrt().tolist()
        place = mounting.origin
        lines.append(
            f"left camera at {place.lat:.7f}, {place.lon:.7f}, {place.height:.3f} m above the ellipsoid "
            f"(± {max(sigma[:2]):.3f} m level, {sigma[2]:.3f} m up), heading {mounting.heading_deg:.4f}° ± "
            f"{math.degrees(sigma[5]):.4f}, pitch {mounting.pitch_deg:.4f}°, roll {mounting.roll_deg:.4f}°"
        )
        if mounting.refraction is not None and result.data.landmarks is not None:
            lines.append(f"refraction of light {mounting.refraction:.2f} ± {sigma[6]:.2f} of the Earth's curvature")
    return lines


def print_rig(result: RigResult, lines: list[str]) -> None:
    """Print the lines of a result, and what was turned, left out and should be doubted."""
    from kcal.cli.console import err, out

    for line in lines:
        out.print(line)
    for turned in result.flipped:
        text = f"turned by 180°: {turned.board} ({turned.camera}; the board was read from its other end)"
        out.print(text, markup=False)
    for item in result.left_out:
        err.print("[yellow]left out:[/]", f"{item.label}: {item.reason}")
    for text in result.warnings:
        err.print("[yellow]warning:[/]", text)


app.command("solve", hidden=True)(with_json(with_inputs(solve_command)))
app.command("check")(with_json(with_inputs(check)))
