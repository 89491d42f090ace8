"""Errors that matches have in common do not count as independent."""

import math

import pytest
import torch

from kcal.scene import common_errors
from kcal.scene.common_errors import line_errors, with_common_errors
from tests.helpers.scene_pairs import SIZE, small_rig

RIG = small_rig()
SIGMA = 0.05
PATCH = 15.0


@pytest.fixture(autouse=True)
def small_patches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of which many fit into a small image without overlap."""
    monkeypatch.setattr(common_errors, "PATCH", PATCH)


def spread_places(step: float, sway: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Left pixels some way apart, and where the right camera sees these things, as the left one sways."""
    draw = torch.Generator().manual_seed(2)
    axes = [torch.arange(30.0, size - 30.0, step, dtype=torch.float64) for size in SIZE]
    left = torch.stack(torch.meshgrid(*axes, indexing="xy"), -1).reshape(-1, 2)
    ranges = 40.0 * 20.0 ** torch.rand(len(left), 1, dtype=torch.float64, generator=draw)
    seen = RIG.right.inside(RIG(ranges * RIG.left.unproject(left)[0])[0][:, 1])
    left, ranges = left[seen] + sway, ranges[seen]
    return left, RIG(ranges * RIG.left.unproject(left)[0])[0][:, 1]


def judged(
    places: list[tuple[torch.Tensor, torch.Tensor]],
    shared: torch.Tensor,
    own: float,
    share: torch.Tensor,
    draw: torch.Generator,
) -> list[torch.Tensor]:
    """Covariances (N, 2, 2) of the matches of each pair; the right marks err by what all share, and each by its own."""
    noise = (own * torch.randn(right.shape, dtype=torch.float64, generator=draw) for _, right in places)
    pixels = [torch.stack([left, right + shared + more], 1) for (left, right), more in zip(places, noise, strict=True)]
    stated = [(SIGMA**2 * torch.eye(2, dtype=torch.float64)).expand(len(shared), 2, 2)] * len(places)
    return with_common_errors([line_errors(RIG, one) for one in pixels], pixels, stated, [share] * len(places))


def counted(pairs: int, *, step: float = 16.0, own: float = SIGMA, common: float = 0.0, sway: float = 0.0) -> float:
    """Stated over counted information of the matches of some pairs, each error with a part that all pairs share."""
    draw = torch.Generator().manual_seed(3)
    places = [spread_places(step, k * sway) for k in range(pairs)]
    left, right = places[0]
    shared = common * torch.randn(right.shape, dtype=torch.float64, generator=draw)
    found = judged(places, shared, own, torch.zeros(len(left)).double(), draw)
    return sum(float((SIGMA**2 / one[:, 1, 1]).sum()) for one in found) / len(left)


def test_independent_errors_stay_as_they_are() -> None:
    assert counted(1) == pytest.approx(1.0, abs=0.2)
    assert counted(4) == pytest.approx(4.0, rel=0.15)


def test_repeated_errors_count_once() -> None:
    assert counted(4, own=0.0, common=SIGMA) == pytest.approx(1.0, rel=0.12)


@pytest.mark.parametrize("sway", [0.0, 1.3])
def test_errors_in_part_common(sway: float) -> None:
    # Of four pairs the mean has the common variance and a quarter of the other: 1 / (1 + 1/4) of one's information.
    assert counted(4, common=SIGMA, sway=sway) == pytest.approx(0.8, rel=0.15)


def test_errors_larger_than_noise_are_learned() -> None:
    assert counted(1, own=2.0 * SIGMA) == pytest.approx(0.25, rel=0.15)


def test_overlapping_patches() -> None:
    # Errors of neighbors are drawn alike here: half a patch apart, each counts (1 + 2/2)² as much in both directions.
    assert 0.25 < counted(1, step=PATCH / 2.0) < 0.33
    assert counted(1, step=2.0 * PATCH) > 0.85


def test_what_fits_in_part_is_judged_by_itself() -> None:
    """Half of the things repeat an error; without classes, all of them lost a part of what several pairs tell."""
    draw = torch.Generator().manual_seed(4)
    left, right = spread_places(16.0, 0.0)
    partly = torch.rand(len(left), generator=draw) < 0.5
    share = 0.8 - 0.2 * partly.double() + 0.01 * torch.rand(len(left), generator=draw)
    shared = torch.where(partly[:, None], 1.5 * SIGMA * torch.randn(right.shape, generator=draw), 0.0)
    found = torch.stack(judged([(left, right)] * 4, shared, SIGMA, share, draw))[..., 1, 1] / SIGMA**2
    plain, edges = ((1.0 / found[:, which]).sum(0).mean() for which in (~partly, partly))
    # Four times the information of one; and that of one with the variance 1.5² + 1/4.
    assert float(plain) == pytest.approx(4.0, rel=0.15)
    assert float(edges) == pytest.approx(1.0 / 2.5, rel=0.2)


def test_no_matches() -> None:
    nothing = torch.zeros(0, 2, 2, dtype=torch.float64)
    assert len(with_common_errors([line_errors(RIG, nothing)], [nothing], [nothing], [nothing[:, 0, 0]])[0]) == 0
    assert math.isfinite(counted(2, step=120.0))
