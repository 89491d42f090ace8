"""Estimate the covariance of fitted corners from the part of the residuals that can move a corner.

Four squares look the same after a turn by 180° about their corner. A model error that is the same on opposite sides
(blur that is no Gaussian, a camera's tone curve) cannot move the corner. So the noise is estimated from the part of the
residuals that is odd about the corner. Its correlation between pixels is the average over the image: JPEG leaves coarse
steps of high spatial frequency, which hardly move a corner; a lens or a demosaicked sensor smooths noise, which moves
it more.
"""

from __future__ import annotations

from types import EllipsisType

import torch
from torch import Tensor

_CORRELATED = 2  # pixels: the largest distance at which correlation is estimated
_MIN_PIXELS = 2000  # in the windows of an image; fewer do not separate correlation from chance
# Bounds of the factor by which correlation may change the variance. Beyond, the residuals are a pattern, not noise.
_VARIANCE_FACTORS = 0.1, 10.0
# The windows of one image have similar noise: the image's mean counts as much as this many pixels of a window.
_SHARED_PIXELS = 40.0


def center_covariance(
    residual: Tensor,
    weight: Tensor,
    jacobian: Tensor,
    inverse: Tensor,
    center: Tensor,
    usable: Tensor,
    least_noise: float,
) -> Tensor:
    """The covariance of the first two parameters, the corner's position.

    The parameters' error is G noise with G = H⁻¹ JᵀW, and its covariance G R Gᵀ, where R is the covariance of the noise
    and W only shapes the window. The residuals are (1 - J G) noise: fitting itself correlates them, and what it does to
    white noise is subtracted from the correlation found.

    Args:
        residual: (B, N, P, P) gray levels, for all corners of B images.
        weight: (B, N, P, P).
        jacobian: (B, N, p, P, P), only of the parameters whose derivatives are odd about the corner.
        inverse: (B, N, p, p), the same part of H⁻¹.
        center: (B, N, 2) pixels from the middle of the patch.
        usable: (B, N) corners from which the image's noise is estimated.
        least_noise: lower bound of the variance; 1/12 for rounded gray levels, because flat black and white are all
            rounded alike and show less of it than edges.

    Returns:
        (B, N, 2, 2) px².
    """
    gain = torch.einsum("bnij,bnjyx->bniyx", inverse, jacobian * weight[:, :, None])
    outer = torch.einsum("bniyx,bnjyx->bnij", gain, gain)  # G Gᵀ
    smeared = torch.einsum("bnij,bnjyx->bniyx", outer, jacobian)
    moving, white = gain[:, :, :2], outer[..., :2, :2]
    odd, pair = _odd(residual, weight, center)

    def found_and_made(down: int, right: int) -> tuple[Tensor, Tensor, Tensor]:
        """Weighted sums over pairs of pixels: products found, products that fitting makes of white noise, and pairs."""
        here, there = _pixel_pairs(down, right)
        both = pair[here] * pair[there]
        # (1 - J G)(1 - J G)ᵀ beside the 1, twice: all of it is odd.
        made = 2.0 * (both * (jacobian[here] * (smeared - gain)[there] - gain[here] * jacobian[there]).sum(-3))
        return (both * odd[here] * odd[there]).sum((-2, -1)), made.sum((-2, -1)), both.sum((-2, -1))

    found, made, count = found_and_made(0, 0)
    freedom = (count + made).clamp_min(1.0)
    common = _sum_usable(found, usable) / _sum_usable(freedom, usable).clamp_min(1.0)
    known = torch.where(usable.sum(-1) >= 2, _SHARED_PIXELS, 0.0)[:, None]
    noise = (found + known * common[:, None]) / (freedom + known)
    scale = 1.0 / torch.where(noise > 0, noise, 1.0)
    enough = _sum_usable(count, usable) >= _MIN_PIXELS
    covariance = white.clone()
    for down in range(_CORRELATED + 1):
        for right in range(-_CORRELATED if down else 1, _CORRELATED + 1):
            found, made, count = found_and_made(down, right)
            correlation = _sum_usable(found * scale - made, usable) / _sum_usable(count, usable).clamp_min(1.0)
            correlation = torch.where(enough, correlation, 0.0)
            here, there = _pixel_pairs(down, right)
            cross = torch.einsum("bniyx,bnjyx->bnij", moving[here], moving[there])
            covariance = covariance + correlation[:, None, None, None] * (cross + cross.transpose(-1, -2))
    return noise.clamp_min(least_noise)[..., None, None] * _bounded(covariance, white)


def _sum_usable(values: Tensor, usable: Tensor) -> Tensor:
    return torch.where(usable, values, 0.0).sum(-1)


def _odd(residual: Tensor, weight: Tensor, center: Tensor) -> tuple[Tensor, Tensor]:
    """The odd part of the residuals about the corner, scaled to the variance of noise, and the weight of each pair."""
    size = residual.shape[-1]
    # Rounded to half a pixel, so that opposite pixels are pixels.
    twice = (2.0 * center).round().nan_to_num().long() + 2 * (size // 2)
    axis = torch.arange(size, device=residual.device)
    columns, rows = twice[..., :1] - axis, twice[..., 1:] - axis
    inside = ((columns >= 0) & (columns < size))[..., None, :] & ((rows >= 0) & (rows < size))[..., :, None]
    index = rows.clamp(0, size - 1)[..., :, None] * size + columns.clamp(0, size - 1)[..., None, :]

    def opposite(values: Tensor) -> Tensor:
        return values.flatten(-2).gather(-1, index.flatten(-2)).reshape(values.shape)

    pair = torch.minimum(weight, opposite(weight)) * inside
    return (residual - opposite(residual)) * 0.5**0.5, pair


def _pixel_pairs(down: int, right: int) -> tuple[tuple[EllipsisType | slice, ...], tuple[EllipsisType | slice, ...]]:
    """Indices of all pixels that have another one `down` rows below and `right` columns beside, and of that one."""
    rows = slice(None, -down or None), slice(down, None)
    columns = (
        (slice(None, -right or None), slice(right, None)) if right >= 0 else (slice(-right, None), slice(None, right))
    )
    return (..., rows[0], columns[0]), (..., rows[1], columns[1])


def _bounded(covariance: Tensor, white: Tensor) -> Tensor:
    """The covariance with its ratio to that of white noise bounded in every direction."""
    factor, _ = torch.linalg.cholesky_ex(torch.nan_to_num(white))
    whitened = torch.linalg.solve_triangular(factor, torch.nan_to_num(covariance), upper=False)
    whitened = torch.linalg.solve_triangular(factor, whitened.transpose(-1, -2), upper=False)
    values, vectors = torch.linalg.eigh(torch.nan_to_num(0.5 * (whitened + whitened.transpose(-1, -2))))
    sides = factor @ vectors
    return (sides * values.clamp(*_VARIANCE_FACTORS)[..., None, :]) @ sides.transpose(-1, -2)
