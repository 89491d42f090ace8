"""`kcal locate`: pixel pairs to positions on the Earth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kcal.cli.console import err, out, print_table, print_wrote, steps, warn
from kcal.cli.cures import mark_again, with_command
from kcal.cli.inputs import MARKS, RIG, SURVEY, typed_with
from kcal.cli.pixel_sigma import PixelSigma, pixel_sigma_and_source
from kcal.cli.settings import taken
from kcal.errors import DegenerateError, InputError
from kcal.files import check_picture, check_writable, written_files
from kcal.texts import one_line

if TYPE_CHECKING:
    from torch import Tensor

    from kcal.locate.positions import Located


def locate_command(
    rig: Annotated[Path, typer.Argument(help="Rig file from `kcal rig`."), RIG],
    points: Annotated[
        Path,
        typer.Argument(
            help="CSV with the columns name,left_u,left_v,right_u,right_v; others are carried into GeoJSON and CSV."
        ),
        MARKS,
    ],
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON,HEIGHT",
            help="Position of the left camera: degrees, degrees, meters above the WGS84 ellipsoid; from the rig file "
            "if not given.",
        ),
    ] = None,
    heading: Annotated[
        float | None,
        typer.Option(
            metavar="DEG", help="Azimuth of the left camera's axis, clockwise from true north; needed with --origin."
        ),
    ] = None,
    pitch: Annotated[
        float, typer.Option(metavar="DEG", help="Elevation of the left camera's axis, positive up.", hidden=True)
    ] = 0.0,
    roll: Annotated[
        float,
        typer.Option(metavar="DEG", help="Roll of the left camera, clockwise as seen from behind it.", hidden=True),
    ] = 0.0,
    grid: Annotated[
        str | None,
        typer.Option(
            metavar="CRS",
            help="Map whose grid north --heading counts from, for example EPSG:32643; true north if not given.",
            hidden=True,
        ),
    ] = None,
    pixel_sigma: PixelSigma = None,
    yaw_sigma: Annotated[
        float,
        typer.Option(metavar="DEG", help="Standard deviation of the relative yaw, added to the rig file's.", min=0),
    ] = 0.0,
    aged: Annotated[
        str | None,
        typer.Option(
            metavar="9h:DEG,8K:DEG",
            help="Hours since the rig was solved, and degrees of yaw that it loses in one; the same for kelvin.",
            hidden=True,
        ),
    ] = None,
    heading_sigma: Annotated[
        float,
        typer.Option(
            metavar="DEG", help="Standard deviation of the heading, added to the rig file's.", min=0, hidden=True
        ),
    ] = 0.0,
    origin_sigma: Annotated[
        float,
        typer.Option(
            metavar="M",
            help="Standard deviation of the origin along each axis, added to the rig file's.",
            min=0,
            hidden=True,
        ),
    ] = 0.0,
    refraction: Annotated[
        float | None,
        typer.Option(
            metavar="K",
            help="Refraction: 0.13, the default, lowers a point at 5 km by 0.26 m; 0 for straight lines. A rig solved "
            "from landmarks has its own.",
            hidden=True,
        ),
    ] = None,
    refraction_sigma: Annotated[
        float | None,
        typer.Option(
            metavar="K",
            help="Its standard deviation, 0.1; 0.5 for lines of sight near hot or cold ground.",
            min=0,
            hidden=True,
        ),
    ] = None,
    geoid: Annotated[
        Path | None, typer.Option(help="Geoid grid file (.tif, .gtx); one that PROJ finds if not given.", hidden=True)
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV", help="True positions, name,lat,lon,height, to show errors in the table and on the maps."
        ),
        SURVEY,
    ] = None,
    output: Annotated[
        list[Path] | None,
        typer.Option(
            "--output",
            "-o",
            help="File to write, .geojson, .geojsonl, .csv, .kml or .cot; may be repeated; - for the standard output.",
        ),
    ] = None,
    stream_format: Annotated[
        str,
        typer.Option(
            "--format", metavar="NAME", help="Format of `-o -`: csv, geojson, geojsonl, kml or cot.", hidden=True
        ),
    ] = "csv",
    as_json: Annotated[bool, typer.Option("--json", help="Print a summary as JSON in place of the table.")] = False,
    picture: Annotated[Path | None, typer.Option(help="PNG file to write: the map and the intervals.")] = None,
    web_map: Annotated[
        Path | None, typer.Option("--map", help="HTML file to write: an interactive map that needs no network.")
    ] = None,
    tiles: Annotated[
        Path | None,
        typer.Option(metavar="FOLDER", help="With --map: folder of tiles FOLDER/zoom/x/y.png to embed.", hidden=True),
    ] = None,
    image: Annotated[
        Path | None, typer.Option(metavar="TIF", help="With --map: GeoTIFF to embed.", hidden=True)
    ] = None,
    online: Annotated[
        bool, typer.Option("--online", help="With --map: let the page load tiles of OpenStreetMap.", hidden=True)
    ] = False,
) -> None:
    """Locate points that were marked in both images: latitude, longitude, height and a 95 % range interval.

    The interval includes noise in the marks, and the errors of calibration and mounting that the rig file contains.
    0.01° of relative yaw is 436 m at 5 km with a baseline of 10 m; `--yaw-sigma` adds such an error. If the parallax is
    below three sigma, only the bearing is given. Heights are ellipsoidal; with a geoid grid the files also contain the
    height of the geoid.

    Light bends: `--refraction` lowers points by K d² / 2R at the level distance d, R being the Earth's radius, and what
    is not known of K is part of the height's error, but not of the range's.

    The rig file of a rig that was solved with landmarks contains its position: `--origin` and `--heading` are then not
    needed.

    A table may have any length: rows are read, located and written in turn. Beyond 1,000 rows the screen shows counts
    only, and pictures and maps show evenly spaced rows and those that have a true position.

    The exit code is 1 if nothing could be located.

    **Examples**

    `kcal locate rig.json points.csv --origin 19.07,72.87,14 --heading 35 -o points.geojson`

    `kcal locate rig.json points.csv --map map.html --truth survey.csv`

    `kcal locate rig.json points.csv --origin -33.9,151.2,10 --heading 250 --pitch -1.5 -o p.geojson -o p.csv
    --picture map.png`

    `kcal locate rig.json detections.csv -o - --format geojsonl | head`
    """
    import json

    from kcal.io.rig_file import load_rig
    from kcal.lens.mounting import Origin
    from kcal.locate.aging import parse_aging
    from kcal.locate.datum import find_geoid, true_from_grid
    from kcal.locate.export import STREAM, check_format, open_writers
    from kcal.locate.marks import filled, read_mark_chunks
    from kcal.locate.mounting import run_errors
    from kcal.locate.positions import located_by
    from kcal.locate.sample import PositionSample
    from kcal.locate.survey import read_survey
    from kcal.locate.tabulate import Locator
    from kcal.locate.truth import read_truth

    outputs = output or []
    streamed = STREAM in outputs
    suffix = f".{stream_format}"
    if streamed and (as_json or outputs.count(STREAM) > 1):
        raise typer.BadParameter("-o - takes the standard output for itself; leave out --json and a second -o -")
    for path in outputs:
        if path == STREAM:
            check_format(f"positions{suffix}")
            continue
        check_format(path)
        check_writable(path, rig, points, *([truth] if truth else []))
    if picture is not None:
        check_picture(picture)
    if web_map is not None:
        from kcal.report.map_page import check_map_format

        check_map_format(web_map)
        check_writable(web_map)
    if (origin is None) != (heading is None):
        raise typer.BadParameter("--origin and --heading belong together")
    if heading is None and (pitch or roll or grid is not None):
        raise typer.BadParameter("--pitch, --roll and --grid belong to --heading; the rig file has its own attitude")
    # Parsed before the rig is read, so that a wrong option is reported first.
    place = None if origin is None else Origin.parse(origin)
    yaw_sigma = math.hypot(yaw_sigma, parse_aging(aged))
    solved = load_rig(rig)
    noise, note = pixel_sigma_and_source(pixel_sigma, solved)
    if solved.mounting is not None and {"origin", "heading"} <= taken:
        # What the rig was solved with is better known.
        place = heading = None
        err.print("the position of the rig is that in its file, not that in kcal.toml")
    doubts = solved.calibration.warnings if solved.calibration else ()
    for text in doubts:
        warn(f"{rig}: {text}")
    if place is None or heading is None:
        if solved.mounting is None:
            raise InputError(
                f"{rig}: the file has no position of the rig; give --origin and --heading. If you only need meters "
                "from the left camera, the columns east_m, north_m and up_m: "
                + typed_with({}, "--origin", "0,0,0", "--heading", "0")
            )
    elif grid is not None:
        heading = true_from_grid(heading, place, grid)
    errors = run_errors(
        solved, yaw_deg=yaw_sigma, heading_deg=heading_sigma, origin_m=origin_sigma, elsewhere=place is not None
    )
    locate = Locator(
        solved, geoid=find_geoid(geoid), origin=place, heading_deg=heading, pitch_deg=pitch, roll_deg=roll,
        pixel_sigma=noise, calibration=errors.calibration, mounting=errors.mounting, link=errors.link,
        refraction=refraction, refraction_sigma=refraction_sigma,
    )  # fmt: skip
    survey = None if truth is None else read_survey(truth, locate.localize.origin, measured=False)
    sample = PositionSample(frozenset(survey.names if survey else ()))
    with written_files() as written:
        try:
            size = points.stat().st_size if points.is_file() else None
            with open_writers(outputs, located_by(locate), suffix) as writers, steps("locating", size) as advance:
                read, stated = 0, False
                for chunk in read_mark_chunks(points):
                    cov = filled(chunk.covariance, noise)
                    stated = stated or cov is not None
                    columns = locate(chunk.names, chunk.pixels, cov, chunk.extras)
                    for writer in writers:
                        writer.add(columns)
                    sample.add(columns)
                    advance(f"{sample.count:,} rows", chunk.bytes_read - read)
                    read = chunk.bytes_read
                if note and not stated:
                    err.print(note)
                located = sample.located(locate)
                true = None if truth is None else read_truth(truth, located)
            if picture is not None:
                from kcal.report.positions import save_positions_picture

                save_positions_picture(picture, located, true)
            if web_map is not None:
                from kcal.report.map_page import save_map

                save_map(web_map, located, true, tiles=tiles, image=image, online=online)
        except KeyboardInterrupt:
            kept = ", ".join(map(str, written)) or "nothing"
            err.print(
                f"interrupted after {sample.count:,} rows; written: {kept}; other files are as they were", markup=False
            )
            raise typer.Exit(130) from None
    if as_json:
        summary = {
            "table": str(points),
            "rows": sample.count,
            "statuses": sample.statuses,
            "warnings": list(doubts),
            "pixel_sigma": noise,
            "interval": located.interval_note,
            "geoid": located.geoid,
            "written": list(map(str, written)),
        }
        print(json.dumps(summary, indent=1))
    elif streamed:
        err.print(_counts(sample.count, sample.statuses), markup=False)
    else:
        _print_positions(located, true, sample.statuses, stated=stated)
        print_wrote(*written)
    if "ok" not in sample.statuses:
        text = f"{points}: none of the {sample.count} pairs could be located; see the table"
        raise DegenerateError(with_command(text, mark_again(None, None, rig=rig)))


def _counts(rows: int, statuses: dict[str, int]) -> str:
    return f"{rows:,} rows: " + ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in statuses.items())


def _print_positions(located: Located, true: Tensor | None, statuses: dict[str, int], *, stated: bool) -> None:
    """Print the table with the reasons below it; of a long one the counts, and the rows that have a true position."""
    from kcal.locate.truth import position_errors
    from kcal.report.tables import position_rows

    errors = None if true is None else position_errors(located, true)
    rows = position_rows(located, errors)
    shown: Sequence[int] = range(len(located.positions))
    if located.rows is not None:
        out.print(_counts(located.rows, statuses), markup=False)
        shown = [] if true is None else true.isfinite().all(-1).nonzero()[:, 0].tolist()
        out.print(f"Pictures and maps show {len(located.positions):,} of them.", markup=False)
    if shown:
        print_table([rows[0], *(rows[i + 1] for i in shown)], left=(0, len(rows[0]) - 1))
    for position in (located.positions[i] for i in shown):
        if position.reason:
            out.print(f"* {one_line(position.name)}: {position.reason}", markup=False)
    noise = "the noise that the CSV states" if stated else f"{located.pixel_sigma:g} px of noise"
    out.print(f"Interval: {located.interval_note}; marks have {noise}.")
    out.print(f"Heights are ellipsoidal; geoid: {located.geoid or 'none found'}.")
