"""How far pixels are shifted, over an image."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PixelShift:
    """Where something is seen in place of `pixels`.

    Args:
        pixels: (rows, columns, 2).
        shift: (rows, columns, 2) pixels, from there; NaN where nothing is seen.
    """

    pixels: Tensor
    shift: Tensor

    @property
    def length(self) -> Tensor:
        """(rows, columns) length of the shift, pixels."""
        return torch.linalg.vector_norm(self.shift, dim=-1)

    @property
    def rms(self) -> float:
        """Root mean square of the length over the image, pixels."""
        return float(self.length[self.length.isfinite()].square().mean().sqrt())

    @property
    def largest(self) -> float:
        """Largest length, pixels."""
        return float(self.length[self.length.isfinite()].max())
