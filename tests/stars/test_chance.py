"""How probable it is that chance explains matches: what proves a name."""

from __future__ import annotations

import numpy as np
import pytest

from kcal.stars.sky import _by_chance


def test_three_matches_are_those_of_the_triangle() -> None:
    every = np.ones(6, bool)
    # Three sizes are tried; all of six are met, three of them by chance.
    assert _by_chance(every, 0.1) == pytest.approx(3 * 0.1**3)
    assert _by_chance(every[:4], 0.1) == pytest.approx(0.1)
    # One of four met beyond the triangle: that is the best that there is.
    fainter = np.array([True, True, True, True, False, False])
    assert _by_chance(fainter, 0.1) == pytest.approx(3 * 0.1)
    assert _by_chance(~every, 0.1) == pytest.approx(3.0)
    # Of five, two by chance, the first is not met: 1 - (1 - p)^1 at four, then the other sizes.
    late = np.array([False, True, True, True, True])
    assert _by_chance(late, 0.1) == pytest.approx(2 * (1 - 0.9**2))
