"""Tables of marks: what each camera saw of a point, one line for each point or for each mark."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import FileError, InputError
from kcal.files import write_atomic
from kcal.locate.tables import CHUNK_ROWS, DistinctKeys, Doubled, TableChunk, TableRow, guarded, header_of, read_chunks
from kcal.texts import briefly, csv_line

# The wide table has one line for each point that two cameras saw, the long one a line for each mark.
PIXELS = ("left_u", "left_v", "right_u", "right_v")
PAIR = ("left", "right")
# The ten entries of a pair's covariance (left_u, left_v, right_u, right_v) on and above its diagonal, row by row.
_UPPER = tuple((i, j) for i in range(4) for j in range(i, 4))
COVARIANCE = tuple(f"cov_{i}{j}" for i, j in _UPPER)
_WIDE = ("name", *PIXELS)
_LONG = ("name", "camera", "u", "v")
_KNOWN = (*_LONG, "time", "sigma", "note")
_PIXEL = "a pixel coordinate"
# px: a survey's and a lens's errors are not smaller, whatever marks say of themselves.
_LEAST_SIGMA = 0.05
# Bytes of a long table that is read whole: some 500,000 lines.
_WHOLE = 1 << 24


@briefly
class Marks(NamedTuple):
    """What the cameras of a rig saw, a row for each point.

    Attributes:
        names: one for each row, unique; its number where a wide table has no names, and with the time where a long
            one has a point at several.
        pixels: (N, V, 2) float64, integer coordinates at pixel centers; NaN where a camera has no mark.
        covariance: (N, 2 V, 2 V) px² of a row's coordinates, as a wide table states it: NaN where a row has none; None
            if it states none at all.
        sigma: (N, V) px along each axis, as a long table states it: NaN where it does not; None likewise.
        extras: the cells of other columns, as they are written: of a long table as in the first line of each point.
    """

    names: Sequence[str]
    pixels: Tensor
    covariance: Tensor | None = None
    sigma: Tensor | None = None
    extras: Mapping[str, list[str]] = {}

    @classmethod
    def of_pair(cls, names: Sequence[str], left: Tensor, right: Tensor, covariance: Tensor | None = None) -> Marks:
        """Of pixels (N, 2) in the left and the right image.

        Raises:
            InputError: no floating point, or shapes that are wrong or unlike.
        """
        left = as_points("left", left, 2)
        right = as_points("right", right, 2, left)
        if left.ndim != 2 or left.shape != right.shape:
            raise InputError(
                f"left and right: the same shape (N, 2) is needed, got {tuple(left.shape)} and {tuple(right.shape)}"
            )
        return cls(names, torch.stack([left, right], 1), covariance)

    def rows(self, which: slice) -> Marks:
        """Some consecutive rows."""
        covariance, sigma = (None if value is None else value[which] for value in (self.covariance, self.sigma))
        extras = {name: cells[which] for name, cells in self.extras.items()}
        return Marks(self.names[which], self.pixels[which], covariance, sigma, extras)

    @property
    def left(self) -> Tensor:
        """(N, 2) pixels of the first camera."""
        return self.pixels[:, 0]

    @property
    def right(self) -> Tensor:
        """(N, 2) pixels of the second camera."""
        return self.pixels[:, 1]

    def covariance_or(self, sigma: float) -> Tensor | None:
        """(N, 2 V, 2 V) what is stated, and `sigma` px along each axis where nothing is; None: nothing at all.

        Example:
            >>> one = Marks.of_pair(("a",), torch.zeros(1, 2), torch.ones(1, 2), torch.full((1, 4, 4), torch.nan))
            >>> one.covariance_or(0.5)[0, 0].tolist()
            [0.25, 0.0, 0.0, 0.0]
        """
        if self.covariance is None:
            if self.sigma is None:
                return None
            variance = torch.where(self.sigma.isfinite(), self.sigma, sigma).square()
            return torch.diag_embed(variance.repeat_interleave(2, -1))
        known = torch.isfinite(self.covariance).all(-1).all(-1)[:, None, None]
        still = torch.eye(self.covariance.shape[-1], dtype=torch.float64)
        return torch.where(known, self.covariance.double(), sigma**2 * still)

    def sigmas(self, sigma: float) -> Tensor:
        """(N, V) standard deviation of each mark along an axis, px: `sigma` where none is stated, NaN without a mark.

        Example:
            >>> one = Marks.of_pair(("a",), torch.tensor([[10.0, 20.0]]), torch.full((1, 2), torch.nan))
            >>> one.sigmas(0.3).tolist()
            [[0.3, nan]]
        """
        found = torch.full(self.pixels.shape[:2], sigma, dtype=torch.float64)
        if self.sigma is not None:
            found = torch.where(self.sigma.isfinite(), self.sigma, found)
        if self.covariance is not None:
            stated = self.covariance.diagonal(dim1=-2, dim2=-1).unflatten(-1, (-1, 2)).mean(-1)
            found = torch.where(stated.isfinite(), stated.sqrt().clamp_min(_LEAST_SIGMA), found)
        return torch.where(self.pixels.isfinite().all(-1), found, math.nan)

    def typical_sigma(self, sigma: float) -> float:
        """The median of `sigmas`, px, so that one vague mark does not count for all; `sigma` without any mark."""
        found = self.sigmas(sigma).nanmedian()
        return float(found) if found.isfinite() else sigma


def is_long(path: str | Path) -> bool:
    """Whether a table has a column `camera`, and with it a line for each mark."""
    return "camera" in header_of(path)


def read_marks(
    path: str | Path,
    cameras: Sequence[str] = PAIR,
    *,
    single: bool = False,
    others: bool = False,
    more: Sequence[str] | None = None,
) -> Marks:
    r"""Read a table of marks: `name,left_u,left_v,right_u,right_v` of two cameras, or `name,camera,u,v` of any number.

    Columns may come in any order, a column `note` is not used, blank lines are skipped, and a byte order mark at the
    beginning is accepted. Pixels may lie outside the image: `locate_points` reports them.

    Of two cameras `name` may be absent (rows are then numbered from 1). The columns `cov_00`, `cov_01` ... `cov_33` may
    contain a pair's covariance, as `kcal mark` writes it: all ten, or all empty.

    Of any number each mark has a line, and if need be its `time` (seconds or text) and `sigma` (px). Lines of one name,
    and one time, belong together; a camera is named once for each.

    Args:
        path: of the file.
        cameras: their names, in the order of the result.
        single: allow a point of two cameras to be marked in one image only; the other's two cells are then empty.
        others: skip marks of other cameras, where they are otherwise an error.
        more: the other columns that a table may have, which `extras` contains; any of a long one if left out.

    Raises:
        FileError: the file cannot be read, has no rows, an unknown or missing column, or a line with a wrong number
            of fields, an empty or non-numeric field, a name used before, a camera that is not there or was marked
            before. The message names the line.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "points.csv")
        ...     _ = path.write_text("name,left_u,left_v,right_u,right_v\nmast,960,540.5,956.8,540.5\n")
        ...     pair = read_marks(path)
        ...     _ = path.write_text("name,camera,u,v\nmast,a,10,20\nmill,b,5,6\nmast,c,30,40\n")
        ...     three = read_marks(path, ("a", "b", "c"))
        >>> pair.names, pair.right.tolist()
        (('mast',), [[956.8, 540.5]])
        >>> three.names, three.pixels[0, :, 0].tolist()
        (('mast', 'mill'), [10.0, nan, 30.0])
    """
    if is_long(path):
        return _whole_long(path, cameras, others, more)
    found = [marks for marks, _ in _wide_chunks(path, cameras, single, False, CHUNK_ROWS, more or ())]
    names = tuple(name for marks in found for name in marks.names)
    covariance = None
    if any(marks.covariance is not None for marks in found):
        unknown = torch.full((4, 4), math.nan, dtype=torch.float64)
        parts = [
            unknown.expand(len(marks.names), 4, 4) if marks.covariance is None else marks.covariance for marks in found
        ]
        covariance = torch.cat(parts)
    known = [name for name in more or () if name in found[0].extras]
    extras = {name: [cell for marks in found for cell in marks.extras[name]] for name in known}
    return Marks(names, torch.cat([marks.pixels for marks in found]), covariance, None, extras)


def read_mark_chunks(
    path: str | Path, cameras: Sequence[str] = PAIR, *, single: bool = False, at_once: int = CHUNK_ROWS
) -> Iterator[tuple[Marks, int]]:
    """The same for a table that may be longer than memory: some points at a time, and how many bytes were read.

    Other columns are kept, also of a wide table. Long tables of up to 16 MB are read whole, in any order of their
    lines. In longer ones the lines of one point, and one time, stand together; names come with their time, if there is
    one.

    Args:
        path: of the file.
        cameras: as for `read_marks`.
        single: likewise.
        at_once: most rows of a part of a wide table.

    Raises:
        FileError: as `read_marks`; a point whose lines do not stand together.
    """
    path = Path(path)
    if not is_long(path):
        yield from _wide_chunks(path, cameras, single, True, at_once)
        return
    if path.stat().st_size <= _WHOLE:
        yield _whole_long(path, cameras), path.stat().st_size
        return
    reader, more = _Gather(cameras), list[str]()
    open_key: tuple[str, str] | None = None
    with closing(DistinctKeys(path, lambda: _things(path))) as earlier:
        for chunk in _long_chunks(path):
            more = [column for column in chunk.columns if column not in _KNOWN]
            for row in chunk.rows():
                key = row.name, row.cells.get("time", "")
                if key != open_key and key in reader.rows:
                    raise FileError(_not_together(row.where, row.name))
                reader.add(row)
                open_key = key
            # The last point may go on.
            done, reader = reader, _Gather(cameras)
            if open_key is not None:
                done.move(open_key, reader)
            if done.first:
                _refuse_apart(path, earlier.add(done.rows))
                yield done.marks(more, timed=True), chunk.bytes_read
        _refuse_apart(path, earlier.add(reader.rows))
        _refuse_apart(path, earlier.finish())
    yield reader.marks(more, timed=True), path.stat().st_size


def _wide_chunks(
    path: str | Path, cameras: Sequence[str], single: bool, extras: bool, at_once: int, more: Sequence[str] = ()
) -> Iterator[tuple[Marks, int]]:
    if len(cameras) != 2:
        raise FileError(f"{path}: marks of {len(cameras)} cameras need the columns {','.join(_LONG)}, one line each")
    known = (*_WIDE, *COVARIANCE)
    for chunk in read_chunks(path, ",".join(_WIDE), (*known, "note", *more), PIXELS, extras=extras, at_once=at_once):
        values = chunk.numbers(PIXELS)
        if values is None:
            values = np.array([[pixel_of(row, side, single) for side in PAIR] for row in chunk.rows()])
        others = {name: cells for name, cells in chunk.columns.items() if name not in known}
        pixels = torch.from_numpy(values).view(-1, 2, 2)
        yield Marks(chunk.names, pixels, _covariances_of(chunk), None, others), chunk.bytes_read


def _whole_long(
    path: str | Path, cameras: Sequence[str], others: bool = False, more: Sequence[str] | None = None
) -> Marks:
    reader = _Gather(cameras, others)
    columns: list[str] = []
    for chunk in _long_chunks(path, more):
        columns = [column for column in chunk.columns if column not in _KNOWN]
        for row in chunk.rows():
            reader.add(row, more or ())
    if not reader.first:
        raise FileError(f"{path}: no mark of {', '.join(cameras)}; the column camera needs its file's name")
    return reader.marks(columns)


def _refuse_apart(path: Path, found: Doubled | None) -> None:
    if found is not None:
        raise FileError(_not_together(f"{path}: line {found.again}", found.key[0]))


def _not_together(where: str, name: str) -> str:
    return (
        f"{where}: lines of {name!r} stand at several places; in a table this long they must stand together: "
        "sort it by name and time"
    )


def _things(path: Path) -> Iterator[tuple[tuple[str, str], int]]:
    """Name and time of each point, and the first of its lines that stand together."""
    last = None
    for chunk in _long_chunks(path):
        times = chunk.columns.get("time", [""] * len(chunk.names))
        for name, time, line in zip(chunk.names, times, chunk.lines, strict=True):
            if (name, time) != last:
                last = name, time
                yield last, line


def _long_chunks(path: str | Path, more: Sequence[str] | None = None) -> Iterator[TableChunk]:
    known = (*_KNOWN, *(more or ()))
    return read_chunks(path, ",".join(_LONG), known, _LONG, extras=more is None, unique=False)


class _Gather:
    """Lines of one point at one time, put together into rows."""

    def __init__(self, cameras: Sequence[str], others: bool = False) -> None:
        self.number: Mapping[str, int] = {name: c for c, name in enumerate(cameras)}
        self.others, self.cameras = others, cameras
        self.rows: dict[tuple[str, str], int] = {}
        self.placed: dict[tuple[int, int], tuple[float, float, float]] = {}
        self.first: list[TableRow] = []

    def add(self, row: TableRow, stated: Sequence[str] = ()) -> None:
        """Take one line; what it states of its point may stand in any of the point's lines."""
        camera = row.cells["camera"]
        if camera not in self.number:
            if self.others:
                return
            order = ", in the order in which the rig was solved" if tuple(self.cameras) == PAIR else ""
            raise FileError(f"{row.where}: no camera is named {camera!r}; they are {', '.join(self.cameras)}{order}")
        key = row.name, row.cells.get("time", "")
        place = self.rows.setdefault(key, len(self.rows)), self.number[camera]
        if place[0] == len(self.first):
            self.first.append(row)
        first = self.first[place[0]].cells
        for column in set(stated) & set(first):
            earlier, cell = first[column], row.cells[column]
            if cell and earlier not in ("", cell):
                raise FileError(f"{row.where}: {column} of {row.name!r} is {cell}, and {earlier} in an earlier line")
            first[column] = earlier or cell
        if place in self.placed:
            raise FileError(f"{row.where}: {row.name!r} was marked in {camera} before; one mark each is needed")
        sigma = row.positive("sigma") or math.nan
        self.placed[place] = row.number("u", _PIXEL), row.number("v", _PIXEL), sigma

    def move(self, key: tuple[str, str], other: _Gather) -> None:
        """Take the last point away, and give it to another."""
        last = self.rows.pop(key)
        other.rows[key], other.first = 0, [self.first.pop()]
        for camera in range(len(self.cameras)):
            if (found := self.placed.pop((last, camera), None)) is not None:
                other.placed[0, camera] = found

    def marks(self, more: Sequence[str], timed: bool = False) -> Marks:
        table = torch.full((len(self.rows), len(self.cameras), 3), math.nan, dtype=torch.float64)
        if self.placed:
            at, values = torch.tensor(list(self.placed)), torch.tensor(list(self.placed.values()), dtype=torch.float64)
            table[at[:, 0], at[:, 1]] = values
        times = [time for _, time in self.rows]
        counts = Counter(name for name, _ in self.rows)
        several = {name for name, count in counts.items() if timed or count > 1} if any(times) else set()
        extras = {column: [row.cells[column] for row in self.first] for column in more}
        if any(times):
            extras = {"time": times, **extras}
        sigma = table[..., 2] if bool(table[..., 2].isfinite().any()) else None
        names = tuple(f"{name} {time}" if name in several else name for name, time in self.rows)
        return Marks(names, table[..., :2], None, sigma, extras)


def write_marks(path: str | Path, marks: Marks) -> Path:
    """Write marks of two cameras as `read_marks` reads them, exact to the last bit.

    Raises:
        FileError: the file cannot be written.
    """
    return write_atomic(path, marks_text(marks))


def marks_text(marks: Marks) -> str:
    """The text that `write_marks` writes; of a pair that is marked in one image only, it has no covariance."""
    table, header = [*marks.left.T.tolist(), *marks.right.T.tolist()], ["name", *PIXELS]
    if marks.covariance is not None:
        whole = marks.covariance.isfinite().all(-1).all(-1)[:, None, None]
        covariance = torch.where(whole, marks.covariance, math.nan)
        table += [covariance[:, i, j].tolist() for i, j in _UPPER]
        header += COVARIANCE
    lines = [csv_line(header)]
    for name, *values in zip(marks.names, *table, strict=True):
        lines.append(csv_line([guarded(name), *(None if math.isnan(value) else value for value in values)]))
    return "".join(lines)


def _covariances_of(chunk: TableChunk) -> Tensor | None:
    """(N, 4, 4) of a chunk; NaN for rows that have none, None if no row has one."""
    if not any(column in chunk.columns for column in COVARIANCE):
        return None
    values = chunk.numbers(COVARIANCE) if all(column in chunk.columns for column in COVARIANCE) else None
    if values is not None:
        found = torch.empty(len(values), 4, 4, dtype=torch.float64)
        for place, (i, j) in enumerate(_UPPER):
            found[:, i, j] = found[:, j, i] = torch.from_numpy(values[:, place])
        if bool((torch.linalg.eigvalsh(found)[:, 0] > 0).all()):
            return found
    stated = torch.stack([_covariance_of(row) for row in chunk.rows()])
    return None if bool(torch.isnan(stated).all()) else stated


def _covariance_of(row: TableRow) -> Tensor:
    """(4, 4) of one line; NaN where it has none."""
    cells = [row.cells.get(column, "") for column in COVARIANCE]
    matrix = torch.full((4, 4), math.nan, dtype=torch.float64)
    if not any(cells):
        return matrix
    for column, (i, j) in zip(COVARIANCE, _UPPER, strict=True):
        if column not in row.cells:
            raise FileError(
                f"{row.where}: the column {column} is missing; a covariance needs all ten, {COVARIANCE[0]} "
                f"to {COVARIANCE[-1]}"
            )
        matrix[i, j] = matrix[j, i] = row.number(column, "a covariance in px²")
    if not float(torch.linalg.eigvalsh(matrix)[0]) > 0:
        raise FileError(
            f"{row.where}: the covariance is not positive definite; write it again or leave its cells empty"
        )
    return matrix


def pixel_of(row: TableRow, side: str, optional: bool) -> tuple[float, float]:
    """The pixel in the columns `side`_u and `side`_v; NaN where both are empty and may be."""
    columns = (f"{side}_u", f"{side}_v")
    if optional and not any(row.cells[column] for column in columns):
        other = "right" if side == "left" else "left"
        if not row.cells[f"{other}_u"]:
            raise FileError(f"{row.where}: neither image has a mark; delete the line")
        return math.nan, math.nan
    return row.number(columns[0], _PIXEL), row.number(columns[1], _PIXEL)
