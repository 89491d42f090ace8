"""Blurred windows of images around points or objects, and bilinear samples of them: what patches are compared in."""

from __future__ import annotations

import math
from typing import NamedTuple, Self

import torch
from torch import Tensor

from kcal.corners.filters import correlated, gaussian_kernel

IMAGE_BLUR = 0.8  # steps, of both images: bilinear samples of it are good to 0.005 px


def grid_of(half: tuple[int, int], device: torch.device) -> Tensor:
    """(2 half_y + 1, 2 half_x + 1, 2) whole steps x, y around zero."""
    x, y = (torch.arange(-side, side + 1, dtype=torch.float64, device=device) for side in half)
    return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)


class ImageWindows(NamedTuple):
    """Blurred parts of one image, one for each object.

    Attributes:
        values: (N, h, w) blurred gray levels.
        saturated: (N, h, w) share of saturated pixels there.
        corner: (N, 2) pixel of the first value of each.
        size: (width, height) of the whole image.
        level: of blur.
    """

    values: Tensor
    saturated: Tensor
    corner: Tensor
    size: tuple[int, int]
    level: int

    def at(self, which: Tensor) -> Self:
        """Those of the objects at some places."""
        return self._replace(
            values=self.values[which], saturated=self.saturated[which], corner=self.corner[which]
        )  # fmt: skip


def image_windows(image: Tensor, pixels: Tensor, level: int, brightest: float) -> ImageWindows:
    """Windows that cover pixels (N, ..., 2) of an image (H, W) with room for blur and slopes; edges repeat."""
    height, width = image.shape
    kernel = gaussian_kernel(IMAGE_BLUR * 2**level, 3 * 2**level).to(image.device)
    reach = len(kernel) // 2
    flat = pixels.detach().flatten(1, -2)
    # One more for the slopes' steps, and one for bilinear samples.
    low = (flat.amin(1) - reach - 2**level - 1).floor().long()
    counts = ((flat.amax(1) - low).amax(0).ceil().long() + reach + 2**level + 2).tolist()
    columns, rows = (
        (low[:, i : i + 1] + torch.arange(min(count, 3 * max(width, height)), device=image.device)).clamp(0, side - 1)
        for i, (count, side) in enumerate(zip(counts, (width, height), strict=True))
    )
    raw = image[rows[:, :, None], columns[:, None, :]].to(torch.float64)
    # Without a brightest level nothing is saturated.
    parts = [raw] if math.isinf(brightest) else [raw, (raw.detach() >= brightest).double()]
    blurred = correlated(torch.cat(parts)[:, None], kernel, kernel)[:, 0]
    values, saturated = blurred.chunk(2) if len(parts) == 2 else (blurred, torch.zeros_like(blurred))
    return ImageWindows(values, saturated, low + float(reach), (width, height), level)


def sample(windows: ImageWindows, pixels: Tensor, *, saturated: bool = False) -> Tensor:
    """Bilinear samples (N, ...) at pixels (N, ..., 2) of the full image."""
    values = windows.saturated if saturated else windows.values
    last = pixels.new_tensor([values.shape[2] - 1, values.shape[1] - 1])
    lead = (len(pixels), *[1] * (pixels.ndim - 2), 2)
    scale = 2.0 / last
    place = torch.addcmul(-scale * windows.corner.reshape(lead) - 1.0, pixels, scale)
    found = torch.nn.functional.grid_sample(
        values[:, None], place.reshape(len(pixels), 1, -1, 2), padding_mode="border", align_corners=True
    )
    return found.reshape(pixels.shape[:-1])


def has_samples(windows: ImageWindows, pixels: Tensor) -> Tensor:
    """(N, ...) where a sample and its slope are of the image and in the window, not of a repeated edge."""
    margin = 2.0**windows.level
    last = pixels.new_tensor(windows.size) - 1.0
    corner = windows.corner.reshape(len(windows.corner), *[1] * (pixels.ndim - 2), 2)
    end = corner + pixels.new_tensor([windows.values.shape[2] - 1, windows.values.shape[1] - 1])
    low, high = corner.clamp_min(0.0) + margin, torch.minimum(end, last) - margin
    return ((pixels >= low) & (pixels <= high)).all(-1)
