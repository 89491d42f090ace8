"""Refine corners by fitting two blurred, crossing edges; each gets a covariance and a blur."""

from __future__ import annotations

import math
from types import EllipsisType
from typing import NamedTuple

import torch
from torch import Tensor

import kcal.corners.erf_board as models
from kcal.checks import as_points
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
    residual: Tensor, weight: Tensor, jacobian: Tensor, inverse: Tensor, center: Tensor, usable: Tensor,
    least_noise: float,
) -> Tensor:  # fmt: skip
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
    gain = torch.einsum("bnij,bnjyx->bniyx", inverse.to(residual), jacobian * weight[:, :, None])
    outer = torch.einsum("bniyx,bnjyx->bnij", gain, gain)  # G Gᵀ
    smeared = torch.einsum("bnij,bnjyx->bniyx", outer, jacobian)
    moving, white = gain[:, :, :2], outer[..., :2, :2]
    odd, pair = _odd(residual, weight, center)
    # (1 - J G)(1 - J G)ᵀ beside the 1 is J at one pixel times `smeared - gain` at the other, less G times J.
    weights = pair[:, :, None]
    ahead, behind = torch.cat([jacobian, -gain], 2) * weights, torch.cat([smeared - gain, jacobian], 2) * weights
    odd = pair * odd

    def found_and_made(down: int, right: int) -> tuple[Tensor, Tensor, Tensor]:
        """Weighted sums over pairs of pixels: products found, products that fitting makes of white noise, and pairs."""
        here, there = _pixel_pairs(down, right)
        made = 2.0 * (ahead[here] * behind[there]).sum((-3, -2, -1))  # twice: all of it is odd
        return (odd[here] * odd[there]).sum((-2, -1)), made, (pair[here] * pair[there]).sum((-2, -1))

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
    return noise.clamp_min(least_noise)[..., None, None] * _bounded(covariance.double(), white.double())


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
_CONVERGED = 1e-4  # pixels: the last step is shorter; in float64 a tenth of it
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
    window: models.CornerWindow
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

    window: models.CornerWindow
    bend: Tensor
    prior: models.RampPrior
    lines: models.LineDistances | None

    def of(self, some: Tensor) -> _FitInputs:
        lines = None if self.lines is None else models.LineDistances(*(value[some] for value in self.lines))
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
    window, levels = models.cut_windows(image, base, offset, radius)
    first, crosses = _start(window)
    nothing = torch.zeros_like(first[:, :2])
    curves = models.curvatures(bend, first) if bend is not None else nothing
    prior = models.RampPrior.of(first, nothing, nothing[:, 0], nothing[:, 0])
    # A few steps are enough to estimate the illumination of the board and which lines reach into windows.
    parameters, cost, converged = _levenberg_marquardt(first, _FitInputs(window, curves, prior, None), _FIRST_STEPS)
    usable = crosses & torch.isfinite(cost)
    lines = None
    near = torch.zeros_like(crosses)
    if around is not None:
        beside = models.neighbor_lines(around, parameters)
        blur = parameters[:, 4].exp().clamp(max=0.5 * flat_side)
        near = usable & (beside.distance.amin((-2, -1)) - radius < REACH * blur)
        if bool(near.any()):
            # Markers may leave less than half a square free; the window stays inside that.
            free = flat_side >= 0.95 * torch.linalg.vector_norm(around.step, dim=-1).nan_to_num(math.inf).amin(-1)
            wide = (WIDE_SHARE * flat_side).clamp(MIN_RADIUS, MAX_RADIUS)
            window, levels = models.cut_windows(image, base, offset, torch.where(near & free, wide, radius))
            lines = beside.distances(parameters, window.where)
            lines = models.LineDistances(lines.distance, lines.turn * near[:, None, None, None])
    inputs = _FitInputs(window, curves, prior, lines)
    # With lines each step is twice the work, so only corners near one get them. These are fitted twice, because only
    # the first of the two fits makes the illumination well determined.
    for group, with_lines in ((~near, False), (near, True), (near, True)):
        some = group.nonzero()[:, 0]
        if not len(some):
            continue
        light = models.light_at(parameters, window, curves, lines, usable.reshape(side.shape))
        place = base + parameters[:, :2].reshape(base.shape)
        slope, error = models.light_slope(light, place, side, usable.reshape(side.shape))
        inputs = inputs._replace(prior=models.RampPrior.of(parameters, slope, error, cost / window.weight.sum(-1)))
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
    # What rounding of the levels may do to a cost.
    power = (inputs.window.weight * inputs.window.levels.square()).sum(-1).double()
    rounding = torch.finfo(inputs.window.levels.dtype).eps * power.sqrt()
    still = _CONVERGED if inputs.window.levels.dtype == torch.float32 else 0.1 * _CONVERGED
    for _ in range(steps):
        scale = normal.diagonal(dim1=-2, dim2=-1).clamp_min(1e-12).rsqrt()
        scaled = normal * scale[:, :, None] * scale[:, None, :]
        scaled = scaled + (_FLOOR + damping)[:, None, None] * torch.eye(models.PARAMETERS, device=scaled.device)
        factor, _ = torch.linalg.cholesky_ex(scaled)
        step = -torch.cholesky_solve((gradient * scale)[..., None], factor)[..., 0] * scale
        step = torch.nan_to_num(step, posinf=0.0, neginf=0.0)
        trial = parameters + step
        trial_normal, trial_gradient, trial_cost = _normal_equations(trial, inputs)
        better = trial_cost <= cost + rounding * cost.sqrt()
        length = torch.linalg.vector_norm(step[:, :2], dim=-1)
        # A rejected tiny step is rounding at the minimum; a rejected long one is not.
        last = torch.where(better | (length < still), length, last)
        parameters = torch.where(better[:, None], trial, parameters)
        normal = torch.where(better[:, None, None], trial_normal, normal)
        gradient = torch.where(better[:, None], trial_gradient, gradient)
        cost = torch.where(better, trial_cost, cost)
        damping = torch.where(better, damping * 0.1, damping * 10.0).clamp(1e-9, 1e6)
        go = (last >= still).nonzero()[:, 0]
        if 2 * len(go) < len(at):  # go on with those that have not converged
            result[at], result_cost[at], result_last[at] = parameters, cost, last
            if not len(go):
                break
            at, inputs = at[go], inputs.of(go)
            parameters, normal, gradient, cost, damping, last, rounding = (
                value[go] for value in (parameters, normal, gradient, cost, damping, last, rounding)
            )
    result[at], result_cost[at], result_last[at] = parameters, cost, last
    return result, result_cost, result_last < _CONVERGED


def _start(window: models.CornerWindow) -> tuple[Tensor, Tensor]:
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
    parameters = torch.zeros(len(x), models.PARAMETERS, dtype=torch.float64, device=x.device)
    parameters[:, :2] = window.offset
    parameters[:, 2], parameters[:, 3] = axis - opening, axis + opening
    parameters[:, 4] = (0.2 * window.radius).clamp(0.6, 1.5).log()
    parameters[:, 6] = 1.0
    levels, _ = models.crossing(parameters, window.where, torch.zeros_like(parameters[:, :2]), slopes=False)
    design = torch.stack([one, levels], -1)
    parameters[:, 5:7] = _least_squares(design, window.levels, weight)
    return parameters, crosses


def _least_squares(design: Tensor, values: Tensor, weight: Tensor) -> Tensor:
    weighted = (design * weight[..., None]).mT
    normal, right = weighted @ design, weighted @ values[..., None]
    return torch.nan_to_num(torch.linalg.solve_ex(normal.double(), right.double())[0][..., 0])


def _normal_equations(parameters: Tensor, inputs: _FitInputs) -> tuple[Tensor, Tensor, Tensor]:
    """Normal matrix, gradient and cost of the weighted residuals and the prior."""
    window, prior = inputs.window, inputs.prior
    levels, jacobian = models.crossing(parameters, window.where, inputs.bend, inputs.lines)
    weight, miss = prior.diagonal(), parameters - prior.value()
    residual = levels - window.levels
    weighted = jacobian * window.weight[:, None]
    normal = (weighted @ jacobian.mT).double() + torch.diag_embed(weight)
    gradient = (weighted @ residual[..., None])[..., 0].double() + weight * miss
    cost = (window.weight * residual**2).sum(-1).double() + (weight * miss**2).sum(-1)
    # Of a blur of 0 levels are finite, and their derivatives are not.
    sound = torch.isfinite(cost + gradient.sum(-1))
    return normal, gradient, torch.where(sound, cost, math.inf)


def _noise_and_covariance(
    parameters: Tensor, inputs: _FitInputs, usable: Tensor, least_noise: float
) -> tuple[Tensor, Tensor]:
    window, prior = inputs.window, inputs.prior
    levels, jacobian = models.crossing(parameters, window.where, inputs.bend, inputs.lines)
    weighted = jacobian * window.weight[:, None]
    normal = (weighted @ jacobian.mT).double() + torch.diag_embed(prior.diagonal())
    inverse, _ = torch.linalg.inv_ex(normal)
    images = usable.shape
    residual = levels - window.levels
    freedom = (window.weight.sum(-1) - models.PARAMETERS).clamp_min(1.0)
    noise = (window.weight * residual.square()).sum(-1) / freedom
    covariance = center_covariance(
        window.patches(residual).unflatten(0, images), window.patches(window.weight).unflatten(0, images),
        window.patches(jacobian[:, models.ODD]).unflatten(0, images),
        inverse.reshape(*images, models.PARAMETERS, models.PARAMETERS)[:, :, models.ODD][..., models.ODD],
        parameters[:, :2].reshape(*images, 2), usable & torch.isfinite(inverse).all(-1).all(-1).reshape(images),
        least_noise,
    ).reshape(-1, 2, 2)  # fmt: skip
    by_ramp = inverse[:, :2, 7:9] * (prior.weight * prior.error)[:, None, None]
    covariance = covariance + by_ramp @ by_ramp.transpose(-1, -2)
    if inputs.lines is not None:
        gain = inverse[:, :2].to(weighted) @ weighted
        covariance = covariance + models.line_covariance(
            parameters, window, inputs.bend, inputs.lines, gain, covariance
        )
    return noise, covariance


def _with_gradient(parameters: Tensor, inputs: _FitInputs, levels: Tensor) -> Tensor:
    """The center as a function of the gray levels: at the minimum g(p, levels) = 0, so dp = -(∂g/∂p)⁻¹ ∂g."""
    window, prior, lines = inputs.window.double(), inputs.prior, inputs.lines
    if lines is None:
        far = torch.full((len(parameters), 2, 2, 1), models.FAR, dtype=torch.float64, device=parameters.device)
        lines = models.LineDistances(far, torch.zeros_like(far))

    def gradient(parameters: Tensor, *given: Tensor) -> Tensor:
        bend, distance, turn, prior, mean, weight, values = given
        levels, jacobian = models.crossing(parameters, window.where, bend, models.LineDistances(distance, turn))
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
