"""A shape fitted again where what stands behind it has a texture: its gray levels are alike in neighboring pixels.

Far hills behind a lamp are not noise of single pixels, and where they are taken for it the lamp is placed twice as
badly and stated to be known twice as well as it is. What the shape leaves over is therefore white noise and a texture
whose correlation falls as exp(-distance / length). Length and strength follow from the pixels by restricted maximum
likelihood (H. D. Patterson and R. Thompson, "Recovery of inter-block information when block sizes are unequal", 1971),
and the shape by least squares that know them (Aitken's, or generalized, least squares).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial.distance import cdist

from kcal.mark.shapes import Floats, ShapeFit, ShapeModel, design_of, improve, slopes

# With other steps (1.5, 4, 10 px; 6 and 18 px to 100) targets before hills erred as much within 7 %.
_LENGTHS = (2.0, 6.0, 18.0)  # px
_STRENGTHS = (0.0, 0.3, 1.0, 3.0, 10.0, 30.0)  # variance of the texture, in variances of the white noise
# The sixteen pairs of pixels of two means of four: by how much their distance differs from that of the means.
_PAIRS = [((x, y), (2 - abs(x)) * (2 - abs(y)) / 16) for x in (-1, 0, 1) for y in (-1, 0, 1)]


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
        result: Floats = design_of(shape, where, p) @ strengths
        return result

    left_over = levels - design @ strengths
    unknowns = np.concatenate([design, slopes(modeled, fit.parameters, modeled(fit.parameters))], 1)
    found = texture_of(where, left_over, unknowns)
    half = cholesky(found.strength * np.exp(-cdist(where, where) / found.length) + np.eye(len(where)), lower=True)

    def whiten(columns: Floats) -> Floats:
        result: Floats = solve_triangular(half, columns, lower=True, check_finite=False)
        return result

    again = improve(shape, fit.parameters, where, levels, np.ones(len(where)), whiten)
    return (
        fit
        if again is None
        else fit._replace(parameters=again.parameters, point=again.point, covariance=again.covariance)
    )


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
    apart = [(cdist(middle, middle + shift), weight) for shift, weight in _PAIRS]
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
