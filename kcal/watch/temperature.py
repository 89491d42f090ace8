"""Temperatures from a table (time,temperature) that may grow while it is read."""

from __future__ import annotations

import bisect
import math
from pathlib import Path

from kcal.errors import FileError, InputError
from kcal.texts import unix_seconds
from kcal.watch.growing_file import GrowingFile

# Seconds beyond which the nearest temperature is not that of a moment.
_NEAR = 3600.0
_KEPT = 100_000


def seconds_of(text: str) -> float:
    """Unix seconds of a number or of an ISO time with its zone.

    Raises:
        InputError: neither.

    Example:
        >>> seconds_of("12.5"), seconds_of("1970-01-01T00:01:00Z")
        (12.5, 60.0)
    """
    value = unix_seconds(text)
    if not math.isfinite(value):
        raise InputError(f"time {text!r}: write seconds, or a time with its zone: 2026-05-01T12:00:00Z")
    return value


class Temperatures:
    """Temperatures of a growing file with the columns time and temperature (°C).

    Args:
        path: of the file.

    Raises:
        FileError: no such file, or other columns.
    """

    def __init__(self, path: Path) -> None:
        self._file = GrowingFile(path)
        self._times: list[float] = []
        self._values: list[float] = []
        self._columns: list[str] = []
        self._take_all()
        if not {"time", "temperature"} <= set(self._columns):
            raise FileError(f"{path}: the columns time and temperature are needed")

    def at(self, time: float) -> float:
        """°C at a moment, between the two nearest; NaN where the nearest is more than an hour away.

        Raises:
            FileError: a damaged line.
        """
        self._take_all()
        k = bisect.bisect_right(self._times, time)
        around = [i for i in (k - 1, k) if 0 <= i < len(self._times) and abs(self._times[i] - time) <= _NEAR]
        if len(around) < 2:
            return self._values[around[0]] if around else math.nan
        first, second = around
        share = (time - self._times[first]) / (self._times[second] - self._times[first])
        return (1.0 - share) * self._values[first] + share * self._values[second]

    def _take_all(self) -> None:
        for line in self._file.lines():
            self._take(line.strip())

    def _take(self, line: str) -> None:
        cells = [cell.strip() for cell in line.split(",")]
        if not self._columns:
            self._columns = cells
            return
        if not line or not {"time", "temperature"} <= set(self._columns):
            return
        try:
            row = dict(zip(self._columns, cells, strict=True))
            time, value = seconds_of(row["time"]), float(row["temperature"])
            if not -100.0 < value < 150.0:
                raise InputError(f"temperature {value:g}: °C are needed")
        except (ValueError, InputError) as error:
            raise FileError(f"{self._file.path}: line {self._file.number}: {error}") from error
        if self._times and time <= self._times[-1]:
            return
        self._times.append(time)
        self._values.append(value)
        if len(self._times) > _KEPT:
            del self._times[: _KEPT // 2], self._values[: _KEPT // 2]
