"""Read marked pixel pairs from a CSV file, and say which line is wrong when one is."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.errors import FileError
from kcal.files import write_atomic
from kcal.locate.tables import CHUNK_ROWS, TableRow, read_chunks

PIXELS = ("left_u", "left_v", "right_u", "right_v")
_HEADER = f"name,{','.join(PIXELS)}"
_PIXEL = "a pixel coordinate"


class Marks(NamedTuple):
    """The same things marked in both images.

    Attributes:
        names: one for each pair, unique; the row's number where the file has no names.
        left: (N, 2) float64 pixels in the left image, integer coordinates at pixel centers.
        right: (N, 2) likewise in the right image.
    """

    names: tuple[str, ...]
    left: Tensor
    right: Tensor

    @property
    def pixels(self) -> Tensor:
        """(N, 2, 2): both images."""
        return torch.stack([self.left, self.right], 1)


def read_marks(path: str | Path, *, single: bool = False) -> Marks:
    r"""Read a comma-separated file with the header `name,left_u,left_v,right_u,right_v`.

    Columns may come in any order; `name` may be absent (rows are then numbered from 1) and a column `note` is allowed
    and not used. Blank lines are skipped, and a byte order mark at the beginning is accepted. Pixels may lie outside
    the image: `locate_points` reports such a pair.

    Args:
        path: of the file.
        single: allow a thing to be marked in one image only; the other's two cells are then empty, its pixel NaN.

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
    chunks = list(read_mark_chunks(path, single=single, extras=False))
    names = tuple(name for chunk in chunks for name in chunk.names)
    pixels = torch.cat([chunk.pixels for chunk in chunks])
    return Marks(names=names, left=pixels[:, 0], right=pixels[:, 1])


class MarkChunk(NamedTuple):
    """Some consecutive pairs of marks of a long table.

    Attributes:
        names: as in `Marks`.
        pixels: (N, 2, 2) float64: both images.
        extras: the cells of all other columns, as they are written.
        bytes_read: how far the file has been read.
    """

    names: Sequence[str]
    pixels: Tensor
    extras: dict[str, list[str]]
    bytes_read: int


def read_mark_chunks(
    path: str | Path, *, single: bool = False, extras: bool = True, at_once: int = CHUNK_ROWS
) -> Iterator[MarkChunk]:
    """Read a table of marks some rows at a time; see `read_marks`.

    Args:
        path: of the file.
        single: allow a thing to be marked in one image only.
        extras: accept columns with other names than those of `read_marks`.
        at_once: most rows of a chunk.
    """
    known = ("name", *PIXELS)
    for chunk in read_chunks(path, _HEADER, (*known, "note"), PIXELS, extras=extras, at_once=at_once):
        values = chunk.numbers(PIXELS)
        if values is None:
            values = np.array([_four_pixels(row, single) for row in chunk.rows()])
        others = {name: cells for name, cells in chunk.columns.items() if name not in known}
        yield MarkChunk(chunk.names, torch.from_numpy(values).view(-1, 2, 2), others, chunk.bytes_read)


def write_marks(path: str | Path, marks: Marks) -> Path:
    """Write marks as `read_marks` reads them, exact to the last bit.

    Raises:
        FileError: the file cannot be written.
    """
    rows = zip(marks.names, marks.left.tolist(), marks.right.tolist(), strict=True)
    lines = [_HEADER, *(",".join([name, *map(repr, (*left, *right))]) for name, left, right in rows)]
    return write_atomic(path, "\n".join(lines) + "\n")


def _four_pixels(row: TableRow, single: bool) -> list[float]:
    return [*pixel_of(row, "left", single), *pixel_of(row, "right", single)]


def pixel_of(row: TableRow, side: str, optional: bool) -> tuple[float, float]:
    """The pixel in the columns `side`_u and `side`_v; NaN where both are empty and may be."""
    columns = (f"{side}_u", f"{side}_v")
    if optional and not any(row.cells[column] for column in columns):
        other = "right" if side == "left" else "left"
        if not row.cells[f"{other}_u"]:
            raise FileError(f"{row.where}: neither image has a mark; delete the line")
        return math.nan, math.nan
    return row.number(columns[0], _PIXEL), row.number(columns[1], _PIXEL)
