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
from kcal.locate.tables import CHUNK_ROWS, TableChunk, TableRow, guarded, read_chunks
from kcal.texts import brief, csv_line

PIXELS = ("left_u", "left_v", "right_u", "right_v")
# The ten entries of a pair's covariance (left_u, left_v, right_u, right_v) on and above its diagonal, row by row.
_UPPER = tuple((i, j) for i in range(4) for j in range(i, 4))
COVARIANCE = tuple(f"cov_{i}{j}" for i, j in _UPPER)
_HEADER = f"name,{','.join(PIXELS)}"
_PIXEL = "a pixel coordinate"
# px: a survey's and a lens's errors are not smaller, whatever marks say of themselves.
_LEAST_SIGMA = 0.05


class Marks(NamedTuple):
    """The same things marked in both images.

    Attributes:
        names: one for each pair, unique; the row's number where the file has no names.
        left: (N, 2) float64 pixels in the left image, integer coordinates at pixel centers.
        right: (N, 2) likewise in the right image.
        covariance: (N, 4, 4) px² of each pair's four coordinates, NaN where the file has none; None if it has none at
            all.
    """

    names: tuple[str, ...]
    left: Tensor
    right: Tensor
    covariance: Tensor | None = None

    @property
    def pixels(self) -> Tensor:
        """(N, 2, 2): both images."""
        return torch.stack([self.left, self.right], 1)

    def covariance_or(self, sigma: float) -> Tensor | None:
        """See `filled`."""
        return filled(self.covariance, sigma)

    def sigmas(self, sigma: float) -> Tensor:
        """(N, 2) standard deviation of each mark along an axis, px: `sigma` where none is stated, NaN without a mark.

        Example:
            >>> one = Marks(("a",), torch.tensor([[10.0, 20.0]]), torch.full((1, 2), torch.nan))
            >>> one.sigmas(0.3).tolist()
            [[0.3, nan]]
        """
        variance = torch.full((len(self.names), 2), sigma**2, dtype=torch.float64)
        if self.covariance is not None:
            stated = self.covariance.diagonal(dim1=-2, dim2=-1).unflatten(-1, (2, 2)).mean(-1)
            variance = torch.where(stated.isfinite(), stated, variance)
        return torch.where(self.pixels.isfinite().all(-1), variance.sqrt().clamp_min(_LEAST_SIGMA), math.nan)

    def typical_sigma(self, sigma: float) -> float:
        """The root mean square of `sigmas`, px; marks that are missing do not count. Without any: `sigma`."""
        found = self.sigmas(sigma)
        known = found[found.isfinite()]
        return float(known.square().mean().sqrt()) if len(known) else sigma

    def __repr__(self) -> str:
        return brief(self)


def filled(covariance: Tensor | None, sigma: float) -> Tensor | None:
    """(N, 4, 4) a covariance as in `Marks`, with `sigma` px along each axis where there is none; None: none at all.

    Example:
        >>> filled(torch.full((1, 4, 4), torch.nan), 0.5)[0, 0].tolist()
        [0.25, 0.0, 0.0, 0.0]
    """
    if covariance is None:
        return None
    known = torch.isfinite(covariance).all(-1).all(-1)[:, None, None]
    return torch.where(known, covariance.double(), sigma**2 * torch.eye(4, dtype=torch.float64))


def read_marks(path: str | Path, *, single: bool = False) -> Marks:
    r"""Read a comma-separated file with the header `name,left_u,left_v,right_u,right_v`.

    Columns may come in any order; `name` may be absent (rows are then numbered from 1) and a column `note` is allowed
    and not used. Blank lines are skipped, and a byte order mark at the beginning is accepted. Pixels may lie outside
    the image: `locate_points` reports such a pair. The columns `cov_00`, `cov_01` ... `cov_33` may contain a pair's
    covariance, as `kcal mark` writes it: all ten, or all empty.

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
    covariance = None
    if any(chunk.covariance is not None for chunk in chunks):
        unknown = torch.full((4, 4), math.nan, dtype=torch.float64)
        parts = [
            unknown.expand(len(chunk.names), 4, 4) if chunk.covariance is None else chunk.covariance for chunk in chunks
        ]
        covariance = torch.cat(parts)
    return Marks(names=names, left=pixels[:, 0], right=pixels[:, 1], covariance=covariance)


class MarkChunk(NamedTuple):
    """Some consecutive pairs of marks of a long table.

    Attributes:
        names: as in `Marks`.
        pixels: (N, 2, 2) float64: both images.
        covariance: as in `Marks`.
        extras: the cells of all other columns, as they are written.
        bytes_read: how far the file has been read.
    """

    names: Sequence[str]
    pixels: Tensor
    covariance: Tensor | None
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
    known = ("name", *PIXELS, *COVARIANCE)
    for chunk in read_chunks(path, _HEADER, (*known, "note"), PIXELS, extras=extras, at_once=at_once):
        values = chunk.numbers(PIXELS)
        if values is None:
            values = np.array([_four_pixels(row, single) for row in chunk.rows()])
        others = {name: cells for name, cells in chunk.columns.items() if name not in known}
        pixels = torch.from_numpy(values).view(-1, 2, 2)
        yield MarkChunk(chunk.names, pixels, _covariances_of(chunk), others, chunk.bytes_read)


def write_marks(path: str | Path, marks: Marks) -> Path:
    """Write marks as `read_marks` reads them, exact to the last bit.

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
