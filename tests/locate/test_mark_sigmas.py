"""Standard deviations of marks: those that are stated, those that are assumed, and none without a mark."""

import math

import pytest
import torch

from kcal.locate.marks import Marks

NONE = [math.nan, math.nan]


def marks(covariance: torch.Tensor | None) -> Marks:
    left = torch.tensor([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]], dtype=torch.float64)
    right = torch.tensor([[1.0, 2.0], NONE, [5.0, 6.0]], dtype=torch.float64)
    return Marks.of_pair(("a", "b", "c"), left, right, covariance)


def stated() -> torch.Tensor:
    found = torch.full((3, 4, 4), torch.nan, dtype=torch.float64)
    found[0] = torch.diag(torch.tensor([0.04, 0.12, 1e-6, 1e-6]).double())
    return found


def test_a_mark_has_the_mean_variance_of_its_axes() -> None:
    found = marks(stated()).sigmas(0.3)
    # No mark is better than a twentieth of a pixel.
    assert found[0].tolist() == pytest.approx([math.sqrt(0.08), 0.05])
    assert found[1].tolist() == pytest.approx([0.3, math.nan], nan_ok=True)
    assert found[2].tolist() == pytest.approx([0.3, 0.3])
    assert marks(None).sigmas(0.3).tolist()[0] == pytest.approx([0.3, 0.3])


def test_the_typical_sigma_is_the_median_of_the_marks_that_are_there() -> None:
    vague = torch.full((3, 4, 4), torch.nan, dtype=torch.float64)
    vague[0] = torch.diag(torch.tensor([9.0, 9.0, 4.0, 4.0]).double())
    assert marks(vague).typical_sigma(0.3) == 0.3
    assert marks(stated()).typical_sigma(0.1) == pytest.approx(0.1)
    assert marks(stated()).typical_sigma(0.01) == pytest.approx(0.01)
    assert Marks.of_pair(("a",), torch.tensor([NONE]), torch.tensor([NONE]), None).typical_sigma(0.3) == 0.3


def test_covariances_are_filled_pair_by_pair() -> None:
    assert marks(None).covariance_or(0.3) is None
    found = marks(stated()).covariance_or(0.3)
    assert torch.equal(found[0], stated()[0])
    torch.testing.assert_close(found[1], 0.09 * torch.eye(4, dtype=torch.float64))
    half = stated()
    half[0, 0, 1] = torch.nan
    found = marks(half).covariance_or(0.3)
    torch.testing.assert_close(found[0], 0.09 * torch.eye(4, dtype=torch.float64))
