"""Models of what an operator marks: two edges that meet, a cross, a blob, the end of a pole; each blurred.

Each model gives, for its parameters, the gray levels of pixels as a sum of a few patterns. How strong the patterns are
follows from linear least squares (variable projection: G. H. Golub and V. Pereyra, 1973), so that only geometry and
blur are searched. Blur is Gaussian, and with it the pixel's own width.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Floats = NDArray[np.float64]
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
    result: Floats = (where - point) @ np.array([math.cos(angle), math.sin(angle)])
    return result


def _bar(distance: Floats, width: float, blur: float) -> Floats:
    """Profile of a blurred bar, 1 in its middle if it is wide."""
    result: Floats = ndtr((distance + width / 2) / blur) - ndtr((distance - width / 2) / blur)
    return result


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
    """The corner of one thing before one background: a wedge of less or more than 180° and nothing else."""
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
    root = np.sqrt(weight)

    def whiten(columns: Floats) -> Floats:
        return root[:, None] * columns

    residual = _whitened_residual(shape, where, levels, whiten)
    costs = [0.0] if len(starts) == 1 else [float(np.square(residual(p)).sum()) for p in starts]
    return improve(shape, starts[int(np.argmin(costs))], where, levels, weight, whiten, iterations)


def improve(
    shape: ShapeModel,
    start: Floats,
    where: Floats,
    levels: Floats,
    weight: Floats,
    whiten: Callable[[Floats], Floats],
    iterations: int = 15,
) -> ShapeFit | None:
    """Least squares from one start (P,), `whiten` making the errors of columns (N, K) alike and independent."""
    residual = _whitened_residual(shape, where, levels, whiten)
    low, high = np.array([-6.0, -6.0, *shape.low]), np.array([6.0, 6.0, *shape.high])
    _, best = _minimized(residual, start, low, high, iterations)
    return _described(shape, best, residual, weight, whiten(levels[:, None])[:, 0])


def design_of(shape: ShapeModel, where: Floats, p: Floats) -> Floats:
    """Patterns (N, K) of a shape, and two for what stands behind, which may be brighter on one side."""
    return np.concatenate([shape.patterns(where, p), where / np.abs(where).max()], 1)


def _whitened_residual(
    shape: ShapeModel, where: Floats, levels: Floats, whiten: Callable[[Floats], Floats]
) -> Callable[[Floats], Floats]:
    def residual(p: Floats) -> Floats:
        columns = whiten(np.concatenate([design_of(shape, where, p), levels[:, None]], 1))
        design, target = columns[:, :-1], columns[:, -1]
        normal = design.T @ design
        normal[np.diag_indices_from(normal)] *= 1 + 1e-10  # patterns may be equal far from the point
        result: Floats = target - design @ np.linalg.solve(normal + 1e-12 * np.eye(len(normal)), design.T @ target)
        return result

    return residual


def starts_at(shape: ShapeModel, points: Floats) -> Floats:
    """(S, P) all starts of a model at each of some points (N, 2)."""
    return np.concatenate([np.concatenate([np.tile(at, (len(shape.starts), 1)), shape.starts], 1) for at in points])


def _minimized(
    residual: Callable[[Floats], Floats], start: Floats, low: Floats, high: Floats, iterations: int
) -> tuple[float, Floats]:
    """Levenberg-Marquardt with slopes by differences; parameters stay inside their bounds."""
    p, damping = np.clip(start, low, high), 1e-3
    r = residual(p)
    cost = float(r @ r)
    for _ in range(iterations):
        jacobian = slopes(residual, p, r)
        normal, right = jacobian.T @ jacobian, jacobian.T @ r
        scale = np.diag(normal) + 1e-9
        for _ in range(5):
            step = -np.linalg.solve(normal + np.diag(damping * scale), right)
            moved = np.clip(p + step, low, high)
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
    return cost, p


def slopes(residual: Callable[[Floats], Floats], p: Floats, r: Floats) -> Floats:
    """(N, P) of residuals by parameters, by differences."""
    columns = []
    for k in range(len(p)):
        moved = p.copy()
        moved[k] += 1e-5
        columns.append((residual(moved) - r) / 1e-5)
    return np.stack(columns, -1)


def _described(
    shape: ShapeModel, p: Floats, residual: Callable[[Floats], Floats], weight: Floats, target: Floats
) -> ShapeFit | None:
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
    root = np.sqrt(weight)
    mean = float((root * target).sum()) / count
    total = float(np.square(target - root * mean).sum())
    explained = 1 - float(r @ r) / max(total, 1e-12)
    score = count * math.log(max(noise2, 1e-3) * freedom / count) + (len(p) + patterns) * math.log(count)
    return ShapeFit(shape.name, p, p[:2], covariance, math.sqrt(noise2), explained, score)
