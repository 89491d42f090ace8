"""A new rig file from a history, and only where the history proves that the old one is wrong for good."""

from __future__ import annotations

from typing import NamedTuple

import torch

from kcal.calibrate.rig.drift import drift_of_turns
from kcal.lens.rig import StereoRig
from kcal.locate.relock import relocked
from kcal.watch.watched import Watched

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
