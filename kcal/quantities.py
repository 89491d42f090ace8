"""The one way in which numbers become texts: two digits of their standard deviation, in a unit that fits the range.

Reports, pictures, tables and maps use these functions. Files for programs keep every digit, in meters.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

# With more decimals, and below this power of ten, a number is written with an exponent.
_MOST_DECIMALS, _LEAST_POWER = 5, -4


class Unit(NamedTuple):
    """A unit of length.

    Attributes:
        name: as it is written.
        meters: its length.
    """

    name: str
    meters: float

    def number(self, meters: float, sigma: float | None = None, *, digits: int = 3, sign: bool = False) -> str:
        """A length in this unit, without its name; arguments as in `number_text`."""
        return number_text(
            meters / self.meters, None if sigma is None else sigma / self.meters, digits=digits, sign=sign
        )


MM, M, KM = Unit("mm", 1e-3), Unit("m", 1.0), Unit("km", 1e3)


def length_unit(lengths: Iterable[float | None]) -> Unit:
    """The unit for lengths that stand together: mm on a bench, m on a site, km at sea.

    Args:
        lengths: meters; the largest that is finite decides.

    Example:
        >>> length_unit([0.28, 0.43]).name, length_unit([120.0, 5000.0]).name, length_unit([800.0, 21e3]).name
        ('mm', 'm', 'km')
    """
    largest = max((abs(one) for one in lengths if one is not None and math.isfinite(one)), default=1.0)
    return MM if largest < 1.0 else M if largest < 1e4 else KM


def number_text(value: float, sigma: float | None = None, *, digits: int = 3, sign: bool = False) -> str:
    """A number, rounded to two digits of its standard deviation.

    Args:
        value: the number.
        sigma: its standard deviation; where that is not known or 0, the number has `digits` digits.
        digits: see there.
        sign: write a plus too.

    Example:
        >>> number_text(83.21683, 0.0217), number_text(1983.4, 586.0), number_text(0.0217, 0.0217), number_text(2 / 3)
        ('83.217', '1980', '0.022', '0.667')
        >>> number_text(-2.1e-8, 3.4e-7), number_text(float("inf"))
        ('-2e-08', '∞')
    """
    if not math.isfinite(value):
        return "–" if math.isnan(value) else "∞" if value > 0 else "-∞"
    known = sigma is not None and 0.0 < sigma < math.inf
    if not known and value == 0.0:
        return "0"
    places = _decimals(sigma, 2) if known and sigma is not None else _decimals(value, digits)
    plus = "+" if sign else ""
    first = math.floor(math.log10(abs(value))) if value else 0
    if places > _MOST_DECIMALS and first < _LEAST_POWER:
        return f"{value:{plus}.{max(first + places, 0)}e}"
    return f"{round(value, places):{plus}z.{max(places, 0)}f}"


def _decimals(value: float, digits: int) -> int:
    """Decimals that show so many digits of a number; negative where these end before the point."""
    first = math.floor(math.log10(abs(value)))
    places = digits - 1 - first
    # 0.0996 is 0.10, not 0.100.
    return places - 1 if round(abs(value), places) >= 10.0 ** (first + 1) else places


def measured_text(value: float, sigma: float | None, unit: str = "", *, sign: bool = False) -> str:
    """A number with its standard deviation, and a unit.

    Example:
        >>> measured_text(533.6391, 0.6764, "px"), measured_text(1.1, None, "mm"), measured_text(10.0, 0.0)
        ('533.64 ± 0.68 px', '1.10 mm', '10.0 ± 0')
    """
    known = sigma is not None and math.isfinite(sigma)
    spread = f" ± {number_text(sigma, sigma)}" if known and sigma is not None else ""
    return f"{number_text(value, sigma, sign=sign)}{spread} {unit}".rstrip()


def length_text(
    meters: float, sigma: float | None = None, *, unit: Unit | None = None, digits: int = 3, sign: bool = False
) -> str:
    """A length, rounded to two digits of its standard deviation, with its unit.

    Args:
        meters: the length.
        sigma: its standard deviation, meters.
        unit: the one that fits the length, if not given.
        digits: of a length without a standard deviation.
        sign: write a plus too.

    Example:
        >>> length_text(0.4012, 0.0004), length_text(812.37, 4.1), length_text(0.0217, digits=2), length_text(21000.0)
        ('401.20 mm', '812.4 m', '22 mm', '21.0 km')
    """
    unit = unit or length_unit([meters])
    number = unit.number(meters, sigma, digits=digits, sign=sign)
    return number if number in ("0", "∞", "-∞", "–") else f"{number} {unit.name}"


def measured_length(meters: float, sigma: float | None) -> str:
    """A length with its standard deviation and its unit.

    Example:
        >>> measured_length(0.083217, 2.2e-5), measured_length(10.02131, 0.0012)
        ('83.217 ± 0.022 mm', '10.0213 ± 0.0012 m')
    """
    unit = length_unit([meters])
    return measured_text(meters / unit.meters, None if sigma is None else sigma / unit.meters, unit.name)


def range_text(meters: float) -> str:
    """A length that is exact, such as a requirement or a ring of a map, with its unit: 250 m, 5 km.

    Example:
        >>> range_text(0.25), range_text(250.0), range_text(5000.0)
        ('250 mm', '250 m', '5 km')
    """
    unit = MM if meters < 1.0 else M if meters < 1e3 else KM
    return f"{meters / unit.meters:g} {unit.name}"


def setting_text(values: Mapping[str, float]) -> str:
    """Where zoom and focus stand: names with their numbers, as precise as anyone states them.

    Example:
        >>> setting_text({"zoom": 12.5, "focus": 100000.5})
        'zoom=12.5 focus=100000.5'
    """
    return " ".join(f"{name}={value:.12g}" for name, value in values.items())
