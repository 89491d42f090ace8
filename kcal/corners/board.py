"""Calibration boards: how many inner corners, how large, and where each one lies."""

from __future__ import annotations

import re

import pydantic
import torch
from torch import Tensor

from kcal.errors import InputError

_UNITS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "in": 0.0254}


class Board(pydantic.BaseModel):
    """A checkerboard, described by its inner corners.

    Convention: corner `row * columns + column` lies at `(column * square, row * square, 0)` metres; x runs along a
    row, y down the columns, z into the board, so that a board seen from its front has z pointing away from the
    camera. The square diagonally outside corner 0 is black (dark).

    Args:
        columns: inner corners in a row (one less than the squares).
        rows: inner corners in a column.
        square: side of a square in metres.

    Example:
        >>> Board(columns=9, rows=6, square=0.025).points.shape
        torch.Size([54, 3])
    """

    model_config = pydantic.ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    columns: int = pydantic.Field(ge=2, le=500)
    rows: int = pydantic.Field(ge=2, le=500)
    square: float = pydantic.Field(gt=0)

    @classmethod
    def parse(cls, size: str, square: str) -> Board:
        """Read `"9x6"` (inner corners, columns by rows) and `"25mm"` (units: mm, cm, m, in).

        Raises:
            InputError: a size or a length that cannot be read, or a length without its unit.

        Example:
            >>> Board.parse("9x6", "25mm").square
            0.025
        """
        match = re.fullmatch(r"\s*(\d+)\s*[xX×]\s*(\d+)\s*", size)
        if not match:
            raise InputError(f"board {size!r}: write inner corners as COLUMNSxROWS, for example 9x6")
        length = re.fullmatch(r"\s*([0-9.]+(?:[eE][-+]?\d+)?)\s*([a-z]*)\s*", square)
        try:
            value = float(length.group(1)) if length else float("nan")
        except ValueError:
            value = float("nan")
        if length is None or not value > 0 or length.group(2) not in _UNITS:
            raise InputError(f"square {square!r}: write a length with its unit (mm, cm, m, in), for example 25mm")
        columns, rows = int(match.group(1)), int(match.group(2))
        if not (2 <= columns <= 500 and 2 <= rows <= 500):
            raise InputError(f"board {size!r}: 2 to 500 inner corners each way are needed")
        # Division by the exact inverse keeps 25 mm at 0.025 to the last bit.
        unit = _UNITS[length.group(2)]
        metres = value / round(1 / unit) if unit in (1e-3, 1e-2) else value * unit
        return cls(columns=columns, rows=rows, square=metres)

    @property
    def corners(self) -> int:
        """How many inner corners the board has."""
        return self.columns * self.rows

    @property
    def points(self) -> Tensor:
        """Corner positions on the flat board, (corners, 3) float64 metres, row by row."""
        y, x = torch.meshgrid(
            torch.arange(self.rows, dtype=torch.float64),
            torch.arange(self.columns, dtype=torch.float64),
            indexing="ij",
        )
        return torch.stack([x.reshape(-1), y.reshape(-1), torch.zeros(self.corners, dtype=torch.float64)], -1) * (
            self.square
        )

    @property
    def unambiguous(self) -> bool:
        """Whether the colours tell the board from itself turned by 180° (one count odd, the other even)."""
        return (self.columns + self.rows) % 2 == 1

    def __str__(self) -> str:
        return f"{self.columns}x{self.rows} inner corners, {self.square * 1000:g} mm squares"
