"""`kcal locate`: pixel pairs to positions on the Earth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from kcal.cli.console import out, print_table, print_wrote, steps
from kcal.errors import DegenerateError, InputError
from kcal.files import check_writable


def locate_command(
    rig: Annotated[Path, typer.Argument(help="Rig file from `kcal rig`.")],
    points: Annotated[Path, typer.Argument(help="CSV with the columns name,left_u,left_v,right_u,right_v.")],
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
        float, typer.Option(metavar="DEG", help="Elevation of the left camera's axis, positive up.")
    ] = 0.0,
    roll: Annotated[
        float, typer.Option(metavar="DEG", help="Roll of the left camera, clockwise as seen from behind it.")
    ] = 0.0,
    grid: Annotated[
        str | None,
        typer.Option(
            metavar="CRS",
            help="Map whose grid north --heading counts from, for example EPSG:32643; true north if not given.",
        ),
    ] = None,
    pixel_sigma: Annotated[
        float,
        typer.Option(metavar="PX", help="Standard deviation of the marks along each axis, where the CSV has none."),
    ] = 0.3,
    yaw_sigma: Annotated[
        float,
        typer.Option(metavar="DEG", help="Standard deviation of the relative yaw, added to the rig file's.", min=0),
    ] = 0.0,
    heading_sigma: Annotated[
        float, typer.Option(metavar="DEG", help="Standard deviation of the heading, added to the rig file's.", min=0)
    ] = 0.0,
    origin_sigma: Annotated[
        float,
        typer.Option(
            metavar="M", help="Standard deviation of the origin along each axis, added to the rig file's.", min=0
        ),
    ] = 0.0,
    refraction: Annotated[
        float | None,
        typer.Option(
            metavar="K",
            help="Refraction: 0.13, the default, lowers a point at 5 km by 0.26 m; 0 for straight lines. A rig solved "
            "from landmarks has its own.",
        ),
    ] = None,
    refraction_sigma: Annotated[
        float | None,
        typer.Option(
            metavar="K", help="Its standard deviation, 0.1; 0.5 for lines of sight near hot or cold ground.", min=0
        ),
    ] = None,
    geoid: Annotated[
        Path | None, typer.Option(help="Geoid grid file (.tif, .gtx); one that PROJ finds if not given.")
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV", help="True positions, name,lat,lon,height, to show errors in the table and on the maps."
        ),
    ] = None,
    output: Annotated[
        list[Path] | None,
        typer.Option("--output", "-o", help="File to write, .geojson, .csv, .kml or .cot; may be repeated."),
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="PNG file to write: the map and the intervals.")] = None,
    web_map: Annotated[
        Path | None, typer.Option("--map", help="HTML file to write: an interactive map that needs no network.")
    ] = None,
    tiles: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="With --map: folder of tiles FOLDER/zoom/x/y.png to embed.")
    ] = None,
    image: Annotated[Path | None, typer.Option(metavar="TIF", help="With --map: GeoTIFF to embed.")] = None,
    online: Annotated[
        bool, typer.Option("--online", help="With --map: let the page load tiles of OpenStreetMap.")
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

    The exit code is 1 if nothing could be located.

    **Examples**

    `kcal locate rig.json points.csv --origin 19.07,72.87,14 --heading 35 -o points.geojson`

    `kcal locate rig.json points.csv --map map.html --truth survey.csv`

    `kcal locate rig.json points.csv --origin -33.9,151.2,10 --heading 250 --pitch -1.5 -o p.geojson -o p.csv
    --picture map.png`
    """
    import math

    import torch

    from kcal.io.rig_file import load_rig
    from kcal.lens.mounting import Origin
    from kcal.lens.rig import RigCovariance
    from kcal.locate.datum import find_geoid, true_from_grid
    from kcal.locate.export import check_format, write_positions
    from kcal.locate.marks import read_marks
    from kcal.locate.mounting import mounting_covariance
    from kcal.locate.positions import locate_points
    from kcal.locate.truth import position_errors, read_truth
    from kcal.report.figures import check_picture
    from kcal.report.map_page import check_map_format, save_map
    from kcal.report.positions import save_positions_picture
    from kcal.report.tables import position_rows

    outputs = output or []
    for path in outputs:
        check_format(path)
        check_writable(path, rig, points, *([truth] if truth else []))
    if picture is not None:
        check_picture(picture)
    if web_map is not None:
        check_map_format(web_map)
        check_writable(web_map)
    if (origin is None) != (heading is None):
        raise typer.BadParameter("--origin and --heading belong together")
    if heading is None and (pitch or roll or grid is not None):
        raise typer.BadParameter("--pitch, --roll and --grid belong to --heading; the rig file has its own attitude")
    # Parsed before the rig is read, so that a wrong option is reported first.
    place = None if origin is None else Origin.parse(origin)
    marks = read_marks(points)
    solved = load_rig(rig)
    calibration, link = solved.covariance, None
    if yaw_sigma:
        yaw = torch.zeros(6, 6, dtype=torch.float64)
        yaw[1, 1] = math.radians(yaw_sigma) ** 2
        calibration = (calibration or RigCovariance.of(solved)).with_pose(yaw)
    mounting = mounting_covariance(origin_m=[origin_sigma] * 3, attitude_deg=(0.0, 0.0, heading_sigma))
    if place is None or heading is None:
        stored = solved.mounting
        if stored is None:
            raise InputError(f"{rig}: the file has no position of the rig; give --origin and --heading")
        if stored.covariance is not None:
            more = len(stored.covariance) - len(mounting)
            mounting = torch.nn.functional.pad(mounting, (0, more, 0, more)) + stored.covariance
        link = stored.link
    elif grid is not None:
        heading = true_from_grid(heading, place, grid)
    located = locate_points(
        solved,
        marks.left,
        marks.right,
        origin=place,
        heading_deg=heading,
        pitch_deg=pitch,
        roll_deg=roll,
        pixel_sigma=pixel_sigma,
        names=marks.names,
        cov=marks.covariance_or(pixel_sigma),
        calibration=calibration,
        mounting=mounting if bool(mounting.any()) else None,
        link=link,
        refraction=refraction,
        refraction_sigma=refraction_sigma,
        geoid=find_geoid(geoid),
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
    rows = position_rows(located, None if true is None else position_errors(located, true))
    print_table(rows, left=(0, len(rows[0]) - 1))
    for position in located.positions:
        if position.reason:
            out.print(f"* {position.name}: {position.reason}", markup=False)
    noise = f"{pixel_sigma:g} px of noise" if marks.covariance is None else "the noise that the CSV states"
    out.print(f"Interval: {located.interval_note}; marks have {noise}.")
    out.print(f"Heights are ellipsoidal; geoid: {located.geoid or 'none found'}.")
    print_wrote(*written)
    if located.count == 0:
        raise DegenerateError(f"{points}: none of the {len(located.positions)} pairs could be located; see the table")
