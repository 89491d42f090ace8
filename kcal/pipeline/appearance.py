"""How alike objects look in two images: the best correlation of their patches over small shifts, for all pairs."""

from __future__ import annotations

import torch
from torch import Tensor

# Samples across a box, and how far patches may be shifted against each other, in samples: boxes err by that.
_SAMPLES = 16
_SHIFT = 4


def appearance(left: Tensor, boxes_left: Tensor, right: Tensor, boxes_right: Tensor) -> Tensor:
    """Normalized correlation (N, M), -1 to 1, of the patches in boxes (N, 4) and (M, 4); 0 where one is flat.

    Args:
        left: (H, W) gray levels.
        boxes_left: (N, 4) edges in pixels.
        right: (H, W) gray levels.
        boxes_right: (M, 4).

    Example:
        >>> image = torch.rand(40, 60, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
        >>> boxes = torch.tensor([[10.0, 10, 26, 26], [30, 10, 46, 26]], dtype=torch.float64)
        >>> (appearance(image, boxes, image.roll(2, 1), boxes) > 0.6).tolist()
        [[True, False], [False, True]]
    """
    templates = _patches(left, boxes_left, _SAMPLES)
    templates = templates - templates.mean((-2, -1), keepdim=True)
    windows = _patches(right, boxes_right, _SAMPLES + 2 * _SHIFT)
    products = torch.nn.functional.conv2d(windows[:, None], templates[:, None])  # (M, N, shifts, shifts)
    area = _SAMPLES**2
    mean = torch.nn.functional.avg_pool2d(windows[:, None], _SAMPLES, stride=1)
    power = torch.nn.functional.avg_pool2d(windows[:, None].square(), _SAMPLES, stride=1) - mean.square()
    norm = (area * power.clamp_min(0.0)).sqrt() * torch.linalg.vector_norm(templates, dim=(-2, -1))[None, :, None, None]
    # Rounding of flat patches is no likeness.
    scale = 1e-6 * area * (left.abs().amax() * right.abs().amax()).clamp_min(1e-12)
    found = torch.where(norm > scale, products / torch.where(norm > scale, norm, 1.0), 0.0)
    return found.amax((-2, -1)).T


def _patches(image: Tensor, boxes: Tensor, samples: int) -> Tensor:
    """(N, samples, samples) of the boxes; more samples than `_SAMPLES` reach beyond the box by as much."""
    height, width = image.shape
    at = (torch.arange(samples, dtype=image.dtype) - 0.5 * (samples - 1)) / _SAMPLES
    middle, size = 0.5 * (boxes[:, :2] + boxes[:, 2:]), boxes[:, 2:] - boxes[:, :2]
    x = middle[:, :1] + at * size[:, :1]
    y = middle[:, 1:] + at * size[:, 1:]
    grid = torch.stack(
        [(2.0 * x / (width - 1) - 1.0)[:, None].expand(-1, samples, -1),
         (2.0 * y / (height - 1) - 1.0)[:, :, None].expand(-1, -1, samples)], -1,
    )  # fmt: skip
    # One tall grid, because the image is the same for all.
    sampled = torch.nn.functional.grid_sample(
        image[None, None], grid.reshape(1, -1, samples, 2), padding_mode="border", align_corners=True
    )
    return sampled.reshape(len(boxes), samples, samples)
