"""Read marks of any number of cameras: long tables with one line for each thing that each camera saw."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.sources import Features
from kcal.errors import FileError
from kcal.locate.distinct_keys import DistinctKeys, Doubled
from kcal.locate.marks import read_marks
from kcal.locate.survey import MarkedLandmarks, Survey, inverse_range_of, marked_places
from kcal.locate.tables import TableChunk, TableRow, header_of, read_chunks
from kcal.texts import brief

_LONG = ("name", "camera", "u", "v")
_HEADER = ",".join(_LONG)
_KNOWN = (*_LONG, "time", "sigma", "note")
_RANGES = ("range", "range_sigma", "beyond")
# Bytes of a table that is read whole: some 500,000 lines.
_WHOLE = 1 << 24


class ViewMarks(NamedTuple):
    """What several cameras saw.

    Attributes:
        names: one for each row; with the moment where a thing was seen at several.
        pixels: (N, C, 2) float64; NaN where a camera has no mark.
        sigma: (N, C) px as the table states it; NaN where it does not.
        extras: `time`, where the table has it, and other columns, as in the first line of each.
    """

    names: tuple[str, ...]
    pixels: Tensor
    sigma: Tensor
    extras: dict[str, list[str]]

    def sigmas(self, default: float) -> Tensor:
        """(N, C) px, `default` where none is stated."""
        return torch.where(self.sigma.isfinite(), self.sigma, default)

    def __repr__(self) -> str:
        return brief(self)


def is_long(path: str | Path) -> bool:
    """Whether a table has a column `camera`."""
    return "camera" in header_of(path)


def read_views(path: str | Path, cameras: Sequence[str], *, ranges: bool = False, others: bool = False) -> ViewMarks:
    r"""Read `name,camera,u,v` and, if they are there, `time` (seconds or text), `sigma` (px) and `note`.

    Lines of one name, and one time, belong together; a camera is named once for each. The table of pairs
    (`name,left_u,left_v,right_u,right_v`) is read too, where there are two cameras.

    Args:
        path: of the file.
        cameras: their names, in the order of the result.
        ranges: accept the columns range, range_sigma and beyond, and no others; otherwise any are kept.
        others: skip marks of other cameras, where they are otherwise an error.

    Raises:
        FileError: a camera that is not there, two marks of one thing in one camera; the line is named.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "marks.csv")
        ...     _ = path.write_text("name,camera,u,v\nmast,a,10,20\nmill,b,5,6\nmast,c,30,40\n")
        ...     views = read_views(path, ("a", "b", "c"))
        >>> views.names, views.pixels[0, :, 0].tolist()
        (('mast', 'mill'), [10.0, nan, 30.0])
    """
    if not is_long(path):
        if len(cameras) != 2:
            raise FileError(f"{path}: marks of {len(cameras)} cameras need the columns {_HEADER}, one line each")
        pairs = read_marks(path, single=True)
        return ViewMarks(pairs.names, pairs.pixels, pairs.sigmas(math.nan), {})
    reader = _Gather(cameras, others)
    more: list[str] = []
    for chunk in _view_chunks(path, ranges):
        more = [column for column in chunk.columns if column not in _KNOWN]
        for row in chunk.rows():
            reader.add(row)
    if not reader.first:
        raise FileError(f"{path}: no mark of {', '.join(cameras)}; the column camera needs its file's name")
    return reader.marks(more)


def read_view_chunks(path: str | Path, cameras: Sequence[str]) -> Iterator[tuple[ViewMarks, int]]:
    """The same for a table that may be longer than memory: some things at a time, and how many bytes were read.

    Tables of up to 16 MB are read whole, in any order of their lines. In longer ones the lines of one thing, and one
    time, stand together; names come with their time, if there is one.

    Raises:
        FileError: as `read_views`; a thing whose lines do not stand together.
    """
    path = Path(path)
    if not is_long(path) or path.stat().st_size <= _WHOLE:
        yield read_views(path, cameras, others=False), path.stat().st_size
        return
    reader, more = _Gather(cameras), list[str]()
    open_key: tuple[str, str] | None = None
    with closing(DistinctKeys(path, lambda: _things(path))) as earlier:
        for chunk in _view_chunks(path, False):
            more = [column for column in chunk.columns if column not in _KNOWN]
            for row in chunk.rows():
                key = row.name, row.cells.get("time", "")
                if key != open_key and key in reader.rows:
                    raise FileError(_not_together(row.where, row.name))
                reader.add(row)
                open_key = key
            # The last thing may go on.
            done, reader = reader, _Gather(cameras)
            if open_key is not None:
                done.move(open_key, reader)
            if done.first:
                _refuse_apart(path, earlier.add(done.rows))
                yield done.marks(more, timed=True), chunk.bytes_read
        _refuse_apart(path, earlier.add(reader.rows))
        _refuse_apart(path, earlier.finish())
    yield reader.marks(more, timed=True), path.stat().st_size


def _refuse_apart(path: Path, found: Doubled | None) -> None:
    if found is not None:
        raise FileError(_not_together(f"{path}: line {found.again}", found.key[0]))


def _not_together(where: str, name: str) -> str:
    return (
        f"{where}: lines of {name!r} stand at several places; in a table this long they must stand together: "
        "sort it by name and time"
    )


def _things(path: Path) -> Iterator[tuple[tuple[str, str], int]]:
    """Name and time of each thing, and the first of its lines that stand together."""
    last = None
    for chunk in _view_chunks(path, False):
        times = chunk.columns.get("time", [""] * len(chunk.names))
        for name, time, line in zip(chunk.names, times, chunk.lines, strict=True):
            if (name, time) != last:
                last = name, time
                yield last, line


def _view_chunks(path: str | Path, ranges: bool) -> Iterator[TableChunk]:
    known = (*_KNOWN, *(_RANGES if ranges else ()))
    return read_chunks(path, _HEADER, known, _LONG, extras=not ranges, unique=False)


class _Gather:
    """Lines of one thing at one time, put together into rows."""

    def __init__(self, cameras: Sequence[str], others: bool = False) -> None:
        self.number: Mapping[str, int] = {name: c for c, name in enumerate(cameras)}
        self.others, self.cameras = others, cameras
        self.rows: dict[tuple[str, str], int] = {}
        self.placed: dict[tuple[int, int], tuple[float, float, float]] = {}
        self.first: list[TableRow] = []

    def add(self, row: TableRow) -> None:
        camera = row.cells["camera"]
        if camera not in self.number:
            if self.others:
                return
            raise FileError(f"{row.where}: no camera is named {camera!r}; they are {', '.join(self.cameras)}")
        key = row.name, row.cells.get("time", "")
        place = self.rows.setdefault(key, len(self.rows)), self.number[camera]
        if place[0] == len(self.first):
            self.first.append(row)
        if place in self.placed:
            raise FileError(f"{row.where}: {row.name!r} was marked in {camera} before; one mark each is needed")
        sigma = row.positive("sigma") or math.nan
        self.placed[place] = row.number("u", "a pixel coordinate"), row.number("v", "a pixel coordinate"), sigma

    def move(self, key: tuple[str, str], other: _Gather) -> None:
        """Take the last thing away, and give it to another."""
        last = self.rows.pop(key)
        other.rows[key], other.first = 0, [self.first.pop()]
        for camera in range(len(self.cameras)):
            if (found := self.placed.pop((last, camera), None)) is not None:
                other.placed[0, camera] = found

    def marks(self, more: Sequence[str], timed: bool = False) -> ViewMarks:
        table = torch.full((len(self.rows), len(self.cameras), 3), math.nan, dtype=torch.float64)
        if self.placed:
            at, values = torch.tensor(list(self.placed)), torch.tensor(list(self.placed.values()), dtype=torch.float64)
            table[at[:, 0], at[:, 1]] = values
        times = [time for _, time in self.rows]
        names = [name for name, _ in self.rows]
        several = {name for name, count in Counter(names).items() if timed or count > 1} if any(times) else set()
        extras = {column: [row.cells[column] for row in self.first] for column in more}
        if any(times):
            extras = {"time": times, **extras}
        return ViewMarks(
            tuple(f"{name} {time}" if name in several else name for name, time in self.rows), table[..., :2],
            table[..., 2], extras,
        )  # fmt: skip


def match_views(survey: Survey, views: ViewMarks, pixel_sigma: float) -> MarkedLandmarks:
    """Match surveyed places and marks by name; see `kcal.rig.match_landmarks`.

    Raises:
        InputError: no name is in both.
    """
    return marked_places(survey, views.names, views.pixels, views.sigmas(pixel_sigma))


def read_feature_views(path: str | Path, cameras: Sequence[str], pixel_sigma: float) -> Features:
    """Things of unknown position, seen by any two or more cameras; their ranges as in `kcal.rig.read_features`.

    Raises:
        FileError: see `read_views`.
    """
    views = read_views(path, cameras, ranges=True)
    count = len(views.names)
    cells = {column: views.extras.get(column, [""] * count) for column in _RANGES}
    rows = [
        TableRow(f"{path}: {name}", name, {column: cells[column][i] for column in _RANGES})
        for i, name in enumerate(views.names)
    ]
    known = torch.tensor([inverse_range_of(row) for row in rows], dtype=torch.float64).reshape(-1, 2)
    return Features(
        names=views.names,
        pixels=views.pixels,
        inverse_range=known[:, 0],
        inverse_range_sigma=known[:, 1],
        pixel_sigma=pixel_sigma,
    )
