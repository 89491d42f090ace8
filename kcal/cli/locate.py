"""`kcal locate`: pixels of two cameras or more to positions on the Earth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcal.cli.commands import rarely
from kcal.cli.console import err, steps
from kcal.cli.inputs import MARKS, RIG, SURVEY
from kcal.cli.located_text import draw_positions, tell_located
from kcal.cli.pixel_sigma import PixelSigma
from kcal.files import check_picture, check_writable, written_files


def locate_command(
    rig: Annotated[Path, typer.Argument(help="Rig file from `kcal rig`."), RIG],
    points: Annotated[
        Path,
        typer.Argument(
            help="CSV with the columns name,left_u,left_v,right_u,right_v, or name,camera,u,v for any number of "
            "cameras; others are carried into GeoJSON and CSV."
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
    pitch: Annotated[float, rarely("DEG", "Elevation of the left camera's axis, positive up.")] = 0.0,
    roll: Annotated[float, rarely("DEG", "Roll of the left camera, clockwise as seen from behind it.")] = 0.0,
    grid: Annotated[
        str | None,
        rarely("CRS", "Map whose grid north --heading counts from, for example EPSG:32643; true north if not given."),
    ] = None,
    pixel_sigma: PixelSigma = None,
    yaw_sigma: Annotated[
        float,
        typer.Option(metavar="DEG", help="Standard deviation of the relative yaw, added to the rig file's.", min=0),
    ] = 0.0,
    aged: Annotated[
        str | None,
        rarely(
            "9h:DEG,8K:DEG",
            "Hours since the rig was solved, and degrees of yaw that it loses in one; the same for kelvin.",
        ),
    ] = None,
    watch: Annotated[
        Path | None,
        typer.Option(
            metavar="HISTORY",
            help="History of `kcal watch`: each row, with its column time, is located by the rig as it stood then.",
        ),
    ] = None,
    heading_sigma: Annotated[
        float, rarely("DEG", "Standard deviation of the heading, added to the rig file's.", min=0)
    ] = 0.0,
    origin_sigma: Annotated[
        float, rarely("M", "Standard deviation of the origin along each axis, added to the rig file's.", min=0)
    ] = 0.0,
    refraction: Annotated[
        float | None,
        rarely(
            "K",
            "Refraction: 0.13, the default, lowers a point at 5 km by 0.26 m; 0 for straight lines. A rig solved "
            "from landmarks has its own.",
        ),
    ] = None,
    refraction_sigma: Annotated[
        float | None, rarely("K", "Its standard deviation, 0.1; 0.5 for lines of sight near hot or cold ground.", min=0)
    ] = None,
    height: Annotated[
        str | None,
        typer.Option(
            metavar="M±SIGMA",
            help="Height above the ellipsoid of what one camera alone saw; otherwise that has a bearing only.",
        ),
    ] = None,
    terrain: Annotated[
        Path | None,
        rarely(
            "RASTER",
            "In place of --height: heights of the ground on which it stands, an ESRI ASCII grid (.asc), or a "
            "GeoTIFF (needs 'kcal\\[terrain]').",
        ),
    ] = None,
    terrain_sigma: Annotated[float, rarely("M", "Standard deviation of the terrain's heights.", min=0.01)] = 3.0,
    geoid_height: Annotated[float, rarely("M", "Added to the terrain's heights if they are above the sea.")] = 0.0,
    geoid: Annotated[Path | None, rarely("", "Geoid grid file (.tif, .gtx); one that PROJ finds if not given.")] = None,
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
        str, rarely("NAME", "Format of `-o -`: csv, geojson, geojsonl, kml or cot.", "--format")
    ] = "csv",
    as_json: Annotated[bool, typer.Option("--json", help="Print a summary as JSON in place of the table.")] = False,
    picture: Annotated[Path | None, typer.Option(help="PNG file to write: the map and the intervals.")] = None,
    web_map: Annotated[
        Path | None, typer.Option("--map", help="HTML file to write: an interactive map that needs no network.")
    ] = None,
    tiles: Annotated[Path | None, rarely("FOLDER", "With --map: folder of tiles FOLDER/zoom/x/y.png to embed.")] = None,
    image: Annotated[Path | None, rarely("TIF", "With --map: GeoTIFF to embed.")] = None,
    online: Annotated[bool, rarely("", "With --map: let the page load tiles of OpenStreetMap.", "--online")] = False,
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

    Of several cameras (one line for each mark: name,camera,u,v) any may have seen a thing; with three or more, a mark
    that contradicts the others is left out and named. One camera alone gives a bearing, or a position at --height or
    where its line of sight meets the --terrain.

    A rig that was watched is known better: with `--watch`, attitude and its sigma are those of each row's time (Unix
    seconds or ISO). Without a history, `--aged` says what is lost since the rig was solved.

    A table may have any length: rows are read, located and written in turn. Beyond 1,000 rows the screen shows counts
    only, and pictures and maps show evenly spaced rows and those that have a true position.

    The exit code is 1 if nothing could be located.

    **Examples**

    `kcal locate rig.json points.csv --origin 19.07,72.87,14 --heading 35 -o points.geojson`

    `kcal locate rig.json points.csv --map map.html --truth survey.csv`

    `kcal locate rig.json points.csv --origin -33.9,151.2,10 --heading 250 --pitch -1.5 -o p.geojson -o p.csv
    --picture map.png`

    `kcal locate rig.json detections.csv -o - --format geojsonl | head`

    `kcal locate towers.rig.json smoke.csv --height 240±30 --map map.html`
    """
    from kcal.cli.locate_runs import LocateOptions, locate_run
    from kcal.cli.stations import parse_height
    from kcal.lens.mounting import Origin
    from kcal.locate.export import STREAM, check_format, open_writers
    from kcal.locate.sample import PositionSample
    from kcal.locate.survey import read_survey
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
    run = locate_run(
        rig,
        points,
        LocateOptions(
            pixel_sigma=pixel_sigma, place=place, heading=heading, pitch=pitch, roll=roll, grid=grid,
            yaw_sigma=yaw_sigma, aged=aged, watch=watch, heading_sigma=heading_sigma, origin_sigma=origin_sigma,
            refraction=refraction, refraction_sigma=refraction_sigma,
            height=None if height is None else parse_height(height), terrain=terrain, terrain_sigma=terrain_sigma,
            geoid_height=geoid_height, geoid=geoid,
        ),
    )  # fmt: skip
    survey = None if truth is None else read_survey(truth, run.empty.origin, measured=False)
    sample = PositionSample(frozenset(survey.names if survey else ()))
    with written_files() as written:
        try:
            size = points.stat().st_size if points.is_file() else None
            with open_writers(outputs, run.empty, suffix) as writers, steps("locating", size) as advance:
                read, stated = 0, False
                for part in run.parts:
                    stated = stated or part.stated
                    for writer in writers:
                        writer.add(part.columns)
                    sample.add(part.columns, part.feet)
                    advance(f"{sample.count:,} rows", part.bytes_read - read)
                    read = part.bytes_read
                if run.note and not stated:
                    err.print(run.note)
                located = sample.located(run.locate)
                true = None if truth is None else read_truth(truth, located)
            draw_positions(located, true, picture, web_map, tiles=tiles, image=image, online=online)
        except KeyboardInterrupt:
            kept = ", ".join(map(str, written)) or "nothing"
            err.print(
                f"interrupted after {sample.count:,} rows; written: {kept}; other files are as they were", markup=False
            )
            raise typer.Exit(130) from None
    tell_located(
        rig, points, located, true, sample, written, as_json=as_json, streamed=streamed, stated=stated,
        doubts=run.doubts,
    )  # fmt: skip
