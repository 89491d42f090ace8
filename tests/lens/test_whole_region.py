"""The inverse over whole valid regions and images of many random lenses: a small run of `scripts/check/folds.py`."""

import pytest
import torch

from kcal.lens.inverse import undistort
from scripts.check import folds
from scripts.shared.distorted import distort


@pytest.mark.slow
def test_random_lenses() -> None:
    tally = folds.sweep(lenses=320, seed=1, points=100)
    assert tally.points > 20_000
    assert tally.valid > 15_000
    assert (tally.lost, tally.elsewhere, tally.wrong) == (0, 0, 0)
    assert tally.worst < 1e-9


# A tilted, decentered lens found by the sweep.
BENT = [
    0.008283487628948559, -0.1761725765383967, 0.22356479586426953, 0.07462202349038814, -0.06215175012836545,
    0.005180133590947832, 0.020311540980875634, 0.1005421132347756, -0.15451424842339886, -0.14166261245059308,
    -0.0382862325484119, -0.021142276158130732, 0.06581837466973582, -0.18087748902908354,
]  # fmt: skip


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_a_fold_between_a_point_and_its_neighbors(mirror: float) -> None:
    """Where the valid region is not convex, a solver that only goes downhill stops at the fold."""
    lens = torch.tensor(BENT, dtype=torch.float64)
    lens[[3, 8, 9, 13]] *= mirror  # p2, s1, s2, tau_y
    point = torch.tensor([[-0.8729470388356101 * mirror, 0.858102771526305]], dtype=torch.float64)
    back, valid = undistort(distort(point, lens, "opencv14"), lens, "opencv14")
    assert valid.tolist() == [True]
    # The lens is flattened 150 to 1 there: 1e-13 becomes 1.5e-11.
    torch.testing.assert_close(back, point, rtol=0, atol=1e-10)
