"""A rig and the history of its attitude: looks at images as they come, drift, and the rig of any time."""

from __future__ import annotations

import bisect
import itertools
import json
import math
import urllib.request
from collections import deque
from collections.abc import Callable, Sequence
from http.client import HTTPException
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import torch
from torch import Tensor

import kcal.watch.history as past
import kcal.watch.measure as measure
from kcal.corners.images import Gray
from kcal.errors import FileError, InputError
from kcal.lens.rig import Rig
from kcal.locate.localizer import Localizer
from kcal.locate.marks import Marks
from kcal.locate.points import PointLocator
from kcal.locate.tables import PositionColumns
from kcal.pipeline.stream import Ledger
from kcal.values import split_address
from kcal.watch.turned import Drift, drift_of_turns

# `Watched`: a rig and the history of its attitude; the rig of any time, with the errors of that time.

# Number of shared errors that a time adds to those of the rig file.
MORE_ERRORS = 9
# Seconds of a history that are read before and after the wanted times; rows beyond change nothing.
_BEFORE, _AFTER = 2 * 86400.0, 2 * 3600.0


class Watched:
    """A rig whose attitude was watched.

    Args:
        rig: as it was solved and watched.
        rows: of its history, in the order of time.
        model: how it turns; learned from the rows if left out.

    Example:
        >>> from kcal.locate.budget import planned_rig
        >>> from kcal.watch.history import HistoryRow, no_look
        >>> rig = planned_rig()
        >>> watched = Watched(rig, [HistoryRow(0.0, no_look())])
        >>> float(watched.rig_at(60.0).baseline)  # nothing was seen: the same rig, less well known
        10.0
    """

    def __init__(self, rig: Rig, rows: Sequence[past.HistoryRow] = (), model: past.TurnModel | None = None) -> None:
        self.rig, self.model = rig, model or model_of(rows)
        self.between = past.between_rows(rig)
        # The times for which no further row of the history matters.
        self.since, self.until = -math.inf, math.inf
        self.times: list[float] = []
        self.states: list[past.TurnState] = []
        self.seen: list[bool] = []
        self._smooth: list[past.TurnState] | None = None
        for row in rows:
            self.take(row)

    def __repr__(self) -> str:
        span = f" from {self.times[0]:.0f} to {self.times[-1]:.0f} s" if self.times else ""
        return f"Watched({', '.join(self.rig.names)}, {len(self.times):,} measurements{span})"

    @classmethod
    def read(cls, path: str | Path, rig: Rig, *, since: float = -math.inf, until: float = math.inf) -> Self:
        """Read the history that `kcal watch` wrote, as far as it tells of times between two times.

        Raises:
            FileError: no history, or one of another rig.
        """
        found = cls(rig, past.read_history(path, rig.fingerprint, since=since - _BEFORE, until=until + _AFTER))
        found.since, found.until = since, until
        return found

    def take(self, row: past.HistoryRow, most: int | None = None) -> None:
        """Take in a further measurement; of more than `most` the oldest are forgotten.

        Raises:
            InputError: it is not later than the last one.
        """
        state = past.first_state(self.model)
        if self.times:
            if not row.time > self.times[-1]:
                raise InputError(f"time {row.time:g}: not after that of the last measurement, {self.times[-1]:g}")
            gap = torch.tensor(row.time - self.times[-1], dtype=torch.float64)
            state, _ = past.passed(self.states[-1], gap, self.model)
        self.times.append(row.time)
        self.states.append(past.taken(state, row.look, self.model, self.between))
        self.seen.append(bool(row.look.seen.all()))
        self._smooth = None
        if most is not None and len(self.times) > most:
            del self.times[: most // 2], self.states[: most // 2], self.seen[: most // 2]

    @property
    def cam_from_local(self) -> Tensor | None:
        """(3, 3) of the left camera, as the rig file says."""
        stands = self.rig.mounting
        return None if stands is None else stands.enu_from_cam.T

    def turns_at(self, time: float, *, gusts: bool = True) -> past.Turns:
        """The turn of both cameras at a time, from the measurements before and after it.

        Raises:
            InputError: before the first measurement.
        """
        k = bisect.bisect_right(self.times, time) - 1
        if k < 0:
            begin = f"it begins at {self.times[0]:.0f}" if self.times else "it has no rows"
            raise InputError(f"time {time:.0f} s: the history of the rig tells nothing of that time; {begin}")
        if self._smooth is None and k + 1 < len(self.times):
            self._smooth = past.smoothed(self.states, self.times, self.model)
        state, _ = past.passed(self.states[k], torch.tensor(time - self.times[k], dtype=torch.float64), self.model)
        if self._smooth is not None and k + 1 < len(self.times):
            state = past.smoothed([state, self._smooth[k + 1]], [time, self.times[k + 1]], self.model)[0]
        return past.turns_of(state, self.model, gusts=gusts)

    def drift_at(self, time: float, *, gusts: bool = True) -> Drift:
        """How the cameras have turned since the reference; see `turns_at`."""
        return drift_of_turns(self.rig, *self.turns_at(time, gusts=gusts), self.cam_from_local)

    def rig_at(self, time: float) -> Rig:
        """The rig as it stood at a time: attitudes corrected, with the covariance of that time on top.

        Args:
            time: seconds, as in the history.

        Raises:
            InputError: before the first measurement.
        """
        return self.drift_at(time).relocked(f"at {time:.3f} s, from the history of the watched rig")


def model_of(rows: Sequence[past.HistoryRow]) -> past.TurnModel:
    """How a rig turns, as its history tells."""
    if not rows:
        return past.TurnModel.usual()
    looks = [row.look for row in rows]
    seen = torch.stack([look.seen for look in looks]).repeat_interleave(3, -1)
    own = torch.stack([look.covariance.diagonal() for look in looks])
    share = torch.stack([look.lasting for look in looks])[:, None]

    return past.learned(past.AngleSeries(
        time=np.array([row.time for row in rows]),
        angle=torch.where(seen, torch.stack([look.turn for look in looks]), math.nan).numpy(),
        variance=((1.0 - share) * own).numpy(),
        lasting=(share * own).numpy(),
        kelvin=torch.stack([look.kelvin for look in looks])[:, None].expand(-1, 6).numpy(),
    ))  # fmt: skip


# A new rig file from a history, and only where the history proves that the old one is wrong for good.

# Seconds of history from which the swing of a day is known, and looks at its end that are held out for the proof.
_DAY, _HELD_OUT = 86400.0, 20


class Relock(NamedTuple):
    """The corrected rig, None where it would not be surely better; and why."""

    rig: Rig | None
    reason: str


def relock(watched: Watched) -> Relock:
    """The rig with the mean attitude of the last day, if that differs from the rig file's beyond the swing of a day.

    A new file is used without the watch: its covariance contains the swing. It must explain the last
    measurements, which take no part in the mean, better than the old one.
    """
    if len(watched.times) <= _HELD_OUT or watched.times[-1] - watched.times[0] < _DAY:
        need = f"a day of history and more than {_HELD_OUT} measurements are needed"
        return Relock(None, f"{need}, so that a swing is not taken for a drift")
    end = watched.times[-_HELD_OUT - 1]
    chosen = [end - _DAY * k / 48.0 for k in range(48)]
    turns = [watched.turns_at(time, gusts=False) for time in chosen if time >= watched.times[0]]
    mean = torch.stack([turn.mean for turn in turns]).mean(0)
    apart = torch.stack([turn.mean - mean for turn in turns])
    # Half-hours agree with each other: the mean is as good as the best known one, not better.
    best = min((turn.covariance for turn in turns), key=lambda matrix: float(matrix.trace()))
    gust = torch.diag(watched.model.gust**2)
    drift = drift_of_turns(watched.rig, mean, best + apart.T @ apart / len(turns) + gust, watched.cam_from_local)
    if not drift.significant:
        return Relock(None, "the attitude does not differ from the rig file's beyond its swing and chance")
    new, old = 0.0, 0.0
    for time in watched.times[-_HELD_OUT:]:
        now = watched.drift_at(time)
        weight = torch.linalg.inv(now.relative_covariance)
        off = now.relative - drift.relative
        old += float(now.relative @ weight @ now.relative)
        new += float(off @ weight @ off)
    if new >= old:
        return Relock(None, f"the last {_HELD_OUT} measurements fit the old rig file better")
    better = drift.relocked(f"mean of the day before {end:.0f} s")
    return Relock(better, f"χ² {drift.chi2:.0f} of the turn; the last measurements: {old:.0f} before, {new:.0f} after")


# A watched rig in a stream: the localizer of each time, from a history that another process writes.

# Seconds for which an attitude counts, and rows that are kept.
_STEP_S, _KEPT = 10.0, past.MOST_ROWS // 4


class Followed:
    """Call it with a time: the localizer of that time; the same one for ten seconds.

    Args:
        history: of `kcal watch`, which may grow.
        localize: the rig as it was solved, and where it stands.

    Raises:
        FileError: no history, or one of another rig.
    """

    def __init__(self, history: Path, localize: Localizer) -> None:
        self._tail, self._solved = past.HistoryTail(history, localize.rig.fingerprint), localize
        self._watched = Watched(localize.rig, self._tail.rows())
        self._now, self._until = localize, -math.inf

    def __call__(self, time: float) -> Localizer:
        """The localizer of a time.

        Raises:
            InputError: a time before the history begins.
        """
        if self._until - _STEP_S <= time < self._until:
            return self._now
        for row in self._tail.rows():
            self._watched.take(row, _KEPT)
        if not self._watched.times:
            raise InputError("--history: it has no rows yet: let `kcal watch` look at the scene first")
        self._now = standing(self._solved, self._watched, time)
        self._until = time + _STEP_S
        return self._now


def standing(solved: Localizer, watched: Watched, time: float) -> Localizer:
    """A localizer as the rig stands at a time; its place stays where it was given."""
    rig = watched.rig_at(time)
    if watched.rig.mounting is None or solved.origin != watched.rig.mounting.origin:
        heading, pitch, roll = solved.attitude_deg
        rig = rig.placed(origin=solved.origin, heading_deg=heading, pitch_deg=pitch, roll_deg=roll)
    return Localizer(rig, pixel_sigma=float(solved.pixel_sigma))


# Look at pairs of images as they come, write what they tell into the history, and say when a rig has drifted.

# When to say that a rig has drifted: beyond a limit, so surely that chance says it less than once a month.

# Degrees of the relative attitude: 0.005° of yaw is 4 % of the range at 5 km with a baseline of 10 m.
LIMIT = 0.005
_MONTH = 30 * 86400.0
# Seconds for an answer; what was not delivered is tried again at the next measurement.
_PATIENCE = 5.0


def located_at(history: Path, rig: Rig, locator: Callable[[Rig], PointLocator]) -> Callable[[Marks], PositionColumns]:
    """What locates rows with a column `time`: by the rig of that second.

    Args:
        history: of `kcal watch`.
        rig: as it was solved and watched.
        locator: makes what locates by a rig.
    """
    watched: Watched | None = None

    def locate(marks: Marks) -> PositionColumns:
        nonlocal watched
        texts = marks.extras.get("time")
        if texts is None:
            raise InputError("--history: the table needs a column time (Unix seconds, or like 2026-05-01T12:00:00Z)")
        times = []
        for name, text in zip(marks.names, texts, strict=True):
            try:
                times.append(round(past.seconds_of(text)))
            except InputError as error:
                raise InputError(f"{name}: {error}") from None
        if not times:
            return locator(rig)(marks)
        if watched is None or min(times) < watched.since or max(times) > watched.until:
            watched = Watched.read(history, rig, since=min(times), until=max(times))
        parts = []
        for time, group in itertools.groupby(range(len(times)), times.__getitem__):
            rows = list(group)
            parts.append(locator(watched.rig_at(float(time)))(marks.rows(slice(rows[0], rows[-1] + 1))))
        return PositionColumns.joined(parts)

    return locate


def alarm_sigmas(every_s: float) -> float:
    """Standard deviations by which a limit must be exceeded, for less than one false alarm a month.

    Three angles and two signs are measured every so many seconds; agreement of measurements makes it rarer. What is
    measured less than once a day is judged as if it were.

    Example:
        >>> round(alarm_sigmas(60.0), 2)
        4.47
    """
    tries = 6.0 * _MONTH / min(every_s, _DAY)
    return math.sqrt(2.0) * float(torch.erfinv(torch.tensor(1.0 - 2.0 / tries, dtype=torch.float64)))


def exceeded(turn: Tensor, sigma: Tensor, limit_deg: float, every_s: float) -> Tensor:
    """Which angles (..., 3) of a relative turn, with standard deviations, radians, are surely beyond a limit."""
    return turn.abs() - alarm_sigmas(every_s) * sigma > math.radians(limit_deg)


class Webhook:
    """Send alarms to an address as JSON; what is not delivered waits, the newest only.

    Args:
        address: http:// or https://.

    Raises:
        InputError: another kind of address.
    """

    def __init__(self, address: str) -> None:
        parts = split_address(address)
        if parts.scheme not in ("http", "https") or not parts.hostname:
            raise InputError("--alarm: write http://... or https://..., or exit")
        self.address, self.failed, self._waiting = address, 0, b""

    def send(self, message: dict[str, object]) -> None:
        """Send a message, in place of one that still waits."""
        self._waiting = json.dumps(message).encode()
        self.again()

    def again(self) -> None:
        """Try to send what waits."""
        if not self._waiting:
            return
        request = urllib.request.Request(self.address, self._waiting, {"Content-Type": "application/json"})
        try:
            with urllib.request.urlopen(request, timeout=_PATIENCE):
                self._waiting = b""
        except (OSError, ValueError, HTTPException):
            self.failed += 1


# `Watcher`: look at pairs of images as they come, and write what they tell into the history.

# Seconds between looks at the matches between the cameras, which take seconds; between times at which it is learned.
_BETWEEN_S, _LEARN_S = 3600.0, 86400.0
# Measurements between checkpoints, at which references are renewed and saved; rows in memory: three days, one a minute.
_CHECKPOINT, _KEPT_ROWS = 60, 4320
# Measurements in a row at images full of points of which none is what was there: another camera, or another view.
_LOST = 30


class Noticed(NamedTuple):
    """What a measurement has told.

    Attributes:
        row: of the history.
        turn: (3,) radians, relative, without wind.
        sigma: (3,) of it.
        alarm: whether it is beyond the limit surely.
        begins: whether it was not at the measurement before.
    """

    row: past.HistoryRow
    turn: Tensor
    sigma: Tensor
    alarm: bool
    begins: bool


class Watcher:
    """Look at a rig again and again; continue where the history ends.

    The first images make the reference, which stands beside the history as `.reference.npz`; `.journal` remembers what
    was written.

    Args:
        rig: as it was solved.
        history: CSV file that grows.
        every_s: seconds between measurements.
        limit_deg: relative turn beyond which there is an alarm.
        temperatures: of the air at the rig, if they are known.
        parquet: file to which the history is written whole once a day; see `kcal.watch.history.save_history`.
        tell: called with what happens.

    Raises:
        FileError: a history or reference of another rig, a damaged one, or one that another process writes.
    """

    def __init__(
        self,
        rig: Rig,
        history: Path,
        *,
        every_s: float = 60.0,
        limit_deg: float = LIMIT,
        temperatures: past.Temperatures | None = None,
        parquet: Path | None = None,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.rig, self.every_s, self.limit_deg, self.tell = rig, every_s, limit_deg, tell
        self.history, self.reference = history, history.with_suffix(".reference.npz")
        self.skipped, self.looks, self.alarms = 0, 0, 0
        self._temperatures, self._warmth, self._parquet = temperatures, math.nan, parquet
        self._rows: deque[past.HistoryRow] = deque(maxlen=_KEPT_ROWS)
        self._sides: tuple[measure.FixedFeatures, measure.FixedFeatures] | None = None
        self._matched, self._learned, self._alarm = -math.inf, -math.inf, False
        self._lost = [0, 0]
        self._notes = ""
        if history.exists() and not history.with_name(history.name + ".journal").exists() and history.stat().st_size:
            raise FileError(
                f"{history}: there is no journal beside it; give another name, or restore {history}.journal"
            )
        self._ledger = Ledger(history.with_name(history.name + ".journal"), [history], "watch")
        try:
            if self._ledger.place.sequence:
                self._rows.extend(past.read_history(history, rig.fingerprint))
                known = (row for row in self._rows if not math.isnan(row.temperature))
                self._warmth = next((row.temperature - float(row.look.kelvin) for row in known), math.nan)
            if self.reference.exists():
                self._sides = measure.load_references(self.reference, rig)
            elif self._rows:
                raise FileError(f"{self.reference}: the reference of the history is missing; begin a new history")
            self.watched = self._relearned()
            # The history counts: what a checkpoint knows is in its rows.
            self._ledger.checkpoint({"rig": rig.fingerprint})
        except BaseException:
            self._ledger.close()
            raise

    @property
    def last_time(self) -> float:
        """Seconds of the last measurement; -inf before the first."""
        return self._rows[-1].time if self._rows else -math.inf

    @property
    def offset(self) -> int:
        """Microseconds of the last measurement's frame, from 1; 0 before the first."""
        return self._ledger.place.offset

    def due(self, time: float) -> bool:
        """Whether the next measurement may be at that time; images of an earlier one are counted and left out."""
        if time <= self.last_time:
            self.skipped += 1
            return False
        return time >= self.last_time + self.every_s

    def refer_to(self, left: Gray, right: Gray) -> None:
        """Take images of when the rig was solved as the reference, before the first measurement.

        Raises:
            FileError: there is a reference already.
            InputError: too few features.
        """
        if self._sides is not None:
            raise FileError(f"{self.reference}: there is a reference already; begin a new history for another")
        sides = measure.new_reference(left, "left"), measure.new_reference(right, "right")
        measure.save_references(self.reference, self.rig, sides)
        self._sides = sides

    def look(self, time: float, left: Gray, right: Gray) -> Noticed:
        """Look at images of a time, and write a row.

        Raises:
            InputError: too few features for a reference, or another lens (`AnotherCameraError`).
        """
        if self._sides is None:
            self.refer_to(left, right)
            self.tell("the reference was made from the first images: attitudes count from there")
        assert self._sides is not None
        about = self.watched.turns_at(time).mean if self.watched.times else torch.zeros(6, dtype=torch.float64)
        between = time >= self._matched + _BETWEEN_S
        found = measure.measured(self.rig, self._sides, (left, right), about, between=between)
        self._matched = time if between else self._matched
        self._check_lost(found)
        warm = math.nan if self._temperatures is None else self._temperatures.at(time)
        self._warmth = warm if math.isnan(self._warmth) else self._warmth
        counts = found.sides[0].found, found.sides[1].found
        seen = past.HistoryRow(time, found.look, counts, found.matches, warm, found.note)
        row = past.warmed(seen, self._warmth, self._rows[-1].look.kelvin if self._rows else None)
        self._sides = found.sides[0].reference, found.sides[1].reference
        self.watched.take(row, _KEPT_ROWS)
        self._rows.append(row)
        noticed = self._write(row)
        if self._ledger.place.sequence % _CHECKPOINT == 0:
            self._renew(left, right)
        if time - self._learned >= _LEARN_S:
            self.watched = self._relearned()
            if self._parquet is not None:
                past.save_history(self.history, self._parquet)
        if row.note != self._notes:
            self.tell(row.note or "both cameras see the reference again")
            self._notes = row.note
        return noticed

    def close(self) -> None:
        """Save the reference, and let others write the history."""
        try:
            if self._sides is not None:
                measure.save_references(self.reference, self.rig, self._sides)
            self._ledger.checkpoint({"rig": self.rig.fingerprint})
        finally:
            self._ledger.close()

    def _write(self, row: past.HistoryRow) -> Noticed:
        whole = self.watched.drift_at(row.time)
        steady = self.watched.drift_at(row.time, gusts=False)
        sigma = steady.relative_covariance.diagonal().sqrt()
        told = whole.relative, whole.relative_covariance.diagonal().sqrt()
        text = past.history_line(row, self.rig.fingerprint, told)
        if not self._ledger.place.sequence:
            text = past.history_head() + text
        self._ledger.append([text.encode()], row.time, round(1e6 * row.time) + 1)
        self.looks += 1
        alarm = bool(exceeded(steady.relative, sigma, self.limit_deg, self.every_s).any())
        # One that ends within the noise of the limit has not ended.
        alarm = alarm or (self._alarm and float(steady.relative.abs().max()) > math.radians(self.limit_deg))
        begins, self._alarm = alarm and not self._alarm, alarm
        self.alarms += begins
        return Noticed(row, steady.relative, sigma, alarm, begins)

    def _check_lost(self, found: measure.TwoViews) -> None:
        for k, (side, name) in enumerate(zip(found.sides, ("left", "right"), strict=True)):
            self._lost[k] = self._lost[k] + 1 if side.lost else 0
            if self._lost[k] == _LOST:
                self.tell(
                    f"{name}: {_LOST} images in a row show a scene of which nothing is in the reference, and tell no "
                    "attitude: was the camera replaced or turned by more than 40 px, or is there snow? If so, solve "
                    "the rig anew and begin a new history"
                )

    def _renew(self, left: Gray, right: Gray) -> None:
        assert self._sides is not None
        turns, seen = self.watched.turns_at(self.last_time), self._rows[-1].look.seen.tolist()
        known = turns.mean[:3], turns.covariance[:3, :3], turns.mean[3:], turns.covariance[3:, 3:]
        one, other = self._sides
        self._sides = (
            measure.renewed(one, self.rig.left, left, *known[:2]) if seen[0] else one,
            measure.renewed(other, self.rig.right, right, *known[2:]) if seen[1] else other,
        )
        # Before the journal: a reference that is ahead of the history does no harm.
        measure.save_references(self.reference, self.rig, self._sides)
        self._ledger.checkpoint({"rig": self.rig.fingerprint})

    def _relearned(self) -> Watched:
        self._learned = self.last_time
        return Watched(self.rig, list(self._rows), model_of(list(self._rows)))
