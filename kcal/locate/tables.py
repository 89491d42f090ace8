"""Tables of marks, survey and positions: their columns, their keys, and how they are read."""

from __future__ import annotations

import csv
import difflib
import itertools
import math
import os
import re
import sys
import tempfile
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from io import TextIOWrapper
from operator import methodcaller
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np
import orjson
from numpy.typing import NDArray

from kcal.dispatch import CHUNK
from kcal.errors import FileError
from kcal.files import read_head
from kcal.texts import briefly

# Located pairs column by column: what files and tables are made of, without an object for each row.

# The numbers of a position, in the order of the columns of a file. Covariances are of east, north, up.
NUMBERS = (
    "lat", "lon", "height_ellipsoidal_m", "geoid_height_m", "east_m", "north_m", "up_m",
    "range_m", "range_low_m", "range_high_m",
    "cov_ee_m2", "cov_en_m2", "cov_eu_m2", "cov_nn_m2", "cov_nu_m2", "cov_uu_m2",
    "cep50_m", "cep95_m", "range_m_per_px", "range_m_per_deg_yaw", "azimuth_deg", "elevation_deg",
    "reprojection_left_px", "reprojection_right_px",
)  # fmt: skip
# Columns of a file before the numbers.
TEXTS = ("name", "status", "reason")
_LARGEST = sys.float_info.max


@briefly
class PositionColumns(NamedTuple):
    """Located pairs, column by column.

    Attributes:
        names: one for each pair.
        status: (N,) codes of `PositionStatus`.
        reasons: empty, or why there is no position, or a warning.
        numbers: (N, 24) float64, the columns `NUMBERS`; NaN where unknown, and `range_high_m` may be infinite.
        extras: the cells of further columns of the table of marks, by name.
        anchor: (N,) number of the camera from which bearing and range count.
    """

    names: Sequence[str]
    status: NDArray[np.int8]
    reasons: Sequence[str]
    numbers: NDArray[np.float64]
    extras: dict[str, list[str]]
    anchor: NDArray[np.int64]

    def column(self, name: str) -> NDArray[np.float64]:
        """(N,) one of the numbers."""
        return self.numbers[:, NUMBERS.index(name)]

    def rows(self, which: NDArray[np.intp] | slice) -> PositionColumns:
        """Some of the pairs."""

        def some(cells: Any) -> Any:
            return cells[which] if isinstance(which, slice) else [cells[i] for i in which.tolist()]

        extras = {name: some(cells) for name, cells in self.extras.items()}
        names, reasons = some(self.names), some(self.reasons)
        return PositionColumns(names, self.status[which], reasons, self.numbers[which], extras, self.anchor[which])

    def pieces(self, size: int) -> Iterator[PositionColumns]:
        """The same rows in turn, `size` at a time."""
        return (self.rows(slice(start, start + size)) for start in range(0, len(self.names), size))

    @classmethod
    def joined(cls, parts: Sequence[PositionColumns]) -> PositionColumns:
        """The rows of some columns, one after the other, with the further columns of the first."""
        if not parts:
            return cls((), np.zeros(0, np.int8), (), np.zeros((0, len(NUMBERS))), {}, np.zeros(0, np.int64))
        names, status, reasons, numbers, extras, anchor = zip(*parts, strict=True)
        return cls(
            [*itertools.chain(*names)], np.concatenate(status), [*itertools.chain(*reasons)], np.concatenate(numbers),
            {name: [*itertools.chain(*(each[name] for each in extras))] for name in extras[0]}, np.concatenate(anchor),
        )  # fmt: skip

    @property
    def located(self) -> NDArray[np.bool_]:
        """(N,) which pairs have a position."""
        return np.isfinite(self.column("east_m"))


def number_lines(values: NDArray[np.float64]) -> list[str]:
    """Each row (K numbers) as text with commas between; every digit of a float64, nothing for NaN, `inf`.

    Example:
        >>> number_lines(np.array([[1.0, np.nan], [0.1, np.inf]]))
        ['1.0,', '0.1,inf']
    """
    if len(values) == 0:
        return []
    # JSON has neither NaN, which becomes null, nor infinity: the largest float stands for it meanwhile.
    infinite = np.isinf(values)
    some = bool(infinite.any())
    finite = np.ascontiguousarray(np.where(infinite, _LARGEST, values) if some else values)
    text = orjson.dumps(finite, option=orjson.OPT_SERIALIZE_NUMPY)
    # Without the letters of null, which no number has.
    text = text[2:-2].translate(None, b"nul")
    text = text.replace(orjson.dumps(_LARGEST), b"inf") if some else text
    return text.decode().split("],[")


# Keys of a table of any length that must differ, checked in constant memory.

# Hashes in memory (8 MB), and the parts in which those on the disk are compared: of 10⁸ keys, 1 MB each.
_IN_MEMORY, _PARTS = 1 << 20, 1 << 10
_EDGES = np.arange(1 - _PARTS // 2, _PARTS // 2, dtype=np.int64) << 54
# Equal hashes that are looked up in the table at once. Unlike keys with equal hashes are far fewer.
_AT_ONCE = 1 << 16


class Doubled(NamedTuple):
    """A key that was used before, and the lines of its first and its second use."""

    key: Any
    first: int
    again: int


class DistinctKeys:
    """Finds a key that comes twice: at once if few came since, in `finish` if it is far from its first use.

    Eight bytes are kept for each key, its hash: the latest million in memory, the others sorted in a temporary file.
    Whether keys with equal hashes are really equal, the table says, which is read again up to there.

    Args:
        path: of the table, for messages.
        walk: reads it from the beginning: each key and its line.

    Example:
        >>> names = DistinctKeys(Path("marks.csv"), lambda: [("a", 2), ("b", 3), ("a", 4)])
        >>> names.add(["a", "b"]), names.add(["a"])
        (None, Doubled(key='a', first=2, again=4))
    """

    def __init__(self, path: Path, walk: Callable[[], Iterable[tuple[Hashable, int]]]) -> None:
        self._path, self._walk = path, walk
        self._latest = np.empty(0, np.int64)
        self._file: IO[bytes] | None = None
        self._starts: list[NDArray[np.int64]] = []  # of the parts of each sorted run in the file

    def add(self, keys: Collection[Hashable]) -> Doubled | None:
        """Take the next keys; one that was used before among the latest.

        Raises:
            FileError: no room on the disk.
        """
        hashes = np.fromiter(map(hash, keys), np.int64, len(keys))
        # Almost sorted, which the stable sort makes use of.
        self._latest = np.sort(np.concatenate([self._latest, hashes]), kind="stable")
        twice = self._latest[1:][self._latest[1:] == self._latest[:-1]]
        if len(twice):
            if found := self._really(twice):
                return found
            self._latest = np.unique(self._latest)
        if len(self._latest) >= _IN_MEMORY:
            self._put_away()
        return None

    def finish(self) -> Doubled | None:
        """A key that was used twice, of all that came.

        Raises:
            FileError: no room on the disk.
        """
        if self._file is None:
            return None
        self._put_away()
        suspects = np.empty(0, np.int64)
        for part in range(_PARTS):
            hashes = np.sort(np.concatenate([self._stored(starts[part : part + 2]) for starts in self._starts]))
            suspects = np.union1d(suspects, hashes[1:][hashes[1:] == hashes[:-1]])
            if len(suspects) > _AT_ONCE:
                break
        return self._really(suspects) if len(suspects) else None

    def close(self) -> None:
        """Remove the temporary file."""
        if self._file is not None:
            self._file.close()

    def _really(self, suspects: NDArray[np.int64]) -> Doubled | None:
        wanted = frozenset(suspects.tolist())
        lines: dict[Hashable, int] = {}
        for key, line in self._walk():
            if hash(key) in wanted:
                if key in lines:
                    return Doubled(key, lines[key], line)
                lines[key] = line
        return None

    def _put_away(self) -> None:
        try:
            if self._file is None:
                self._file = tempfile.TemporaryFile()  # noqa: SIM115
            start = self._file.seek(0, 2) // 8
            self._file.write(self._latest.data)
            self._file.flush()
        except OSError as error:
            raise FileError(
                f"{self._path}: to find names that are used twice, 8 bytes for each are kept in "
                f"{tempfile.gettempdir()}: {error.strerror or error}; set TMPDIR to a folder with more room"
            ) from error
        edges = np.searchsorted(self._latest, _EDGES)
        self._starts.append(np.concatenate([[start], start + edges, [start + len(self._latest)]]))
        self._latest = self._latest[:0]

    def _stored(self, span: NDArray[np.int64]) -> NDArray[np.int64]:
        assert self._file is not None
        first, end = span.tolist()
        self._file.seek(8 * first)
        return np.frombuffer(self._file.read(8 * (end - first)), np.int64)


# Comma-separated tables with named rows, read strictly: an error names the line and what to write there.

# The pieces in which the localizer does many points: a table is located as in one call, to the last bit.
CHUNK_ROWS = CHUNK
# Characters of a line.
_LONGEST = 1 << 20

_NUMBER = re.compile(r"[+-]?([0-9]+(\.[0-9]*)?|\.[0-9]+)([eE][+-]?[0-9]+)?")
# Apostrophes, and what begins a formula: see `kcal.texts.csv_line`.
_GUARDED = re.compile(r"'+\s*[=+\-@＝＋－＠]")


class TableRow(NamedTuple):
    """One line of a table: where it stands, its name, and its cells by column."""

    where: str
    name: str
    cells: dict[str, str]

    def number(self, column: str, what: str = "a number") -> float:
        """The finite number in a column.

        Raises:
            FileError: empty, or no number; the line is named.
        """
        cell = self.cells[column]
        if not cell:
            raise FileError(f"{self.where}: {column} is empty; write {what} or delete the line")
        value = _float(cell)
        if not math.isfinite(value):
            verb, example = ("are", 43.32027) if what.endswith("degrees") else ("is", 960.5)
            raise FileError(f"{self.where}: {column} is {cell!r}; {what} {verb} needed, for example {example}")
        return value

    def positive(self, column: str, *, infinite: bool = False) -> float | None:
        """The positive number in a column; None where the column is absent or the cell is empty.

        Args:
            column: its name.
            infinite: whether `inf` counts.

        Raises:
            FileError: another number, or none; the line is named.
        """
        cell = self.cells.get(column)
        if not cell:
            return None
        value = _float(cell)
        if not value > 0 or (math.isinf(value) and not infinite):
            raise FileError(f"{self.where}: {column} is {cell!r}; a positive number is needed")
        return value


def _float(cell: str) -> float:
    try:
        # Python also reads "1_000", which is more likely a slip than a number.
        return math.nan if "_" in cell else float(cell)
    except ValueError:
        return math.nan


class TableChunk(NamedTuple):
    """Some consecutive rows of a table, column by column.

    Attributes:
        path: of the table.
        lines: the line on which each row ends.
        names: one for each row; its number where the table has no names.
        columns: the cells of each column, in the order of the header.
        bytes_read: how far the file has been read, for progress.
    """

    path: Path
    lines: Sequence[int]
    names: Sequence[str]
    columns: dict[str, list[str]]
    bytes_read: int

    def rows(self) -> Iterator[TableRow]:
        """Each row by itself, for what is not done by columns."""
        for line, name, cells in zip(self.lines, self.names, zip(*self.columns.values(), strict=True), strict=True):
            yield TableRow(f"{self.path}: line {line}", name, dict(zip(self.columns, cells, strict=True)))

    def numbers(self, columns: Sequence[str]) -> NDArray[np.float64] | None:
        """(N, K) finite numbers of some columns; None if a cell has none: then ask its row, which says so."""
        values = np.empty((len(self.lines), len(columns)))
        for place, column in enumerate(columns):
            text = ",".join(self.columns[column]).encode()
            if text.translate(None, b"0123456789.eE+-,"):
                return None
            try:
                values[:, place] = orjson.loads(b"[" + text + b"]")
            except ValueError:
                # Not JSON may still be a number: "+5", ".5".
                try:
                    values[:, place] = list(map(float, self.columns[column]))
                except ValueError:
                    return None
        return values if bool(np.isfinite(values).all()) else None


def read_rows(path: str | Path, header: str, columns: Sequence[str], required: Sequence[str]) -> list[TableRow]:
    r"""Read a comma-separated file with a header and at least one line below it.

    Columns may come in any order; `name` may be absent (rows are then numbered from 1). Blank lines are skipped, and a
    byte order mark at the beginning is accepted.

    Args:
        path: of the file.
        header: the usual header, for messages.
        columns: all columns that may be there.
        required: those that must be.

    Raises:
        FileError: the file cannot be read, has no rows, an unknown or missing column, or a line with a wrong number
            of fields or a name used before. The message names the line.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "points.csv")
        ...     _ = path.write_text("name,height\nmast,14.5\n")
        ...     read_rows(path, "name,height", ("name", "height"), ("height",))[0].number("height")
        14.5
    """
    return [row for chunk in read_chunks(path, header, columns, required) for row in chunk.rows()]


def read_chunks(
    path: str | Path,
    header: str,
    columns: Sequence[str],
    required: Sequence[str],
    *,
    extras: bool = False,
    unique: bool = True,
    at_once: int = CHUNK_ROWS,
) -> Iterator[TableChunk]:
    """The same, some rows at a time, so that a table may be longer than memory.

    Of the names, some megabytes are kept in memory, the others as eight bytes each in a temporary file: one that was
    used before is refused when its line is reached or, if a million lines or more are between, at the end.

    Args:
        path: of the file.
        header: the usual header, for messages.
        columns: all columns that are known.
        required: those that must be there.
        extras: accept other columns too.
        unique: refuse a name that was used before.
        at_once: most rows of a chunk.

    Raises:
        FileError: as `read_rows`, when the line is reached.
    """
    path = Path(path)
    count = 0

    def names_again() -> Iterator[tuple[str, int]]:
        again = read_chunks(path, header, columns, required, extras=extras, unique=False, at_once=at_once)
        return ((name, line) for chunk in again for name, line in zip(chunk.names, chunk.lines, strict=True))

    with _text_of(path) as file, closing(DistinctKeys(path, names_again)) as earlier:
        texts_of = _lines_of(path, file)
        names, line = _first_row(path, texts_of)
        if not names:
            raise FileError(f"{path}: the file is empty; the first line must be {header}")
        _check_header(f"{path}: line {line}", names, header, columns, required, extras)
        read = _bytes_read(file)
        while texts := list(itertools.islice(texts_of, at_once)):
            by_column = _split_plain(texts, names)
            lines: Sequence[int] = range(line + 1, line + 1 + len(texts))
            line += len(texts)
            if by_column is None:
                rows, beyond = _split_any(path, texts, texts_of, lines[0] - 1)
                line += beyond
                for end, cells in rows:
                    if len(cells) != len(names):
                        text = f"{len(cells)} fields, the header has {len(names)}: {','.join(cells)}"
                        raise FileError(f"{path}: line {end}: {text}")
                by_column = {name: [cells[place] for _, cells in rows] for place, name in enumerate(names)}
                lines = [end for end, _ in rows]
            if not lines:
                continue
            for name, cells in by_column.items():
                if "'" in "".join(cells):
                    by_column[name] = list(map(_unguarded, cells))
            own = by_column.get("name", [str(count + i) for i in range(1, len(lines) + 1)])
            if "name" in by_column and unique:
                if "" in own:
                    where = f"{path}: line {lines[own.index('')]}"
                    raise FileError(f"{where}: the name is empty; write one or leave the column out")
                _refuse_doubled(path, earlier.add(own))
            count += len(lines)
            yield TableChunk(path, lines, own, by_column, read)
            read = _bytes_read(file)
        _refuse_doubled(path, earlier.finish())
    if count == 0:
        raise FileError(f"{path}: no rows under the header; write one line for each")


def header_of(path: str | Path) -> list[str]:
    """The columns of a table.

    Raises:
        FileError: the file cannot be read.
    """
    path = Path(path)
    with _text_of(path) as file:
        return _first_row(path, _lines_of(path, file))[0]


def _first_row(path: Path, texts: Iterator[str]) -> tuple[list[str], int]:
    """Names of the columns, none in an empty file, and how many lines were read."""
    line = 0
    for text in texts:
        rows, beyond = _split_any(path, [text], texts, line)
        line += 1 + beyond
        if rows:
            return rows[0][1], line
    return [], line


@contextmanager
def _text_of(path: Path) -> Iterator[TextIOWrapper]:
    """Open a table; what goes wrong while the block reads it is a `FileError`."""
    try:
        read_head(path, 0)
        with path.open(encoding="utf-8-sig", newline="") as file:
            yield file
    except OSError as error:
        raise FileError(f"{path}: cannot read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: not UTF-8 text; save it as CSV in UTF-8") from error


def _lines_of(path: Path, file: TextIOWrapper) -> Iterator[str]:
    """The lines of a table: zeros without end, say, are none."""
    number = 0
    while text := file.readline(_LONGEST):
        number += 1
        if len(text) == _LONGEST and not text.endswith("\n"):
            raise FileError(f"{path}: line {number}: more than {_LONGEST:,} characters; not a table")
        yield text


def _bytes_read(file: TextIOWrapper) -> int:
    """How much of a file has been taken from the disk."""
    return os.lseek(file.fileno(), 0, os.SEEK_CUR)


def _stripped(cells: list[str]) -> list[str]:
    return [cell.strip() for cell in cells]


def _split_plain(texts: list[str], names: Sequence[str]) -> dict[str, list[str]] | None:
    """The columns of lines without quotation marks, all of the right width: no list for each row, 5 times as fast.

    None where the lines need `csv`.
    """
    width = len(names)
    text = "".join(texts).replace("\r\n", "\n").removesuffix("\n")
    if any(sign in text for sign in '"\r\0') or set(map(methodcaller("count", ","), texts)) != {width - 1}:
        return None
    cells = text.replace("\n", ",").split(",")
    if not text.isascii() or any(space in text for space in " \t\v\f\x1c\x1d\x1e\x1f"):
        cells = _stripped(cells)
    by_column = {name: cells[place::width] for place, name in enumerate(names)}
    # A row of empty cells is a blank line.
    return by_column if all(by_column[names[-1]]) else None


def _split_any(path: Path, texts: list[str], file: Iterator[str], line: int) -> tuple[list[tuple[int, list[str]]], int]:
    """Rows that are not blank, each with the line on which it ends, and how many lines beyond `texts` the last took."""
    if any("\0" in text for text in texts):
        raise FileError(f"{path}: not a text file; save it as CSV in UTF-8")
    reader = csv.reader(itertools.chain(texts, file), strict=True, skipinitialspace=True)
    rows = []
    try:
        for cells in map(_stripped, reader):
            if any(cells):
                rows.append((line + reader.line_num, cells))
            if reader.line_num >= len(texts):
                break
    except csv.Error as error:
        raise FileError(f"{path}: line {line + reader.line_num}: {error}; check the quotation marks") from error
    return rows, reader.line_num - len(texts)


def is_number(cell: str) -> bool:
    """Whether a spreadsheet reads a cell as a number."""
    return _NUMBER.fullmatch(cell) is not None


def guarded(text: str) -> str:
    """A text that looks as if `kcal.texts.csv_line` had put an apostrophe before it gets one more."""
    return f"'{text}" if _GUARDED.match(text) and not is_number(text[1:]) else text


def _unguarded(text: str) -> str:
    """The text before `csv_line` put an apostrophe in front, so that no spreadsheet takes it for a formula."""
    return text[1:] if text.startswith("'") and _GUARDED.match(text) and not is_number(text[1:]) else text


def _refuse_doubled(path: Path, found: Doubled | None) -> None:
    if found is not None:
        key, first, again = found
        raise FileError(f"{path}: line {again}: the name {key!r} was used on line {first}; names must differ")


def _check_header(
    where: str, names: list[str], header: str, columns: Sequence[str], required: Sequence[str], extras: bool
) -> None:
    if len(names) == 1 and len(required) > 0:
        for sign, word in ((";", "semicolons"), ("\t", "tabs")):
            if sign in names[0]:
                raise FileError(f"{where}: fields are separated by {word}; use commas, and points in the numbers")
    missing = [column for column in required if column not in names]
    for column in names:
        # Where others are welcome, one that is nearly a known one is a slip only if a known one is missing.
        if column not in columns and (not extras or missing or not column or column.lower() in columns):
            exchanged = [one for one in columns if sorted(one) == sorted(column.lower())]  # u_left for left_u
            near = exchanged or difflib.get_close_matches(column.lower(), columns, n=1, cutoff=0.5)
            if near or not extras or not column:
                hint = f"did you mean {near[0]!r}?" if near else f"the header is {header}"
                raise FileError(f"{where}: unknown column {column!r}; {hint}")
        if names.count(column) > 1:
            raise FileError(f"{where}: the column {column!r} is there twice")
    if missing:
        raise FileError(f"{where}: the column {missing[0]!r} is missing; the header is {header}")
