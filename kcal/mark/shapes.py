"""Models of what an operator marks, fitted where a click is; or refused."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial.distance import cdist
from scipy.special import ndtr
from torch import Tensor

from kcal.corners.images import Gray
from kcal.corners.match import refine_point
from kcal.errors import InputError

# Models of what an operator marks: two edges that meet, a cross, a blob, the end of a pole; each blurred.
#
# Each model gives, for its parameters, the gray levels of pixels as a sum of a few patterns. How strong the patterns
# are follows from linear least squares (variable projection: G. H. Golub and V. Pereyra, 1973), so that only geometry
# and blur are searched. Blur is Gaussian, and with it the pixel's own width.

Floats = NDArray[np.float64]
# Of parameters to residuals, or of columns (N, K) to white ones.
_Map: TypeAlias = Callable[[Floats], Floats]
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
SEEN = 0.01  # of the largest weight: pixels that count less are left out
_CONVERGED = 5e-4  # pixels: the last step of a converged point is shorter
_STEEPEST = 0.985  # correlation: lines that meet at less than 10° are one edge


class ShapeModel(NamedTuple):
    """A model.

    Attributes:
        name: what it is called.
        patterns: (N, K) of positions (N, 2) around the start and parameters (P,); the first two are the point.
        starts: parameters (S, P) to begin with, without the point.
        low: smallest parameters, without the point.
        high: largest parameters, without the point.
    """

    name: str
    patterns: Callable[[Floats, Floats], Floats]
    starts: Floats
    low: tuple[float, ...]
    high: tuple[float, ...]


def _across(where: Floats, point: Floats, angle: float) -> Floats:
    """Signed distance (N,) from the line through a point whose normal has an angle."""
    return (where - point) @ np.array([math.cos(angle), math.sin(angle)])


def _bar(distance: Floats, width: float, blur: float) -> Floats:
    """Profile of a blurred bar, 1 in its middle if it is wide."""
    return ndtr((distance + width / 2) / blur) - ndtr((distance - width / 2) / blur)


def _both_positive(h: Floats, k: Floats, correlation: float) -> Floats:
    """Probability that two normal variables of a correlation lie below h and k: a blurred wedge, exactly.

    Plackett's integral over the correlation: R. L. Plackett, "A reduction formula for normal multivariate integrals",
    1954.
    """
    angle = math.asin(correlation)
    theta = 0.5 * angle * (_NODES + 1)
    sine, cosine = np.sin(theta), np.cos(theta)
    exponent = (h * h + k * k)[:, None] - 2 * (h * k)[:, None] * sine
    wedge: Floats = np.exp(-0.5 * exponent / cosine**2) @ _WEIGHTS * (angle / (4 * math.pi))
    return ndtr(h) * ndtr(k) + wedge


def _corner(where: Floats, p: Floats) -> Floats:
    blur = p[4]
    h, k = (_across(where, p[:2], angle) / blur for angle in (p[2], p[3]))
    correlation = min(max(math.cos(p[3] - p[2]), -_STEEPEST), _STEEPEST)
    return np.stack([np.ones_like(h), ndtr(h), ndtr(k), _both_positive(h, k, correlation)], -1)


def _wedge(where: Floats, p: Floats) -> Floats:
    """The corner of one object before one background: a wedge of less or more than 180° and nothing else."""
    return _corner(where, p)[:, [0, 3]]


def _cross(where: Floats, p: Floats) -> Floats:
    first, second = (_bar(_across(where, p[:2], angle), p[4], p[5]) for angle in (p[2], p[3]))
    return np.stack([np.ones_like(first), 1 - (1 - first) * (1 - second)], -1)


def _blob(where: Floats, p: Floats) -> Floats:
    d = where - p[:2]
    along = d @ np.array([math.cos(p[2]), math.sin(p[2])])
    across = d @ np.array([-math.sin(p[2]), math.cos(p[2])])
    # A power of 2 makes it flat in the middle with soft edges, as a blurred disc or box is.
    distance = (along / p[3]) ** 2 + (across / p[4]) ** 2
    return np.stack([np.ones_like(along), np.exp(-0.5 * np.maximum(distance, 1e-12) ** p[5])], -1)


def _end(where: Floats, p: Floats) -> Floats:
    side = _bar(_across(where, p[:2], p[2] + math.pi / 2), p[3], p[4])
    return np.stack([np.ones_like(side), side * ndtr(_across(where, p[:2], p[2]) / p[4])], -1)


def _grid(*axes: tuple[float, ...]) -> Floats:
    return np.stack([axis.ravel() for axis in np.meshgrid(*axes, indexing="ij")], -1)


_ANGLES = tuple(math.pi * k / 8 for k in range(8))
_pairs = _grid(_ANGLES, _ANGLES)
_PAIRS = _pairs[_pairs[:, 0] < _pairs[:, 1]]
_around = _grid(tuple(math.pi * k / 4 for k in range(8)), (math.pi / 3, math.pi / 2, 2 * math.pi / 3))
_QUADRANTS = np.stack([_around[:, 0], _around[:, 0] + _around[:, 1]], -1)
_BLURS = (0.4, 4.0)
_TURNS = (-20.0, 20.0)

SHAPES = (
    ShapeModel("corner", _wedge, np.concatenate([_QUADRANTS, np.full((len(_QUADRANTS), 1), 1.0)], 1),
               (_TURNS[0], _TURNS[0], _BLURS[0]), (_TURNS[1], _TURNS[1], _BLURS[1])),
    ShapeModel("corner", _corner, np.concatenate([_PAIRS, np.full((len(_PAIRS), 1), 1.0)], 1),
               (_TURNS[0], _TURNS[0], _BLURS[0]), (_TURNS[1], _TURNS[1], _BLURS[1])),
    ShapeModel("cross", _cross, _grid(_ANGLES[:4], (0.0,), (2.0, 4.0), (1.0,)) + np.array([0, 0, 0, 0.0]),
               (_TURNS[0], _TURNS[0], 0.5, _BLURS[0]), (_TURNS[1], _TURNS[1], 10.0, _BLURS[1])),
    ShapeModel("blob", _blob, _grid((0.0, math.pi / 4), (1.5, 4.0), (1.5, 3.0), (1.0,)),
               (_TURNS[0], 0.6, 0.6, 0.7), (_TURNS[1], 12.0, 12.0, 5.0)),
    ShapeModel("end", _end, _grid(tuple(math.pi * k / 8 for k in range(16)), (2.0, 5.0), (1.0,)),
               (_TURNS[0], 0.5, _BLURS[0]), (_TURNS[1], 10.0, _BLURS[1])),
)  # fmt: skip
# The second arm of a cross starts at a right angle to the first.
SHAPES[2].starts[:, 1] = SHAPES[2].starts[:, 0] + math.pi / 2


class ShapeFit(NamedTuple):
    """A model fitted around a start.

    Attributes:
        shape: name of the model.
        parameters: (P,) all of them.
        point: (2,) from the start, px.
        covariance: (2, 2) px².
        noise: standard deviation of the residuals, gray levels.
        explained: share of the variance of the gray levels that the model explains, 0 to 1.
        score: Bayesian information criterion; the lowest is best.
    """

    shape: str
    parameters: Floats
    point: Floats
    covariance: Floats
    noise: float
    explained: float
    score: float


def fit_shape(
    shape: ShapeModel, where: Floats, levels: Floats, weight: Floats, starts: Floats, iterations: int = 15
) -> ShapeFit | None:
    """Fit a model to gray levels (N,) at positions (N, 2) by least squares with weights (N,).

    Args:
        shape: the model.
        where: positions around the start, px.
        levels: gray levels.
        weight: of each pixel, 0 to 1.
        starts: (S, P) parameters to begin with; the best of them is improved.
        iterations: at most.

    Returns:
        The fit; None if the pixels determine nothing.
    """
    used = weight > SEEN
    where, levels, weight = where[used], levels[used], weight[used]
    whiten = functools.partial(np.multiply, np.sqrt(weight)[:, None])
    residual = _whitened_residual(shape, where, levels, whiten)
    costs = [0.0] if len(starts) == 1 else [float(np.square(residual(p)).sum()) for p in starts]
    return improve(shape, starts[int(np.argmin(costs))], where, levels, weight, whiten, iterations)


def improve(
    shape: ShapeModel, start: Floats, where: Floats, levels: Floats, weight: Floats, whiten: _Map, iterations: int = 15
) -> ShapeFit | None:
    """Least squares from one start (P,); `whiten` makes the errors of columns (N, K) independent and of equal size."""
    residual = _whitened_residual(shape, where, levels, whiten)
    low, high = np.array([-6.0, -6.0, *shape.low]), np.array([6.0, 6.0, *shape.high])
    p = _minimized(residual, start, low, high, iterations)
    r = residual(p)
    jacobian = slopes(residual, p, r)
    length = np.linalg.norm(jacobian, axis=0) + 1e-12
    scaled = jacobian / length
    normal = scaled.T @ scaled
    patterns = shape.patterns(np.zeros((1, 2)), p).shape[1] + 2
    count = float(weight.sum())
    freedom = max(count - len(p) - patterns, 1.0)
    noise2 = float(r @ r) / freedom
    # Parameters at a bound, or that do not matter, drop out; the point itself must be determined.
    values, vectors = np.linalg.eigh(normal)
    if values[-1] <= 0:
        return None
    inverse = (vectors / np.maximum(values, 1e-9 * values[-1])) @ vectors.T
    # Weights shape the window and are not inverse variances: the noise is that of single pixels.
    middle = noise2 * (scaled * weight[:, None]).T @ scaled
    covariance = (inverse @ middle @ inverse)[:2, :2] / np.outer(length[:2], length[:2])
    target, root = whiten(levels[:, None])[:, 0], np.sqrt(weight)
    mean = float((root * target).sum()) / count
    total = float(np.square(target - root * mean).sum())
    explained = 1 - float(r @ r) / max(total, 1e-12)
    score = count * math.log(max(noise2, 1e-3) * freedom / count) + (len(p) + patterns) * math.log(count)
    return ShapeFit(shape.name, p, p[:2], covariance, math.sqrt(noise2), explained, score)


def design_of(shape: ShapeModel, where: Floats, p: Floats) -> Floats:
    """Patterns (N, K) of a shape, and two for what stands behind, which may be brighter on one side."""
    return np.concatenate([shape.patterns(where, p), where / np.abs(where).max()], 1)


def _whitened_residual(shape: ShapeModel, where: Floats, levels: Floats, whiten: _Map) -> _Map:
    def residual(p: Floats) -> Floats:
        columns = whiten(np.concatenate([design_of(shape, where, p), levels[:, None]], 1))
        design, target = columns[:, :-1], columns[:, -1]
        normal = design.T @ design
        normal[np.diag_indices_from(normal)] *= 1 + 1e-10  # patterns may be equal far from the point
        return target - design @ np.linalg.solve(normal + 1e-12 * np.eye(len(normal)), design.T @ target)

    return residual


def starts_at(shape: ShapeModel, points: Floats) -> Floats:
    """(S, P) all starts of a model at each of some points (N, 2)."""
    return np.concatenate([np.concatenate([np.tile(at, (len(shape.starts), 1)), shape.starts], 1) for at in points])


def _minimized(residual: _Map, start: Floats, low: Floats, high: Floats, iterations: int) -> Floats:
    """Levenberg-Marquardt with slopes by differences; parameters stay inside their bounds."""
    p, damping = np.clip(start, low, high), 1e-3
    r = residual(p)
    cost = float(r @ r)
    for _ in range(iterations):
        jacobian = slopes(residual, p, r)
        normal, right = jacobian.T @ jacobian, jacobian.T @ r
        scale = np.diag(normal) + 1e-9
        for _ in range(5):
            moved = np.clip(p - np.linalg.solve(normal + np.diag(damping * scale), right), low, high)
            there = residual(moved)
            if float(there @ there) < cost:
                damping = max(damping / 5, 1e-9)
                break
            damping *= 5
        else:
            break
        before, cost = cost, float(there @ there)
        settled = float(np.abs(moved - p)[:2].max()) < _CONVERGED or before - cost < 1e-6 * before
        p, r = moved, there
        if settled:
            break
    return p


def slopes(residual: _Map, p: Floats, r: Floats) -> Floats:
    """(N, P) of residuals by parameters, by differences."""
    return np.stack([(residual(p + step) - r) / 1e-5 for step in 1e-5 * np.eye(len(p))], -1)


# A shape fitted again where what stands behind it has a texture: its gray levels are alike in neighboring pixels.
#
# Far hills behind a lamp are not noise of single pixels, and where they are taken for it the lamp is placed twice as
# badly and stated to be known twice as well as it is. What the shape leaves over is therefore white noise and a texture
# whose correlation falls as exp(-distance / length). Length and strength follow from the pixels by restricted maximum
# likelihood (H. D. Patterson and R. Thompson, "Recovery of inter-block information when block sizes are unequal",
# 1971), and the shape by least squares that know them (Aitken's, or generalized, least squares).

# With other steps (1.5, 4, 10 px; 6 and 18 px to 100) targets before hills erred as much within 7 %.
_LENGTHS = (2.0, 6.0, 18.0)  # px
_STRENGTHS = (0.0, 0.3, 1.0, 3.0, 10.0, 30.0)  # variance of the texture, in variances of the white noise
# The sixteen pairs of pixels of two means of four: by how much their distance differs from that of the means.
_OVERLAPS = [((x, y), (2 - abs(x)) * (2 - abs(y)) / 16) for x in (-1, 0, 1) for y in (-1, 0, 1)]


class Texture(NamedTuple):
    """What a shape leaves over.

    Attributes:
        length: of the correlation of the texture, px.
        strength: its variance over that of the white noise.
    """

    length: float
    strength: float


def fit_before_texture(shape: ShapeModel, fit: ShapeFit, where: Floats, levels: Floats) -> ShapeFit:
    """Fit a shape again, with a texture behind it.

    Args:
        shape: the model.
        fit: its fit that knows of no texture; the start.
        where: positions (N, 2) around the start, px.
        levels: gray levels (N,).

    Returns:
        The fit with another place and covariance; its score and what it explains stay those of the start.
    """
    design = design_of(shape, where, fit.parameters)
    strengths = np.linalg.lstsq(design, levels, rcond=None)[0]

    def modeled(p: Floats) -> Floats:
        return design_of(shape, where, p) @ strengths

    left_over = levels - design @ strengths
    unknowns = np.concatenate([design, slopes(modeled, fit.parameters, modeled(fit.parameters))], 1)
    found = texture_of(where, left_over, unknowns)
    half = cholesky(found.strength * np.exp(-cdist(where, where) / found.length) + np.eye(len(where)), lower=True)
    whiten = functools.partial(solve_triangular, half, lower=True, check_finite=False)
    again = improve(shape, fit.parameters, where, levels, np.ones(len(where)), whiten)
    if again is None:
        return fit
    return fit._replace(parameters=again.parameters, point=again.point, covariance=again.covariance)


def texture_of(where: Floats, left_over: Floats, unknowns: Floats) -> Texture:
    """Texture in what a model leaves over, by restricted maximum likelihood of means of 2 x 2 pixels.

    Args:
        where: positions (N, 2), px.
        left_over: gray levels (N,) without the model.
        unknowns: (N, K) derivatives of the model by all that was fitted.
    """
    middle, means = _fours(where, np.concatenate([left_over[:, None], unknowns], 1))
    basis, values, _ = np.linalg.svd(means[:, 1:], full_matrices=False)
    basis = basis[:, values > 1e-9 * values[0]]
    apart = [(cdist(middle, middle + shift), weight) for shift, weight in _OVERLAPS]
    best, result = -math.inf, Texture(_LENGTHS[0], 0.0)
    for length in _LENGTHS:
        alike = sum(weight * np.exp(-distance / length) for distance, weight in apart)
        for strength in _STRENGTHS:
            likelihood = _likelihood(means[:, 0], basis, strength * alike + 0.25 * np.eye(len(middle)))
            if likelihood > best:
                best, result = likelihood, Texture(length, strength)
    return result


def _fours(where: Floats, columns: Floats) -> tuple[Floats, Floats]:
    """Positions (M, 2) and means (M, K) of squares of four pixels: the texture is coarser, the work 64 times less."""
    cell = np.floor((where - where.min(0) + 0.5) / 2).astype(np.int64)
    _, index, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(count), 2 + columns.shape[1]))
    np.add.at(sums, index.ravel(), np.concatenate([where, columns], 1))
    means = sums[count == 4] / 4
    return means[:, :2], means[:, 2:]


def _likelihood(left_over: Floats, basis: Floats, covariance: Floats) -> float:
    """Logarithm of the restricted likelihood, its scale eliminated, but for a constant."""
    half = np.linalg.cholesky(covariance)
    white = solve_triangular(half, np.concatenate([left_over[:, None], basis], 1), lower=True)
    normal, right = white[:, 1:].T @ white[:, 1:], white[:, 1:].T @ white[:, 0]
    squares = float(white[:, 0] @ white[:, 0] - right @ np.linalg.solve(normal, right))
    freedom = len(basis) - basis.shape[1]
    return -0.5 * (
        freedom * math.log(max(squares, 1e-300) / freedom)
        + 2 * float(np.log(np.diag(half)).sum())
        + float(np.linalg.slogdet(normal)[1])
    )


# Move a click to what is there: a corner, a cross, the middle of a blob or the end of a pole; or refuse.

REACH = 3.5  # pixels that a click may be away from what it means
_HALF = 18  # pixels on each side of the click that take part at most
_WINDOWS = (4.0, 5.5, 7.5)  # pixels: sigma of the weight around the point, as long as the shape fits
_NOISIER = 1.1  # times the noise of the smaller window: then the larger one contains something else
_LEAST_HALF = 8
_SURE = 60.0  # a shape whose score is this much higher is not the one
_ROUGH = 10  # iterations to tell which shape it is
_LEAST_EXPLAINED = 0.7  # below, the surroundings are something else
_LARGEST_SIGMA = 0.5  # px: a place that is known worse than this is marked as well by hand
# px: what blur that is not Gaussian and backgrounds that are not even leave of the best fits.
_MODEL_SIGMA = 0.02


class Snapped(NamedTuple):
    """A point that was found near a click.

    Attributes:
        u: column.
        v: row.
        cov: variance of u, covariance, variance of v, px².
        how: the shape that was found; "edges" where only the directions of edges were used (`refine_point`).
    """

    u: float
    v: float
    cov: tuple[float, float, float]
    how: str


def snap(image: Gray, u: float, v: float) -> Snapped:
    """Find what a click means.

    Four shapes are fitted around it and the one that explains the pixels best is taken. Where
    none explains them, edges that meet decide alone (`kcal.corners.match.refine_point`).

    Args:
        image: (H, W) gray levels.
        u: column of the click.
        v: row.

    Raises:
        InputError: nothing there that determines a point, or nothing within 3.5 px.

    Example:
        >>> x = np.arange(60.0)
        >>> image = 60 + 100 / (1 + np.exp(-2 * np.add.outer(x - 30.3, 0 * x))) / (1 + np.exp(-2 * (x - 27.6)))
        >>> found = snap(image.astype(np.uint8), 29, 31)
        >>> found.how, round(found.u, 1), round(found.v, 1)
        ('corner', 27.6, 30.3)
    """
    column, row = round(u), round(v)
    height, width = image.shape
    half = min(column, row, width - 1 - column, height - 1 - row, _HALF)
    if half < _LEAST_HALF:
        raise InputError(f"within {_LEAST_HALF} px of the image's border: no room to look for a shape; mark it by hand")
    levels = image[row - half : row + half + 1, column - half : column + half + 1].astype(np.float64)
    if levels.max() - levels.min() < 3:
        raise InputError("flat: there is nothing to snap to; mark it by hand or choose another point")
    best = _best_shape(levels, np.array([u - column, v - row]))
    if best is not None:
        cov = best.covariance + _MODEL_SIGMA**2 * np.eye(2)
        return Snapped(column + float(best.point[0]), row + float(best.point[1]), three_of(cov), best.shape)
    # Only the surroundings are converted: the image may have 24 million pixels.
    top, left = max(round(v) - 24, 0), max(round(u) - 24, 0)
    crop = torch.from_numpy(image[top : top + 49, left : left + 49].astype(np.float64))
    found = refine_point(crop, torch.tensor([u - left, v - top], dtype=torch.float64))
    covariance = found.covariance.numpy() + _MODEL_SIGMA**2 * np.eye(2)
    if math.sqrt(float(np.linalg.eigvalsh(covariance)[-1])) > _LARGEST_SIGMA:
        raise InputError("nothing here determines a point: no corner, cross, blob or end; mark it by hand")
    return Snapped(left + float(found.pixel[0]), top + float(found.pixel[1]), three_of(covariance), "edges")


def _best_shape(levels: Floats, click: Floats) -> ShapeFit | None:
    half = len(levels) // 2
    x, y = np.meshgrid(np.arange(-half, half + 1.0), np.arange(-half, half + 1.0))
    where = np.stack([x.ravel(), y.ravel()], -1)
    gray = levels.ravel()

    def window(middle: Floats, sigma: float) -> Floats:
        distance = np.square(where - middle).sum(-1)
        return np.where(distance < (2.5 * sigma) ** 2, np.exp(-0.5 * distance / sigma**2), 0.0)

    around = click + REACH / 1.6 * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    rough = []
    for shape in SHAPES:
        fit = fit_shape(shape, where, gray, window(click, _WINDOWS[0]), starts_at(shape, around), _ROUGH)
        if fit is not None and np.linalg.norm(fit.point - click) <= REACH + 1:
            rough.append((shape, fit))
    rough.sort(key=lambda found: found[1].score)
    fits = []
    for shape, first in [found for found in rough[:2] if found[1].score < rough[0][1].score + _SURE]:
        # Again with windows around the point, so that the result does not depend on the click.
        fit, previous, seen = None, first, np.zeros(len(where), dtype=bool)
        for sigma in _WINDOWS:
            wider = fit_shape(shape, where, gray, window(previous.point, sigma), previous.parameters[None])
            # A larger window is better as long as the shape explains it as well.
            if wider is None or (fit is not None and wider.noise > _NOISIER * fit.noise):
                break
            # Around a whole pixel, so that a click elsewhere does not change which pixels at the rim take part.
            fit, previous, seen = wider, wider, window(np.rint(wider.point), sigma) > SEEN
        if fit is not None and _is_determined(fit, click):
            fits.append((first.score, shape, fit, seen))
    # The shape that explains the pixels best is the one, unless it determines no point.
    for _, shape, fit, seen in sorted(fits, key=lambda found: found[0]):
        final = fit_before_texture(shape, fit, where[seen], gray[seen])
        if _is_determined(final, click):
            return final
    return None


def _is_determined(fit: ShapeFit, click: Floats) -> bool:
    sigma = math.sqrt(max(float(np.linalg.eigvalsh(fit.covariance)[-1]), 0.0))
    near = float(np.linalg.norm(fit.point - click)) <= REACH
    return near and 0 < sigma <= _LARGEST_SIGMA and fit.explained >= _LEAST_EXPLAINED


def three_of(covariance: Floats | Tensor) -> tuple[float, float, float]:
    """Variance of u, covariance and variance of v, of a covariance (2, 2)."""
    return float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])
