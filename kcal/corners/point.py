"""Refine single points by eye on an enlarged crop (the paper's Section 4.3), or automatically where edges meet."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kcal.checks import as_points, require_finite
from kcal.corners.patches import as_gray, filtered, gaussian_kernel
from kcal.errors import InputError

FACTOR = 10
HALF = 12  # pixels on each side of the point that are cropped
MAX_POINT_MOVE = 3.0  # pixels
_WINDOW = 4.0  # pixels: sigma of the weight of gradients around the point
_GRADIENT_BLUR = 0.7  # pixels
_MAX_ITERATIONS = 20
_CONVERGED = 1e-4  # pixels
_MIN_ROUNDNESS = 0.02  # smaller over larger eigenvalue of the gradients' scatter; nearly 0 for a single straight edge


@dataclass(frozen=True, kw_only=True)
class Enlarged:
    """A crop of an image, enlarged.

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
        """Convert positions (..., 2) on the patch to pixels of the image.

        The *edges* of pixels coincide, not their centers: pixel x of the image covers [x - 0.5, x + 0.5], which is
        `factor` pixels of the patch. So u = (x + 0.5) / factor - 0.5 + left. Dividing by a factor of 10 alone would be
        wrong by 0.45 px.

        Example:
            >>> view = enlarge(torch.rand(40, 40), torch.tensor([20.0, 10.0]), half=4)
            >>> view.to_image(torch.tensor([[4.5, 4.5]])).tolist()  # the middle of the patch's first ten pixels
            [[16.0, 6.0]]
        """
        corner = torch.tensor([self.left, self.top], dtype=torch.float64)
        return (as_points("marks", marks, 2) + 0.5) / self.factor - 0.5 + corner

    def from_image(self, pixels: Tensor) -> Tensor:
        """Convert pixels (..., 2) of the image to positions on the patch; the inverse of `to_image`."""
        corner = torch.tensor([self.left, self.top], dtype=torch.float64)
        return (as_points("pixels", pixels, 2) - corner + 0.5) * self.factor - 0.5


@dataclass(frozen=True, kw_only=True)
class RefinedPoint:
    """A point refined to a fraction of a pixel.

    Args:
        pixel: (2,) float64.
        covariance: (2, 2) px², from how closely the edges meet in one point. An upper bound: blur rounds a corner,
            so that no edge points exactly at it.
    """

    pixel: Tensor
    covariance: Tensor


def enlarge(image: Tensor, pixel: Tensor, half: int = HALF, factor: int = FACTOR) -> Enlarged:
    """Crop an image around a pixel and enlarge it bilinearly, for marking by eye.

    Args:
        image: (H, W) gray levels.
        pixel: (2,) middle of the crop. The crop stays inside the image and is smaller at its border.
        half: pixels of the crop on each side of the middle one.
        factor: of enlargement.

    Raises:
        InputError: an image that is not (H, W) or not finite, a pixel outside it, or `half` or `factor` below 1.

    Example:
        >>> enlarge(torch.rand(40, 40), torch.tensor([20.3, 10.0])).patch.shape
        torch.Size([230, 250])
    """
    image = as_gray("image", image)
    pixel = as_points("pixel", pixel, 2)
    require_finite("pixel", pixel)
    if pixel.shape != (2,) or half < 1 or factor < 1:
        raise InputError(f"pixel {tuple(pixel.shape)}, half {half}, factor {factor}: (2,) and at least 1 are needed")
    height, width = image.shape
    column, row = (int(value) for value in pixel.round().tolist())
    if not (0 <= column < width and 0 <= row < height):
        raise InputError(f"pixel ({float(pixel[0]):g}, {float(pixel[1]):g}) is outside the image of {width}x{height}")
    left, top = max(column - half, 0), max(row - half, 0)
    crop = image[top : row + half + 1, left : column + half + 1]
    # align_corners=False is the half-pixel rule: edges coincide.
    patch = torch.nn.functional.interpolate(crop[None, None], scale_factor=factor, mode="bilinear", align_corners=False)
    return Enlarged(patch=patch[0, 0], left=left, top=top, factor=factor)


def refine_point(image: Tensor, pixel: Tensor) -> RefinedPoint:
    """Move a roughly marked corner (of a roof, a mast, a board) to where its edges meet.

    On a crop enlarged ten times, it finds the point at which all nearby edges point: W. Förstner and E. Gülch, "A fast
    operator for detection and precise location of distinct points, corners and centers of circular features", 1987.
    For corners of checkerboards `kcal.corners.erf.erf_saddle` is several times more accurate.

    Args:
        image: (H, W) gray levels.
        pixel: (2,) within about 2 px of the corner and at least 5 px inside the image.

    Returns:
        The corner and its covariance.

    Raises:
        InputError: a pixel near or outside the image's border, a place without a corner (flat, or one straight edge),
            several corners close together, or a corner more than 3 px away.

    Example:
        >>> x = torch.arange(40.0, dtype=torch.float64)
        >>> image = 100 * torch.outer(torch.sigmoid(2 * (x - 17.3)), torch.sigmoid(2 * (x - 20.6)))
        >>> [round(value, 1) for value in refine_point(image, torch.tensor([20.0, 18.0])).pixel.tolist()]
        [20.7, 17.4]
    """
    view = enlarge(image, pixel)
    start = view.from_image(pixel)
    height, width = view.patch.shape
    factor = view.factor
    room = torch.minimum(start, torch.tensor([width - 1.0, height - 1.0]) - start).min()
    if float(room) < 5 * factor:
        raise InputError("the point is within 5 px of the image's border: no room to refine it; mark another point")
    gradient = _gradients(view.patch, _GRADIENT_BLUR * factor)
    y, x = torch.meshgrid(
        torch.arange(height, dtype=torch.float64), torch.arange(width, dtype=torch.float64), indexing="ij"
    )
    where = torch.stack([x, y], -1)
    scatter = gradient[..., :, None] * gradient[..., None, :]
    place = start
    for _ in range(_MAX_ITERATIONS):
        weight = torch.exp(-0.5 * ((where - place) / (_WINDOW * factor)).square().sum(-1))
        normal = (weight[..., None, None] * scatter).sum((0, 1))
        eigenvalues = torch.linalg.eigvalsh(normal)
        if not float(eigenvalues[0]) > _MIN_ROUNDNESS * float(eigenvalues[1]):
            raise InputError("no corner here: the image is flat or a single straight edge; mark another point")
        right = (weight[..., None] * (scatter @ where[..., None])[..., 0]).sum((0, 1))
        moved = torch.linalg.solve(normal, right)
        step = float(torch.linalg.vector_norm(moved - place))
        place = moved
        if float(torch.linalg.vector_norm(place - start)) > MAX_POINT_MOVE * factor:
            raise InputError(f"the nearest corner is more than {MAX_POINT_MOVE:g} px away; mark the point more closely")
        if step < _CONVERGED * factor:
            break
    else:
        raise InputError("the point does not converge: several corners are close together; mark another point")
    miss = (gradient * (where - place)).sum(-1)
    # Neighboring pixels of the patch are interpolated: only one in factor² is an independent measurement.
    effective = weight.sum() / factor**2
    noise = (weight * miss.square()).sum() / weight.sum() * effective / (effective - 2.0).clamp_min(1.0)
    covariance = noise * factor**2 * torch.linalg.inv(normal)
    return RefinedPoint(pixel=view.to_image(place), covariance=covariance / factor**2)


def _gradients(patch: Tensor, sigma: float) -> Tensor:
    """Derivatives (H, W, 2) along x and y of a patch (H, W) after a Gaussian blur."""
    reach = round(4 * sigma)
    smooth = gaussian_kernel(sigma, reach)
    slope = torch.arange(-reach, reach + 1, dtype=torch.float64) * smooth / sigma**2
    return torch.stack([filtered(patch, slope, smooth), filtered(patch, smooth, slope)], -1)
