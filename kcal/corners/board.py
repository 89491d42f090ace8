"""Describe a calibration board: its inner corners, the size of its squares, its markers."""

from __future__ import annotations

import re

import pydantic
import torch
from torch import Tensor

from kcal.errors import InputError

# Markers in OpenCV's dictionaries, by name.
DICTIONARIES = {
    f"{bits}x{bits}_{count}": count for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)
}  # fmt: skip
_DEFAULT_DICTIONARY, _MARKER_SHARE = "4x4_50", 0.7
_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}


class Board(pydantic.BaseModel):
    """A checkerboard, described by its inner corners.

    Convention: corner `row * columns + column` lies at `(column * square, row * square, 0)` meters. x runs along a
    row, y down the columns, z into the board, away from a camera in front of it. The square diagonally outside
    corner 0 is dark.

    Args:
        columns: inner corners in a row (one less than the squares).
        rows: inner corners in a column.
        square: side of a square in meters.
        dictionary: of a ChArUco board, the name of OpenCV's dictionary (`4x4_50`) whose markers lie in the light
            squares, numbered row by row; None for a plain checkerboard.
        marker: side of a marker in meters, of a ChArUco board.

    Example:
        >>> Board(columns=9, rows=6, square=0.025).points.shape
        torch.Size([54, 3])
    """

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    columns: int = pydantic.Field(ge=2, le=500)
    rows: int = pydantic.Field(ge=2, le=500)
    square: float = pydantic.Field(gt=0)
    dictionary: str | None = None
    marker: float | None = pydantic.Field(default=None, gt=0)

    @pydantic.model_validator(mode="after")
    def _markers(self) -> Board:
        if (self.dictionary is None) != (self.marker is None):
            raise ValueError("a ChArUco board has a dictionary and a marker size, a checkerboard neither")
        if self.dictionary is None or self.marker is None:
            return self
        if self.dictionary not in DICTIONARIES:
            raise ValueError(f"dictionary {self.dictionary!r}: choose one of {', '.join(DICTIONARIES)}")
        needed = (self.columns + 1) * (self.rows + 1) // 2
        if needed > DICTIONARIES[self.dictionary]:
            raise ValueError(f"the board needs {needed} markers, dictionary {self.dictionary} fewer")
        if not self.marker < self.square:
            raise ValueError("a marker must be smaller than its square")
        return self

    @classmethod
    def parse(cls, size: str, square: str) -> Board:
        """Read `"9x6"` (inner corners, columns by rows) and `"25mm"` (units: mm, cm, m, in).

        A ChArUco board is `"charuco:9x6"`. `"charuco:9x6:5x5_100"` names a dictionary other than 4x4_50, and
        `"charuco:9x6:5x5_100:15mm"` markers other than 0.7 of the square.

        Raises:
            InputError: a size or a length that cannot be read, or a length without its unit.

        Example:
            >>> Board.parse("9x6", "25mm").square
            0.025
            >>> Board.parse("charuco:9x6:5x5_100:15mm", "20mm").marker
            0.015
        """
        kind, _, rest = size.strip().rpartition("charuco:")
        if not kind and rest != size.strip():
            return cls._charuco(rest, square)
        match = re.fullmatch(r"\s*(\d+)\s*[xX×]\s*(\d+)\s*", size)
        if not match:
            raise InputError(f"board {size!r}: write inner corners as COLUMNSxROWS, for example 9x6")
        side = _parse_length("square", square)
        columns, rows = int(match.group(1)), int(match.group(2))
        if not (2 <= columns <= 500 and 2 <= rows <= 500):
            raise InputError(f"board {size!r}: 2 to 500 inner corners each way are needed")
        return cls(columns=columns, rows=rows, square=side)

    @classmethod
    def _charuco(cls, text: str, square: str) -> Board:
        size, *more = text.split(":")
        if len(more) > 2:
            raise InputError(f"board 'charuco:{text}': write charuco:COLUMNSxROWS[:DICTIONARY[:MARKER]]")
        plain = cls.parse(size, square)
        dictionary = more[0].lower().removeprefix("dict_") if more else _DEFAULT_DICTIONARY
        marker = _parse_length("marker", more[1]) if len(more) > 1 else _MARKER_SHARE * plain.square
        try:
            return cls(
                columns=plain.columns, rows=plain.rows, square=plain.square, dictionary=dictionary, marker=marker
            )
        except pydantic.ValidationError as error:
            why = error.errors()[0]["msg"].removeprefix("Value error, ")
            raise InputError(f"board 'charuco:{text}': {why}") from error

    @property
    def corners(self) -> int:
        """Number of inner corners."""
        return self.columns * self.rows

    @property
    def points(self) -> Tensor:
        """Corner positions on the flat board, (corners, 3) float64 meters, row by row."""
        rows, columns = (torch.arange(count, dtype=torch.float64) for count in (self.rows, self.columns))
        yx = torch.cartesian_prod(rows, columns)
        return torch.nn.functional.pad(yx.flip(-1), (0, 1)) * self.square

    @property
    def unambiguous(self) -> bool:
        """Whether the board differs from itself turned by 180°: it has markers, or one count is odd and one even."""
        return self.dictionary is not None or (self.columns + self.rows) % 2 == 1

    def __str__(self) -> str:
        plain = f"{self.columns}x{self.rows} inner corners, {self.square * 1000:g} mm squares"
        return plain if self.marker is None else f"{plain}, {self.marker * 1000:g} mm markers {self.dictionary}"


def _parse_length(name: str, text: str) -> float:
    """A text such as `25mm` in meters."""
    length = re.fullmatch(r"\s*([0-9.]+(?:[eE][-+]?\d+)?)\s*([a-z]*)\s*", text)
    try:
        value = float(length.group(1)) if length else float("nan")
    except ValueError:
        value = float("nan")
    if length is None or not value > 0 or length.group(2) not in _UNITS:
        raise InputError(f"{name} {text!r}: write a length with its unit (mm, cm, m, in), for example 25mm")
    # Division by the exact inverse keeps 25 mm at 0.025 to the last bit.
    unit = _UNITS[length.group(2)]
    return value / round(1 / unit) if unit in (1e-3, 1e-2) else value * unit
