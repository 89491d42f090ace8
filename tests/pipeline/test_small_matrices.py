"""Small matrices with their number as the last axis: the same as torch's, matrix by matrix."""

from __future__ import annotations

import pytest
import torch

from kcal.pipeline.measurements import congruent, eliminate, outer, product, solved, squared


def lanes(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, 3, 5, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def stacked(value: torch.Tensor) -> torch.Tensor:
    """The same with the number of matrices first."""
    return value.movedim((-2, -1), (0, 1))


def test_products() -> None:
    first, second, square = lanes(4, 6), lanes(6, 2, seed=1), lanes(6, 6, seed=2)
    torch.testing.assert_close(stacked(product(first, second)), stacked(first) @ stacked(second))
    torch.testing.assert_close(stacked(squared(first)), stacked(first) @ stacked(first).mT)
    torch.testing.assert_close(stacked(congruent(first, square)), stacked(first) @ stacked(square) @ stacked(first).mT)
    rows, columns = lanes(4), lanes(6, seed=3)
    assert torch.equal(outer(rows, columns)[2, 5], rows[2] * columns[5])


@pytest.mark.parametrize("size", [1, 2, 4, 6])
def test_elimination_whatever_the_units(size: int) -> None:
    unit = torch.logspace(-9, 3, size, dtype=torch.float64)[:, None, None]
    matrix = squared(lanes(size, size + 2)) * unit[:, None] * unit
    columns = lanes(size, 3, seed=1) * unit[:, None]
    done = eliminate(matrix, columns)
    scale = unit[:, None]
    torch.testing.assert_close(solved(done) * scale, stacked_solution(matrix, columns, unit), rtol=1e-9, atol=1e-10)
    torch.testing.assert_close(done.pivots.log().sum(0), torch.linalg.slogdet(stacked(matrix))[1], rtol=1e-9, atol=1e-9)
    white = (done.columns.square() / done.pivots[:, None]).sum(0)
    expected = (columns * solved(done)).sum(0)
    torch.testing.assert_close(white, expected, rtol=1e-9, atol=0.0)


def stacked_solution(matrix: torch.Tensor, columns: torch.Tensor, unit: torch.Tensor) -> torch.Tensor:
    """By torch, in units in which all rows are alike; times `unit`."""
    scaled = torch.linalg.solve(stacked(matrix / unit[:, None] / unit), stacked(columns / unit[:, None]))
    return scaled.movedim((0, 1), (-2, -1))


def test_what_is_not_positive_gives_numbers_all_the_same() -> None:
    done = eliminate(torch.zeros(2, 2, 1, dtype=torch.float64), torch.zeros(2, 1, 1, dtype=torch.float64))
    assert bool((done.pivots > 0).all())
    assert bool(torch.isfinite(solved(done)).all())
