"""Positions as Cursor-on-Target events, the XML of ATAK, WinTAK and their kin."""

from __future__ import annotations

import datetime
import hashlib
import math
import xml.etree.ElementTree as ET

from kcal.errors import InputError
from kcal.locate.positions import Located, Position

# What Cursor-on-Target writes for a number that is not known.
_UNKNOWN = "9999999.0"
# Unknown affiliation, on the ground: kcal says where, not what.
_TYPE = "a-u-G"
# Machine-generated, estimated.
_HOW = "m-g"


def to_cot(located: Located, *, time: datetime.datetime | None = None, stale_s: float = 300.0) -> str:
    """One event for each position, in an `events` element; send them one by one.

    `hae` is the ellipsoidal height. `ce` is the radius of the horizontal circle that contains the true position with
    95 %, `le` half the vertical 95 % interval, both in meters; the format's definition names no probability, so that
    the remark in each event states it. Pairs without a position are left out.

    Args:
        located: from `kcal.locate_points`.
        time: of the marks, with its time zone; now if left out.
        stale_s: seconds for which an event counts.

    Raises:
        InputError: a time without a time zone, or a `stale_s` that is not positive.
    """
    moment = datetime.datetime.now(datetime.UTC) if time is None else time
    if moment.tzinfo is None:
        raise InputError("time: a time zone is needed; write for example datetime.now(datetime.UTC)")
    if not 0 < stale_s < math.inf:
        raise InputError(f"stale_s {stale_s}: a positive number of seconds is needed")
    moment = moment.astimezone(datetime.UTC)
    root = ET.Element("events")
    for position in located.positions:
        if position.lat is not None and position.lon is not None:
            _event(root, located, position, moment, moment + datetime.timedelta(seconds=stale_s))
    ET.indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + ET.tostring(root, encoding="unicode") + "\n"


def _event(
    root: ET.Element, located: Located, position: Position, start: datetime.datetime, stale: datetime.datetime
) -> None:
    origin = located.origin
    identity = hashlib.sha256(f"{origin.lat!r} {origin.lon!r} {position.name}".encode()).hexdigest()[:16]
    event = ET.SubElement(
        root, "event", version="2.0", uid=f"kcal-{identity}", type=_TYPE, how=_HOW,
        time=_stamp(start), start=_stamp(start), stale=_stamp(stale),
    )  # fmt: skip
    vertical = None if position.covariance is None else 1.96 * math.sqrt(max(position.covariance[2][2], 0.0))
    ET.SubElement(
        event, "point", lat=repr(position.lat), lon=repr(position.lon), hae=_meters_text(position.height),
        ce=_meters_text(position.cep95_m), le=_meters_text(vertical),
    )  # fmt: skip
    detail = ET.SubElement(event, "detail")
    name = "".join(c for c in position.name if c >= " ")
    ET.SubElement(detail, "contact", callsign=name)
    remark = f"kcal: ce and le contain 95 %; {located.interval_note}"
    ET.SubElement(detail, "remarks").text = f"{remark}. {position.reason}" if position.reason else remark


def _meters_text(value: float | None) -> str:
    return _UNKNOWN if value is None or not math.isfinite(value) else f"{value:.3f}"


def _stamp(moment: datetime.datetime) -> str:
    return moment.strftime("%Y-%m-%dT%H:%M:%S.") + f"{moment.microsecond // 1000:03d}Z"
