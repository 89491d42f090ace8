"""`kcal locate`: pixels of two cameras or more to positions on the Earth."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, TypeAlias

import typer

import kcal
from kcal.cli import console, kinds, rooms
from kcal.cli.console import err, out, print_table, print_wrote, steps, tell, warn
from kcal.cli.inputs import pixel_sigma_and_source, typed
from kcal.cli.options import Kind, Rare, settings_file, taken
from kcal.errors import DegenerateError, InputError
from kcal.files import written_files
from kcal.texts import counted_text, one_line

# Positions; whether the table states noise; how far it is read.
LocatedPart: TypeAlias = "tuple[rooms.PositionColumns, bool, int]"


# What `kcal locate` prints and draws of positions.


def counts_text(rows: int, statuses: dict[str, int]) -> str:
    """How many rows have each status."""
    counts = (f"{count:,} {name.replace('_', ' ')}" for name, count in statuses.items())
    return f"{counted_text(rows, 'row')}: {', '.join(counts)}"


def _print_positions(
    located: rooms.Located, true: rooms.Tensor | None, statuses: dict[str, int], *, stated: bool
) -> None:
    """Print the table with the reasons below it; of a long one the counts, and the rows that have a true position."""
    rows = rooms.position_rows(located, None if true is None else rooms.position_errors(located, true))
    shown: Sequence[int] = range(len(located.positions))
    if located.rows is not None:
        out.print(counts_text(located.rows, statuses))
        shown = [] if true is None else true.isfinite().all(-1).nonzero()[:, 0].tolist()
        out.print(f"Pictures and maps show {len(located.positions):,} of them.")
    if shown:
        print_table([rows[0], *(rows[i + 1] for i in shown)], left=(0, len(rows[0]) - 1))
    for position in (located.positions[i] for i in shown):
        if position.reason:
            out.print(f"* {one_line(position.name)}: {position.reason}")
    noise = "the noise that the CSV states" if stated else f"{located.pixel_sigma:g} px of noise"
    out.print(f"Interval: {located.interval_note}; marks have {noise}.")
    if located.origin is None:
        out.print(f"This rig has no place on the Earth: positions are meters, {located.frame}.")
    else:
        out.print(f"Heights are ellipsoidal; geoid: {located.geoid or 'none found'}.")


# What `kcal locate` does with a table, part by part: pairs of a rig of two cameras, or marks of any number of them.


_SETTING = Kind(setting=True)


@dataclasses.dataclass(frozen=True, kw_only=True)
class LocateOptions:
    """How a table is located.

    Args:
        site: Position of the left camera, and its standard deviation along each axis, which is added to the rig
            file's; from the rig file if not given.
        heading: Azimuth of the left camera's axis, clockwise from true north, and its standard deviation, which is
            added to the rig file's; needed with --site.
        pitch: Elevation of the left camera's axis, positive up.
        roll: Roll of the left camera, clockwise as seen from behind it.
        grid: Map whose grid north --heading counts from, for example EPSG:32643; true north if not given.
        yaw_sigma: Standard deviation of the relative yaw, added to the rig file's.
        aged: Hours since the rig was solved, and degrees of yaw that it loses in one; the same for kelvin.
        history: History of `kcal watch`: each row, with its column time, is located by the rig as it stood then.
        refraction: Refraction, and its standard deviation: 0.13±0.1, the default, lowers a point at 5 km by 0.26 m; 0
            for straight lines; ±0.5 for lines of sight near hot or cold ground. A rig solved from landmarks has its
            own.
        height: Height above the ellipsoid of what one camera alone saw, ± 1 m if not stated; otherwise that has a
            bearing only.
        terrain: In place of --height: heights of the ground on which it stands, an ESRI ASCII grid (.asc), or a GeoTIFF
            (needs 'kcal[terrain]').
        terrain_sigma: Standard deviation of the terrain's heights.
        geoid: Height of the geoid above the WGS84 ellipsoid, added to the terrain's heights if these are above the sea.
        geoid_grid: Geoid grid file (.tif, .gtx) for the heights of the geoid in the output; one that PROJ finds if not
            given.
    """

    site: Annotated[kinds.Place, _SETTING] | None = None
    heading: Annotated[kinds.MeasuredDegrees, _SETTING] | None = None
    pitch: Rare[kinds.Degrees] = 0.0
    roll: Rare[kinds.Degrees] = 0.0
    grid: Rare[Annotated[str, Kind(metavar="CRS")] | None] = None
    pixel_sigma: kinds.PixelSigma | None = None
    yaw_sigma: kinds.DegreesSigma = 0.0
    aged: Rare[kinds.Aging | None] = None
    history: kinds.History | None = None
    refraction: Rare[kinds.MeasuredRefraction | None] = None
    height: kinds.Height | None = None
    terrain: Rare[kinds.Raster | None] = None
    terrain_sigma: Rare[Annotated[float, Kind(metavar="M", least=0.01, of="terrain")]] = 3.0
    geoid: Annotated[Rare[kinds.Meters | None], Kind(of="terrain")] = None
    geoid_grid: Rare[Path | None] = None

    def __post_init__(self) -> None:
        if (self.site is None) != (self.heading is None):
            raise typer.BadParameter("--site and --heading belong together")
        if self.heading is None and (self.pitch or self.roll or self.grid is not None):
            raise typer.BadParameter(
                "--pitch, --roll and --grid belong to --heading; the rig file has its own attitude"
            )


def locate_run(rig: Path, points: Path, own: LocateOptions) -> tuple[rooms.PointLocator, Iterator[LocatedPart], str]:
    """Read a rig and begin a table: marks of several cameras, or of one with a height or a terrain, or pairs.

    Returns:
        by which it is located; what locates it, part by part; and where the noise of marks is from, to be said if the
        table does not state it.
    """
    solved = kcal.load_rig(rig)
    stated = own.height is not None or own.terrain is not None
    many = stated or rooms.is_long(points) or not solved.is_pair
    if many:
        refuse_of_pairs(own)
    elif own.aged is not None and own.history is not None:
        raise typer.BadParameter("--aged guesses what --history tells: give either")
    noise, note = pixel_sigma_and_source(own.pixel_sigma, solved)
    warn(*(f"{rig}: {text}" for text in (solved.calibration.warnings if solved.calibration else ())))
    by_moments: Callable[[kcal.locate.Marks], rooms.PositionColumns] | None = None
    geoid = kcal.locate.find_geoid(own.geoid_grid)
    if many:
        ground = None if own.terrain is None else kcal.locate.terrain(own.terrain, own.geoid)
        locate = rooms.PointLocator(
            kcal.Localizer(solved, weights="all", pixel_sigma=noise), geoid=geoid, ground=ground,
            height=own.height if ground is None else (0.0, own.terrain_sigma),
        )  # fmt: skip
    else:
        localize = pair_localizer(solved, own, noise)
        whole = localize(solved)
        if own.history is not None:
            # Moments add what is not known of them.
            whole.included = ("marks", "calibration", *(("mounting",) if whole.origin else ()))
            by_moments = rooms.located_at(
                own.history, solved, lambda rig: rooms.PointLocator(localize(rig), geoid=geoid)
            )
        locate = rooms.PointLocator(whole, geoid=geoid)

    def parts() -> Iterator[LocatedPart]:
        for marks, read in rooms.read_mark_chunks(points, solved.names, single=many):
            yield (by_moments or locate)(marks), marks.covariance_or(noise) is not None, read

    return locate, parts(), note


def refuse_of_pairs(own: LocateOptions) -> None:
    """Refuse options of two cameras, whose rig's file does not say where they stand, for any other rig."""
    elsewhere = own.site or own.heading or own.yaw_sigma or own.refraction or own.aged or own.history
    if elsewhere and not {"site", "heading"} & taken:
        raise typer.BadParameter(
            "of several cameras position, attitude and their errors come from the rig file: leave out --site, "
            "--heading, --yaw-sigma, --refraction, --aged and --history"
        )
    if own.height is not None and own.terrain is not None:
        raise typer.BadParameter("--height and --terrain both say where a point that one camera saw stands: give one")


def pair_localizer(solved: kcal.Rig, own: LocateOptions, noise: float) -> Callable[[kcal.Rig], kcal.Localizer]:
    """What makes a localizer of two cameras as they were solved, or as they stand at another time.

    Args:
        solved: the rig of the file.
        own: where it stands, if not as its file says, and what errors come on top.
        noise: of marks, px.
    """
    yaw_sigma = math.hypot(own.yaw_sigma, own.aged or 0.0)
    site, heading = own.site, own.heading
    if solved.mounting is not None and {"site", "heading"} <= taken:
        # What the rig was solved with is better known.
        site = heading = None
        err.print(f"the position of the rig is that in its file, not that in {settings_file()}")
    azimuth = None if heading is None else heading.value
    if site is not None and azimuth is not None and own.grid is not None:
        azimuth = rooms.true_from_grid(azimuth, site.origin, own.grid)
    refraction, refraction_sigma = own.refraction or (None, None)

    def localize(standing: kcal.Rig) -> kcal.Localizer:
        if site or heading or own.pitch or own.roll or own.refraction:
            standing = standing.placed(
                origin=None if site is None else site.origin, heading_deg=azimuth, pitch_deg=own.pitch,
                roll_deg=own.roll, refraction=refraction, refraction_sigma=refraction_sigma,
            )  # fmt: skip
        standing = rooms.with_stated_errors(
            standing, yaw_deg=yaw_sigma, heading_deg=heading.sigma or 0.0 if heading else 0.0,
            origin_m=site.sigma or 0.0 if site else 0.0,
        )  # fmt: skip
        return kcal.Localizer(standing, weights="marks", pixel_sigma=noise)

    return localize


def locate_command(
    rig: kinds.RigFile,
    points: kinds.Marks,
    *,
    options: LocateOptions,
    truth: kinds.Survey | None = None,
    output: list[kinds.NewFile] | None = None,
    format: Rare[Annotated[str, Kind(metavar="NAME")]] = "csv",
    picture: kinds.Picture | None = None,
    map_: Annotated[Path, Kind(writes=True)] | None = None,
    tiles: Rare[Annotated[Path, Kind(metavar="FOLDER", of="map_")] | None] = None,
    image: Rare[Annotated[Path, Kind(metavar="TIF", of="map_")] | None] = None,
    online: Annotated[Rare[bool], Kind(of="map_")] = False,
) -> None:
    """Locate points that were marked in both images: latitude, longitude, height and a 95 % range interval.

    The interval includes noise in the marks, and the errors of calibration and mounting that the rig file contains.
    0.01° of relative yaw is 436 m at 5 km with a baseline of 10 m; `--yaw-sigma` adds such an error. If the parallax is
    below three sigma, only the bearing is given. Heights are ellipsoidal; with a geoid grid the files also contain the
    height of the geoid.

    Light bends: `--refraction` lowers points by K d² / 2R at the horizontal distance d, R being the Earth's radius, and
    what is not known of K is part of the height's error, but not of the range's.

    The rig file of a rig that was solved with landmarks contains its position: `--site` and `--heading` are then not
    needed. Without any position, points are meters in the rig's own frame, which is the left camera's (x right, y down,
    z forward); they can be written as CSV.

    Of several cameras (one line for each mark: name,camera,u,v) any may have seen a point; with three or more, a mark
    that contradicts the others is left out and named. One camera alone gives a bearing, or a position at --height or
    where its line of sight meets the --terrain.

    A rig that was watched is known better: with `--history`, attitude and its sigma are those of each row's time (Unix
    seconds or ISO). Without a history, `--aged` says what is lost since the rig was solved.

    A table may have any length: rows are read, located and written in turn. Beyond 1,000 rows the screen shows counts
    only, and pictures and maps show evenly spaced rows and those that have a true position.

    The exit code is 1 if nothing could be located.

    **Examples**

    `kcal locate rig.json points.csv --site 19.07,72.87,14 --heading 35 -o points.geojson`

    `kcal locate rig.json points.csv --map map.html --truth survey.csv`

    `kcal locate rig.json points.csv --site -33.9,151.2,10 --heading 250±0.1 --pitch -1.5 -o p.geojson -o p.csv
    --picture map.png`

    `kcal locate rig.json detections.csv -o - --format geojsonl | head`

    `kcal locate towers.rig.json smoke.csv --height 240±30 --map map.html`

    Args:
        rig: Rig file from `kcal rig`.
        points: CSV with the columns name,left_u,left_v,right_u,right_v, or name,camera,u,v for any number of cameras;
            others are carried into GeoJSON and CSV.
        truth: True positions, name,lat,lon,height, to show errors in the table and on the maps.
        output: File to write, .geojson, .geojsonl, .csv, .kml, .cot, .parquet or .gpkg; may be repeated; - for the
            standard output.
        format: Format of `-o -`: csv, geojson, geojsonl, kml, cot, parquet or gpkg.
        picture: A plan and the intervals.
        map_: HTML file to write: an interactive map that needs no network.
        tiles: With --map: folder of tiles FOLDER/zoom/x/y.png to embed.
        image: With --map: GeoTIFF to embed.
        online: With --map: let the page load tiles of OpenStreetMap.
    """
    outputs = output or []
    streamed = rooms.STREAM in outputs
    suffix = f".{format}"
    if streamed and ("--json" in typed or outputs.count(rooms.STREAM) > 1):
        raise typer.BadParameter("-o - takes the standard output for itself; leave out --json and a second -o -")
    if streamed:
        console.end_line()
    named = [f"positions{suffix}" if path == rooms.STREAM else path for path in outputs]
    for name in named:
        rooms.check_format(name)
    if map_ is not None:
        rooms.check_map_format(map_)
    locate, parts, note = locate_run(rig, points, options)
    empty = locate.located()
    for name in named:
        rooms.check_place(name, empty)
    if not empty.origin:
        for option, given in (("--map", map_), ("--picture", picture), ("--truth", truth)):
            if given is not None:
                raise InputError(f"{option}: {rooms.NOWHERE}")
    survey = None if truth is None else rooms.read_survey(truth, empty.origin, measured=False)
    sample = rooms.PositionSample(frozenset(survey.names if survey else ()))
    with written_files() as written:
        try:
            size = points.stat().st_size if points.is_file() else None
            with rooms.open_writers(outputs, empty, suffix) as writers, steps("locating", size) as advance:
                read, stated = 0, False
                for columns, known, end in parts:
                    stated = stated or known
                    for writer in writers:
                        writer.add(columns)
                    sample.add(columns)
                    advance(f"{sample.count:,} rows", end - read)
                    read = end
                if note and not stated:
                    err.print(note)
                located = sample.located(locate)
                true = None if truth is None else rooms.read_truth(truth, located)
            if picture is not None:
                draw = kcal.report.positions_figure if located.centers is None else rooms.stations_figure
                kcal.report.save_picture(picture, draw(located, true))
            if map_ is not None:
                kcal.report.save_map(map_, located, true, tiles=tiles, image=image, online=online)
        except KeyboardInterrupt:
            kept = ", ".join(map(str, written)) or "nothing"
            err.print(f"interrupted after {sample.count:,} rows; written: {kept}; other files are as they were")
            raise typer.Exit(130) from None
    tell(
        table=str(points), rows=sample.count, statuses=sample.statuses, pixel_sigma=located.pixel_sigma,
        frame=located.frame, interval=located.interval_note, geoid=located.geoid,
    )  # fmt: skip
    if streamed:
        err.print(counts_text(sample.count, sample.statuses))
    else:
        _print_positions(located, true, sample.statuses, stated=stated)
        print_wrote(*written)
    if "ok" not in sample.statuses:
        rows = "pairs" if located.centers is None else "points"
        text = f"{points}: none of the {sample.count} {rows} could be located; see the table"
        raise DegenerateError(console.with_command(text, console.mark_again("--rig", rig)))
