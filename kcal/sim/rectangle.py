"""A rectangle of pixels."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class Window(NamedTuple):
    """A rectangle of pixels; it may reach beyond the image."""

    left: int
    top: int
    width: int
    height: int


def pixel_axes(window: Window) -> tuple[Tensor, Tensor]:
    """Positions x of every column (width,) and y of every row (height,), float64."""
    x = window.left + torch.arange(window.width, dtype=torch.float64)
    y = window.top + torch.arange(window.height, dtype=torch.float64)
    return x, y


def grow(window: Window, by: int) -> Window:
    """The window with `by` more pixels on every side."""
    return Window(window.left - by, window.top - by, window.width + 2 * by, window.height + 2 * by)
