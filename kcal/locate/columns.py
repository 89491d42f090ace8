"""Located pairs column by column: what files and tables are made of, without an object for each row."""

from __future__ import annotations

import itertools
import sys
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import orjson
from numpy.typing import NDArray

from kcal.texts import brief

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


class PositionColumns(NamedTuple):
    """Located pairs, column by column.

    Attributes:
        names: one for each pair.
        status: (N,) codes of `PositionStatus`.
        reasons: empty, or why there is no position, or a warning.
        numbers: (N, 24) float64, the columns `NUMBERS`; NaN where unknown, and `range_high_m` may be infinite.
        extras: the cells of further columns of the table of marks, by name.
    """

    names: Sequence[str]
    status: NDArray[np.int8]
    reasons: Sequence[str]
    numbers: NDArray[np.float64]
    extras: dict[str, list[str]]

    def column(self, name: str) -> NDArray[np.float64]:
        """(N,) one of the numbers."""
        return self.numbers[:, NUMBERS.index(name)]

    def rows(self, which: NDArray[np.intp]) -> PositionColumns:
        """Some of the pairs."""
        places = which.tolist()
        return PositionColumns(
            [self.names[i] for i in places],
            self.status[which],
            [self.reasons[i] for i in places],
            self.numbers[which],
            {name: [cells[i] for i in places] for name, cells in self.extras.items()},
        )

    def pieces(self, size: int) -> Iterator[PositionColumns]:
        """The same rows in turn, `size` at a time."""
        for start in range(0, len(self.names), size):
            part = slice(start, start + size)
            extras = {name: cells[part] for name, cells in self.extras.items()}
            yield PositionColumns(self.names[part], self.status[part], self.reasons[part], self.numbers[part], extras)

    @classmethod
    def joined(cls, parts: Sequence[PositionColumns]) -> PositionColumns:
        """The rows of some columns, one after the other, with the further columns of the first."""
        if not parts:
            return cls((), np.zeros(0, np.int8), (), np.zeros((0, len(NUMBERS))), {})
        names, status, reasons, numbers, extras = zip(*parts, strict=True)
        return cls(
            [*itertools.chain(*names)], np.concatenate(status), [*itertools.chain(*reasons)], np.concatenate(numbers),
            {name: [*itertools.chain(*(each[name] for each in extras))] for name in extras[0]},
        )  # fmt: skip

    @property
    def located(self) -> NDArray[np.bool_]:
        """(N,) which pairs have a position."""
        return np.isfinite(self.numbers[:, 0])

    def __repr__(self) -> str:
        return brief(self)


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
