"""`kcal locate`: pixel pairs to positions on the Earth."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from kcal.cli.console import err, steps, warn
from kcal.cli.inputs import MARKS, RIG, SURVEY, typed_with
from kcal.cli.located_text import draw_positions, tell_located
from kcal.cli.pixel_sigma import ASSUMED, PixelSigma, pixel_sigma_and_source
from kcal.cli.settings import taken
from kcal.errors import InputError
from kcal.files import check_picture, check_writable, written_files

if TYPE_CHECKING:
    from kcal.lens.rig import StereoRig


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
    watch: Annotated[
        Path | None,
        typer.Option(
            metavar="HISTORY",
            help="History of `kcal watch`: each row, with its column time, is located by the rig as it stood then.",
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
    height: Annotated[
        str | None,
        typer.Option(
            metavar="M±SIGMA",
            help="Height above the ellipsoid of what one camera alone saw; otherwise that has a bearing only.",
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

    Of several cameras (one line for each mark: name,camera,u,v) any may have seen a thing; with three or more, a mark
    that contradicts the others is left out and named. One camera alone gives a bearing, or a position at --height.

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
    from kcal.cli.stations import parse_height
    from kcal.cli.watched_rows import located_at
    from kcal.io.rig_file import load_rig
    from kcal.lens.mounting import Origin
    from kcal.lens.rig import RigCovariance
    from kcal.locate.aging import parse_aging
    from kcal.locate.datum import find_geoid, true_from_grid
    from kcal.locate.export import STREAM, check_format, open_writers
    from kcal.locate.marks import filled, read_mark_chunks
    from kcal.locate.mounting import run_errors
    from kcal.locate.positions import located_by
    from kcal.locate.sample import PositionSample
    from kcal.locate.station_positions import locate_views
    from kcal.locate.stations import load_camera_rig, names_of_rig
    from kcal.locate.survey import read_survey
    from kcal.locate.tabulate import Locator
    from kcal.locate.truth import read_truth
    from kcal.locate.view_marks import is_long, read_views

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
    stated_height = None if height is None else parse_height(height)
    if stated_height is not None or is_long(points) or len(names_of_rig(rig)) != 2:
        elsewhere = any((place, yaw_sigma, heading_sigma, origin_sigma, refraction, refraction_sigma, aged, watch))
        if elsewhere and not {"origin", "heading"} & taken:
            raise typer.BadParameter(
                "of several cameras position, attitude and their errors come from the rig file: leave out --origin, "
                "--heading, --yaw-sigma, --heading-sigma, --origin-sigma, --refraction, --aged and --watch"
            )
        stations = load_camera_rig(rig)
        views = read_views(points, stations.names)
        doubts = stations.calibration.warnings if stations.calibration else ()
        for text in doubts:
            warn(f"{rig}: {text}")
        told = stations.calibration.pixel_sigma if stations.calibration else None
        located = locate_views(
            stations, views, pixel_sigma=pixel_sigma or told or ASSUMED, height=stated_height, geoid=find_geoid(geoid)
        )
        with written_files() as written:
            with open_writers(outputs, located, suffix) as writers:
                for writer in writers:
                    writer.add(located.columns)
            true = None if truth is None else read_truth(truth, located)
            draw_positions(located, true, picture, web_map, tiles=tiles, image=image, online=online)
        sample = PositionSample()
        sample.add(located.columns)
        tell_located(
            rig, points, located, true, sample, written, as_json=as_json, streamed=streamed,
            stated=bool(views.sigma.isfinite().any()), doubts=doubts,
        )  # fmt: skip
        return
    if aged and watch:
        raise typer.BadParameter("--aged guesses what the history of --watch tells: give either")
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

    def locator(standing: StereoRig) -> Locator:
        errors = run_errors(
            standing, yaw_deg=yaw_sigma, heading_deg=heading_sigma, origin_m=origin_sigma, elsewhere=place is not None
        )
        return Locator(
            standing, geoid=find_geoid(geoid), origin=place, heading_deg=heading, pitch_deg=pitch, roll_deg=roll,
            pixel_sigma=noise, calibration=errors.calibration, mounting=errors.mounting, link=errors.link,
            refraction=refraction, refraction_sigma=refraction_sigma,
        )  # fmt: skip

    if watch is not None and solved.covariance is None:
        # Not exact: moments add what is not known of them.
        solved.covariance = RigCovariance.of(solved)
    locate = locator(solved)
    at_moments = None if watch is None else located_at(watch, solved, locator)
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
                    columns = (at_moments or locate)(chunk.names, chunk.pixels, cov, chunk.extras)
                    for writer in writers:
                        writer.add(columns)
                    sample.add(columns)
                    advance(f"{sample.count:,} rows", chunk.bytes_read - read)
                    read = chunk.bytes_read
                if note and not stated:
                    err.print(note)
                located = sample.located(locate)
                true = None if truth is None else read_truth(truth, located)
            draw_positions(located, true, picture, web_map, tiles=tiles, image=image, online=online)
        except KeyboardInterrupt:
            kept = ", ".join(map(str, written)) or "nothing"
            err.print(
                f"interrupted after {sample.count:,} rows; written: {kept}; other files are as they were", markup=False
            )
            raise typer.Exit(130) from None
    tell_located(
        rig, points, located, true, sample, written, as_json=as_json, streamed=streamed, stated=stated, doubts=doubts
    )
