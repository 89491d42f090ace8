"""Smoothing afterwards: what later sightings say of earlier moments (Rauch, Tung, Striebel).

The pass back follows the noise alone, like the filter's gain. The effect of the shared errors is carried through it, so
that it stays in the smoothed covariance as it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.locate.multi_localizer import MultiViewLocalizer
from kcal.pipeline.estimates import TrackStates, track_states
from kcal.pipeline.imm_filter import Summary


class SmoothedTrack(NamedTuple):
    """One track at the M moments of its life.

    Attributes:
        number: as in `Tracks`.
        time: (M,) seconds.
        state: places and velocities, M of them.
    """

    number: int
    time: Tensor
    state: TrackStates


class _Moment(NamedTuple):
    """A track at one moment, each (1, ...); `prior` and `cross` tell how it was predicted, None at birth.

    `clock` are the values of the clock's errors with which both were made.
    """

    time: float
    frame: Tensor
    home: Tensor
    belief: Summary
    prior: Summary | None
    cross: Tensor | None
    clock: Tensor


class History:
    """What smoothing needs of each track, by its key: it grows by some kilobytes for each track and moment."""

    def __init__(self) -> None:
        self._moments: dict[int, list[_Moment]] = {}
        self._priors: dict[int, tuple[Summary, Tensor]] = {}
        self._clock = torch.zeros(0)
        self.numbers: dict[int, int] = {}

    def predicted(self, keys: Sequence[int], prior: Summary, cross: Tensor, clock: Tensor) -> None:
        """Note what is believed before the sightings of a moment."""
        places = [torch.tensor([i], device=cross.device) for i in range(len(keys))]
        self._clock = clock
        self._priors = {key: (prior.at(i), cross[i]) for key, i in zip(keys, places, strict=True)}

    def filtered(
        self, time: float, keys: Sequence[int], frame: Tensor, home: Tensor, beliefs: Summary, clock: Tensor
    ) -> None:
        """Note what is believed after them; tracks that are gone may be missing."""
        for place, key in enumerate(keys):
            which = torch.tensor([place], device=frame.device)
            prior, cross = self._priors.get(key, (None, None))
            if prior is not None:
                # The sightings of this moment told something of the clock.
                prior = _moved(prior, clock - self._clock)
            moment = _Moment(time, frame[which], home[which], beliefs.at(which), prior, cross, clock)
            self._moments.setdefault(key, []).append(moment)
        self._priors = {}

    def confirmed(self, key: int, number: int) -> None:
        """A track got its number; several may share one, if motion recognized the target."""
        self.numbers[key] = number

    def smoothed(self, localize: MultiViewLocalizer, clock: Tensor, root: Tensor | None) -> list[SmoothedTrack]:
        """All confirmed tracks, with the clock as now known and a root of the covariance of the shared errors."""
        by_number: dict[int, list[tuple[_Moment, Summary]]] = {}
        for key, number in self.numbers.items():
            moments = [_with_clock(moment, clock) for moment in self._moments[key]]
            by_number.setdefault(number, []).extend(zip(moments, _passed_back(moments), strict=True))
        found = []
        for number, pairs in sorted(by_number.items()):
            pairs.sort(key=lambda pair: pair[0].time)
            beliefs = Summary(*(torch.cat(values) for values in zip(*(belief for _, belief in pairs), strict=True)))
            frame, home = (torch.cat([getattr(moment, name) for moment, _ in pairs]) for name in ("frame", "home"))
            time = torch.tensor([moment.time for moment, _ in pairs], dtype=torch.float64)
            found.append(SmoothedTrack(number, time, track_states(localize, frame, home, beliefs, root)))
        return found


def _moved(belief: Summary, clock: Tensor) -> Summary:
    """The belief after the clock's errors became known to be larger by `clock`."""
    first = belief.effect.shape[-1] - len(clock)
    return belief._replace(mean=belief.mean + belief.effect[..., first:] @ clock)


def _with_clock(moment: _Moment, clock: Tensor) -> _Moment:
    change = clock - moment.clock
    prior = None if moment.prior is None else _moved(moment.prior, change)
    return moment._replace(belief=_moved(moment.belief, change), prior=prior)


def _passed_back(moments: list[_Moment]) -> list[Summary]:
    beliefs = [moments[-1].belief]
    for now, later in zip(moments[-2::-1], moments[:0:-1], strict=True):
        if later.prior is None or later.cross is None:
            beliefs.append(now.belief)
            continue
        mean, noise, effect = now.belief
        prior, after = later.prior, beliefs[-1]
        # Units of one sigma: directions and inverse ranges differ by orders of magnitude.
        unit = prior.noise.diagonal(dim1=-2, dim2=-1).rsqrt()
        white = unit[..., :, None] * prior.noise * unit[..., None, :]
        gain = (later.cross * unit[..., None, :]) @ torch.linalg.inv_ex(white)[0] * unit[..., None, :]
        beliefs.append(
            Summary(
                mean + (gain @ (after.mean - prior.mean)[..., None])[..., 0],
                noise + gain @ (after.noise - prior.noise) @ gain.mT,
                effect + gain @ (after.effect - prior.effect),
            )
        )
    return beliefs[::-1]
