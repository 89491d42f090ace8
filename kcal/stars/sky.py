"""The bright stars, and where they are seen from a place on the Earth."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcal.errors import InputError
from kcal.files import read_bytes
from kcal.lens.rig import Origin
from kcal.texts import brief

# The bright stars: positions, proper motions and magnitudes, and names for the brightest.
#
# The catalogue in the package is the Yale Bright Star Catalogue, 5th revised edition (D. Hoffleit and W. H. Warren Jr.,
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
        number: (N,) of the star in its catalogue; Harvard Revised (HR) in the one that kcal brings along.
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
            raise InputError("star catalogue: six arrays of the same shape (N,) are needed")
        if not all(np.isfinite(column).all() for column in columns) or (np.abs(self.dec) > np.pi / 2).any():
            raise InputError("star catalogue: a value is not finite, or a declination is beyond 90 degrees")

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
            raise InputError(f"star catalogue: the year {year:.0f} is outside {FIRST_YEAR:.0f} to {LAST_YEAR:.0f}")
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


def parse_time(text: str) -> datetime.datetime:
    """Read a time with its zone, as UTC.

    Raises:
        InputError: no time, or one without a zone: an hour is 15° of heading.

    Example:
        >>> parse_time("2019-07-29T22:47:26+02:00").isoformat()
        '2019-07-29T20:47:26+00:00'
    """
    try:
        time = datetime.datetime.fromisoformat(text.strip())
    except ValueError:
        raise InputError(f"time {text!r}: write it like 2026-11-24T20:47:26Z") from None
    if time.tzinfo is None:
        raise InputError(
            f"time {text!r} has no zone, and an hour is 15° of heading; end it with Z for UTC, or with +02:00"
        )
    return time.astimezone(datetime.UTC)


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
    # From the axes of the equator of date back to those of the catalogue.
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
        >>> seen = observed_directions(StarCatalog.bundled(), parse_time("2019-07-29T20:47:26Z"), place)
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
        context, _ = erfa.apco13(
            *_julian(erfa, time), dut1, *place, 0.0, 0.0, air.hectopascal, air.celsius, air.humidity, 0.6
        )
        ra, dec = erfa.atciq(*_columns(catalog), 0.0, 0.0, context)
        azimuth, zenith, *_ = erfa.atioq(ra, dec, context)
    # `unit_vectors` counts from the first axis; azimuths count from north, the second.
    return unit_vectors(np.pi / 2 - azimuth, np.pi / 2 - zenith)


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
