"""Fit blurred, crossing edges to the pixels around each corner: Levenberg-Marquardt for all corners at once.

First each corner is fitted alone. What these fits know together (illumination of the board, width of the edges) then
goes into a second fit.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.corners.crossing import ODD, PARAMETERS, LineDistances, crossing
from kcal.corners.erf_board import FAR, RampPrior, curvatures, light_at, light_slope, line_covariance, neighbor_lines
from kcal.corners.erf_spread import center_covariance
from kcal.corners.erf_window import CornerWindow, cut_windows
from kcal.corners.grid import Neighbors
from kcal.dispatch import is_differentiated

MIN_ANGLE = math.radians(25.0)  # between the edges; below, the series of `crossing` is too short
# Radius of the window as a share of the smallest square side. 0.4 was 5 to 20 % worse at squares of 8 to 20 px; 0.6 is
# wrong where blur is a fifth of the square.
SHARE = 0.5
# The same where blur is a good part of the square and the next lines belong to the model; half a square would hardly
# determine ten parameters then.
WIDE_SHARE = 0.75
MAX_RADIUS = 12.0  # pixels
MIN_RADIUS = 2.5  # pixels: fewer would not determine ten parameters
# The next line is left out where it is more sigmas of blur from the window's rim: 3e-4 of the contrast.
REACH = 3.5
_FIRST_STEPS, _STEPS = 4, 20
_CONVERGED = 1e-5  # pixels


class CrossingFit(NamedTuple):
    """What was fitted to each of M corners.

    Args:
        center: (M, 2) pixels from the pixel that contains the start; differentiable with respect to the image.
        parameters: (M, 10), see `crossing`.
        window: the pixels used.
        noise: (M,) variance of the gray levels.
        covariance: (M, 2, 2) px².
        crosses: (M,) whether there are two edges.
        converged: (M,) whether the last step was small.
        near: (M,) whether the next lines were part of the model.
    """

    center: Tensor
    parameters: Tensor
    window: CornerWindow
    noise: Tensor
    covariance: Tensor
    crosses: Tensor
    converged: Tensor
    near: Tensor

    @property
    def blur(self) -> Tensor:
        """Sigma of the edges' Gaussian, (M,) pixels."""
        return self.parameters[:, 4].exp()


class _FitInputs(NamedTuple):
    """What a fit takes as given: pixels, curvatures of the edges (M, 2), prior, and the next lines."""

    window: CornerWindow
    bend: Tensor
    prior: RampPrior
    lines: LineDistances | None

    def of(self, some: Tensor) -> _FitInputs:
        lines = None if self.lines is None else LineDistances(*(value[some] for value in self.lines))
        return _FitInputs(self.window.of(some), self.bend[some], self.prior.of_some(some), lines)


def fit_crossings(
    image: Tensor, start: Tensor, side: Tensor, bend: Tensor | None, around: Neighbors | None, least_noise: float
) -> CrossingFit:
    """Fit two crossing edges to the surroundings of each corner.

    Args:
        image: (B, H, W).
        start: (B, N, 2) pixels, to about half a pixel.
        side: (B, N) smallest sides of the squares.
        bend: (M, 2, 2) curvature vectors of the lines through each corner, M = B N.
        around: steps to the next corners, (M, 4, 2), or None.
        least_noise: lower bound of the variance of the gray levels.
    """
    base = start.round()
    offset = (start - base).reshape(-1, 2)
    flat_side = side.reshape(-1)
    radius = (SHARE * flat_side).clamp(MIN_RADIUS, MAX_RADIUS)
    window, levels = cut_windows(image, base, offset, radius)
    first, crosses = _start(window)
    nothing = torch.zeros_like(first[:, :2])
    curves = curvatures(bend, first) if bend is not None else nothing
    prior = RampPrior.of(first, nothing, nothing[:, 0], nothing[:, 0])
    # A few steps are enough to estimate the illumination of the board and which lines reach into windows.
    parameters, cost, converged = _levenberg_marquardt(first, _FitInputs(window, curves, prior, None), _FIRST_STEPS)
    usable = crosses & torch.isfinite(cost)
    lines = None
    near = torch.zeros_like(crosses)
    if around is not None:
        beside = neighbor_lines(around, parameters)
        blur = parameters[:, 4].exp().clamp(max=0.5 * flat_side)
        near = usable & (beside.distance.amin((-2, -1)) - radius < REACH * blur)
        if bool(near.any()):
            # Markers may leave less than half a square free; the window stays inside that.
            free = flat_side >= 0.95 * torch.linalg.vector_norm(around.step, dim=-1).nan_to_num(math.inf).amin(-1)
            wide = (WIDE_SHARE * flat_side).clamp(MIN_RADIUS, MAX_RADIUS)
            window, levels = cut_windows(image, base, offset, torch.where(near & free, wide, radius))
            lines = beside.distances(parameters, window.where)
            lines = LineDistances(lines.distance, lines.turn * near[:, None, None, None])
    inputs = _FitInputs(window, curves, prior, lines)
    # With lines each step is twice the work, so only corners near one get them. These are fitted twice, because only
    # the first of the two fits makes the illumination well determined.
    for group, with_lines in ((~near, False), (near, True), (near, True)):
        some = group.nonzero()[:, 0]
        if not len(some):
            continue
        light = light_at(parameters, window, curves, lines, usable.reshape(side.shape))
        place = base + parameters[:, :2].reshape(base.shape)
        slope, error = light_slope(light, place, side, usable.reshape(side.shape))
        inputs = inputs._replace(prior=RampPrior.of(parameters, slope, error, cost / window.weight.sum(-1)))
        chosen = (inputs if with_lines else inputs._replace(lines=None)).of(some)
        done = _levenberg_marquardt(parameters[some], chosen, _STEPS)
        parameters, cost, converged = (
            value.index_copy(0, some, new) for value, new in zip((parameters, cost, converged), done, strict=True)
        )
    between = (parameters[:, 2] - parameters[:, 3]).sin().abs()
    crosses = crosses & (between > math.sin(MIN_ANGLE)) & torch.isfinite(cost)
    noise, covariance = _noise_and_covariance(
        parameters, inputs, (crosses & converged).reshape(side.shape), least_noise
    )
    converged = converged & torch.isfinite(covariance).all(-1).all(-1)
    center = _with_gradient(parameters, inputs, levels) if is_differentiated(levels) else parameters[:, :2]
    return CrossingFit(center, parameters, window, noise, covariance, crosses, converged, near)


def _levenberg_marquardt(parameters: Tensor, inputs: _FitInputs, steps: int) -> tuple[Tensor, Tensor, Tensor]:
    """Minimize for all corners at once: parameters, cost, and whether the last step was small."""
    result = parameters.clone()
    result_cost = torch.full_like(parameters[:, 0], math.inf)
    result_last = result_cost.clone()
    at = torch.arange(len(parameters), device=parameters.device)  # the corners that still move
    damping = torch.full_like(result_cost, 1e-3)
    last = result_last.clone()
    normal, gradient, cost = _normal_equations(parameters, inputs)
    for _ in range(steps):
        scale = normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).rsqrt()
        scaled = normal * scale[:, :, None] * scale[:, None, :]
        scaled = scaled + (1e-12 + damping)[:, None, None] * torch.eye(PARAMETERS, device=scaled.device)
        factor, _ = torch.linalg.cholesky_ex(scaled)
        step = -torch.cholesky_solve((gradient * scale)[..., None], factor)[..., 0] * scale
        step = torch.nan_to_num(step, posinf=0.0, neginf=0.0)
        trial = parameters + step
        trial_normal, trial_gradient, trial_cost = _normal_equations(trial, inputs)
        better = trial_cost <= cost
        length = torch.linalg.vector_norm(step[:, :2], dim=-1)
        # A rejected tiny step is rounding at the minimum; a rejected long one is not.
        last = torch.where(better | (length < _CONVERGED), length, last)
        parameters = torch.where(better[:, None], trial, parameters)
        normal = torch.where(better[:, None, None], trial_normal, normal)
        gradient = torch.where(better[:, None], trial_gradient, gradient)
        cost = torch.where(better, trial_cost, cost)
        damping = torch.where(better, damping * 0.1, damping * 10.0).clamp(1e-9, 1e6)
        go = (last >= _CONVERGED).nonzero()[:, 0]
        if 2 * len(go) < len(at):  # go on with those that have not converged
            result[at], result_cost[at], result_last[at] = parameters, cost, last
            if not len(go):
                break
            at, inputs = at[go], inputs.of(go)
            parameters, normal, gradient, cost, damping, last = (
                value[go] for value in (parameters, normal, gradient, cost, damping, last)
            )
    result[at], result_cost[at], result_last[at] = parameters, cost, last
    return result, result_cost, result_last < 10 * _CONVERGED


def _start(window: CornerWindow) -> tuple[Tensor, Tensor]:
    """Edge directions from the asymptotes of a quadratic, then mean and contrast by linear least squares."""
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


def _normal_equations(parameters: Tensor, inputs: _FitInputs) -> tuple[Tensor, Tensor, Tensor]:
    """Normal matrix, gradient and cost of the weighted residuals and the prior."""
    window, prior = inputs.window, inputs.prior
    levels, jacobian = crossing(parameters, window.where, inputs.bend, inputs.lines)
    weight, miss = prior.diagonal(), parameters - prior.value()
    residual = levels - window.levels
    weighted = jacobian * window.weight[:, None]
    normal = weighted @ jacobian.transpose(-1, -2) + torch.diag_embed(weight)
    gradient = (weighted @ residual[..., None])[..., 0] + weight * miss
    cost = (window.weight * residual**2).sum(-1) + (weight * miss**2).sum(-1)
    return normal, gradient, torch.nan_to_num(cost, nan=math.inf)


def _noise_and_covariance(
    parameters: Tensor, inputs: _FitInputs, usable: Tensor, least_noise: float
) -> tuple[Tensor, Tensor]:
    window, prior = inputs.window, inputs.prior
    levels, jacobian = crossing(parameters, window.where, inputs.bend, inputs.lines)
    weighted = jacobian * window.weight[:, None]
    normal = weighted @ jacobian.transpose(-1, -2) + torch.diag_embed(prior.diagonal())
    inverse, _ = torch.linalg.inv_ex(normal)
    images = usable.shape
    residual = levels - window.levels
    freedom = (window.weight.sum(-1) - PARAMETERS).clamp_min(1.0)
    noise = (window.weight * residual.square()).sum(-1) / freedom
    covariance = center_covariance(
        window.patches(residual).unflatten(0, images),
        window.patches(window.weight).unflatten(0, images),
        window.patches(jacobian[:, ODD]).unflatten(0, images),
        inverse.reshape(*images, PARAMETERS, PARAMETERS)[:, :, ODD][..., ODD],
        parameters[:, :2].reshape(*images, 2),
        usable & torch.isfinite(inverse).all(-1).all(-1).reshape(images),
        least_noise,
    ).reshape(-1, 2, 2)
    by_ramp = inverse[:, :2, 7:9] * (prior.weight * prior.error)[:, None, None]
    covariance = covariance + by_ramp @ by_ramp.transpose(-1, -2)
    if inputs.lines is not None:
        gain = inverse[:, :2] @ weighted
        covariance = covariance + line_covariance(parameters, window, inputs.bend, inputs.lines, gain, covariance)
    return noise, covariance


def _with_gradient(parameters: Tensor, inputs: _FitInputs, levels: Tensor) -> Tensor:
    """The center as a function of the gray levels: at the minimum g(p, levels) = 0, so dp = -(∂g/∂p)⁻¹ ∂g."""
    window, prior, lines = inputs.window, inputs.prior, inputs.lines
    if lines is None:
        far = torch.full((len(parameters), 2, 2, 1), FAR, dtype=torch.float64, device=parameters.device)
        lines = LineDistances(far, torch.zeros_like(far))

    def gradient(
        parameters: Tensor,
        bend: Tensor,
        distance: Tensor,
        turn: Tensor,
        prior: Tensor,
        mean: Tensor,
        weight: Tensor,
        values: Tensor,
    ) -> Tensor:
        levels, jacobian = crossing(parameters, window.where, bend, LineDistances(distance, turn))
        return jacobian @ (weight * (levels - values)) + prior * (parameters - mean)

    arguments = parameters, inputs.bend, *lines, prior.diagonal(), prior.value(), window.weight
    hessian = torch.func.vmap(torch.func.jacfwd(gradient))(*arguments, window.levels)
    inverse, _ = torch.linalg.inv_ex(hessian.detach())
    # Windows without a corner have none, and NaN would spread to the gradients of others.
    inverse = torch.where(torch.isfinite(inverse).all(-1).all(-1)[:, None, None], inverse, 0.0)
    residual = torch.func.vmap(gradient)(*arguments, levels)
    change = -(inverse @ (residual - residual.detach())[..., None])[..., 0]
    return parameters[:, :2] + torch.nan_to_num(change[:, :2])
