"""`Tracker`: objects of one time step after another become tracks with places, velocities and honest errors."""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Self, TypeAlias

import torch
from torch import Tensor

import kcal.pipeline.imm_filter as imm
import kcal.pipeline.measurements as measured
from kcal.checks import chi2_quantile, chi2_tail
from kcal.dispatch import known_true
from kcal.errors import InputError
from kcal.lens.pose import side_axes
from kcal.locate.localizer import Localizer
from kcal.locate.mounting import MOUNTING_ERRORS
from kcal.pipeline.assignment import Candidates, Looks, Scores, SeenFrom, assigned, looks_of, nearby, within
from kcal.pipeline.estimates import History, SmoothedTrack, TrackStates, track_states, track_table
from kcal.pipeline.measurements import Anchored, ClockEstimate, ClockPrior, SharedErrors, Sightings, anchored
from kcal.pipeline.pairing import ObjectViews, mark_numbers
from kcal.texts import brief, briefly

# When tracks begin and end, and what is told of them.


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackOptions:
    """When tracks begin and end, and how targets move.

    Args:
        motions: models among which each track may switch.
        switch_s: mean time between switches, seconds.
        speed_mps: standard deviation of a new target's velocity along each axis, times `fast` of each motion.
        confirm_hits: sightings after which a track is told of; twice as many if its pairs are ambiguous.
        lose_after_s: seconds without a sighting after which a track is told of no more.
        forget_after_s: seconds without a sighting in which it may still be recognized by its motion.
        gate: largest squared Mahalanobis distance of a sighting by two cameras from its track; 23.5 loses one in
            10,000. Of one camera, or of more, it is the distance that loses as many.
        recognize: the same of a new track from a lost one, in place and velocity; 16.8 loses one in 100.
        lasting_px: standard deviation of the part of a mark's error that stays the same as long as a target is seen,
            along each axis of all images but the first camera's, pixels. Matched images have 0.01 px of it, compressed
            ones 0.02 px (`scripts/check/compression.py`).

    Raises:
        InputError: a value that is not positive (`lasting_px` may be zero), or a forgetting before the losing.
    """

    __repr__ = brief

    motions: tuple[imm.Motion, ...] = imm.MOTIONS
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


@briefly
class Tracks(NamedTuple):
    """The confirmed tracks at one time.

    Attributes:
        time: seconds.
        number: T numbers, from 1; a track keeps its number after an occlusion if its motion recognizes it.
        category: T names.
        hits: (T,) sightings so far.
        unseen_s: (T,) seconds since the last one; zero if seen now.
        state: places and velocities.
        models: (T, J) probabilities of `TrackOptions.motions`.
        seen: (T, V) bool: which cameras see it at this time step.
    """

    time: float
    number: tuple[int, ...]
    category: tuple[str, ...]
    hits: Tensor
    unseen_s: Tensor
    state: TrackStates
    models: Tensor
    seen: Tensor

    def to_arrow(self) -> Any:
        """A `pyarrow.Table`, a row for each track, with the columns of the files of tracks; needs the extra `tables`.

        Example:
            >>> polars.concat(polars.DataFrame(tracker(views).to_arrow()) for views in moments)  # doctest: +SKIP
        """
        time, more = torch.full_like(self.unseen_s, self.time), {"hits": self.hits, "unseen_s": self.unseen_s}
        return track_table(self.state, self.number, time, {"category": [*self.category]}, more)


# What a tracker computes at each time step, as functions of tensors alone: as they are, or compiled.
#
# Sizes are T tracks under J models, N pairs, L possible matches.

# What a match gains for each mark that it explains: half the squared distance at which marks are no more taken.
_EXPLAINED = 12.0
# Of stand-ins from which graphs are made: sizes that no other axis has, so that none seem to belong together.
_STAND_INS = _PAIRS, _TRACKS, _MATCHES, _TAKEN, _TOLD = 1009, 1013, 1019, 1021, 1031


class TrackSteps(NamedTuple):
    """The steps, in their order.

    Attributes:
        measure: pixels, which are seen, covariances and times of a time step as sightings; see `sightings`.
        move: beliefs to another time; see `moved_on`.
        look: see `looked_at`, with beliefs that have come to the same time step.
        near: see `nearby`.
        score: see `scored`.
        take: see `taken_in`.
        place: tracks of these numbers on the Earth, from beliefs, frames, homes and a root as in `track_states`.
    """

    measure: Callable[[Tensor, Tensor, Tensor, Tensor], Sightings]
    move: Callable[[imm.Beliefs, Tensor, Tensor, Tensor], imm.Beliefs]
    look: Callable[[imm.Beliefs, Tensor, Tensor, Tensor | None], tuple[imm.Beliefs, Looks]]
    near: Callable[[Looks, Sightings, imm.Timing, Tensor], Tensor]
    score: Callable[[imm.Beliefs, Tensor, Tensor, Sightings, imm.Timing, Tensor | None, Tensor, Tensor], Scores]
    take: Callable[[imm.Beliefs, Anchored, imm.Timing, Tensor | None], imm.Beliefs]
    place: Callable[[imm.Beliefs, Tensor, Tensor, Tensor | None, Tensor], TrackStates]


def moved_on(beliefs: imm.Beliefs, up: Tensor, numbers: Tensor, stay: Tensor) -> imm.Beliefs:
    """Beliefs after a step: `up` and `numbers` as in `transition`, `stay` as in `Beliefs.mixed`."""
    return imm.predicted(beliefs.mixed(stay), imm.transition(numbers, up))


def taken_in(beliefs: imm.Beliefs, seen: Anchored, timing: imm.Timing, root: Tensor | None) -> imm.Beliefs:
    """Beliefs with sightings, one for each track."""
    return imm.updated(beliefs, imm.innovations(beliefs, seen, timing), root)


def track_steps(localize: Localizer, lasting_px: float) -> TrackSteps:
    """The steps as they are."""
    centers, errors, bending = localize.rig.center, localize.errors, localize.bending_errors
    turned = None if errors is None else errors[:, :, 3:6].movedim(-1, 0)
    cameras, known = SeenFrom(centers, turned), measured.known_views(localize.posed, localize.common)
    k = float(known.posed.bending)

    def measure(pixels: Tensor, seen: Tensor, covariance: Tensor, time: Tensor) -> Sightings:
        return measured.sightings(known, pixels, seen, covariance, time, lasting_px)

    def looked_at(beliefs: imm.Beliefs, frame: Tensor, home: Tensor, root: Tensor | None) -> tuple[imm.Beliefs, Looks]:
        merged = beliefs.merged()
        return merged, looks_of(merged, frame, centers.T.index_select(1, home), cameras, root)

    def scored(
        merged: imm.Beliefs, frame: Tensor, home: Tensor, seen: Sightings, timing: imm.Timing, root: Tensor | None,
        track: Tensor, which: Tensor,
    ) -> Scores:  # fmt: skip
        """Sightings (L,) against tracks (L,), whose beliefs are merged."""
        beliefs, local = merged.at(track), seen.at(which)
        origin = centers.T.index_select(1, home[track])
        where = None if known_true(~local.alone) else beliefs.mean[:3, 0]
        there = anchored(local, frame.index_select(-1, track), origin, where, bending, k)
        found = imm.innovations(beliefs, there, timing.at(which))
        fit = imm.fit_of(found, root)
        density = fit.log_density[0] + _EXPLAINED * local.seen.sum(0)
        effect, noise = found.effect[..., 0, :], found.noise[..., 0, :]
        return Scores(there, effect, found.value[:, 0], noise, fit.squared[0], density)

    def place(beliefs: imm.Beliefs, frame: Tensor, home: Tensor, root: Tensor | None, which: Tensor) -> TrackStates:
        summary = beliefs.at(which).summary()
        return track_states(localize, frame.index_select(-1, which).movedim(-1, 0), home[which], summary, root)

    return TrackSteps(measure, moved_on, looked_at, nearby, scored, taken_in, place)


@torch.no_grad()
def compiled_steps(steps: TrackSteps, cameras: int, nothing: imm.Beliefs, root: Tensor | None) -> TrackSteps:
    """The steps in C++ for any numbers of tracks and sightings: this takes three minutes, less where torch remembers.

    Args:
        steps: from `track_steps`.
        cameras: V.
        nothing: beliefs of no tracks.
        root: (K + Q, R) of the covariance of the shared errors; None: the identity.

    Raises:
        InputError: torch could not compile, for want of a C++ compiler for instance.
    """
    made = TrackSteps(*(_Compiled(step) for step in steps))
    # This graph is many small kernels, which Python would call one by one.
    made = made._replace(measure=_Compiled(steps.measure, {"cpp_wrapper": True}))
    try:
        # Torch warns of itself.
        with warnings.catch_warnings(action="ignore", category=FutureWarning):
            _compile_all(made, cameras, nothing, root)
    except RuntimeError as error:
        raise InputError(f"tracks cannot be compiled here; without compiling they work ({error})") from error
    return made


def _compile_all(made: TrackSteps, cameras: int, nothing: imm.Beliefs, root: Tensor | None) -> None:
    """Call each step with stand-ins."""
    new, models = nothing.mean.new_zeros, nothing.mean.shape[1]
    unit = torch.eye(2 * cameras).to(nothing.mean).expand(_PAIRS, 2 * cameras, 2 * cameras)
    there = torch.ones(_PAIRS, cameras, dtype=torch.bool, device=unit.device)
    seen = made.measure(new(_PAIRS, cameras, 2), there, unit, new(_PAIRS, cameras))
    clocks = nothing.late.shape[1] // 3
    timing = imm.Timing(new(cameras, _PAIRS), new(clocks, 3, _PAIRS), new(clocks, _PAIRS))
    beliefs = imm.Beliefs(*(torch.nn.functional.pad(value, (0, _TRACKS), value=1.0) for value in nothing))
    frame = torch.eye(3).to(unit)[..., None].expand(3, 3, _TRACKS)
    sizes = (_TRACKS, _MATCHES, _MATCHES, _TAKEN, _TOLD)
    home, track, pair, taken, told = (torch.zeros(size, dtype=torch.long, device=unit.device) for size in sizes)
    beliefs = made.move(beliefs, frame[2], new(9, models), new(()))
    merged, looks = made.look(beliefs, frame, home, root)
    made.near(looks, seen, timing, new(()))
    # Each its own tensor: the same one twice would become a rule.
    scores = made.score(merged, frame, home, seen, timing, root, track, pair)
    made.take(beliefs.at(taken), scores.seen.at(taken), timing.at(taken), root)
    made.place(beliefs, frame, home, root, told)


class _Compiled:
    """A step that is compiled at its first call, for any sizes from 2; with fewer it is done as it is."""

    def __init__(self, step: Callable[..., Any], options: dict[str, Any] | None = None) -> None:
        self.step, self.made = step, torch.compile(step, fullgraph=True, options=options)
        # Of all tensors in the arguments: which, and which axis, may have any size.
        self.free: list[tuple[int, int]] | None = None

    def __call__(self, *arguments: Any) -> Any:
        # Other strides would need other code.
        given = [_contiguous(argument) for argument in arguments]
        tensors = [one for part in given if part is not None for one in (part if isinstance(part, tuple) else (part,))]
        if self.free is None:
            every = [(i, axis) for i, tensor in enumerate(tensors) for axis in range(tensor.ndim)]
            self.free = [(i, axis) for i, axis in every if tensors[i].shape[axis] in _STAND_INS]
            for i, axis in self.free:
                torch._dynamo.mark_dynamic(tensors[i], axis)
        if min(tensors[i].shape[axis] for i, axis in self.free) < 2:
            return self.step(*arguments)
        return self.made(*given)


def _contiguous(value: Any) -> Any:
    if value is None or isinstance(value, Tensor):
        return value if value is None else value.contiguous()
    return type(value)(*(part.contiguous() for part in value))


# `Tracker`: objects of one time step after another become tracks with places, velocities and honest errors.

# Of the gate: nearer sightings tell of the clocks. One in a hundred is left out where the gate loses one in 10,000.
_SURE = 13.3 / 23.5
_Ends: TypeAlias = "set[tuple[int, int]]"  # numbers of cameras and of their marks
# A frame is turned toward its target when that is farther from the axis than this tangent: 17°.
_TURN = 0.3


class Tracker:
    """Follow targets through marks of two cameras or more; call it with the objects of each time step in turn.

    Two cameras that see a target begin a track. It keeps its number while any camera sees it: one alone tells its
    bearing, and other cameras may take over. A target is told from the camera that saw it first.

    Errors of calibration, mounting and clocks are shared by all tracks and frames, and a part of each target's errors
    in the marks lasts: frames reduce the noise of the marks, and never what these contribute.

    Args:
        localize: the rig, where it stands, and how well both are known.
        options: when tracks begin and end.
        clock: what is known of the clock of each camera but the first, or one for all of them; with sigmas above zero
            they are estimated from the tracks.
        record: keep what `smoothed` needs; memory then grows with time.
        compiled: translate the filter to C++ first, which takes three minutes, or one where torch remembers;
            each time step of many tracks then takes about half the time.
        moments: `localize` as it stands at a time, with `moving` more errors; neither compiled nor recorded.

    Example:
        >>> from kcal import Origin
        >>> from kcal.rig import planned_rig
        >>> rig = planned_rig()
        >>> tracker = Tracker(Localizer(rig.placed(origin=Origin(lat=19.07, lon=72.87, height=14.0), heading_deg=0.0)))
        >>> for time in torch.arange(10).double() / 10:
        ...     place = torch.tensor([[0.0, 0.0, 500.0]]) + time * torch.tensor([8.0, 0.0, 0.0])
        ...     left, right = rig(place)[0].unbind(-2)
        ...     pairs = ObjectViews.of_pairs(left, right, covariance=0.04 * torch.eye(4)[None],
        ...                                  time=time.expand(1, 2), score=torch.ones(1), category=("car",))
        ...     tracks = tracker(pairs)
        >>> tracks.number, round(tracks.state.enu[0, 1].item()), round(tracks.state.velocity[0, 0].item())
        ((1,), 500, 8)
    """

    def __init__(
        self,
        localize: Localizer,
        options: TrackOptions | None = None,
        *,
        clock: ClockPrior | Sequence[ClockPrior] | None = None,
        record: bool = False,
        compiled: bool = False,
        moments: Callable[[float], Localizer] | None = None,
        moving: int = 0,
    ) -> None:
        if moments is not None and (compiled or record):
            raise InputError("a rig that moves: neither compiled filters nor records are possible")
        self.localize = localize.weighing_all()
        self.solved, self.moments, self.options = self.localize, moments, options or TrackOptions()
        rig, errors = self.localize.rig, self.localize.errors
        others = len(rig) - 1
        if rig.origin is None or not others:
            raise InputError(
                "tracks: two cameras or more with a place on the Earth are needed; solve the rig with landmarks, or "
                "give origin and heading_deg"
            )
        priors = [clock or ClockPrior()] * others if clock is None or isinstance(clock, ClockPrior) else list(clock)
        if len(priors) != others:
            raise InputError(f"clock: one, or one for each of {others} cameras beside the first, is needed")
        # What lasts of the marks' errors behaves as the calibration's errors do, though each track has its own.
        lasting = 2 * others if self.options.lasting_px else 0
        self.errors = (0 if errors is None else len(errors)) + (moving + MOUNTING_ERRORS if moments else 0)
        self.calibration = self.errors + lasting
        device = rig.center.device
        self.shared = SharedErrors(self.calibration, priors, device)
        # By the number of cameras: squared distances that lose as many sightings as `gate` does of two.
        loss, counts = float(chi2_tail(self.options.gate, 4)), torch.arange(len(rig) + 1.0)
        self.gates = chi2_quantile(2.0 * counts.clamp_min(1.0), 1.0 - loss).to(device)
        self._stands: Localizer | None = None
        self.time = -math.inf
        self.records: list[TrackRecord] = []
        self.history: History | None = History() if record else None
        empty = torch.zeros(0, dtype=torch.float64, device=device)
        # (3, 3, T) rotations from the rig's axes, and (T,) cameras from which tracks are told.
        self.frame, self.home = empty.reshape(3, 3, 0), empty.long()
        self.beliefs = self._nothing()
        self.next_number = self.next_key = 1
        # By key of a track and camera: the row of the last objects that it has its mark from.
        self.seen_now: dict[tuple[int, int], int] = {}
        self.steps = track_steps(self.localize, self.options.lasting_px)
        if compiled:
            self.steps = compiled_steps(self.steps, len(rig), self.beliefs, self.shared.mixing)

    def __repr__(self) -> str:
        confirmed = sum(record.number > 0 for record in self.records)
        return f"Tracker(time={self.time:.6f} s, {confirmed} tracks, {len(self.localize.rig)} cameras)"

    def __call__(self, views: ObjectViews, time: float | None = None) -> Tracks:
        """Take in the objects of one time step; time steps must not go back in time.

        Args:
            views: may be empty if `time` is given.
            time: seconds to which tracks are moved; if left out, the latest exposure of the first camera (of any, where
                that saw nothing).

        Raises:
            InputError: a time before that of the last call, or none.
        """
        # Operations of small tensors take some percent less time in this mode, which compiled steps do not know.
        with torch.no_grad() if isinstance(self.steps.move, _Compiled) else torch.inference_mode():
            found = self._taken(views, time)
        plain: list[Any] = [value.clone() if isinstance(value, Tensor) else value for value in found]
        return Tracks(*plain)._replace(state=TrackStates(*(value.clone() for value in found.state)))

    def _taken(self, views: ObjectViews, time: float | None) -> Tracks:
        if views.cameras != len(self.localize.rig):
            raise InputError(f"objects of {views.cameras} cameras, and the rig has {len(self.localize.rig)}")
        if time is None:
            if not bool(views.seen.any()):
                raise InputError("no objects: give the time to which the tracks are to be moved")
            first = views.seen[:, 0]
            time = float(views.time[:, 0][first].max() if bool(first.any()) else views.time[views.seen].max())
        if not self.time <= time < math.inf:
            raise InputError(f"time {time}: it must be finite and not before the last one, {self.time}")
        if self.shared.start is None:
            self.shared.start = time
        if self.moments is not None and (stands := self.moments(time)) is not self._stands:
            self._stands, self.localize = stands, stands.weighing_all(self.errors)
            self.steps = track_steps(self.localize, self.options.lasting_px)
        self._predict(time)
        self.seen_now = {}
        if len(views):
            self._take(views, self.steps.measure(views.pixels, views.seen, views.covariance, views.time))
        self._sort_out()
        if self.history is not None:
            keys = [track.key for track in self.records]
            beliefs, frame = self.beliefs.summary(), self.frame.movedim(-1, 0)
            self.history.filtered(time, keys, frame, self.home, beliefs, self.shared.corrected)
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
        self.frame, self.home, self.beliefs = self.frame[..., :0], self.home[:0], self._nothing()

    @torch.no_grad()
    def tracks(self) -> Tracks:
        """The confirmed tracks as they are now."""
        told = [i for i, track in enumerate(self.records) if self._is_told(track)]
        which = torch.tensor(told, dtype=torch.long, device=self.frame.device)
        records, cameras = [self.records[i] for i in told], range(len(self.localize.rig))
        return Tracks(
            time=self.time,
            number=tuple(track.number for track in records),
            category=tuple(track.category for track in records),
            hits=torch.tensor([track.hits for track in records], dtype=torch.long),
            unseen_s=torch.tensor([self.time - track.last for track in records], dtype=torch.float64),
            state=self.steps.place(self.beliefs, self.frame, self.home, self.shared.mixing, which),
            models=self.beliefs.weight[:, which].T,
            seen=torch.tensor(
                [[(track.key, c) in self.seen_now for c in cameras] for track in records], dtype=torch.bool
            ).reshape(len(records), len(cameras)),
        )

    def clock_estimate(self, camera: int = 1) -> ClockEstimate:
        """What the tracks have told so far of the clock of a camera, from 1: beside that of the first camera (0).

        Raises:
            InputError: no such camera.
        """
        if not 0 < camera < len(self.localize.rig):
            raise InputError(f"camera {camera}: a number from 1 to {len(self.localize.rig) - 1} is needed")
        return self.shared.clock_estimate(camera)

    @torch.no_grad()
    def smoothed(self) -> list[SmoothedTrack]:
        """Every confirmed track with the knowledge of all time steps, if `record` was set. Call it at any time.

        Raises:
            InputError: nothing was recorded.
        """
        if self.history is None:
            raise InputError("nothing was recorded; make the tracker with record=True")
        return self.history.smoothed(self.localize, self.shared.corrected, self.shared.mixing)

    def _nothing(self) -> imm.Beliefs:
        """Beliefs of no tracks."""
        clocks = len(self.shared.corrected)
        return imm.no_beliefs(self.calibration, clocks, len(self.options.motions), self.frame.device)

    def _is_told(self, track: TrackRecord) -> bool:
        return track.number > 0 and self.time - track.last <= self.options.lose_after_s

    def _predict(self, time: float) -> None:
        dt, self.time = time - self.time, time
        if not self.records:
            return
        numbers = self.frame.new_tensor(imm.step_numbers(self.options.motions, dt))
        stay = self.frame.new_tensor(math.exp(-dt / self.options.switch_s))
        up = self.frame[:, 2]
        aim, turn = self.beliefs.middle[:2, 0], None
        if bool((aim.abs() > _TURN).any()):
            turn = _toward(aim)
            self.frame = measured.product(turn, self.frame)
        elif self.history is None:
            self.beliefs = self.steps.move(self.beliefs, up, numbers, stay)
            return
        beliefs, step = self.beliefs.mixed(stay), imm.transition(numbers, up)
        self.beliefs = imm.predicted(beliefs, step, turn)
        if self.history is not None:
            keys = [track.key for track in self.records]
            cross = imm.cross_covariance(beliefs, self.beliefs, step, turn)
            self.history.predicted(keys, self.beliefs.summary(), cross, self.shared.corrected)

    def _take(self, views: ObjectViews, seen: Sightings) -> None:
        timing, marks = self._delays(seen), mark_numbers(views.pixels, views.seen)
        ends: list[_Ends] = [{(c, mark) for c, mark in enumerate(row) if mark >= 0} for row in marks.tolist()]
        several = views.seen.sum(1) > 1
        numbers = torch.arange(len(views))
        used: _Ends = set()
        # Cameras that see a track together, and then, one after the other, those that see one alone.
        groups = [numbers[several], *(numbers[~several & views.seen[:, c]] for c in range(views.cameras))]
        for camera, rows in enumerate(groups, -1):
            rows = rows[[not ends[i] & used for i in rows.tolist()]]
            if len(rows) and self.records:
                used |= self._match(views, seen, timing, ends, rows, camera)
        usable = seen.usable.tolist()
        fresh = [i for i in numbers[several].tolist() if usable[i] and not ends[i] & used]
        if fresh:
            self._begin(torch.tensor(fresh), views, seen, timing)
        if self.shared.estimated:
            move = self.shared.settle()
            shift = (self.beliefs.effect[:, self.calibration :] * move[:, None, None]).sum(1)
            self.beliefs = self.beliefs._replace(mean=self.beliefs.mean + shift)

    def _match(
        self, views: ObjectViews, seen: Sightings, timing: imm.Timing, ends: list[_Ends], rows: Tensor, camera: int
    ) -> _Ends:
        """Give tracks the sightings of some rows; those of one `camera` (not -1) go to tracks that it has not seen yet.

        Returns the marks that are used up.
        """
        root, frame, home = self.shared.mixing, self.frame, self.home
        part, when = (seen, timing) if len(rows) == len(views) else (seen.at(rows), timing.at(rows))
        merged, looks = self.steps.look(self.beliefs, frame, home, root)
        close = self.steps.near(looks, part, when, self.gates[-1])
        close[[i for i, record in enumerate(self.records) if (record.key, camera) in self.seen_now]] = False
        track, which = close.nonzero(as_tuple=True)
        found = self.steps.score(merged, frame, home, part, when, root, track, which)
        possible = within(found, track, which, self.gates[part.seen.sum(0)[which]])
        evidence = [track.evidence for track in self.records]
        tiers = [0 if self._is_told(track) else 1 if track.number == 0 else -1 for track in self.records]
        accepted = sorted(assigned(possible, [ends[i] for i in rows.tolist()], evidence, tiers))
        if not accepted:
            return set()
        taken = rows[possible.pair[accepted].cpu()].tolist()
        names, score = [views.category[i] for i in taken], views.score[taken]
        self._update(possible, torch.tensor(accepted), part, when, names, score)
        for t, i in zip(possible.track[accepted].tolist(), taken, strict=True):
            self.seen_now |= {(self.records[t].key, c): i for c, _ in ends[i]}
        return {mark for i in taken for mark in ends[i]}

    def _delays(self, seen: Sightings) -> imm.Timing:
        since = seen.time[1:] - (self.shared.start or 0.0)
        clock = torch.stack([torch.ones_like(since), since, seen.row[1:]], 1)  # (V - 1, 3, N)
        values = self.shared.values.unflatten(0, clock.shape[:2])
        delay = seen.time - self.time + torch.nn.functional.pad((values[..., None] * clock).sum(1), (0, 0, 1, 0))
        if not self.shared.estimated:
            return imm.Timing(delay, clock[:0], since[:0])
        root = self.shared.root[self.calibration :].unflatten(0, clock.shape[:2])
        unsure = (root[..., None] * clock[:, :, None]).sum(1).square().sum(1).sqrt()
        return imm.Timing(delay, clock, unsure)

    def _update(
        self,
        possible: Candidates,
        rows: Tensor,
        seen: Sightings,
        timing: imm.Timing,
        categories: list[str],
        score: Tensor,
    ) -> None:
        track, which, scores = possible.track[rows], possible.pair[rows], possible.scores
        count = seen.seen.sum(0)[which]
        if self.shared.estimated:
            known = torch.tensor([self.records[i].number > 0 for i in track.tolist()])
            sure = scores.at(rows[known & (scores.squared[rows] < _SURE * self.gates[count])])
            self.shared.add(sure.effect, sure.innovation, sure.covariance)
        # Rows are in the order of tracks: where each has one, nothing is to be picked out.
        every = len(track) == len(self.records)
        old = self.beliefs if every else self.beliefs.at(track)
        local = scores.seen if len(rows) == len(possible.track) else scores.seen.at(rows)
        new = self.steps.take(old, local, timing.at(which), self.shared.mixing)
        both = zip(self.beliefs, new, strict=True)
        self.beliefs = new if every else imm.Beliefs(*(value.index_copy(-1, track, part) for value, part in both))
        columns = track.tolist(), scores.log_density[rows].tolist(), categories, score.tolist(), count.tolist()
        for t, density, name, weight, cameras in zip(*columns, strict=True):
            record = self.records[t]
            # One camera alone confirms nothing, and no time step counts twice.
            if record.last < self.time and (cameras > 1 or record.number):
                record.hits += 1
            record.last = self.time
            record.evidence += density
            record.categories[name] = record.categories.get(name, 0.0) + weight

    def _begin(self, which: Tensor, views: ObjectViews, seen: Sightings, timing: imm.Timing) -> None:
        seen = seen.at(which)
        ray = torch.nn.functional.normalize(seen.direction.T, dim=-1)
        frame = torch.stack([*side_axes(ray), ray]).movedim(-1, 1)
        local = anchored(seen, frame, seen.place)
        speeds = self.options.speed_mps * ray.new_tensor([motion.fast for motion in self.options.motions]).T
        new = imm.born(local, timing.at(which), speeds)
        self.beliefs = imm.Beliefs(*(torch.cat(both, -1) for both in zip(self.beliefs, new, strict=True)))
        self.frame, self.home = torch.cat([self.frame, frame], -1), torch.cat([self.home, seen.anchor])
        for i in which.tolist():
            needed = self.options.confirm_hits * (2 if bool(views.ambiguous[i]) else 1)
            scores = {views.category[i]: float(views.score[i])}
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
                    self.history.numbers[track.key] = track.number
        limits = [self.options.forget_after_s if t.number else 0.5 * self.options.lose_after_s for t in self.records]
        kept = [i for i, track in enumerate(self.records) if self.time - track.last <= limits[i]]
        if len(kept) < len(self.records):
            which = torch.tensor(kept, dtype=torch.long, device=self.frame.device)
            self.beliefs, self.frame, self.home = self.beliefs.at(which), self.frame[..., which], self.home[which]
            self.records = [self.records[i] for i in kept]

    def _recognized(self, new: int) -> int | None:
        """The lost track that a new one continues, if there is one and only one."""
        named = [i for i, track in enumerate(self.records) if track.number and not self._is_told(track)]
        lost = [i for i in named if self.records[i].last < self.records[new].first]
        if not lost:
            return None
        which = torch.tensor(lost, device=self.frame.device)
        old, here = self.beliefs.at(which).merged(), self.beliefs.at(torch.tensor([new])).merged()
        frame, to = self.frame[..., which], self.frame[..., new, None]
        still = imm.transition(frame.new_tensor(imm.step_numbers((imm.Motion(acceleration=0.0),), 0.0)), frame[:, 2])
        centers = self.localize.rig.center
        apart = centers[self.home[which]] - centers[self.home[new]]
        shift = None if not bool(apart.any()) else measured.product(to, apart.T[:, None])[:, 0]
        old = imm.predicted(old, still, measured.product(to, frame.transpose(0, 1)), shift)
        spread = measured.rooted(here.effect - old.effect, self.shared.mixing)
        distance = measured.mahalanobis(here.noise + old.noise + measured.squared(spread), here.mean - old.mean)[0][0]
        near = [i for i, value in zip(lost, distance.tolist(), strict=True) if value <= self.options.recognize]
        return near[0] if len(near) == 1 else None


def _toward(aim: Tensor) -> Tensor:
    """Rotations (3, 3, T) that bring the directions (x, y, 1) onto the axis; none where they are near it."""
    ray = torch.nn.functional.normalize(torch.cat([aim, torch.ones_like(aim[:1])]).T, dim=-1)
    turned = torch.stack([*side_axes(ray), ray]).movedim(-1, 1)
    still = torch.eye(3, dtype=aim.dtype, device=aim.device)[..., None].expand_as(turned)
    return torch.where(aim.abs().amax(0) > _TURN, turned, still)
