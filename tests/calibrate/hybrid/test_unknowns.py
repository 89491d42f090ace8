"""Which parameters are one unknown, and that priors stand where these unknowns do."""

from __future__ import annotations

import torch

from kcal.calibrate.hybrid.fitted_views import hybrid_problem, hybrid_unknowns
from kcal.corners.board import Board
from kcal.lens.hybrid_terms import HybridForm
from kcal.lens.model import LensModel
from kcal.lens.zernike import ZernikeModes

MODEL = LensModel(hybrid=HybridForm(shape=0.5, radius=0.6, modes=ZernikeModes()))
SIZE = MODEL.size


def test_square_pixels_have_one_focal_length() -> None:
    """fx and fy are the first unknown; the principal point, the coefficients follow; a second focal length is last."""
    square, others = hybrid_unknowns(MODEL), hybrid_unknowns(MODEL, square=False)
    names = [0, 1, 2, 3, *range(5, 5 + SIZE)]  # without the skew
    assert list(square.indices) == list(others.indices) == names
    assert list(square.slots) == [0, 0, *range(1, 3 + SIZE)]
    assert list(others.slots) == [0, 3 + SIZE, *range(1, 3 + SIZE)]


def test_priors_are_of_the_unknowns_that_are_not_held() -> None:
    board = Board(columns=4, rows=3, square=0.1)
    shapes = torch.zeros(2, 3, board.corners, dtype=torch.float64)
    pixels = torch.zeros(1, board.corners, 2, dtype=torch.float64)
    count = 3 + SIZE + 2
    mean = torch.arange(count, dtype=torch.float64)
    precision = torch.full((count,), 4.0, dtype=torch.float64)
    precision[[1, -1]] = torch.inf
    problem = hybrid_problem(board.points, shapes, pixels, torch.ones(1, board.corners), MODEL, mean, precision)
    (prior,) = problem.terms
    # cx is held, and the last mode of the board.
    assert prior.index.tolist() == [0, 3, *range(5, 5 + SIZE), 5 + SIZE]  # type: ignore[attr-defined]
    assert prior.mean.tolist() == [0.0, *mean[2:-1].tolist()]  # type: ignore[attr-defined]
    assert prior.weight.tolist() == [2.0] * (count - 2)  # type: ignore[attr-defined]
