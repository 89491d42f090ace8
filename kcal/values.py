"""Values as people type them: a length with its unit, value ± σ, a size, a place, a time, RANGE:ERROR, and lists.

Each function takes the text and what it is called where it was typed, `--size` on the command line or `size` in
`kcal.toml`, and raises an `InputError` that says what to write.
"""

from __future__ import annotations

import datetime
import math
import re
from typing import NamedTuple
from urllib.parse import SplitResult, urlsplit

from kcal.errors import InputError

_METERS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254, "km": 1e3}


class WithSigma(NamedTuple):
    """A number and its standard deviation; None where that was not stated.

    Example:
        >>> str(WithSigma(0.13, 0.1)), str(WithSigma(35.0))
        ('0.13±0.1', '35')
    """

    value: float
    sigma: float | None = None

    def __str__(self) -> str:
        return f"{self.value:.15g}" if self.sigma is None else f"{self.value:.15g}±{self.sigma:.15g}"


def with_sigma(text: str, name: str) -> WithSigma:
    """A number, with its standard deviation if that is known; `+-` may be typed for `±`.

    Raises:
        InputError: no number, or a standard deviation that is negative.

    Example:
        >>> with_sigma("10.02+-0.005", "--baseline")
        WithSigma(value=10.02, sigma=0.005)
    """
    parts = text.replace("+-", "±").split("±")
    values = [_number_or_nan(part) for part in parts]
    unread = any(value != value and part.strip().lower() != "nan" for value, part in zip(values, parts, strict=True))
    if len(values) > 2 or unread or not all(0 <= sigma < math.inf for sigma in values[1:]):
        raise InputError(f"{name} {text!r}: write VALUE±SIGMA, for example 12±3, or the value alone")
    return WithSigma(*values)


def share(text: str, name: str) -> float:
    """A number from 0 to 1.

    Example:
        >>> share("0.5", "--alpha")
        0.5
    """
    value = _number_or_nan(text)
    if not 0 <= value <= 1:
        raise InputError(f"{name} {text}: a number from 0 to 1 is needed")
    return value


def number_list(text: str, name: str, count: int | None = None, form: str = "250,1000,5000") -> tuple[float, ...]:
    """Numbers with commas between them.

    Args:
        text: as typed.
        name: what it is called.
        count: how many are needed; None: one or more.
        form: what to write, for the message.

    Raises:
        InputError: others.
    """
    try:
        values = tuple(map(float, text.split(",")))
    except ValueError:
        values = ()
    if not values or count not in (None, len(values)):
        raise InputError(f"{name} {text!r}: write {form}")
    return values


def length(text: str, name: str) -> float:
    """A positive length with its unit, in meters.

    Raises:
        InputError: no positive number with a unit.

    Example:
        >>> length("2.5cm", "--square")
        0.025
    """
    return _length(text, name, unit="")


def distance(text: str, name: str) -> float:
    """A distance in meters, with or without its unit; `inf` is infinitely far away.

    Example:
        >>> distance("5km", "--distance"), distance("800", "--distance")
        (5000.0, 800.0)
    """
    return math.inf if text.strip() in ("inf", "infinity") else _length(text, name, unit="m")


def _length(text: str, name: str, unit: str) -> float:
    found = re.fullmatch(r"\s*([0-9.]+(?:[eE][-+]?\d+)?)\s*([a-z]*)\s*", text)
    value = _number_or_nan(found.group(1)) if found else math.nan
    scale = _METERS.get(found.group(2) or unit) if found else None
    if scale is None or not 0 < value < math.inf:
        form = "a length with its unit (mm, cm, m, in), for example 25mm"
        raise InputError(
            f"{name} {text!r}: write {'meters, or a length with its unit, for example 5km' if unit else form}"
        )
    # Division by the exact inverse keeps 25 mm at 0.025 to the last bit.
    return value / round(1 / scale) if scale in (1e-3, 1e-2) else value * scale


def size(text: str, name: str) -> tuple[int, int]:
    """Width and height of an image, pixels.

    Example:
        >>> size("1920x1080", "--size")
        (1920, 1080)
    """
    width, _, height = text.lower().partition("x")
    if not (width.isdigit() and height.isdigit()) or not (int(width) and int(height)):
        raise InputError(f"{name} {text}: write WIDTHxHEIGHT in pixels, for example 1920x1080")
    return int(width), int(height)


def place_on_earth(text: str, name: str) -> tuple[float, float, float, float | None]:
    """Latitude and longitude in degrees, height above the WGS84 ellipsoid in meters, and σ of each axis if stated.

    Example:
        >>> place_on_earth("19.07,72.87,14±0.5", "--site")
        (19.07, 72.87, 14.0, 0.5)
    """
    form = "three numbers LAT,LON,HEIGHT, for example 19.07,72.87,14"
    where, mark, sigma = text.replace("+-", "±").partition("±")
    lat, lon, height = number_list(where, name, 3, form)
    if mark and not 0 <= _number_or_nan(sigma) < math.inf:
        raise InputError(f"{name} {text!r}: write {form}±0.5 with the standard deviation along each axis, meters")
    return lat, lon, height, _number_or_nan(sigma) if mark else None


def instant(text: str, name: str) -> datetime.datetime:
    """A time with its zone, as UTC.

    Raises:
        InputError: no time, or one without a zone: an hour is 15° of heading.

    Example:
        >>> instant("2019-07-29T22:47:26+02:00", "--time").isoformat()
        '2019-07-29T20:47:26+00:00'
    """
    try:
        time = datetime.datetime.fromisoformat(text.strip())
    except ValueError:
        raise InputError(f"{name} {text!r}: write it like 2026-05-01T12:00:00Z") from None
    if time.tzinfo is None:
        raise InputError(f"{name} {text!r} has no zone: end it with Z for UTC, or with +02:00")
    return time.astimezone(datetime.UTC)


def ranges_and_errors(text: str, name: str) -> tuple[tuple[float, float], ...]:
    """Ranges and an error of each, meters, of `RANGE:SHARE%` or `RANGE:METERS`, several with commas.

    Example:
        >>> ranges_and_errors("5km:10%, 800m:20m", "--require")
        ((5000.0, 500.0), (800.0, 20.0))
    """
    found = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*([0-9.]+)\s*(km|m)\s*:\s*([0-9.]+)\s*(%|km|m)\s*", part)
        far, allowed = (_number_or_nan(match.group(i)) for i in (1, 3)) if match else (math.nan, math.nan)
        if match is None or not (0 < far < math.inf and 0 < allowed < math.inf):
            raise InputError(
                f"{name} {part.strip()!r}: write RANGE:ERROR, for example 5km:10% or 800m:20m, several with commas"
            )
        far *= _METERS[match.group(2)]
        found.append((far, allowed * (0.01 * far if match.group(4) == "%" else _METERS[match.group(4)])))
    return tuple(found)


def named(text: str, name: str, form: str) -> tuple[str, str]:
    """`NAME=VALUE` as both.

    Example:
        >>> named("fx = 1600", "--fix", "NAME=VALUE")
        ('fx', '1600')
    """
    key, equals, value = (part.strip() for part in text.partition("="))
    if not (key and equals and value):
        raise InputError(f"{name} {text!r}: write {form}")
    return key, value


def _number_or_nan(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def split_address(text: str) -> SplitResult:
    """The parts of SCHEME://HOST:PORT/PATH; all of them empty if the port or the host in brackets cannot be.

    Example:
        >>> split_address("udp://127.0.0.1:18999").port, split_address("udp://[::1:5").hostname
        (18999, None)
    """
    try:
        parts = urlsplit(text)
        # Reading a port that is no number or beyond 65535 raises ValueError.
        return parts if parts.port != 0 else urlsplit("")
    except ValueError:
        return urlsplit("")
