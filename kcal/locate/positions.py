"""Positions of located points, their regions, their places on a map, and their errors against the truth."""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.arrow import ArrowRows, arrow_table, wkb_points, wkb_polygon
from kcal.checks import as_points
from kcal.doors import shown_in_notebooks
from kcal.errors import InputError
from kcal.lens.rig import Origin
from kcal.locate.geodesy import anchor, enu_to_geodetic, latitude_longitude
from kcal.locate.localizer import Localizer
from kcal.locate.stereo import PositionStatus, covariance_root
from kcal.locate.survey import read_survey
from kcal.locate.tables import NUMBERS, PositionColumns
from kcal.locate.tabulate import Viewpoint
from kcal.texts import brief

# Why there are neither maps nor latitudes, and the cure.
NOWHERE = (
    "this rig has no place on the Earth, so that its positions are meters in its own frame; solve it with landmarks or "
    "positions that have latitudes, or give the origin and the heading of its left camera"
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Position:
    """One row of marks, located or not; what is not known is None.

    Latitude, longitude (degrees) and the ellipsoidal WGS84 `height` (meters), `enu` and the best estimate `range_m`
    are there only if the status is `OK`. Azimuth and elevation in degrees and the range interval are also there if
    it is `BEARING_ONLY` or `PARALLEL`, the interval only if some range explains the marks. Ranges are meters from the
    left camera; `range_high_m` may be infinite. The interval covers 95 % of the errors that `Located.interval_note`
    names. `reason` is empty, says why there is no position, or warns of one that looks wrong.

    `height` is above the ellipsoid; `geoid_height` is that of the geoid, known only with a grid, and
    `height - geoid_height` is close to the height above the sea. `covariance` is of `enu`, to first order; `cep50_m`
    and `cep95_m` are the radii of horizontal circles that contain the true position with 50 and 95 %, infinite where it
    may lie at infinity. The sensitivities are slopes of the range by a pixel of a mark and by a degree of relative yaw.
    """

    name: str
    status: PositionStatus
    reason: str = ""
    lat: float | None = None
    lon: float | None = None
    height: float | None = None
    geoid_height: float | None = None
    enu: tuple[float, float, float] | None = None
    covariance: tuple[tuple[float, float, float], ...] | None = None
    cep50_m: float | None = None
    cep95_m: float | None = None
    meters_per_pixel: float | None = None
    meters_per_degree: float | None = None
    range_m: float | None = None
    range_low_m: float | None = None
    range_high_m: float | None = None
    azimuth_deg: float | None = None
    elevation_deg: float | None = None
    reprojection_px: tuple[float, float] | None = None


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Located(ArrowRows):
    """Result of `locate_points`: one position for each pair of marks, in order, and where the rig stood.

    `columns` contains the positions as arrays, `positions` gives each row as a `Position`. `origin` is None, there are
    no cameras, and heading, pitch and roll are NaN, where the rig has no place on the Earth.

    `centers` (V, 3) are where the cameras stand, meters, if ranges count from each of them; None: all count from the
    left camera.

    `included` names the errors that intervals and covariances cover; `geoid` is the grid of the geoid heights, None
    without one. `rows` is the length of the table of which the positions are a sample, None if they are all.
    """

    __repr__ = brief
    _repr_html_ = shown_in_notebooks

    columns: PositionColumns
    cameras: tuple[Viewpoint, ...]
    origin: Origin | None
    heading_deg: float
    pitch_deg: float
    roll_deg: float
    pixel_sigma: float
    included: tuple[str, ...] = ("marks",)
    geoid: str | None = None
    rows: int | None = None
    centers: Tensor | None = None

    @functools.cached_property
    def positions(self) -> tuple[Position, ...]:
        """The rows, one object each."""
        return tuple(_positions_of(self.columns))

    @property
    def place(self) -> Origin:
        """Where the rig stands.

        Raises:
            InputError: nowhere on the Earth.
        """
        if self.origin is None:
            raise InputError(f"there are no latitudes: {NOWHERE}")
        return self.origin

    @property
    def frame(self) -> str:
        """Of which frame positions are the meters."""
        if self.origin is not None:
            return "east, north, up of the origin"
        return "x right, y down, z forward of the left camera" if self.centers is None else "x, y, z of the rig"

    @property
    def feet(self) -> Tensor:
        """(N, 3) where bearings and ranges count from, meters; the left camera is at zero."""
        if self.centers is None:
            return torch.zeros(len(self.columns.names), 3, dtype=torch.float64)
        return self.centers[torch.from_numpy(self.columns.anchor)]

    @property
    def count_note(self) -> str:
        """How many points are located, and of how long a table they are a sample."""
        note = f"{self.count} of {len(self.columns.names)} points located"
        return note if self.rows is None else f"{note}, a sample of the {self.rows:,} in the table"

    @property
    def interval_note(self) -> str:
        """Which errors the intervals cover and which they do not, as a sentence without a full stop."""
        # What stands nowhere has no errors of where it stands.
        relevant = ("calibration", "mounting") if self.origin else ("calibration",)
        missing = [name for name in relevant if name not in self.included]
        known = [name for name in self.included if name != "marks"]
        note = "95 % of the noise in the marks" + (f" and of the errors in {' and '.join(known)}" if known else "")
        return note + (f"; errors in {' and '.join(missing)} are not included" if missing else "")

    def to_arrow(self) -> Any:
        """A `pyarrow.Table` with the columns of a CSV file, unknown numbers null; with pyarrow, the extra `tables`.

        On the Earth it is a GeoParquet table: `geometry` holds points, and `region` their 95 % regions.

        Example:
            >>> import pandas, polars  # doctest: +SKIP
            >>> pandas.DataFrame.from_arrow(located), polars.DataFrame(located)  # doctest: +SKIP
        """
        return position_table(self.columns, self)

    @property
    def count(self) -> int:
        """How many pairs have a position."""
        return int((self.columns.status == PositionStatus.OK).sum())

    @property
    def enu(self) -> Tensor:
        """East, north, up in meters, (N, 3) float64; NaN where there is no position."""
        first = NUMBERS.index("east_m")
        return torch.from_numpy(self.columns.numbers[:, first : first + 3].copy())


def _positions_of(columns: PositionColumns) -> Iterator[Position]:
    rows = zip(columns.names, columns.status.tolist(), columns.reasons, columns.numbers.tolist(), strict=True)
    for name, status, reason, numbers in rows:
        lat, lon, height, geoid, distance, low, high, cep50, cep95, by_pixel, by_degree, azimuth, elevation = (
            None if math.isnan(value) else value for value in (*numbers[:4], *numbers[7:10], *numbers[16:22])
        )
        east, north, up = numbers[4:7]
        ee, en, eu, nn, nu, uu = numbers[10:16]
        left, right = numbers[22:]
        yield Position(
            name=name, status=PositionStatus(status), reason=reason, lat=lat, lon=lon, height=height,
            geoid_height=geoid, enu=None if math.isnan(east) else (east, north, up),
            covariance=None if math.isnan(ee) else ((ee, en, eu), (en, nn, nu), (eu, nu, uu)),
            cep50_m=cep50, cep95_m=cep95, meters_per_pixel=by_pixel, meters_per_degree=by_degree,
            range_m=distance, range_low_m=low, range_high_m=high, azimuth_deg=azimuth, elevation_deg=elevation,
            reprojection_px=None if math.isnan(left) else (left, right),
        )  # fmt: skip


# The 95 % region of a position as a ring on the map: an ellipse in inverse range, skewed outward in meters.

REGION_SHARE = 0.95
# In files, of the degrees of a region's corners: 0.1 mm (RFC 7946, section 11.2). Positions keep all digits. The last
# digits of functions such as the arc tangent depend on how many values are computed at once.
CORNER_DECIMALS = 9
_RING_POINTS = 72
# An ellipse that comes this close to the camera, in shares of the distance, has no inverse to speak of.
_TOO_WIDE = 0.85
# Regions at once: fewer cost more calls, more do not fit the cache.
_AT_ONCE = 512

Ring = list[tuple[float, float]]


def region_outline(enu: Tensor, covariance: Tensor, share: float = REGION_SHARE, *, plain: bool = False) -> Tensor:
    """Outlines of the horizontal regions that contain the true positions with a probability of `share`.

    The ellipse is drawn where errors are Gaussian, in X / |X|² of the horizontal position, and carried back.

    Args:
        enu: (..., 3) meters from the left camera.
        covariance: (..., 3, 3) to first order.
        share: probability.
        plain: ellipses in meters: of lines of sight from several places.

    Returns:
        (..., 72, 2) east, north in meters, counterclockwise.

    Example:
        >>> spread = torch.diag(torch.tensor([0.1, 200.0, 0.1], dtype=torch.float64) ** 2)
        >>> outline = region_outline(torch.tensor([0.0, 5000.0, 0.0]), spread)
        >>> outline[:, 1].min().round().item(), outline[:, 1].max().round().item()
        (4554.0, 5543.0)
    """
    return torch.stack(_level_outline(enu[..., :2].double(), covariance[..., :2, :2].double(), share, plain), -1)


def _level_outline(place: Tensor, spread: Tensor, share: float, plain: bool = False) -> tuple[Tensor, Tensor]:
    """East and north (..., 72) each: one by one they take a third of the time. `plain`: ellipses in meters."""
    squared = place.square().sum(-1)
    some = torch.where(squared > 0, squared, 1.0)
    reach = math.sqrt(-2.0 * math.log(1.0 - share))
    along = (place * (spread @ place[..., None])[..., 0]).sum(-1)
    wide = (squared == 0) | (reach * along.sqrt() > _TOO_WIDE * squared) | plain
    still = torch.eye(2, dtype=torch.float64)
    slope = (still - 2.0 * place[..., :, None] * place[..., None, :] / some[..., None, None]) / some[..., None, None]
    root = covariance_root(torch.where(wide[..., None, None], spread, slope @ spread @ slope.mT))
    middle = torch.where(wide[..., None], place, place / some[..., None])
    # The inversion turns the sense of rotation, and the root may.
    clockwise = (torch.linalg.det(root) > 0) != wide
    angle = torch.linspace(0, 2 * math.pi, _RING_POINTS + 1, dtype=torch.float64)[:-1]
    cosine, sine = reach * torch.stack([angle, angle.flip(0)]).cos(), reach * torch.stack([angle, angle.flip(0)]).sin()
    cosine, sine = cosine[clockwise.long()], sine[clockwise.long()]
    east = middle[..., :1] + root[..., :1, 0] * cosine + root[..., :1, 1] * sine
    north = middle[..., 1:] + root[..., 1:, 0] * cosine + root[..., 1:, 1] * sine
    length = torch.where(wide[..., None], 1.0, (east * east + north * north).clamp_min(1e-300))
    return east / length, north / length


def region_rings(located: Located) -> list[Ring]:
    """The ring of each position: (latitude, longitude), closed, counterclockwise, longitudes without a jump."""
    blocks = ring_blocks(located.columns, located)
    return [[(lat, lon) for lat, lon in ring] for block in blocks for ring in block.tolist()]


def ring_blocks(columns: PositionColumns, run: Located) -> Iterator[NDArray[np.float64]]:
    """The rings (M, 73, 2) of those rows that have a position, some rows at a time.

    Only lines of sight from one place skew a region; others are ellipses.
    """
    upper = NUMBERS.index("cov_ee_m2") + np.array([[0, 1], [1, 3]])
    rotation, translation = anchor(run.place)
    located = torch.from_numpy(columns.numbers[columns.located])
    # Splitting no rows gives one part, of no rows.
    for part in located.split(_AT_ONCE) if len(located) else ():
        east, north, up, lon_of_point = (part[:, NUMBERS.index(name)] for name in ("east_m", "north_m", "up_m", "lon"))
        outline = _level_outline(torch.stack([east, north], -1), part[:, upper], REGION_SHARE, run.centers is not None)
        axes = zip(rotation, translation, strict=True)
        x, y, z = (row[0] * outline[0] + row[1] * outline[1] + (row[2] * up[:, None] + offset) for row, offset in axes)
        lat, lon = latitude_longitude(x, y, z)
        lon = lon + 360.0 * torch.round((lon_of_point[:, None] - lon) / 360.0)
        yield torch.stack([torch.cat([value, value[:, :1]], 1) for value in (lat, lon)], -1).numpy()


def near(lon: float, other: float) -> float:
    """The longitude by which `lon` lies less than half a turn from `other`: beyond ±180 across the antimeridian."""
    return lon + 360.0 * round((other - lon) / 360.0)


def cut_at_antimeridian(ring: Sequence[tuple[float, float]]) -> list[Ring]:
    """A ring whose longitudes run beyond ±180 as one or two rings within ±180 (RFC 7946, section 3.1.9)."""
    edge = 180.0 if max(lon for _, lon in ring) > 180.0 else -180.0
    sides = []
    for outer in (False, True):
        kept: Ring = []
        for (lat0, lon0), (lat1, lon1) in itertools.pairwise(ring):
            out0, out1 = abs(lon0) > 180.0, abs(lon1) > 180.0
            if out0 == outer:
                kept.append((lat0, lon0))
            if out0 != out1:
                share = (edge - lon0) / (lon1 - lon0)
                kept.append((lat0 + share * (lat1 - lat0), edge))
        if kept:
            turn = -math.copysign(360.0, edge) if outer else 0.0
            kept = [(lat, lon + turn) for lat, lon in kept]
            sides.append([*kept, kept[0]])
    return sides


# Positions as a table of Arrow, and on the Earth of GeoParquet 1.1: geometries are longitude, latitude, height.

_MOVED = {"east_m": "x_m", "north_m": "y_m", "up_m": "z_m"}
_AXES = str.maketrans("enu", "xyz")
# The numbers of a rig that has no place on the Earth, by their names there: x, y and z for east, north and up.
OWN_FRAME = {
    name: re.sub("cov_(..)", lambda found: f"cov_{found[1].translate(_AXES)}", _MOVED.get(name, name))
    for name in NUMBERS
    if not name.startswith(("lat", "lon", "height", "geoid", "cep", "azimuth", "elevation"))
}
STATUS_NAMES = {int(status): status.name.lower() for status in PositionStatus}
_GEO = {
    "version": "1.1.0",
    "primary_column": "geometry",
    "columns": {
        "geometry": {"encoding": "WKB", "geometry_types": ["Point Z"]},
        "region": {"encoding": "WKB", "geometry_types": ["MultiPolygon"], "edges": "planar"},
    },
}


def position_table(columns: PositionColumns, run: Located) -> Any:
    """Some rows as `Located.to_arrow` gives all of them; with the cells of further columns as texts."""
    texts = {"name": columns.names, "status": [STATUS_NAMES[code] for code in columns.status.tolist()]}
    texts |= {"reason": columns.reasons}
    if run.origin is None:
        numbers = {own: columns.column(name) for name, own in OWN_FRAME.items()}
        return arrow_table(texts | numbers | columns.extras, {"kcal": {"frame": run.frame}})
    numbers = {name: columns.column(name) for name in NUMBERS}
    places = np.stack([numbers[name] for name in ("lon", "lat", "height_ellipsoidal_m")], -1)
    rings = (ring[:, ::-1] for block in ring_blocks(columns, run) for ring in block)
    regions = [wkb_polygon(_flat_rings(next(rings))) if there else None for there in columns.located.tolist()]
    geometries = {"geometry": wkb_points(places), "region": regions}
    about: dict[str, dict[str, Any]] = {"geo": _GEO, "kcal": {"range_interval": run.interval_note, "geoid": run.geoid}}
    return arrow_table(texts | numbers | columns.extras | geometries, about)


def _flat_rings(ring: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    if np.abs(ring[:, 0]).max() <= 180.0:
        return [ring]
    return [np.array(part)[:, ::-1] for part in cut_at_antimeridian(ring[:, ::-1].tolist())]


# Places and fields of view as a map draws them: latitude and longitude, computed on the ellipsoid.

_RIM_POINTS = 60


def map_places(enu: Tensor, origin: Origin) -> Ring:
    """Latitude and longitude in degrees of places (N, 3) in meters east, north, up of the origin.

    Longitudes lie within half a turn of the origin's: beyond ±180 across the antimeridian.

    Example:
        >>> lat, lon = map_places(torch.tensor([[0.0, 0.0, 0.0]]), Origin(lat=19.0, lon=72.9, height=0.0))[0]
        >>> round(lat, 9), round(lon, 9)
        (19.0, 72.9)
    """
    geodetic = enu_to_geodetic(enu.detach().cpu().double(), origin).tolist()
    return [(lat, near(lon, origin.lon)) for lat, lon, _ in geodetic]


def camera_place(camera: Viewpoint, origin: Origin) -> tuple[float, float]:
    """Latitude and longitude in degrees of a camera, its longitude within half a turn of the origin's."""
    return camera.geodetic[0], near(camera.geodetic[1], origin.lon)


def level_rim(foot: tuple[float, float, float], azimuths_deg: Tensor, reach: float) -> Tensor:
    """Places (N, 3) in meters east, north, up at a distance from a foot, in directions clockwise from north."""
    angle = torch.deg2rad(azimuths_deg)
    rim = torch.stack([angle.sin(), angle.cos(), torch.zeros_like(angle)], -1) * reach
    return rim + torch.tensor(foot, dtype=torch.float64)


def field_azimuths(camera: Viewpoint, count: int = _RIM_POINTS) -> Tensor | None:
    """Azimuths (count,) in degrees from the left end of a camera's field of view to its right end, without a jump.

    None if the lens model has no ray there.
    """
    if camera.azimuths_deg is None:
        return None
    first, last = camera.azimuths_deg
    return torch.linspace(first, first + (last - first) % 360, count, dtype=torch.float64)


def field_of_view(camera: Viewpoint, origin: Origin, reach: float) -> Ring | None:
    """Outline of what a camera sees, up to a distance in meters: its foot and an arc; None if it is not known."""
    sweep = field_azimuths(camera)
    if sweep is None:
        return None
    foot = torch.tensor([camera.enu], dtype=torch.float64)
    return map_places(torch.cat([foot, level_rim(camera.enu, sweep, reach)]), origin)


# Compare positions with the truth where it is known.


def read_truth(path: str | Path, located: Located) -> Tensor:
    r"""True positions (N, 3) east, north, up of the left camera for the located points by name; NaN where unknown.

    Args:
        path: a CSV with name,lat,lon,height or name,east,north,up (of the left camera), other columns as a survey has.
        located: what they are compared with.

    Raises:
        FileError: see `kcal.locate.survey.read_survey`.
        InputError: no name is in both.

    Example:
        >>> import tempfile
        >>> from kcal import locate_points
        >>> from kcal.locate import Marks
        >>> from kcal.rig import planned_rig
        >>> origin = Origin(lat=19.07, lon=72.87, height=14.0)
        >>> localize = Localizer(planned_rig().placed(origin=origin, heading_deg=0.0))
        >>> located = locate_points(localize, Marks(("mast",), planned_rig()(torch.tensor([[0.0, 0.0, 1000.0]]))[0]))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     _ = Path(folder, "truth.csv").write_text("name,east,north,up\nmast,1,1000,0\n")
        ...     read_truth(Path(folder, "truth.csv"), located).tolist()
        [[1.0, 1000.0, 0.0]]
    """
    survey = read_survey(path, located.place, measured=False)
    index = {name: i for i, name in enumerate(survey.names)}
    names = [position.name for position in located.positions]
    if not any(name in index for name in names):
        raise InputError(f"{path}: none of its names ({', '.join(survey.names[:3])} ...) is among the points")
    nowhere = torch.full((3,), math.nan, dtype=torch.float64)
    return torch.stack([survey.points[index[name]] if name in index else nowhere for name in names])


def position_errors(located: Located, truth: Tensor) -> list[tuple[float, float, bool] | None]:
    """The error of each position; None where position or truth is unknown.

    Returns:
        for each position its horizontal distance from the truth and its range minus the true one (meters), and whether
        the range interval contains the true range.

    Example:
        >>> from kcal import Camera, Rig, locate_points
        >>> from kcal.locate import Marks
        >>> camera = Camera.build(focal=(1600, 1600), center=(960, 540), size=(1920, 1080), model="pinhole")
        >>> rig = Rig.pair(camera, camera, torch.eye(3), torch.tensor([-10.0, 0.0, 0.0]))
        >>> localize = Localizer(rig.placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0))
        >>> found = locate_points(localize, Marks(("1",), torch.tensor([[[960.0, 540.0], [944.0, 540.0]]])))
        >>> [round(value, 6) for value in position_errors(found, torch.tensor([[3.0, 996.0, 0.0]]).double())[0][:1]]
        [5.0]
    """
    truth = as_points("truth", truth, 3)
    if truth.ndim != 2 or len(truth) != len(located.positions):
        raise InputError(f"truth: shape ({len(located.positions)}, 3) is needed, got {tuple(truth.shape)}")
    out: list[tuple[float, float, bool] | None] = []
    for position, true in zip(located.positions, truth, strict=True):
        if position.enu is None or position.range_m is None or not bool(torch.isfinite(true).all()):
            out.append(None)
            continue
        east, north, _ = (torch.tensor(position.enu, dtype=torch.float64) - true).tolist()
        away = float(torch.linalg.vector_norm(true))
        low, high = position.range_low_m or 0.0, position.range_high_m or math.inf
        out.append((math.hypot(east, north), position.range_m - away, low <= away <= high))
    return out


@torch.no_grad()
def interval_coverage(localize: Localizer, left: Tensor, right: Tensor, ranges: Tensor) -> float:
    """The share of pairs whose 95 % range interval contains the true range.

    Args:
        localize: what locates them.
        left: (N, 2) marks in the left image.
        right: (N, 2) in the right one.
        ranges: (N,) true ranges, meters.

    Example:
        >>> from kcal.rig import planned_rig
        >>> points = torch.tensor([[0.0, 0.0, 500.0], [9.0, 0.0, 800.0], [0.0, 9.0, 900.0]]).double()
        >>> origin = Origin(lat=19.07, lon=72.87, height=14.0)
        >>> localize = Localizer(planned_rig().placed(origin=origin, heading_deg=0.0))
        >>> left, right = planned_rig()(points)[0].unbind(-2)
        >>> round(interval_coverage(localize, left, right, torch.tensor([500.0, 2000.0, 900.0])), 3)
        0.667
    """
    found = localize(left, right)
    return float(((found.range_low <= ranges) & (ranges <= found.range_high)).double().mean())
