"""The variance of a pose is what errors that neighbors share make it."""

import pytest
import torch
from torch import Tensor

from kcal.scene import common_errors
from kcal.scene.common_errors import LineErrors, line_errors, pose_variance_ratio
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
