"""Positions as files: GeoJSON (RFC 7946), CSV, KML and Cursor-on-Target; numbers keep every float64 digit.

Rows are written in chunks, so that a table may be longer than memory.
"""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import BinaryIO, NamedTuple

from kcal.errors import InputError
from kcal.files import open_atomic
from kcal.locate.columns import NUMBERS, TEXTS, PositionColumns, number_lines
from kcal.locate.cot import COT_END, cot_events, cot_start
from kcal.locate.geojson import camera_features, point_features, region_features
from kcal.locate.kml import KML_END, kml_points, kml_regions, kml_start
from kcal.locate.positions import Located
from kcal.locate.stereo import PositionStatus
from kcal.locate.tables import guarded, is_number
from kcal.texts import csv_line

# Rows at once, so that their texts fit the cache.
_AT_ONCE = 1024
# Stands for the standard output.
STREAM = Path("-")
# What, in a column of texts, one a line, might need more than writing it down.
_SPECIAL = re.compile(r"[^\w .:/\n-]|^[^\w.\n]", re.MULTILINE)
# Names of properties and columns that further columns of a table must not have.
_TAKEN = {"kind", *TEXTS, *NUMBERS}
_STATUSES = {int(status): status.name.lower() for status in PositionStatus}


class _Format(NamedTuple):
    """How a file is made: its beginning, a text for each chunk, and its end.

    Attributes:
        start: the beginning; of a table it names the columns.
        rows: of each chunk; the time is that of the whole file.
        later: of each chunk too, but written after all rows.
        end: the end.
    """

    start: Callable[[Located, PositionColumns], bytes]
    rows: Callable[[Located, PositionColumns, datetime], bytes]
    later: Callable[[Located, PositionColumns], bytes] | None = None
    end: bytes = b""


def _json_start(run: Located, columns: PositionColumns) -> bytes:
    return b'{"type":"FeatureCollection","features":[\n' + b",\n".join(camera_features(run))


def _after_others(features: Iterable[bytes]) -> bytes:
    return b",\n".join([b"", *features])


def _json_lines(run: Located, columns: PositionColumns, time: datetime) -> bytes:
    """Each point with its region behind it."""
    regions = region_features(columns, run)
    lines = []
    for feature, there in zip(point_features(columns), columns.located.tolist(), strict=True):
        lines += [feature, next(regions)] if there else [feature]
    return b"".join(line + b"\n" for line in lines)


def _csv_start(run: Located, columns: PositionColumns) -> bytes:
    return csv_line([*TEXTS, *NUMBERS, *columns.extras]).encode()


def _csv_rows(run: Located, columns: PositionColumns, time: datetime) -> bytes:
    statuses = [_STATUSES[code] for code in columns.status.tolist()]
    texts = [_csv_cells(columns.names), statuses, _csv_cells(columns.reasons)]
    cells = [*texts, number_lines(columns.numbers), *map(_csv_cells, columns.extras.values())]
    return "".join([",".join(row) + "\n" for row in zip(*cells, strict=True)]).encode()


def _csv_cells(texts: Iterable[str]) -> list[str]:
    """Texts as cells; numbers stay numbers."""
    texts = list(texts)
    whole = "\n".join(texts)
    if whole.count("\n") == len(texts) - 1 and not _SPECIAL.search(whole):
        return texts
    return [text if is_number(text) else csv_line([guarded(text)])[:-1] for text in texts]


_GEOJSON = _Format(
    _json_start,
    lambda run, columns, time: _after_others(point_features(columns)),
    lambda run, columns: _after_others(region_features(columns, run)),
    b"\n]}\n",
)
_FORMATS = {
    ".geojson": _GEOJSON,
    ".json": _GEOJSON,
    ".csv": _Format(_csv_start, _csv_rows),
    ".kml": _Format(
        lambda run, columns: kml_start(run).encode(),
        lambda run, columns, time: kml_points(columns).encode(),
        lambda run, columns: kml_regions(columns, run).encode(),
        KML_END.encode(),
    ),
    ".cot": _Format(
        lambda run, columns: cot_start().encode(),
        lambda run, columns, time: cot_events(columns, run, time=time).encode(),
        end=COT_END.encode(),
    ),
    ".geojsonl": _Format(lambda run, columns: b"".join(line + b"\n" for line in camera_features(run)), _json_lines),
}


# Rows of these can be appended one after another; a .cot file then lacks the end of its document.
APPENDED = (".geojsonl", ".csv", ".cot")


def check_format(path: str | Path) -> None:
    """Raise `InputError` unless the suffix of `path` is one that `write_positions` knows."""
    if Path(path).suffix.lower() not in _FORMATS:
        raise InputError(f"{path}: unknown format; the file name must end with {', '.join(_FORMATS)}")


def appended(suffix: str, run: Located, columns: PositionColumns, time: datetime, *, first: bool) -> bytes:
    """Some rows of a file that grows, with its beginning before the first of them.

    Args:
        suffix: .geojsonl, .csv or .cot, whose rows stand by themselves.
        run: how the positions were located.
        columns: the rows.
        time: of the rows.
        first: whether the file is empty so far.

    Raises:
        InputError: another suffix.
    """
    if suffix not in APPENDED:
        raise InputError(f"{suffix}: a file that grows needs one of {', '.join(APPENDED)}")
    made = _FORMATS[suffix]
    start = made.start(run, columns) if first else b""
    if suffix == ".geojsonl":
        # Without the regions, which are most of a file: a stream never ends.
        return start + b"".join(line + b"\n" for line in point_features(columns))
    return start + made.rows(run, columns, time)


class PositionWriter:
    """Write positions into an open file, chunk by chunk; `close` writes what comes after all rows.

    Regions of GeoJSON and KML wait in a temporary file meanwhile.

    Args:
        file: open for writing bytes.
        suffix: the format: ".csv" and so on.
        run: how the positions were located; its own positions are not written.
    """

    def __init__(self, file: BinaryIO, suffix: str, run: Located) -> None:
        self._file, self._run, self._format = file, run, _FORMATS[suffix.lower()]
        self._later = tempfile.TemporaryFile() if self._format.later is not None else None  # noqa: SIM115
        self._started = False
        self._time = datetime.now(UTC)

    def add(self, columns: PositionColumns) -> None:
        """Write some rows; all chunks must have the same further columns."""
        if not self._started:
            taken = [name for name in columns.extras if name in _TAKEN or name.endswith("_infinite")]
            if taken:
                raise InputError(f"the table has a column {taken[0]!r}, as positions have; give it another name")
            self._file.write(self._format.start(self._run, columns))
            self._started = True
        for piece in columns.pieces(_AT_ONCE):
            self._file.write(self._format.rows(self._run, piece, self._time))
            if self._later is not None and self._format.later is not None:
                self._later.write(self._format.later(self._run, piece))

    def close(self) -> None:
        """Write the end of the file, which stays open."""
        if self._later is not None:
            self._later.seek(0)
            shutil.copyfileobj(self._later, self._file, 1 << 20)
            self._later.close()
        self._file.write(self._format.end)
        self._file.flush()


@contextmanager
def open_writers(paths: Sequence[Path], run: Located, stream_suffix: str = ".csv") -> Iterator[list[PositionWriter]]:
    """Open files for positions, all of them whole or untouched in the end.

    Args:
        paths: of the files; `STREAM` stands for the standard output, which gets rows as soon as they are known.
        run: how the positions are located.
        stream_suffix: the format of `STREAM`.
    """
    with ExitStack() as stack:
        writers = []
        for path in paths:
            streamed = path == STREAM
            file = sys.stdout.buffer if streamed else stack.enter_context(open_atomic(path))
            writers.append(PositionWriter(file, stream_suffix if streamed else path.suffix, run))
        yield writers
        for writer in writers:
            writer.close()


def write_positions(path: str | Path, located: Located) -> Path:
    """Write positions, atomically, in the format of the suffix: .geojson, .json, .geojsonl, .csv, .kml or .cot.

    GeoJSON follows RFC 7946: coordinates are [longitude, latitude, ellipsoidal WGS84 height in meters]. The cameras
    come first (`kind` is "camera"), then one feature for each pair of marks (`kind` is "point"), and last a polygon for
    each position (`kind` is "region"): its 95 % region, a long and slightly skewed ellipse. A pair without a position
    has a null geometry, its status and the reason. `range_high_m` is null where it is infinite, because JSON has no
    infinity; `range_high_infinite` is then true. `.geojsonl` has one feature a line, each region behind its point. In
    CSV unknown fields are empty and an infinite range is `inf`. `.cot` is Cursor-on-Target.

    Raises:
        InputError: another suffix.
        FileError: the file cannot be written; an old one is then untouched.

    Example:
        >>> import torch
        >>> from kcal import Origin, locate_points
        >>> from kcal.rig import planned_rig
        >>> left, right, _ = planned_rig()(torch.tensor([[0.0, 0.0, 1000.0]]))
        >>> located = locate_points(planned_rig(), left, right, origin=Origin(lat=19.07, lon=72.87, height=14.0),
        ...                         heading_deg=0.0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_positions(Path(folder, "positions.csv"), located).read_text().splitlines()[1][:4]
        '1,ok'
    """
    check_format(path)
    with open_atomic(path) as file:
        writer = PositionWriter(file, Path(path).suffix, located)
        writer.add(located.columns)
        writer.close()
    return Path(path)
