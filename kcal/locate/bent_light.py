"""What there is besides pixels when a point is sought: who saw it, how light bends, which height it has."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

# Meters: light from beyond is bent as if it came from there; nothing on the Earth is seen so far.
LIGHT_HORIZON = 5e5


class Surroundings(NamedTuple):
    """What there may be besides pixels.

    Attributes:
        present: (..., C, N) bool: which camera saw what; all of them if None.
        up: (C, 3) the vertical at each camera, in its axes; straight lines of sight if None.
        bending: 1/m: light from the level distance d comes from bending * d² too high: k / 2R.
        held: (..., 3, N) row of (a, b, ρ) that stays as it is at the start, over its sigma: a stated height.
        held_off: (..., N) by how much it is too high, over its sigma: zeros, with derivatives.
    """

    present: Tensor | None = None
    up: Tensor | None = None
    bending: Tensor | float = 0.0
    held: Tensor | None = None
    held_off: Tensor | float = 0.0


def length_of_one(scale: Tensor, inverse: Tensor) -> Tensor:
    """Meters of one in the units of ρ-scaled points, at most as far as anything on the Earth is seen."""
    return scale / torch.maximum(inverse.abs(), scale / LIGHT_HORIZON)


def lifted(seen: Tensor, around: Surroundings, unit: Tensor | float) -> Tensor:
    """By how much (..., C, 3, N) things are seen higher than `seen` in each camera's axes; one of it is `unit` m."""
    assert around.up is not None
    up = around.up[..., None]
    along = (seen * up).sum(-2, keepdim=True)
    level = seen.square().sum(-2, keepdim=True) - along * along
    return around.bending * unit * level * up
