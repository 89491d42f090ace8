"""`kcal sites`: what camera towers see and how well they locate it, and where to put the next one."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Annotated

import kcal
from kcal.cli import kinds, rooms
from kcal.cli.console import draw_picture, out, print_table, print_wrote, steps, tell, warn
from kcal.cli.inputs import pixel_sigma_of
from kcal.cli.options import Kind
from kcal.cli.stars import print_star_budget
from kcal.errors import InputError
from kcal.file_kind import file_kind
from kcal.files import write_atomic
from kcal.table import Columns, Table
from kcal.texts import length_text, range_text
from kcal.values import WithSigma


def sites_command(
    towers: kinds.Sites,
    *,
    area: kinds.Area,
    candidates: kinds.Sites | None = None,
    build: Annotated[kinds.Count, Kind(of="candidates")] = 1,
    terrain: kinds.Raster | None = None,
    geoid: Annotated[kinds.Meters | None, Kind(of="terrain")] = None,
    ground: kinds.Meters | None = None,
    above: kinds.Meters = 0.0,
    cells: Annotated[int, Kind(metavar="N", least=10)] = 200,
    pixel_sigma: kinds.PixelSigma | None = None,
    output: kinds.NewFile | None = None,
    picture: kinds.Picture | None = None,
) -> None:
    """Where to put the next camera: a map of what towers see and how well they locate it, and candidates in order.

    The ground hides what is behind it, the Earth curves and light bends. A bearing is off by `sigma` (0.05° if not
    given: marks and heading together); a tower without `heading` looks all around, a candidate with a `field` and
    without `heading` is turned to where it gives most. The best candidate is the one with the smallest mean variance of
    positions over the area (A-optimality); what nobody sees counts with the size of the area.

    **Examples**

    `kcal sites towers.csv --area 44.8,5.8,45.2,6.3 --terrain hills.tif --candidates hilltops.csv --picture sites.png`

    `kcal sites towers.rig.json --area 44.8,5.8,45.2,6.3 --ground 240 --above 50 -o map.csv`

    Args:
        towers: Towers that stand: CSV with name,lat,lon and height or mast (meters above the ground), and heading,
            field, sigma, elevation_sigma (degrees), position_sigma, reach (meters); or a rig file.
        area: What they should see: south, west, north, east, in degrees.
        candidates: Sites for the next tower, in such a table.
        build: How many of them are to be built, one after the other.
        terrain: Heights of the ground that hides what is behind it: an ESRI ASCII grid (.asc), or a GeoTIFF (needs
            'kcal[terrain]'). Level ground if not given.
        geoid: Height of the geoid above the WGS84 ellipsoid, added to the terrain's heights if these are above the sea.
        ground: Without a terrain: height of the ground above the ellipsoid.
        above: Height above the ground of what should be seen: smoke, drones.
        cells: Points of the map along its longer side.
        output: CSV file to write: the map, one line for each point.
        picture: The map.
    """
    if (terrain is None) == (ground is None):
        raise InputError("give --terrain, or --ground with the height of level ground above the ellipsoid; one of them")
    surface = kcal.locate.level_ground(ground or 0.0) if terrain is None else kcal.locate.terrain(terrain, geoid)
    if file_kind(towers) == "rig":
        rig = rooms.stations_of(kcal.load_rig(towers))
        standing = rooms.sites_of(rig, pixel_sigma_of(pixel_sigma, rig))
        if rig.root is None:
            warn(f"{towers}: the rig has no error bars: bearings count as exact but for the noise of marks")
    else:
        standing = rooms.read_sites(towers, surface)
    proposed = [] if candidates is None else rooms.read_sites(candidates, surface)
    names = [site.name for site in (*standing, *proposed)]
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputError(f"{candidates}: {min(twice)!r} is a tower and a candidate; names must differ")
    with steps("looking from each site", None):
        field = kcal.locate.area_of(list(area), surface, (*standing, *proposed), cells=cells, above=above)
        now = rooms.siting_map(field, standing)
        ranked = kcal.locate.rank_sites(field, standing, proposed, build=build)
        later = rooms.siting_map(field, [*standing, *(one.site for one in ranked if one.order)]) if ranked else None
    if unknown := 1.0 - float(field.known.double().mean()):
        warn(f"the terrain has no heights in {100 * unknown:.1f} % of the area, which is left out")
    if bool(field.surface.up.isnan().any()):
        warn("the terrain has no heights in some places between sites and area: nothing is taken to be hidden by them")
    two = now.seen_by > 1
    some = length_text(float(now.sigma[two].median()), digits=2) if bool(two.any()) else "nowhere known"
    alone = float((now.seen_by == 1).double().mean())
    out.print(
        f"two towers or more see {100 * now.covered:.0f} % of the area, one {100 * alone:.0f} %; median standard "
        f"deviation of positions where two do: {some}; over the whole area, where what nobody sees may be anywhere in "
        f"it: {length_text(now.mean_sigma, digits=3)}"
    )
    table = _ranked_table(ranked)
    if ranked:
        print_table(table.cells)
    told = zip(ranked, table.records, strict=True)
    tell(
        mean_sigma_m=now.mean_sigma, covered=now.covered,
        candidates=[dataclasses.asdict(one.site.origin) | record for one, record in told],
    )  # fmt: skip
    if later is not None:
        out.print(f"with the chosen: {length_text(later.mean_sigma, digits=3)}, {100 * later.covered:.0f} % covered")
    if output is not None:
        write_atomic(output, _map_text(field, now, later))
    draw_picture(picture, lambda: rooms.siting_figure(field, standing, ranked))
    print_wrote(output, picture)


def _ranked_table(ranked: list[rooms.RankedSite]) -> Table:
    length = functools.partial(length_text, digits=3)
    columns: Columns = {
        "name": "candidate", "order": "build", "heading_deg": ("heading °", "{:.0f}"),
        "mean_sigma_m": ("alone", length), "covered": ("covered", lambda share: f"{100 * share:.0f} %"),
        "mean_sigma_after_m": ("after", length),
    }  # fmt: skip
    rows = [[one.site.name, one.order, one.site.heading_deg, one.mean_sigma, one.covered, one.after] for one in ranked]
    return Table(columns, rows)


def _map_text(area: rooms.Area, now: rooms.SitingMap, later: rooms.SitingMap | None) -> str:
    """One line for each point whose ground is known."""
    columns = [*rooms.torch.meshgrid(area.lat, (area.lon + 180.0) % 360.0 - 180.0, indexing="ij"), area.ground]
    head, layout = ["lat", "lon", "height"], ["%.7f", "%.7f", "%.2f"]
    for found, word in ((now, ""), (later, "_after")):
        if found is not None:
            columns += [found.seen_by.double(), found.sigma]
            head, layout = [*head, f"seen_by{word}", f"sigma_m{word}"], [*layout, "%.0f", "%.4g"]
    form = ",".join(layout)
    rows = rooms.torch.stack([column[area.known] for column in columns], -1).tolist()
    return "\n".join([",".join(head), *(form % tuple(row) for row in rows)]) + "\n"


# `kcal budget`: how far a rig can measure, before it is built or after.

# Ranges in the table, if none are given.
_BASELINES = (10.0, 25.0, 50.0, 100.0, 250.0, 500.0)


def budget_command(
    rig: kinds.RigFile | None = None,
    *,
    focal: kinds.Pixels = 1600.0,
    baseline: kinds.MeasuredBaseline = WithSigma(10.0, 0.001),
    distances: kinds.Distances | None = None,
    pixel_sigma: kinds.PixelSigma | None = None,
    yaw_sigma: kinds.DegreesSigma = 0.01,
    timing: kinds.Seconds = 0.01,
    speed: Annotated[float, Kind(metavar="M/S", least=0)] = 20.0,
    picture: kinds.Picture | None = None,
    aperture: Annotated[float, Kind(metavar="MM")] | None = None,
    pitch: Annotated[kinds.Degrees, Kind(of="aperture")] = 0.0,
    clock_sigma: Annotated[kinds.Seconds, Kind(of="aperture")] = 0.01,
) -> None:
    """Print range errors from disparity, relative yaw, baseline and timing, each alone, at several ranges.

    The errors are exact. One that makes the disparity smaller moves a far point much farther out than the same error
    of the other sign moves it in, and may move it beyond infinity. The last column is the first-order error, which the
    formula Z² Δd / (f B) gives.

    For a rig file with a covariance, a second table splits the standard deviation of ranges by what to improve: marks;
    lenses (better calibrated cameras); the relative pose, as it would be with exact lenses (better landmarks and far
    features). Errors of the mounting move points sideways and leave ranges as they are.

    **Examples**

    `kcal budget`

    `kcal budget --focal 2400 --baseline 4±0.002 --pixel-sigma 0.2 --picture budget.png`

    `kcal budget rig.json --distances 500,1000,2000`

    Args:
        rig: Rig file; the planned rig of --focal and --baseline if not given.
        focal: Focal length of the planned rig.
        baseline: Distance between the cameras of the planned rig, and its error; without ±, 1 mm.
        distances: Ranges in the table, meters; 10 to 500 baselines if not given.
        yaw_sigma: Error of the relative yaw.
        timing: Time between the two images.
        speed: Speed of the target along the baseline, meters a second.
        picture: A plot of the errors.
        aperture: Also print how many stars a camera sees, and what they give: diameter of the lens's opening, focal
            length / f-number; 2.9 is common.
        pitch: With --aperture: elevation of the cameras' axes.
        clock_sigma: With --aperture: standard deviation of the offset between the cameras' clocks.
    """
    chosen = kcal.rig.planned_rig(focal_px=focal, baseline_m=baseline.value) if rig is None else rooms.load_pair(rig)
    noise = pixel_sigma_of(pixel_sigma, None if rig is None else chosen)
    disparity = math.sqrt(2.0) * noise
    error = 0.001 if baseline.sigma is None else baseline.sigma
    errors = kcal.locate.BudgetErrors(
        disparity_px=disparity, yaw_deg=yaw_sigma, baseline_m=error, timing_s=timing, speed_mps=speed
    )
    far = list(distances or rooms.usual_ranges(chosen, _BASELINES))
    labels = {
        "disparity": f"disparity {disparity:.3g} px",
        "yaw": f"relative yaw {yaw_sigma:g}°",
        "baseline": f"baseline {range_text(error)}",
        "timing": f"{1000 * timing:g} ms apart at {speed:g} m/s",
    }
    found = kcal.locate.range_errors(chosen, far, errors)
    if rig is None:
        out.print(f"planned rig: f {focal:g} px, baseline {baseline.value:g} m, f B {focal * baseline.value:g} px m")
    else:
        out.print(f"{rig}: baseline {length_text(float(chosen.baseline), digits=6)}")
    rows = [["range", "error", "nearer", "farther", "first order"]]
    for i, distance in enumerate(far):
        for name, sides in found.items():
            cells = (length_text(float(value[i]), sign=True) for value in sides)
            rows.append([range_text(distance), labels[name], *cells])
    print_table(rows, left=(1,))
    if chosen.covariance is not None:
        out.print(f"\nWhat the rig file knows, and {noise:g} px of noise in each mark:")
        print_table(rooms.range_sigma_rows(rooms.range_sigmas(chosen, far, pixel_sigma=noise)))
    if aperture is not None:
        print_star_budget(chosen, aperture, pitch, clock_sigma)
    if picture is not None:
        sweep = rooms.plotted_ranges(far)
        figure = rooms.budget_figure(sweep, kcal.locate.range_errors(chosen, sweep, errors), labels)
        kcal.report.save_picture(picture, figure)
    print_wrote(picture)
