"""How a calibration is held against itself: which halves are compared, and what structure of residuals measures."""

import pytest
import torch
from calibrate_scenes import observe

from kcal.calibrate.camera.trust import _splits, residual_structure
from kcal.corners.board import Board

BOARD = Board(columns=9, rows=6, square=0.03)
SIZE = (640, 480)
VIEWS = 40
GENERATOR = torch.Generator().manual_seed(8)
NOISE = 0.3 * torch.randn(VIEWS, BOARD.corners, 2, dtype=torch.float64, generator=GENERATOR)
PIXELS = torch.rand(VIEWS, BOARD.corners, 2, dtype=torch.float64, generator=GENERATOR) * torch.tensor(SIZE)
SEEN = observe(PIXELS, board=BOARD, size=SIZE)


def test_halves_by_turns_and_by_order() -> None:
    names = [f"view{i}" for i in range(13)]
    (label, alike, (first, second)), (other, unlike, halves) = _splits(names)
    assert (label, alike, first, second) == ("every other view", True, names[::2], names[1::2])
    assert (other, unlike, halves) == ("first and second half", False, (names[:6], names[6:]))


def test_halves_by_the_beginning_of_names() -> None:
    """Where there are two kinds of names, and enough of each."""
    names = [f"day/morning_{i}" for i in range(6)] + [f"day/noon_{i}" for i in range(7)]
    assert _splits(names)[1] == ("images morning_… and noon_…", False, (names[:6], names[6:]))
    assert _splits(names[1:])[1][0] == "first and second half"
    assert _splits([*names, "evening_1"])[1][0] == "first and second half"


def structure(residuals: torch.Tensor) -> tuple[float, float, float]:
    return residual_structure(residuals, PIXELS, SIZE, SEEN)[:3]


def test_what_repeats_along_rows_is_a_correlation_of_neighbors() -> None:
    """The same in a whole row, independent between rows: 48 of 93 neighbors in each view are then alike."""
    grid = NOISE.unflatten(1, (BOARD.rows, BOARD.columns))
    alike = grid[:, :, :1].expand_as(grid).flatten(1, 2)
    # 240 rows of two numbers each know their mean square to 7 %, and the correlation between rows to 7 %.
    assert structure(alike)[2] == pytest.approx(48 / 93, abs=0.06)
    # With as much noise again, half of it.
    assert structure(alike + NOISE.flip(0))[2] == pytest.approx(24 / 93, abs=0.06)


def test_what_repeats_at_a_corner_or_in_a_place_is_told_in_units_of_noise() -> None:
    # As much at each corner of the board in all views as noise has: both together have twice the variance.
    image, board, _ = structure(NOISE + NOISE[:1])
    assert image == pytest.approx(1.0, abs=0.4)
    assert board == pytest.approx((VIEWS + 1) / 2, rel=0.15)
    # In a place of the image: 48 cells with 45 corners each.
    push = torch.where(PIXELS[..., :1] < 320, 0.3, -0.3).expand_as(NOISE)
    assert structure(NOISE + push)[0] == pytest.approx((45 + 1) / 2, rel=0.15)
    assert structure(NOISE)[:2] == pytest.approx((1.0, 1.0), abs=0.4)


def test_unseen_corners_count_nowhere() -> None:
    some = NOISE.clone()
    some[torch.rand(VIEWS, BOARD.corners, generator=GENERATOR) < 0.3] = torch.nan
    for value, expected in zip(structure(some), (1.0, 1.0, 0.0), strict=True):
        assert value == pytest.approx(expected, abs=0.4)
