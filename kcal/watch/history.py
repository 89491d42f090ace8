"""Tables that grow while they are read: the history of a watched rig, and temperatures."""

from __future__ import annotations

import bisect
import csv
import math
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.errors import FileError, InputError
from kcal.texts import csv_line, unix_seconds
from kcal.watch.state import Look

# Lines of a text file that another process writes, as they become whole.


class GrowingFile:
    """Read what has been added since the last time.

    Args:
        path: of the file.
    """

    def __init__(self, path: str | Path) -> None:
        self.path, self.number, self._offset = path, 0, 0

    def lines(self) -> Iterator[str]:
        """The whole lines that have come, without their ends; `number` is that of the line, from 1.

        Raises:
            FileError: the file cannot be read.
        """
        try:
            with open(self.path, "rb") as file:
                file.seek(self._offset)
                for line in file:
                    # One that is still being written is left out.
                    if not line.endswith(b"\n"):
                        break
                    self._offset += len(line)
                    self.number += 1
                    yield line.decode("utf-8-sig" if self.number == 1 else "utf-8", "replace").rstrip("\r\n")
        except OSError as error:
            raise FileError(f"{self.path}: cannot read: {error.strerror or error}") from error


# The history of a watched rig as a growing CSV file: what each look measured, and what it made of it.

_ANGLES = ("pitch", "yaw", "roll")
_SIDES = ("left", "right")
_TOLD = (*(f"relative_{name}_deg" for name in _ANGLES), *(f"relative_{name}_sigma_deg" for name in _ANGLES))
_TURN = tuple(f"{side}_{name}_deg" for side in _SIDES for name in _ANGLES)
_BETWEEN = tuple(f"between_{k}_deg" for k in range(5))


def _upper(size: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(size) for j in range(i, size)]


_TURN_COVARIANCE = tuple(f"{side}_cov_{i}{j}_deg2" for side in _SIDES for i, j in _upper(3))
_BETWEEN_COVARIANCE = tuple(f"between_cov_{i}{j}_deg2" for i, j in _upper(5))
COLUMNS = (
    "time", "rig", *_TOLD, "left_features", "right_features", "matches", "lasting", "temperature_c",
    *_TURN, *_TURN_COVARIANCE, *_BETWEEN, *_BETWEEN_COVARIANCE, "note",
)  # fmt: skip
# Rows that are kept of a file: two weeks of a look a minute.
MOST_ROWS = 20_000


class HistoryRow(NamedTuple):
    """One look.

    Attributes:
        time: seconds, of the left image.
        look: what was measured; its `kelvin` is counted from the first temperature of the history.
        features: in the left and the right image.
        matches: between the images.
        temperature: °C, NaN where nobody measured it.
        note: what was found besides.
    """

    time: float
    look: Look
    features: tuple[int, int] = (0, 0)
    matches: int = 0
    temperature: float = math.nan
    note: str = ""


def no_look() -> Look:
    """Nothing was seen."""
    zero = torch.zeros(6, dtype=torch.float64)
    return Look(
        turn=zero, covariance=torch.eye(6, dtype=torch.float64), lasting=zero[0], seen=torch.zeros(2, dtype=torch.bool),
        between=zero[:5], between_covariance=torch.eye(5, dtype=torch.float64), matched=torch.tensor(False),
        kelvin=zero[0],
    )  # fmt: skip


def history_line(row: HistoryRow, fingerprint: str, told: tuple[Tensor, Tensor]) -> str:
    """A line of the file; `told` is the relative turn (3,) of the moment and its sigma (3,), radians."""
    look, degrees = row.look, math.degrees(1.0)
    cells: list[object] = [row.time, fingerprint, *(degrees * torch.cat(told)).tolist(), *row.features, row.matches]
    cells += [float(look.lasting), None if math.isnan(row.temperature) else row.temperature]
    seen = look.seen.tolist()
    for side in (0, 1):
        cells += (degrees * look.turn[3 * side : 3 * side + 3]).tolist() if seen[side] else [None] * 3
    for side in (0, 1):
        block = degrees**2 * look.covariance[3 * side : 3 * side + 3, 3 * side : 3 * side + 3]
        cells += [float(block[i, j]) for i, j in _upper(3)] if seen[side] else [None] * 6
    if bool(look.matched):
        cells += (degrees * look.between).tolist()
        cells += [degrees**2 * float(look.between_covariance[i, j]) for i, j in _upper(5)]
    else:
        cells += [None] * 20
    return csv_line([*cells, row.note])


def history_head() -> str:
    """The first line of the file."""
    return csv_line(COLUMNS)


class HistoryTail:
    """The rows of a history that grows, as far as they are whole.

    Args:
        path: of the file.
        fingerprint: of the rig that was watched.
    """

    def __init__(self, path: str | Path, fingerprint: str) -> None:
        self._file, self._fingerprint, self._first = GrowingFile(path), fingerprint, math.nan
        self._kelvin: Tensor | None = None

    def rows(self, since: float = -math.inf, until: float = math.inf) -> list[HistoryRow]:
        """The rows that have come since the last call: the last `MOST_ROWS` between two times.

        Raises:
            FileError: no such file, no history, one of another rig, or a damaged line.
        """
        rows: deque[HistoryRow] = deque(maxlen=MOST_ROWS)
        for line in self._file.lines():
            row = self._row(line)
            if row is not None and since <= row.time <= until:
                rows.append(row)
        if self._file.number == 0:
            raise FileError(f"{self._file.path}: no rows yet: let `kcal watch` look at the scene first")
        return list(rows)

    def _row(self, line: str) -> HistoryRow | None:
        cells = next(csv.reader([line]), [])
        if self._file.number == 1:
            if tuple(cells) != COLUMNS:
                raise FileError(f"{self._file.path}: not a history of this version of `kcal watch`")
            return None
        row = parsed_row(f"{self._file.path}: line {self._file.number}", cells, self._fingerprint)
        self._first = row.temperature if math.isnan(self._first) else self._first
        row = warmed(row, self._first, self._kelvin)
        self._kelvin = row.look.kelvin
        return row


def read_history(
    path: str | Path, fingerprint: str, *, since: float = -math.inf, until: float = math.inf
) -> list[HistoryRow]:
    """The rows between two times; see `HistoryTail`."""
    return HistoryTail(path, fingerprint).rows(since, until)


def warmed(row: HistoryRow, first: float, before: Tensor | None) -> HistoryRow:
    """The row with kelvin since the `first` temperature; what nobody measured stays as it was `before`."""
    kelvin = torch.tensor(row.temperature - first, dtype=torch.float64)
    if math.isnan(float(kelvin)):
        kelvin = torch.zeros_like(kelvin) if before is None else before
    return row._replace(look=row.look._replace(kelvin=kelvin))


def parsed_row(where: str, cells: Sequence[str], fingerprint: str) -> HistoryRow:
    """A row of its cells.

    Raises:
        FileError: a damaged row, or one of another rig.
    """
    if len(cells) != len(COLUMNS):
        raise FileError(f"{where}: {len(cells)} cells, not {len(COLUMNS)}: the file is damaged; remove that line")
    by_name = dict(zip(COLUMNS, cells, strict=True))
    if by_name["rig"] != fingerprint:
        raise FileError(
            f"{where}: the history is of another rig ({by_name['rig']}, not {fingerprint}); give the rig file that "
            "was watched, or begin a new history"
        )

    def numbers(names: Sequence[str]) -> Tensor:
        values = [float(by_name[name]) for name in names]
        if not all(map(math.isfinite, values)):
            raise ValueError("not finite")
        return torch.tensor(values, dtype=torch.float64)

    try:
        look, radian = no_look(), math.radians(1.0)
        turn, covariance, seen = look.turn.clone(), look.covariance.clone(), look.seen.clone()
        for side in (0, 1):
            if by_name[_TURN[3 * side]]:
                part = slice(3 * side, 3 * side + 3)
                turn[part] = radian * numbers(_TURN[part])
                covariance[part, part] = radian**2 * _from_upper(numbers(_TURN_COVARIANCE[6 * side : 6 * side + 6]), 3)
                seen[side] = True
        look = look._replace(turn=turn, covariance=covariance, seen=seen, lasting=numbers(["lasting"])[0])
        if by_name[_BETWEEN[0]]:
            look = look._replace(
                between=radian * numbers(_BETWEEN),
                between_covariance=radian**2 * _from_upper(numbers(_BETWEEN_COVARIANCE), 5),
                matched=torch.tensor(True),
            )
        warm = by_name["temperature_c"]
        return HistoryRow(
            float(numbers(["time"])[0]), look, (int(by_name["left_features"]), int(by_name["right_features"])),
            int(by_name["matches"]), float(numbers(["temperature_c"])[0]) if warm else math.nan, by_name["note"],
        )  # fmt: skip
    except ValueError as error:
        raise FileError(f"{where}: a number is damaged ({error}); remove that line") from error


def _from_upper(upper: Tensor, size: int) -> Tensor:
    matrix = torch.zeros(size, size, dtype=torch.float64)
    for (i, j), value in zip(_upper(size), upper, strict=True):
        matrix[i, j] = matrix[j, i] = value
    if not bool(torch.linalg.eigvalsh(matrix)[0] > 0):
        raise ValueError("a covariance is not positive definite")
    return matrix


# Temperatures from a table (time,temperature) that may grow while it is read.

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
