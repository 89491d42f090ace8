"""What a measured board says of itself, against straightforward fits to its corners; its sigmas by differences."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from torch import Tensor

from kcal.calibrate.hybrid.measured_board import MeasuredBoard, load_measured_board, save_measured_board
from kcal.corners.board import Board
from kcal.errors import InputError

BOARD = Board(columns=6, rows=9, square=0.02)
KINDS = ("bending", "stretch", "shear", "print_error")


def made(amplitudes: Tensor, spread: float = 1e-5) -> MeasuredBoard:
    half = spread * torch.randn(28, 28, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    return MeasuredBoard(name="plate", board=BOARD, amplitudes=amplitudes, half=half, log_evidence=5.0)


def drawn() -> Tensor:
    return 3e-5 * torch.randn(28, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def plane_part() -> tuple[Tensor, Tensor]:
    """A (3, 2) of the best affine map from the ordered to the measured corners in the plane, and what it leaves."""
    places = torch.cat([BOARD.points[:, :2], torch.ones(BOARD.corners, 1, dtype=torch.float64)], 1)
    found = made(drawn()).points
    affine = torch.linalg.lstsq(places, found).solution
    return affine, found - places @ affine


def test_values() -> None:
    board = made(drawn())
    affine, rest = plane_part()
    right, down = affine[0, :2], affine[1, :2]
    assert board.stretch.value == pytest.approx(float(right.norm() / down.norm()) - 1.0, abs=1e-6)
    assert board.shear.value == pytest.approx(float(right @ down / right.norm() / down.norm()), abs=1e-6)
    assert board.bending.value == pytest.approx(float(rest[:, 2].abs().max()), rel=1e-9)
    assert board.print_error.value == pytest.approx(float(rest[:, :2].square().sum(-1).mean().sqrt()), rel=1e-9)
    assert board.stretch.value != 0.0
    assert board.shear.value != 0.0


@pytest.mark.parametrize("kind", KINDS)
def test_sigmas(kind: str) -> None:
    """That of a function of the amplitudes, to first order."""

    def value(amplitudes: Tensor) -> float:
        return float(getattr(made(amplitudes), kind).value)

    slope = (
        torch.tensor([value(drawn() + step) - value(drawn() - step) for step in 1e-9 * torch.eye(28).double()]) / 2e-9
    )
    board = made(drawn(), 1e-7)
    assert getattr(board, kind).sigma == pytest.approx(float((board.half @ slope.double()).norm()), rel=1e-4)


def test_an_error_below_its_noise() -> None:
    """A board as it was ordered: its RMS has no slope, and its sigma is what noise alone would show."""
    board = made(torch.zeros(28, dtype=torch.float64))
    assert board.print_error.value == 0.0
    draws = torch.randn(100, 28, generator=torch.Generator().manual_seed(3), dtype=torch.float64) @ board.half
    shown = torch.tensor([made(draw).print_error.value for draw in draws])
    assert board.print_error.sigma == pytest.approx(float(shown.square().mean().sqrt()), rel=0.15)


def test_displacements() -> None:
    """No shift and no tilt is left in them; they are what an affine map leaves, and stretch and shear."""
    board = made(drawn())
    there = board.displacements()
    torch.testing.assert_close(board.displacements(BOARD.points), there)
    x, y = (BOARD.points[:, :2] - BOARD.points[:, :2].mean(0)).unbind(-1)
    u, v, w = there.unbind(-1)
    left = [u.sum(), v.sum(), w.sum(), (x * w).sum(), (y * w).sum()]
    assert max(abs(float(one)) for one in left) < 1e-12
    _, rest = plane_part()
    torch.testing.assert_close(w, rest[:, 2])
    stretch, shear = 0.5 * board.stretch.value, 0.5 * board.shear.value
    torch.testing.assert_close(u - rest[:, 0], stretch * x + shear * y, rtol=0, atol=1e-10)
    torch.testing.assert_close(v - rest[:, 1], shear * x - stretch * y, rtol=0, atol=1e-10)


def test_covariance_of_the_corners() -> None:
    board = made(drawn())
    slopes = torch.stack([made(step).points - BOARD.points for step in torch.eye(28, dtype=torch.float64)])
    spread = torch.einsum("rb,bnk->rnk", board.half, slopes)
    torch.testing.assert_close(board.points_covariance, torch.einsum("rnk,rnl->nkl", spread, spread))


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    size = torch.eye(28, dtype=torch.float64)
    for amplitudes, half in ((drawn()[:-1], size), (drawn(), size[:-1]), (drawn() / 0.0, size), (drawn(), size / 0.0)):
        with pytest.raises(InputError, match="measured board"):
            MeasuredBoard(name="plate", board=BOARD, amplitudes=amplitudes, half=half, log_evidence=0.0)
    with pytest.raises(InputError, match="the observations show another board"):
        made(drawn()).prior_for(BOARD.points + 1e-6)
    board = made(drawn())
    again = load_measured_board(save_measured_board(board, tmp_path / "board.json"))
    assert torch.equal(again.amplitudes, board.amplitudes)
    assert torch.equal(again.half, board.half)
    assert (again.name, again.board, again.log_evidence) == (board.name, board.board, 5.0)
