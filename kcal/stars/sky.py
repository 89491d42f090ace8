"""The bright stars, and where they are seen from a place on the Earth."""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import functools
import hashlib
import io
import itertools
import math
import os
import sys
import warnings
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import stats
from scipy.spatial import cKDTree

from kcal.errors import FileError, InputError
from kcal.files import make_folder, read_bytes, write_atomic
from kcal.lens.pose import rotation_between
from kcal.lens.rig import Origin
from kcal.texts import brief

# The bright stars: positions, proper motions and magnitudes, and names for the brightest.
#
# The catalog in the package is the Yale Bright Star Catalogue, 5th revised edition (D. Hoffleit and W. H. Warren Jr.,
# 1991, Astronomical Data Center; CDS V/50): 9,096 stars to magnitude 6.5 and some fainter ones, with positions good to
# about 1 second of arc. It is a compilation of facts that is distributed without a license text.

PACKED_FILE = Path(__file__).with_name("bright_stars.bin")
# Angles are 2**-32 of a turn, proper motions milliarcseconds a year (in right ascension times cos δ).
PACKED = np.dtype([
    ("number", "<u2"), ("ra", "<i4"), ("dec", "<i4"), ("pm_ra", "<i2"), ("pm_dec", "<i2"), ("magnitude", "<i2"),
])  # fmt: skip
# Proper motions are linear only for so long: outside, fast and near stars leave their places by seconds of arc.
FIRST_YEAR, LAST_YEAR = 1900.0, 2100.0
_TURN = 2.0 * np.pi / 2**32
_MILLIARCSECOND = np.pi / 180 / 3_600_000

# Names by the International Astronomical Union's catalog of star names, by Harvard Revised number.
_NAMES = {
    15: "Alpheratz", 21: "Caph", 168: "Schedar", 188: "Diphda", 337: "Mirach", 424: "Polaris", 472: "Achernar",
    603: "Almach", 617: "Hamal", 936: "Algol", 1017: "Mirfak", 1457: "Aldebaran", 1708: "Capella", 1713: "Rigel",
    1790: "Bellatrix", 1791: "Elnath", 1852: "Mintaka", 1903: "Alnilam", 1948: "Alnitak", 2061: "Betelgeuse",
    2088: "Menkalinan", 2294: "Mirzam", 2326: "Canopus", 2421: "Alhena", 2491: "Sirius", 2618: "Adhara", 2693: "Wezen",
    2891: "Castor", 2943: "Procyon", 2990: "Pollux", 3307: "Avior", 3685: "Miaplacidus", 3748: "Alphard",
    3982: "Regulus", 4295: "Merak", 4301: "Dubhe", 4534: "Denebola", 4554: "Phecda", 4660: "Megrez", 4730: "Acrux",
    4763: "Gacrux", 4853: "Mimosa", 4905: "Alioth", 5054: "Mizar", 5056: "Spica", 5191: "Alkaid", 5267: "Hadar",
    5340: "Arcturus", 5459: "Rigil Kentaurus", 5460: "Toliman", 5563: "Kochab", 5793: "Alphecca", 6134: "Antares",
    6217: "Atria", 6527: "Shaula", 6553: "Sargas", 6556: "Rasalhague", 6705: "Eltanin", 6879: "Kaus Australis",
    7001: "Vega", 7121: "Nunki", 7417: "Albireo", 7557: "Altair", 7790: "Peacock", 7796: "Sadr", 7924: "Deneb",
    8162: "Alderamin", 8308: "Enif", 8425: "Alnair", 8728: "Fomalhaut", 8775: "Scheat", 8781: "Markab",
}  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class StarCatalog:
    """Stars by number: places at J2000 in the International Celestial Reference System, motions and magnitudes.

    Args:
        number: (N,) of the star in its catalog; Harvard Revised (HR) in the one that kcal brings along.
        ra: (N,) right ascension, radians.
        dec: (N,) declination, radians.
        pm_ra: (N,) proper motion in right ascension times cos δ, radians a year.
        pm_dec: (N,) proper motion in declination, radians a year.
        magnitude: (N,) visual.

    Raises:
        InputError: arrays of other shapes, values that are not finite, or a declination beyond ±90°.

    Example:
        >>> stars = StarCatalog.bundled()
        >>> len(stars), stars.name_of(2491), round(float(stars.magnitude.min()), 2)
        (9096, 'Sirius', -1.46)
    """

    __repr__ = brief

    number: NDArray[np.int64]
    ra: NDArray[np.float64]
    dec: NDArray[np.float64]
    pm_ra: NDArray[np.float64]
    pm_dec: NDArray[np.float64]
    magnitude: NDArray[np.float64]

    def __post_init__(self) -> None:
        columns = [self.ra, self.dec, self.pm_ra, self.pm_dec, self.magnitude]
        if any(column.shape != self.number.shape or column.ndim != 1 for column in columns):
            raise InputError("star catalog: six arrays of the same shape (N,) are needed")
        if not all(np.isfinite(column).all() for column in columns) or (np.abs(self.dec) > np.pi / 2).any():
            raise InputError("star catalog: a value is not finite, or a declination is beyond 90 degrees")

    def __len__(self) -> int:
        """How many stars there are."""
        return len(self.number)

    @staticmethod
    @functools.cache
    def bundled() -> StarCatalog:
        """The Yale Bright Star Catalogue, which is part of kcal: 9,096 stars."""
        table = np.frombuffer(read_bytes(PACKED_FILE), PACKED)
        ra, dec = (table[name].astype(np.float64) * _TURN for name in ("ra", "dec"))
        return StarCatalog(
            number=table["number"].astype(np.int64),
            ra=ra % (2 * np.pi),
            dec=dec,
            pm_ra=table["pm_ra"] * _MILLIARCSECOND,
            pm_dec=table["pm_dec"] * _MILLIARCSECOND,
            magnitude=table["magnitude"] / 100.0,
        )

    def name_of(self, number: int) -> str:
        """A star's proper name, where it has a well known one, otherwise `HR 1234`."""
        return _NAMES.get(int(number), f"HR {int(number)}")

    def directions(self, year: float = 2000.0) -> NDArray[np.float64]:
        """(N, 3) unit vectors in the celestial frame, with proper motion to `year`, without aberration.

        Raises:
            InputError: a year for which proper motions are not linear any more.
        """
        if not FIRST_YEAR <= year <= LAST_YEAR:
            raise InputError(f"star catalog: the year {year:.0f} is outside {FIRST_YEAR:.0f} to {LAST_YEAR:.0f}")
        time, cos = year - 2000.0, np.cos(self.dec)
        ra, dec = self.ra + time * self.pm_ra / np.maximum(cos, 1e-9), self.dec + time * self.pm_dec
        return unit_vectors(ra, dec)


def unit_vectors(longitude: NDArray[np.float64], latitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """(N, 3) from angles in radians.

    Example:
        >>> unit_vectors(np.array([np.pi / 2]), np.array([0.0])).round(12).tolist()
        [[0.0, 1.0, 0.0]]
    """
    cos = np.cos(latitude)
    return np.stack([np.cos(longitude) * cos, np.sin(longitude) * cos, np.sin(latitude)], -1)


# Where stars are seen from a place on the Earth: proper motion, aberration, the Earth's rotation and refraction.
#
# All of it is done by pyerfa, offline. What it does not know are UT1 - UTC (below 0.9 s by definition; one second of
# time is 15 seconds of arc) and polar motion (0.3 seconds of arc, left out).

# rad/s: the Earth turns by this against the stars.
EARTH_RATE = 7.292115e-5
# s: dUT1 where nobody says it: between -0.9 and 0.9 by definition, taken as equally likely.
UNKNOWN_DUT1_SIGMA = 0.9 / math.sqrt(3.0)
# Below this altitude the model of refraction errs by more than 10 seconds of arc, and it is not used.
LOWEST_ALTITUDE = math.radians(5.0)
_FIRST, _LAST = 1972, 2100
_ARCSECOND = math.pi / 180 / 3600


@dataclasses.dataclass(frozen=True, kw_only=True)
class Air:
    """The air at the camera, which refracts starlight, and how well it is known.

    Args:
        hectopascal: pressure there, not reduced to sea level.
        celsius: temperature.
        humidity: relative, 0 to 1.
        hectopascal_sigma: standard deviation of the pressure.
        celsius_sigma: standard deviation of the temperature.

    Raises:
        InputError: a value that no air has.

    Example:
        >>> round(Air.at_height(1282.0).hectopascal)
        868
    """

    hectopascal: float
    celsius: float = 10.0
    humidity: float = 0.5
    hectopascal_sigma: float = 10.0
    celsius_sigma: float = 10.0

    def __post_init__(self) -> None:
        if not (0 <= self.hectopascal <= 1100 and -90 <= self.celsius <= 60 and 0 <= self.humidity <= 1):
            raise InputError(
                f"air: {self.hectopascal:g} hPa, {self.celsius:g} °C and a humidity of {self.humidity:g} are not those "
                "of any air; hectopascal at the camera, degrees Celsius and a share from 0 to 1 are needed"
            )
        if not (0 <= self.hectopascal_sigma < math.inf and 0 <= self.celsius_sigma < math.inf):
            raise InputError("air: standard deviations must be numbers from 0 on")

    @classmethod
    def at_height(cls, height: float, **known: float) -> Air:
        """Standard air at a height in meters (ISO 2533), for what is not among the `known` values."""
        standard = 1013.25 * max(1.0 - 2.25577e-5 * height, 0.0) ** 5.25588
        return cls(**{"hectopascal": standard, **known})


def require_erfa() -> Any:
    """The module erfa.

    Raises:
        InputError: pyerfa is not installed.
    """
    try:
        import erfa
    except ImportError as error:
        raise InputError("stars need pyerfa; install it with: pip install 'kcal[stars]'") from error
    return erfa


def year_of(time: datetime.datetime) -> float:
    """The year with its fraction.

    Raises:
        InputError: a time without a zone, or one for which no leap seconds or positions are known.
    """
    if time.tzinfo is None:
        raise InputError("a time with a zone is needed: an hour is 15° of heading")
    if not _FIRST <= time.year < _LAST:
        raise InputError(f"the year {time.year} is outside {_FIRST} to {_LAST}; is the clock of the camera right?")
    start = datetime.datetime(time.year, 1, 1, tzinfo=datetime.UTC)
    return time.year + (time - start).total_seconds() / (365.25 * 86400)


def celestial_directions(catalog: StarCatalog, time: datetime.datetime | None = None) -> NDArray[np.float64]:
    """(N, 3) unit vectors without a place, in the axes of the International Celestial Reference System.

    With proper motion and aberration (20 seconds of arc) at a time; without one, as they stood at J2000.

    Raises:
        InputError: pyerfa is missing, a time without zone or out of range.

    Example:
        >>> celestial_directions(StarCatalog.bundled()).shape
        (9096, 3)
    """
    if time is None:
        return catalog.directions()
    year_of(time)
    erfa = require_erfa()
    with _quiet(erfa):
        context, _ = erfa.apci13(*_julian(erfa, time))
        ra, dec = erfa.atciq(*_columns(catalog), 0.0, 0.0, context)
    # From the axes of the equator of date back to those of the catalog.
    return unit_vectors(ra, dec) @ np.asarray(context["bpn"], np.float64)


def observed_directions(
    catalog: StarCatalog, time: datetime.datetime, origin: Origin, air: Air | None = None, dut1: float = 0.0
) -> NDArray[np.float64]:
    """(N, 3) unit vectors east, north, up (of the WGS84 ellipsoid) in which stars are seen, refracted.

    Args:
        catalog: the stars.
        time: when, with a zone.
        origin: the camera's place.
        air: there; standard air at that height if left out.
        dut1: UT1 - UTC in seconds; one second is 15 seconds of arc.

    Raises:
        InputError: pyerfa is missing, a time without zone or out of range, or a dut1 that cannot be.

    Example:
        >>> place = Origin(lat=52.0, lon=4.4, height=0.0)
        >>> time = datetime.datetime(2019, 7, 29, 20, 47, 26, tzinfo=datetime.UTC)
        >>> seen = observed_directions(StarCatalog.bundled(), time, place)
        >>> polaris = seen[StarCatalog.bundled().number == 424][0]
        >>> round(float(np.degrees(np.arcsin(polaris[2]))), 1)
        51.5
    """
    if not abs(dut1) <= 1.0:
        raise InputError(f"dut1 {dut1}: UT1 - UTC is between -0.9 and 0.9 seconds")
    year_of(time)
    erfa, air = require_erfa(), air or Air.at_height(origin.height)
    place = math.radians(origin.lon), math.radians(origin.lat), origin.height
    with _quiet(erfa):
        # Once for all stars: 0.1 ms, which `atco13` would take for each.
        weather = air.hectopascal, air.celsius, air.humidity
        context, _ = erfa.apco13(*_julian(erfa, time), dut1, *place, 0.0, 0.0, *weather, 0.6)
        ra, dec = erfa.atciq(*_columns(catalog), 0.0, 0.0, context)
        azimuth, zenith, *_ = erfa.atioq(ra, dec, context)
    # `unit_vectors` counts from the first axis; azimuths count from north, the second.
    return unit_vectors(np.pi / 2 - azimuth, np.pi / 2 - zenith)


def sun_at(time: datetime.datetime) -> StarCatalog:
    """The Sun at a time, as the only star of a catalog.

    Example:
        >>> place, time = Origin(lat=52.0, lon=4.4, height=0.0), datetime.datetime(2019, 7, 29, 21, tzinfo=datetime.UTC)
        >>> round(float(np.degrees(np.arcsin(observed_directions(sun_at(time), time, place)[0, 2]))))
        -10
    """
    erfa = require_erfa()
    with _quiet(erfa):
        earth, _ = erfa.epv00(*_julian(erfa, time))
    x, y, z = -np.asarray(earth["p"])[:, None]
    ra, dec, still = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y)), np.zeros(1)
    return StarCatalog(number=np.zeros(1, np.int64), ra=ra, dec=dec, pm_ra=still, pm_dec=still, magnitude=still)


def pole_in_enu(lat: float) -> NDArray[np.float64]:
    """(3,) the Earth's axis, towards the north, in the east, north, up of a latitude in degrees."""
    return np.array([0.0, math.cos(math.radians(lat)), math.sin(math.radians(lat))])


def refraction_sigma(altitude: NDArray[np.float64]) -> NDArray[np.float64]:
    """Radians by which the model of refraction errs: .3 seconds of arc at 10°, 5 at 5° (ERFA, refco)."""
    return 0.3 * _ARCSECOND * (np.radians(10.0) / np.maximum(altitude, np.radians(2.0))) ** 4


def _columns(catalog: StarCatalog) -> tuple[NDArray[np.float64], ...]:
    return catalog.ra, catalog.dec, catalog.pm_ra / np.maximum(np.cos(catalog.dec), 1e-9), catalog.pm_dec


def _julian(erfa: Any, time: datetime.datetime) -> tuple[float, float]:
    t = time.astimezone(datetime.UTC)
    first, second = erfa.dtf2d("UTC", t.year, t.month, t.day, t.hour, t.minute, t.second + t.microsecond * 1e-6)
    return float(first), float(second)


def _quiet(erfa: Any) -> warnings.catch_warnings[None]:
    # A "dubious year" is one whose leap seconds are not known yet: part of what is not known of UT1.
    return warnings.catch_warnings(action="ignore", category=erfa.ErfaWarning)


# Angles between bright stars, sorted, for identification; kept on disk in the user's folder for caches.

# Degrees. A table is made for the first that is enough for a field.
_ANGLES = (3.0, 5.0, 7.0, 10.0, 14.0, 20.0, 28.0, 40.0, 60.0)
# Of one table: for wide angles, fewer stars take part.
_MOST_PAIRS = 700_000
_VERSION = 1


class PairTable(NamedTuple):
    """Pairs of stars by their angle; stars are counted by brightness, the brightest being 0.

    Attributes:
        order: (N,) index in the catalog of each star by brightness.
        directions: (N, 3) unit vectors of these.
        pairs: (2 P, 2) uint16, each pair both ways.
        angle: (2 P,) radians, ascending.
        stars: how many of the brightest stars take part.
    """

    order: NDArray[np.int64]
    directions: NDArray[np.float64]
    pairs: NDArray[np.uint16]
    angle: NDArray[np.float32]
    stars: int


def cache_folder() -> Path:
    """The user's folder for caches of kcal; `KCAL_CACHE` names another one."""
    if given := os.environ.get("KCAL_CACHE"):
        return Path(given)
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local") / "kcal"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "kcal"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "kcal"


def pair_table(catalog: StarCatalog, field: float) -> PairTable:
    """The table for images whose diagonal is `field` radians, from the disk or made now (a second or less)."""
    degrees = next((angle for angle in _ANGLES if angle >= min(0.8 * np.degrees(field), _ANGLES[-1])), _ANGLES[-1])
    return _table_of(catalog, degrees, cache_folder())


# Of many images of one camera; a table of 700,000 pairs takes 17 MB.
@functools.lru_cache(maxsize=3)
def _table_of(catalog: StarCatalog, degrees: float, folder: Path) -> PairTable:
    order = np.argsort(catalog.magnitude, kind="stable")
    directions = catalog.directions()[order]
    content = hashlib.sha256(directions.tobytes()).hexdigest()[:12]
    path = folder / f"stars-{_VERSION}-{content}-{degrees:g}.npz"
    found = _table_on_disk(path)
    pairs, angle, stars = found or _close_pairs(directions, np.radians(degrees))
    if found is None:
        data = io.BytesIO()
        np.savez(data, pairs=pairs, angle=angle, stars=np.array(stars))
        # A home that cannot be written costs a second each time, no more.
        with contextlib.suppress(FileError):
            make_folder(path.parent)
            write_atomic(path, data.getvalue(), told=False)
    both = np.stack([pairs, pairs[:, ::-1]], 1).reshape(-1, 2)
    return PairTable(order, directions, both, np.repeat(angle, 2), stars)


_Pairs = tuple[NDArray[np.uint16], NDArray[np.float32], int]


def _close_pairs(directions: NDArray[np.float64], largest: float) -> _Pairs:
    share = (1.0 - np.cos(largest)) / 2.0
    stars = int(min(len(directions), np.sqrt(2.0 * _MOST_PAIRS / share), 2**16 - 1))
    pairs = cKDTree(directions[:stars]).query_pairs(2.0 * np.sin(largest / 2.0), output_type="ndarray")
    chord = np.linalg.norm(directions[pairs[:, 0]] - directions[pairs[:, 1]], axis=1)
    angle = (2.0 * np.arcsin(chord / 2.0)).astype(np.float32)
    order = np.argsort(angle, kind="stable")
    return pairs[order].astype(np.uint16), angle[order], stars


def _table_on_disk(path: Path) -> _Pairs | None:
    """What the file contains; None if it is not there or not whole."""
    try:
        with np.load(io.BytesIO(read_bytes(path)), allow_pickle=False) as table:
            pairs, angle, stars = table["pairs"], table["angle"], int(table["stars"])
    except Exception:  # whatever is wrong with the file, the table can be made anew
        return None
    whole = pairs.ndim == 2 and pairs.shape == (len(angle), 2) and pairs.dtype == np.uint16 and stars > 0
    return (pairs, angle, stars) if whole and (np.diff(angle) >= 0).all() and pairs.max(initial=0) < stars else None


# Name stars without knowing where the camera looks, from the angles between the brightest of them.
#
# Triangles of bright stars propose attitudes, and all other stars test them. How many stars agree by chance follows
# from how many stars the sky has there: an attitude is accepted only where chance explains it less than once in 10⁹
# images.

Floats = NDArray[np.float64]

# Expected number of attitudes that agree as well by chance.
_BY_CHANCE = 1e-9
# More stars of an image are not needed.
_TESTED = 80
# Triangles with a side below this share of the field propose attitudes that are too rough.
_SHORTEST = 0.06
# Stars of the catalog in the field for each star of the image, of which not all are the brightest.
_DEEPER, _LEAST_IN_FIELD = 3.0, 24.0
_MOST_PROPOSALS = 20_000
# Of the reach within which matches are counted: a good attitude is nearer than the reach.
_SHARES = (1.0, 0.5, 0.25)


class Identification(NamedTuple):
    """An attitude on which many stars agree.

    Attributes:
        rotation: (3, 3) camera from the catalog's frame.
        star: (N,) index in the catalog of each star of the image; -1 where it has none.
        by_chance: expected number of attitudes on which as many stars agree by chance.
    """

    rotation: Floats
    star: NDArray[np.int64]
    by_chance: float

    @property
    def matches(self) -> int:
        """How many stars have a name."""
        return int((self.star >= 0).sum())


def identify(
    rays: Floats,
    reach: float,
    *,
    catalog: StarCatalog | None = None,
    scale_error: float = 0.0,
    field: float = 0.0,
    corners: int = 10,
) -> Identification | None:
    """Find which stars of the catalog are seen, and from that where the camera looks; nothing need be known of it.

    Args:
        rays: (N, 3) unit vectors in the camera's frame towards the stars of an image, the brightest first.
        reach: radians by which rays may be wrong, by the lens more than by the marks.
        catalog: the stars; kcal's own if left out.
        scale_error: share by which the focal length may be wrong.
        field: angle in radians between opposite corners of the image; by the stars themselves if left out.
        corners: how many of the brightest stars make triangles; the others only test.

    Returns:
        None where no attitude agrees with more stars than by chance: fewer than five or six stars never do.

    Example:
        >>> stars = StarCatalog.bundled()
        >>> seen = stars.directions()[np.argsort(stars.magnitude)]
        >>> ahead = seen[seen[:, 2] > 0.9][:12]
        >>> found = identify(ahead, 1e-4)
        >>> found.matches, bool(np.allclose(found.rotation, np.eye(3), atol=1e-4))
        (12, True)
    """
    rays = rays[:_TESTED]
    if len(rays) < 4:
        return None
    if not field:
        field = 2.0 * float(np.arccos(np.clip(rays @ _middle(rays), -1, 1)).max())
    table = pair_table(catalog or StarCatalog.bundled(), field)
    area = 2.0 * math.pi * (1.0 - math.cos(min(field, math.pi) / 2.0))
    in_field = max(_DEEPER * len(rays), _LEAST_IN_FIELD)
    pool = int(min(in_field * 4.0 * math.pi / area, len(table.order)))
    tree = cKDTree(table.directions[:pool])
    proposals, best = 0, None
    triples = sorted(itertools.combinations(range(min(corners, len(rays))), 3), key=lambda triple: triple[2])
    for triple in triples:
        at = list(triple)
        stars = _triangles(rays[at], table, min(pool, table.stars), reach, scale_error, _SHORTEST * field)
        if not len(stars):
            continue
        proposals += len(stars)
        found = _best_turn(turn_between(table.directions[stars], rays[at]), rays, tree, reach + scale_error * field / 2)
        if best is None or found[1] > best[1]:
            best = found
            tested = _tested(best[0], rays, tree, table, reach + scale_error * field / 2, area, proposals, pool)
            if tested is not None:
                return tested
        if proposals > _MOST_PROPOSALS:
            break
    return None


def turn_between(first: Floats, second: Floats) -> Floats:
    """(..., 3, 3) rotations R of smallest |second - R first|² for unit vectors (..., N, 3)."""
    return rotation_between(torch.from_numpy(first), torch.from_numpy(second)).numpy()


def _middle(rays: Floats) -> Floats:
    mean = rays.mean(0)
    return mean / np.linalg.norm(mean)


def _angle(first: Floats, second: Floats) -> Floats:
    return 2.0 * np.arcsin(np.clip(np.linalg.norm(first - second, axis=-1) / 2.0, 0.0, 1.0))


def _triangles(
    corners: Floats, table: PairTable, pool: int, reach: float, scale_error: float, shortest: float
) -> NDArray[np.int64]:
    """(C, 3) stars of the table whose triangle has the sides and the sense of three rays."""
    sides = [float(_angle(corners[a], corners[b])) for a, b in ((0, 1), (0, 2), (1, 2))]
    none = np.empty((0, 3), np.int64)
    if min(sides) < shortest or max(sides[:2]) > table.angle[-1]:
        return none
    lists = []
    for side in sides[:2]:
        margin = reach + scale_error * side
        # In the type of the table, all of which would be converted otherwise.
        ends = np.array([side - margin, side + margin], table.angle.dtype)
        low, high = np.searchsorted(table.angle, ends)
        pairs = table.pairs[low:high].astype(np.int64)
        lists.append(pairs[(pairs < pool).all(1)])
    first, second = lists
    second = second[np.argsort(second[:, 0], kind="stable")]
    begin = np.searchsorted(second[:, 0], first[:, 0])
    count = np.searchsorted(second[:, 0], first[:, 0], "right") - begin
    if not count.sum():
        return none
    at = np.repeat(np.arange(len(first)), count)
    partner = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(begin, count)
    stars = np.stack([first[at, 0], first[at, 1], second[partner, 1]], 1)
    third = _angle(table.directions[stars[:, 1]], table.directions[stars[:, 2]])
    stars = stars[np.abs(third - sides[2]) < reach + scale_error * sides[2]]
    return stars[np.linalg.det(table.directions[stars]) * np.linalg.det(corners) > 0]


def _best_turn(rotations: Floats, rays: Floats, tree: cKDTree, reach: float) -> tuple[Floats, int]:
    """The rotation of which most rays meet a star, and how many."""
    there = np.einsum("cji,nj->cni", rotations, rays)
    distance, _ = tree.query(there.reshape(-1, 3), distance_upper_bound=reach)
    hits = np.isfinite(distance).reshape(len(rotations), -1).sum(1)
    return rotations[hits.argmax()], int(hits.max())


def _tested(
    rotation: Floats, rays: Floats, tree: cKDTree, table: PairTable, reach: float, area: float, tried: int, pool: int
) -> Identification | None:
    """The attitude refined by all stars that meet one, if chance does not explain how many do."""
    star = _met(rotation, rays, tree, reach)
    for _ in range(3):
        known = star >= 0
        if known.sum() < 4:
            return None
        rotation = turn_between(table.directions[star[known]], rays[known])
        star = _met(rotation, rays, tree, reach)
    # The share of the field that the stars there cover: those of the Milky Way are denser than elsewhere.
    axis = _middle(rays) @ rotation
    radius = 2.0 * math.asin(min(math.sqrt(area / (4.0 * math.pi)), 1.0))
    near = len(tree.query_ball_point(axis, 2.0 * math.sin(radius / 2.0)))
    density = max(near / area, pool / (4.0 * math.pi))
    distance = _angle(rays, table.directions[np.maximum(star, 0)] @ rotation.T)
    by_chance = min(
        _by_chance((star >= 0) & (distance < share * reach), min(density * math.pi * (share * reach) ** 2, 1.0))
        for share in _SHARES
    )
    by_chance *= tried * len(_SHARES)
    if by_chance > _BY_CHANCE:
        return None
    return Identification(rotation, np.where(star >= 0, table.order[np.maximum(star, 0)], -1), by_chance)


def _by_chance(met: NDArray[np.bool_], chance: float) -> float:
    """How probable it is that chance explains the matches among the brightest stars, at the number that suits it least.

    The brightest stars of an image are in the catalog; of the many faint ones most may be too faint for it.
    """
    sizes = np.arange(4, len(met) + 1)
    # Three matches are those of the triangle.
    matches = np.cumsum(met)[sizes - 1] - 3
    return float((len(sizes) * stats.binom.sf(matches - 1, sizes - 3, chance)).min())


def _met(rotation: Floats, rays: Floats, tree: cKDTree, reach: float) -> NDArray[np.int64]:
    """(N,) the star that each ray meets, each star once (by the nearest ray); -1 for none."""
    distance, star = tree.query(rays @ rotation, distance_upper_bound=reach)
    star = np.where(np.isfinite(distance), star, -1)
    order = np.argsort(distance, kind="stable")
    _, first = np.unique(star[order], return_index=True)
    kept = np.zeros(len(star), bool)
    kept[order[first]] = True
    return np.where(kept, star, -1)
