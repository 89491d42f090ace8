"""The valid region of a lens as a polygon in the image."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from kcal.lens.distortion import distort_components
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS
from kcal.lens.region import Region

_COUNT = 256
# A little inside the edge: at a pole the edge itself is mapped to infinity.
_INSIDE = 1.0 - 1e-6


def image_outline(
    to_sensor: Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor]],
    parameters: Tensor,
    model: LensModel,
    region: Region,
    size: tuple[int, int],
) -> Tensor:
    """The part of the image (width, height) that the region is mapped to: a polygon (V, 2) of pixels.

    Args:
        to_sensor: distorted coordinates x, y (N,) and the parameters to pixels u, v.
        parameters: (5 + P,) of one camera.
        model: its lens model.
        region: where its lens is valid.
        size: of the image.
    """
    x, y = (region.outline(_COUNT) * _INSIDE).unbind(-1)
    lens = distort_components(x, y, parameters[len(INTRINSICS) :], model, slopes=False)
    polygon = torch.stack(to_sensor(lens.x, lens.y, parameters), -1)
    return clip_to_image(polygon, size) if bool(region.radius > 0) else polygon[:0]


def clip_to_image(polygon: Tensor, size: tuple[int, int]) -> Tensor:
    """Cut a polygon (V, 2) to the image, whose edges lie half a pixel beyond the outer centers.

    One edge of the image after the other, as Sutherland and Hodgman (1974) do.

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
        # A corner on the edge is kept as itself; its crossing would be the same point again.
        keep[:, 1] &= (height_over != 0) & (height_after != 0)
        polygon = torch.stack([polygon, crossing], 1)[keep]
    return polygon


def area(polygon: Tensor) -> float:
    """Area of a polygon (V, 2) whose corners run clockwise as one sees them (x right, y down)."""
    (x, y), (next_x, next_y) = polygon.T, polygon.roll(-1, 0).T
    return float(0.5 * (x * next_y - y * next_x).sum())
