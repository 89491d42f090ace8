"""How far a fitted corner can be off: the noise of the gray levels, as far as it can move a corner.

Turned by 180° round a corner, four squares are what they were, and so is everything that is wrong with the model in
both places alike (blur that is no Gaussian, a camera's tone curve): it cannot move the corner. So the noise is taken
from what the model leaves that is odd round the corner, and its correlation from pixel to pixel as it is on average
over the image: JPEG leaves coarse steps of high spatial frequencies, which hardly move a corner; a lens or a
demosaicked sensor smooths noise, which moves it more.
"""

from __future__ import annotations

from types import EllipsisType

import torch
from torch import Tensor

_REACH = 2  # pixels: how far correlation is looked for
_LEAST_PIXELS = 2000  # in the windows of an image; fewer do not tell the correlations from chance
# Correlation may change the variance by so much. Beyond, what is left is not noise but another pattern.
_CLAMP = 0.1, 10.0
# Windows of one image share their noise, more or less: the image's mean counts as much as so many pixels of a window.
_SHARED = 40.0


def spread(
    residual: Tensor,
    weight: Tensor,
    jacobian: Tensor,
    inverse: Tensor,
    center: Tensor,
    usable: Tensor,
    least_noise: float,
) -> Tensor:
    """The covariance of the first two parameters.

    With residuals e = noise - J H⁻¹ JᵀW noise, the parameters' error is G noise, G = H⁻¹ JᵀW, and its covariance is
    G R Gᵀ, R being the noise's covariance. The weights W only shape the window. Fitting itself makes neighboring
    residuals differ; what it would make of white noise is subtracted from the correlation found.

    Args:
        residual: (B, N, P, P) gray levels, for all corners of B images.
        weight: (B, N, P, P).
        jacobian: (B, N, p, P, P), of the parameters that are odd round the corner only.
        inverse: (B, N, p, p), of H⁻¹ the same.
        center: (B, N, 2) pixels from the middle of the patch.
        usable: (B, N) corners from which the image's noise is learned.
        least_noise: that of rounding, 1/12: flat black and white are rounded alike everywhere and show less of it than
            there is at edges.

    Returns:
        (B, N, 2, 2) px².
    """
    gain = torch.einsum("bnij,bnjyx->bniyx", inverse, jacobian * weight[:, :, None])
    outer = torch.einsum("bniyx,bnjyx->bnij", gain, gain)  # G Gᵀ
    smeared = torch.einsum("bnij,bnjyx->bniyx", outer, jacobian)
    moving, white = gain[:, :, :2], outer[..., :2, :2]
    odd, pair = _odd(residual, weight, center)

    def found_and_made(down: int, right: int) -> tuple[Tensor, Tensor, Tensor]:
        """Sums over pairs of pixels: of the products found, of what fitting makes of white noise, and of the pairs."""
        here, there = _pairs(down, right)
        both = pair[here] * pair[there]
        # (1 - J G)(1 - J G)ᵀ beside the 1, twice: all of it is odd.
        made = 2.0 * (both * (jacobian[here] * (smeared - gain)[there] - gain[here] * jacobian[there]).sum(-3))
        return (both * odd[here] * odd[there]).sum((-2, -1)), made.sum((-2, -1)), both.sum((-2, -1))

    found, made, count = found_and_made(0, 0)
    freedom = (count + made).clamp_min(1.0)
    common = _sum(found, usable) / _sum(freedom, usable).clamp_min(1.0)
    known = torch.where(usable.sum(-1) >= 2, _SHARED, 0.0)[:, None]
    noise = (found + known * common[:, None]) / (freedom + known)
    scale = 1.0 / torch.where(noise > 0, noise, 1.0)
    enough = _sum(count, usable) >= _LEAST_PIXELS
    covariance = white.clone()
    for down in range(_REACH + 1):
        for right in range(-_REACH if down else 1, _REACH + 1):
            found, made, count = found_and_made(down, right)
            correlation = _sum(found * scale - made, usable) / _sum(count, usable).clamp_min(1.0)
            correlation = torch.where(enough, correlation, 0.0)
            here, there = _pairs(down, right)
            cross = torch.einsum("bniyx,bnjyx->bnij", moving[here], moving[there])
            covariance = covariance + correlation[:, None, None, None] * (cross + cross.transpose(-1, -2))
    return noise.clamp_min(least_noise)[..., None, None] * _bounded(covariance, white)


def _sum(values: Tensor, usable: Tensor) -> Tensor:
    return torch.where(usable, values, 0.0).sum(-1)


def _odd(residual: Tensor, weight: Tensor, center: Tensor) -> tuple[Tensor, Tensor]:
    """What is odd round the corner, of the variance of the whole if that is noise, and the weight of both places."""
    size = residual.shape[-1]
    # To half a pixel, so that pixels fall on pixels.
    twice = (2.0 * center).round().nan_to_num().long() + 2 * (size // 2)
    axis = torch.arange(size, device=residual.device)
    columns, rows = twice[..., :1] - axis, twice[..., 1:] - axis
    inside = ((columns >= 0) & (columns < size))[..., None, :] & ((rows >= 0) & (rows < size))[..., :, None]
    index = rows.clamp(0, size - 1)[..., :, None] * size + columns.clamp(0, size - 1)[..., None, :]

    def opposite(values: Tensor) -> Tensor:
        return values.flatten(-2).gather(-1, index.flatten(-2)).reshape(values.shape)

    pair = torch.minimum(weight, opposite(weight)) * inside
    return (residual - opposite(residual)) * 0.5**0.5, pair


def _pairs(down: int, right: int) -> tuple[tuple[EllipsisType | slice, ...], tuple[EllipsisType | slice, ...]]:
    """Indices of all pixels that have another one so far below and to the right, and of that one."""
    rows = slice(None, -down or None), slice(down, None)
    columns = (
        (slice(None, -right or None), slice(right, None)) if right >= 0 else (slice(-right, None), slice(None, right))
    )
    return (..., rows[0], columns[0]), (..., rows[1], columns[1])


def _bounded(covariance: Tensor, white: Tensor) -> Tensor:
    """The covariance with its ratio to that of white noise within the bounds, in every direction."""
    factor, _ = torch.linalg.cholesky_ex(torch.nan_to_num(white))
    whitened = torch.linalg.solve_triangular(factor, torch.nan_to_num(covariance), upper=False)
    whitened = torch.linalg.solve_triangular(factor, whitened.transpose(-1, -2), upper=False)
    values, vectors = torch.linalg.eigh(torch.nan_to_num(0.5 * (whitened + whitened.transpose(-1, -2))))
    sides = factor @ vectors
    return (sides * values.clamp(*_CLAMP)[..., None, :]) @ sides.transpose(-1, -2)
