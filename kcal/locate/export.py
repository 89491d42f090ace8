"""Write positions: KML, GeoJSON, Cursor on Target, CSV, GeoParquet, GeoPackage."""

from __future__ import annotations

import hashlib
import math
import re
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple
from xml.sax.saxutils import escape, quoteattr

import numpy as np
import orjson
import torch

from kcal.errors import FileError, InputError, with_extra
from kcal.files import open_atomic
from kcal.locate.geodesy import geodetic_to_enu
from kcal.locate.points import PointLocator
from kcal.locate.positions import (
    CORNER_DECIMALS,
    NOWHERE,
    OWN_FRAME,
    REGION_SHARE,
    STATUS_NAMES,
    Located,
    cut_at_antimeridian,
    position_table,
    ring_blocks,
)
from kcal.locate.tables import NUMBERS, TEXTS, PositionColumns, guarded, header_of, is_number, number_lines, read_chunks
from kcal.texts import csv_line, one_line, visible

# Positions as KML 2.2 (OGC 07-147r2), for Google Earth and every GIS: points, 95 % regions, cameras.
#
# KML counts absolute altitudes from the EGM96 geoid. With a geoid grid, positions are written with `altitudeMode`
# absolute and their height above that geoid; without one they are `clampToGround`, because an ellipsoidal height taken
# for a height above the sea would be wrong by up to 100 m. Regions lie on the ground.

KML_END = " </Document>\n</kml>\n"
_STYLES = """  <Style id="camera">
   <IconStyle><color>ffb06c2b</color></IconStyle>
  </Style>
  <Style id="point">
   <IconStyle><color>ff6b2ac0</color></IconStyle>
  </Style>
  <Style id="region">
   <LineStyle><color>ff271811</color></LineStyle>
   <PolyStyle><color>33271811</color></PolyStyle>
  </Style>
"""


def kml_start(run: Located) -> str:
    """The beginning of the document: styles and cameras."""
    note = f"Regions: {run.interval_note}. Geoid: {run.geoid or 'none'}."
    cameras = "".join(
        _point(f"{camera.name} camera", "camera", f"{camera.geodetic[1]!r},{camera.geodetic[0]!r}", False, "")
        for camera in run.cameras
    )
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2">\n <Document>\n'
        f"  <name>kcal positions</name>\n  <description>{_xml(note)}</description>\n{_STYLES}{cameras}"
    )


def kml_points(columns: PositionColumns) -> str:
    """A placemark for each row that has a position."""
    found = columns.rows(np.flatnonzero(columns.located))
    height, geoid = found.column("height_ellipsoidal_m"), found.column("geoid_height_m")
    places = number_lines(np.stack([found.column("lon"), found.column("lat"), height - geoid], -1))
    ranges = np.stack([found.column(name) for name in ("range_m", "range_low_m", "range_high_m")], -1)
    placemarks = []
    points = zip(found.names, found.reasons, places, ranges.tolist(), strict=True)
    for name, reason, place, (distance, low, high) in points:
        text = f"range {distance:.1f} m, 95 %: {low:.1f} to {high:.1f} m"
        known = not place.endswith(",")
        text = f"{text}. {reason}" if reason else text
        placemarks.append(_point(name, "point", place.removesuffix(","), known, text))
    return "".join(placemarks)


def kml_regions(columns: PositionColumns, run: Located) -> str:
    """A polygon for each row that has a position."""
    names = [columns.names[i] for i in np.flatnonzero(columns.located).tolist()]
    placemarks = []
    for name, ring in zip(names, (ring for block in ring_blocks(columns, run) for ring in block), strict=True):
        corners = np.stack([(ring[:, 1] + 180.0) % 360.0 - 180.0, ring[:, 0]], -1)
        places = number_lines(corners.round(CORNER_DECIMALS))
        placemarks.append(
            f"  <Placemark>\n   <name>{_xml(name)}, 95 %</name>\n   <styleUrl>#region</styleUrl>\n   <Polygon>\n"
            f"    <outerBoundaryIs><LinearRing><coordinates>{' '.join(places)}</coordinates></LinearRing>"
            "</outerBoundaryIs>\n   </Polygon>\n  </Placemark>\n"
        )
    return "".join(placemarks)


def _point(name: str, style: str, place: str, absolute: bool, description: str) -> str:
    about = f"   <description>{_xml(description)}</description>\n" if description else ""
    mode = "absolute" if absolute else "clampToGround"
    return (
        f"  <Placemark>\n   <name>{_xml(name)}</name>\n{about}   <styleUrl>#{style}</styleUrl>\n"
        f"   <Point>\n    <altitudeMode>{mode}</altitudeMode>\n    <coordinates>{place}</coordinates>\n   </Point>\n"
        "  </Placemark>\n"
    )


def _xml(text: str) -> str:
    return escape(visible(text))


# Positions as GeoJSON (RFC 7946): one file, or one feature a line.

# What JSON calls a number; "007" is none, and stays a text.
_JSON_NUMBER = re.compile(r"-?(0|[1-9][0-9]*)(\.[0-9]+)?([eE][+-]?[0-9]+)?")
# Whole numbers beyond this lose digits in programs that read every number as a float64.
_LARGEST_WHOLE = 2**53
_POLYGON = (b'{"type":"Feature","geometry":{"type":"Polygon","coordinates":[', b']},"properties":')
_PROPERTIES = ("kind", *TEXTS, *NUMBERS)
_HEIGHT = NUMBERS.index("height_ellipsoidal_m")


def camera_features(run: Located) -> list[bytes]:
    """A feature for each camera; the left one says what holds for all positions."""
    features = []
    for camera in run.cameras:
        properties: dict[str, Any] = {"name": f"{camera.name} camera", "kind": "camera"}
        if camera.name == "left":
            properties |= {name: getattr(run, name) for name in ("heading_deg", "pitch_deg", "roll_deg", "pixel_sigma")}
            properties |= {"range_interval": run.interval_note, "geoid": run.geoid}
        lat, lon, height = camera.geodetic
        features.append(_feature({"type": "Point", "coordinates": [lon, lat, height]}, properties))
    return features


def point_features(columns: PositionColumns) -> Iterator[bytes]:
    """A feature for each pair of marks; its geometry is null where there is no position."""
    infinite = set(np.flatnonzero(np.isinf(columns.numbers).any(1)).tolist())
    extras = [(column, list(map(_json_value, cells))) for column, cells in columns.extras.items()]
    rows = zip(columns.names, columns.status.tolist(), columns.reasons, columns.numbers.tolist(), strict=True)
    for place, (name, status, reason, numbers) in enumerate(rows):
        lat, lon, height = numbers[0], numbers[1], numbers[_HEIGHT]
        # JSON has neither NaN nor infinity: both become null.
        values = ("point", name, STATUS_NAMES[status], reason, *numbers)
        properties: dict[str, Any] = dict(zip(_PROPERTIES, values, strict=True))
        if place in infinite:
            properties |= {
                f"{column.removesuffix('_m')}_infinite": True
                for column, value in zip(NUMBERS, numbers, strict=True)
                if value == float("inf")
            }
        if extras:
            properties.update((column, cells[place]) for column, cells in extras)
        yield _feature({"type": "Point", "coordinates": [lon, lat, height]} if lat == lat else None, properties)


def region_features(columns: PositionColumns, run: Located) -> Iterator[bytes]:
    """A polygon for each position: its 95 % region, a long and slightly skewed ellipse."""
    names = iter([columns.names[place] for place in np.flatnonzero(columns.located).tolist()])
    for block in ring_blocks(columns, run):
        corners = np.ascontiguousarray(block[..., ::-1]).round(CORNER_DECIMALS)
        beyond = (np.abs(block[..., 1]).max(-1) > 180.0).tolist()
        # Section 3.1.6: closed, counterclockwise; section 3.1.9: a polygon across the antimeridian is cut in two.
        for lon_lat, cut, ring in zip(corners, beyond, block, strict=True):
            properties = {"kind": "region", "name": next(names), "share": REGION_SHARE}
            if cut:
                yield _feature(_cut(ring.tolist()), properties)
            else:
                # Most of the file: copied once.
                text = orjson.dumps(lon_lat, option=orjson.OPT_SERIALIZE_NUMPY)
                yield b"".join([_POLYGON[0], text, _POLYGON[1], orjson.dumps(properties), b"}"])


def _cut(ring: list[tuple[float, float]]) -> dict[str, Any]:
    parts = [[[lon, lat] for lat, lon in part] for part in cut_at_antimeridian(ring)]
    if len(parts) == 1:
        return {"type": "Polygon", "coordinates": parts}
    return {"type": "MultiPolygon", "coordinates": [[part] for part in parts]}


def _feature(geometry: dict[str, Any] | None, properties: dict[str, Any]) -> bytes:
    return orjson.dumps({"type": "Feature", "geometry": geometry, "properties": properties})


def _json_value(cell: str) -> object:
    """The cell of a further column: a number with all its digits where it is one, null where it is empty."""
    if not cell:
        return None
    number = _JSON_NUMBER.fullmatch(cell)
    if number and not (number[2] or number[3]):
        # Python refuses to read whole numbers of thousands of digits.
        exact = len(cell) <= len(str(-_LARGEST_WHOLE)) and abs(int(cell)) <= _LARGEST_WHOLE
    else:
        # One beyond float64 is none for programs that read it.
        exact = number is not None and math.isfinite(float(cell))
    return orjson.Fragment(cell) if exact else cell


# Positions as Cursor-on-Target events, the XML of ATAK, WinTAK and their kin.

COT_START, COT_END = '<?xml version="1.0" encoding="UTF-8"?>\n<events>\n', "</events>\n"
# What Cursor-on-Target writes for a number that is not known.
_UNKNOWN = "9999999.0"
# Unknown affiliation, on the ground: kcal says where, not what.
_TYPE = "a-u-G"
# Machine-generated, estimated.
_HOW = "m-g"


def cot_events(columns: PositionColumns, run: Located, *, time: datetime | None = None, stale_s: float = 300.0) -> str:
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
    moment = datetime.now(UTC) if time is None else time
    if moment.tzinfo is None:
        raise InputError("time: a time zone is needed; write for example datetime.now(datetime.UTC)")
    if not 0 < stale_s < math.inf:
        raise InputError(f"stale_s {stale_s}: a positive number of seconds is needed")
    moment = moment.astimezone(UTC)
    start, stale = _stamp(moment), _stamp(moment + timedelta(seconds=stale_s))
    station = f"{run.place.lat!r} {run.place.lon!r}"
    remark = escape(f"kcal: ce and le contain 95 %; {run.interval_note}")
    found = columns.rows(np.flatnonzero(columns.located))
    vertical = 1.96 * np.sqrt(np.maximum(found.column("cov_uu_m2"), 0.0))
    errors = zip(found.column("cep95_m").tolist(), vertical.tolist(), strict=True)
    events = []
    points = zip(found.names, found.reasons, found.numbers.tolist(), errors, strict=True)
    for name, reason, (lat, lon, height, *_), (circle, up) in points:
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


def _stamp(moment: datetime) -> str:
    return moment.strftime("%Y-%m-%dT%H:%M:%S.") + f"{moment.microsecond // 1000:03d}Z"


# Positions as files: GeoJSON (RFC 7946), CSV, KML and Cursor-on-Target; numbers keep every float64 digit.
#
# Rows are written in chunks, so that a table may be longer than memory.

# Rows at once, so that their texts fit the cache.
_AT_ONCE = 1024
# Stands for the standard output.
STREAM = Path("-")
# What, in a column of texts, one a line, might need more than writing it down.
_SPECIAL = re.compile(r"[^\w .:/\n-]|^[^\w.\n]", re.MULTILINE)
# Names of properties and columns that further columns of a table must not have.
_TAKEN = {"kind", *TEXTS, *NUMBERS}


class _Format(NamedTuple):
    """How a file is made: its beginning, a text for each chunk, and its end; nothing where another library writes it.

    Attributes:
        start: the beginning; of a table it names the columns.
        rows: of each chunk; the time is that of the whole file.
        later: of each chunk too, but written after all rows.
        end: the end.
    """

    start: Callable[[Located, PositionColumns], bytes] = lambda run, columns: b""
    rows: Callable[[Located, PositionColumns, datetime], bytes] = lambda run, columns, time: b""
    later: Callable[[Located, PositionColumns], bytes] | None = None
    end: bytes = b""


def _after_others(features: Iterable[bytes]) -> bytes:
    return b",\n".join([b"", *features])


def _json_lines(run: Located, columns: PositionColumns, time: datetime) -> bytes:
    """Each point with its region behind it."""
    regions = region_features(columns, run)
    lines = []
    for feature, there in zip(point_features(columns), columns.located.tolist(), strict=True):
        lines += [feature, next(regions)] if there else [feature]
    return b"".join(line + b"\n" for line in lines)


_OWN_COLUMNS = [NUMBERS.index(name) for name in OWN_FRAME]


def _csv_start(run: Located, columns: PositionColumns) -> bytes:
    numbers = NUMBERS if run.origin else ("frame", *OWN_FRAME.values())
    return csv_line([*TEXTS, *numbers, *columns.extras]).encode()


def _csv_rows(run: Located, columns: PositionColumns, time: datetime) -> bytes:
    statuses = [STATUS_NAMES[code] for code in columns.status.tolist()]
    texts = [_csv_cells(columns.names), statuses, _csv_cells(columns.reasons)]
    numbers = columns.numbers
    if run.origin is None:
        texts.append(_csv_cells([run.frame] * len(statuses)))
        numbers = np.ascontiguousarray(numbers[:, _OWN_COLUMNS])
    cells = [*texts, number_lines(numbers), *map(_csv_cells, columns.extras.values())]
    return "".join([",".join(row) + "\n" for row in zip(*cells, strict=True)]).encode()


def _csv_cells(texts: Iterable[str]) -> list[str]:
    """Texts as cells; numbers stay numbers."""
    texts = list(texts)
    whole = "\n".join(texts)
    if whole.count("\n") == len(texts) - 1 and not _SPECIAL.search(whole):
        return texts
    return [text if is_number(text) else csv_line([guarded(text)])[:-1] for text in texts]


_GEOJSON = _Format(
    lambda run, columns: b'{"type":"FeatureCollection","features":[\n' + b",\n".join(camera_features(run)),
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
        lambda run, columns: COT_START.encode(),
        lambda run, columns, time: cot_events(columns, run, time=time).encode(),
        end=COT_END.encode(),
    ),
    ".geojsonl": _Format(lambda run, columns: b"".join(line + b"\n" for line in camera_features(run)), _json_lines),
}


class _Parquet:
    """Rows of a GeoParquet file, a group of rows for each part."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._writer: Any = None

    def add(self, run: Located, columns: PositionColumns) -> None:
        table = position_table(columns, run)  # it says what to install
        from pyarrow.parquet import ParquetWriter

        self._writer = self._writer or ParquetWriter(self._file, table.schema)
        self._writer.write_table(table)

    def close(self) -> None:
        if self._writer is not None:
            self._writer.close()


class _GeoPackage:
    """Two layers of a GeoPackage: `positions`, points with all columns, and `regions`, their 95 % regions."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._folder = file, tempfile.TemporaryDirectory()
        self._path, self._begun = Path(self._folder.name, "positions.gpkg"), False

    def add(self, run: Located, columns: PositionColumns) -> None:
        with with_extra("tables", "GeoPackage files need"):
            from pyogrio.raw import write_arrow

        table = position_table(columns, run)
        there = table.filter(table["region"].is_valid())
        for layer, rows, geometry, kind in (
            ("positions", table.drop_columns("region"), "geometry", "Point Z"),
            ("regions", there.select(["name", "region"]), "region", "MultiPolygon"),
        ):
            write_arrow(
                rows, self._path, layer=layer, driver="GPKG", geometry_name=geometry, geometry_type=kind,
                crs="EPSG:4326", append=self._begun,
            )  # fmt: skip
        self._begun = True

    def close(self) -> None:
        if self._begun:
            with self._path.open("rb") as made:
                shutil.copyfileobj(made, self._file, 1 << 20)
        self._folder.cleanup()


# Formats whose files are no text: written by other libraries.
_TABLES: dict[str, type[_Parquet] | type[_GeoPackage]] = {".parquet": _Parquet, ".gpkg": _GeoPackage}

# Rows of these can be appended one after another; a .cot file then lacks the end of its document.
APPENDED = (".geojsonl", ".csv", ".cot")


def check_place(path: str | Path, run: Located) -> None:
    """Raise `InputError` for a file of latitudes where there are none."""
    if run.origin is None and Path(path).suffix.lower() not in (".csv", ".parquet"):
        raise InputError(f"{path}: {NOWHERE}; or write .csv or .parquet")


def check_format(path: str | Path) -> None:
    """Raise `InputError` unless the suffix of `path` is one that `write_positions` knows."""
    if Path(path).suffix.lower() not in _FORMATS | _TABLES:
        raise InputError(f"{path}: unknown format; the file name must end with {', '.join(_FORMATS | _TABLES)}")


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
        check_place(f"positions{suffix}", run)
        self._file, self._run = file, run
        table = _TABLES.get(suffix.lower())
        self._table = table(file) if table else None
        self._format = _Format() if table else _FORMATS[suffix.lower()]
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
        if self._table:
            self._table.add(self._run, columns)
            return
        for piece in columns.pieces(_AT_ONCE):
            self._file.write(self._format.rows(self._run, piece, self._time))
            if self._later is not None and self._format.later is not None:
                self._later.write(self._format.later(self._run, piece))

    def close(self) -> None:
        """Write the end of the file, which stays open."""
        if self._table:
            self._table.close()
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
    for path in paths:
        check_place(f"positions{stream_suffix}" if path == STREAM else path, run)
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
    """Write positions, atomically: .geojson, .json, .geojsonl, .csv, .kml, .cot, .parquet or .gpkg, by the suffix.

    GeoJSON follows RFC 7946: coordinates are [longitude, latitude, ellipsoidal WGS84 height in meters]. The cameras
    come first (`kind` is "camera"), then one feature for each pair of marks (`kind` is "point"), and last a polygon for
    each position (`kind` is "region"): its 95 % region, a long and slightly skewed ellipse. A pair without a position
    has a null geometry, its status and the reason. `range_high_m` is null where it is infinite, because JSON has no
    infinity; `range_high_infinite` is then true. `.geojsonl` has one feature a line, each region behind its point. In
    CSV unknown fields are empty and an infinite range is `inf`. `.cot` is Cursor-on-Target. `.parquet` is GeoParquet
    (`Located.to_arrow`) and `.gpkg` a GeoPackage with the layers `positions` and `regions`; both need the extra
    `tables`.

    Raises:
        InputError: another suffix.
        FileError: the file cannot be written; an old one is then untouched.

    Example:
        >>> import torch
        >>> from kcal import Localizer, Origin, locate_points
        >>> from kcal.locate import Marks
        >>> from kcal.rig import planned_rig
        >>> there = planned_rig().placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)
        >>> localize = Localizer(there)
        >>> located = locate_points(localize, Marks(("1",), planned_rig()(torch.tensor([[0.0, 0.0, 1000.0]]))[0]))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_positions(Path(folder, "positions.csv"), located).read_text().splitlines()[1][:4]
        '1,ok'
    """
    check_format(path)
    with open_writers([Path(path)], located) as (writer,):
        writer.add(located.columns)
    return Path(path)


# Read positions back.

_CODES = {name: code for code, name in STATUS_NAMES.items()}
# Meters by which places and their latitudes may differ: files have all digits.
_ROUNDED = 1e-3


def read_positions(path: str | Path, locate: PointLocator) -> Located:
    """Read the positions of a CSV file that kcal has written, of points or of tracks.

    Args:
        path: of the file.
        locate: of the rig by which they were located.

    Raises:
        FileError: another table, a cell that cannot be read, or positions of another rig as far as that shows: another
            frame, another place on the Earth, other cameras.
    """
    run = locate.located()
    names = list(NUMBERS if run.origin else OWN_FRAME.values())
    known = [*TEXTS, *([] if run.origin else ["frame"]), *names]
    if ("frame" in header_of(path)) == bool(run.origin):
        raise FileError(f"{path}: positions of another rig: those of this one are meters, {run.frame}")
    parts = []
    for chunk in read_chunks(path, ",".join(known), known, known, extras=True, unique=False):
        cells = dict(chunk.columns)
        numbers = np.full((len(chunk.names), len(NUMBERS)), np.nan)
        try:
            status = np.array([_CODES[text] for text in cells["status"]], np.int8)
            for name, place in zip(names, range(len(NUMBERS)) if run.origin else _OWN_COLUMNS, strict=True):
                numbers[:, place] = [float(cell or "nan") for cell in cells[name]]
        except (KeyError, ValueError) as error:
            raise FileError(f"{path}: lines {chunk.lines[0]} to {chunk.lines[-1]}: {error} is none of kcal") from error
        extras = {name: texts for name, texts in cells.items() if name not in known}
        parts.append(PositionColumns(chunk.names, status, cells["reason"], numbers, extras, np.zeros(len(status), int)))
    columns = PositionColumns.joined(parts)
    there = torch.from_numpy(columns.numbers[columns.located])
    if run.origin and bool(((geodetic_to_enu(there[:, :3], run.origin) - there[:, 4:7]).norm(dim=-1) > _ROUNDED).any()):
        raise FileError(f"{path}: positions of another rig: this one counts from {run.origin}")
    cameras = columns.extras.get("told_from", columns.extras.get("cameras", []))
    anchors = [] if run.centers is None else [text.split(" ")[0] for text in cameras]
    rig = locate.localize.rig
    if other := next((name for name in anchors if name and name not in rig.names), None):
        raise FileError(f"{path}: positions of another rig: this one has no camera {other!r}")
    for row, name in enumerate(anchors):
        columns.anchor[row] = rig.names.index(name) if name else 0
    return locate.located(columns)
