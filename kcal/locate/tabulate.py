"""Located points as rows of a table: heights above a datum, circular errors, and columns."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyproj
import torch
from numpy.typing import NDArray
from pyproj.exceptions import ProjError
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import FileError, InputError, KcalWarning
from kcal.lens.camera import Camera
from kcal.lens.rig import Origin
from kcal.locate.geodesy import azimuth_elevation
from kcal.locate.stereo import Localization, PositionStatus, covariance_root
from kcal.locate.tables import NUMBERS

# What depends on grids and map projections: height above the sea, and grid north. Through PROJ, outside any graph.

# Global geoid grids by the names PROJ gives them, the finer first.
_KNOWN_GRIDS = ("us_nga_egm08_25.tif", "egm08_25.gtx", "us_nga_egm96_15.tif", "egm96_15.gtx")
_SUFFIXES = (".tif", ".tiff", ".gtx", ".byn")


class Geoid(NamedTuple):
    """A geoid grid: the file, and the name under which results state it."""

    path: Path
    name: str


def find_geoid(path: str | Path | None = None) -> Geoid | None:
    """The geoid grid of a file, or one that PROJ finds on this machine, or None; nothing is downloaded.

    Args:
        path: a grid that PROJ reads (.tif, .gtx, .byn), for example `us_nga_egm08_25.tif` from cdn.proj.org.

    Raises:
        FileError: a file was given and is not there, or is no grid.

    Example:
        >>> find_geoid("no-such-grid.gtx")
        Traceback (most recent call last):
        kcal.errors.FileError: no-such-grid.gtx: no such geoid grid
    """
    if path is not None:
        path = Path(path)
        if not path.is_file():
            raise FileError(f"{path}: no such geoid grid")
        if path.suffix.lower() not in _SUFFIXES:
            raise FileError(f"{path}: a geoid grid ends with {', '.join(_SUFFIXES)}")
        return Geoid(path, path.stem)
    folders = [*pyproj.datadir.get_data_dir().split(os.pathsep), pyproj.datadir.get_user_data_dir()]
    for name in _KNOWN_GRIDS:
        for folder in folders:
            if (found := Path(folder, name)).is_file():
                return Geoid(found, found.stem)
    return None


def geoid_column(geoid: Geoid, lat: NDArray[np.float64], lon: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height (N,) of the geoid above the WGS84 ellipsoid, meters; NaN outside the grid.

    Height above the geoid, which is close to height above mean sea level, is ellipsoidal height minus this.

    Args:
        geoid: the grid.
        lat: (N,) degrees.
        lon: (N,) degrees.

    Raises:
        FileError: PROJ cannot read the grid.
    """
    try:
        shift = pyproj.Transformer.from_pipeline(
            f"+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad "
            f'+step +proj=vgridshift +multiplier=1 +grids="{geoid.path.resolve()}" '
            "+step +proj=unitconvert +xy_in=rad +xy_out=deg"
        )
        # Above the geoid 0 m is above the ellipsoid N m.
        heights = shift.transform(lon, lat, np.zeros(len(lon)))[2]
    except ProjError as error:
        raise FileError(f"{geoid.path}: PROJ cannot read this geoid grid: {error}") from error
    return np.where(np.isfinite(heights), heights, np.nan)


def true_from_grid(grid_heading_deg: float, origin: Origin, crs: str) -> float:
    """Heading from true north of a heading measured from a map's grid north.

    Grid north and true north differ by the meridian convergence, up to 3° in UTM: 61 m at 5 km for each 0.7°.

    Args:
        grid_heading_deg: clockwise from grid north.
        origin: where it was measured.
        crs: the map's projected coordinate system, for example `"EPSG:32643"` (UTM zone 43 north).

    Outside the area that the system is made for, such as another zone of UTM, a `KcalWarning` says how it is turned.

    Raises:
        InputError: not a projected coordinate system, or the place lies outside of it.

    Example:
        >>> mumbai = Origin(lat=19.07, lon=72.87, height=14.0)
        >>> round(true_from_grid(0.0, mumbai, "EPSG:32643"), 3)
        -0.696
    """
    try:
        system = pyproj.CRS.from_user_input(crs)
    except ProjError as error:
        raise InputError(f"{crs}: PROJ does not know this coordinate system; write for example EPSG:32643") from error
    if not system.is_projected:
        raise InputError(f"{crs}: {system.name} has no grid; a projected system such as EPSG:32643 is needed")
    try:
        # The azimuth of grid north from true north; longitudes count from the system's own meridian, such as Paris.
        meridian = system.prime_meridian
        first = math.degrees(meridian.longitude * float(meridian.unit_conversion_factor)) if meridian else 0.0
        factors = pyproj.Proj(system).get_factors(origin.lon - first, origin.lat, errcheck=True)
        grid_north = factors.meridian_convergence
    except ProjError as error:
        raise InputError(f"{crs}: {system.name} does not reach {origin.lat:g}, {origin.lon:g}") from error
    area = system.area_of_use
    if area is not None and not _lies_within(area.bounds, origin):
        warnings.warn(
            f"{crs}: {system.name} is made for latitudes {area.south:g} to {area.north:g} and longitudes {area.west:g} "
            f"to {area.east:g}, not for {origin.lat:g}, {origin.lon:g}, where its grid north is {grid_north:.2f}° from "
            "true north: is it this map's?",
            KcalWarning,
            stacklevel=2,
        )
    return math.fmod(grid_heading_deg + grid_north, 360.0)


def _lies_within(bounds: tuple[float, float, float, float], origin: Origin) -> bool:
    """Whether a place is inside west, south, east and north bounds, across the antimeridian or all around, too."""
    west, south, east, north = bounds
    width = (east - west) % 360 or 360
    return south <= origin.lat <= north and (origin.lon - west) % 360 <= width


# Circular error probable of positions whose error ellipse is long, and skewed along the line of sight.
#
# At 5 km an ellipse of a stereo rig is a thousand times longer than wide, so that the usual formulas for circles miss;
# and along the line of sight the error of the inverse range is Gaussian, not that of the range. So the errors of the
# vector X / |X|², which is linear in the marks at any distance, are integrated over the region that the circle becomes.

# The integral in the plane neglects the square of errors across the line of sight, as shares of the horizontal
# distance: at 1 % the radius is wrong by at most 0.3 %, no more than samples are. Points with larger ones are sampled.
_LARGEST_ACROSS = 0.01
# A quasi-random set of this size knows the radius to some 0.3 %; points at once, so that memory stays below 200 MB.
_DRAWS, _SAMPLED_AT_ONCE = 8192, 256
# Points at once in the integral: fewer cost more calls, more do not fit the cache.
_AT_ONCE = 8192
# Ellipses narrower than this need 6 Gauss-Hermite nodes across, all others 16 nodes: 1e-6 and 5e-4 at worst.
_NARROW, _FEW_NODES, _NODES = 0.15, 6, 16
# Standard deviations beyond which a Gaussian need not be integrated, and from which on the circle's edge is far enough
# away for Gauss-Hermite nodes.
_TAIL, _FAR = 6.0, 4.0
_STEPS = 40


def circular_error(enu: Tensor, covariance: Tensor, shares: tuple[float, ...] = (0.5, 0.95)) -> Tensor:
    """Radii of the horizontal circles about an estimate that contain the true position with the given probabilities.

    Args:
        enu: (..., 3) estimates, meters from the camera that ranges are measured from.
        covariance: (..., 3, 3) to first order, as `Localization.covariance`.
        shares: probabilities: CEP50 and CEP95.

    Returns:
        (..., K) meters, good to 0.3 % (0.5 % where errors across the line of sight are above 1 % of the distance);
        infinite where the covariance is not finite or so large a share may lie at infinity.

    Raises:
        InputError: wrong shapes, or a share that is no probability.

    Example:
        >>> enu = torch.tensor([0.0, 1000.0, 0.0], dtype=torch.float64)
        >>> thin = torch.diag(torch.tensor([0.01, 5.0, 0.01], dtype=torch.float64) ** 2)
        >>> [round(radius, 2) for radius in circular_error(enu, thin).tolist()]  # 0.674 and 1.96 sigma, not 1.18, 2.45
        [3.37, 9.8]
    """
    enu = as_points("enu", enu, 3).detach()
    covariance = as_points("covariance", covariance, 3).detach()
    if covariance.shape != (*enu.shape, 3):
        raise InputError(f"covariance: shape {(*enu.shape, 3)} is needed, got {tuple(covariance.shape)}")
    if not shares or not all(0 < share < 1 for share in shares):
        raise InputError(f"shares {shares}: probabilities between 0 and 1 are needed")
    points, matrices = enu.reshape(-1, 3), covariance.reshape(-1, 3, 3)
    squared = points.square().sum(-1)
    known = torch.isfinite(matrices).all(-1).all(-1) & (squared > 0) & torch.isfinite(squared)
    level = points[:, :2].square().sum(-1)
    along = (points[:, None] @ matrices @ points[:, :, None])[:, 0, 0] / squared
    across = matrices.diagonal(dim1=-2, dim2=-1).sum(-1) - along
    near_plane = known & (across < _LARGEST_ACROSS**2 * level)
    radii = points.new_full((len(points), len(shares)), math.inf)
    for row in near_plane.nonzero()[:, 0].split(_AT_ONCE):
        radii[row] = _integrated(points[row, :2], matrices[row, :2, :2], shares)
    # What the integral left open: NaN.
    open_rows = (known & ~near_plane) | radii.isnan().any(-1)
    for row in open_rows.nonzero()[:, 0].split(_SAMPLED_AT_ONCE):
        radii[row] = _sampled(points[row], matrices[row], shares)
    return radii.reshape(*enu.shape[:-1], len(shares))


class _Ellipse(NamedTuple):
    """Errors of X / |X|² in the horizontal plane, in units of 1 / |X|: (N,) each.

    Attributes:
        long: standard deviation along the long axis.
        short: across it.
        cosine: of the angle between the long axis and the line of sight; not negative.
        sine: of the same angle, not negative.
    """

    long: Tensor
    short: Tensor
    cosine: Tensor
    sine: Tensor


def _integrated(place: Tensor, spread: Tensor, shares: tuple[float, ...]) -> Tensor:
    """(N, K) radii of horizontal places (N, 2) with covariances (N, 2, 2); NaN where the search did not end."""
    squared = place.square().sum(-1)
    east, north = place.unbind(-1)
    ee, en, nn = spread[:, 0, 0], spread[:, 0, 1], spread[:, 1, 1]
    # To first order X / |X|² reflects errors along the line of sight: only the sign of the correlation changes.
    radial = (east * east * ee + 2.0 * east * north * en + north * north * nn) / squared.square()
    cross = (north * north * ee - 2.0 * east * north * en + east * east * nn) / squared.square()
    mixed = (east * north * (nn - ee) + (east * east - north * north) * en) / squared.square()
    half, turn = 0.5 * (radial - cross), 0.5 * torch.atan2(2.0 * mixed, radial - cross)
    root = torch.hypot(half, mixed)
    long = 0.5 * (radial + cross) + root
    short = ((radial * cross - mixed * mixed) / long).clamp_min(1e-18 * long)
    ellipse = _Ellipse(long.sqrt(), short.sqrt(), turn.cos().abs(), turn.sin().abs())
    narrow = ellipse.short < _NARROW * ellipse.long
    found = place.new_empty(len(place), len(shares))
    for few in (True, False):
        (row,) = torch.nonzero(narrow if few else ~narrow, as_tuple=True)
        part = _Ellipse(*(value[row] for value in ellipse))
        for number, share in enumerate(shares):
            ratio = _quantile(part, share, _FEW_NODES if few else _NODES)
            # Beyond infinity, behind the camera, lies what is left.
            ahead = torch.special.ndtr(1.0 / radial[row].sqrt())
            found[row, number] = torch.where(ahead > share, ratio * squared[row].sqrt(), math.inf)
    return found


def _quantile(ellipse: _Ellipse, share: float, nodes: int) -> Tensor:
    """(N,) radius over distance that contains the share; NaN where the search did not end."""
    sigmas = float(torch.special.ndtri(torch.tensor(share, dtype=torch.float64)))
    goal = math.log(float(torch.erfinv(torch.tensor(share, dtype=torch.float64))))
    # Wilson and Hilferty's approximation of a weighted sum of chi-squares, good to 2 % without skewness.
    total = ellipse.long.square() + ellipse.short.square()
    shape = 2.0 / 9.0 * (ellipse.long**4 + ellipse.short**4) / total.square()
    start = total.sqrt() * (1.0 - shape + sigmas * shape.sqrt()).clamp_min(1e-3) ** 1.5

    # As a number of standard deviations in one dimension, a share grows like a power of the radius: secants of the
    # logarithms end after two or three steps.
    def excess(x: Tensor, part: _Ellipse) -> Tensor:
        return goal - torch.erfinv(_share(x.exp(), part, nodes).clamp(1e-12, 1.0 - 1e-12)).log()

    x = start.log()
    last = excess(x, ellipse)
    out, step, row = x.clone(), last, torch.arange(len(x), device=x.device)
    for _ in range(_STEPS):
        if len(row) == 0:
            return out.exp()
        part = _Ellipse(*(value[row] for value in ellipse))
        x = x + step
        now = excess(x, part)
        slope = ((last - now) / step).nan_to_num(1.0).clamp(0.05, 4.0)
        following = (now / slope).clamp(-2.0, 2.0)
        out[row] = x + following
        # The next error is about the product of these two.
        more = ((following * step).abs() > 1e-4) | (following.abs() > 0.05)
        row, x, last, step = row[more], x[more], now[more], following[more]
    out[row] = math.nan
    return out.exp()


def _share(ratio: Tensor, ellipse: _Ellipse, nodes: int) -> Tensor:
    """(N,) probability that the true position lies within `ratio` times the distance from the estimate.

    An inversion takes circles to circles: with Y in units of 1 / |X| and the mean at (1, 0), the condition is
    (1 - ratio²) |Y|² - 2 Y[0] + 1 <= 0. Along the long axis its Gaussian is integrated in closed form between the two
    ends, across it by quadrature.
    """
    hermite, hermite_weight, sine, sine_weight = _rules(nodes, ratio.device)
    level = 1.0 - ratio * ratio
    bounded = level > 1e-9
    divisor = torch.where(bounded, level, 1.0)
    t, weight = hermite, hermite_weight
    if nodes > _FEW_NODES:
        # The disc's extent across the long axis; t = middle + half sin θ removes the root at its edges.
        middle = torch.where(bounded, -ellipse.sine * ratio * ratio / divisor / ellipse.short, 0.0)
        extent = torch.where(bounded, ratio / divisor / ellipse.short, math.inf)
        low, high = (middle - extent).clamp_min(-_TAIL), (middle + extent).clamp_max(_TAIL)
        far = ((low < -_FAR) & (high > _FAR))[:, None]
        half = 0.5 * (high - low)[:, None]
        t = 0.5 * (low + high)[:, None] + half * sine
        weight = torch.where(far, hermite_weight, half * sine_weight * torch.exp(-0.5 * t * t))
        t = torch.where(far, hermite, t)
    across = ellipse.short[:, None] * t
    # k u² + 2 b u + c <= 0 for u along the long axis.
    k, b = level[:, None], ((level - 1.0) * ellipse.cosine)[:, None]
    beside = across * ellipse.sine[:, None]
    c = k * (1.0 - 2.0 * beside + across * across) - 2.0 * (1.0 - beside) + 1.0
    squared = b * b - k * c
    root = squared.clamp_min(0.0).sqrt()
    to_sigmas = (math.sqrt(0.5) / ellipse.long)[:, None]
    near = torch.erf(c / (root - b).clamp_min(1e-300) * to_sigmas)
    far_end = torch.where(bounded[:, None], torch.erf((root - b) / divisor[:, None] * to_sigmas), 1.0)
    return 0.5 * (weight * torch.where(squared > 0, far_end - near, 0.0)).sum(-1)


@functools.lru_cache(maxsize=4)
def _rules(nodes: int, device: torch.device) -> tuple[Tensor, ...]:
    """Gauss-Hermite nodes and weights; and sin θ of Gauss-Legendre nodes, with weights that contain cos θ."""
    normal, normal_weight = np.polynomial.hermite_e.hermegauss(nodes)
    unit, unit_weight = np.polynomial.legendre.leggauss(nodes)
    angle = 0.5 * math.pi * unit
    scale = math.sqrt(0.5 / math.pi)
    rules = (normal, scale * normal_weight, np.sin(angle), scale * 0.5 * math.pi * unit_weight * np.cos(angle))
    return tuple(torch.as_tensor(rule, device=device) for rule in rules)


def _sampled(enu: Tensor, covariance: Tensor, shares: tuple[float, ...]) -> Tensor:
    """(N, K) radii, for errors of any size in any direction: X / |X|² is sampled in space and carried over."""
    squared = (enu * enu).sum(-1)
    still = torch.eye(3, dtype=enu.dtype, device=enu.device)
    # The derivative of X / |X|² by X: a reflection along X, over |X|².
    direction = enu / squared.sqrt()[:, None]
    slope = (still - 2.0 * direction[:, :, None] * direction[:, None, :]) / squared[:, None, None]
    factor = covariance_root(slope @ covariance @ slope.mT)
    inverted = enu / squared[:, None]
    samples = inverted[:, None, :] + _standard_normal(enu.device) @ factor.mT
    ahead = (samples * direction[:, None, :]).sum(-1) > 0
    points = samples / (samples * samples).sum(-1, keepdim=True).clamp_min(1e-300)
    distance = torch.linalg.vector_norm((points - enu[:, None, :])[..., :2], dim=-1)
    ordered = torch.where(ahead, distance, torch.inf).sort(-1).values
    return ordered[:, [min(_DRAWS - 1, round(share * _DRAWS)) for share in shares]]


@functools.lru_cache(maxsize=2)
def _standard_normal(device: torch.device) -> Tensor:
    """(S, 3) standard normal points, the same ones every time."""
    uniform = torch.quasirandom.SobolEngine(3, scramble=True, seed=1).draw(_DRAWS, dtype=torch.float64)
    # Never 0 or 1, where the inverse is infinite.
    half = 0.5 / _DRAWS
    return torch.special.ndtri(uniform.clamp(half, 1.0 - half)).to(device)


# Columns of positions, and where cameras stand for maps.


@dataclasses.dataclass(frozen=True, kw_only=True)
class Viewpoint:
    """Position and field of view of a camera of the rig, for maps.

    Args:
        name: "left" or "right", or that of a station.
        enu: meters from the origin.
        geodetic: latitude, longitude in degrees, ellipsoidal WGS84 height in meters.
        azimuths_deg: of the left and right ends of the image's middle row, or None if the lens model has no ray there.
    """

    name: str
    enu: tuple[float, float, float]
    geodetic: tuple[float, float, float]
    azimuths_deg: tuple[float, float] | None


Group = tuple[str, NDArray[np.bool_], NDArray[np.float64]]


def number_table(found: Localization, more: Sequence[Group] = (), *, on_earth: bool = True) -> NDArray[np.float64]:
    """(N, 24) the columns `NUMBERS` of localized points or tracks on the CPU; NaN where unknown.

    Args:
        found: (N,) of them; what it says of single views is not read.
        more: other columns: name of the first, (N,) where they are known, and values (columns, N).
        on_earth: whether there is anything level: latitudes, circles, azimuths.
    """
    status = found.status
    ok = (status == int(PositionStatus.OK)).numpy()
    aimed = ok | torch.isin(status, status.new_tensor([PositionStatus.BEARING_ONLY, PositionStatus.PARALLEL])).numpy()
    circles = torch.full((len(ok), 2), math.nan, dtype=torch.float64)
    if on_earth:
        circles[torch.from_numpy(ok)] = circular_error(found.enu[ok], found.covariance[ok])
    interval = torch.stack([found.range_low, found.range_high])
    groups: tuple[Group, ...] = (
        ("lat", ok & on_earth, found.geodetic.T.numpy()),
        ("east_m", ok, found.enu.T.numpy()),
        ("range_m", ok, 1.0 / np.where(ok, found.inverse_range.numpy(), 1.0)[None]),
        ("range_low_m", aimed & torch.isfinite(found.range_low).numpy(), interval.numpy()),
        ("cov_ee_m2", ok, found.covariance[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]].T.numpy()),
        ("cep50_m", ok, circles.T.numpy()),
        ("azimuth_deg", aimed & on_earth, azimuth_elevation(found.bearing).T.numpy()),
        *more,
    )
    table = np.full((len(NUMBERS), len(ok)), np.nan)
    for first, where, values in groups:
        row = NUMBERS.index(first)
        np.copyto(table[row : row + len(values)], values, where=where)
    return np.ascontiguousarray(table.T)


def middle_row_ends(camera: Camera) -> Tensor | None:
    """Rays (2, 3) through the left and right ends of the image's middle row, on the CPU; None where there are none."""
    width, height = camera.size
    ends = camera.focal.new_tensor([[-0.5, (height - 1) / 2], [width - 0.5, (height - 1) / 2]])
    with torch.no_grad():
        rays, valid = camera.unproject(ends)
    return rays.cpu() if bool(valid.all()) else None
