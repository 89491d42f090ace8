"""Sub-pixel corners of a checkerboard as saddle points of a quadratic, in torch, for gradients and for batches.

Where four squares meet, the blurred image is a saddle. A quadratic is fitted to it by least squares on a small disc,
the center moves to the quadratic's stationary point, and this is repeated until it stands still. The fit is linear
algebra with one constant matrix: no orientation, no start values, no window that swallows the neighbor.
After L. Lucchese and S. K. Mitra, "Using saddle points for subpixel feature detection in camera calibration targets",
APCCAS 2002.
"""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor, nn

from kcal.checks import as_points
from kcal.errors import InputError

RADIUS = 3.0  # pixels, of the disc
BLUR = 1.5  # pixels, sigma of the Gaussian before the fit
REPEATS = 6
MAX_MOVE = 2.0  # pixels from the start
SQUARE_SHARE = 0.35  # of the smallest square side: the disc never reaches further
MOVE_SHARE = 0.3  # of the smallest square side: a corner never moves further
MIN_FIT = 0.85  # share of the gray levels' variance that the quadratic must explain; 0.98 to 0.999 on real corners
STILL = 0.02  # pixels: a last step below this has converged

_HALF = 12  # of the patch: 0.5 rounding + MAX_MOVE + RADIUS + 1 bilinear + 3 sigma of blur, rounded up


class Status(IntEnum):
    """What became of a corner."""

    GOOD = 0
    MISSING = 1  # the start was NaN
    OUTSIDE = 2  # the disc and its blur leave the image
    NO_SADDLE = 3  # the gray levels form a hill, a hollow or an edge, or fit no quadratic: something covers the corner
    MOVED = 4  # further from its start than it may
    RESTLESS = 5  # still moving after the last repeat
    SATURATED = 6  # too many gray levels at the end of the scale
    OCCLUDED = 7  # the gray levels are not those of four squares: something covers the corner
    BLURRED = 8  # the edges are too wide for the squares


class Refined(NamedTuple):
    """Refined corners.

    Args:
        pixels: (..., N, 2) float64, NaN where `status` is not `Status.GOOD`.
        status: (..., N) int64, see `Status`.
        covariance: (..., N, 2, 2) px² of (u, v), NaN where not good; None from methods that do not tell.
        blur: (..., N) px, sigma of the edges' Gaussian with the pixel's own area in it, NaN where not good; or None.
    """

    pixels: Tensor
    status: Tensor
    covariance: Tensor | None = None
    blur: Tensor | None = None


def saddle(image: Tensor, pixels: Tensor, side: Tensor | float) -> Refined:
    """Move corners to the saddle points of the image.

    The disc has a radius of 3 px after a Gaussian of 1.5 px; both shrink together where 3 px would be more than 0.35
    of the square. Samples between pixels are bilinear: bicubic ones would bias the corner by 0.03 px. The result is
    differentiable with respect to `image`, through the repeats.

    Args:
        image: (..., H, W) gray levels, floating point or uint8, of any scale.
        pixels: (..., N, 2) starts, within 2 px and 0.3 of the square; NaN where a corner was not seen.
        side: the smallest side in pixels of the squares round each corner, (..., N) or one number.

    Returns:
        The corners, NaN where no corner can be vouched for, and a `Status` for each.

    Raises:
        InputError: shapes that do not fit together, or a side that is not positive.

    Example:
        >>> x = torch.arange(40.0, dtype=torch.float64)
        >>> image = torch.outer(torch.tanh(x - 19.3), torch.tanh(x - 20.6))
        >>> start = torch.tensor([[20.0, 20.0]], dtype=torch.float64)
        >>> found = saddle(image, start, side=15.0)
        >>> [round(value, 2) for value in found.pixels[0].tolist()], int(found.status[0])
        ([20.6, 19.3], 0)
    """
    image, pixels, side = check_arguments(image, pixels, side)
    batch, (height, width) = pixels.shape[:-2], image.shape[-2:]
    seen = torch.isfinite(pixels).all(-1)
    start = torch.where(seen[..., None], pixels, 0.0)
    scale = (side * SQUARE_SHARE / RADIUS).clamp(max=1.0)
    limit = (side * MOVE_SHARE).clamp(max=MAX_MOVE)
    base = start.detach().round()
    # Patches and all that follows have shape (corners of all images, ...).
    patches = _blurred_patches(image.reshape(-1, height, width), base.reshape(-1, base.shape[-2], 2), scale)
    offset = (start - base).reshape(-1, 2)
    offsets, design, inverse = _disc(image.device)
    flat_scale, flat_limit = scale.reshape(-1, 1), limit.reshape(-1, 1)

    where, step = offset, torch.zeros_like(offset)
    is_saddle = torch.zeros(len(offset), dtype=torch.bool, device=image.device)
    for _ in range(REPEATS):
        samples = _bilinear(patches, where[:, None] + flat_scale[:, None] * offsets)
        step, is_saddle = _stationary(samples @ inverse.T)
        is_saddle = is_saddle & _fits(samples, samples @ inverse.T @ design.T)
        step = step * flat_scale
        # A bounded step, and a center whose disc stays on the patch; both bounds are out of reach of a good corner.
        step = step * (RADIUS / 2 * flat_scale / _length(step)).clamp(max=1.0)
        move = where + step - offset
        where = offset + move * (MAX_MOVE / _length(move)).clamp(max=1.0)
    moved = (where - offset).reshape(start.shape)
    result = start + moved

    margin = (RADIUS + 2 * BLUR) * scale
    x, y = result.detach().unbind(-1)
    inside = (x >= margin) & (x <= width - 1 - margin) & (y >= margin) & (y <= height - 1 - margin)
    checks = (
        (Status.RESTLESS, _length(step)[:, 0].reshape(x.shape) <= STILL),
        (Status.MOVED, _length(moved)[..., 0] < flat_limit[:, 0].reshape(x.shape)),
        (Status.NO_SADDLE, is_saddle.reshape(x.shape)),
        (Status.OUTSIDE, inside),
        (Status.MISSING, seen),
    )
    status = torch.zeros((*batch, start.shape[-2]), dtype=torch.int64, device=image.device)
    for code, passed in checks:  # the most basic trouble last, so that it is the one reported
        status = torch.where(passed, status, int(code))
    return Refined(torch.where((status == Status.GOOD)[..., None], result, float("nan")), status)


class SaddleRefine(nn.Module):
    """`saddle` as a module without parameters, to hold in a pipeline.

    Example:
        >>> x = torch.arange(40.0, dtype=torch.float64)
        >>> image = torch.outer(torch.tanh(x - 19.3), torch.tanh(x - 20.6))
        >>> SaddleRefine()(image, torch.tensor([[20.0, 20.0]]), 15.0).status
        tensor([0])
    """

    def forward(self, image: Tensor, pixels: Tensor, side: Tensor | float) -> Refined:
        """See `saddle`."""
        return saddle(image, pixels, side)


def check_arguments(image: Tensor, pixels: Tensor, side: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
    """The arguments of `saddle`, positions and sides as float64 and sides of one shape with the corners.

    Raises:
        InputError: see `saddle`.
    """
    if not isinstance(image, Tensor) or image.ndim < 2:
        raise InputError("image: a tensor of shape (..., H, W) is needed")
    if not (image.is_floating_point() or image.dtype == torch.uint8):
        raise InputError(f"image: floating point or uint8 is needed, got {image.dtype}; convert with .double()")
    pixels = as_points("pixels", pixels, 2)
    if pixels.ndim < 2:
        raise InputError(f"pixels: shape (..., N, 2) is needed, got {tuple(pixels.shape)}")
    if pixels.shape[:-2] != image.shape[:-2]:
        raise InputError(
            f"image {tuple(image.shape)} and pixels {tuple(pixels.shape)}: the dimensions before the last two differ"
        )
    sides = torch.as_tensor(side, dtype=torch.float64, device=pixels.device).detach()
    if not bool((sides > 0).all()):
        raise InputError("side: positive side lengths in pixels are needed")
    try:
        sides = sides.expand(pixels.shape[:-1])
    except RuntimeError:
        raise InputError(f"side: shape {tuple(sides.shape)} does not fit pixels {tuple(pixels.shape)}") from None
    return image, pixels, sides


def _disc(device: torch.device) -> tuple[Tensor, Tensor, Tensor]:
    """Sample offsets (K, 2) on the disc, 1, x, y, x², xy, y² there (K, 6), and the (6, K) pseudo-inverse of these."""
    axis = torch.arange(-int(RADIUS), int(RADIUS) + 1, dtype=torch.float64, device=device)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    keep = x**2 + y**2 <= RADIUS**2
    x, y = x[keep], y[keep]
    design = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1)
    return torch.stack([x, y], -1), design, torch.linalg.solve(design.T @ design, design.T)


def cut_patches(image: Tensor, base: Tensor, half: int) -> Tensor:
    """Cut (2 half + 1)² gray levels round whole pixels `base` (B, N, 2) from (B, H, W): (B N, P, P) float64.

    Outside the image its edge goes on.
    """
    height, width = image.shape[-2:]
    reach = torch.arange(-half, half + 1, device=image.device)
    columns = (base[..., 0].long()[..., None] + reach).clamp(0, width - 1)
    rows = (base[..., 1].long()[..., None] + reach).clamp(0, height - 1)
    index = rows[..., :, None] * width + columns[..., None, :]
    cut = image.reshape(len(image), -1).gather(1, index.reshape(len(image), -1)).to(torch.float64)
    return cut.reshape(-1, 2 * half + 1, 2 * half + 1)


def _blurred_patches(image: Tensor, base: Tensor, scale: Tensor) -> Tensor:
    """Patches round `base` (B, N, 2) of (B, H, W), each blurred with its own sigma: (B N, P, P)."""
    patches = cut_patches(image, base, _HALF)
    reach = torch.arange(-_HALF, _HALF + 1, device=image.device)
    sigma = (BLUR * scale).reshape(-1, 1, 1)
    distance = (reach[:, None] - reach[None, :]).to(torch.float64)
    kernel = torch.exp(-0.5 * (distance / sigma) ** 2)
    kernel = kernel / kernel.sum(-1, keepdim=True)
    return kernel @ patches @ kernel.transpose(-1, -2)


def _bilinear(patches: Tensor, where: Tensor) -> Tensor:
    """Sample (M, P, P) patches at `where` (M, K, 2) pixels from their centers: (M, K)."""
    grid = (where / _HALF)[:, None]
    return nn.functional.grid_sample(patches[:, None], grid, mode="bilinear", align_corners=True)[:, 0, 0]


def _stationary(quadratic: Tensor) -> tuple[Tensor, Tensor]:
    """The stationary point (M, 2) of quadratics (M, 6), and whether it is a saddle; zero where it is not."""
    _, gx, gy, xx, xy, yy = quadratic.unbind(-1)
    determinant = 4 * xx * yy - xy * xy
    is_saddle = determinant < 0
    safe = torch.where(is_saddle, determinant, 1.0)
    step = torch.stack([(xy * gy - 2 * yy * gx) / safe, (xy * gx - 2 * xx * gy) / safe], -1)
    return torch.where(is_saddle[:, None], step, 0.0), is_saddle


def _fits(samples: Tensor, quadratic: Tensor) -> Tensor:
    """Whether the quadratic explains the samples (M, K), (M,) bool."""
    samples, quadratic = samples.detach(), quadratic.detach()
    return (samples - quadratic).square().sum(-1) <= (1 - MIN_FIT) * samples.var(-1, correction=0) * samples.shape[-1]


def _length(vector: Tensor) -> Tensor:
    """Detached Euclidean length, (..., 1), never zero so that it can divide."""
    return torch.linalg.vector_norm(vector.detach(), dim=-1, keepdim=True).clamp(min=1e-12)
