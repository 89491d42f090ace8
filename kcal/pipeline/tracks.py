"""`Tracker`: pairs of one moment after another become tracks with places, velocities and honest errors."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.errors import InputError
from kcal.lens.pose import side_axes
from kcal.locate.localizer import StereoLocalizer
from kcal.pipeline.assignment import Candidates, assigned, mark_numbers, within
from kcal.pipeline.estimates import TrackStates
from kcal.pipeline.imm_filter import (
    Beliefs,
    Timing,
    born,
    cross_covariance,
    no_beliefs,
    predicted,
)
from kcal.pipeline.measurements import Sightings, anchored
from kcal.pipeline.motion import MOTIONS, Motion, step_numbers, transition
from kcal.pipeline.pairs import ObjectPairs
from kcal.pipeline.shared_errors import ClockEstimate, ClockPrior, SharedErrors
from kcal.pipeline.small_matrices import mahalanobis, product, squared
from kcal.pipeline.smoothing import History, SmoothedTrack
from kcal.pipeline.track_steps import compiled_steps, track_steps

# A frame is turned toward its target when that is farther from the axis than this tangent: 17°.
_TURN = 0.3


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """When tracks begin and end, and how targets move.

    Args:
        motions: models among which each track may switch.
        switch_s: mean time between switches, seconds.
        speed_mps: standard deviation of a new target's velocity along each axis.
        confirm_hits: sightings after which a track is told of; twice as many if its pairs are ambiguous.
        lose_after_s: seconds without a sighting after which a track is told of no more.
        forget_after_s: seconds without a sighting in which it may still be recognized by its motion.
        gate: largest squared Mahalanobis distance of a sighting from its track; 23.5 loses one in 10,000.
        recognize: the same of a new track from a lost one, in place and velocity; 16.8 loses one in 100.
        lasting_px: standard deviation of the part of a mark's error that stays the same as long as a target is seen,
            along each axis of the right image, pixels. Matched images have 0.01 px of it, compressed ones 0.02 px
            (`scripts/check/compression.py`).

    Raises:
        InputError: a value that is not positive (`lasting_px` may be zero), or a forgetting before the losing.
    """

    motions: tuple[Motion, ...] = MOTIONS
    switch_s: float = 20.0
    speed_mps: float = 15.0
    confirm_hits: int = 4
    lose_after_s: float = 1.5
    forget_after_s: float = 15.0
    gate: float = 23.5
    recognize: float = 16.8
    lasting_px: float = 0.01

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            zero = field.name == "lasting_px" and value == 0
            if field.name != "motions" and not zero and not 0 < value < math.inf:
                raise InputError(f"{field.name} {value}: a positive number is needed")
        if not self.motions or self.forget_after_s < self.lose_after_s:
            raise InputError("tracks: at least one motion is needed, and forget_after_s not below lose_after_s")

    @classmethod
    def for_video(cls, match_sigma: float) -> Self:
        """Options for matches in compressed video; `match_sigma` is as in `kcal live`.

        A third of what compression adds to a match lasts (`scripts/check/compression.py`).
        """
        return cls(lasting_px=math.hypot(cls.lasting_px, match_sigma / 3.0))


@dataclasses.dataclass
class TrackRecord:
    """What is remembered of a track besides its state; `number` is 0 until it is confirmed."""

    number: int
    key: int
    first: float
    last: float
    hits: int
    needed: int
    evidence: float
    categories: dict[str, float]

    @property
    def category(self) -> str:
        """The one with the highest sum of scores."""
        return max(self.categories, key=lambda name: self.categories[name])


class Tracks(NamedTuple):
    """The confirmed tracks at one moment.

    Attributes:
        time: seconds.
        number: T numbers, from 1; a track keeps its number after an occlusion if its motion recognizes it.
        category: T names.
        hits: (T,) sightings so far.
        unseen_s: (T,) seconds since the last one; zero if seen now.
        state: places and velocities.
        models: (T, J) probabilities of `TrackOptions.motions`.
    """

    time: float
    number: tuple[int, ...]
    category: tuple[str, ...]
    hits: Tensor
    unseen_s: Tensor
    state: TrackStates
    models: Tensor


class Tracker:
    """Follow targets through pairs of marks; call it with the pairs of each moment in turn.

    Errors of calibration, mounting and clocks are shared by all tracks and frames, and a part of each target's errors
    in the marks lasts: frames reduce the noise of the marks, and never what these contribute.

    Args:
        localize: the rig, where it stands, and how well both are known.
        options: when tracks begin and end.
        clock: what is known of the clocks; with sigmas above zero they are estimated from the tracks.
        record: keep what `smoothed` needs; memory then grows with time.
        compiled: translate the filter to C++ first, which takes three minutes, or one where torch remembers;
            each moment of many tracks then takes about half the time.
        moments: `localize` as it stands at a time, with `moving` more errors; neither compiled nor recorded.

    Example:
        >>> from kcal import Origin
        >>> from kcal.rig import planned_rig
        >>> rig = planned_rig()
        >>> tracker = Tracker(StereoLocalizer(rig, origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0))
        >>> for time in torch.arange(10).double() / 10:
        ...     left, right, _ = rig(torch.tensor([[0.0, 0.0, 500.0]]) + time * torch.tensor([8.0, 0.0, 0.0]))
        ...     pairs = ObjectPairs(left=left, right=right, covariance=0.04 * torch.eye(4)[None],
        ...                         time=time.expand(1, 2), score=torch.ones(1), category=("car",), track=(None,),
        ...                         ambiguous=torch.zeros(1, dtype=torch.bool))
        ...     tracks = tracker(pairs)
        >>> tracks.number, round(tracks.state.enu[0, 1].item()), round(tracks.state.velocity[0, 0].item())
        ((1,), 500, 8)
    """

    def __init__(
        self,
        localize: StereoLocalizer,
        options: TrackOptions | None = None,
        *,
        clock: ClockPrior | None = None,
        record: bool = False,
        compiled: bool = False,
        moments: Callable[[float], StereoLocalizer] | None = None,
        moving: int = 0,
    ) -> None:
        if moments is not None and (compiled or record):
            raise InputError("a rig that moves: neither compiled filters nor records are possible")
        self.localize, self.solved, self.moments, self.options = localize, localize, moments, options or TrackOptions()
        factor = localize.calibration_factor
        # What lasts of the marks' errors behaves as the calibration's errors do, though each track has its own.
        self.calibration = (0 if factor is None else factor.shape[1]) + moving + (2 if self.options.lasting_px else 0)
        device = localize.enu_from_rig.device
        self.shared = SharedErrors(self.calibration, clock or ClockPrior(), device)
        self.time = -math.inf
        self.records: list[TrackRecord] = []
        self.history: History | None = History() if record else None
        models = len(self.options.motions)
        empty = torch.zeros(0, dtype=torch.float64, device=device)
        # (3, 3, T) rotations from the rig's axes.
        self.frame = empty.reshape(3, 3, 0)
        self.beliefs = no_beliefs(self.calibration, models, device)
        self.next_number = self.next_key = 1
        self.steps = track_steps(localize, self.options.lasting_px)
        if compiled:
            self.steps = compiled_steps(self.steps, self.calibration, models, self.shared.root)

    @torch.no_grad()
    def __call__(self, pairs: ObjectPairs, time: float | None = None) -> Tracks:
        """Take in the pairs of one moment; moments must not go back in time.

        Args:
            pairs: may be empty if `time` is given.
            time: seconds to which tracks are moved; the latest exposure of the left camera if left out.

        Raises:
            InputError: a time before that of the last call, or none.
        """
        if time is None:
            if not len(pairs):
                raise InputError("no pairs: give the time to which the tracks are to be moved")
            time = float(pairs.time[:, 0].max())
        if not self.time <= time < math.inf:
            raise InputError(f"time {time}: it must be finite and not before the last one, {self.time}")
        if self.shared.start is None:
            self.shared.start = time
        if self.moments is not None and (stands := self.moments(time)) is not self.localize:
            self.localize, self.steps = stands, track_steps(stands, self.options.lasting_px)
        self._predict(time)
        if len(pairs):
            self._take(pairs, self.steps.measure(pairs.left, pairs.right, pairs.covariance, pairs.time))
        self._sort_out()
        if self.history is not None:
            keys = [track.key for track in self.records]
            self.history.filtered(time, keys, self.frame.movedim(-1, 0), self.beliefs.summary(), self.shared.values)
        return self.tracks()

    def set_clock(self, time: float) -> None:
        """Go on at another time, also an earlier one: the clock was set, or nothing came for long.

        Tracks end, because nobody knows how much time has passed; numbers go on, and so does what is known of the
        offset between the cameras' clocks.
        """
        if self.shared.start is not None and time < self.time:
            # The drift counts from there.
            self.shared.start += time - self.time
        self.time = -math.inf
        self.records = []
        self.frame = self.frame[..., :0]
        self.beliefs = no_beliefs(self.calibration, len(self.options.motions), self.frame.device)

    def tracks(self) -> Tracks:
        """The confirmed tracks as they are now."""
        told = [i for i, track in enumerate(self.records) if self._is_told(track)]
        which = torch.tensor(told, dtype=torch.long, device=self.frame.device)
        records = [self.records[i] for i in told]
        return Tracks(
            time=self.time,
            number=tuple(track.number for track in records),
            category=tuple(track.category for track in records),
            hits=torch.tensor([track.hits for track in records], dtype=torch.long),
            unseen_s=torch.tensor([self.time - track.last for track in records], dtype=torch.float64),
            state=self.steps.place(self.beliefs, self.frame, self.shared.root, which),
            models=self.beliefs.weight[:, which].T,
        )

    def clock_estimate(self) -> ClockEstimate:
        """What the tracks have told of the clocks so far."""
        return self.shared.clock_estimate()

    def smoothed(self) -> list[SmoothedTrack]:
        """Every confirmed track with the knowledge of all moments, if `record` was set; it may be called at any time.

        Raises:
            InputError: nothing was recorded.
        """
        if self.history is None:
            raise InputError("nothing was recorded; make the tracker with record=True")
        return self.history.smoothed(self.localize, self.shared.values, self.shared.root)

    def _is_told(self, track: TrackRecord) -> bool:
        return track.number > 0 and self.time - track.last <= self.options.lose_after_s

    def _predict(self, time: float) -> None:
        dt, self.time = time - self.time, time
        if not self.records:
            return
        numbers = self.frame.new_tensor(step_numbers(self.options.motions, dt))
        stay = self.frame.new_tensor(math.exp(-dt / self.options.switch_s))
        up = (self.frame * self.localize.enu_from_rig[2, :, None]).sum(1)
        aim, turn = self.beliefs.middle[:2, 0], None
        if bool((aim.abs() > _TURN).any()):
            turn = _toward(aim)
            self.frame = product(turn, self.frame)
        elif self.history is None:
            self.beliefs = self.steps.move(self.beliefs, up, numbers, stay)
            return
        beliefs, step = self.beliefs.mixed(stay), transition(numbers, up)
        self.beliefs = predicted(beliefs, step, turn)
        if self.history is not None:
            keys = [track.key for track in self.records]
            cross = cross_covariance(beliefs, self.beliefs, step, turn)
            self.history.predicted(keys, self.beliefs.summary(), cross, self.shared.values)

    def _take(self, pairs: ObjectPairs, seen: Sightings) -> None:
        timing = self._delays(seen)
        marks = mark_numbers(pairs.left, pairs.right)
        taken = [False] * len(pairs)
        if self.records:
            frame, root, gate = self.frame, self.shared.root, self.options.gate
            merged, close = self.steps.look(self.beliefs, frame, seen, timing, root, root.new_tensor(gate))
            track, pair = close.nonzero(as_tuple=True)
            found = self.steps.score(merged, frame, seen, timing, root, track, pair)
            possible = within(found, track, pair, gate)
            evidence = [track.evidence for track in self.records]
            accepted = assigned(possible, marks, evidence, [self._tier(track) for track in self.records])
            if accepted:
                self._update(possible, torch.tensor(accepted), pairs, timing)
                used = marks[possible.pair[accepted].cpu().numpy()]
                left, right = (set(column) for column in used.T.tolist())
                taken = [first in left or second in right for first, second in marks.tolist()]
        fresh = [i for i, usable in enumerate(seen.usable.tolist()) if usable and not taken[i]]
        if fresh:
            self._begin(torch.tensor(fresh), pairs, seen, timing)
        if self.shared.estimated:
            move = self.shared.settle()
            shift = (self.beliefs.effect[:, self.calibration :] * move[:, None, None]).sum(1)
            self.beliefs = self.beliefs._replace(mean=self.beliefs.mean + shift)

    def _delays(self, seen: Sightings) -> Timing:
        since = seen.time[1] - (self.shared.start or 0.0)
        clock = torch.stack([torch.ones_like(since), since, seen.row])
        known = torch.stack([torch.zeros_like(since), self.shared.values @ clock])
        unsure = (self.shared.root[self.calibration :].T @ clock).square().sum(0).sqrt()
        return Timing(seen.time - self.time + known, clock, unsure)

    def _tier(self, track: TrackRecord) -> int:
        if track.number == 0:
            return 1
        return 0 if self.time - track.last <= self.options.lose_after_s else -1

    def _update(self, possible: Candidates, rows: Tensor, pairs: ObjectPairs, timing: Timing) -> None:
        track, pair, scores = possible.track[rows], possible.pair[rows], possible.scores
        if self.shared.estimated:
            known = torch.tensor([self.records[i].number > 0 for i in track.tolist()])
            sure = scores.at(rows[known & (scores.squared[rows] < 13.3)])
            self.shared.add(sure.effect, sure.innovation, sure.covariance)
        old, seen = self.beliefs.at(track), scores.seen.at(rows)
        new = self.steps.take(old, seen, timing.at(pair), self.shared.root)
        both = zip(self.beliefs, new, strict=True)
        self.beliefs = Beliefs(*(value.index_copy(-1, track, part) for value, part in both))
        densities, weights = scores.log_density[rows].tolist(), pairs.score.tolist()
        for t, p, density in zip(track.tolist(), pair.tolist(), densities, strict=True):
            record = self.records[t]
            record.last, record.hits = self.time, record.hits + 1
            record.evidence += density
            name = pairs.category[p]
            record.categories[name] = record.categories.get(name, 0.0) + weights[p]

    def _begin(self, which: Tensor, pairs: ObjectPairs, seen: Sightings, timing: Timing) -> None:
        seen = seen.at(which)
        ray = torch.nn.functional.normalize(seen.direction.T, dim=-1)
        frame = torch.stack([*side_axes(ray), ray]).movedim(-1, 1)
        new = born(anchored(seen, frame), timing.at(which), self.options.speed_mps, len(self.options.motions))
        self.beliefs = Beliefs(*(torch.cat(both, -1) for both in zip(self.beliefs, new, strict=True)))
        self.frame = torch.cat([self.frame, frame], -1)
        for i in which.tolist():
            needed = self.options.confirm_hits * (2 if bool(pairs.ambiguous[i]) else 1)
            scores = {pairs.category[i]: float(pairs.score[i])}
            self.records.append(TrackRecord(0, self.next_key, self.time, self.time, 1, needed, 0.0, scores))
            self.next_key += 1

    def _sort_out(self) -> None:
        """Confirm, recognize and forget."""
        for i, track in enumerate(self.records):
            if track.number == 0 and track.hits >= track.needed:
                lost = self._recognized(i)
                if lost is None:
                    track.number, self.next_number = self.next_number, self.next_number + 1
                else:
                    old = self.records[lost]
                    track.number, track.first, track.hits = old.number, old.first, old.hits + track.hits
                    track.categories = old.categories | track.categories
                    # Forgotten below: its number lives on.
                    old.last = -math.inf
                if self.history is not None:
                    self.history.confirmed(track.key, track.number)
        limits = [self.options.forget_after_s if t.number else 0.5 * self.options.lose_after_s for t in self.records]
        kept = [i for i, track in enumerate(self.records) if self.time - track.last <= limits[i]]
        if len(kept) < len(self.records):
            which = torch.tensor(kept, dtype=torch.long, device=self.frame.device)
            self.beliefs, self.frame = self.beliefs.at(which), self.frame[..., which]
            self.records = [self.records[i] for i in kept]

    def _recognized(self, new: int) -> int | None:
        """The lost track that a new one continues, if there is one and only one."""
        first, tracks = self.records[new].first, enumerate(self.records)
        lost = [i for i, track in tracks if track.number and not self._is_told(track) and track.last < first]
        if not lost:
            return None
        which = torch.tensor(lost, device=self.frame.device)
        old, here = self.beliefs.at(which).merged(), self.beliefs.at(torch.tensor([new])).merged()
        frame, to = self.frame[..., which], self.frame[..., new, None]
        up = (frame * self.localize.enu_from_rig[2, :, None]).sum(1)
        still = transition(frame.new_tensor(step_numbers((Motion(acceleration=0.0),), 0.0)), up)
        old = predicted(old, still, product(to, frame.transpose(0, 1)))
        spread = product(here.effect - old.effect, self.shared.root[..., None, None])
        distance = mahalanobis(here.noise + old.noise + squared(spread), here.mean - old.mean)[0][0]
        near = [i for i, value in zip(lost, distance.tolist(), strict=True) if value <= self.options.recognize]
        return near[0] if len(near) == 1 else None


def _toward(aim: Tensor) -> Tensor:
    """Rotations (3, 3, T) that bring the directions (x, y, 1) onto the axis; none where they are near it."""
    ray = torch.nn.functional.normalize(torch.cat([aim, torch.ones_like(aim[:1])]).T, dim=-1)
    turned = torch.stack([*side_axes(ray), ray]).movedim(-1, 1)
    still = torch.eye(3, dtype=aim.dtype, device=aim.device)[..., None].expand_as(turned)
    return torch.where(aim.abs().amax(0) > _TURN, turned, still)
