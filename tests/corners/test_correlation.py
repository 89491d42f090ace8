"""Correlation of patches against NumPy's, and what only the ratios of weights may decide."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from kcal.corners.patches import RIVAL_DISTANCE, highest_peak, is_textured, weighted_correlation

DRAW = torch.Generator().manual_seed(6)


def random(*shape: int) -> Tensor:
    return torch.rand(*shape, generator=DRAW).double()


@pytest.mark.parametrize("scale", [1.0, 1e-3, 1e3])
def test_flat_where_it_counts(scale: float) -> None:
    """Contrast of one in a hundred thousand of the level is texture, of one in ten million is not."""
    template, weight = 100.0 + random(4, 5, 6), scale * random(4, 5, 6)
    template[1] = 100.0
    template[2] = 100.0 + 1e-3 * (template[2] - 100.0)
    template[3] = 100.0 + 1e-5 * (template[3] - 100.0)
    assert is_textured(template, weight).tolist() == [True, False, True, False]
    weight[0, 1:] = 0.0
    template[0, 0] = 100.0
    assert not bool(is_textured(template, weight)[0])
    assert not bool(is_textured(template, torch.zeros(4, 5, 6)).any())


@pytest.mark.parametrize("scale", [1.0, 1e-3])
def test_correlation_is_that_of_numpy(scale: float) -> None:
    """Of weighted values at every whole shift; brightness and contrast do not matter; not over what is unusable."""
    template, wide, weight = random(2, 4, 5), 50.0 + 9.0 * random(2, 6, 8), random(2, 4, 5)
    usable = torch.ones(2, 6, 8, dtype=torch.bool)
    usable[1, 5, 7] = False
    found = weighted_correlation(template, scale * weight, wide, usable)
    assert found.shape == (2, 3, 4)
    for k in range(2):
        for i in range(3):
            for j in range(4):
                part = wide[k, i : i + 4, j : j + 5].flatten().numpy()
                cov = np.cov(template[k].flatten().numpy(), part, aweights=weight[k].flatten().numpy())
                wanted = cov[0, 1] / np.sqrt(cov[0, 0] * cov[1, 1])
                assert float(found[k, i, j]) == pytest.approx(-1.0 if (k, i, j) == (1, 2, 3) else wanted)
    again = weighted_correlation(3.0 * template - 7.0, weight, 0.2 * wide + 30.0, usable)
    assert again == pytest.approx(found)
    assert weighted_correlation(torch.ones(2, 4, 5).double(), weight, wide, usable).tolist() == [[[-1.0] * 4] * 3] * 2
    # One place each, and one template for all.
    some = random(3, 4, 5)
    one = weighted_correlation(template[:1], weight[:1], some, torch.ones(3, 4, 5, dtype=torch.bool))
    for k in range(3):
        own = weighted_correlation(template[:1], weight[:1], some[k : k + 1], usable[:1, :4, :5])
        assert float(one[k]) == pytest.approx(float(own))


def test_the_highest_and_its_rival() -> None:
    """The rival is another peak, farther than three steps, not at the first or last column."""
    assert RIVAL_DISTANCE == 3.0
    places = torch.stack(torch.meshgrid(torch.arange(9.0), torch.arange(5.0), indexing="xy"), -1)
    scores = torch.zeros(1, 5, 9)
    scores[0, 1, 2] = 0.9
    for (row, column), value, rival in (
        ((1, 5), 0.7, 0.0),
        ((1, 6), 0.7, 0.7),
        ((4, 2), 0.7, 0.0),
        ((4, 3), 0.7, 0.7),
        ((1, 8), 0.7, 0.0),
        ((4, 0), 0.7, 0.0),
        ((3, 7), -0.1, 0.0),
    ):
        some = scores.clone()
        some[0, row, column] = value
        peak = highest_peak(some, places)
        assert int(peak.number) == 11
        assert peak.place.tolist() == [[2.0, 1.0]]
        assert float(peak.score) == pytest.approx(0.9)
        assert float(peak.rival) == pytest.approx(rival)
        assert not bool(peak.edge)
    # A slope is no peak.
    slope = torch.linspace(1.0, 0.0, 9).expand(1, 5, 9).clone()
    slope[0, 2, 1] = 2.0
    assert float(highest_peak(slope, places).rival) == -1.0
    for column in (0, 8):
        edge = torch.zeros(1, 5, 9)
        edge[0, 3, column] = 1.0
        assert bool(highest_peak(edge, places).edge)
