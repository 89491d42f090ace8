"""Cut out the pixels around corners that an erf fit explains."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.corners.saddle import cut_patches


class CornerWindow:
    """The pixels around each of M corners and their weights: 1 inside the radius, falling to 0 within a pixel.

    Args:
        levels: (M, K) gray levels of the pixels on a disc.
        offset: (M, 2) starts relative to the patch's middle.
        radius: (M,) pixels.
        places: (K,) indices of these pixels in a patch, row by row.
        size: pixels on a side of the patch.
    """

    def __init__(self, levels: Tensor, offset: Tensor, radius: Tensor, places: Tensor, size: int) -> None:
        self.levels = levels
        self.offset = offset
        self.radius = radius
        self.places = places
        self.size = size
        self.where = torch.stack([places % size, places // size], -1).to(torch.float64) - size // 2
        distance = torch.linalg.vector_norm(self.where - offset[:, None], dim=-1)
        self.weight = (radius[:, None] + 0.5 - distance).clamp(0.0, 1.0)

    def of(self, some: Tensor) -> CornerWindow:
        """The window of some of the corners."""
        return CornerWindow(self.levels[some], self.offset[some], self.radius[some], self.places, self.size)

    def patches(self, values: Tensor) -> Tensor:
        """Values of the pixels (..., K) as (..., P, P), 0 outside the disc."""
        whole = values.new_zeros(*values.shape[:-1], self.size * self.size)
        return whole.index_copy(-1, self.places, values).unflatten(-1, (self.size, self.size))


def cut_windows(image: Tensor, base: Tensor, offset: Tensor, radius: Tensor) -> tuple[CornerWindow, Tensor]:
    """The windows around `base` + `offset`, and their gray levels (M, K) with gradients."""
    most = float(radius.max())
    half = math.ceil(most + 1.0)
    axis = torch.arange(-half, half + 1, device=radius.device)
    # A start lies at most half a pixel from the middle along each axis.
    places = (torch.hypot(axis[:, None].double(), axis[None].double()) < most + 1.21).flatten().nonzero()[:, 0]
    levels = cut_patches(image, base, half).flatten(-2)[:, places]
    return CornerWindow(levels.detach(), offset, radius, places, len(axis)), levels
