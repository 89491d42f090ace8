"""Data of views that stand still, from a quadratic form alone."""

from __future__ import annotations

import torch

from kcal.calibrate.hybrid.quadratic import Quadratic, ViewData


def standing(data: Quadratic) -> ViewData:
    """A single view without motion that says this."""
    size = len(data.g)
    none = torch.zeros(1, 0, size + 1, dtype=data.K.dtype)
    return ViewData(data, none[..., :0], none, torch.zeros(1, size, dtype=data.K.dtype), none[..., 0])
