"""Comma-separated tables with named rows, read strictly: an error names the line and what to write there."""

from __future__ import annotations

import csv
import difflib
import io
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from kcal.errors import FileError


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
            raise FileError(f"{self.where}: {column} is {cell!r}; {what} is needed, for example 960.5")
        return value

    def optional(self, column: str, what: str = "a number") -> float | None:
        """The same, None where the column is absent or the cell is empty."""
        return self.number(column, what) if self.cells.get(column) else None

    def positive(self, column: str) -> float | None:
        """The same, positive; `inf` counts."""
        cell = self.cells.get(column)
        if not cell:
            return None
        value = _float(cell)
        if not value > 0:
            raise FileError(f"{self.where}: {column} is {cell!r}; a positive number is needed")
        return value


def _float(cell: str) -> float:
    try:
        # Python also reads "1_000", which is more likely a slip than a number.
        return math.nan if "_" in cell else float(cell)
    except ValueError:
        return math.nan


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
    path = Path(path)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise FileError(f"{path}: cannot read: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise FileError(f"{path}: not UTF-8 text; save it as CSV in UTF-8") from error
    if "\0" in text:
        raise FileError(f"{path}: not a text file; save it as CSV in UTF-8")
    reader = csv.reader(io.StringIO(text, newline=""), strict=True, skipinitialspace=True)
    try:
        rows = [(reader.line_num, [cell.strip() for cell in row]) for row in reader]
    except csv.Error as error:
        raise FileError(f"{path}: line {reader.line_num}: {error}; check the quotation marks") from error
    rows = [(line, cells) for line, cells in rows if any(cells)]
    if not rows:
        raise FileError(f"{path}: the file is empty; the first line must be {header}")
    line, names = rows[0]
    _check_header(f"{path}: line {line}", names, header, columns, required)
    if len(rows) == 1:
        raise FileError(f"{path}: no rows under the header; write one line for each")

    lines_by_name: dict[str, int] = {}
    found = []
    for number, (line, cells) in enumerate(rows[1:], start=1):
        where = f"{path}: line {line}"
        if len(cells) != len(names):
            raise FileError(f"{where}: {len(cells)} fields, the header has {len(names)}: {','.join(cells)}")
        row = dict(zip(names, cells, strict=True))
        name = row.get("name", str(number))
        if not name:
            raise FileError(f"{where}: the name is empty; write one or leave the column out")
        if name in lines_by_name:
            raise FileError(f"{where}: the name {name!r} was used on line {lines_by_name[name]}; names must differ")
        lines_by_name[name] = line
        found.append(TableRow(where, name, row))
    return found


def _check_header(where: str, names: list[str], header: str, columns: Sequence[str], required: Sequence[str]) -> None:
    if len(names) == 1 and len(required) > 0:
        for sign, word in ((";", "semicolons"), ("\t", "tabs")):
            if sign in names[0]:
                raise FileError(f"{where}: fields are separated by {word}; use commas, and points in the numbers")
    for column in names:
        if column not in columns:
            near = difflib.get_close_matches(column.lower(), columns, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]!r}?" if near else f"the header is {header}"
            raise FileError(f"{where}: unknown column {column!r}; {hint}")
        if names.count(column) > 1:
            raise FileError(f"{where}: the column {column!r} is there twice")
    missing = [column for column in required if column not in names]
    if missing:
        raise FileError(f"{where}: the column {missing[0]!r} is missing; the header is {header}")
