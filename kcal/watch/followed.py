"""A watched rig in a stream: the localizer of each moment, from a history that another process writes."""

from __future__ import annotations

import math
from pathlib import Path

from kcal.errors import InputError
from kcal.locate.localizer import StereoLocalizer
from kcal.watch.history import MOST_ROWS, HistoryTail
from kcal.watch.watched import Watched

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
        return StereoLocalizer(rig, pixel_sigma=solved.pixel_sigma)
    heading, pitch, roll = solved.attitude_deg
    return StereoLocalizer(
        rig, origin=solved.origin, heading_deg=heading, pitch_deg=pitch, roll_deg=roll, pixel_sigma=solved.pixel_sigma
    )
