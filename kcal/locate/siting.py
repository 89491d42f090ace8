"""Where to put cameras: what they see of a terrain, how well they locate it, and tables of it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import FileError, InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import enu_from_cam
from kcal.lens.rig import REFRACTION, REFRACTION_SIGMA, Origin, Rig
from kcal.locate.geodesy import anchor, ecef_from_enu_rotation, geodetic_to_enu, mean_radius, place_enu
from kcal.locate.ground import Ground
from kcal.locate.localizer import Localizer
from kcal.locate.mounting import station_mounting
from kcal.locate.tables import TableRow, read_rows
from kcal.locate.views import common_variance
from kcal.texts import brief, briefly

# What the ground hides: lines of sight over a surface of heights, with the Earth's curve and bent light.

# Samples of the ground, and along the rays of one place: beyond, the steps get coarser.
_MOST_SAMPLES = 16_000_000
# Where the ground is, from a point on the tangent plane: each step leaves a thousandth.
_STEPS = 2


class GroundSurface(NamedTuple):
    """Ground in the axes east, north, up of an origin, on a grid of equal steps.

    Attributes:
        up: (rows, columns) meters up of the tangent plane, NaN where the ground is not known.
        corner: east and north of `up[0, 0]`, meters.
        step: meters.
        below: (rows, columns) meters above the ellipsoid.
    """

    up: Tensor
    corner: tuple[float, float]
    step: float
    below: Tensor

    def at(self, east: Tensor, north: Tensor, heights: bool = False) -> Tensor:
        """`up` (or heights above the ellipsoid) between the points of the grid; NaN outside."""
        rows, columns = self.up.shape
        x = 2.0 * (east - self.corner[0]) / (self.step * (columns - 1)) - 1.0
        y = 2.0 * (north - self.corner[1]) / (self.step * (rows - 1)) - 1.0
        table = (self.below if heights else self.up)[None, None]
        found = torch.nn.functional.grid_sample(table, torch.stack([x, y], -1).reshape(1, 1, -1, 2), align_corners=True)
        return torch.where((x.abs() <= 1.0) & (y.abs() <= 1.0), found.reshape(x.shape), math.nan)


def surface_of(ground: Ground, origin: Origin, low: Tensor, high: Tensor, step: float) -> GroundSurface:
    """Sample ground over a rectangle.

    Args:
        ground: from `kcal.locate.level_ground` or `terrain`.
        origin: of the axes.
        low: (2,) east and north of its southwestern corner, meters.
        high: (2,) of its northeastern corner.
        step: meters between samples; larger where there would be more than 16 million.

    Example:
        >>> from kcal.locate.ground import level_ground
        >>> there = Origin(lat=45.0, lon=6.0, height=0.0)
        >>> sea = surface_of(level_ground(0.0), there, torch.tensor([-9e3, -9e3]), torch.tensor([9e3, 9e3]), 1e3)
        >>> sea.at(torch.tensor([0.0, 8000.0]).double(), torch.zeros(2).double()).round(decimals=1).abs().tolist()
        [0.0, 5.0]
    """
    span = (high - low).double()
    step = max(step, math.sqrt(float(span.prod()) / _MOST_SAMPLES))
    columns, rows = (math.ceil(float(side) / step) + 1 for side in span)
    east = float(low[0]) + step * torch.arange(columns, dtype=torch.float64)
    north = float(low[1]) + step * torch.arange(rows, dtype=torch.float64)
    y, x = torch.meshgrid(north, east, indexing="ij")
    up, place = torch.zeros_like(x), anchor(origin)
    for _ in range(_STEPS):
        lat, lon, height = place_enu(torch.stack([x, y, up], -1), *place).unbind(-1)
        below = ground(lat, lon)
        up = torch.where(below.isfinite(), up + below - height, up)
    return GroundSurface(torch.where(below.isfinite(), up, math.nan), (float(low[0]), float(low[1])), step, below)


@torch.no_grad()
def seen_over(surface: GroundSurface, eye: Tensor, points: Tensor, bending: float) -> Tensor:
    """(N,) whether points are seen from an eye over the ground; unknown ground hides nothing.

    The highest slope up to each distance is found along rays in all directions, as far apart as the grid's points;
    a point is compared with the nearest ray, up to one step before it.

    Args:
        surface: the ground.
        eye: (3,) east, north, up, meters.
        points: (N, 3).
        bending: k / 2R, 1/m: light from the horizontal distance d comes from bending · d² too high.
    """
    away = points[:, :2] - eye[:2]
    distance = torch.linalg.vector_norm(away, dim=-1)
    farthest = float(distance.nan_to_num().max())
    step = max(surface.step, math.sqrt(2.0 * math.pi / _MOST_SAMPLES) * farthest)
    if farthest <= step:
        return torch.ones_like(distance, dtype=torch.bool)
    rays = math.ceil(2.0 * math.pi * farthest / step)
    angle = 2.0 * math.pi / rays * torch.arange(rays, dtype=torch.float64)
    reach = step * torch.arange(1, int(farthest / step) + 1, dtype=torch.float64)
    up = surface.at(eye[0] + angle.sin()[:, None] * reach, eye[1] + angle.cos()[:, None] * reach)
    slope = ((up - eye[2]) / reach + bending * reach).nan_to_num(nan=-math.inf, neginf=-math.inf)
    highest = slope.cummax(-1).values
    known = distance.isfinite()
    way = torch.where(known, torch.atan2(away[:, 0], away[:, 1]), 0.0)
    ray = (way * (rays / (2.0 * math.pi))).round().long() % rays
    before = (torch.where(known, distance, 0.0) / step).long() - 2
    own = (points[:, 2] - eye[2]) / distance.clamp_min(1e-9) + bending * distance
    horizon = highest[ray, before.clamp(0, len(reach) - 1)]
    return known & ((before < 0) | (own >= horizon))


def eye_height(surface: GroundSurface, name: str, eye: Tensor) -> None:
    """Raise `InputError` if an eye (3,) is below the ground."""
    ground = float(surface.at(eye[:1], eye[1:2])[0])
    if float(eye[2]) < ground:
        raise InputError(
            f"site {name}: it stands {ground - float(eye[2]):.1f} m below the ground of the terrain; is its height "
            "above the ellipsoid, as the terrain's is? A column mast (meters above the ground) needs no height"
        )


# Where to put the next camera: a map of errors and coverage over an area, and the best of candidate sites.
#
# A camera knows the direction to a point, off by its marks, its attitude, its position and by refraction. Directions of
# several cameras are added as information; what no camera knows is the size of the area. The measure of a set of sites
# is the mean variance of level positions over the area (A-optimality), which covers hidden parts before it refines
# others.

# Headings that are tried for a candidate that does not look all around and has none.
_HEADINGS = 36


@dataclasses.dataclass(frozen=True, kw_only=True)
class Site:
    """An existing or possible place of a camera.

    Args:
        name: of the site.
        origin: of the camera, its height above the ellipsoid.
        heading_deg: of the middle of its field of view, clockwise from true north; None: it looks all around, or, for a
            candidate that does not, the best heading is sought.
        field_deg: horizontal field of view, 360 for a tower that looks all around.
        sigma_deg: standard deviation of a bearing: marks and heading together.
        elevation_sigma_deg: of an elevation; as of a bearing if left out.
        position_m: of the camera's position along each axis, meters.
        reach_m: farthest distance at which points are still seen, meters.
        camera: lens and size of the image: what it sees then depends on heights too.
        pitch_deg: of such a camera.
        roll_deg: of such a camera.

    Raises:
        InputError: a value out of range.

    Example:
        >>> Site(name="mill", origin=Origin(lat=45.0, lon=6.0, height=812.0), heading_deg=90.0).sigma_deg
        0.05
    """

    __repr__ = brief

    name: str
    origin: Origin
    heading_deg: float | None = None
    field_deg: float = 360.0
    sigma_deg: float = 0.05
    elevation_sigma_deg: float | None = None
    position_m: float = 1.0
    reach_m: float = math.inf
    camera: Camera | None = None
    pitch_deg: float = 0.0
    roll_deg: float = 0.0

    def __post_init__(self) -> None:
        for what, value, most in (
            ("field", self.field_deg, 360.0), ("sigma", self.sigma_deg, 45.0), ("reach", self.reach_m, math.inf),
            ("elevation sigma", self.elevation_sigma_deg or self.sigma_deg, 45.0),
        ):  # fmt: skip
            if not 0.0 < value <= most:
                raise InputError(f"site {self.name}: {what} {value:g}: a positive number is needed, at most {most:g}")
        if not 0.0 <= self.position_m < math.inf:
            raise InputError(f"site {self.name}: position sigma {self.position_m:g}: meters, not negative, are needed")
        if self.heading_deg is not None and not abs(self.heading_deg) <= 360.0:
            raise InputError(f"site {self.name}: heading {self.heading_deg:g}: degrees, -360 to 360, are needed")
        if self.camera is not None and self.heading_deg is None:
            raise InputError(f"site {self.name}: a camera needs a heading")


@briefly
class Area(NamedTuple):
    """Points of the ground, in rows from south to north.

    Attributes:
        origin: of east, north and up, in the middle.
        lat: (rows,) degrees.
        lon: (columns,) degrees.
        points: (rows, columns, 3) points of which positions are wanted, meters; NaN where the ground is not known.
        ground: (rows, columns) height of the ground above the ellipsoid, meters.
        surface: what hides them.
    """

    origin: Origin
    lat: Tensor
    lon: Tensor
    points: Tensor
    ground: Tensor
    surface: GroundSurface

    @property
    def known(self) -> Tensor:
        """(rows, columns) where the ground is known."""
        return self.points.isfinite().all(-1)

    @property
    def prior(self) -> float:
        """Variance along each axis of a point that is somewhere in the area, m²."""
        flat = self.points[self.known][:, :2]
        return float((flat.amax(0) - flat.amin(0)).square().sum() / 24.0)


class SitingMap(NamedTuple):
    """What sites give over an area.

    Attributes:
        sees: (S, rows, columns) which site sees what.
        sigma: (rows, columns) root of the variance of the level position, east and north together, meters: where one
            site or none sees a point, nearly the size of the area.
        mean_sigma: root of the mean variance over the area, weighted: what is made small.
        covered: share of the area, weighted, that two sites or more see.
    """

    sees: Tensor
    sigma: Tensor
    mean_sigma: float
    covered: float

    @property
    def seen_by(self) -> Tensor:
        """(rows, columns) how many sites see it."""
        return self.sees.sum(0)


@briefly
class RankedSite(NamedTuple):
    """A candidate with its rank and the errors that would remain.

    Attributes:
        site: with the heading that is best.
        mean_sigma: of the sites that stand and this one alone, meters; see `SitingMap`.
        covered: likewise.
        order: 1 for the first one to build, 2 for the best beside it, and so on; None if it is not among them.
        after: `mean_sigma` once all up to it are built; None if it is not among them.
    """

    site: Site
    mean_sigma: float
    covered: float
    order: int | None
    after: float | None


def area_of(
    bounds: Sequence[float], ground: Ground, sites: Sequence[Site] = (), *, cells: int = 200, above: float = 0.0,
    step: float | None = None,
) -> Area:  # fmt: skip
    """Points over a rectangle of latitudes and longitudes, and the ground from there to all sites.

    Args:
        bounds: south, west, north, east, degrees; east below west crosses the antimeridian.
        ground: from `level_ground` or `terrain`.
        sites: that stand, and candidates.
        cells: points along the longer side.
        above: height of points above the ground, meters: smoke, say.
        step: of the ground that hides, meters; the cell of a raster, or of the map, if left out.

    Raises:
        InputError: bounds that are none, an area that is not known at all, a site below the ground.

    Example:
        >>> from kcal.locate.ground import level_ground
        >>> area_of((44.95, 5.95, 45.05, 6.05), level_ground(0.0), cells=11).points.shape
        torch.Size([11, 8, 3])
    """
    if len(bounds) != 4:
        raise InputError(f"bounds: south, west, north and east are needed, got {len(bounds)} numbers")
    south, west, north, east = bounds
    east = east + 360.0 if east < west else east
    if not (-90.0 < south < north < 90.0 and -180.0 <= west < east <= west + 180.0):
        raise InputError(f"area {', '.join(f'{b:g}' for b in bounds)}: SOUTH,WEST,NORTH,EAST in degrees are needed")
    if not 2 <= cells <= 5000 or not math.isfinite(above):
        raise InputError(f"area: 2 to 5,000 cells along a side are needed, got {cells}")
    middle = (0.5 * (south + north), (0.5 * (west + east) + 180.0) % 360.0 - 180.0)
    origin = Origin(lat=middle[0], lon=middle[1], height=0.0)
    across = (east - west) * math.cos(math.radians(origin.lat))
    cell = max(across, north - south) / cells
    rows, columns = (max(2, round(side / cell)) for side in (north - south, across))
    lat = south + (north - south) * (torch.arange(rows, dtype=torch.float64) + 0.5) / rows
    lon = west + (east - west) * (torch.arange(columns, dtype=torch.float64) + 0.5) / columns
    lats, lons = torch.meshgrid(lat, (lon + 180.0) % 360.0 - 180.0, indexing="ij")
    heights = ground(lats, lons)
    if not bool(heights.isfinite().any()):
        raise InputError("area: the terrain has no height there; does it cover these latitudes and longitudes?")
    points = geodetic_to_enu(torch.stack([lats, lons, heights.nan_to_num() + above], -1), origin)
    places = [geodetic_to_enu(site.origin.geodetic, origin) for site in sites]
    flat = torch.cat([points.reshape(-1, 3), *(place[None] for place in places)])[:, :2]
    meters = math.radians(cell) * mean_radius(origin.lat)
    step = step or min(meters, float(getattr(ground, "cell_m", math.inf)))
    surface = surface_of(ground, origin, flat.amin(0) - step, flat.amax(0) + step, step)
    for site, place in zip(sites, places, strict=True):
        eye_height(surface, site.name, place)
    return Area(origin, lat, lon, torch.where(heights.isfinite()[..., None], points, math.nan), heights, surface)


@torch.no_grad()
def siting_map(area: Area, sites: Sequence[Site], weights: Tensor | None = None) -> SitingMap:
    """What sites see of an area, and how well they locate it.

    Args:
        area: from `area_of`, with these sites.
        sites: that stand.
        weights: (rows, columns) how much each point counts; alike if left out.

    Example:
        >>> from kcal.locate.ground import level_ground
        >>> towers = [Site(name=name, origin=Origin(lat=45.0, lon=lon, height=100.0)) for name, lon in
        ...           (("mill", 5.9), ("mast", 6.1))]
        >>> area = area_of((45.05, 5.95, 45.15, 6.05), level_ground(0.0), towers, cells=10)
        >>> found = siting_map(area, towers)
        >>> round(found.covered, 6), round(float(found.sigma[5, 3]))
        (1.0, 19)
    """
    seen = [_seen_by(area, site) for site in sites]
    for site, view in zip(sites, seen, strict=True):
        if site.heading_deg is None and site.field_deg < 360.0:
            raise InputError(f"site {site.name}: a tower with a field of view of {site.field_deg:g}° needs a heading")
        view.turn(site)
    weight = _checked_weights(area, weights)
    known = area.known
    sees = torch.zeros(len(sites), *known.shape, dtype=torch.bool)
    for own, view in zip(sees, seen, strict=True):
        own[known] = view.sees
    total = sum((view.information for view in seen), torch.zeros(6, int(known.sum()), dtype=torch.float64))
    variance = _level_variance(total, area.prior)
    sigma = torch.full(known.shape, math.nan, dtype=torch.float64)
    sigma[known] = variance.sqrt()
    two = (sees.sum(0) > 1)[known].double()
    return SitingMap(sees, sigma, math.sqrt(float(weight @ variance)), min(1.0, float(weight @ two)))


@torch.no_grad()
def rank_sites(
    area: Area, sites: Sequence[Site], candidates: Sequence[Site], *, build: int | None = None,
    weights: Tensor | None = None,
) -> list[RankedSite]:  # fmt: skip
    """Rank candidates by what each adds to the existing sites, greedily, the best one first.

    Args:
        area: from `area_of`, with sites and candidates.
        sites: that stand; may be none.
        candidates: one of them for each place. Where a heading is left open, 36 are tried.
        build: how many are chosen, one after the other; all if left out.
        weights: see `siting_map`.

    Returns:
        The candidates, those to build first in their order, then the others by what each gives alone.

    Example:
        >>> from kcal.locate.ground import level_ground
        >>> mill, near, far = (Site(name=name, origin=Origin(lat=45.0, lon=lon, height=100.0)) for name, lon in
        ...                    (("mill", 5.9), ("near", 5.91), ("far", 6.1)))
        >>> area = area_of((45.05, 5.95, 45.15, 6.05), level_ground(0.0), [mill, near, far], cells=10)
        >>> [(ranked.site.name, round(ranked.mean_sigma)) for ranked in rank_sites(area, [mill], [near, far])]
        [('far', 20), ('near', 399)]
    """
    weight, prior = _checked_weights(area, weights), area.prior
    count = int(area.known.sum())
    total, times = torch.zeros(6, count, dtype=torch.float64), torch.zeros(count, dtype=torch.long)
    for site in sites:
        view = _seen_by(area, site)
        view.turn(site)
        total, times = total + view.information, times + view.sees
    views = [_seen_by(area, site) for site in candidates]
    left = list(range(len(candidates)))
    alone: dict[int, tuple[Site, float, float]] = {}
    chosen: list[RankedSite] = []
    build = len(candidates) if build is None else build
    while left and (len(chosen) < build or not alone):
        tried: list[tuple[float, int, Site]] = []
        for i in left:
            options = [candidates[i]]
            if candidates[i].heading_deg is None and candidates[i].field_deg < 360.0:
                headings = (360.0 / _HEADINGS * k for k in range(_HEADINGS))
                options = [dataclasses.replace(candidates[i], heading_deg=heading) for heading in headings]
            found = []
            for site in options:
                views[i].turn(site)
                found.append(float(weight @ _level_variance(total + views[i].information, prior)))
            variance, site = min(zip(found, options, strict=True), key=lambda pair: pair[0])
            if i not in alone:
                views[i].turn(site)
                covered = min(1.0, float(weight @ (times + views[i].sees > 1).double()))
                alone[i] = site, math.sqrt(variance), covered
            tried.append((variance, i, site))
        if len(chosen) >= build:
            break
        variance, i, site = min(tried, key=lambda one: one[0])
        views[i].turn(site)
        total, times = total + views[i].information, times + views[i].sees
        left.remove(i)
        chosen.append(RankedSite(site, *alone[i][1:], len(chosen) + 1, math.sqrt(variance)))
    others = sorted((RankedSite(*alone[i], None, None) for i in left), key=lambda ranked: ranked.mean_sigma)
    return [*chosen, *others]


class _View:
    """What one site sees of the known points of an area, in any heading: (6, N) information, row by row."""

    def __init__(self, clear: Tensor, azimuth: Tensor, own: Tensor, each: Tensor) -> None:
        self.clear, self.azimuth, self.own, self.each = clear, azimuth, own, each
        self.sees, self.information = clear, each

    def turn(self, site: Site) -> None:
        self.sees = self.clear
        if site.camera is not None:
            assert site.heading_deg is not None
            turn = enu_from_cam(site.heading_deg, site.pitch_deg, site.roll_deg)
            pixels, valid = site.camera.project(self.own @ turn)
            self.sees = self.clear & valid & site.camera.inside(pixels)
        elif site.heading_deg is not None and site.field_deg < 360.0:
            off = (self.azimuth - site.heading_deg + 180.0) % 360.0 - 180.0
            self.sees = self.clear & (off.abs() <= 0.5 * site.field_deg)
        self.information = torch.where(self.sees, self.each, 0.0)


def _seen_by(area: Area, site: Site) -> _View:
    eye = geodetic_to_enu(site.origin.geodetic, area.origin)
    points = area.points[area.known]
    curve = 0.5 / mean_radius(site.origin.lat)
    clear = seen_over(area.surface, eye, points, REFRACTION * curve)
    to_own = ecef_from_enu_rotation(site.origin.lat, site.origin.lon).T @ anchor(area.origin)[0]
    own = (points - eye) @ to_own.T
    level = own[:, :2].square().sum(-1)
    own = own + torch.nn.functional.pad((REFRACTION * curve * level)[:, None], (2, 0))
    distance = torch.linalg.vector_norm(own, dim=-1)
    clear = clear & (distance <= site.reach_m) & (level > 0)
    azimuth = torch.rad2deg(torch.atan2(own[:, 0], own[:, 1]))
    ray = own / distance.clamp_min(1e-9)[:, None]
    side = torch.stack([ray[:, 1], -ray[:, 0], torch.zeros_like(azimuth)], -1)
    side = side / torch.linalg.vector_norm(side, dim=-1, keepdim=True).clamp_min(1e-12)
    rise = torch.linalg.cross(side, ray)
    angles = [math.radians(sigma) for sigma in (site.sigma_deg, site.elevation_sigma_deg or site.sigma_deg)]
    place = site.position_m**2
    across = (angles[0] * distance).square() + place
    upward = (angles[1] * distance).square() + place + (REFRACTION_SIGMA * curve * level).square()
    # Rows of bearing and elevation in the axes of the area, each over its sigma.
    rows = torch.stack([side / across.sqrt()[:, None], rise / upward.sqrt()[:, None]], 1) @ to_own
    first, second = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
    return _View(clear, azimuth, own, (rows[..., first] * rows[..., second]).sum(1).T.contiguous())


def _level_variance(information: Tensor, prior: float) -> Tensor:
    """(N,) variance of east and north together, given (6, N) information and the variance beforehand."""
    a, b, c, d, e, f = information
    a, d, f = a + 1.0 / prior, d + 1.0 / prior, f + 1.0 / prior
    a, b, d = a - c * c / f, b - c * e / f, d - e * e / f
    return (a + d) / (a * d - b * b)


def _checked_weights(area: Area, weights: Tensor | None) -> Tensor:
    """(N,) of the known points, their sum one."""
    known = area.known
    weights = torch.ones(known.shape, dtype=torch.float64) if weights is None else weights.double()
    if weights.shape != known.shape or not bool((weights[known] >= 0).all()) or not float(weights[known].sum()) > 0:
        raise InputError(f"weights: {tuple(known.shape)} of them are needed, none negative and not all zero")
    return weights[known] / weights[known].sum()


# Sites from a table, and from a rig of stations with what is known of it.

_HEADER = "name,lat,lon,height"
_COLUMNS = (
    "name", "lat", "lon", "height", "mast", "heading", "field", "sigma", "elevation_sigma", "position_sigma", "reach",
)  # fmt: skip
# Pixels along each axis at which a rig's directions are judged.
_PLACES = 7


def read_sites(path: str | Path, ground: Ground | None = None) -> list[Site]:
    r"""Read `name,lat,lon,height` and, if they are there, the other columns of a `Site`.

    These are heading, field, sigma and elevation_sigma (degrees), position_sigma and reach (meters); empty cells are as
    in `Site`. In place of height (of the camera, above the ellipsoid) there may be mast: meters above the ground.

    Raises:
        FileError: see `kcal.locate.read_marks`; a height and a mast, or neither; a mast where no ground is known.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "sites.csv")
        ...     _ = path.write_text("name,lat,lon,height,heading,field\nmill,45,6,812,90,60\n")
        ...     site = read_sites(path)[0]
        >>> site.name, site.heading_deg, site.field_deg
        ('mill', 90.0, 60.0)
    """
    return [_table_site(row, ground) for row in read_rows(path, _HEADER, _COLUMNS, ("name", "lat", "lon"))]


def _table_site(row: TableRow, ground: Ground | None) -> Site:
    stated = {column: row.number(column) for column in _COLUMNS[1:] if row.cells.get(column)}
    if ("height" in stated) == ("mast" in stated):
        raise FileError(
            f"{row.where}: {row.name!r} needs a height (of the camera, above the ellipsoid) or a mast (above the "
            "ground), and one of them only"
        )
    lat, lon = row.number("lat"), row.number("lon")
    if "mast" in stated:
        below = math.nan if ground is None else float(ground(*torch.tensor([[lat], [lon]], dtype=torch.float64)))
        if not math.isfinite(below):
            why = "no terrain was given" if ground is None else "the terrain has no height there"
            raise FileError(f"{row.where}: {row.name!r} has a mast, and {why}; write its height")
        stated["height"] = below + stated["mast"]
    names = {
        "heading": "heading_deg", "field": "field_deg", "sigma": "sigma_deg", "reach": "reach_m",
        "elevation_sigma": "elevation_sigma_deg", "position_sigma": "position_m",
    }  # fmt: skip
    more = {names[column]: value for column, value in stated.items() if column in names}
    try:
        origin = Origin(lat=lat, lon=lon, height=stated["height"])
        return Site(name=row.name, origin=origin, **more)  # type: ignore[arg-type]
    except InputError as error:
        raise FileError(f"{row.where}: {error}") from error


@torch.no_grad()
def sites_of(rig: Rig, pixel_sigma: float | None = None) -> list[Site]:
    """The cameras of a rig as sites, with what is known of lens and attitude together, half-way over the image.

    What errors of several cameras have in common is not part of it: `Localizer` knows it.

    Args:
        rig: with an origin.
        pixel_sigma: of a mark along each axis, px; if left out, as in `Localizer`.

    Raises:
        InputError: a rig without an origin.

    Example:
        >>> from kcal import Camera
        >>> from kcal.locate import enu_from_cam
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = Rig([camera], ["mill"], enu_from_cam(90.0).T[None], center=torch.zeros(1, 3),
        ...                 origin=Origin(lat=45.0, lon=6.0, height=812.0))
        >>> rig.root = rig.with_errors(attitude_deg=(0.01, 0.01, 0.2))
        >>> site = sites_of(rig, pixel_sigma=1.0)[0]
        >>> round(site.heading_deg), round(site.sigma_deg, 2), round(site.elevation_sigma_deg, 2)
        (90, 0.2, 0.04)
    """
    sites, localize = [], Localizer(rig, weights="all", pixel_sigma=pixel_sigma)
    for c, (name, camera) in enumerate(zip(rig.names, rig.each, strict=True)):
        stands = station_mounting(rig, c)
        across, down = (torch.linspace(0.25, 0.75, _PLACES, dtype=torch.float64) * (side - 1) for side in camera.size)
        pixels = torch.cartesian_prod(across, down)
        rays, valid = camera.unproject(pixels)
        pixels, rays = pixels[valid], rays[valid]
        # Degrees that a pixel is wide and high there.
        steps = [
            torch.rad2deg((camera.unproject(pixels + step)[0] - rays).norm(dim=-1)) for step in torch.eye(2).double()
        ]
        spread = localize.pixel_sigma.square().repeat(len(rays), 2)
        position = 0.0
        if stands.covariance is not None:
            position = float((stands.covariance[:2, :2].trace() / 2).sqrt())
        spread = spread + common_variance(localize.posed, localize.common, c, rays @ rig.rotation[c])
        sigma = [float((spread[:, axis].sqrt() * steps[axis]).median()) for axis in (0, 1)]
        sites.append(Site(
            name=name, origin=stands.origin, heading_deg=stands.heading_deg, pitch_deg=stands.pitch_deg,
            roll_deg=stands.roll_deg, camera=camera, sigma_deg=sigma[0], elevation_sigma_deg=sigma[1],
            position_m=position,
        ))  # fmt: skip
    return sites
