"""Shapes before a texture: what it is, and errors that are as small and as large as stated."""

import math

import numpy as np
import pytest

from kcal.mark.shapes import SHAPES, ShapeFit, _fours, _likelihood, fit_before_texture, fit_shape, texture_of

AXIS = np.arange(-12.0, 13.0)
WHERE = np.stack([part.ravel() for part in np.meshgrid(AXIS, AXIS)], -1)
DISTANCE = np.hypot(*(WHERE[:, None] - WHERE).transpose(2, 0, 1))
WEDGE, _, _, BLOB, END = SHAPES
TRUE = {
    "wedge": (WEDGE, np.array([0.3, -0.2, 0.4, 0.4 + math.pi / 2, 1.0])),
    "blob": (BLOB, np.array([0.3, -0.2, 0.5, 3.0, 2.0, 1.5])),
    "end": (END, np.array([0.3, -0.2, 0.4, 4.0, 0.9])),
}


def textures(length: float, sigma: float, white: float, seed: int, count: int) -> np.ndarray:
    half = np.linalg.cholesky(sigma**2 * np.exp(-DISTANCE / length) + white**2 * np.eye(len(WHERE)))
    result: np.ndarray = half @ np.random.default_rng(seed).normal(size=(len(WHERE), count))
    return result


def test_means_of_four() -> None:
    where, columns = _fours(
        np.array([[-1.0, 0], [0, 0], [-1, 1], [0, 1], [1, 0]]), np.array([[1.0], [2], [3], [6], [9]])
    )
    np.testing.assert_allclose(where, [[-0.5, 0.5]])
    np.testing.assert_allclose(columns, [[3.0]])


def test_the_likelihood_is_that_of_what_no_unknown_explains() -> None:
    """The normal density of projections on a basis of the complement, its scale eliminated."""
    draw = np.random.default_rng(1)
    root = draw.normal(size=(9, 9))
    covariance, basis = root @ root.T + np.eye(9), np.linalg.qr(draw.normal(size=(9, 2)))[0]
    rest = np.linalg.svd(basis)[0][:, 2:]
    y = draw.normal(size=9)
    inner = rest.T @ covariance @ rest
    squares = (rest.T @ y) @ np.linalg.solve(inner, rest.T @ y)
    wanted = -0.5 * (7 * math.log(squares / 7) + np.linalg.slogdet(inner)[1])
    assert _likelihood(y, basis, covariance) == pytest.approx(wanted, rel=1e-12)


@pytest.mark.parametrize(("length", "strength"), [(2.0, 3.0), (18.0, 10.0), (6.0, 0.0)])
def test_the_texture_is_found(length: float, strength: float) -> None:
    unknowns = np.concatenate([np.ones((len(WHERE), 1)), WHERE / 12], 1)
    found = [texture_of(WHERE, draw, unknowns) for draw in textures(length, math.sqrt(strength), 1.0, 2, 12).T]
    if strength == 0:
        assert sum(texture.strength == 0 for texture in found) >= 10
    else:
        # Over the short distances of a window only the slope of the correlation at its start, strength over length,
        # is told well; the steps of the grid are factors of three.
        slope = np.median([texture.strength / texture.length for texture in found])
        assert 1 / 3.1 < slope / (strength / length) < 3.1


def fits(kind: str, length: float, sigma: float, count: int) -> list[tuple[ShapeFit, ShapeFit]]:
    shape, p = TRUE[kind]
    clean = shape.patterns(WHERE, p) @ np.array([60.0, 80.0])
    weight = np.exp(-0.5 * np.square(WHERE - p[:2]).sum(-1) / 7.5**2)
    seen = weight > 0.01
    result = []
    for noise in textures(length, sigma, 1.5, 5, count).T:
        first = fit_shape(shape, WHERE, clean + noise, weight, p[None] + 0.05)
        assert first is not None
        result.append((first, fit_before_texture(shape, first, WHERE[seen], (clean + noise)[seen])))
    return result


@pytest.mark.parametrize("kind", TRUE)
def test_before_a_texture_errors_are_smaller_and_as_large_as_stated(kind: str) -> None:
    pairs = fits(kind, 9.0, 4.0, 20)
    (before, after) = (np.array([fit.point for fit in some]) - [0.3, -0.2] for some in zip(*pairs, strict=True))
    assert np.square(after).mean() < 0.7 * np.square(before).mean()
    share = [float(d @ np.linalg.solve(pair[1].covariance, d)) for d, pair in zip(after, pairs, strict=True)]
    # Two degrees of freedom; the mean of 20 draws has a standard deviation of 0.45.
    assert 0.9 < float(np.mean(share)) < 3.2
    # What the shape explains, and how it compares with others, is said by the first fit.
    assert all((first.score, first.explained) == (final.score, final.explained) for first, final in pairs)


def test_without_a_texture_nothing_is_lost() -> None:
    pairs = fits("wedge", 9.0, 0.0, 10)
    (before, after) = (np.array([fit.point for fit in some]) - [0.3, -0.2] for some in zip(*pairs, strict=True))
    assert np.square(after).mean() < 1.3 * np.square(before).mean()
    sigma = [math.sqrt(np.trace(final.covariance) / np.trace(first.covariance)) for first, final in pairs]
    assert 0.5 < float(np.median(sigma)) < 1.1
