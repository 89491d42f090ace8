"""The mean square of an amplitude, over what views leave of it, is the variance of modes that they do not tell."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from scipy import integrate

from kcal.calibrate.hybrid.evidence import expected_amplitudes

WIDE: list[tuple[float, float | None]] = [(-12.0, 12.0), (-12.0, 12.0), (-40.0, None)]


Loss = Callable[[np.ndarray], tuple[float, np.ndarray]]


def bend(loss: Loss, at: np.ndarray) -> np.ndarray:
    """The Hessian."""
    steps = 1e-4 * np.eye(len(at))
    return np.stack([loss(at + step)[1] - loss(at - step)[1] for step in steps]) / 2e-4


def weights_seen(sizes: list[float], sigma: float) -> Loss:
    """-ln p of ln A where modes of weights ~ N(0, A²) were each seen with an error of σ, under a broad prior."""
    squares = float(np.square(sizes).sum())

    def loss(v: np.ndarray) -> tuple[float, np.ndarray]:
        variance = math.exp(2.0 * v[0]) + sigma**2
        value = 0.5 * (len(sizes) * math.log(variance) + squares / variance) + 0.5 * float(v @ v) / 4.0
        slope = v / 4.0
        slope[0] += math.exp(2.0 * v[0]) * (len(sizes) / variance - squares / variance**2)
        return value, slope

    return loss


def values_of(loss: Loss) -> Callable[[np.ndarray], np.ndarray]:
    return lambda many: np.array([loss(v)[0] for v in many])


def smallest(loss: Loss) -> np.ndarray:
    places = np.linspace(-8.0, 4.0, 4001)
    best = min(places, key=lambda x: loss(np.array([x, 0.0, 0.0]))[0])
    return np.array([best, 0.0, 0.0])


@pytest.mark.parametrize("sizes", [[1.0, -0.8, 1.2, 0.7, -1.1], [0.3, -0.1, 0.2], [0.01, 0.02]])
def test_mean_square_is_that_of_the_integral(sizes: list[float]) -> None:
    """Where the amplitude is well determined, where it is not, and where nothing but an upper bound is known."""
    loss = weights_seen(sizes, 0.2)
    at = smallest(loss)
    found = expected_amplitudes(bend(loss, at), values_of(loss), at, [0], WIDE)

    def density(x: float, power: float) -> float:
        return math.exp(loss(at)[0] - loss(np.array([x, 0.0, 0.0]))[0] + power * x)

    total, square = (integrate.quad(density, -12.0, 8.0, args=(p,), limit=200)[0] for p in (0.0, 2.0))
    # Nine places along a skewed density: the smallest case is the widest.
    assert found[0] == pytest.approx(0.5 * math.log(square / total), abs=0.15)
    assert found[0] > at[0]
    assert found[1:].tolist() == at[1:].tolist()


def test_others_follow() -> None:
    """Two amplitudes of which only the sum of the logarithms is known well: the trial of one takes the other along."""
    precision = np.linalg.inv(np.array([[1.0, -0.9], [-0.9, 1.0]]))

    def loss(v: np.ndarray) -> tuple[float, np.ndarray]:
        return 0.5 * float(v @ precision @ v), precision @ v

    found = expected_amplitudes(precision, values_of(loss), np.zeros(2), [0, 1], WIDE[:2])
    # ln A has a variance of 1 each: ½ ln <A²> = 1.
    assert found == pytest.approx([1.0, 1.0], abs=0.02)


def test_bounds_hold() -> None:
    loss = weights_seen([0.01, 0.02], 0.2)
    at = smallest(loss)
    top = float(at[0]) + 0.4
    found = expected_amplitudes(bend(loss, at), values_of(loss), at, [0], [(-12.0, top), *WIDE[1:]])
    assert at[0] - 1.0 < found[0] <= top
