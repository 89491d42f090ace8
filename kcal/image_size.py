"""The size of an image, as kcal's files have it; apart from other checks, because torch takes long to load."""

from __future__ import annotations

from typing import Annotated

import pydantic

# Of one image. The largest sensors of 2025 have about 410 megapixels.
MOST_PIXELS = 500_000_000


def check_pixel_count(size: tuple[int, int]) -> tuple[int, int]:
    """Return (width, height) unless no camera has so many pixels.

    Raises:
        ValueError: more than 500 megapixels.

    Example:
        >>> check_pixel_count((1920, 1080))
        (1920, 1080)
    """
    width, height = size
    if width * height > MOST_PIXELS:
        shown = f"{width}x{height}" if max(size) < 1e12 else "more than 1e12"
        raise ValueError(f"{shown} pixels; an image may have at most {MOST_PIXELS // 10**6} megapixels")
    return size


# (width, height) in pixels, in kcal's files.
ImageSize = Annotated[tuple[pydantic.PositiveInt, pydantic.PositiveInt], pydantic.AfterValidator(check_pixel_count)]
