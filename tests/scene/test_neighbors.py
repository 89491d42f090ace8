"""The variance of a pose is what errors that neighbors share make it.

Errors that matches have in common do not count as independent.
"""

import math

import pytest
import torch
from torch import Tensor

from kcal.scene import common_errors
from kcal.scene.common_errors import LineErrors, line_errors, pose_variance_ratio, with_common_errors
from tests.helpers.scene_pairs import SIZE, drawn_pixels, small_rig

RIG = small_rig()
SIGMA = 0.05
COUNT = 600


def shared(pixels: Tensor, part: float, draw: torch.Generator) -> Tensor:
    """(M,) px: an error of its own for each square of a chessboard across the left image."""
    cell = (pixels[:, 0] / part).long()
    return torch.randn(1000, dtype=torch.float64, generator=draw)[cell[:, 0] + 30 * cell[:, 1]]


def lines_of(pixels: Tensor, error: Tensor) -> LineErrors:
    """Of matches with errors (M,) px downward."""
    return line_errors(RIG, pixels + error[:, None, None] * torch.tensor([[0.0, 0.0], [0.0, 1.0]]))


def ratio_of(lines: LineErrors, pixels: Tensor) -> float:
    covariance = (SIGMA**2 * torch.eye(2, dtype=torch.float64)).expand(len(pixels), 2, 2)
    return pose_variance_ratio([lines], [pixels], [covariance], SIZE)


def ratio(pixels: Tensor, error: Tensor) -> float:
    return ratio_of(lines_of(pixels, error), pixels)


def unbounded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ratios below one are to be seen, too."""
    monkeypatch.setattr(common_errors, "max", lambda _, found: found, raising=False)


def test_independent_errors(monkeypatch: pytest.MonkeyPatch) -> None:
    unbounded(monkeypatch)
    draw = torch.Generator().manual_seed(1)
    found = []
    for _ in range(60):
        pixels = drawn_pixels(draw, COUNT)
        found.append(ratio(pixels, SIGMA * torch.randn(len(pixels), dtype=torch.float64, generator=draw)))
    # Three standard errors of 60 ratios that scatter by 0.16.
    assert sum(found) / len(found) == pytest.approx(1.0, abs=0.065)


def test_errors_that_neighbors_share_count_as_they_act(monkeypatch: pytest.MonkeyPatch) -> None:
    unbounded(monkeypatch)
    draw = torch.Generator().manual_seed(2)
    pixels = drawn_pixels(draw, COUNT)
    covariance = (SIGMA**2 * torch.eye(2, dtype=torch.float64)).expand(len(pixels), 2, 2)
    lines = line_errors(RIG, pixels)
    slope = lines.slopes / lines.sigma(covariance)[:, None]
    stated = torch.linalg.inv(slope.T @ slope)
    found, poses = [], []
    for turn in range(400):
        noise = torch.randn(len(pixels), dtype=torch.float64, generator=draw)
        error = SIGMA * (noise + 0.6 * shared(pixels, 20.0, draw))
        # The slope of what a right pixel lower by one does, over its σ.
        poses.append(stated @ slope.T @ (error / SIGMA))
        if turn < 24:
            found.append(ratio(pixels, error))
    real = (torch.stack(poses).square().mean(0) / stated.diagonal()).mean()
    assert float(real) > 1.3
    assert sum(found) / len(found) == pytest.approx(float(real), rel=0.12)


def test_errors_of_lenses_are_no_errors_of_matches() -> None:
    draw = torch.Generator().manual_seed(3)
    pixels = drawn_pixels(draw, COUNT)
    noise = SIGMA * torch.randn(len(pixels), dtype=torch.float64, generator=draw)
    at = pixels[:, 0] / torch.tensor(SIZE) - 0.5
    smooth = 0.3 * (at[:, 0] ** 3 - 2.0 * at[:, 1] ** 2 * at[:, 0] + at[:, 1] ** 4)
    assert smooth.abs().max() > SIGMA
    assert ratio(pixels, noise + smooth) == pytest.approx(ratio(pixels, noise), abs=0.02)


def test_where_matches_leave_a_pose_open_there_is_no_ratio() -> None:
    draw = torch.Generator().manual_seed(8)
    pixels = drawn_pixels(draw, COUNT)
    noise = torch.randn(len(pixels), dtype=torch.float64, generator=draw)
    lines = lines_of(pixels, SIGMA * (noise + shared(pixels, 20.0, draw)))
    assert ratio_of(lines, pixels) > 1.5
    # Nothing tells of shifts.
    assert ratio_of(lines._replace(slopes=lines.slopes * torch.tensor([1.0, 1.0, 1.0, 0.0, 0.0])), pixels) == 1.0


def test_few_matches_and_wrong_ones() -> None:
    draw = torch.Generator().manual_seed(5)
    pixels = drawn_pixels(draw, COUNT)
    error = SIGMA * (torch.randn(COUNT, dtype=torch.float64, generator=draw) + shared(pixels, 20.0, draw))
    few = slice(0, 79)
    assert ratio(pixels[few], error[few]) == 1.0
    whole = ratio(pixels, error)
    assert whole > 1.5
    # More than five standard deviations off: not counted.
    wrong = torch.cat([error, torch.full((20,), 6.0 * SIGMA, dtype=torch.float64)])
    assert ratio(torch.cat([pixels, pixels[:20]]), wrong) == pytest.approx(whole, rel=1e-9)


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
