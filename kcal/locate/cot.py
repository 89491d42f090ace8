"""Positions as Cursor-on-Target events, the XML of ATAK, WinTAK and their kin."""

from __future__ import annotations

import datetime
import hashlib
import math
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from kcal.errors import InputError
from kcal.locate.columns import PositionColumns
from kcal.locate.positions import Located
from kcal.texts import one_line

COT_END = "</events>\n"
# What Cursor-on-Target writes for a number that is not known.
_UNKNOWN = "9999999.0"
# Unknown affiliation, on the ground: kcal says where, not what.
_TYPE = "a-u-G"
# Machine-generated, estimated.
_HOW = "m-g"


def cot_start() -> str:
    """The beginning of the document."""
    return '<?xml version="1.0" encoding="UTF-8"?>\n<events>\n'


def cot_events(
    columns: PositionColumns, run: Located, *, time: datetime.datetime | None = None, stale_s: float = 300.0
) -> str:
    """An event for each row that has a position.

    `hae` is the ellipsoidal height. `ce` is the radius of the horizontal circle that contains the true position with
    95 %, `le` half the vertical 95 % interval, both in meters; the format's definition names no probability, so that
    the remark in each event states it. Pairs without a position are left out.

    Args:
        columns: the rows.
        run: how they were located.
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
    start, stale = _stamp(moment), _stamp(moment + datetime.timedelta(seconds=stale_s))
    station = f"{run.origin.lat!r} {run.origin.lon!r}"
    remark = escape(f"kcal: ce and le contain 95 %; {run.interval_note}")
    found = columns.rows(np.flatnonzero(columns.located))
    vertical = 1.96 * np.sqrt(np.maximum(found.column("cov_uu_m2"), 0.0))
    errors = zip(found.column("cep95_m").tolist(), vertical.tolist(), strict=True)
    events = []
    for name, reason, (lat, lon, height, *_), (circle, up) in zip(
        found.names, found.reasons, found.numbers.tolist(), errors, strict=True
    ):
        identity = hashlib.sha256(f"{station} {name}".encode()).hexdigest()[:16]
        more = f". {escape(reason)}" if reason else ""
        events.append(
            f' <event version="2.0" uid="kcal-{identity}" type="{_TYPE}" how="{_HOW}" time="{start}" start="{start}" '
            f'stale="{stale}">\n  <point lat="{lat!r}" lon="{lon!r}" hae="{_meters_text(height)}" '
            f'ce="{_meters_text(circle)}" le="{_meters_text(up)}" />\n  <detail>\n'
            f"   <contact callsign={quoteattr(one_line(name))} />\n   <remarks>{remark}{more}</remarks>\n"
            "  </detail>\n </event>\n"
        )
    return "".join(events)


def _meters_text(value: float) -> str:
    return f"{value:.3f}" if math.isfinite(value) else _UNKNOWN


def _stamp(moment: datetime.datetime) -> str:
    return moment.strftime("%Y-%m-%dT%H:%M:%S.") + f"{moment.microsecond // 1000:03d}Z"
