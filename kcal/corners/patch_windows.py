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
    kernel = gaussian_kernel(IMAGE_BLUR * 2**level, 3 * 2**level).to(image.device)
    raw, low = _raw_windows(image, pixels, len(kernel) // 2, level)
    # Without a brightest level nothing is saturated.
    parts = [raw] if math.isinf(brightest) else [raw, (raw.detach() >= brightest).double()]
    blurred = correlated(torch.cat(parts)[:, None], kernel, kernel)[:, 0]
    values, saturated = blurred.chunk(2) if len(parts) == 2 else (blurred, torch.zeros_like(blurred))
    return ImageWindows(values, saturated, low, (image.shape[1], image.shape[0]), level)


def warped_blur_windows(image: Tensor, pixels: Tensor, warp: Tensor) -> ImageWindows:
    """As `image_windows` at level 0 without saturation, but blurred as the other image is, seen from this one.

    Args:
        image: (H, W) gray levels.
        pixels: (N, ..., 2) px.
        warp: (N, 2, 2) pixels of this image by those of the other one.
    """
    covariance = IMAGE_BLUR**2 * warp @ warp.mT
    reach = math.ceil(3.0 * float(torch.linalg.matrix_norm(covariance, 2).amax().sqrt()))
    raw, low = _raw_windows(image, pixels, reach, 0)
    offset = grid_of((reach, reach), image.device)
    kernel = torch.exp(-0.5 * torch.einsum("hwi,nij,hwj->nhw", offset, torch.linalg.inv(covariance), offset))
    kernel = kernel / kernel.sum((1, 2), keepdim=True)
    values = torch.nn.functional.conv2d(raw[None], kernel[:, None], groups=len(raw))[0]
    return ImageWindows(values, torch.zeros_like(values), low, (image.shape[1], image.shape[0]), 0)


def _raw_windows(image: Tensor, pixels: Tensor, reach: int, level: int) -> tuple[Tensor, Tensor]:
    """Gray levels (N, h, w) of windows with a margin of `reach`, and the first pixel (N, 2) inside of it."""
    height, width = image.shape
    flat = pixels.detach().flatten(1, -2)
    # One more for the slopes' steps, and one for bilinear samples.
    low = (flat.amin(1) - reach - 2**level - 1).floor().long()
    counts = ((flat.amax(1) - low).amax(0).ceil().long() + reach + 2**level + 2).tolist()
    columns, rows = (
        (low[:, i : i + 1] + torch.arange(min(count, 3 * max(width, height)), device=image.device)).clamp(0, side - 1)
        for i, (count, side) in enumerate(zip(counts, (width, height), strict=True))
    )
    return image[rows[:, :, None], columns[:, None, :]].to(torch.float64), low + float(reach)


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
