"""How the cameras of a rig turn over time: model, filter, smoother, and tables that grow while they are read."""

from __future__ import annotations

import bisect
import csv
import dataclasses
import io
import math
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.checks import chi2_quantile
from kcal.errors import FileError, InputError, with_extra
from kcal.files import read_bytes, write_atomic
from kcal.lens.rig import Rig
from kcal.texts import csv_line, unix_seconds

# How the cameras of a rig turn over time, and how that is learned from what was measured (maximum likelihood).
#
# Each camera turns by three angles, left before right: pitch, yaw, roll, in radians about its own axes, counted from
# the time of the reference. Each angle is a random walk that returns to its mean (an Ornstein-Uhlenbeck process:
# masts bend with the sun and go back), plus a turn for each kelvin where temperatures are known, plus a part that has
# another value at every measurement (wind). Beyond the noise of a measurement, patches change with light and shade:
# that error lasts for hours.

# Seconds that light and shade last.
LASTING_S = 7200.0
# Radians per kelvin of an angle: 1 K across a steel beam of 10 m bends it by 0.6 mrad; brackets do a hundredth of that.
HEAT_SIGMA = 1e-5
# What is assumed of swing (radians), return (seconds) and wind (radians), and by which factors it may differ.
_USUAL = (math.radians(0.003), 6 * 3600.0, math.radians(0.0005))
_FACTOR = math.log(5.0)
_LEAST, _MOST = (1e-7, 300.0, 1e-8), (0.05, 3e7, 0.01)
# Rows that are enough to learn from, and the most that are read.
FEWEST, MOST_LEARNT = 60, 1500
# Standard deviations beyond which a measurement is left out of the likelihood.
_OUTLIER = 5.0


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class TurnModel:
    """What is known of the motion of the six angles before anything is measured.

    Args:
        swing: (..., 6) radians, standard deviation of the part that changes slowly.
        return_s: (..., 6) seconds in which it goes back by 1 - 1/e; a random walk where that is long.
        gust: (..., 6) radians, standard deviation of what has another value at every measurement.
    """

    swing: Tensor
    return_s: Tensor
    gust: Tensor

    @classmethod
    def usual(cls) -> TurnModel:
        """What is assumed before enough was measured."""
        swing, back, gust = torch.tensor(_USUAL, dtype=torch.float64)[:, None].expand(3, 6)
        return cls(swing=swing, return_s=back, gust=gust)


class AngleSeries(NamedTuple):
    """One angle at T measurements, for K angles: what `learned` reads.

    Attributes:
        time: (T,) seconds.
        angle: (T, K) radians, NaN where it was not measured.
        variance: (T, K) of its noise that is new at each measurement.
        lasting: (T, K) variance of what lasts.
        kelvin: (T, K) of warming since the reference; zeros where nobody measured it.
    """

    time: NDArray[np.float64]
    angle: NDArray[np.float64]
    variance: NDArray[np.float64]
    lasting: NDArray[np.float64]
    kelvin: NDArray[np.float64]


def learned(series: AngleSeries) -> TurnModel:
    """The most likely model of K angles; what is usual counts where the measurements tell little.

    Measurements are thinned to some thousand, evenly; a compass search goes over the logarithms of the three numbers.
    """
    rows = np.flatnonzero(np.isfinite(series.angle).any(1))
    if len(rows) < FEWEST:
        return TurnModel.usual()
    rows = rows[-MOST_LEARNT:] if len(rows) <= 2 * MOST_LEARNT else rows[:: len(rows) // MOST_LEARNT]
    part = AngleSeries(*(values[rows] for values in series))
    usual, count = np.log(_USUAL), part.angle.shape[1]
    low, high = np.log(_LEAST), np.log(_MOST)
    best = np.repeat(usual[:, None], count, 1)
    step = np.full(count, 1.5)
    moves = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    for _ in range(24):
        tried = np.clip(best[None] + moves[:, :, None] * step, low[:, None], high[:, None])
        prior = -0.5 * (((tried - usual[:, None]) / _FACTOR) ** 2).sum(1)
        value = _log_likelihood(part, np.exp(tried)) + prior
        first = value.argmax(0)
        best = tried[first, :, np.arange(count)].T
        step = np.where(first == 0, 0.5 * step, step)
        if step.max() < 0.1:
            break
    swing, back, gust = torch.from_numpy(np.exp(best))
    # The sun moves masts smoothly, which looks say is slow; how far they go is what was seen: 95 % of it, as of a sine.
    far = np.nanquantile(np.abs(part.angle), 0.95, axis=0) / math.sqrt(2.0)
    swing = torch.maximum(swing, torch.from_numpy(far))
    return TurnModel(swing=swing, return_s=back, gust=gust)


def _log_likelihood(series: AngleSeries, tried: NDArray[np.float64]) -> NDArray[np.float64]:
    """(C, K) of C candidates (C, 3, K), by a Kalman filter of slow part, lasting error and turn per kelvin."""
    swing, back, gust = tried.swapaxes(0, 1)
    shape = swing.shape
    mean, spread = np.zeros((3, *shape)), np.zeros((3, 3, *shape))
    spread[0, 0], spread[1, 1], spread[2, 2] = swing**2, series.lasting[0], HEAT_SIGMA**2
    total = np.zeros(shape)
    for k in range(len(series.time)):
        if k:
            passed = series.time[k] - series.time[k - 1]
            keep = np.ones((3, *shape))
            keep[0], keep[1] = np.exp(-passed / back), math.exp(-passed / LASTING_S)
            mean = keep * mean
            spread = keep[:, None] * spread * keep
            spread[0, 0] += (1.0 - keep[0] ** 2) * swing**2
            spread[1, 1] += (1.0 - keep[1] ** 2) * series.lasting[k]
        toward = spread[0] + spread[1] + series.kelvin[k] * spread[2]
        variance = toward[0] + toward[1] + series.kelvin[k] * toward[2] + gust**2 + series.variance[k]
        off = series.angle[k] - mean[0] - mean[1] - series.kelvin[k] * mean[2]
        square = off**2 / variance
        used = square < _OUTLIER**2
        log = -0.5 * (np.minimum(square, _OUTLIER**2) + np.log(variance))
        total += np.where(np.isfinite(off), log, 0.0)
        gain = np.where(used, toward / variance, 0.0)
        mean = mean + gain * np.where(used, off, 0.0)
        spread = spread - gain[:, None] * toward
    return total


# Kalman filter and smoother of the attitude of both cameras: from looks at the scene to the turn of any time.

# Of the state: slow turns, lasting errors of measurements, errors of lenses between the cameras, turns per kelvin.
_SLOW, _LASTING, _BIAS, _HEAT = slice(0, 6), slice(6, 12), slice(12, 17), slice(17, 23)
SIZE = 23
# Radians by which errors of the lenses turn what is measured between the cameras: some tenths of a pixel.
_LENS_SIGMA = 3e-4
# A measurement that chance explains less than once in a million is doubted, until so many in a row agree.
_CHANCE, _AGREE = 1.0 - 1e-6, 3
_GATES = torch.cat([torch.ones(1, dtype=torch.float64),
                    chi2_quantile(torch.arange(1.0, 12.0, dtype=torch.float64), _CHANCE)])  # fmt: skip


class Look(NamedTuple):
    """What the images of one time tell; leading dimensions (...) are separate rigs.

    Attributes:
        turn: (..., 6) radians of the left and right camera since the reference; what is not seen is not read.
        covariance: (..., 6, 6) of it, as one measurement tells.
        lasting: (...) share of that covariance that lasts (light and shade).
        seen: (..., 2) whether there is a turn of each camera.
        between: (..., 5) of `between_rows`, from matches between the cameras.
        between_covariance: (..., 5, 5).
        matched: (...) whether there are such.
        kelvin: (...) of warming since the reference; zeros where nobody measures.
    """

    turn: Tensor
    covariance: Tensor
    lasting: Tensor
    seen: Tensor
    between: Tensor
    between_covariance: Tensor
    matched: Tensor
    kelvin: Tensor


class TurnState(NamedTuple):
    """What is known at a time.

    Attributes:
        mean: (..., 23).
        covariance: (..., 23, 23).
        doubt: (..., 6) radians by which the last measurements contradict the state, if they do.
        strikes: (...) how many in a row did.
        kelvin: (...) of the last measurement.
        lasting: (..., 6) variance of lasting errors, of the last measurement.
    """

    mean: Tensor
    covariance: Tensor
    doubt: Tensor
    strikes: Tensor
    kelvin: Tensor
    lasting: Tensor


class Turns(NamedTuple):
    """Turn of both cameras at a time: (..., 6) radians, and (..., 6, 6)."""

    mean: Tensor
    covariance: Tensor


def between_rows(rig: Rig) -> Tensor:
    """(5, 6): what matches between the cameras can tell of turns of both.

    These are the turn of the right camera against the left one (3, about the right one's axes), and of the baseline's
    direction in the left camera's frame (2). A turn of both about the baseline shows in no match.
    """
    rotation = rig.right_from_left_rotation
    axis = -(rotation.T @ rig.right_from_left_translation)
    beside = torch.linalg.svd(axis[None])[2][1:]
    across = torch.linalg.cross((axis / axis.norm()).expand(2, 3), beside)
    zero = torch.zeros(2, 3, dtype=torch.float64)
    return torch.cat([torch.cat([-rotation, torch.eye(3, dtype=torch.float64)], 1), torch.cat([across, zero], 1)])


def first_state(model: TurnModel, lead: tuple[int, ...] = ()) -> TurnState:
    """Before the first measurement."""
    variance = torch.zeros(*lead, SIZE, dtype=torch.float64)
    variance[..., _SLOW], variance[..., _BIAS], variance[..., _HEAT] = model.swing**2, _LENS_SIGMA**2, HEAT_SIGMA**2
    zero = torch.zeros(*lead, 6, dtype=torch.float64)
    return TurnState(
        mean=torch.zeros(*lead, SIZE, dtype=torch.float64),
        covariance=torch.diag_embed(variance),
        doubt=zero, strikes=zero[..., 0], kelvin=zero[..., 0], lasting=zero,
    )  # fmt: skip


def passed(state: TurnState, seconds: Tensor, model: TurnModel) -> tuple[TurnState, Tensor]:
    """The state after a time (...), and (..., 23) what each part keeps."""
    keep = torch.ones_like(state.mean)
    keep[..., _SLOW] = torch.exp(-seconds[..., None] / model.return_s)
    keep[..., _LASTING] = torch.exp(-seconds / LASTING_S)[..., None]
    more = torch.zeros_like(state.mean)
    more[..., _SLOW] = model.swing**2
    more[..., _LASTING] = state.lasting
    covariance = keep[..., None] * state.covariance * keep[..., None, :]
    covariance = covariance + torch.diag_embed((1.0 - keep**2) * more)
    return state._replace(mean=keep * state.mean, covariance=covariance), keep


def taken(state: TurnState, look: Look, model: TurnModel, rows: Tensor) -> TurnState:
    """The state after a measurement of the same time; `rows` are those of `between_rows`.

    A measurement that contradicts the state is doubted and widens what is told of that time. Three in a row that do are
    believed: somebody has hit the mast.
    """
    share = look.lasting[..., None]
    own = look.covariance.diagonal(dim1=-2, dim2=-1)
    first = (state.lasting == 0).all(-1, keepdim=True)
    spread = state.covariance.clone()
    lasting = spread.diagonal(dim1=-2, dim2=-1)[..., _LASTING]
    # The first measurement tells how much may last.
    lasting.copy_(torch.where(first, share * own, lasting))
    design, noise, wanted, there = _rows_of(look, model, rows)
    off = torch.where(there, wanted - (design @ state.mean[..., None])[..., 0], 0.0)

    def innovation(prior: Tensor) -> Tensor:
        return design @ prior @ design.mT + noise

    square = (off * torch.linalg.solve(innovation(spread), off[..., None])[..., 0]).sum(-1)
    strange = square > _GATES[there.sum(-1)]
    strikes = torch.where(strange, state.strikes + 1.0, 0.0)
    believed = strange & (strikes >= _AGREE)
    jump = torch.where(there[..., :6], off[..., :6], 0.0)
    wider = torch.zeros_like(state.mean)
    wider[..., _SLOW] = torch.where(believed[..., None], jump**2, 0.0)
    spread = spread + torch.diag_embed(wider)
    gain = torch.linalg.solve(innovation(spread), design @ spread).mT
    used = (~strange | believed)[..., None]
    rest = torch.eye(SIZE, dtype=torch.float64) - gain @ design
    after = rest @ spread @ rest.mT + gain @ noise @ gain.mT
    return TurnState(
        mean=torch.where(used, state.mean + (gain @ off[..., None])[..., 0], state.mean),
        covariance=torch.where(used[..., None], after, spread),
        doubt=torch.where(used, 0.0, torch.maximum(state.doubt, jump.abs())),
        strikes=torch.where(believed, 0.0, strikes),
        kelvin=look.kelvin,
        lasting=torch.where(look.seen.repeat_interleave(3, -1), share * own, state.lasting),
    )


def _rows_of(look: Look, model: TurnModel, rows: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Design (..., 11, 23), covariance (..., 11, 11), what was measured (..., 11) and which of it there is."""
    there = torch.cat([look.seen.repeat_interleave(3, -1), look.matched[..., None].expand(*look.matched.shape, 5)], -1)
    by_turn = torch.cat([torch.eye(6, dtype=torch.float64), rows])
    design = torch.zeros(*there.shape, SIZE, dtype=torch.float64)
    design[..., _SLOW] = by_turn
    design[..., :6, _LASTING] = torch.eye(6, dtype=torch.float64)
    design[..., 6:, _BIAS] = torch.eye(5, dtype=torch.float64)
    design[..., _HEAT] = look.kelvin[..., None, None] * by_turn
    # Wind turns both measurements of a time alike.
    noise = (by_turn * model.gust[..., None, :] ** 2) @ by_turn.mT
    noise = noise.expand(*there.shape, 11).clone()
    noise[..., :6, :6] += (1.0 - look.lasting)[..., None, None] * look.covariance
    noise[..., 6:, 6:] += look.between_covariance
    both = there[..., None] & there[..., None, :]
    noise = torch.where(both, noise, 0.0) + torch.diag_embed((~there).double())
    wanted = torch.cat([look.turn, look.between], -1)
    return torch.where(there[..., None], design, 0.0), noise, torch.where(there, wanted, 0.0), there


def turns_of(state: TurnState, model: TurnModel, *, gusts: bool = True) -> Turns:
    """The turn of both cameras; with the wind of the time, or only what lasts beyond it (for alarms)."""
    whole = torch.zeros(*state.mean.shape[:-1], 6, SIZE, dtype=torch.float64)
    whole[..., _SLOW] = torch.eye(6, dtype=torch.float64)
    whole[..., _HEAT] = state.kelvin[..., None, None] * torch.eye(6, dtype=torch.float64)
    covariance = whole @ state.covariance @ whole.mT
    more = state.doubt**2 + (model.gust**2 if gusts else 0.0)
    return Turns((whole @ state.mean[..., None])[..., 0], covariance + torch.diag_embed(more))


def smoothed(states: list[TurnState], times: list[float], model: TurnModel) -> list[TurnState]:
    """What is known of each time from all measurements, those after it too (H. Rauch, F. Tung and C. Striebel 1965).

    Args:
        states: after each measurement, in turn.
        times: seconds of these.
        model: of the turns.
    """
    found = list(states)
    for k in range(len(states) - 2, -1, -1):
        later, here = found[k + 1], states[k]
        prior, keep = passed(here, torch.tensor(times[k + 1] - times[k], dtype=torch.float64), model)
        move = (states[k + 1].mean - prior.mean)[_SLOW].abs()
        jumped = bool((move > 4.0 * prior.covariance.diagonal()[_SLOW].sqrt()).any())
        if jumped and bool(states[k + 1].strikes == 0) and bool(here.strikes > 0):
            # Believed after doubts: what came after the jump tells nothing of before.
            continue
        gain = torch.linalg.solve(prior.covariance + 1e-24 * torch.eye(SIZE, dtype=torch.float64),
                                  keep[:, None] * here.covariance).mT  # fmt: skip
        mean = here.mean + gain @ (later.mean - prior.mean)
        covariance = here.covariance + gain @ (later.covariance - prior.covariance) @ gain.mT
        found[k] = here._replace(mean=mean, covariance=0.5 * (covariance + covariance.mT))
    return found


# Tables that grow while they are read: the history of a watched rig, and temperatures.


class GrowingTable:
    """Rows of a CSV file that another process writes, as they become whole; or of a Parquet file, as it is now.

    Args:
        path: of the file.
        needed: columns that it must have.
        wanted: what a file with other columns is not.
    """

    def __init__(self, path: str | Path, needed: Sequence[str], wanted: str) -> None:
        self.path, self.number, self._offset = path, 0, 0
        self._needed, self._wanted, self._columns = set(needed), wanted, list[str]()

    @property
    def where(self) -> str:
        """The file, and the number of the line that was read last, from 1."""
        return f"{self.path}: line {self.number}"

    def rows(self) -> Iterator[dict[str, str]]:
        """The rows that have come since the last call, by their columns.

        Raises:
            FileError: the file cannot be read, has other columns, or a row with another number of cells.
        """
        if Path(self.path).suffix.lower() == ".parquet":
            for row in [] if self.number else _parquet_rows(self.path, self._needed, self._wanted):
                self.number += 1
                yield row
            return
        try:
            with open(self.path, "rb") as file:
                file.seek(self._offset)
                for line in file:
                    # One that is still being written is left out.
                    if not line.endswith(b"\n"):
                        break
                    self._offset += len(line)
                    self.number += 1
                    text = line.decode("utf-8-sig" if self.number == 1 else "utf-8", "replace")
                    cells = [cell.strip() for cell in next(csv.reader([text]), [])]
                    if self.number == 1:
                        if not self._needed <= set(cells):
                            raise FileError(f"{self.path}: {self._wanted}")
                        self._columns = cells
                    elif cells and len(cells) != len(self._columns):
                        count = len(self._columns)
                        raise FileError(f"{self.where}: {len(cells)} cells, not {count}: damaged; remove that line")
                    elif cells:
                        yield dict(zip(self._columns, cells, strict=True))
        except OSError as error:
            raise FileError(f"{self.path}: cannot read: {error.strerror or error}") from error


def _parquet_rows(path: str | Path, needed: set[str], wanted: str) -> Iterator[dict[str, str]]:
    with with_extra("tables", "Parquet histories need"):
        import pyarrow
        from pyarrow.parquet import ParquetFile

    try:
        with ParquetFile(path) as file:
            if not needed <= set(file.schema_arrow.names):
                raise FileError(f"{path}: {wanted}")
            for batch in file.iter_batches(1000):
                for row in batch.to_pylist():
                    yield {name: "" if value is None else str(value) for name, value in row.items()}
    except (OSError, pyarrow.ArrowInvalid) as error:
        raise FileError(f"{path}: cannot read: {error}") from error


# The history of a watched rig as a growing CSV file: what each measurement measured, and what it made of it.

_ANGLES = ("pitch", "yaw", "roll")
_SIDES = ("left", "right")
_TOLD = (*(f"relative_{name}_deg" for name in _ANGLES), *(f"relative_{name}_sigma_deg" for name in _ANGLES))
_TURN = tuple(f"{side}_{name}_deg" for side in _SIDES for name in _ANGLES)
_BETWEEN = tuple(f"between_{k}_deg" for k in range(5))


def _upper(size: int) -> tuple[Tensor, ...]:
    return torch.triu_indices(size, size).unbind()


_TURN_COVARIANCE = tuple(f"{side}_cov_{i}{j}_deg2" for side in _SIDES for i in range(3) for j in range(i, 3))
_BETWEEN_COVARIANCE = tuple(f"between_cov_{i}{j}_deg2" for i in range(5) for j in range(i, 5))
# What was measured, each in a unit of degrees; and how much of it the left camera, the right one and both tell.
_LOOK = (*_TURN, *_TURN_COVARIANCE, *_BETWEEN, *_BETWEEN_COVARIANCE)
_UNITS = torch.tensor([math.degrees(1.0) ** (2 if "_cov_" in name else 1) for name in _LOOK], dtype=torch.float64)
_TELLS = torch.tensor([0] * 3 + [1] * 3 + [0] * 6 + [1] * 6 + [2] * 20)
COLUMNS = (
    "time", "rig", *_TOLD, "left_features", "right_features", "matches", "lasting", "temperature_c", *_LOOK, "note",
)  # fmt: skip
_NO_HISTORY = "not a history of this version of `kcal watch`"
# Rows that are kept of a file: two weeks of a measurement a minute.
MOST_ROWS = 20_000


class HistoryRow(NamedTuple):
    """One measurement.

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
    """A line of the file; `told` is the relative turn (3,) of the time and its sigma (3,), radians."""
    look, air = row.look, None if math.isnan(row.temperature) else row.temperature
    blocks = look.covariance[:3, :3], look.covariance[3:, 3:]
    parts = [look.turn, *(block[_upper(3)] for block in blocks), look.between, look.between_covariance[_upper(5)]]
    there = torch.cat([look.seen, look.matched[None]])[_TELLS].tolist()
    measured = [value if one else None for value, one in zip((_UNITS * torch.cat(parts)).tolist(), there, strict=True)]
    degrees = (math.degrees(1.0) * torch.cat(told)).tolist()
    return csv_line(
        [row.time, fingerprint, *degrees, *row.features, row.matches, float(look.lasting), air, *measured, row.note]
    )


def history_table(path: str | Path) -> Any:
    """A history as far as its lines are whole, as a `pyarrow.Table`: the columns of the file, unknown numbers null.

    Raises:
        FileError: the file cannot be read, has other columns, or is damaged.
        InputError: pyarrow is not installed, the extra `tables`.
    """
    with with_extra("tables", "Parquet histories need"):
        import pyarrow
        from pyarrow.csv import ConvertOptions, read_csv

    data = read_bytes(path)
    kinds = dict.fromkeys(COLUMNS, pyarrow.float64()) | dict.fromkeys(("rig", "note"), pyarrow.string())
    kinds |= dict.fromkeys(("left_features", "right_features", "matches"), pyarrow.int64())
    try:
        whole = pyarrow.py_buffer(data[: data.rfind(b"\n") + 1])
        table = read_csv(whole, convert_options=ConvertOptions(column_types=kinds))
    except pyarrow.ArrowInvalid as error:
        raise FileError(f"{path}: no history of `kcal watch`, or a damaged one: {error}") from error
    if not set(COLUMNS) <= set(table.column_names):
        raise FileError(f"{path}: {_NO_HISTORY}")
    return table


def save_history(path: str | Path, parquet: str | Path) -> Path:
    """Write a history as a Parquet file, whole or not at all; see `history_table`.

    A Parquet file ends with the places of its rows, so that none can be added: what grows, and survives a power cut, is
    the CSV file.
    """
    table, data = history_table(path), io.BytesIO()
    from pyarrow.parquet import write_table

    write_table(table, data)
    return write_atomic(parquet, data.getvalue())


def history_head() -> str:
    """The first line of the file."""
    return csv_line(COLUMNS)


class HistoryTail:
    """The rows of a history that grows, as far as they are whole.

    Args:
        path: of the CSV file, or of a Parquet file that `save_history` wrote.
        fingerprint: of the rig that was watched.
    """

    def __init__(self, path: str | Path, fingerprint: str) -> None:
        self._table = GrowingTable(path, COLUMNS, _NO_HISTORY)
        self._fingerprint, self._first, self._kelvin = fingerprint, math.nan, None

    _kelvin: Tensor | None

    def rows(self, since: float = -math.inf, until: float = math.inf) -> list[HistoryRow]:
        """The rows that have come since the last call: the last `MOST_ROWS` between two times.

        Raises:
            FileError: no such file, no history, one of another rig, or a damaged line.
        """
        rows: deque[HistoryRow] = deque(maxlen=MOST_ROWS)
        for cells in self._table.rows():
            row = _parsed_row(self._table.where, cells, self._fingerprint)
            self._first = row.temperature if math.isnan(self._first) else self._first
            row = warmed(row, self._first, self._kelvin)
            self._kelvin = row.look.kelvin
            if since <= row.time <= until:
                rows.append(row)
        if self._table.number == 0:
            raise FileError(f"{self._table.path}: no rows yet: let `kcal watch` look at the scene first")
        return list(rows)


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


def _parsed_row(where: str, cells: dict[str, str], fingerprint: str) -> HistoryRow:
    """A row of its cells.

    Raises:
        FileError: a damaged row, or one of another rig.
    """
    if cells["rig"] != fingerprint:
        raise FileError(
            f"{where}: the history is of another rig ({cells['rig']}, not {fingerprint}); give the rig file that "
            "was watched, or begin a new history"
        )
    told = torch.tensor([bool(cells[block[0]]) for block in (_TURN, _TURN[3:], _BETWEEN)])
    there, warm = told[_TELLS].tolist(), cells["temperature_c"]
    try:
        every = [float(cells[name]) if one else 0.0 for name, one in zip(_LOOK, there, strict=True)]
        every += [float(cells["lasting"]), float(cells["time"]), float(warm or 0.0)]
        if not all(map(math.isfinite, every)):
            raise ValueError("not finite")
        turn, left, right, between, both = (_UNITS.new_tensor(every[:-3]) / _UNITS).split([6, 6, 6, 5, 15])
        look = no_look()._replace(
            turn=turn, covariance=torch.block_diag(_from_upper(left, 3, told[0]), _from_upper(right, 3, told[1])),
            seen=told[:2], lasting=torch.tensor(every[-3], dtype=torch.float64),
            between=between, between_covariance=_from_upper(both, 5, told[2]), matched=told[2],
        )  # fmt: skip
        features = int(cells["left_features"]), int(cells["right_features"])
        temperature = every[-1] if warm else math.nan
        return HistoryRow(every[-2], look, features, int(cells["matches"]), temperature, cells["note"])
    except ValueError as error:
        raise FileError(f"{where}: a number is damaged ({error}); remove that line") from error


def _from_upper(upper: Tensor, size: int, there: Tensor) -> Tensor:
    """A covariance of its upper triangle; the identity where there is none."""
    matrix = torch.eye(size, dtype=torch.float64)
    if bool(there):
        rows, columns = _upper(size)
        matrix[rows, columns] = matrix[columns, rows] = upper
        if not bool(torch.linalg.eigvalsh(matrix)[0] > 0):
            raise ValueError("a covariance is not positive definite")
    return matrix


# Temperatures from a table (time,temperature) that may grow while it is read.

# Seconds beyond which the nearest temperature is not that of a time.
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
        needed = "the columns time and temperature are needed"
        self._table = GrowingTable(path, ("time", "temperature"), needed)
        self._times: list[float] = []
        self._values: list[float] = []
        self._take_all()
        if not self._table.number:
            raise FileError(f"{path}: {needed}")

    def at(self, time: float) -> float:
        """°C at a time, between the two nearest; NaN where the nearest is more than an hour away.

        Raises:
            FileError: a damaged line.
        """
        self._take_all()
        k = bisect.bisect_right(self._times, time)
        around = [i for i in (k - 1, k) if 0 <= i < len(self._times) and abs(self._times[i] - time) <= _NEAR]
        if len(around) < 2:
            return self._values[around[0]] if around else math.nan
        return float(np.interp(time, [self._times[i] for i in around], [self._values[i] for i in around]))

    def _take_all(self) -> None:
        for cells in self._table.rows():
            try:
                time, value = seconds_of(cells["time"]), float(cells["temperature"])
                if not -100.0 < value < 150.0:
                    raise InputError(f"temperature {value:g}: °C are needed")
            except (ValueError, InputError) as error:
                raise FileError(f"{self._table.where}: {error}") from error
            if self._times and time <= self._times[-1]:
                continue
            self._times.append(time)
            self._values.append(value)
        if len(self._times) > _KEPT:
            del self._times[: _KEPT // 2], self._values[: _KEPT // 2]
