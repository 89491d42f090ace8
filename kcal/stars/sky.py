"""Where stars are seen from a place on the Earth: proper motion, aberration, the Earth's rotation and refraction.

All of it is done by pyerfa, offline. What it does not know are UT1 - UTC (below 0.9 s by definition; one second of time
is 15 seconds of arc) and polar motion (0.3 seconds of arc, left out).
"""

from __future__ import annotations

import dataclasses
import datetime
import math
import warnings
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kcal.errors import InputError
from kcal.lens.mounting import Origin
from kcal.stars.catalog import StarCatalog, unit_vectors

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
