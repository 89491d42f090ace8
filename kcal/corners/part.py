"""Find a part of a checkerboard, where it is certain which part it is.

A grid of corners is grown from the largest one that OpenCV finds, over what glare or a shadow left out. Its place in
the board follows from the board's ends, beyond which squares no longer alternate, and from which squares are dark.
Where several places remain possible, there is no result: a wrong place would be a wrong lens.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.grid import in_image, sides
from kcal.corners.grid_check import (
    MIN_OUTER,
    levels_beside,
    skips,
    step_along,
    uneven,
    without_false_sides,
)
from kcal.corners.grow import checkered, grown_grid, local_steps
from kcal.corners.order import handedness, uprightness

MIN_CORNERS = 12
MIN_FILLED = 0.5  # share of the places of the grown grid at which corners were found
MIN_LINES = 3  # each way
MIN_END, MIN_END_SHARE = 3, 0.8  # corners that must show the board's end on one side, and their share
OUTER_SQUARE = 0.5  # of its contrast at the corner that the outer square must have up to the board's end


class BoardPart(NamedTuple):
    """A part of a board, or why there is none.

    Args:
        pixels: (corners, 2), NaN outside the part; None if there is none.
        reason: why.
        rejected: (N, 2) corners found.
        other: whether they are certainly those of another board.
    """

    pixels: Tensor | None
    reason: str = ""
    rejected: Tensor | None = None
    other: bool = False


def find_part(image: npt.NDArray[np.uint8], board: Board, seeds: Iterable[Tensor]) -> BoardPart:
    """Find the visible corners of a board that is cut by the image's edge, covered or glaring in places.

    Args:
        image: (H, W) uint8.
        board: the board.
        seeds: grids of corners (rows, columns, 2) in the image, such as detectors find; they are tried in turn.

    Returns:
        The corners; without a reason if there is no grid at all.
    """
    best = BoardPart(None)
    for seed in seeds:
        whole = without_false_sides(image, seed)
        if whole is None or uneven(image, whole) is not None:
            continue
        if skips(image, whole.reshape(-1, 2), whole.shape[1], whole.shape[0]):
            continue
        part = _grown(image, whole.flip(1) if handedness(whole) < 0 else whole, board)
        if part.pixels is not None:
            return part
        if best.rejected is None or (part.rejected is not None and len(part.rejected) > len(best.rejected)):
            best = part
    return best


def _grown(image: npt.NDArray[np.uint8], seed: Tensor, board: Board) -> BoardPart:
    """The part of the board that grows from a seed."""
    longer, shorter = max(board.columns, board.rows), min(board.columns, board.rows)
    grid = grown_grid(image, seed, longer + 1)
    known = torch.isfinite(grid).all(-1)
    seen = grid[known]
    high, wide = grid.shape[:2]
    if len(seen) < max(MIN_CORNERS, MIN_FILLED * known.numel()) or min(high, wide) < MIN_LINES:
        return BoardPart(None)
    asked, size = f"{board.columns}x{board.rows}", f"{max(high, wide)}x{min(high, wide)}"
    ends = board_ends(image, grid)
    if all(ends) and (max(high, wide), min(high, wide)) != (longer, shorter):
        return BoardPart(
            None, f"a board of {size} inner corners was found, not {asked}: give --board {size}", seen, True
        )
    if max(high, wide) > longer or min(high, wide) > shorter:
        return BoardPart(None, f"a grid of {size} inner corners was found, larger than {asked}", seen, other=True)
    places = _placements(image, grid, ends, board)
    if not places:
        return BoardPart(None, f"a grid of {size} inner corners was found, which is no part of {asked}", seen)
    if len(places) > _symmetries(board) or not _is_anchored(image, grid, ends):
        where = _hidden_sides(image, grid, ends)
        return BoardPart(
            None,
            f"{len(seen)} of {board.corners} corners found, but not which ones: {where}; show two sides that meet",
            seen,
        )
    return BoardPart(max(places, key=uprightness).reshape(-1, 2))


def _is_anchored(image: npt.NDArray[np.uint8], grid: Tensor, ends: tuple[bool, bool, bool, bool]) -> bool:
    """Whether both ends of the board are visible in each direction, or one of them with paper beyond."""
    sure = board_ends(image, grid, paper=True)
    return all((ends[i] and ends[i + 1]) or sure[i] or sure[i + 1] for i in (0, 2))


def board_ends(image: npt.NDArray[np.generic], grid: Tensor, paper: bool = False) -> tuple[bool, bool, bool, bool]:
    """At which sides (top, bottom, left, right) of a grid (rows, columns, 2) the board's end is visible.

    The outer squares must alternate up to one step outside the outer corners, and nothing may alternate beyond. With
    `paper` it must be light there as well: what covers a board along a straight line seldom is.
    """
    top, bottom, left, right = (_is_end(image, side, paper) for side in sides(grid))
    return top, bottom, left, right


def _is_end(image: npt.NDArray[np.generic], grid: Tensor, paper: bool) -> bool:
    beyond, out, along = _next_line(grid)
    own, inner, outer = (
        step_along(image, places, along, down) for places, down in ((grid[0], out), (beyond, -out), (beyond, out))
    )
    usable = in_image(image, beyond + 0.5 * out) & torch.isfinite(own + inner + outer)
    ends = (inner / own > OUTER_SQUARE) & (outer.abs() < MIN_OUTER * inner.abs())
    if paper:
        square, ground = (levels_beside(image, beyond, along, down) for down in (-out, out))
        ends &= ground.amin(0) > square.mean(0)
    count = int(usable.sum())
    return count >= MIN_END and int((ends & usable).sum()) >= MIN_END_SHARE * count


def _next_line(grid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Where the next line above the first would be (columns, 2), the step to it, and the step along it."""
    along = local_steps(grid)[0][0]
    beyond = 3 * grid[0] - 3 * grid[1] + grid[2]
    beyond = torch.where(torch.isfinite(beyond), beyond, 2 * grid[0] - grid[1])
    return beyond, beyond - grid[0], along


def _placements(
    image: npt.NDArray[np.generic], grid: Tensor, ends: tuple[bool, bool, bool, bool], board: Board
) -> list[Tensor]:
    """All boards (rows, columns, 2) of which the grid can be a part, NaN outside it."""
    places = []
    top, bottom, left, right = ends
    for _ in range(4):
        high, wide = grid.shape[:2]
        along, down = local_steps(grid)
        lighter = (step_along(image, grid, along, down) - step_along(image, grid, along, -down)) * checkered(grid)
        dark = bool(lighter.nanmedian() < 0)  # the square diagonally outside the grid's first corner
        for row in range(board.rows - high + 1):
            for column in range(board.columns - wide + 1):
                fits = (not top or row == 0) and (not bottom or row + high == board.rows)
                fits = fits and (not left or column == 0) and (not right or column + wide == board.columns)
                if fits and dark == ((row + column) % 2 == 0):
                    whole = torch.full((board.rows, board.columns, 2), torch.nan, dtype=torch.float64)
                    whole[row : row + high, column : column + wide] = grid
                    places.append(whole)
        grid = grid.transpose(0, 1).flip(1)
        top, bottom, left, right = left, right, bottom, top
    return places


def _symmetries(board: Board) -> int:
    """Turns after which the board looks the same."""
    if (board.columns + board.rows) % 2:
        return 1
    return 4 if board.columns == board.rows and board.columns % 2 == 0 else 2


def _hidden_sides(image: npt.NDArray[np.generic], grid: Tensor, ends: tuple[bool, bool, bool, bool]) -> str:
    """Where in the image the board's end is not visible, in words."""
    middle = grid.nanmean((0, 1))
    cut: list[str] = []
    unclear: list[str] = []
    for side, end in zip(sides(grid), ends, strict=True):
        if end:
            continue
        beyond, out, _ = _next_line(side)
        x, y = (side[0].nanmean(0) - middle).tolist()
        name = ("right" if x > 0 else "left") if abs(x) > abs(y) else ("bottom" if y > 0 else "top")
        known = torch.isfinite(beyond + out).all(-1)
        outside = known & ~in_image(image, beyond + 0.5 * out)
        (cut if 2 * int(outside.sum()) >= int(known.sum()) else unclear).append(name)
    texts = []
    if cut:
        texts.append(f"the board is cut by the image's edge at the {' and '.join(cut)}")
    if unclear:
        texts.append(f"its end at the {' and '.join(unclear)} is covered, glaring or unclear")
    return ", ".join(texts)
