"""What errors of all matches have in common: parts that are smooth over the image, thousandths of a pixel.

The ground before the mast, a row of hills, the height of the sun: what matches are off by leans a little with their
place in the image. Between two matches that is next to nothing, but no number of matches makes it smaller. It changes
pitch, roll and where the cameras stand, and hardly yaw: so it is an unknown of the adjustment, not a part of each
match's σ, which would widen all of them alike.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.rig.sources import FeatureEffect

# px across the lines of each of three errors, at the image's borders: the likeliest on 13 terrains at 960 x 540 (yaw's
# seeds 400-412; one and three pairs of a minute, and ten of a day of two of them). With the 20 of 430-449 χ² of the
# relative rotation, which should be 3, is 3.1 and 2.2 from one and three pairs, and 2.8 from ten; without them 4.1, 3.3
# and 6.9. Products and squares of both coordinates, which would change yaw, have no part in it.
_SMOOTH_PX = 0.0035
_NAMES = tuple(f"errors that matches share, {part}" for part in ("everywhere", "by columns", "by rows"))


def smooth_effects(pixels: Tensor, across: Tensor, size: tuple[int, int]) -> tuple[FeatureEffect, ...]:
    """Three errors: one everywhere, and one each that grows linearly from the middle of the left image to its borders.

    Args:
        pixels: (M, 2, 2) left and right.
        across: (M, 2) unit vectors of the right image across the lines.
        size: width and height of the left image.
    """
    place = 2.0 * pixels[:, 0] / torch.tensor(size) - 1.0
    amounts = torch.stack([torch.ones_like(place[:, 0]), *place.T])
    # Half of it in each image: matches tell the difference alone.
    sides = torch.tensor([-0.5, 0.5], dtype=torch.float64)[:, None] * across[:, None]
    shifts = _SMOOTH_PX * amounts[..., None, None] * sides
    return tuple(FeatureEffect(name=name, shift=shift) for name, shift in zip(_NAMES, shifts, strict=True))
