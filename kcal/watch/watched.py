"""`Watched`: a rig and the history of its attitude; the rig of any moment, with the errors of that moment."""

from __future__ import annotations

import bisect
import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.calibrate.rig.drift import Drift, drift_of_turns
from kcal.errors import InputError
from kcal.lens.rig import RigCovariance, StereoRig
from kcal.locate.geodesy import enu_from_cam
from kcal.locate.relock import relocked
from kcal.watch.history import HistoryRow, read_history
from kcal.watch.model import AngleSeries, TurnModel, learned
from kcal.watch.state import Turns, TurnState, between_rows, first_state, passed, smoothed, taken, turns_of

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

    def __init__(self, rig: StereoRig, rows: Sequence[HistoryRow] = (), model: TurnModel | None = None) -> None:
        self.rig, self.model = rig, model or model_of(rows)
        self.between = between_rows(rig)
        # Of which moments the rows tell all that the history does.
        self.since, self.until = -math.inf, math.inf
        self.times: list[float] = []
        self.states: list[TurnState] = []
        self.seen: list[bool] = []
        self._smooth: list[TurnState] | None = None
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
            state, _ = passed(self.states[-1], torch.tensor(row.time - self.times[-1]).double(), self.model)
        else:
            state = first_state(self.model)
        self.times.append(row.time)
        self.states.append(taken(state, row.look, self.model, self.between))
        self.seen.append(bool(row.look.seen.all()))
        self._smooth = None
        if most is not None and len(self.times) > most:
            del self.times[: most // 2], self.states[: most // 2], self.seen[: most // 2]

    @property
    def cam_from_local(self) -> Tensor | None:
        """(3, 3) of the left camera, as the rig file says."""
        stands = self.rig.mounting
        return None if stands is None else enu_from_cam(stands.heading_deg, stands.pitch_deg, stands.roll_deg).T

    def turns_at(self, time: float, *, gusts: bool = True) -> Turns:
        """The turn of both cameras at a moment, from the looks before and after it.

        Raises:
            InputError: before the first look.
        """
        k = bisect.bisect_right(self.times, time) - 1
        if k < 0:
            begin = f"it begins at {self.times[0]:.0f}" if self.times else "it has no rows"
            raise InputError(f"time {time:.0f} s: the history of the rig tells nothing of that moment; {begin}")
        if self._smooth is None and k + 1 < len(self.times):
            self._smooth = smoothed(self.states, self.times, self.model)
        state, _ = passed(self.states[k], torch.tensor(time - self.times[k]).double(), self.model)
        if self._smooth is not None and k + 1 < len(self.times):
            state = smoothed([state, self._smooth[k + 1]], [time, self.times[k + 1]], self.model)[0]
        return turns_of(state, self.model, gusts=gusts)

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


def model_of(rows: Sequence[HistoryRow]) -> TurnModel:
    """How a rig turns, as its history tells."""
    if not rows:
        return TurnModel.usual()
    looks = [row.look for row in rows]
    seen = torch.stack([look.seen for look in looks]).repeat_interleave(3, -1)
    own = torch.stack([look.covariance.diagonal() for look in looks])
    share = torch.stack([look.lasting for look in looks])[:, None]

    def array(values: Tensor) -> NDArray[np.float64]:
        found: NDArray[np.float64] = values.numpy()
        return found

    return learned(AngleSeries(
        time=np.array([row.time for row in rows]),
        angle=array(torch.where(seen, torch.stack([look.turn for look in looks]), math.nan)),
        variance=array((1.0 - share) * own),
        lasting=array(share * own),
        kelvin=array(torch.stack([look.kelvin for look in looks])[:, None].expand(-1, 6)),
    ))  # fmt: skip
