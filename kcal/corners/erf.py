"""Refine corners by fitting two blurred, crossing edges; each gets a covariance and a blur.

`kcal.corners.crossing.crossing` models all pixels within half a square (at most 12 px) of each corner. A small batched
Levenberg-Marquardt estimates its ten parameters for all corners at once. Nothing is interpolated: the model is
evaluated at the pixels.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.corners.erf_fit import CrossingFit, fit_crossings
from kcal.corners.grid import Neighbors
from kcal.corners.saddle import MAX_MOVE, MOVE_SHARE, CornerStatus, Refined, check_arguments, inside_image, with_status
from kcal.errors import InputError

MAX_BLUR = 0.3  # of the square side
MAX_KNOWN_BLUR = 0.35  # the same where the neighboring lines belong to the model
MAX_SATURATED = 0.6  # share of the window at one end of the scale; light squares alone are half of it
# Limits of the RMS residual over half the contrast; above, something covers the corner. 99.9 % of the corners on real
# images are below the first. Noisy images get a multiple of their median, up to the third.
MAX_MISFIT = 0.2
_MEDIANS = 2.5
_WORST_MISFIT = 0.5


def erf_saddle(
    image: Tensor,
    pixels: Tensor,
    side: Tensor | float,
    *,
    bend: Tensor | None = None,
    around: Neighbors | None = None,
    levels: tuple[float, float] | None = None,
) -> Refined:
    """Fit two blurred edges that cross at each corner.

    Starts must be good to about half a pixel, such as those of `kcal.corners.saddle.saddle`. The corners are
    differentiable with respect to `image` by the implicit function theorem; covariance and blur carry no gradient.

    Args:
        image: (..., H, W) gray levels, floating point or uint8.
        pixels: (..., N, 2) starts; NaN where a corner was not seen.
        side: smallest side in pixels of the squares around each corner, (..., N) or one number.
        bend: (..., N, 2, 2) curvature vectors in 1 / pixels of the lines through each corner along the board's rows
            and columns (`kcal.corners.grid.line_bend`): a distorting lens bends them by enough to shift the corner.
            Straight if not given.
        around: steps to the neighboring corners (`kcal.corners.grid.neighbors`). Where blur is a good part of a
            square, the lines through them reach into the window. Ignored if not given.
        levels: darkest and brightest gray level that an image of integers can have, to reject saturated corners; no
            such check if None.

    Returns:
        The corners with covariance, blur and status.

    Raises:
        InputError: shapes that do not match, or a side that is not positive.

    Example:
        >>> x = torch.arange(40.0, dtype=torch.float64)
        >>> image = torch.outer(torch.erf((x - 19.3) / 1.4), torch.erf((x - 20.6) / 1.4)) * 80 + 128
        >>> found = erf_saddle(image, torch.tensor([[20.5, 19.5]]), side=15.0)
        >>> [round(value, 6) for value in found.pixels[0].tolist()], round(float(found.blur[0]), 3)
        ([20.6, 19.3], 0.99)
    """
    image, pixels, side = check_arguments(image, pixels, side)
    if bend is not None:
        bend = as_points("bend", bend, 2).detach()
        if bend.shape != (*pixels.shape, 2):
            raise InputError(f"bend: shape {(*pixels.shape, 2)} is needed, got {tuple(bend.shape)}")
        bend = bend.reshape(-1, 2, 2)
    if around is not None:
        if around.step.shape != (*pixels.shape[:-1], 4, 2) or around.outer.shape != (*pixels.shape[:-1], 4):
            raise InputError(f"around: steps of shape {(*pixels.shape[:-1], 4, 2)} are needed, see `neighbors`")
        around = Neighbors(*(value.detach().flatten(0, pixels.ndim - 2) for value in around))
    height, width = image.shape[-2:]
    seen = torch.isfinite(pixels).all(-1)
    start = torch.where(seen[..., None], pixels, 0.0).detach()
    if not start.numel():
        nothing = torch.zeros(start.shape[:-1], dtype=torch.float64, device=image.device)
        return Refined(start, nothing.long(), nothing[..., None, None].expand(*start.shape, 2), nothing)
    by_image = start.reshape(-1, *start.shape[-2:])
    sides = side.reshape(by_image.shape[:2])
    rounding = 1.0 / 12.0 if levels is not None or image.dtype == torch.uint8 else 0.0
    fit = fit_crossings(image.reshape(-1, height, width), by_image, sides, bend, around, rounding)

    result = start.round() + fit.center.reshape(start.shape)
    shape = side.shape
    moved = torch.linalg.vector_norm(fit.center.detach() - fit.window.offset, dim=-1)
    low, high = levels or (-math.inf, math.inf)
    at_an_end = torch.stack([fit.window.levels <= low, fit.window.levels >= high]) * fit.window.weight
    saturated = (at_an_end.sum(-1) / fit.window.weight.sum(-1)).amax(0)
    result, status = with_status(
        result,
        (
            (CornerStatus.MISSING, seen),
            (CornerStatus.OUTSIDE, inside_image(result.detach(), fit.window.radius.reshape(shape), width, height)),
            (CornerStatus.SATURATED, saturated <= MAX_SATURATED),
            (CornerStatus.NO_SADDLE, fit.crosses),
            (CornerStatus.OCCLUDED, _is_explained(fit, shape)),
            (CornerStatus.BLURRED, _is_sharp(fit, sides)),
            (CornerStatus.MOVED, moved < (side.reshape(-1) * MOVE_SHARE).clamp(max=MAX_MOVE)),
            (CornerStatus.NOT_CONVERGED, fit.converged),
        ),
    )
    good = status == CornerStatus.GOOD
    covariance = torch.where(good[..., None, None], fit.covariance.reshape(*shape, 2, 2), float("nan"))
    return Refined(result, status, covariance, torch.where(good, fit.blur.reshape(shape), float("nan")))


def _is_explained(fit: CrossingFit, shape: torch.Size) -> Tensor:
    contrast = fit.parameters[:, 6].abs().clamp_min(1e-12)  # never divide by zero
    misfit = (fit.noise.sqrt() / contrast).reshape(shape)
    limit = _MEDIANS * misfit.nanmedian(-1, keepdim=True).values
    return misfit <= limit.clamp(MAX_MISFIT, _WORST_MISFIT)


def _is_sharp(fit: CrossingFit, side: Tensor) -> Tensor:
    """Whether blur leaves the corner determined. No corner counts as sharper than 0.9 of its image's median blur.

    An image has nearly one blur, so a much sharper fit means that this corner does not determine its own.
    """
    blur = fit.blur.reshape(side.shape)
    typical = torch.where(fit.crosses.reshape(side.shape), blur, float("nan")).nanmedian(-1, keepdim=True).values
    limit = torch.where(fit.near.reshape(side.shape), MAX_KNOWN_BLUR, MAX_BLUR) * side
    return torch.fmax(blur, 0.9 * typical) <= limit
