"""Sub-pixel corners by fitting two blurred, crossing edges, with a covariance and the blur of each corner.

All pixels within half a square (at most 12 px) are explained by `kcal.corners.crossing.crossing`; a small batched
Levenberg-Marquardt finds its ten numbers for all corners at once. Nothing is interpolated: the model is evaluated
where the pixels are.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from kcal.checks import as_points
from kcal.corners.erf_fit import Fit, fit_crossings
from kcal.corners.grid import Neighbors
from kcal.corners.saddle import MAX_MOVE, MOVE_SHARE, Refined, Status, check_arguments
from kcal.errors import InputError

MAX_BLUR = 0.3  # of the square side
MAX_KNOWN_BLUR = 0.35  # the same where the next lines are known, and fitted
_TYPICAL_BLUR = 0.9  # of the median of the image: no corner is taken to be sharper
MAX_SATURATED = 0.6  # share of the window at one end of the scale; light squares alone are half of it
# Of half the contrast, the root mean square of what the model leaves: more is something that covers the corner. 99.9 %
# of the corners on real images are below. Where a whole image is noisy, so many times its median are allowed.
MAX_MISFIT = 0.2
_TIMES_MEDIAN = 2.5
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

    Starts must be good to about half a pixel: `kcal.corners.saddle.saddle` gives them. The result is differentiable
    with respect to `image` by the implicit function theorem; the covariance and the blur carry no gradient.

    Args:
        image: (..., H, W) gray levels, floating point or uint8.
        pixels: (..., N, 2) starts; NaN where a corner was not seen.
        side: the smallest side in pixels of the squares round each corner, (..., N) or one number.
        bend: (..., N, 2, 2) curvature vectors in 1 / pixels of the lines through each corner along the board's rows
            and columns (`kcal.corners.grid.line_bend`), which a distorting lens bends by enough to shift the corner.
            Straight if not given.
        around: the steps to the next corners (`kcal.corners.grid.neighbors`): where blur is a good part of a square,
            the lines through them reach into the window. Not allowed for if not given.
        levels: the darkest and brightest gray level there can be in an image of whole numbers, to find saturated
            corners; not looked for if None.

    Returns:
        The corners with covariance, blur and status.

    Raises:
        InputError: shapes that do not fit together, or a side that is not positive.

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
        around = Neighbors(
            around.step.detach().reshape(-1, 4, 2),
            around.change.detach().reshape(-1, 4, 2),
            around.outer.reshape(-1, 4),
        )
    height, width = image.shape[-2:]
    seen = torch.isfinite(pixels).all(-1)
    start = torch.where(seen[..., None], pixels, 0.0).detach()
    if not start.numel():
        nothing = torch.zeros(start.shape[:-1], dtype=torch.float64, device=image.device)
        return Refined(start, nothing.long(), nothing[..., None, None].expand(*start.shape, 2), nothing)
    # From here on all is (corners of all images, ...).
    grouped = start.reshape(-1, *start.shape[-2:])
    images = image.reshape(len(grouped), height, width)
    whole = levels is not None or image.dtype == torch.uint8
    rounding = 1.0 / 12.0 if whole else 0.0
    fit = fit_crossings(images, grouped, side.reshape(grouped.shape[:2]), bend, around, rounding)
    result = start.round() + fit.center.reshape(start.shape)

    shape = side.shape
    x, y = result.detach().unbind(-1)
    margin = fit.window.radius.reshape(shape)
    inside = (x >= margin) & (x <= width - 1 - margin) & (y >= margin) & (y <= height - 1 - margin)
    moved = torch.linalg.vector_norm(fit.center.detach() - fit.window.offset, dim=-1)
    limit = (side.reshape(-1) * MOVE_SHARE).clamp(max=MAX_MOVE)
    low, high = levels or (-math.inf, math.inf)
    gray = fit.window.levels
    saturated = torch.maximum(_share(gray <= low, fit.window.weight), _share(gray >= high, fit.window.weight))
    blur = fit.parameters[:, 4].exp()
    status = torch.zeros(shape, dtype=torch.int64, device=image.device)
    for code, passed in (  # the most basic trouble last, so that it is the one reported
        (Status.RESTLESS, fit.still),
        (Status.MOVED, moved < limit),
        (Status.BLURRED, _sharp(fit, side.reshape(grouped.shape[:2]))),
        (Status.OCCLUDED, _explained(fit, shape)),
        (Status.NO_SADDLE, fit.crosses),
        (Status.SATURATED, saturated <= MAX_SATURATED),
        (Status.OUTSIDE, inside.reshape(-1)),
        (Status.MISSING, seen.reshape(-1)),
    ):
        status = torch.where(passed.reshape(shape), status, int(code))
    good = status == Status.GOOD
    return Refined(
        torch.where(good[..., None], result, float("nan")),
        status,
        torch.where(good[..., None, None], fit.covariance.reshape(*shape, 2, 2), float("nan")),
        torch.where(good, blur.reshape(shape), float("nan")),
    )


class ErfRefine(nn.Module):
    """`erf_saddle` as a module without parameters, to hold in a pipeline.

    Example:
        >>> x = torch.arange(40.0, dtype=torch.float64)
        >>> image = torch.outer(torch.erf((x - 19.3) / 1.4), torch.erf((x - 20.6) / 1.4))
        >>> ErfRefine()(image, torch.tensor([[20.5, 19.5]]), 15.0).status
        tensor([0])
    """

    def forward(self, image: Tensor, pixels: Tensor, side: Tensor | float, bend: Tensor | None = None) -> Refined:
        """See `erf_saddle`."""
        return erf_saddle(image, pixels, side, bend=bend)


def _explained(fit: Fit, shape: torch.Size) -> Tensor:
    misfit = (fit.noise.sqrt() / fit.parameters[:, 6].abs().clamp_min(1e-12)).reshape(shape)
    limit = _TIMES_MEDIAN * misfit.nanmedian(-1, keepdim=True).values if shape[-1] else misfit
    return (misfit <= limit.clamp(MAX_MISFIT, _WORST_MISFIT)).reshape(-1)


def _sharp(fit: Fit, side: Tensor) -> Tensor:
    """An image has one blur, nearly: a corner far from the others is one whose own blur could not be told."""
    blur = fit.parameters[:, 4].exp().reshape(side.shape)
    typical = torch.where(fit.crosses.reshape(side.shape), blur, float("nan")).nanmedian(-1, keepdim=True).values
    limit = torch.where(fit.near.reshape(side.shape), MAX_KNOWN_BLUR, MAX_BLUR) * side
    return (torch.fmax(blur, _TYPICAL_BLUR * typical) <= limit).reshape(-1)


def _share(mask: Tensor, weight: Tensor) -> Tensor:
    return (mask * weight).sum(-1) / weight.sum(-1)
