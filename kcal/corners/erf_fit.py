"""The fit of blurred, crossing edges to the pixels round each corner: Levenberg-Marquardt for all corners at once.

First each corner is fitted by itself. What these fits know together (how light falls on the board, how wide edges are
blurred) then goes into a second one.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.corners.crossing import ODD, PARAMETERS, Beside, crossing
from kcal.corners.erf_board import Prior, curvatures, light_at, light_slope, line_spread, lines_beside
from kcal.corners.erf_spread import spread
from kcal.corners.erf_window import Window, look
from kcal.corners.grid import Neighbors

MIN_ANGLE = math.radians(25.0)  # between the edges; below, the series of `crossing` ends too early
SHARE = 0.5  # of the smallest square side: the radius of the window
# The same where blur is a good part of the square, and the lines beyond are known and fitted, too: the window of half a
# square would then hardly determine ten numbers.
WIDE_SHARE = 0.75
MAX_RADIUS = 12.0  # pixels
MIN_RADIUS = 2.5  # pixels: fewer would not determine ten numbers
# Sigmas from the window's rim to the next line beyond which its blur is forgotten: 3e-4 of the contrast.
REACH = 3.5
_NOWHERE = 1e6  # pixels
_FIRST_STEPS, _STEPS = 4, 20
_STILL = 1e-5  # pixels


class Fit(NamedTuple):
    """What was fitted to each of M corners.

    Args:
        center: (M, 2) pixels from the pixel the start is in; differentiable with respect to the image.
        parameters: (M, 10), see `crossing`.
        window: the pixels used.
        noise: (M,) variance of the gray levels.
        covariance: (M, 2, 2) px².
        crosses: (M,) whether there are two edges.
        still: (M,) whether the last step was small.
        near: (M,) whether the next lines were fitted, too.
    """

    center: Tensor
    parameters: Tensor
    window: Window
    noise: Tensor
    covariance: Tensor
    crosses: Tensor
    still: Tensor
    near: Tensor


def fit_crossings(
    image: Tensor, start: Tensor, side: Tensor, bend: Tensor | None, around: Neighbors | None, least_noise: float
) -> Fit:
    """Fit two crossing edges to the surroundings of each corner.

    Args:
        image: (B, H, W).
        start: (B, N, 2) pixels, to about half a pixel.
        side: (B, N) smallest sides of the squares.
        bend: (M, 2, 2) curvature vectors of the lines through each corner, M = B N.
        around: steps to the next corners, (M, 4, 2), or None.
        least_noise: variance that the gray levels have at least.
    """
    base = start.round()
    offset = (start - base).reshape(-1, 2)
    flat_side = side.reshape(-1)
    radius = (SHARE * flat_side).clamp(MIN_RADIUS, MAX_RADIUS)
    window, patches = look(image, base, offset, radius)
    first, crosses = _start(window)
    curves = curvatures(bend, first) if bend is not None else torch.zeros_like(first[:, :2])
    nothing = torch.zeros_like(first[:, :2])
    prior = Prior.of(first, nothing, torch.zeros_like(side).reshape(-1), nothing[:, 0])
    # What the first steps find is enough to know how light falls on the board, and which lines reach into windows.
    parameters, cost, still = _minimize(first, window, curves, prior, None, _FIRST_STEPS)
    usable = crosses & torch.isfinite(cost)
    beside = None
    near = torch.zeros_like(crosses)
    if around is not None:
        lines = lines_beside(around, parameters)
        blur = parameters[:, 4].exp().clamp(max=0.5 * flat_side)
        near = usable & (lines.distance.amin((-2, -1)) - radius < REACH * blur)
        if bool(near.any()):
            # Where markers leave less than half a square free, so it stays.
            free = flat_side >= 0.95 * torch.linalg.vector_norm(around.step, dim=-1).nan_to_num(math.inf).amin(-1)
            wide = (WIDE_SHARE * flat_side).clamp(MIN_RADIUS, MAX_RADIUS)
            window, patches = look(image, base, offset, torch.where(near & free, wide, radius))
            known = lines.beside(parameters, window.where)
            beside = Beside(known.distance, known.turn * near[:, None, None, None])
    # With lines beside, each step is twice the work, and only then is it known well how light falls on the board.
    for group, others in ((~near, None), (near, beside), (near, beside)):
        some = group.nonzero()[:, 0]
        if not len(some):
            continue
        light = light_at(parameters, window, curves, beside, usable.reshape(side.shape))
        place = base + parameters[:, :2].reshape(base.shape)
        slope, doubt = light_slope(light, place, side, usable.reshape(side.shape))
        noise = cost / window.weight.sum(-1)
        prior = Prior.of(parameters, slope, doubt, noise)
        chosen = None if others is None else Beside(*(value[some] for value in others))
        done = _minimize(parameters[some], window.of(some), curves[some], prior.of_some(some), chosen, _STEPS)
        parameters, cost, still = (
            value.index_copy(0, some, new) for value, new in zip((parameters, cost, still), done, strict=True)
        )
    between = (parameters[:, 2] - parameters[:, 3]).sin().abs()
    crosses = crosses & (between > math.sin(MIN_ANGLE)) & torch.isfinite(cost)
    learn = (crosses & still).reshape(side.shape)
    noise, covariance = _spread(parameters, window, curves, prior, beside, learn, least_noise)
    still = still & torch.isfinite(covariance).all(-1).all(-1)
    center = parameters[:, :2]
    if patches.requires_grad:
        center = _with_gradient(parameters, window, curves, prior, beside, patches)
    return Fit(center, parameters, window, noise, covariance, crosses, still, near)


def _minimize(
    parameters: Tensor, window: Window, bend: Tensor, prior: Prior, beside: Beside | None, steps: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Levenberg-Marquardt for all corners at once: parameters, cost, and whether the last step was small."""
    result = parameters.clone()
    result_cost = torch.full_like(parameters[:, 0], math.inf)
    result_last = result_cost.clone()
    at = torch.arange(len(parameters), device=parameters.device)  # the corners that still move
    damping = torch.full_like(result_cost, 1e-3)
    last = result_last.clone()
    normal, gradient, cost = _normal(parameters, window, bend, prior, beside)
    for _ in range(steps):
        scale = normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).rsqrt()
        scaled = normal * scale[:, :, None] * scale[:, None, :]
        scaled = scaled + (1e-12 + damping)[:, None, None] * torch.eye(PARAMETERS, device=scaled.device)
        factor, _ = torch.linalg.cholesky_ex(scaled)
        step = -torch.cholesky_solve((gradient * scale)[..., None], factor)[..., 0] * scale
        step = torch.nan_to_num(step, posinf=0.0, neginf=0.0)
        trial = parameters + step
        trial_normal, trial_gradient, trial_cost = _normal(trial, window, bend, prior, beside)
        better = trial_cost <= cost
        length = torch.linalg.vector_norm(step[:, :2], dim=-1)
        # A rejected tiny step is rounding at the minimum; a rejected long one is not.
        last = torch.where(better | (length < _STILL), length, last)
        parameters = torch.where(better[:, None], trial, parameters)
        normal = torch.where(better[:, None, None], trial_normal, normal)
        gradient = torch.where(better[:, None], trial_gradient, gradient)
        cost = torch.where(better, trial_cost, cost)
        damping = torch.where(better, damping * 0.1, damping * 10.0).clamp(1e-9, 1e6)
        go = (last >= _STILL).nonzero()[:, 0]
        if 2 * len(go) < len(at):  # leave those behind that have arrived
            result[at], result_cost[at], result_last[at] = parameters, cost, last
            if not len(go):
                break
            at, window, bend, prior = at[go], window.of(go), bend[go], prior.of_some(go)
            beside = None if beside is None else Beside(*(value[go] for value in beside))
            parameters, normal, gradient, cost, damping, last = (
                value[go] for value in (parameters, normal, gradient, cost, damping, last)
            )
    result[at], result_cost[at], result_last[at] = parameters, cost, last
    return result, result_cost, result_last < 10 * _STILL


def _start(window: Window) -> tuple[Tensor, Tensor]:
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
    parameters = torch.zeros(len(x), PARAMETERS, dtype=torch.float64, device=x.device)
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


def _normal(
    parameters: Tensor, window: Window, bend: Tensor, prior: Prior, beside: Beside | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Normal matrix, gradient and cost of the weighted residuals and the prior."""
    levels, jacobian = crossing(parameters, window.where, bend, beside)
    weight, miss = prior.diagonal(), parameters - prior.value()
    residual = levels - window.levels
    weighted = jacobian * window.weight[:, None]
    normal = weighted @ jacobian.transpose(-1, -2) + torch.diag_embed(weight)
    gradient = (weighted @ residual[..., None])[..., 0] + weight * miss
    cost = (window.weight * residual**2).sum(-1) + (weight * miss**2).sum(-1)
    return normal, gradient, torch.nan_to_num(cost, nan=math.inf)


def _spread(
    parameters: Tensor,
    window: Window,
    bend: Tensor,
    prior: Prior,
    beside: Beside | None,
    usable: Tensor,
    least_noise: float,
) -> tuple[Tensor, Tensor]:
    levels, jacobian = crossing(parameters, window.where, bend, beside)
    weighted = jacobian * window.weight[:, None]
    normal = weighted @ jacobian.transpose(-1, -2) + torch.diag_embed(prior.diagonal())
    inverse, _ = torch.linalg.inv_ex(normal)
    usable = usable & torch.isfinite(inverse).all(-1).all(-1).reshape(usable.shape)
    images = usable.shape
    residual = levels - window.levels
    freedom = (window.weight.sum(-1) - PARAMETERS).clamp_min(1.0)
    noise = (window.weight * residual.square()).sum(-1) / freedom
    covariance = spread(
        window.patches(residual).unflatten(0, images),
        window.patches(window.weight).unflatten(0, images),
        window.patches(jacobian[:, ODD]).unflatten(0, images),
        inverse.reshape(*images, PARAMETERS, PARAMETERS)[:, :, ODD][..., ODD],
        parameters[:, :2].reshape(*images, 2),
        usable,
        least_noise,
    )
    covariance = covariance.reshape(-1, 2, 2)
    by_ramp = inverse[:, :2, 7:9] * (prior.weight * prior.doubt)[:, None, None]
    covariance = covariance + by_ramp @ by_ramp.transpose(-1, -2)
    if beside is None:
        return noise, covariance
    gain = inverse[:, :2] @ weighted
    return noise, covariance + line_spread(parameters, window, bend, beside, gain, covariance)


def _with_gradient(
    parameters: Tensor, window: Window, bend: Tensor, prior: Prior, beside: Beside | None, patches: Tensor
) -> Tensor:
    """The center as a function of the gray levels: at the minimum g(p, levels) = 0, so dp = -(∂g/∂p)⁻¹ ∂g."""
    if beside is None:
        nowhere = torch.full((len(parameters), 2, 2, 1), _NOWHERE, dtype=torch.float64, device=parameters.device)
        beside = Beside(nowhere, torch.zeros_like(nowhere))

    def gradient(
        parameters: Tensor,
        bend: Tensor,
        distance: Tensor,
        turn: Tensor,
        prior: Tensor,
        miss: Tensor,
        weight: Tensor,
        values: Tensor,
    ) -> Tensor:
        levels, jacobian = crossing(parameters, window.where, bend, Beside(distance, turn))
        return jacobian @ (weight * (levels - values)) + prior * (parameters - miss)

    inputs = parameters, bend, *beside, prior.diagonal(), prior.value(), window.weight

    hessian = torch.func.vmap(torch.func.jacfwd(gradient))(*inputs, window.levels)
    inverse, _ = torch.linalg.inv_ex(hessian)
    residual = torch.func.vmap(gradient)(*inputs, patches)
    change = -(inverse.detach() @ (residual - residual.detach())[..., None])[..., 0]
    return parameters[:, :2] + torch.nan_to_num(change[:, :2])
