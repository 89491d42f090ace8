"""What a tracker computes at each moment, as functions of tensors alone: as they are, or compiled.

Sizes are T tracks under J models, N pairs, L possible matches.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kcal.dispatch import known_true
from kcal.errors import InputError
from kcal.locate.multi_localizer import MultiViewLocalizer
from kcal.pipeline.assignment import Looks, Scores, SeenFrom, looks_of, nearby
from kcal.pipeline.estimates import TrackStates, track_states
from kcal.pipeline.imm_filter import Beliefs, Timing, fit_of, innovations, predicted, updated
from kcal.pipeline.measurements import Anchored, Sightings, anchored, known_sightings, sightings
from kcal.pipeline.motion import transition

# What a match gains for each mark that it explains: half the squared distance at which marks are no more taken.
_EXPLAINED = 12.0
# Of stand-ins from which graphs are made: sizes that no other axis has, so that none seem to belong together.
_STAND_INS = _PAIRS, _TRACKS, _MATCHES, _TAKEN, _TOLD = 1009, 1013, 1019, 1021, 1031


class TrackSteps(NamedTuple):
    """The steps, in their order.

    Attributes:
        measure: pixels, which are seen, covariances and times of a moment as sightings; see `sightings`.
        move: beliefs to another time; see `moved_on`.
        look: see `looked_at`, with beliefs that have come to the same moment.
        near: see `nearby`.
        score: see `scored`.
        take: see `taken_in`.
        place: tracks of these numbers on the Earth, from beliefs, frames, homes and a root as in `track_states`.
    """

    measure: Callable[[Tensor, Tensor, Tensor, Tensor], Sightings]
    move: Callable[[Beliefs, Tensor, Tensor, Tensor], Beliefs]
    look: Callable[[Beliefs, Tensor, Tensor, Tensor | None], tuple[Beliefs, Looks]]
    near: Callable[[Looks, Sightings, Timing, Tensor], Tensor]
    score: Callable[[Beliefs, Tensor, Tensor, Sightings, Timing, Tensor | None, Tensor, Tensor], Scores]
    take: Callable[[Beliefs, Anchored, Timing, Tensor | None], Beliefs]
    place: Callable[[Beliefs, Tensor, Tensor, Tensor | None, Tensor], TrackStates]


def moved_on(beliefs: Beliefs, up: Tensor, numbers: Tensor, stay: Tensor) -> Beliefs:
    """Beliefs after a step: `up` and `numbers` as in `transition`, `stay` as in `Beliefs.mixed`."""
    return predicted(beliefs.mixed(stay), transition(numbers, up))


def taken_in(beliefs: Beliefs, seen: Anchored, timing: Timing, root: Tensor | None) -> Beliefs:
    """Beliefs with sightings, one for each track."""
    found = innovations(beliefs, seen, timing)
    return updated(beliefs, found, root)


def track_steps(localize: MultiViewLocalizer, lasting_px: float) -> TrackSteps:
    """The steps as they are."""
    centers, errors, bending = localize.rig.center, localize.errors, localize.bending_errors
    turned = None if errors is None else errors[:, :, 3:6].movedim(-1, 0)
    cameras, known = SeenFrom(centers, turned), known_sightings(localize)
    k = float(known.posed.bending)

    def measure(pixels: Tensor, seen: Tensor, covariance: Tensor, time: Tensor) -> Sightings:
        return sightings(known, pixels, seen, covariance, time, lasting_px)

    def looked_at(beliefs: Beliefs, frame: Tensor, home: Tensor, root: Tensor | None) -> tuple[Beliefs, Looks]:
        merged = beliefs.merged()
        return merged, looks_of(merged, frame, centers.T.index_select(1, home), cameras, root)

    def scored(
        merged: Beliefs, frame: Tensor, home: Tensor, seen: Sightings, timing: Timing, root: Tensor | None,
        track: Tensor, which: Tensor,
    ) -> Scores:  # fmt: skip
        """Sightings (L,) against tracks (L,), whose beliefs are merged."""
        beliefs, local = merged.at(track), seen.at(which)
        origin = centers.T.index_select(1, home[track])
        where = None if known_true(~local.alone) else beliefs.mean[:3, 0]
        there = anchored(local, frame.index_select(-1, track), origin, where, bending, k)
        found = innovations(beliefs, there, timing.at(which))
        fit = fit_of(found, root)
        density = fit.log_density[0] + _EXPLAINED * local.seen.sum(0)
        return Scores(
            there, found.effect[..., 0, :], found.value[:, 0], found.noise[..., 0, :], fit.squared[0], density
        )

    def place(beliefs: Beliefs, frame: Tensor, home: Tensor, root: Tensor | None, which: Tensor) -> TrackStates:
        summary = beliefs.at(which).summary()
        return track_states(localize, frame.index_select(-1, which).movedim(-1, 0), home[which], summary, root)

    return TrackSteps(measure, moved_on, looked_at, nearby, scored, taken_in, place)


@torch.no_grad()
def compiled_steps(steps: TrackSteps, cameras: int, nothing: Beliefs, root: Tensor | None) -> TrackSteps:
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


def _compile_all(made: TrackSteps, cameras: int, nothing: Beliefs, root: Tensor | None) -> None:
    """Call each step with stand-ins."""
    new, models = nothing.mean.new_zeros, nothing.mean.shape[1]
    unit = torch.eye(2 * cameras).to(nothing.mean).expand(_PAIRS, 2 * cameras, 2 * cameras)
    there = torch.ones(_PAIRS, cameras, dtype=torch.bool, device=unit.device)
    seen = made.measure(new(_PAIRS, cameras, 2), there, unit, new(_PAIRS, cameras))
    clocks = nothing.late.shape[1] // 3
    timing = Timing(new(cameras, _PAIRS), new(clocks, 3, _PAIRS), new(clocks, _PAIRS))
    beliefs = Beliefs(*(torch.nn.functional.pad(value, (0, _TRACKS), value=1.0) for value in nothing))
    frame = torch.eye(3).to(unit)[..., None].expand(3, 3, _TRACKS)
    home = torch.zeros(_TRACKS, dtype=torch.long, device=unit.device)
    beliefs = made.move(beliefs, frame[2], new(9, models), new(()))
    merged, looks = made.look(beliefs, frame, home, root)
    made.near(looks, seen, timing, new(()))
    # Each its own tensor: the same one twice would become a rule.
    track, pair, taken, told = (
        torch.zeros(size, dtype=torch.long, device=unit.device) for size in (_MATCHES, _MATCHES, _TAKEN, _TOLD)
    )
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
        tensors = [tensor for argument in given for tensor in _tensors_in(argument)]
        if self.free is None:
            every = [(i, axis) for i, tensor in enumerate(tensors) for axis in range(tensor.ndim)]
            self.free = [(i, axis) for i, axis in every if tensors[i].shape[axis] in _STAND_INS]
            for i, axis in self.free:
                torch._dynamo.mark_dynamic(tensors[i], axis)
        if min(tensors[i].shape[axis] for i, axis in self.free) < 2:
            return self.step(*arguments)
        return self.made(*given)


def _tensors_in(value: Any) -> tuple[Tensor, ...]:
    if value is None:
        return ()
    return (value,) if isinstance(value, Tensor) else value


def _contiguous(value: Any) -> Any:
    if value is None or isinstance(value, Tensor):
        return value if value is None else value.contiguous()
    return type(value)(*(part.contiguous() for part in value))
