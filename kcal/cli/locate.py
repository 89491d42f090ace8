"""`kcal locate`: pixels of two cameras or more to positions on the Earth."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from kcal.cli.console import end_line, err, mark_again, out, print_table, print_wrote, steps, warn, with_command
from kcal.cli.inputs import MARKS, RIG, SURVEY, PixelSigma, pixel_sigma_and_source
from kcal.cli.settings import picture_option, rarely, settings_file, taken
from kcal.cli.stations import parse_height
from kcal.errors import DegenerateError, InputError
from kcal.files import check_writable, written_files
from kcal.texts import one_line

if TYPE_CHECKING:
    from torch import Tensor

    from kcal.lens.rig import Origin, Rig
    from kcal.locate.marks import Marks
    from kcal.locate.points import PointLocator, PositionSample
    from kcal.locate.positions import Located
    from kcal.locate.tables import PositionColumns

    Locate = Callable[[Marks], tuple[PositionColumns, Tensor | None]]


# Rows of a table that are located by a watched rig, each as the rig stood at its time.


def located_at(history: Path, rig: Rig, locator: Callable[[Rig], PointLocator]) -> Locate:
    """What locates rows with a column `time`: by the rig of that second.

    Args:
        history: of `kcal watch`.
        rig: as it was solved and watched.
        locator: makes what locates by a rig.
    """
    from kcal.locate.tables import PositionColumns
    from kcal.watch.history import seconds_of
    from kcal.watch.watcher import Watched

    watched: Watched | None = None

    def locate(marks: Marks) -> tuple[PositionColumns, Tensor | None]:
        nonlocal watched
        texts = marks.extras.get("time")
        if texts is None:
            raise InputError("--watch: the table needs a column time (Unix seconds, or like 2026-05-01T12:00:00Z)")
        times = []
        for name, text in zip(marks.names, texts, strict=True):
            try:
                times.append(round(seconds_of(text)))
            except InputError as error:
                raise InputError(f"{name}: {error}") from None
        if not times:
            return locator(rig)(marks)
        if watched is None or min(times) < watched.since or max(times) > watched.until:
            watched = Watched.read(history, rig, since=min(times), until=max(times))
        parts = []
        for time, group in itertools.groupby(range(len(times)), times.__getitem__):
            rows = list(group)
            standing = locator(watched.rig_at(float(time)))
            parts.append(standing(marks.rows(slice(rows[0], rows[-1] + 1)))[0])
        return PositionColumns.joined(parts), None

    return locate


# What `kcal locate` prints and draws of positions.


def draw_positions(
    located: Located, true: Tensor | None, picture: Path | None, web_map: Path | None, **background: Any
) -> None:
    """Write the picture and the map, where they were asked for."""
    if picture is not None:
        from kcal.report.figures import save_picture
        from kcal.report.positions import positions_figure, stations_figure

        save_picture(picture, (positions_figure if located.feet is None else stations_figure)(located, true))
    if web_map is not None:
        from kcal.report.map_page import save_map

        save_map(web_map, located, true, **background)


def tell_located(
    rig: Path,
    points: Path,
    located: Located,
    true: Tensor | None,
    sample: PositionSample,
    written: Iterable[Path],
    *,
    as_json: bool,
    streamed: bool,
    stated: bool,
    doubts: Sequence[str],
) -> None:
    """Print what was found.

    Raises:
        DegenerateError: nothing could be located.
    """
    if as_json:
        summary = {
            "table": str(points),
            "rows": sample.count,
            "statuses": sample.statuses,
            "warnings": list(doubts),
            "pixel_sigma": located.pixel_sigma,
            "frame": located.frame,
            "interval": located.interval_note,
            "geoid": located.geoid,
            "written": list(map(str, written)),
        }
        end_line()
        print(json.dumps(summary, indent=1))
    elif streamed:
        err.print(counts_text(sample.count, sample.statuses), markup=False)
    else:
        _print_positions(located, true, sample.statuses, stated=stated)
        print_wrote(*written)
    if "ok" not in sample.statuses:
        rows = "pairs" if located.feet is None else "points"
        text = f"{points}: none of the {sample.count} {rows} could be located; see the table"
        raise DegenerateError(with_command(text, mark_again(None, None, rig=rig)))


def counts_text(rows: int, statuses: dict[str, int]) -> str:
    """How many rows have each status."""
    return f"{rows:,} rows: " + ", ".join(f"{count:,} {name.replace('_', ' ')}" for name, count in statuses.items())


def _print_positions(located: Located, true: Tensor | None, statuses: dict[str, int], *, stated: bool) -> None:
    """Print the table with the reasons below it; of a long one the counts, and the rows that have a true position."""
    from kcal.locate.positions import position_errors
    from kcal.report.tables import position_rows

    errors = None if true is None else position_errors(located, true)
    rows = position_rows(located, errors)
    shown: Sequence[int] = range(len(located.positions))
    if located.rows is not None:
        out.print(counts_text(located.rows, statuses), markup=False)
        shown = [] if true is None else true.isfinite().all(-1).nonzero()[:, 0].tolist()
        out.print(f"Pictures and maps show {len(located.positions):,} of them.", markup=False)
    if shown:
        print_table([rows[0], *(rows[i + 1] for i in shown)], left=(0, len(rows[0]) - 1))
    for position in (located.positions[i] for i in shown):
        if position.reason:
            out.print(f"* {one_line(position.name)}: {position.reason}", markup=False)
    noise = "the noise that the CSV states" if stated else f"{located.pixel_sigma:g} px of noise"
    out.print(f"Interval: {located.interval_note}; marks have {noise}.")
    if located.origin is None:
        out.print(f"This rig has no place on the Earth: positions are meters, {located.frame}.")
    else:
        out.print(f"Heights are ellipsoidal; geoid: {located.geoid or 'none found'}.")


# What `kcal locate` does with a table, part by part: pairs of a rig of two cameras, or marks of any number of them.


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocateOptions:
    """What the user gave besides the files, as on the command line."""

    pixel_sigma: float | None = None
    place: Origin | None = None
    heading: float | None = None
    pitch: float = 0.0
    roll: float = 0.0
    grid: str | None = None
    yaw_sigma: float = 0.0
    aged: str | None = None
    watch: Path | None = None
    heading_sigma: float = 0.0
    origin_sigma: float = 0.0
    refraction: float | None = None
    refraction_sigma: float | None = None
    height: tuple[float, float] | None = None
    terrain: Path | None = None
    terrain_sigma: float = 3.0
    geoid_height: float = 0.0
    geoid: Path | None = None


class LocatedPart(NamedTuple):
    """Some rows of a table.

    Attributes:
        columns: their positions.
        feet: (N, 3) where bearings count from, of several cameras; None: the left camera.
        stated: whether the table says how noisy its marks are.
        bytes_read: how far it has been read.
    """

    columns: PositionColumns
    feet: Tensor | None
    stated: bool
    bytes_read: int


class LocateRun(NamedTuple):
    """A table that is about to be located.

    Attributes:
        locate: by which it is.
        parts: locates it, part by part.
        doubts: what the rig's file warns of.
        note: where the noise of marks is from, to be said if the table does not state it.
    """

    locate: PointLocator
    parts: Iterator[LocatedPart]
    doubts: Sequence[str]
    note: str


def locate_run(rig: Path, points: Path, options: LocateOptions) -> LocateRun:
    """Read a rig and begin a table: marks of several cameras, or of one with a height or a terrain, or pairs."""
    from kcal.io.rig_file import load_rig
    from kcal.locate.localizer import Localizer
    from kcal.locate.marks import is_long, read_mark_chunks
    from kcal.locate.points import PointLocator
    from kcal.locate.raster import terrain
    from kcal.locate.tabulate import find_geoid

    own = options
    solved = load_rig(rig)
    stated = own.height is not None or own.terrain is not None
    many = stated or is_long(points) or len(solved) != 2 or not solved.in_first_frame
    if many:
        _refuse_of_pairs(own)
    elif own.aged and own.watch:
        raise typer.BadParameter("--aged guesses what the history of --watch tells: give either")
    noise, note = pixel_sigma_and_source(own.pixel_sigma, solved)
    doubts = _warned(rig, solved.calibration.warnings if solved.calibration else ())
    by_moments: Locate | None = None
    if many:
        ground = None if own.terrain is None else terrain(own.terrain, own.geoid_height)
        locate = PointLocator(
            Localizer(solved, weights="all", pixel_sigma=noise), geoid=find_geoid(own.geoid), ground=ground,
            height=own.height if ground is None else (0.0, own.terrain_sigma),
        )  # fmt: skip
    else:
        locate, by_moments = _of_pairs(solved, own, noise)

    def parts() -> Iterator[LocatedPart]:
        for marks, read in read_mark_chunks(points, solved.names, single=many):
            columns, feet = (by_moments or locate)(marks)
            yield LocatedPart(columns, feet, marks.covariance_or(noise) is not None, read)

    return LocateRun(locate, parts(), doubts, note)


def _refuse_of_pairs(own: LocateOptions) -> None:
    elsewhere = any(
        (
            own.place, own.yaw_sigma, own.heading_sigma, own.origin_sigma, own.refraction, own.refraction_sigma,
            own.aged, own.watch,
        )
    )  # fmt: skip
    if elsewhere and not {"origin", "heading"} & taken:
        raise typer.BadParameter(
            "of several cameras position, attitude and their errors come from the rig file: leave out --origin, "
            "--heading, --yaw-sigma, --heading-sigma, --origin-sigma, --refraction, --aged and --watch"
        )
    if own.height is not None and own.terrain is not None:
        raise typer.BadParameter("--height and --terrain both say where a point that one camera saw stands: give one")


def _of_pairs(solved: Rig, own: LocateOptions, noise: float) -> tuple[PointLocator, Locate | None]:
    """What locates pairs, and what does so by the history of a watched rig."""
    from kcal.lens.rig import RigCovariance
    from kcal.locate.localizer import Localizer
    from kcal.locate.mounting import run_errors
    from kcal.locate.points import PointLocator
    from kcal.locate.tabulate import find_geoid, true_from_grid
    from kcal.watch.turned import parse_aging

    yaw_sigma = math.hypot(own.yaw_sigma, parse_aging(own.aged))
    place, heading = own.place, own.heading
    if solved.mounting is not None and {"origin", "heading"} <= taken:
        # What the rig was solved with is better known.
        place = heading = None
        err.print(f"the position of the rig is that in its file, not that in {settings_file()}", markup=False)
    if place is not None and heading is not None and own.grid is not None:
        heading = true_from_grid(heading, place, own.grid)

    def locator(standing: Rig) -> PointLocator:
        errors = run_errors(
            standing, yaw_deg=yaw_sigma, heading_deg=own.heading_sigma, origin_m=own.origin_sigma,
            elsewhere=place is not None,
        )  # fmt: skip
        localize = Localizer(
            standing, weights="marks", origin=place, heading_deg=heading, pitch_deg=own.pitch, roll_deg=own.roll,
            pixel_sigma=noise, refraction=own.refraction, refraction_sigma=own.refraction_sigma, **errors._asdict(),
        )  # fmt: skip
        return PointLocator(localize, geoid=find_geoid(own.geoid))

    if own.watch is not None and solved.covariance is None:
        # Not exact: moments add what is not known of them.
        solved.covariance = RigCovariance.of(solved)
    return locator(solved), None if own.watch is None else located_at(own.watch, solved, locator)


def _warned(rig: Path, doubts: Sequence[str]) -> Sequence[str]:
    for text in doubts:
        warn(f"{rig}: {text}")
    return doubts


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
    picture: Annotated[Path | None, picture_option("a plan and the intervals.")] = None,
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
    needed. Without any position, points are meters in the rig's own frame, which is the left camera's (x right, y down,
    z forward); they can be written as CSV.

    Of several cameras (one line for each mark: name,camera,u,v) any may have seen a point; with three or more, a mark
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
    from kcal.lens.rig import Origin
    from kcal.locate.export import STREAM, check_format, check_place, open_writers
    from kcal.locate.points import PositionSample
    from kcal.locate.positions import NOWHERE, read_truth
    from kcal.locate.survey import read_survey

    outputs = output or []
    streamed = STREAM in outputs
    suffix = f".{stream_format}"
    if streamed and (as_json or outputs.count(STREAM) > 1):
        raise typer.BadParameter("-o - takes the standard output for itself; leave out --json and a second -o -")
    if streamed:
        end_line()
    for path in outputs:
        if path == STREAM:
            check_format(f"positions{suffix}")
            continue
        check_format(path)
        check_writable(path, rig, points, *([truth] if truth else []))
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
    empty = run.locate.located()
    for path in outputs:
        check_place(f"positions{suffix}" if path == STREAM else path, empty)
    if not empty.origin:
        for option, given in (("--map", web_map), ("--picture", picture), ("--truth", truth)):
            if given is not None:
                raise InputError(f"{option}: {NOWHERE}")
    survey = None if truth is None else read_survey(truth, empty.origin, measured=False)
    sample = PositionSample(frozenset(survey.names if survey else ()))
    with written_files() as written:
        try:
            size = points.stat().st_size if points.is_file() else None
            with open_writers(outputs, empty, suffix) as writers, steps("locating", size) as advance:
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
