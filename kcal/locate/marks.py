"""Read marked pixel pairs from a CSV file, and say which line is wrong when one is."""

from __future__ import annotations

import csv
import difflib
import io
import math
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import FileError

_PIXELS = ("left_u", "left_v", "right_u", "right_v")
_COLUMNS = ("name", *_PIXELS, "note")


class Marks(NamedTuple):
    """The same things marked in both images.

    Attributes:
        names: one a pair, unique; the row's number where the file has no names.
        left: (N, 2) float64 pixels in the left image, integer coordinates at pixel centres.
        right: (N, 2) likewise in the right image.
    """

    names: tuple[str, ...]
    left: Tensor
    right: Tensor


def read_marks(path: str | Path) -> Marks:
    r"""Read a comma-separated file with the header `name,left_u,left_v,right_u,right_v`.

    Columns may come in any order; `name` may be absent (rows are then numbered from 1) and a column `note` is allowed
    and not used. Blank lines are skipped, and a byte order mark at the beginning is accepted. Pixels may lie outside
    the image: `locate` reports such a pair.

    Raises:
        FileError: the file cannot be read, has no rows, an unknown or missing column, or a line with a wrong number
            of fields, an empty or non-numeric field or a name used before. The message names the line.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder, "points.csv")
        ...     _ = path.write_text("name,left_u,left_v,right_u,right_v\nmast,960,540.5,956.8,540.5\n")
        ...     marks = read_marks(path)
        >>> marks.names, marks.right.tolist()
        (('mast',), [[956.8, 540.5]])
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
        raise FileError(f"{path}: the file is empty; the first line must be name,{','.join(_PIXELS)}")
    line, header = rows[0]
    _check_header(f"{path}: line {line}", header)
    if len(rows) == 1:
        raise FileError(f"{path}: no rows under the header; write one line for each pair of marks")

    lines_by_name: dict[str, int] = {}
    pixels = []
    for number, (line, cells) in enumerate(rows[1:], start=1):
        where = f"{path}: line {line}"
        if len(cells) != len(header):
            raise FileError(f"{where}: {len(cells)} fields, the header has {len(header)}: {','.join(cells)}")
        row = dict(zip(header, cells, strict=True))
        name = row.get("name", str(number))
        if not name:
            raise FileError(f"{where}: the name is empty; write one or leave the column out")
        if name in lines_by_name:
            raise FileError(f"{where}: the name {name!r} was used on line {lines_by_name[name]}; names must differ")
        lines_by_name[name] = line
        pixels.append([_number(where, column, row[column]) for column in _PIXELS])
    table = torch.tensor(pixels, dtype=torch.float64)
    return Marks(names=tuple(lines_by_name), left=table[:, :2], right=table[:, 2:])


def _check_header(where: str, header: list[str]) -> None:
    expected = f"name,{','.join(_PIXELS)}"
    if len(header) == 1:
        for sign, word in ((";", "semicolons"), ("\t", "tabs")):
            if sign in header[0]:
                raise FileError(f"{where}: fields are separated by {word}; use commas, and points in the numbers")
    for column in header:
        if column not in _COLUMNS:
            near = difflib.get_close_matches(column.lower(), _COLUMNS, n=1, cutoff=0.5)
            hint = f"did you mean {near[0]!r}?" if near else f"the header is {expected}"
            raise FileError(f"{where}: unknown column {column!r}; {hint}")
        if header.count(column) > 1:
            raise FileError(f"{where}: the column {column!r} is there twice")
    missing = [column for column in _PIXELS if column not in header]
    if missing:
        raise FileError(f"{where}: the column {missing[0]!r} is missing; the header is {expected}")


def _number(where: str, column: str, cell: str) -> float:
    if not cell:
        raise FileError(f"{where}: {column} is empty; write a pixel coordinate or delete the line")
    try:
        # Python also reads "1_000", which is more likely a slip than a number.
        value = math.nan if "_" in cell else float(cell)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise FileError(f"{where}: {column} is {cell!r}; a pixel coordinate is needed, for example 960.5")
    return value
