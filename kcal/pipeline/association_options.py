"""`AssociationOptions`: which detections may be of one object."""

from __future__ import annotations

import math
from dataclasses import dataclass

from kcal.errors import InputError
from kcal.pipeline.detections import Anchor


@dataclass(frozen=True, kw_only=True)
class AssociationOptions:
    """Options of `associate`.

    Args:
        box_sigma: standard deviation of a box's middle along each axis, pixels.
        nearest: smallest range, meters; 10 baselines if None.
        farthest: largest range, meters.
        gate: a pair is possible up to this many standard deviations, epipolar error, size and looks together.
        odds: a pair is ambiguous unless the best assignment with it is this many times as likely as the best one that
            pairs one of its members otherwise.
        same_category: whether only detections of the same category may be paired.
        anchor: pixel that stands for an object; see `Detections.anchors`.

    Raises:
        InputError: a value out of range.
    """

    box_sigma: float = 2.0
    nearest: float | None = None
    farthest: float = math.inf
    gate: float = 4.0
    odds: float = 20.0
    same_category: bool = True
    anchor: Anchor = "center"

    def __post_init__(self) -> None:
        if not (0 < self.box_sigma < math.inf and 0 < self.gate < math.inf and 1 <= self.odds < math.inf):
            raise InputError("association: box_sigma and gate are positive, and odds at least 1")
        if not 0 < (self.nearest or 1e-9) < self.farthest:
            raise InputError(f"association: 0 < nearest < farthest is needed, got {self.nearest} and {self.farthest}")
