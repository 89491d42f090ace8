"""Marking single points finer than a pixel: a small crop made ten times larger, and the way back from it.

The paper's Section 4.3 marks points by hand on such crops. `enlarge` makes one, `Enlarged.to_image` maps marks back
exactly, and `refine_point` does the marking for anything that has corners.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcal.checks import as_points, require_finite
from kcal.errors import InputError

FACTOR = 10
HALF = 12  # pixels round the point that are cropped
_WINDOW = 4.0  # pixels: sigma of the weight of gradients round the point
_BLUR = 0.7  # pixels
_REPEATS = 20
_MAX_MOVE = 3.0  # pixels
_STILL = 1e-4
_MIN_ROUNDNESS = 0.02  # smaller over larger eigenvalue of the gradients' scatter; an edge alone has next to none


@dataclass(frozen=True, kw_only=True)
class Enlarged:
    """A crop of an image, `factor` times larger.

    Args:
        patch: (h * factor, w * factor) gray levels, bilinear.
        left: column of the image at which the crop begins.
        top: row at which it begins.
        factor: of enlargement.
    """

    patch: Tensor
    left: int
    top: int
    factor: int

    def to_image(self, marks: Tensor) -> Tensor:
        """Positions (..., 2) on the patch as pixels of the image.

        The *edges* of pixels coincide, not their centers: pixel x of the image covers [x - 0.5, x + 0.5], which is ten
        pixels of the patch. So u = (x + 0.5) / factor - 0.5 + left; dividing by the factor alone is 0.45 px wrong.

        Example:
            >>> view = enlarge(torch.rand(40, 40), torch.tensor([20.0, 10.0]), half=4)
            >>> view.to_image(torch.tensor([[4.5, 4.5]])).tolist()  # the middle of the patch's first ten pixels
            [[16.0, 6.0]]
        """
        corner = torch.tensor([self.left, self.top], dtype=torch.float64)
        return (as_points("marks", marks, 2) + 0.5) / self.factor - 0.5 + corner

    def from_image(self, pixels: Tensor) -> Tensor:
        """Pixels (..., 2) of the image as positions on the patch; the inverse of `to_image`."""
        corner = torch.tensor([self.left, self.top], dtype=torch.float64)
        return (as_points("pixels", pixels, 2) - corner + 0.5) * self.factor - 0.5


@dataclass(frozen=True, kw_only=True)
class RefinedPoint:
    """A point refined to a fraction of a pixel.

    Args:
        pixel: (2,) float64.
        covariance: (2, 2) px², from how badly the edges meet in one point: an upper bound, because blur rounds a
            corner and no edge then points exactly at it.
    """

    pixel: Tensor
    covariance: Tensor


def enlarge(image: Tensor, pixel: Tensor, half: int = HALF, factor: int = FACTOR) -> Enlarged:
    """Crop an image round a pixel and enlarge it bilinearly, for marking by eye.

    Args:
        image: (H, W) gray levels.
        pixel: (2,) where to crop; the crop stays inside the image and is smaller at its border.
        half: pixels of the crop on each side of the middle one.
        factor: of enlargement.

    Raises:
        InputError: an image that is not (H, W), or a pixel outside it.

    Example:
        >>> enlarge(torch.rand(40, 40), torch.tensor([20.3, 10.0])).patch.shape
        torch.Size([230, 250])
    """
    pixel = as_points("pixel", pixel, 2)
    require_finite("pixel", pixel)
    if image.ndim != 2 or pixel.shape != (2,) or half < 1 or factor < 1:
        raise InputError(f"image {tuple(image.shape)}, pixel {tuple(pixel.shape)}: (H, W) and (2,) are needed")
    height, width = image.shape
    column, row = (int(value) for value in pixel.round().tolist())
    if not (0 <= column < width and 0 <= row < height):
        raise InputError(f"pixel ({float(pixel[0]):g}, {float(pixel[1]):g}) is outside the image of {width}x{height}")
    left, top = max(column - half, 0), max(row - half, 0)
    crop = image[top : row + half + 1, left : column + half + 1].to(torch.float64)
    # align_corners=False is the half-pixel rule: edges coincide.
    patch = torch.nn.functional.interpolate(crop[None, None], scale_factor=factor, mode="bilinear", align_corners=False)
    return Enlarged(patch=patch[0, 0], left=left, top=top, factor=factor)


def refine_point(image: Tensor, pixel: Tensor) -> RefinedPoint:
    """Move a roughly marked corner (of a roof, a mast, a board) to where its edges meet.

    On the enlarged crop, the point is sought from which all edges nearby are seen end-on: W. Förstner and E. Gülch,
    "A fast operator for detection and precise location of distinct points, corners and centers of circular features",
    1987. For corners of checkerboards `kcal.corners.erf.erf_saddle` is several times better.

    Args:
        image: (H, W) gray levels.
        pixel: (2,) within about 2 px of the corner and at least 5 px inside the image.

    Raises:
        InputError: a pixel at or beyond the image's border, a place without a corner (flat, or one straight edge), or
            a corner farther than 3 px away.

    Example:
        >>> x = torch.arange(40.0, dtype=torch.float64)
        >>> image = 100 * torch.outer(torch.sigmoid(2 * (x - 17.3)), torch.sigmoid(2 * (x - 20.6)))
        >>> [round(value, 1) for value in refine_point(image, torch.tensor([20.0, 18.0])).pixel.tolist()]
        [20.7, 17.4]
    """
    view = enlarge(image, pixel)
    start = view.from_image(as_points("pixel", pixel, 2))
    height, width = view.patch.shape
    factor = view.factor
    room = torch.minimum(start, torch.tensor([width - 1.0, height - 1.0]) - start).min()
    if float(room) < 5 * factor:
        raise InputError("the point is within 5 px of the image's border: no room to refine it")
    gx, gy = _gradients(view.patch, _BLUR * factor)
    y, x = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    where = torch.stack([x, y], -1)
    gradient = torch.stack([gx, gy], -1)
    scatter = gradient[..., :, None] * gradient[..., None, :]
    place = start
    for _ in range(_REPEATS):
        weight = torch.exp(-0.5 * ((where - place) / (_WINDOW * factor)).square().sum(-1))
        normal = (weight[..., None, None] * scatter).sum((0, 1))
        eigenvalues = torch.linalg.eigvalsh(normal)
        if not float(eigenvalues[0]) > _MIN_ROUNDNESS * float(eigenvalues[1]):
            raise InputError("no corner here: the image is flat or a single straight edge; mark another point")
        right = (weight[..., None] * (scatter @ where[..., None])[..., 0]).sum((0, 1))
        moved = torch.linalg.solve(normal, right)
        step = float(torch.linalg.vector_norm(moved - place))
        place = moved
        if float(torch.linalg.vector_norm(place - start)) > _MAX_MOVE * factor:
            raise InputError(f"the nearest corner is more than {_MAX_MOVE:g} px away; mark the point more closely")
        if step < _STILL * factor:
            break
    else:
        raise InputError("the point does not settle: several corners are close together; mark another one")
    miss = (gradient * (where - place)).sum(-1)
    # Neighbors on the enlarged patch say the same: only one in factor² is a measurement of its own.
    effective = weight.sum() / factor**2
    noise = (weight * miss.square()).sum() / weight.sum() * effective / (effective - 2.0).clamp_min(1.0)
    covariance = noise * factor**2 * torch.linalg.inv(normal)
    return RefinedPoint(pixel=view.to_image(place), covariance=covariance / factor**2)


def _gradients(patch: Tensor, sigma: float) -> tuple[Tensor, Tensor]:
    """Derivatives along x and y of the patch after a Gaussian blur; the patch's edge goes on outside."""
    reach = round(4 * sigma)
    offset = torch.arange(-reach, reach + 1, dtype=torch.float64)
    smooth = torch.exp(-0.5 * (offset / sigma) ** 2)
    smooth = smooth / smooth.sum()
    slope = offset * smooth / sigma**2
    padded = torch.nn.functional.pad(patch[None, None], (reach,) * 4, mode="replicate")

    def filtered(across: Tensor, down: Tensor) -> Tensor:
        rows = torch.nn.functional.conv2d(padded, across.reshape(1, 1, 1, -1))
        result: Tensor = torch.nn.functional.conv2d(rows, down.reshape(1, 1, -1, 1))[0, 0]
        return result

    return filtered(slope, smooth), filtered(smooth, slope)
