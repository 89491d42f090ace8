"""Count the rows of a long table, and keep some of them for tables on a screen, pictures and maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Set as AbstractSet

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.locate.columns import PositionColumns
from kcal.locate.positions import Located, located_by
from kcal.locate.station_positions import ViewsLocator
from kcal.locate.stereo import PositionStatus
from kcal.locate.tabulate import Locator

# More than anybody reads, and few enough for a picture and a page.
SAMPLE_ROWS = 1000


class PositionSample:
    """Evenly spaced rows, at most `most` of them, whatever the chunks; tables no longer than that are kept whole.

    Args:
        named: names whose rows are kept besides.
        most: how many others at most.
    """

    def __init__(self, named: AbstractSet[str] = frozenset(), most: int = SAMPLE_ROWS) -> None:
        self._named, self._most = named, most
        self._stride = 1
        self._numbers, self._kept = np.zeros(0, dtype=np.int64), PositionColumns.joined([])
        self._feet = torch.zeros(0, 3, dtype=torch.float64)
        self.count = 0
        self._statuses = np.zeros(len(PositionStatus), dtype=np.int64)

    def add(self, columns: PositionColumns, feet: Tensor | None = None) -> None:
        """Count the next rows, and keep some, with where their bearings count from, (N, 3), of several cameras."""
        numbers = np.arange(self.count, self.count + len(columns.names))
        self.count += len(numbers)
        self._statuses += np.bincount(columns.status, minlength=len(self._statuses))
        while self.count > self._stride * self._most:
            self._stride *= 2
        parts = [self._wanted(self._numbers, self._kept), self._wanted(numbers, columns._replace(extras={}))]
        if feet is not None:
            whole = torch.cat([self._feet, feet])
            self._feet = whole[np.isin(np.concatenate([self._numbers, numbers]), [*parts[0][0], *parts[1][0]])]
        self._numbers = np.concatenate([which for which, _ in parts])
        self._kept = PositionColumns.joined([rows for _, rows in parts])

    def _wanted(
        self, numbers: NDArray[np.int64], columns: PositionColumns
    ) -> tuple[NDArray[np.int64], PositionColumns]:
        wanted = numbers % self._stride == 0
        if self._named:
            wanted |= np.array([name in self._named for name in columns.names], dtype=bool)
        return numbers[wanted], columns.rows(np.flatnonzero(wanted))

    @property
    def statuses(self) -> dict[str, int]:
        """How many rows have each status; the ones that occur."""
        return {status.name.lower(): int(self._statuses[status]) for status in PositionStatus if self._statuses[status]}

    def located(self, locate: Locator | ViewsLocator) -> Located:
        """What was kept, in the order of the table."""
        if isinstance(locate, ViewsLocator):
            found = locate.located(self._kept, self._feet)
        else:
            found = located_by(locate, self._kept)
        return found if len(self._numbers) == self.count else dataclasses.replace(found, rows=self.count)
