"""Files of measured boards: lossless, and refused where they do not fit; what a board says of itself."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from kcal.calibrate.hybrid.board_modes import BENDING, board_modes
from kcal.calibrate.hybrid.measured_board import MeasuredBoard, load_measured_board, save_measured_board
from kcal.corners.board import Board
from kcal.errors import FileError, InputError

BOARD = Board(columns=9, rows=6, square=0.025)


def awkward_board(scale: float = 1e-4) -> MeasuredBoard:
    generator = torch.Generator().manual_seed(5)
    amplitudes = scale * torch.randn(28, generator=generator, dtype=torch.float64)
    half = 1e-6 * torch.randn(28, 28, generator=generator, dtype=torch.float64)
    return MeasuredBoard(
        name="π",
        board=BOARD,
        amplitudes=amplitudes,
        half=half,
        log_evidence=1.0 / 3.0,
        observations=("left", "right"),
    )


def test_file_is_lossless(tmp_path: Path) -> None:
    board = awkward_board()
    read = load_measured_board(save_measured_board(board, tmp_path / "x.board.json"))
    assert (read.name, read.board, read.log_evidence, read.observations) == ("π", BOARD, 1.0 / 3.0, ("left", "right"))
    for ours, theirs in ((board.amplitudes, read.amplitudes), (board.half, read.half), (board.points, read.points)):
        torch.testing.assert_close(ours, theirs, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"kcal": "rig"}, "this is a kcal rig file"),
        ({"version": 2}, "version 2 of the board format"),
        ({"amplitudes": [0.0] * 27, "half": [[0.0] * 27] * 28}, "28 amplitudes"),
        ({"half": [[0.0] * 28] * 27}, "28 x 28"),
        ({"half": [[0.0] * 27] * 28}, "as many columns"),
        ({"amplitudes": ["x"] * 28}, "amplitudes"),
        ({"board": {"columns": 1, "rows": 6, "square": 0.025}}, "columns"),
    ],
)
def test_bad_files_are_refused(tmp_path: Path, change: dict[str, Any], complaint: str) -> None:
    path = save_measured_board(awkward_board(), tmp_path / "x.board.json")
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | change), encoding="utf-8")
    with pytest.raises(FileError, match=complaint):
        load_measured_board(path)


def test_values_that_are_not_finite() -> None:
    with pytest.raises(InputError, match="finite"):
        MeasuredBoard(
            name="",
            board=BOARD,
            amplitudes=torch.full((28,), math.nan, dtype=torch.float64),
            half=torch.eye(28, dtype=torch.float64),
            log_evidence=0.0,
        )


def test_summary() -> None:
    """Numbers of a board that is stretched, sheared and bent by known amounts, whose amplitudes have one sigma."""
    modes = board_modes(BOARD.points)
    x, y, _ = (BOARD.points - BOARD.points.mean(0)).T
    # Width over height 1.001; rows and columns at a cosine of 5e-4; a saddle of .2 mm at the corners.
    wanted = torch.stack([1e-3 * x + 5e-4 * y, torch.zeros_like(x), 2e-4 * x * y / (x * y).abs().max()], 1)
    amplitudes = torch.linalg.lstsq(modes.shapes.flatten(1).T, wanted.T.flatten()).solution
    half = 1e-5 * torch.eye(28, dtype=torch.float64)
    board = MeasuredBoard(name="a", board=BOARD, amplitudes=amplitudes, half=half, log_evidence=0.0)
    torch.testing.assert_close(board.points - BOARD.points, wanted, rtol=0, atol=1e-12)
    assert board.stretch.value == pytest.approx(1e-3, rel=1e-9)
    assert board.shear.value == pytest.approx(5e-4, rel=1e-9)
    assert board.bending.value == pytest.approx(2e-4, rel=1e-9)
    assert board.print_error.value == pytest.approx(0.0, abs=1e-12)
    # Twelve modes of one sigma, nearly one each at the corner of the board.
    assert 2e-5 < board.bending.sigma < 4e-5
    assert 1e-5 < board.print_error.sigma < 3e-5
    heights = torch.einsum("bn,bn->n", *(2 * [1e-5 * modes.shapes[modes.family == BENDING][:, 2]]))
    torch.testing.assert_close(board.points_covariance[:, 2, 2], heights)
    # Displacements are those of the corners, off what cameras cannot tell: half of the stretch each way.
    moved = torch.stack([5e-4 * x + 2.5e-4 * y, 2.5e-4 * x - 5e-4 * y, wanted[:, 2]], 1)
    torch.testing.assert_close(board.displacements(), moved, rtol=0, atol=1e-12)
    torch.testing.assert_close(board.displacements(BOARD.points[5:9]), moved[5:9], rtol=0, atol=1e-12)


def test_sigmas_of_the_summary() -> None:
    """Over draws of the amplitudes, the numbers scatter by their sigmas."""
    board = awkward_board()
    generator = torch.Generator().manual_seed(6)
    names = ("bending", "stretch", "shear", "print_error")
    draws = []
    for _ in range(200):
        amplitudes = board.amplitudes + torch.randn(28, generator=generator, dtype=torch.float64) @ board.half
        other = MeasuredBoard(name="", board=BOARD, amplitudes=amplitudes, half=board.half, log_evidence=0.0)
        draws.append([getattr(other, name).value for name in names])
    sigma = torch.tensor([getattr(board, name).sigma for name in names])
    torch.testing.assert_close(torch.tensor(draws).std(0), sigma, rtol=0.2, atol=0)
