"""Refine checkerboard corners to the saddle points of fitted quadratics, differentiable and in batches.

Where four squares meet, the blurred image is a saddle. A quadratic is fitted to a small disc by least squares, the
center moves to its stationary point, and both repeat until the center stands still. The fit is linear algebra with one
constant matrix; it needs no orientation. After L. Lucchese and S. K. Mitra, "Using saddle points for subpixel feature
detection in camera calibration targets", APCCAS 2002.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points, exportable
from kcal.errors import InputError

# Pixels: radius of the disc and sigma of the blur before the fit. On rendered boards with squares of 10 to 40 px these
# gave the smallest errors over all blurs.
RADIUS = 3.0
BLUR = 1.5
MAX_MOVE = 2.0  # pixels from the start
SQUARE_SHARE = 0.35  # of the smallest square side: no window reaches further; measured for cornerSubPix as well
MOVE_SHARE = 0.3  # of the smallest square side: no corner moves further
MIN_FIT = 0.85  # share of the gray levels' variance that the quadratic must explain; 0.98 to 0.999 on real corners
CONVERGED = 0.02  # pixels: the last step of a converged corner is at most this long

_REPEATS = 6
_HALF = 12  # of the patch: 0.5 rounding + MAX_MOVE + RADIUS + 1 bilinear + 3 sigma of blur, rounded up


class CornerStatus(IntEnum):
    """Whether a corner was refined, or why not."""

    GOOD = 0
    MISSING = 1  # the start was NaN
    OUTSIDE = 2  # the window or its blur leaves the image
    NO_SADDLE = 3  # the gray levels form a maximum, a minimum or an edge, or fit no quadratic
    MOVED = 4  # farther from the start than allowed
    NOT_CONVERGED = 5  # still moving after the last iteration
    SATURATED = 6  # too many gray levels at one end of the scale
    OCCLUDED = 7  # the gray levels are not those of four squares: something covers the corner
    BLURRED = 8  # the edges are too wide for the squares


@exportable
class Refined(NamedTuple):
    """Corners that were refined, and how well they are known.

    Args:
        pixels: (..., N, 2) float64, NaN where `status` is not `CornerStatus.GOOD`.
        status: (..., N) int64, see `CornerStatus`.
        covariance: (..., N, 2, 2) px² of (u, v), NaN where not good; None from methods that do not estimate it.
        blur: (..., N) px, sigma of the edges' Gaussian, which includes the pixel's own area; NaN where not good; None
            from methods that do not estimate it.
    """

    pixels: Tensor
    status: Tensor
    covariance: Tensor | None = None
    blur: Tensor | None = None


def saddle(image: Tensor, pixels: Tensor, side: Tensor | float) -> Refined:
    """Move corners to the saddle points of the image.

    The disc has a radius of 3 px after a Gaussian of 1.5 px; both shrink together where 3 px would be more than 0.35
    of the square. Samples are bilinear, because bicubic ones bias the corner by 0.03 px. The result is differentiable
    with respect to `image`, through the iterations.

    Args:
        image: (..., H, W) gray levels, floating point or uint8, of any scale.
        pixels: (..., N, 2) starts, within 2 px and 0.3 of the square; NaN where a corner was not seen.
        side: smallest side in pixels of the squares around each corner, (..., N) or one number.

    Returns:
        The corners, NaN where none was found, and the `CornerStatus` of each.

    Raises:
        InputError: shapes that do not match, or a side that is not positive.

    Example:
        >>> x = torch.arange(40.0, dtype=torch.float64)
        >>> image = torch.outer(torch.tanh(x - 19.3), torch.tanh(x - 20.6))
        >>> start = torch.tensor([[20.0, 20.0]], dtype=torch.float64)
        >>> found = saddle(image, start, side=15.0)
        >>> [round(value, 2) for value in found.pixels[0].tolist()], int(found.status[0])
        ([20.6, 19.3], 0)
    """
    image, pixels, side = check_arguments(image, pixels, side)
    height, width = image.shape[-2:]
    seen = torch.isfinite(pixels).all(-1)
    start = torch.where(seen[..., None], pixels, 0.0)
    scale = (side * SQUARE_SHARE / RADIUS).clamp(max=1.0)
    limit = (side * MOVE_SHARE).clamp(max=MAX_MOVE)
    base = start.detach().round()
    # Patches and all that follows have shape (corners of all images, ...).
    patches = _blurred_patches(image.reshape(-1, height, width), base.reshape(-1, base.shape[-2], 2), scale)
    offset = (start - base).reshape(-1, 2)
    offsets, design, inverse = _disc(image.device)
    flat_scale = scale.reshape(-1, 1)

    where, step = offset, torch.zeros_like(offset)
    is_saddle = torch.zeros(len(offset), dtype=torch.bool, device=image.device)
    for _ in range(_REPEATS):
        samples = _bilinear(patches, where[:, None] + flat_scale[:, None] * offsets)
        step, is_saddle = _stationary(samples @ inverse.T)
        is_saddle = is_saddle & _fits(samples, samples @ inverse.T @ design.T)
        step = step * flat_scale
        # Bound the step, and keep the disc on the patch. Good corners reach neither bound.
        step = step * (RADIUS / 2 * flat_scale / _safe_norm(step)).clamp(max=1.0)
        move = where + step - offset
        where = offset + move * (MAX_MOVE / _safe_norm(move)).clamp(max=1.0)
    moved = (where - offset).reshape(start.shape)
    result = start + moved
    margin = (RADIUS + 2 * BLUR) * scale
    checks = (
        (CornerStatus.MISSING, seen),
        (CornerStatus.OUTSIDE, inside_image(result.detach(), margin, width, height)),
        (CornerStatus.NO_SADDLE, is_saddle),
        (CornerStatus.MOVED, _safe_norm(moved)[..., 0] < limit),
        (CornerStatus.NOT_CONVERGED, _safe_norm(step) <= CONVERGED),
    )
    return Refined(*with_status(result, checks))


def inside_image(pixels: Tensor, margin: Tensor, width: int, height: int) -> Tensor:
    """Whether pixels (..., 2) keep a margin (...) from the centers of the image's border pixels."""
    x, y = pixels.unbind(-1)
    return (x >= margin) & (x <= width - 1 - margin) & (y >= margin) & (y <= height - 1 - margin)


def with_status(pixels: Tensor, checks: Sequence[tuple[CornerStatus, Tensor]]) -> tuple[Tensor, Tensor]:
    """Pixels (..., N, 2), NaN where any check failed, and the status of the first check that failed, (..., N)."""
    status = torch.zeros(pixels.shape[:-1], dtype=torch.int64, device=pixels.device)
    for code, passed in reversed(checks):
        status = torch.where(passed.reshape(status.shape), status, int(code))
    return torch.where((status == CornerStatus.GOOD)[..., None], pixels, float("nan")), status


def check_arguments(image: Tensor, pixels: Tensor, side: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
    """The arguments of `saddle`: pixels and sides as float64, and one side per corner.

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
    """Sample offsets on the disc (K, 2), 1, x, y, x², xy, y² there (K, 6), and the pseudo-inverse of these (6, K)."""
    axis = torch.arange(-int(RADIUS), int(RADIUS) + 1, dtype=torch.float64, device=device)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    keep = x**2 + y**2 <= RADIUS**2
    x, y = x[keep], y[keep]
    design = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1)
    return torch.stack([x, y], -1), design, torch.linalg.solve(design.T @ design, design.T)


def cut_patches(image: Tensor, base: Tensor, half: int) -> Tensor:
    """Cut (2 half + 1)² gray levels around whole pixels `base` (B, N, 2) from (B, H, W): (B N, P, P) float64.

    Border pixels are repeated outside the image.
    """
    height, width = image.shape[-2:]
    reach = torch.arange(-half, half + 1, device=image.device)
    columns = (base[..., 0].long()[..., None] + reach).clamp(0, width - 1)
    rows = (base[..., 1].long()[..., None] + reach).clamp(0, height - 1)
    index = rows[..., :, None] * width + columns[..., None, :]
    cut = image.reshape(len(image), -1).gather(1, index.reshape(len(image), -1)).to(torch.float64)
    return cut.reshape(-1, 2 * half + 1, 2 * half + 1)


def _blurred_patches(image: Tensor, base: Tensor, scale: Tensor) -> Tensor:
    """Patches around `base` (B, N, 2) of (B, H, W), each blurred with its own sigma: (B N, P, P)."""
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
    return torch.nn.functional.grid_sample(patches[:, None], grid, mode="bilinear", align_corners=True)[:, 0, 0]


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


def _safe_norm(vector: Tensor) -> Tensor:
    """Detached Euclidean norm, (..., 1), never zero so that it can divide."""
    return torch.linalg.vector_norm(vector.detach(), dim=-1, keepdim=True).clamp(min=1e-12)
