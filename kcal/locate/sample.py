"""Count the rows of a long table, and keep some of them for tables on a screen, pictures and maps."""

from __future__ import annotations

import dataclasses
from collections.abc import Set as AbstractSet

import numpy as np

from kcal.locate.columns import PositionColumns
from kcal.locate.positions import Located, Position, located_by, positions_of
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
        self._kept: dict[int, Position] = {}
        self.count = 0
        self._statuses = np.zeros(len(PositionStatus), dtype=np.int64)

    def add(self, columns: PositionColumns) -> None:
        """Count the next rows, and keep some."""
        numbers = np.arange(self.count, self.count + len(columns.names))
        self.count += len(numbers)
        self._statuses += np.bincount(columns.status, minlength=len(self._statuses))
        while self.count > self._stride * self._most:
            self._stride *= 2
        kept = self._kept.items()
        self._kept = {i: known for i, known in kept if i % self._stride == 0 or known.name in self._named}
        wanted = numbers % self._stride == 0
        if self._named:
            wanted |= np.array([name in self._named for name in columns.names])
        which = np.flatnonzero(wanted)
        self._kept.update(zip(numbers[which].tolist(), positions_of(columns.rows(which)), strict=True))

    @property
    def statuses(self) -> dict[str, int]:
        """How many rows have each status; the ones that occur."""
        return {status.name.lower(): int(self._statuses[status]) for status in PositionStatus if self._statuses[status]}

    def located(self, locate: Locator) -> Located:
        """What was kept, in the order of the table."""
        found = located_by(locate, tuple(self._kept.values()))
        return found if len(self._kept) == self.count else dataclasses.replace(found, rows=self.count)
