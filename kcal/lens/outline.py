"""The valid region of a lens as a polygon in the image."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.lens.distortion import distort_components
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS, to_pixels
from kcal.lens.region import Region


def image_outline(parameters: Tensor, model: LensModel, region: Region, size: tuple[int, int]) -> Tensor:
    """Map the valid region to the image (width, height): a polygon (V, 2) in pixels.

    Args:
        parameters: (5 + P,) of a single camera.
        model: its lens model.
        region: its valid region.
        size: (width, height) of the image.
    """
    # A little inside the edge: at a pole the edge itself is mapped to infinity.
    x, y = (region.outline(256) * (1.0 - 1e-6)).unbind(-1)
    lens = distort_components(x, y, parameters[len(INTRINSICS) :], model, slopes=False)
    polygon = torch.stack(to_pixels(lens.x, lens.y, parameters), -1)
    return clip_to_image(polygon, size) if bool(region.radius > 0) else polygon[:0]


def clip_to_image(polygon: Tensor, size: tuple[int, int]) -> Tensor:
    """Clip a polygon (V, 2) to the image, whose edges lie half a pixel beyond the outer pixel centers.

    Source: Sutherland and Hodgman (1974), one edge of the image after the other.

    Example:
        >>> triangle = torch.tensor([[-0.5, -0.5], [9.5, -0.5], [-0.5, 9.5]], dtype=torch.float64)
        >>> clip_to_image(triangle, (5, 10)).tolist()
        [[-0.5, -0.5], [4.5, -0.5], [4.5, 4.5], [-0.5, 9.5]]
    """
    width, height = size
    for axis, edge, sign in ((0, -0.5, 1.0), (0, width - 0.5, -1.0), (1, -0.5, 1.0), (1, height - 0.5, -1.0)):
        height_over = sign * (polygon[:, axis] - edge)
        following, height_after = polygon.roll(-1, 0), height_over.roll(-1, 0)
        weight = (height_over / (height_over - height_after))[:, None]
        crossing = polygon + weight * (following - polygon)
        crossing[:, axis] = edge
        keep = torch.stack([height_over >= 0, (height_over > 0) != (height_after > 0)], -1)
        # A corner on the edge is kept as such; its crossing would repeat it.
        keep[:, 1] &= (height_over != 0) & (height_after != 0)
        polygon = torch.stack([polygon, crossing], 1)[keep]
    return polygon


def polygon_area(polygon: Tensor) -> float:
    """Area of a polygon (V, 2) whose corners run clockwise as seen in the image (x right, y down)."""
    (x, y), (next_x, next_y) = polygon.T, polygon.roll(-1, 0).T
    return float(0.5 * (x * next_y - y * next_x).sum())
