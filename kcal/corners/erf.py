"""Refine corners by fitting two blurred, crossing edges; each gets a covariance and a blur."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.corners.erf_board import (
    FAR,
    ODD,
    PARAMETERS,
    CornerWindow,
    LineDistances,
    RampPrior,
    crossing,
    curvatures,
    cut_windows,
    light_at,
    light_slope,
    line_covariance,
    neighbor_lines,
)
from kcal.corners.grid import Neighbors
from kcal.corners.saddle import MAX_MOVE, MOVE_SHARE, CornerStatus, Refined, check_arguments, inside_image, with_status
from kcal.dispatch import is_differentiated
from kcal.errors import InputError

# Estimate the covariance of fitted corners from the part of the residuals that can move a corner.
#
# Four squares look the same after a turn by 180° about their corner. A model error that is the same on opposite sides
# (blur that is no Gaussian, a camera's tone curve) cannot move the corner. So the noise is estimated from the part of
# the residuals that is odd about the corner. Its correlation between pixels is the average over the image: JPEG leaves
# coarse steps of high spatial frequency, which hardly move a corner; a lens or a demosaicked sensor smooths noise,
# which moves it more.

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
    odd, pair = _odd(residual, weight, center)
    # In one row of pixels, zeros between lines and patches keep those `apart` from meeting pixels of others.
    width = residual.shape[-1] + _CORRELATED
    odd, pair, weight, jacobian = (
        torch.nn.functional.pad(values, (0, _CORRELATED, 0, _CORRELATED)).flatten(-2)
        for values in (pair * odd, pair, weight, jacobian)
    )
    gain = inverse.to(residual) @ (jacobian * weight[..., None, :])
    outer = gain @ gain.mT  # G Gᵀ
    white = outer[..., :2, :2]
    # (1 - J G)(1 - J G)ᵀ beside the 1 is J at one pixel times `G Gᵀ J - G` at the other, less G times J.
    ahead = torch.cat([jacobian, -gain], -2) * pair[..., None, :]
    behind = torch.cat([outer @ jacobian - gain, jacobian], -2) * pair[..., None, :]
    # Weighted sums over pixels: what was found, what fitting makes of white noise (twice: all of it is odd), and pairs.
    found, made, count = odd.square().sum(-1), 2.0 * (ahead * behind).sum((-2, -1)), pair.square().sum(-1)
    freedom = (count + made).clamp_min(1.0)
    common = _sum_usable(found, usable) / _sum_usable(freedom, usable).clamp_min(1.0)
    known = torch.where(usable.sum(-1) >= 2, _SHARED_PIXELS, 0.0)[:, None]
    noise = (found + known * common[:, None]) / (freedom + known)
    enough = _sum_usable(count, usable) >= _MIN_PIXELS
    # The same sums over pixels `apart`, for the usable corners of each image together.
    whiten = torch.where(noise > 0, noise, math.inf).rsqrt()[..., None]
    odd, pair = (torch.where(usable[..., None], of, 0.0).flatten(1) for of in (odd * whiten, pair))
    ahead, behind = (torch.where(usable[..., None, None], of, 0.0).flatten(1) for of in (ahead, behind))
    moving = gain[..., :2, :]
    smeared = torch.zeros_like(moving)
    for down, right in itertools.product(range(_CORRELATED + 1), range(-_CORRELATED, _CORRELATED + 1)):
        if (apart := down * width + right) > 0:  # each pair of pixels once
            found, made, count = (
                torch.einsum("bk,bk->b", here[:, :-apart], there[:, apart:])
                for here, there in ((odd, odd), (ahead, behind), (pair, pair))
            )
            correlation = torch.where(enough, (found - 2.0 * made) / count.clamp_min(1.0), 0.0)
            smeared[..., :-apart] += correlation[:, None, None, None] * moving[..., apart:]
    cross = moving @ smeared.mT
    covariance = (white + cross + cross.mT).double()
    return noise.clamp_min(least_noise)[..., None, None] * _bounded(covariance, white.double())


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


def _bounded(covariance: Tensor, white: Tensor) -> Tensor:
    """The covariance with its ratio to that of white noise bounded in every direction."""
    factor, _ = torch.linalg.cholesky_ex(torch.nan_to_num(white))
    whitened = torch.linalg.solve_triangular(factor, torch.nan_to_num(covariance), upper=False)
    whitened = torch.linalg.solve_triangular(factor, whitened.transpose(-1, -2), upper=False)
    values, vectors = torch.linalg.eigh(torch.nan_to_num(0.5 * (whitened + whitened.transpose(-1, -2))))
    sides = factor @ vectors
    return (sides * values.clamp(*_VARIANCE_FACTORS)[..., None, :]) @ sides.transpose(-1, -2)


# Fit blurred, crossing edges to the pixels around each corner: Levenberg-Marquardt for all corners at once.
#
# First each corner is fitted alone. What these fits know together (illumination of the board, width of the edges) then
# goes into a second fit.

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
_COARSE_RADIUS = 8.0  # pixels: from here on every fifth pixel is enough for the first steps
_CONVERGED = 1e-5  # pixels: the next step would be shorter; in float64 a tenth of it
_FLOOR = 1e-7  # of the scaled normal matrix: what float32 leaves of it


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
    coarse = window.coarse() if float(radius.min()) >= _COARSE_RADIUS else window
    first, crosses = _start(coarse)
    nothing = torch.zeros_like(first[:, :2])
    curves = curvatures(bend, first) if bend is not None else nothing
    prior = RampPrior.of(first, nothing, nothing[:, 0], nothing[:, 0])
    # A few steps are enough to estimate the illumination of the board and which lines reach into windows.
    fit = _levenberg_marquardt(first, _FitInputs(coarse, curves, prior, None), _FIRST_STEPS)
    usable = crosses & torch.isfinite(fit.cost)
    lines = None
    near = torch.zeros_like(crosses)
    if around is not None:
        beside = neighbor_lines(around, fit.parameters)
        blur = fit.parameters[:, 4].exp().clamp(max=0.5 * flat_side)
        near = usable & (beside.distance.amin((-2, -1)) - radius < REACH * blur)
        if bool(near.any()):
            # Markers may leave less than half a square free; the window stays inside that.
            free = flat_side >= 0.95 * torch.linalg.vector_norm(around.step, dim=-1).nan_to_num(math.inf).amin(-1)
            wide = (WIDE_SHARE * flat_side).clamp(MIN_RADIUS, MAX_RADIUS)
            window, levels = cut_windows(image, base, offset, torch.where(near & free, wide, radius))
            lines = beside.distances(fit.parameters, window.where)
            lines = LineDistances(lines.distance, lines.turn * near[:, None, None, None])
    inputs = _FitInputs(window, curves, prior, lines)
    # With lines each step is twice the work, so only corners near one get them. These are fitted twice, because only
    # the first of the two fits makes the illumination well determined.
    variance, residual = fit.cost / coarse.weight.sum(-1), torch.zeros_like(window.levels)
    fit = fit._replace(residual=residual, jacobian=residual[:, None].repeat(1, PARAMETERS, 1))
    for group, with_lines in ((~near, False), (near, True), (near, True)):
        some = group.nonzero()[:, 0]
        if not len(some):
            continue
        light = light_at(fit.parameters, window, curves, lines, usable.reshape(side.shape))
        place = base + fit.parameters[:, :2].reshape(base.shape)
        slope, error = light_slope(light, place, side, usable.reshape(side.shape))
        inputs = inputs._replace(prior=RampPrior.of(fit.parameters, slope, error, variance))
        chosen = (inputs if with_lines else inputs._replace(lines=None)).of(some)
        done = _levenberg_marquardt(fit.parameters[some], chosen, _STEPS)
        fit = _Fit(*(value.index_copy(0, some, new) for value, new in zip(fit, done, strict=True)))
        variance = fit.cost / window.weight.sum(-1)
    parameters = fit.parameters
    between = (parameters[:, 2] - parameters[:, 3]).sin().abs()
    crosses = crosses & (between > math.sin(MIN_ANGLE)) & torch.isfinite(fit.cost)
    noise, covariance = _noise_and_covariance(fit, inputs, (crosses & fit.converged).reshape(side.shape), least_noise)
    converged = fit.converged & torch.isfinite(covariance).all(-1).all(-1)
    center = _with_gradient(parameters, inputs, levels) if is_differentiated(levels) else parameters[:, :2]
    return CrossingFit(center, parameters, window, noise, covariance, crosses, converged, near)


class _Fit(NamedTuple):
    """Where Levenberg-Marquardt is with each corner: parameters, the cost there, and whether it converged.

    Residuals (M, K), their derivatives (M, 10, K), normal equations and cost are those before the last step.
    """

    parameters: Tensor
    cost: Tensor
    normal: Tensor
    gradient: Tensor
    residual: Tensor
    jacobian: Tensor
    converged: Tensor

    def of(self, some: Tensor) -> _Fit:
        return _Fit(*(value[some] for value in self))


def _levenberg_marquardt(parameters: Tensor, inputs: _FitInputs, steps: int) -> _Fit:
    """Minimize for all corners at once, until the next step would be tiny.

    As steps near the minimum shrink by the same factor, the last one is taken without looking where it ends.
    """
    at = torch.arange(len(parameters), device=parameters.device)  # the corners that still move
    fit = _evaluated(parameters, inputs)
    damping, last = torch.full_like(fit.cost, 1e-3), torch.zeros_like(fit.cost)
    # What rounding of the levels may do to a cost.
    power = (inputs.window.weight * inputs.window.levels.square()).sum(-1).double()
    rounding = torch.finfo(inputs.window.levels.dtype).eps * power.sqrt()
    still = _CONVERGED if inputs.window.levels.dtype == torch.float32 else 0.1 * _CONVERGED
    done = []
    for _ in range(steps):
        scale = fit.normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).rsqrt()
        scaled = fit.normal * scale[:, :, None] * scale[:, None, :]
        scaled = scaled + (_FLOOR + damping)[:, None, None] * torch.eye(PARAMETERS, device=scaled.device)
        factor, _ = torch.linalg.cholesky_ex(scaled)
        step = -torch.cholesky_solve((fit.gradient * scale)[..., None], factor)[..., 0] * scale
        step = torch.nan_to_num(step, posinf=0.0, neginf=0.0)
        trial = fit.parameters + step
        length = torch.linalg.vector_norm(step[:, :2], dim=-1)
        ends = length * (length / last.clamp_min(1e-12)).clamp_max(1.0) < still
        if bool(ends.any()):
            done.append((at[ends], fit._replace(parameters=trial, converged=ends).of(ends)))
            go = (~ends).nonzero()[:, 0]
            at, inputs, fit = at[go], inputs.of(go), fit.of(go)
            trial, damping, length, last, rounding = (value[go] for value in (trial, damping, length, last, rounding))
            if not len(at):
                break
        tried = _evaluated(trial, inputs)
        better = tried.cost <= fit.cost + rounding * fit.cost.sqrt()
        if not bool(better.all()):
            chosen = (
                torch.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old)
                for new, old in zip(tried, fit, strict=True)
            )
            tried = _Fit(*chosen)
        fit, last = tried, torch.where(better, length, last)
        damping = torch.where(better, damping * 0.1, damping * 10.0).clamp(1e-9, 1e6)
    done.append((at, fit))
    order = torch.cat([corners for corners, _ in done]).argsort()
    return _Fit(*(torch.cat(values) for values in zip(*(part for _, part in done), strict=True))).of(order)


def _start(window: CornerWindow) -> tuple[Tensor, Tensor]:
    """Edge directions from the asymptotes of a quadratic, then mean and contrast by linear least squares."""
    x, y = (window.where - window.offset[:, None].to(window.where)).unbind(-1)
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
    levels, _ = crossing(parameters, window.where, torch.zeros_like(parameters[:, :2]), slopes=False)
    design = torch.stack([one, levels], -1)
    parameters[:, 5:7] = _least_squares(design, window.levels, weight)
    return parameters, crosses


def _least_squares(design: Tensor, values: Tensor, weight: Tensor) -> Tensor:
    weighted = (design * weight[..., None]).mT
    normal, right = weighted @ design, weighted @ values[..., None]
    return torch.nan_to_num(torch.linalg.solve_ex(normal.double(), right.double())[0][..., 0])


def _evaluated(parameters: Tensor, inputs: _FitInputs) -> _Fit:
    """Normal equations of the weighted residuals and the prior."""
    window, prior = inputs.window, inputs.prior
    levels, jacobian = crossing(parameters, window.where, inputs.bend, inputs.lines)
    weight, miss = prior.diagonal(), parameters - prior.value()
    rows = torch.cat([jacobian, (levels - window.levels)[:, None]], 1)
    sums = ((rows * window.weight[:, None]) @ rows.mT).double()
    normal = sums[:, :-1, :-1] + torch.diag_embed(weight)
    gradient = sums[:, :-1, -1] + weight * miss
    cost = sums[:, -1, -1] + (weight * miss**2).sum(-1)
    # Of a blur of 0 levels are finite, and their derivatives are not.
    sound = torch.isfinite(cost + gradient.sum(-1))
    cost = torch.where(sound, cost, math.inf)
    return _Fit(parameters, cost, normal, gradient, rows[:, -1], rows[:, :-1], torch.zeros_like(sound))


def _noise_and_covariance(fit: _Fit, inputs: _FitInputs, usable: Tensor, least_noise: float) -> tuple[Tensor, Tensor]:
    window, prior = inputs.window, inputs.prior
    parameters, residual, jacobian = fit.parameters, fit.residual, fit.jacobian
    weighted = jacobian * window.weight[:, None]
    normal = (weighted @ jacobian.mT).double() + torch.diag_embed(prior.diagonal())
    inverse, _ = torch.linalg.inv_ex(normal)
    images = usable.shape
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
        gain = inverse[:, :2].to(weighted) @ weighted
        covariance = covariance + line_covariance(parameters, window, inputs.bend, inputs.lines, gain, covariance)
    return noise, covariance


def _with_gradient(parameters: Tensor, inputs: _FitInputs, levels: Tensor) -> Tensor:
    """The center as a function of the gray levels: at the minimum g(p, levels) = 0, so dp = -(∂g/∂p)⁻¹ ∂g."""
    window, prior, lines = inputs.window.double(), inputs.prior, inputs.lines
    if lines is None:
        far = torch.full((len(parameters), 2, 2, 1), FAR, dtype=torch.float64, device=parameters.device)
        lines = LineDistances(far, torch.zeros_like(far))

    def gradient(parameters: Tensor, *given: Tensor) -> Tensor:
        bend, distance, turn, prior, mean, weight, values = given
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


# Refine corners by fitting two blurred, crossing edges; each gets a covariance and a blur.
#
# `kcal.corners.erf_board.crossing` models all pixels within half a square (at most 12 px) of each corner. A small
# batched Levenberg-Marquardt estimates its ten parameters for all corners at once. Nothing is interpolated: the model
# is evaluated at the pixels.

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

    Starts must be good to about half a pixel, such as those of `kcal.corners.refine.saddle`. The corners are
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
