"""`kcal locate`: pixel pairs to positions on the Earth."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from kcal.locate.positions import Located, Position


def locate(
    rig: Annotated[Path, typer.Argument(help="Rig file from `kcal rig`.")],
    points: Annotated[Path, typer.Argument(help="CSV with the columns name,left_u,left_v,right_u,right_v.")],
    origin: Annotated[
        str | None,
        typer.Option(
            metavar="LAT,LON,HEIGHT",
            help="Left camera: degrees, degrees, meters above the WGS84 ellipsoid. From the rig file if it has it.",
        ),
    ] = None,
    heading: Annotated[
        float | None,
        typer.Option(metavar="DEG", help="Azimuth of the left camera's axis, clockwise from true north."),
    ] = None,
    pitch: Annotated[float, typer.Option(metavar="DEG", help="Elevation of the left camera's axis, up.")] = 0.0,
    roll: Annotated[
        float, typer.Option(metavar="DEG", help="Roll of the left camera, clockwise as seen from behind it.")
    ] = 0.0,
    grid: Annotated[
        str | None,
        typer.Option(metavar="CRS", help="The heading counts from this map's grid north, e.g. EPSG:32643."),
    ] = None,
    pixel_sigma: Annotated[float, typer.Option(metavar="PX", help="Noise of the marks along each axis.")] = 0.3,
    yaw_sigma: Annotated[
        float, typer.Option(metavar="DEG", help="One sigma of the rig's relative yaw; it widens the intervals.", min=0)
    ] = 0.0,
    heading_sigma: Annotated[
        float, typer.Option(metavar="DEG", help="One sigma of the heading; it widens the regions.", min=0)
    ] = 0.0,
    origin_sigma: Annotated[
        float, typer.Option(metavar="M", help="One sigma of the origin along each axis.", min=0)
    ] = 0.0,
    refraction: Annotated[
        float, typer.Option(metavar="K", help="Bending of light; 0.13 in standard air, 0 for straight lines.")
    ] = 0.0,
    geoid: Annotated[
        Path | None, typer.Option(help="A geoid grid (.tif, .gtx); one that PROJ finds is used if not given.")
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(metavar="CSV", help="True positions, name,lat,lon,height: errors in the table and on the maps."),
    ] = None,
    output: Annotated[
        list[Path] | None,
        typer.Option("--output", "-o", help="A .geojson, .csv, .kml or .cot file to write; may be repeated."),
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="A .png file for the map.")] = None,
    web_map: Annotated[
        Path | None, typer.Option("--map", help="An .html file for an interactive map that needs no network.")
    ] = None,
    tiles: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="For --map: tiles FOLDER/zoom/x/y.png to embed.")
    ] = None,
    image: Annotated[Path | None, typer.Option(metavar="TIF", help="For --map: a GeoTIFF to embed.")] = None,
    online: Annotated[
        bool, typer.Option("--online", help="For --map: let the page load tiles of OpenStreetMap.")
    ] = False,
) -> None:
    """Locate what was marked in both images: latitude, longitude, height and an honest range interval.

    The interval holds the true range for 95 % of marks with the given noise. Errors of the rig come on top: those that
    the rig file holds are included, and `--yaw-sigma` adds some; 0.01° of relative yaw is 436 m at 5 km with a baseline
    of 10 m. Where the parallax is below three sigma only the bearing is given. Heights are ellipsoidal; with a geoid
    grid the files also hold the height of the geoid.

    A rig that was solved with landmarks knows where it stands: then no `--origin` and `--heading` are needed.

    Ends with exit code 1 if nothing at all could be located.

    **Examples**

    `kcal locate rig.json points.csv --origin 19.07,72.87,14 --heading 35 -o points.geojson`

    `kcal locate rig.json points.csv --map map.html --truth survey.csv`

    `kcal locate rig.json points.csv --origin -33.9,151.2,10 --heading 250 --pitch -1.5 -o p.geojson -o p.csv
    --picture map.png`
    """
    import math

    import torch

    from kcal.cli.console import out, steps
    from kcal.errors import DegenerateError, InputError
    from kcal.files import check_writable
    from kcal.io.rig_file import RigFile
    from kcal.lens.rig import RigCovariance
    from kcal.locate.datum import find_geoid, true_from_grid
    from kcal.locate.export import check_format, write_positions
    from kcal.locate.geodesy import Origin
    from kcal.locate.marks import read_marks
    from kcal.locate.mounting import mounting_covariance
    from kcal.locate.positions import locate_points
    from kcal.locate.truth import position_errors, read_truth
    from kcal.report.figures import check_picture_format
    from kcal.report.map_page import check_map_format, save_map
    from kcal.report.positions import save_positions_picture

    outputs = output or []
    for path in outputs:
        check_format(path)
        check_writable(path, rig, points, *([truth] if truth else []))
    if picture is not None:
        check_picture_format(picture)
        check_writable(picture)
    if web_map is not None:
        check_map_format(web_map)
        check_writable(web_map)
    if (origin is None) != (heading is None):
        raise typer.BadParameter("--origin and --heading belong together")
    if heading is None and (pitch or roll or grid is not None):
        raise typer.BadParameter("--pitch, --roll and --grid belong to --heading; the rig file has its own attitude")
    # Before the rig is read: a wrong option is told first.
    place = None if origin is None else Origin.parse(origin)
    marks = read_marks(points)
    file = RigFile.load(rig)
    solved = file.rig()
    calibration = file.joint_covariance()
    if yaw_sigma:
        yaw = torch.zeros(6, 6, dtype=torch.float64)
        yaw[1, 1] = math.radians(yaw_sigma) ** 2
        more = RigCovariance.of(solved, pose=yaw).matrix
        calibration = more if calibration is None else calibration + more
    link = None
    standing = mounting_covariance(origin_m=[origin_sigma] * 3, attitude_deg=(0.0, 0.0, heading_sigma))
    if place is None or heading is None:
        stored = file.mounting
        if stored is None:
            raise InputError(f"{rig}: does not say where the rig stands; give --origin and --heading")
        place = Origin(lat=stored.lat, lon=stored.lon, height=stored.height)
        heading, pitch, roll = stored.heading_deg, stored.pitch_deg, stored.roll_deg
        if stored.covariance is not None:
            standing = standing + torch.tensor(stored.covariance, dtype=torch.float64)
        if stored.link is not None:
            link = torch.tensor(stored.link, dtype=torch.float64)
    heights = find_geoid(geoid)
    located = locate_points(
        solved,
        marks.left,
        marks.right,
        origin=place,
        heading_deg=heading if grid is None else true_from_grid(heading, place, grid),
        pitch_deg=pitch,
        roll_deg=roll,
        pixel_sigma=pixel_sigma,
        names=marks.names,
        calibration=None if calibration is None else RigCovariance.of(solved, joint=calibration),
        mounting=standing if bool(standing.any()) else None,
        link=link,
        refraction=refraction,
        geoid=heights,
    )
    true = None if truth is None else read_truth(truth, located)
    written = [*outputs, *(path for path in (picture, web_map) if path is not None)]
    with steps("writing", len(written)) as advance:
        for path in outputs:
            write_positions(path, located)
            advance(path.name)
        if picture is not None:
            save_positions_picture(picture, located, true)
            advance(picture.name)
        if web_map is not None:
            save_map(web_map, located, true, tiles=tiles, image=image, online=online)
            advance(web_map.name)
    for line in _table(located, None if true is None else position_errors(located, true)):
        out.print(line, markup=False)
    for position in located.positions:
        if position.reason:
            out.print(f"* {position.name}: {position.reason}", markup=False)
    out.print(f"Interval: {located.interval_note}; marks have {pixel_sigma:g} px.")
    out.print(f"Heights are ellipsoidal; geoid: {located.geoid or 'none at hand'}.")
    for path in written:
        out.print(f"wrote {path}", markup=False)
    if located.count == 0:
        raise DegenerateError(f"{points}: none of the {len(located.positions)} pairs could be located; see the table")


def _table(located: Located, off: list[tuple[float, float, bool] | None] | None = None) -> list[str]:
    """Aligned lines as wide as they need: a table fitted to the 80 columns of a pipe would cut names and digits."""
    rows = [["name", "lat °", "lon °", "height m", "range m", "interval m", "status"]]
    rows += [_row(position) for position in located.positions]
    if off is not None:
        rows[0][-1:-1] = ["off level m", "off in range m", "in interval"]
        for row, miss in zip(rows[1:], off, strict=True):
            row[-1:-1] = (
                ["", "", ""] if miss is None else [_meters(miss[0]), f"{miss[1]:+.1f}", "yes" if miss[2] else "no"]
            )
    widths = [max(len(cell) for cell in column) for column in zip(*rows, strict=True)]
    lines = []
    for name, *numbers, status in rows:
        cells = [name.ljust(widths[0])]
        cells += [number.rjust(width) for number, width in zip(numbers, widths[1:-1], strict=True)]
        lines.append("  ".join([*cells, status]))
    return lines


def _row(position: Position) -> list[str]:
    low, high = position.range_low_m, position.range_high_m
    numbers = ["", "", "", ""]
    if position.lat is not None and position.lon is not None and position.height is not None:
        numbers = [
            f"{position.lat:.7f}",
            f"{position.lon:.7f}",
            f"{position.height:.1f}",
            _meters(position.range_m or 0),
        ]
    interval = "" if low is None or high is None else f"{_meters(low)} – {_meters(high)}"
    status = position.status.name.lower().replace("_", " ")
    return [position.name, *numbers, interval, f"{status} *" if position.reason else status]


def _meters(value: float) -> str:
    return "∞" if value == float("inf") else f"{value:.1f}" if value < 1000 else f"{value:.0f}"
