"""Look at pairs of images as they come, write what they tell into the history, and say when a rig has drifted."""

from __future__ import annotations

import json
import math
import urllib.request
from collections import deque
from collections.abc import Callable
from http.client import HTTPException
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

import torch
from torch import Tensor

import kcal.watch.measure as measure
from kcal.corners.images import Gray
from kcal.errors import FileError, InputError
from kcal.lens.rig import StereoRig
from kcal.pipeline.stream_journal import Ledger
from kcal.watch.history import HistoryRow, Temperatures, history_head, history_line, read_history, warmed
from kcal.watch.watched import Watched, model_of

# When to say that a rig has drifted: beyond a limit, so surely that chance says it less than once a month.

# Degrees of the relative attitude: 0.005° of yaw is 4 % of the range at 5 km with a baseline of 10 m.
LIMIT = 0.005
_MONTH = 30 * 86400.0
# Seconds for an answer; what was not delivered is tried again at the next look.
_PATIENCE = 5.0


def alarm_sigmas(every_s: float) -> float:
    """Standard deviations by which a limit must be exceeded, for less than one false alarm a month.

    Three angles and two signs are looked at every so many seconds; that looks agree with each other makes it rarer.

    Example:
        >>> round(alarm_sigmas(60.0), 2)
        4.47
    """
    tries = 6.0 * _MONTH / every_s
    return math.sqrt(2.0) * float(torch.erfinv(torch.tensor(1.0 - 2.0 / tries, dtype=torch.float64)))


class Exceeded(NamedTuple):
    """Which of three angles (..., 3) are beyond the limit, and whether any is (...)."""

    angles: Tensor
    any: Tensor


def exceeded(turn: Tensor, sigma: Tensor, limit_deg: float, every_s: float) -> Exceeded:
    """Whether a relative turn (..., 3) with standard deviations (..., 3), radians, is surely beyond a limit."""
    beyond = turn.abs() - alarm_sigmas(every_s) * sigma > math.radians(limit_deg)
    return Exceeded(beyond, beyond.any(-1))


class Webhook:
    """Send alarms to an address as JSON; what is not delivered waits, the newest only.

    Args:
        address: http:// or https://.

    Raises:
        InputError: another kind of address.
    """

    def __init__(self, address: str) -> None:
        if urlsplit(address).scheme not in ("http", "https") or not urlsplit(address).hostname:
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
        request = urllib.request.Request(
            self.address, self._waiting, {"Content-Type": "application/json"}, method="POST"
        )
        try:
            with urllib.request.urlopen(request, timeout=_PATIENCE):
                self._waiting = b""
        except (OSError, ValueError, HTTPException):
            self.failed += 1


# `Watcher`: look at pairs of images as they come, and write what they tell into the history.

# Seconds between looks at the matches between the cameras, which take seconds; between times at which it is learned.
_BETWEEN_S, _LEARN_S = 3600.0, 86400.0
# Looks between checkpoints, at which references are renewed and saved; rows in memory: three days of a look a minute.
_CHECKPOINT, _KEPT = 60, 4320
# Looks in a row at images full of things of which none is what was there: another camera, or another view.
_LOST = 30


class Noticed(NamedTuple):
    """What a look has told.

    Attributes:
        row: of the history.
        turn: (3,) radians, relative, without wind.
        sigma: (3,) of it.
        alarm: whether it is beyond the limit surely.
        begins: whether it was not at the look before.
    """

    row: HistoryRow
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
        every_s: seconds between looks.
        limit_deg: relative turn beyond which there is an alarm.
        temperatures: of the air at the rig, if they are known.
        tell: called with what happens.

    Raises:
        FileError: a history or reference of another rig, a damaged one, or one that another process writes.
    """

    def __init__(
        self,
        rig: StereoRig,
        history: Path,
        *,
        every_s: float = 60.0,
        limit_deg: float = LIMIT,
        temperatures: Temperatures | None = None,
        tell: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.rig, self.every_s, self.limit_deg, self.tell = rig, every_s, limit_deg, tell
        self.history, self.reference = history, history.with_suffix(".reference.npz")
        self.skipped, self.looks, self.alarms = 0, 0, 0
        self._temperatures, self._warmth = temperatures, math.nan
        self._rows: deque[HistoryRow] = deque(maxlen=_KEPT)
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
                self._rows.extend(read_history(history, rig.fingerprint))
                first = [row.temperature for row in self._rows if not math.isnan(row.temperature)]
                self._warmth = self._warmth if not first else first[0] - float(
                    next(row.look.kelvin for row in self._rows if not math.isnan(row.temperature)))  # fmt: skip
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
        """Seconds of the last look; -inf before the first."""
        return self._rows[-1].time if self._rows else -math.inf

    @property
    def offset(self) -> int:
        """Microseconds of the last look's frame, from 1; 0 before the first."""
        return self._ledger.place.offset

    def due(self, time: float) -> bool:
        """Whether the next look may be at that time; images of an earlier one are counted and left out."""
        if time <= self.last_time:
            self.skipped += 1
            return False
        return time >= self.last_time + self.every_s

    def refer_to(self, left: Gray, right: Gray) -> None:
        """Take images of when the rig was solved as the reference, before the first look.

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
        """Look at images of a moment, and write a row.

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
        row = warmed(
            HistoryRow(time, found.look, counts, found.matches, warm, found.note), self._warmth,
            self._rows[-1].look.kelvin if self._rows else None,
        )  # fmt: skip
        self._sides = found.sides[0].reference, found.sides[1].reference
        self.watched.take(row, _KEPT)
        self._rows.append(row)
        noticed = self._write(row)
        if self._ledger.place.sequence % _CHECKPOINT == 0:
            self._renew(left, right)
        if time - self._learned >= _LEARN_S:
            self.watched = self._relearned()
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

    def _write(self, row: HistoryRow) -> Noticed:
        whole = self.watched.drift_at(row.time)
        steady = self.watched.drift_at(row.time, gusts=False)
        sigma = steady.relative_covariance.diagonal().sqrt()
        told = whole.relative, whole.relative_covariance.diagonal().sqrt()
        text = history_line(row, self.rig.fingerprint, told)
        if not self._ledger.place.sequence:
            text = history_head() + text
        self._ledger.append([text.encode()], row.time, round(1e6 * row.time) + 1)
        self.looks += 1
        alarm = bool(exceeded(steady.relative, sigma, self.limit_deg, self.every_s).any)
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
        turns = self.watched.turns_at(self.last_time)
        seen = self._rows[-1].look.seen.tolist()
        sides = [
            measure.renewed(side, camera, image, turns.mean[part], turns.covariance[part, part]) if there else side
            for side, camera, image, there, part in zip(
                self._sides,
                (self.rig.left, self.rig.right),
                (left, right),
                seen,
                (slice(0, 3), slice(3, 6)),
                strict=True,
            )
        ]
        self._sides = sides[0], sides[1]
        # Before the journal: a reference that is ahead of the history does no harm.
        measure.save_references(self.reference, self.rig, self._sides)
        self._ledger.checkpoint({"rig": self.rig.fingerprint})

    def _relearned(self) -> Watched:
        self._learned = self.last_time
        return Watched(self.rig, list(self._rows), model_of(list(self._rows)))
