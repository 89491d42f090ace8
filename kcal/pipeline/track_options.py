"""When tracks begin and end, and what is told of them."""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple, Self

from torch import Tensor

from kcal.errors import InputError
from kcal.pipeline.estimates import TrackStates
from kcal.pipeline.imm_filter import MOTIONS, Motion


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
        gate: largest squared Mahalanobis distance of a sighting by two cameras from its track; 23.5 loses one in
            10,000. Of one camera, or of more, it is the distance that loses as many.
        recognize: the same of a new track from a lost one, in place and velocity; 16.8 loses one in 100.
        lasting_px: standard deviation of the part of a mark's error that stays the same as long as a target is seen,
            along each axis of all images but the first camera's, pixels. Matched images have 0.01 px of it, compressed
            ones 0.02 px (`scripts/check/compression.py`).

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
        seen: (T, V) bool: which cameras see it at this moment.
    """

    time: float
    number: tuple[int, ...]
    category: tuple[str, ...]
    hits: Tensor
    unseen_s: Tensor
    state: TrackStates
    models: Tensor
    seen: Tensor
