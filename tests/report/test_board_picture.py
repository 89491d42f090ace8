"""The picture of a measured board."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.quiver import Quiver

from kcal.calibrate.hybrid.measured_board import MeasuredBoard
from kcal.corners.board import Board
from kcal.errors import InputError
from kcal.report.calibration import board_figure, board_text
from kcal.report.figures import save_picture


def bent_board(scale: float) -> MeasuredBoard:
    amplitudes = torch.zeros(28, dtype=torch.float64)
    amplitudes[1], amplitudes[12] = scale, scale
    half = 1e-5 * torch.eye(28, dtype=torch.float64)
    board = Board(columns=6, rows=9, square=0.02)
    return MeasuredBoard(name="plate", board=board, amplitudes=amplitudes, half=half, log_evidence=0.0)


def test_heights_and_arrows() -> None:
    """The second mode is a saddle: corners of opposite heights; stretch moves the corners left and right."""
    figure = board_figure(bent_board(2e-4))
    axes = figure.axes[0]
    assert "plate: 6x9 inner corners" in figure.texts[0].get_text()
    assert "bending 0.200 ± 0.0" in figure.texts[0].get_text()
    levels = axes.collections[0].norm
    assert 0.2 <= float(levels.vmax) < 0.3
    assert float(levels.vmin) == -float(levels.vmax)
    (arrows,) = [part for part in axes.collections if isinstance(part, Quiver)]
    assert arrows.N == 54
    across, down = np.array(arrows.U), np.array(arrows.V)
    x = 1e3 * bent_board(0.0).board.points[:, 0].numpy()
    np.testing.assert_array_equal(np.sign(np.round(across, 9)), np.sign(x - x.mean()))
    # Nothing longer than the distance of the corners, 20 mm.
    assert 8.0 < float(np.hypot(across, down).max()) <= 20.0


def test_text_of_a_flat_board() -> None:
    lines = board_text(bent_board(0.0))
    assert lines[0].startswith("bending 0.000 ± 0.0")
    assert [line.split()[0] for line in lines] == ["bending", "stretch", "shear", "print"]


def test_file(tmp_path: Path) -> None:
    path = save_picture(tmp_path / "board.png", board_figure(bent_board(0.0)))
    assert path.read_bytes()[:4] == b"\x89PNG"
    with pytest.raises(InputError, match=r"must end with \.png"):
        save_picture(tmp_path / "board.jpg", board_figure(bent_board(0.0)))
