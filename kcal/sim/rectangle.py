"""Rectangles of pixels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class PixelRectangle(NamedTuple):
    """A rectangle of pixels; it may reach beyond the image."""

    left: int
    top: int
    width: int
    height: int


def pixel_axes(window: PixelRectangle) -> tuple[Tensor, Tensor]:
    """Return the positions x of every column (width,) and y of every row (height,), float64."""
    x = window.left + torch.arange(window.width, dtype=torch.float64)
    y = window.top + torch.arange(window.height, dtype=torch.float64)
    return x, y


def grow(window: PixelRectangle, by: int) -> PixelRectangle:
    """Add `by` pixels on every side."""
    return PixelRectangle(window.left - by, window.top - by, window.width + 2 * by, window.height + 2 * by)
