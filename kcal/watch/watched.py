"""A rig and the history of its attitude: the rig of any moment, a stream that follows it, and a new rig file."""

from __future__ import annotations

import bisect
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

import kcal.watch.state as estimate
from kcal.calibrate.rig.drift import Drift, drift_of_turns
from kcal.errors import InputError
from kcal.lens.rig import RigCovariance, StereoRig
from kcal.locate.geodesy import enu_from_cam
from kcal.locate.localizer import StereoLocalizer
from kcal.locate.monitor import relocked
from kcal.watch.history import MOST_ROWS, HistoryRow, HistoryTail, read_history

# `Watched`: a rig and the history of its attitude; the rig of any moment, with the errors of that moment.

# Shared errors that a moment has beside those of the rig file.
MORE_ERRORS = 6
# Seconds of a history before and after the moments that are asked for: longer ago tells nothing more.
_BEFORE, _AFTER = 2 * 86400.0, 2 * 3600.0


class Watched:
    """A rig whose attitude was watched.

    Args:
        rig: as it was solved and watched.
        rows: of its history, in the order of time.
        model: how it turns; learned from the rows if left out.

    Example:
        >>> from kcal.locate.budget import planned_rig
        >>> from kcal.watch.history import no_look
        >>> rig = planned_rig()
        >>> watched = Watched(rig, [HistoryRow(0.0, no_look())])
        >>> float(watched.rig_at(60.0).baseline)  # nothing was seen: the same rig, less well known
        10.0
    """

    def __init__(
        self, rig: StereoRig, rows: Sequence[HistoryRow] = (), model: estimate.TurnModel | None = None
    ) -> None:
        self.rig, self.model = rig, model or model_of(rows)
        self.between = estimate.between_rows(rig)
        # Of which moments the rows tell all that the history does.
        self.since, self.until = -math.inf, math.inf
        self.times: list[float] = []
        self.states: list[estimate.TurnState] = []
        self.seen: list[bool] = []
        self._smooth: list[estimate.TurnState] | None = None
        for row in rows:
            self.take(row)

    @classmethod
    def read(cls, path: str | Path, rig: StereoRig, *, since: float = -math.inf, until: float = math.inf) -> Self:
        """Read the history that `kcal watch` wrote, as far as it tells of moments between two times.

        Raises:
            FileError: no history, or one of another rig.
        """
        found = cls(rig, read_history(path, rig.fingerprint, since=since - _BEFORE, until=until + _AFTER))
        found.since, found.until = since, until
        return found

    def take(self, row: HistoryRow, most: int | None = None) -> None:
        """Take in a further look; of more than `most` the oldest are forgotten.

        Raises:
            InputError: it is not later than the last one.
        """
        if self.times and not row.time > self.times[-1]:
            raise InputError(f"time {row.time:g}: not after that of the last look, {self.times[-1]:g}")
        if self.times:
            state, _ = estimate.passed(self.states[-1], torch.tensor(row.time - self.times[-1]).double(), self.model)
        else:
            state = estimate.first_state(self.model)
        self.times.append(row.time)
        self.states.append(estimate.taken(state, row.look, self.model, self.between))
        self.seen.append(bool(row.look.seen.all()))
        self._smooth = None
        if most is not None and len(self.times) > most:
            del self.times[: most // 2], self.states[: most // 2], self.seen[: most // 2]

    @property
    def cam_from_local(self) -> Tensor | None:
        """(3, 3) of the left camera, as the rig file says."""
        stands = self.rig.mounting
        return None if stands is None else enu_from_cam(stands.heading_deg, stands.pitch_deg, stands.roll_deg).T

    def turns_at(self, time: float, *, gusts: bool = True) -> estimate.Turns:
        """The turn of both cameras at a moment, from the looks before and after it.

        Raises:
            InputError: before the first look.
        """
        k = bisect.bisect_right(self.times, time) - 1
        if k < 0:
            begin = f"it begins at {self.times[0]:.0f}" if self.times else "it has no rows"
            raise InputError(f"time {time:.0f} s: the history of the rig tells nothing of that moment; {begin}")
        if self._smooth is None and k + 1 < len(self.times):
            self._smooth = estimate.smoothed(self.states, self.times, self.model)
        state, _ = estimate.passed(self.states[k], torch.tensor(time - self.times[k]).double(), self.model)
        if self._smooth is not None and k + 1 < len(self.times):
            state = estimate.smoothed([state, self._smooth[k + 1]], [time, self.times[k + 1]], self.model)[0]
        return estimate.turns_of(state, self.model, gusts=gusts)

    def drift_at(self, time: float, *, gusts: bool = True) -> Drift:
        """How the cameras have turned since the reference; see `turns_at`."""
        return drift_of_turns(self.rig, *self.turns_at(time, gusts=gusts), self.cam_from_local)

    def rig_at(self, time: float) -> StereoRig:
        """The rig as it stood at a moment: attitudes corrected, with the covariance of that moment on top.

        Args:
            time: seconds, as in the history.

        Raises:
            InputError: before the first look.
        """
        rig = relocked(
            _uncertain(self.rig), self.drift_at(time), f"at {time:.3f} s, from the history of the watched rig"
        )
        # The same number of shared errors at every moment, for filters.
        known = rig.covariance
        if known is not None:
            more = len(self.rig.covariance.half if self.rig.covariance else []) + MORE_ERRORS - len(known.half)
            rig.covariance = RigCovariance(half=torch.nn.functional.pad(known.half, (0, 0, 0, more)))
        return rig


def _uncertain(rig: StereoRig) -> StereoRig:
    """The rig, with an exact mounting as one whose covariance is zero: a moment adds to it."""
    stands = rig.mounting
    if stands is None or stands.covariance is not None:
        return rig
    same = StereoRig(rig.left, rig.right, rig.right_from_left_rotation, rig.right_from_left_translation)
    same.covariance, same.calibration = rig.covariance, rig.calibration
    same.mounting = dataclasses.replace(stands, covariance=torch.zeros(6, 6, dtype=torch.float64))
    return same


def model_of(rows: Sequence[HistoryRow]) -> estimate.TurnModel:
    """How a rig turns, as its history tells."""
    if not rows:
        return estimate.TurnModel.usual()
    looks = [row.look for row in rows]
    seen = torch.stack([look.seen for look in looks]).repeat_interleave(3, -1)
    own = torch.stack([look.covariance.diagonal() for look in looks])
    share = torch.stack([look.lasting for look in looks])[:, None]

    def array(values: Tensor) -> NDArray[np.float64]:
        found: NDArray[np.float64] = values.numpy()
        return found

    return estimate.learned(estimate.AngleSeries(
        time=np.array([row.time for row in rows]),
        angle=array(torch.where(seen, torch.stack([look.turn for look in looks]), math.nan)),
        variance=array((1.0 - share) * own),
        lasting=array(share * own),
        kelvin=array(torch.stack([look.kelvin for look in looks])[:, None].expand(-1, 6)),
    ))  # fmt: skip


# A new rig file from a history, and only where the history proves that the old one is wrong for good.

# Seconds of a history before a swing of the day is known, and looks at its end that were not used for the proof.
_DAY, _HELD_OUT = 86400.0, 20


class Relock(NamedTuple):
    """The corrected rig, None where it would not be surely better; and why."""

    rig: StereoRig | None
    reason: str


def relock(watched: Watched) -> Relock:
    """The rig with the mean attitude of the last day, if that differs from the rig file's beyond the swing of a day.

    A new file is used without the watch: its covariance contains the swing. It must explain the last looks, which take
    no part in the mean, better than the old one.
    """
    if not watched.times or watched.times[-1] - watched.times[0] < _DAY:
        return Relock(None, "a day of history is needed, so that a swing is not taken for a drift")
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
        return Relock(None, f"the last {_HELD_OUT} looks fit the old rig file better")
    better = relocked(watched.rig, drift, f"mean of the day before {end:.0f} s")
    return Relock(better, f"χ² {drift.chi2:.0f} of the turn; the last looks: {old:.0f} before, {new:.0f} after")


# A watched rig in a stream: the localizer of each moment, from a history that another process writes.

# Seconds for which an attitude counts, and rows that are kept.
_STEP_S, _KEPT = 10.0, MOST_ROWS // 4


class Followed:
    """Call it with a time: the localizer of that moment; the same one for ten seconds.

    Args:
        history: of `kcal watch`, which may grow.
        localize: the rig as it was solved, and where it stands.

    Raises:
        FileError: no history, or one of another rig.
    """

    def __init__(self, history: Path, localize: StereoLocalizer) -> None:
        self._tail, self._solved = HistoryTail(history, localize.rig.fingerprint), localize
        self._watched = Watched(localize.rig, self._tail.rows())
        self._now, self._until = localize, -math.inf

    def __call__(self, time: float) -> StereoLocalizer:
        """The localizer of a moment.

        Raises:
            InputError: a moment before the history begins.
        """
        if self._until - _STEP_S <= time < self._until:
            return self._now
        for row in self._tail.rows():
            self._watched.take(row, _KEPT)
        if not self._watched.times:
            raise InputError("--watch: the history has no rows yet: let `kcal watch` look at the scene first")
        self._now = standing(self._solved, self._watched, time)
        self._until = time + _STEP_S
        return self._now


def standing(solved: StereoLocalizer, watched: Watched, time: float) -> StereoLocalizer:
    """A localizer as the rig stands at a moment; its place stays where it was given."""
    rig = watched.rig_at(time)
    if solved.rig.mounting is not None and solved.origin == solved.rig.mounting.origin:
        return StereoLocalizer(rig, pixel_sigma=float(solved.pixel_sigma))
    heading, pitch, roll = solved.attitude_deg
    return StereoLocalizer(
        rig,
        origin=solved.origin,
        heading_deg=heading,
        pitch_deg=pitch,
        roll_deg=roll,
        pixel_sigma=float(solved.pixel_sigma),
    )
