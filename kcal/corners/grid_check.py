"""Check that a detected grid of corners is the board: all of it, and no more."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.grid import as_grid, first_square_dark, in_image, levels_at, local_side, sides

MAX_BEND = 0.25  # of a square: distance of a corner from its neighbors' homography; a wrong grid is off by 1
MAX_RATIO = 1.7  # of one square's side to the next along a row; perspective reaches it only 3 squares from the board
MIN_ALTERNATING = 0.9  # share of neighboring squares that must alternate; glare may spoil a few
# Of the contrast on the inner side of an outer line: true lines have 0.55 to 1.1, false ones up to 0.1.
MIN_OUTER = 0.35
GOES_ON = 0.75  # of the contrast across a corner: the board's outer edge has half of it, another row all
_FOUR_COLORS = 0.5  # of a corner's contrast, in the middle between two: a skipped corner has all of it, an edge none
MIN_SQUARE = 5.0  # pixels: below, blur decides where the corner seems to be


def grid_trouble(image: npt.NDArray[np.generic], pixels: Tensor, columns: int, rows: int) -> str | None:
    """Why a detected grid cannot be the board, or None.

    * Every square must have the same orientation.
    * Every block of up to 3 x 3 corners must fit a homography; a single one for the board would refuse wide lenses.
    * Sides must change slowly along rows and columns; a homography alone would accept a skipped row.
    * Dark and light squares must alternate, also outside the outer corners, must not go on farther, and no corners may
      lie between those of the grid.
    """
    grid = as_grid(pixels, columns, rows)
    if not bool(torch.isfinite(grid).all()):
        return "a corner is not finite"
    side = local_side(pixels, columns, rows)
    if float(side.min()) < MIN_SQUARE:
        return f"the smallest square is only {float(side.min()):.1f} px wide; move closer or use larger squares"
    trouble = uneven(image, grid)
    if trouble is not None:
        return trouble
    if false_sides(image, pixels, columns, rows).any():
        return f"the outer line of {columns}x{rows} corners lies on the board's edge: the board has fewer inner corners"
    if goes_on(image, pixels, columns, rows):
        return f"the squares go on beyond {columns}x{rows}: the board has more inner corners than that"
    if skips(image, pixels, columns, rows):
        return f"lines of corners lie between those of {columns}x{rows}: the board has more inner corners than that"
    return None


def uneven(image: npt.NDArray[np.generic], grid: Tensor) -> str | None:
    """Why corners (rows, columns, 2) are no grid of squares that alternate, or None."""
    areas = _corner_areas(grid)
    if not (bool((areas > 0).all()) or bool((areas < 0).all())):
        return "the grid found is folded: not the board"
    if float(_bend(grid)) > MAX_BEND or float(_ratio(grid)) > MAX_RATIO:
        return "the grid found is uneven: not the board, or another number of corners"
    rows, columns = grid.shape[:2]
    if first_square_dark(image, grid.reshape(-1, 2), columns, rows)[1] < MIN_ALTERNATING:
        return "the squares of the grid found do not alternate between dark and light"
    return None


def goes_on(image: npt.NDArray[np.generic], pixels: Tensor, columns: int, rows: int) -> bool:
    """Whether the grid is only a part of a larger board.

    Detectors do return parts: asked for 8x6, OpenCV finds such a part on most views of a 9x6 board, and not the same
    part for each camera. One step beyond each side, four squares meet only if there is another row of corners; on the
    board's outer edge three of the four places have one color.
    """
    grid = as_grid(pixels, columns, rows)
    return any(_goes_on_above(image, side) for side in sides(grid) if len(side) >= 3)


def false_sides(image: npt.NDArray[np.generic], pixels: Tensor, columns: int, rows: int) -> Tensor:
    """Which sides of the grid are no lines of corners: top, bottom, left and right, (4,) bool.

    Asked for 9x6, OpenCV's sector detector takes the paper's edge of an 8x6 board for a ninth column where the ground
    is dark. Outside such a line squares do not alternate. A side that glare hides, or the image cuts, counts as true.
    """
    grid = as_grid(pixels, columns, rows)
    return torch.tensor([_alternates_less_outside(image, side) for side in sides(grid)])


def without_false_sides(image: npt.NDArray[np.generic], grid: Tensor) -> Tensor | None:
    """A grid (rows, columns, 2) without the outer lines that are no corners; None if fewer than 3 lines remain."""
    while min(grid.shape[:2]) >= 3:
        rows, columns = grid.shape[:2]
        top, bottom, left, right = (int(side) for side in false_sides(image, grid.reshape(-1, 2), columns, rows))
        if not top + bottom + left + right:
            return grid
        grid = grid[top : rows - bottom, left : columns - right]
    return None


def _alternates_less_outside(image: npt.NDArray[np.generic], grid: Tensor) -> bool:
    along = torch.gradient(grid, dim=1)[0][0]
    out = 2 * grid[0] - 3 * grid[1] + grid[2]  # the next step outward, as perspective continues
    inner, outer = (step_along(image, grid[0], along, down) for down in (grid[1] - grid[0], out))
    usable = in_image(image, grid[0] + 0.5 * out)
    usable &= inner.abs() > 0.3 * step_along(image, grid[1], along, grid[2] - grid[1]).abs().median()
    if 2 * int(usable.sum()) < len(usable):
        return False
    return float((-outer / inner)[usable].median()) < MIN_OUTER


def step_along(image: npt.NDArray[np.generic], places: Tensor, along: Tensor, down: Tensor) -> Tensor:
    """How much lighter squares are after each of `places` (..., 2) than before it, on the side of `down`."""
    after, before = levels_beside(image, places, along, down)
    return after - before


def levels_beside(image: npt.NDArray[np.generic], places: Tensor, along: Tensor, down: Tensor) -> Tensor:
    """Gray levels after and before each of `places` (..., 2), on the side of `down`; (2, ...)."""
    share = torch.tensor([0.2, 0.3, 0.4], dtype=torch.float64)[:, None]
    places, along, down = places[..., None, :], along[..., None, :], down[..., None, :]
    return torch.stack([levels_at(image, places + share * (sign * along + down)).mean(-1) for sign in (1.0, -1.0)])


def skips(image: npt.NDArray[np.generic], pixels: Tensor, columns: int, rows: int) -> bool:
    """Whether the grid leaves out every other line of a larger board.

    Asked for 5x4, OpenCV finds every other row of a 9x6 board in some views; squares seen from the side look the same.
    In the middle of a square's side two colors meet; in the middle between corners that are two squares apart, four do.
    """
    grid = as_grid(pixels, columns, rows)
    return any(_skips_rows(image, side) for side in (grid, grid.transpose(0, 1)))


def _skips_rows(image: npt.NDArray[np.generic], grid: Tensor) -> bool:
    along = torch.gradient(grid, dim=1)[0]
    down = torch.gradient(grid, dim=0)[0]
    middle = 0.5 * (grid[1:] + grid[:-1])
    between = _contrast(image, middle, 0.5 * (along[1:] + along[:-1]), 0.5 * (grid[1:] - grid[:-1]))
    own = _contrast(image, grid, along, 0.5 * down)
    return float(between.abs().median() / own.abs().median().clamp_min(1e-9)) > _FOUR_COLORS


def _contrast(image: npt.NDArray[np.generic], places: Tensor, along: Tensor, down: Tensor) -> Tensor:
    """Twice how much lighter two opposite quadrants around places (..., 2) are than the other two."""
    share = torch.tensor([0.2, 0.3, 0.4], dtype=torch.float64)[:, None]
    signs = ((1.0, 1.0, 1.0), (-1.0, -1.0, 1.0), (1.0, -1.0, -1.0), (-1.0, 1.0, -1.0))
    places, along, down = places[..., None, :], along[..., None, :], down[..., None, :]
    parts = [sign * levels_at(image, places + share * (a * along + b * down)).mean(-1) for a, b, sign in signs]
    return torch.stack(parts).sum(0)


def _goes_on_above(image: npt.NDArray[np.generic], grid: Tensor) -> bool:
    along = torch.gradient(grid, dim=1)[0][0]
    # Extrapolated quadratically, because perspective would shift a linear step by a good part of a square.
    beyond = 3 * grid[0] - 3 * grid[1] + grid[2]
    out = beyond - grid[0]
    inside = in_image(image, beyond + 0.5 * out)
    if int(inside.sum()) * 2 < len(inside):
        return False
    there = _contrast(image, beyond, along, out)
    own = _contrast(image, grid[0], along, (grid[0] - grid[1] + out) / 2)
    own = torch.where(own.abs() < 1e-9, 1e-9, own)
    return float((-there / own)[inside].median()) > GOES_ON


def _corner_areas(grid: Tensor) -> Tensor:
    """Twice the signed area of the triangle at each of a square's four corners; positive where x to y is clockwise."""
    p, q, r, s = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]

    def cross(a: Tensor, b: Tensor) -> Tensor:
        return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]

    return torch.stack([cross(q - p, s - p), cross(r - q, p - q), cross(s - r, q - r), cross(p - s, r - s)])


def _ratio(grid: Tensor) -> Tensor:
    """The largest ratio of two successive sides along a row or a column."""
    ratios = [torch.ones(1, dtype=torch.float64)]
    for dim in (0, 1):
        side = torch.linalg.vector_norm(grid.diff(dim=dim), dim=-1).log()
        ratios.append(side.diff(dim=dim).abs().exp().reshape(-1))
    return torch.cat(ratios).max()


def _bend(grid: Tensor) -> Tensor:
    """Largest distance of a corner from the homography of its block, in units of the block's smallest square."""
    rows, columns = grid.shape[:2]
    high, wide = min(3, rows), min(3, columns)
    blocks = grid.unfold(0, high, 1).unfold(1, wide, 1)  # (i, j, 2, high, wide)
    blocks = blocks.reshape(-1, 2, high, wide)
    side = torch.minimum(
        torch.linalg.vector_norm(blocks.diff(dim=2), dim=1).amin((1, 2)),
        torch.linalg.vector_norm(blocks.diff(dim=3), dim=1).amin((1, 2)),
    )
    flat = blocks.flatten(2).transpose(1, 2)
    center = flat.mean(1, keepdim=True)
    u, v = ((flat - center) / side[:, None, None]).unbind(-1)
    y, x = torch.meshgrid(torch.arange(high).double() - 1, torch.arange(wide).double() - 1, indexing="ij")
    x, y = x.reshape(1, -1).expand_as(u), y.reshape(1, -1).expand_as(u)
    one, zero = torch.ones_like(u), torch.zeros_like(u)
    # The linear homography equations, with the last element fixed: its plane at infinity never crosses a block.
    first = torch.stack([x, y, one, zero, zero, zero, -u * x, -u * y], -1)
    second = torch.stack([zero, zero, zero, x, y, one, -v * x, -v * y], -1)
    solution = torch.linalg.lstsq(
        torch.cat([first, second], 1), torch.cat([u, v], 1)[..., None], driver="gelsd"
    ).solution[..., 0]
    a = solution[:, None]
    w = a[..., 6] * x + a[..., 7] * y + 1
    miss = torch.hypot(
        (a[..., 0] * x + a[..., 1] * y + a[..., 2]) / w - u, (a[..., 3] * x + a[..., 4] * y + a[..., 5]) / w - v
    )
    return miss.max()
