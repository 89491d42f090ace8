"""Square roots of information: covariances, priors, boards that are integrated out."""

from __future__ import annotations

import dataclasses
import math

import pytest
import torch

from kcal.errors import InputError
from kcal.lens.information import CameraInformation


def information(board: int = 2, scale: float = 1.0) -> CameraInformation:
    """Five unknowns of a camera of seven parameters, and some of a board."""
    generator = torch.Generator().manual_seed(1)
    count = 5 + board
    sigma = torch.full((count,), math.inf, dtype=torch.float64)
    sigma[3:] = torch.rand(count - 3, generator=generator, dtype=torch.float64) + 0.1
    units = scale ** torch.arange(count, dtype=torch.float64)
    return CameraInformation(
        slots=(0, 0, 1, 2, -1, 3, 4),
        estimate=torch.randn(count, generator=generator, dtype=torch.float64),
        rows=torch.randn(40, count, generator=generator, dtype=torch.float64) * units,
        residuals=torch.randn(40, generator=generator, dtype=torch.float64),
        mean=torch.zeros(count, dtype=torch.float64),
        sigma=sigma,
    )


def test_covariance_of_data_and_prior() -> None:
    """(RᵀR + 1/σ²)⁻¹, tied parameters alike and held ones zero."""
    known = information()
    inverse = torch.linalg.inv(known.rows.T @ known.rows + torch.diag(known.sigma**-2))
    torch.testing.assert_close(known.half().T @ known.half(), inverse, rtol=1e-12, atol=1e-14)
    found = known.covariance()
    assert found.shape == (7, 7)
    assert torch.equal(found[0], found[1])
    assert not found[4].any()
    torch.testing.assert_close(found[5, 2], inverse[3, 1], rtol=1e-11, atol=1e-14)


def test_without_board_is_the_marginal() -> None:
    """Integrating the board out leaves the camera's block of the covariance, and the pull of what is left."""
    known = information()
    alone = known.without_board()
    assert alone.board_size == 0
    torch.testing.assert_close(alone.covariance(), known.covariance(), rtol=1e-11, atol=1e-14)
    # The same best camera: the step to the minimum of everything is that of the camera alone.
    whole, part = known.whole.rows, alone.whole.rows
    step = torch.linalg.lstsq(whole[:, :-1], -whole[:, -1:]).solution[:5]
    torch.testing.assert_close(torch.linalg.lstsq(part[:, :-1], -part[:, -1:]).solution, step, rtol=1e-11, atol=1e-12)


def test_rows_are_those_of_its_parts() -> None:
    """Data, priors and what others say, in the order of the unknowns, with residuals at the estimate."""
    known = dataclasses.replace(information(), others=torch.ones(1, 3, dtype=torch.float64))
    assert torch.equal(known.data.rows, torch.cat([known.rows, known.residuals[:, None]], 1))
    pull = (known.estimate - known.mean) / known.sigma
    slots = known.data.slots
    for prior, own in ((known.lens_prior, [3, 4]), (known.board_prior, [5, 6])):
        rows = prior.placed(slots, known.estimate).rows
        assert torch.equal(rows[:, own], torch.diag(1.0 / known.sigma[own]))
        torch.testing.assert_close(rows[:, -1], pull[own])
    assert known.told.placed(slots, known.estimate).rows[-1].tolist() == [0.0] * 5 + [1.0] * 3
    torch.testing.assert_close(known.data.compressed().products[:-1], known.data.products[:-1])
    assert known.whole.rows.shape == (40 + 2 + 2 + 1, 8)


def test_from_covariance_and_back() -> None:
    """Parameters without variance are held; the rest comes back."""
    root = torch.randn(5, 7, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    matrix = root.T @ root + 0.1 * torch.eye(7).double()
    matrix[3], matrix[:, 3] = 0.0, 0.0
    found = CameraInformation.from_covariance(torch.arange(7.0), matrix)
    assert found.slots == (0, 1, 2, -1, 3, 4, 5)
    torch.testing.assert_close(found.covariance(), matrix, rtol=1e-11, atol=1e-13)


def test_refused() -> None:
    """Shapes and values that cannot be."""
    known = information()
    for change in ({"mean": known.mean[:3]}, {"sigma": -known.sigma}, {"residuals": known.residuals * math.nan}):
        fields = {name: getattr(known, name) for name in ("slots", "estimate", "rows", "residuals", "mean", "sigma")}
        with pytest.raises(InputError, match="information"):
            CameraInformation(**fields | change)
    with pytest.raises(InputError, match="finite"):
        CameraInformation.from_covariance(torch.ones(2), torch.full((2, 2), math.nan).double())
