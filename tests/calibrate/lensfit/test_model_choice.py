"""Which model held-out groups prefer: paired differences, their standard error, and corners that a lens cannot show."""

from __future__ import annotations

import math

import pytest
import torch

from kcal.calibrate.lensfit.model_choice import Contender, choose, paired_difference, surely_worse


def contender(costs: list[float]) -> Contender:
    return Contender(name="", costs=torch.tensor(costs, dtype=torch.float64))


def test_the_preferred_one_within_chance() -> None:
    # The groups differ far more than the models do: paired, the richer one is 1.5 standard errors better.
    plain = contender([10.0, 40.0, 90.0, 20.0])
    rich = contender([9.0, 39.6, 90.4, 19.0])
    more, error = paired_difference(plain, rich)
    assert (more, round(error, 3)) == (pytest.approx(2.0), 1.327)
    assert choose([plain, rich]) is plain
    assert choose([rich, plain]) is rich


def test_the_richer_one_where_all_groups_agree() -> None:
    plain, rich = contender([10.0, 40.0, 90.0, 20.0]), contender([9.0, 38.9, 88.8, 19.1])
    assert surely_worse(plain, rich)
    assert not surely_worse(rich, plain)
    assert choose([plain, rich]) is rich


def test_a_corner_that_cannot_be_shown_decides() -> None:
    folds, shows = contender([1.0, math.inf, 1.0]), contender([5.0, 5.0, 5.0])
    assert surely_worse(folds, shows)
    assert choose([folds, shows]) is shows
    # Both fail: the rest is compared, and nothing becomes NaN.
    other = contender([1.0, 1.0, math.inf])
    more, error = paired_difference(folds, other)
    assert (more, error) == (0.0, math.inf)
    assert choose([other, folds]) is other


def test_chance_is_rarely_taken_for_evidence() -> None:
    generator = torch.Generator().manual_seed(0)
    wrong = 0
    for _ in range(400):
        noise = 10.0 + torch.randn(2, 20, dtype=torch.float64, generator=generator)
        wrong += surely_worse(*(Contender(name="", costs=one) for one in noise))
    # Two standard errors on one side: 2.3 % for Gaussian differences, some more as the error is estimated.
    assert 4 <= wrong <= 22
