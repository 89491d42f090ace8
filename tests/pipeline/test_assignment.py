"""Matches are accepted as exhaustive search would: as many as possible, and then the likeliest."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from kcal.pipeline.assignment import Candidates, Scores, assigned
from kcal.pipeline.measurements import Anchored


def candidates(track: list[int], pair: list[int], density: list[float]) -> Candidates:
    none = torch.zeros(0)
    scores = Scores(Anchored(*[none] * 5), *[none] * 4, torch.tensor(density, dtype=torch.float64))
    return Candidates(torch.tensor(track), torch.tensor(pair), scores)


@pytest.mark.parametrize("seed", range(20))
def test_the_best_of_all(seed: int) -> None:
    random = np.random.default_rng(seed)
    every = list(itertools.product(range(3), range(4)))
    chosen = [every[i] for i in random.choice(len(every), random.integers(1, 8), replace=False)]
    density = random.normal(0.0, 5.0, len(chosen)).tolist()
    possible = candidates(*(list(column) for column in zip(*chosen, strict=True)), density)
    # Every pair has marks of its own.
    found = assigned(possible, [{(0, i), (1, i)} for i in range(4)], [0.0] * 3, [0] * 3)

    def is_valid(rows: tuple[int, ...]) -> bool:
        return all(len({chosen[i][end] for i in rows}) == len(rows) for end in (0, 1))

    subsets = [rows for n in range(len(chosen) + 1) for rows in itertools.combinations(range(len(chosen)), n)]
    best = max(filter(is_valid, subsets), key=lambda rows: (len(rows), sum(density[i] for i in rows)))
    assert sorted(found) == sorted(best)


def test_a_mark_goes_to_the_track_of_more_evidence() -> None:
    """Two tracks, each with its own pair; the pairs share their left mark."""
    marks = [{(0, 0), (1, 0)}, {(0, 0), (1, 1)}]
    possible = candidates([0, 1], [0, 1], [-1.0, -2.0])
    assert assigned(possible, marks, [0.0, 0.0], [0, 0]) == [0]
    assert assigned(possible, marks, [0.0, 10.0], [0, 0]) == [1]


def test_confirmed_tracks_choose_first_and_lost_ones_not_at_all() -> None:
    marks = [{(0, 0), (1, 0)}]
    possible = candidates([0, 1, 2], [0, 0, 0], [-9.0, -1.0, 0.0])
    assert assigned(possible, marks, [0.0] * 3, [0, 1, -1]) == [0]
    assert assigned(possible, marks, [0.0] * 3, [1, 1, -1]) == [1]
    assert assigned(possible, marks, [0.0] * 3, [-1, -1, -1]) == []
