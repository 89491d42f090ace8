"""What a rig that was right once still knows of its relative yaw: masts bend with the sun, and creep with time."""

from __future__ import annotations

import math
import re

from kcal.errors import InputError

_PART = re.compile(r"([0-9.]+)\s*([hK])\s*:\s*([0-9.eE+-]+)")


def forgotten_yaw(*, hours: float = 0.0, per_hour: float = 0.0, kelvin: float = 0.0, per_kelvin: float = 0.0) -> float:
    """Standard deviation in degrees of the relative yaw that a rig has lost since it was solved.

    A random walk of `per_hour` degrees after an hour, which grows with the root of time, and a turn of `per_kelvin`
    degrees for each kelvin by which it is warmer or colder. Both must be known of the mast: from nights that were
    solved one after the other, or from `kcal rig check`.

    Raises:
        InputError: a negative number.

    Example:
        >>> forgotten_yaw(hours=9, per_hour=0.0004, kelvin=8, per_kelvin=0.0002)  # 0.0012 and 0.0016 degrees
        0.002
    """
    if min(hours, per_hour, kelvin, per_kelvin) < 0 or not math.isfinite(hours + per_hour + kelvin + per_kelvin):
        raise InputError("what a rig forgets: hours, kelvin and degrees from 0 on are needed")
    return math.hypot(per_hour * math.sqrt(hours), per_kelvin * kelvin)


def parse_aging(text: str | None) -> float:
    """`forgotten_yaw` of a text like 9h:0.0004,8K:0.0002; 0 for none.

    Raises:
        InputError: another text.

    Example:
        >>> parse_aging("9h:0.0004,8K:0.0002"), parse_aging("4h:0.001")
        (0.002, 0.002)
    """
    if text is None:
        return 0.0
    known: dict[str, tuple[float, float]] = {}
    for part in text.split(","):
        found = _PART.fullmatch(part.strip())
        try:
            count, unit, degrees = found.groups()  # type: ignore[union-attr]
            known[unit] = float(count), float(degrees)
        except (AttributeError, ValueError):
            raise InputError(
                f"--aged {text}: write hours and degrees in an hour, kelvin and degrees per kelvin, like "
                "9h:0.0004,8K:0.0002"
            ) from None
    (hours, per_hour), (kelvin, per_kelvin) = known.get("h", (0.0, 0.0)), known.get("K", (0.0, 0.0))
    return forgotten_yaw(hours=hours, per_hour=per_hour, kelvin=kelvin, per_kelvin=per_kelvin)
