"""Put detected corners into the board's order, however the board was held."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.grid import as_grid, first_square_dark


def canonical_order(image: npt.NDArray[np.generic], pixels: Tensor, board: Board) -> Tensor:
    """Put a board's detected corners into the board's order.

    The order is never mirrored: seen from the front, x along a row to y down a column is a clockwise quarter turn in
    the image. The square diagonally outside corner 0 must be dark, by majority of neighboring squares. For boards with
    an odd sum of columns and rows this leaves one order. Other boards look the same after a turn by 180°; the order
    nearest to upright in the image is taken. It may differ between two cameras, so do not use such boards for stereo
    (`Board.unambiguous`).

    Args:
        image: (H, W) gray levels in which the corners were found.
        pixels: (corners, 2) in any of the board's eight orders; a board of other columns than rows has four.
        board: the board.

    Returns:
        The same corners, (corners, 2) float64, in the board's order.

    Raises:
        InputError: another number of corners than the board's.

    Example:
        >>> board = Board(columns=4, rows=3, square=0.1)
        >>> corners = board.points[:, :2] * 100 + 10  # squares of 10 px, corner 0 at (10, 10)
        >>> y, x = np.mgrid[:60, :60]
        >>> image = np.where((x // 10 + y // 10) % 2 == 0, 0, 255)
        >>> bool((canonical_order(image, corners.flip(0), board) == corners).all())
        True
    """
    grid = as_grid(pixels, board.columns, board.rows)
    if handedness(grid) < 0:
        grid = grid.flip(1)
    turns = [grid, grid.flip(0, 1)]
    if board.columns == board.rows:
        quarter = grid.transpose(0, 1).flip(1)
        turns += [quarter, quarter.flip(0, 1)]
    dark = [turn for turn in turns if first_square_dark(image, turn.reshape(-1, 2), board.columns, board.rows)[0]]
    return max(dark or turns, key=uprightness).reshape(-1, 2)


def handedness(grid: Tensor) -> float:
    """Positive where (x along rows, y down columns) turns clockwise in the image, as on a board seen from its front."""
    across = (grid[:, 1:] - grid[:, :-1]).nanmean((0, 1))
    down = (grid[1:] - grid[:-1]).nanmean((0, 1))
    return float(across[0] * down[1] - across[1] * down[0])


def uprightness(grid: Tensor) -> float:
    """2 for rows to the right and columns down, -2 for the opposite; a slight lean decides between quarter turns."""
    across = torch.nn.functional.normalize((grid[:, 1:] - grid[:, :-1]).nanmean((0, 1)), dim=0)
    down = torch.nn.functional.normalize((grid[1:] - grid[:-1]).nanmean((0, 1)), dim=0)
    lean = 1e-6 * float(across[1] - down[0])
    return float(across[0] + down[1]) + lean
