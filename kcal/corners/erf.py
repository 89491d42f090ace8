"""Sub-pixel corners by fitting two blurred, crossing edges, with a covariance and the blur of each corner.

All pixels within half a square (at most 12 px) are explained by `kcal.corners.crossing.crossing`; a small batched
Levenberg-Marquardt finds its ten numbers for all corners at once. Nothing is interpolated: the model is evaluated
where the pixels are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from kcal.checks import as_points
from kcal.corners.crossing import crossing
from kcal.corners.saddle import MAX_MOVE, MOVE_SHARE, Refined, Status, check_arguments, cut_patches
from kcal.errors import InputError

SHARE = 0.5  # of the smallest square side: the radius of the window
MAX_RADIUS = 12.0  # pixels
MIN_RADIUS = 2.5  # pixels: fewer would not determine ten numbers
MAX_BLUR = 0.3  # of the square side
MAX_SATURATED = 0.6  # share of the window at one end of the scale; light squares alone are half of it
# Of half the contrast, the root mean square of what the model leaves: more is something that covers the corner. 99.9 %
# of the corners on real images are below. Where a whole image is noisy, so many times its median are allowed.
MAX_MISFIT = 0.2
_TIMES_MEDIAN = 2.5
_WORST_MISFIT = 0.5
MIN_ANGLE = math.radians(25.0)  # between the edges; below, the series of `crossing` ends too early
# A ramp of illumination looks like a shift of the corner where the window is hardly wider than the blur. A prior keeps
# it small there: it counts as much as so many pixels one pixel away from the centre.
RAMP_WEIGHT = 3000.0
_STEPS = 20
_STILL = 1e-5  # pixels
_PARAMETERS = 10


def erf_saddle(
    image: Tensor,
    pixels: Tensor,
    side: Tensor | float,
    *,
    bend: Tensor | None = None,
    levels: tuple[float, float] | None = None,
) -> Refined:
    """Fit two blurred edges that cross at each corner.

    Starts must be good to about half a pixel: `kcal.corners.saddle.saddle` gives them. The result is differentiable
    with respect to `image` by the implicit function theorem; the covariance and the blur carry no gradient.

    Args:
        image: (..., H, W) grey levels, floating point or uint8.
        pixels: (..., N, 2) starts; NaN where a corner was not seen.
        side: the smallest side in pixels of the squares round each corner, (..., N) or one number.
        bend: (..., N, 2, 2) curvature vectors in 1 / pixels of the lines through each corner along the board's rows
            and columns (`kcal.corners.grid.line_bend`), which a distorting lens bends by enough to shift the corner.
            Straight if not given.
        levels: the darkest and brightest grey level there can be, to find saturated corners; not looked for if None.

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
    height, width = image.shape[-2:]
    seen = torch.isfinite(pixels).all(-1)
    start = torch.where(seen[..., None], pixels, 0.0).detach()
    base = start.round()
    radius = (SHARE * side).clamp(MIN_RADIUS, MAX_RADIUS).reshape(-1)
    half = math.ceil(float(radius.max()) + 1.0) if radius.numel() else 1
    # From here on all is (corners of all images, ...).
    images = image.reshape(-1, height, width)
    patches = cut_patches(images, base.reshape(len(images), base.shape[-2], 2), half).flatten(-2)
    offset = (start - base).reshape(-1, 2)
    window = _Window(patches.detach(), offset, radius, half)
    fit = _fit(window, bend)
    centre = fit.parameters[:, :2]
    if image.requires_grad:
        centre = _with_gradient(fit, window, patches)
    result = base + centre.reshape(start.shape)

    shape = side.shape
    x, y = result.detach().unbind(-1)
    margin = radius.reshape(shape)
    inside = (x >= margin) & (x <= width - 1 - margin) & (y >= margin) & (y <= height - 1 - margin)
    moved = torch.linalg.vector_norm(centre.detach() - offset, dim=-1)
    limit = (side.reshape(-1) * MOVE_SHARE).clamp(max=MAX_MOVE)
    low, high = levels or (-math.inf, math.inf)
    grey = patches.detach()
    saturated = torch.maximum(_share(grey <= low, window.weight), _share(grey >= high, window.weight))
    blur = fit.parameters[:, 4].exp()
    status = torch.zeros(shape, dtype=torch.int64, device=image.device)
    for code, passed in (  # the most basic trouble last, so that it is the one reported
        (Status.RESTLESS, fit.still),
        (Status.MOVED, moved < limit),
        (Status.BLURRED, blur <= MAX_BLUR * side.reshape(-1)),
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


class _Window:
    """The pixels round each of M corners, and how much each counts: 1 inside the radius, falling to 0 within a pixel.

    Args:
        levels: (M, K) grey levels.
        offset: (M, 2) starts relative to the patch's middle.
        radius: (M,) pixels.
        half: the patch has (2 half + 1)² = K pixels.
    """

    def __init__(self, levels: Tensor, offset: Tensor, radius: Tensor, half: int) -> None:
        axis = torch.arange(-half, half + 1, dtype=torch.float64, device=levels.device)
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        self.levels = levels
        self.offset = offset
        self.where = torch.stack([x.reshape(-1), y.reshape(-1)], -1)
        self.radius = radius
        distance = torch.linalg.vector_norm(self.where - offset[:, None], dim=-1)
        self.weight = (radius[:, None] + 0.5 - distance).clamp(0.0, 1.0)


class _Fit(NamedTuple):
    parameters: Tensor  # (M, 10)
    bend: Tensor  # (M, 2)
    noise: Tensor  # (M,) variance of the grey levels
    covariance: Tensor  # (M, 2, 2)
    crosses: Tensor  # (M,) whether there are two edges
    still: Tensor  # (M,) whether the last step was small


def _fit(window: _Window, bend: Tensor | None) -> _Fit:
    parameters, crosses = _start(window)
    curves = _assign(bend, parameters) if bend is not None else torch.zeros_like(parameters[:, :2])
    prior = torch.zeros(_PARAMETERS, dtype=torch.float64, device=parameters.device)
    prior[7:9] = RAMP_WEIGHT
    damping = torch.full_like(parameters[:, 0], 1e-3)
    normal, gradient, cost = _normal(parameters, window, curves, prior)
    last = torch.full_like(cost, math.inf)
    for _ in range(_STEPS):
        scale = normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).rsqrt()
        scaled = normal * scale[:, :, None] * scale[:, None, :]
        scaled = scaled + (1e-12 + damping)[:, None, None] * torch.eye(_PARAMETERS, device=scaled.device)
        factor, _ = torch.linalg.cholesky_ex(scaled)
        step = -torch.cholesky_solve((gradient * scale)[..., None], factor)[..., 0] * scale
        step = torch.nan_to_num(step, posinf=0.0, neginf=0.0)
        trial = parameters + step
        trial_normal, trial_gradient, trial_cost = _normal(trial, window, curves, prior)
        better = trial_cost <= cost
        length = torch.linalg.vector_norm(step[:, :2], dim=-1)
        # A rejected tiny step is rounding at the minimum; a rejected long one is not.
        last = torch.where(better | (length < _STILL), length, last)
        parameters = torch.where(better[:, None], trial, parameters)
        normal = torch.where(better[:, None, None], trial_normal, normal)
        gradient = torch.where(better[:, None], trial_gradient, gradient)
        cost = torch.where(better, trial_cost, cost)
        damping = torch.where(better, damping * 0.1, damping * 10.0).clamp(1e-9, 1e6)
        if bool((last < _STILL).all()):
            break
    between = (parameters[:, 2] - parameters[:, 3]).sin().abs()
    crosses = crosses & (between > math.sin(MIN_ANGLE)) & torch.isfinite(cost)
    noise, covariance = _spread(parameters, window, curves, prior)
    return _Fit(parameters, curves, noise, covariance, crosses, last < 10 * _STILL)


def _start(window: _Window) -> tuple[Tensor, Tensor]:
    """Edge directions from the asymptotes of a quadratic, then mean, contrast and ramp by linear least squares."""
    x, y = (window.where - window.offset[:, None]).unbind(-1)
    one = torch.ones_like(x)
    weight = window.weight
    design = torch.stack([one, x, y, x * x, 2.0 * x * y, y * y], -1)
    _, _, _, xx, xy, yy = _least_squares(design, window.levels, weight).unbind(-1)
    spread = torch.hypot(0.5 * (xx - yy), xy)
    middle = 0.5 * (xx + yy)
    crosses = spread > middle.abs()
    axis = 0.5 * torch.atan2(xy, 0.5 * (xx - yy))
    # xx cos² + 2 xy cos sin + yy sin² = middle + spread cos(2 (angle - axis)) = 0
    opening = 0.5 * torch.acos((-middle / spread.clamp_min(1e-300)).clamp(-0.9, 0.9))
    parameters = torch.zeros(len(x), _PARAMETERS, dtype=torch.float64, device=x.device)
    parameters[:, :2] = window.offset
    parameters[:, 2], parameters[:, 3] = axis - opening, axis + opening
    parameters[:, 4] = (0.2 * window.radius).clamp(0.6, 1.5).log()
    parameters[:, 6] = 1.0
    levels, _ = crossing(parameters, window.where, torch.zeros_like(parameters[:, :2]))
    design = torch.stack([one, levels], -1)
    parameters[:, 5:7] = _least_squares(design, window.levels, weight)
    return parameters, crosses


def _least_squares(design: Tensor, values: Tensor, weight: Tensor) -> Tensor:
    weighted = design * weight[..., None]
    normal = weighted.transpose(-1, -2) @ design
    solution, _ = torch.linalg.solve_ex(normal, weighted.transpose(-1, -2) @ values[..., None])
    return torch.nan_to_num(solution[..., 0])


def _assign(bend: Tensor, parameters: Tensor) -> Tensor:
    """The curvature of each edge (M, 2): of the row's and the column's line, whichever each edge follows.

    A line's curvature vector is perpendicular to the line, so the edge that a line is has it along its normal.
    """
    normal = torch.stack([-parameters[:, 2:4].sin(), parameters[:, 2:4].cos()], -1)  # (M, edge, 2)
    along = torch.einsum("mei,mli->mel", normal, bend)
    length = torch.linalg.vector_norm(bend, dim=-1)
    # How well each of the two pairings explains both vectors.
    straight = (along[:, 0, 0].abs() - length[:, 0]) + (along[:, 1, 1].abs() - length[:, 1])
    swapped = (along[:, 0, 1].abs() - length[:, 1]) + (along[:, 1, 0].abs() - length[:, 0])
    return torch.where(
        (straight >= swapped)[:, None],
        torch.stack([along[:, 0, 0], along[:, 1, 1]], -1),
        torch.stack([along[:, 0, 1], along[:, 1, 0]], -1),
    )


def _normal(parameters: Tensor, window: _Window, bend: Tensor, prior: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normal matrix, gradient and cost of the weighted residuals and the prior."""
    levels, jacobian = crossing(parameters, window.where, bend)
    residual = levels - window.levels
    weighted = jacobian * window.weight[:, None]
    normal = weighted @ jacobian.transpose(-1, -2) + torch.diag(prior)
    gradient = (weighted @ residual[..., None])[..., 0] + prior * parameters
    cost = (window.weight * residual**2).sum(-1) + (prior * parameters**2).sum(-1)
    return normal, gradient, torch.nan_to_num(cost, nan=math.inf)


def _spread(parameters: Tensor, window: _Window, bend: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Variance of the grey levels' noise from what is left, and the centre's covariance.

    The weights only shape the window; every pixel has the same noise, hence H⁻¹ Jᵀ W² J H⁻¹ in place of H⁻¹.
    """
    levels, jacobian = crossing(parameters, window.where, bend)
    squared = (window.weight * (levels - window.levels) ** 2).sum(-1)
    noise = squared / (window.weight.sum(-1) - _PARAMETERS).clamp_min(1.0)
    weighted = jacobian * window.weight[:, None]
    normal = weighted @ jacobian.transpose(-1, -2) + torch.diag(prior)
    inverse, _ = torch.linalg.inv_ex(normal)
    spread = inverse @ (weighted @ weighted.transpose(-1, -2)) @ inverse
    return noise, noise[:, None, None] * spread[:, :2, :2]


def _with_gradient(fit: _Fit, window: _Window, patches: Tensor) -> Tensor:
    """The centre as a function of the grey levels: at the minimum g(p, levels) = 0, so dp = -(∂g/∂p)⁻¹ ∂g."""

    def gradient(parameters: Tensor, bend: Tensor, weight: Tensor, values: Tensor) -> Tensor:
        levels, jacobian = crossing(parameters, window.where, bend)
        prior = torch.zeros_like(parameters)
        prior[7:9] = RAMP_WEIGHT
        return jacobian @ (weight * (levels - values)) + prior * parameters

    inputs = fit.parameters, fit.bend, window.weight
    hessian = torch.func.vmap(torch.func.jacfwd(gradient))(*inputs, window.levels)
    inverse, _ = torch.linalg.inv_ex(hessian)
    residual = torch.func.vmap(gradient)(*inputs, patches)
    change = -(inverse.detach() @ (residual - residual.detach())[..., None])[..., 0]
    return fit.parameters[:, :2] + torch.nan_to_num(change[:, :2])


def _explained(fit: _Fit, shape: torch.Size) -> Tensor:
    misfit = (fit.noise.sqrt() / fit.parameters[:, 6].abs().clamp_min(1e-12)).reshape(shape)
    limit = _TIMES_MEDIAN * misfit.nanmedian(-1, keepdim=True).values if shape[-1] else misfit
    return (misfit <= limit.clamp(MAX_MISFIT, _WORST_MISFIT)).reshape(-1)


def _share(mask: Tensor, weight: Tensor) -> Tensor:
    return (mask * weight).sum(-1) / weight.sum(-1)
