"""Measure a grid of corners, and check that it is the board: all of it, and no more."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.checks import as_points
from kcal.errors import InputError

# Measure the squares, lines and neighbors of a grid of corners.

MIN_SHARPNESS = 0.58  # see `sharpness`: a blur of 0.22 of the square's side


def as_grid(pixels: Tensor, columns: int, rows: int) -> Tensor:
    """Corners (rows * columns, 2) as (rows, columns, 2) float64.

    Raises:
        InputError: another number of corners.
    """
    pixels = as_points("pixels", pixels, 2)
    if pixels.shape != (rows * columns, 2):
        raise InputError(
            f"pixels: shape ({rows * columns}, 2) is needed for {columns}x{rows}, got {tuple(pixels.shape)}"
        )
    return pixels.reshape(rows, columns, 2)


def sides(grid: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A grid (rows, columns, 2), turned or mirrored so that top, bottom, left and right in turn are its first row."""
    return grid, grid.flip(0), grid.transpose(0, 1), grid.transpose(0, 1).flip(0)


def local_side(pixels: Tensor, columns: int, rows: int) -> Tensor:
    """The distance in pixels from each corner to its nearest neighbor in the grid, (rows * columns,).

    Refinement windows are proportional to it, because a fixed one would contain the next corner of a distant board.
    Neighbors that were not seen (NaN) do not count; a corner without any gets infinity.

    Example:
        >>> corners = torch.tensor([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0], [3.0, 4.0]])
        >>> local_side(corners, 2, 2).tolist()
        [3.0, 3.0, 3.0, 3.0]
    """
    grid = as_grid(pixels, columns, rows)
    side = torch.full((rows, columns), float("inf"), dtype=torch.float64, device=grid.device)
    across = torch.linalg.vector_norm(grid[:, 1:] - grid[:, :-1], dim=-1)
    down = torch.linalg.vector_norm(grid[1:] - grid[:-1], dim=-1)
    side[:, 1:] = torch.fmin(side[:, 1:], across)
    side[:, :-1] = torch.fmin(side[:, :-1], across)
    side[1:] = torch.fmin(side[1:], down)
    side[:-1] = torch.fmin(side[:-1], down)
    return side.reshape(-1)


def cell_levels(image: npt.NDArray[np.generic], grid: Tensor) -> Tensor:
    """Mean gray level in the middle of each square between four corners (rows, columns, 2): one less each way, float64.

    Sampled at 25 points over the middle half of the square, so that corners may be off by a few pixels.
    """
    share = torch.linspace(0.25, 0.75, 5, dtype=torch.float64)
    b, a = torch.meshgrid(share, share, indexing="ij")
    a, b = a.reshape(-1, 1), b.reshape(-1, 1)
    top = grid[:-1, :-1, None] * (1 - a) + grid[:-1, 1:, None] * a
    bottom = grid[1:, :-1, None] * (1 - a) + grid[1:, 1:, None] * a
    return levels_at(image, top * (1 - b) + bottom * b).mean(-1)


def first_square_dark(image: npt.NDArray[np.generic], grid: Tensor) -> tuple[bool, float]:
    """Whether the square diagonally outside the first corner is dark, and the share of neighboring squares that agree.

    Colors alternate, so that square has the color of the first one inside.
    """
    differences = _alternating(cell_levels(image, grid))
    lighter = float((differences > 0).double().mean())
    return lighter > 0.5, max(lighter, float((differences < 0).double().mean()))


def sharpness(image: npt.NDArray[np.generic], grid: Tensor) -> float:
    """Contrast near the corners of the squares over that in their middle: 1 if sharp, 0.5 if blurred to waves.

    The median over the squares, near meaning a quarter of a square inside. A Gaussian blur of 0.2 of the square's side
    gives 0.64, one of 0.25 gives 0.54. With more blur a corner is shifted by what lies beyond its four squares, by
    tenths of a pixel at the board's border.
    """
    p, q, r, s = grid[:-1, :-1], grid[:-1, 1:], grid[1:, :-1], grid[1:, 1:]
    middle = levels_at(image, (p + q + r + s) / 4)
    turns = ((p, q, r, s), (q, p, s, r), (r, s, p, q), (s, r, q, p))
    near = torch.stack([levels_at(image, (9 * a + 3 * (b + c) + d) / 16) for a, b, c, d in turns]).mean(0)
    whole = _alternating(middle).nanmedian()
    return float(_alternating(near).nanmedian() / torch.where(whole == 0, 1e-9, whole))


def _alternating(levels: Tensor) -> Tensor:
    """How much lighter each square is than its neighbors, with the sign for a dark first square.

    Comparing neighbors makes the result nearly independent of uneven light.
    """
    sign = checkered(levels)
    across = (levels[:, 1:] - levels[:, :-1]) * sign[:, :-1]
    down = (levels[1:] - levels[:-1]) * sign[:-1]
    return torch.cat([across.reshape(-1), down.reshape(-1)])


def direct_equations(points: Tensor, image: Tensor, seen: Tensor | None = None) -> Tensor:
    """(..., 2 N, 9) equations of the direct linear transform from points to image (..., N, 2); zero where not seen."""
    at = torch.nn.functional.pad(points, (0, 1), value=1.0)
    if seen is not None:
        at = at * seen[..., None]
    zero = torch.zeros_like(at)
    rows = [torch.cat([at, zero, -image[..., :1] * at], -1), torch.cat([zero, at, -image[..., 1:] * at], -1)]
    return torch.cat(rows, -2)


def checkered(grid: Tensor) -> Tensor:
    """1 and -1 in turn, for the places of a grid (rows, columns, ...)."""
    i, j = torch.meshgrid(*map(torch.arange, grid.shape[:2]), indexing="ij")
    return 1.0 - 2.0 * ((i + j) % 2)


def levels_at(image: npt.NDArray[np.generic], where: Tensor) -> Tensor:
    """Gray levels at the pixels nearest to `where` (..., 2), (...) float64; the image's edge goes on outside.

    NaN where `where` is.
    """
    x, y = where.nan_to_num().round().long().unbind(-1)
    x, y = x.clamp(0, image.shape[1] - 1), y.clamp(0, image.shape[0] - 1)
    levels = torch.from_numpy(image[y.numpy(), x.numpy()].astype(np.float64))
    return torch.where(torch.isfinite(where).all(-1), levels, torch.nan)


def in_image(image: npt.NDArray[np.generic], places: Tensor) -> Tensor:
    """Whether places (..., 2) lie between the centers of the image's border pixels; False for NaN."""
    limit = torch.tensor([image.shape[1] - 1.0, image.shape[0] - 1.0], dtype=torch.float64)
    return ((places >= 0) & (places <= limit)).all(-1)


def line_bend(pixels: Tensor, columns: int, rows: int) -> Tensor:
    """Curvature vectors of the board's lines at each corner, (corners, 2, 2) in 1 / pixels: row first, then column.

    Only a distorting lens bends lines; perspective does not. Each curvature is that of the circle through three
    successive corners (K. Menger). Three corners determine it badly and it changes smoothly, so a quadratic over the
    board is fitted to all of them. 0 where no three corners on a line were seen.

    Example:
        >>> angle = torch.tensor([-0.1, 0.0, 0.1], dtype=torch.float64)
        >>> row = torch.stack([200 * angle.sin(), 200 - 200 * angle.cos()], -1)  # on a circle of radius 200
        >>> bend = line_bend(torch.cat([row, row + torch.tensor([0.0, 20.0])]), 3, 2)
        >>> [round(value, 6) + 0.0 for value in bend[1, 0].tolist()], bend[1, 1].tolist()
        ([0.0, 0.005], [0.0, 0.0])
    """
    grid = as_grid(pixels, columns, rows)
    across = _smooth(_curvature(grid))
    down = _smooth(_curvature(grid.transpose(0, 1))).transpose(0, 1)
    return torch.stack([across, down], -2).reshape(-1, 2, 2)


def _smooth(values: Tensor) -> Tensor:
    """The quadratic in both directions that fits the values of a grid (L, N, 2) best; NaN values are ignored."""
    axes = (torch.linspace(-1.0, 1.0, size, dtype=torch.float64, device=values.device) for size in values.shape[:2])
    i, j = (axis.reshape(-1) for axis in torch.meshgrid(*axes, indexing="ij"))
    design = torch.stack([i**m * j**n for m in range(3) for n in range(3 - m)], -1)
    flat = values.reshape(-1, 2)
    known = torch.isfinite(flat).all(-1)
    if not bool(known.any()):
        return torch.zeros_like(values)
    # If there are too few corners, this gives the smallest coefficients that explain them.
    solution = torch.linalg.lstsq(design[known], flat[known], driver="gelsd").solution
    return (design @ solution).reshape(values.shape)


class Neighbors(NamedTuple):
    """Steps to the neighboring corners: left, right, up and down in the board's order.

    Args:
        step: (..., N, 4, 2) pixels from each corner to its neighbor, at the board's border to the end of the outer
            square. There, and where the neighbor was not seen, it is extrapolated from the two corners on the other
            side; NaN without them.
        change: (..., N, 4, 2) difference of that step between successive corners along the other line: along rows for
            the steps up and down.
        outer: (..., N, 4) whether the board ends there.
    """

    step: Tensor
    change: Tensor
    outer: Tensor


def neighbors(pixels: Tensor, columns: int, rows: int) -> Neighbors:
    """The steps from each corner of a board to the corners next to it.

    Example:
        >>> corners = torch.tensor([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0], [3.0, 4.0]])
        >>> around = neighbors(corners, 2, 2)
        >>> around.step[0].tolist(), around.outer[0].tolist()
        ([[-3.0, 0.0], [3.0, 0.0], [0.0, -4.0], [0.0, 4.0]], [True, False, True, False])
    """
    grid = as_grid(pixels, columns, rows)
    across, down = _steps(grid), [value.transpose(0, 1) for value in _steps(grid.transpose(0, 1))]
    step, change, outer = (torch.cat(both, 2) for both in zip(across, down, strict=True))
    return Neighbors(step.reshape(-1, 4, 2), change.reshape(-1, 4, 2), outer.reshape(-1, 4))


def _steps(lines: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Steps back and forth (L, N, 2, 2) along lines of corners, their change (L, N, 2, 2), and the ends (L, N, 2)."""
    forth = torch.full_like(lines, float("nan"))
    forth[:, :-1] = lines.diff(dim=1)
    back = -forth.roll(1, 1)
    whole_back = torch.where(torch.isnan(back), _beyond(forth, forth.roll(-1, 1)), back)
    whole_forth = torch.where(torch.isnan(forth), _beyond(back, back.roll(1, 1)), forth)
    step = torch.stack([whole_back, whole_forth], 2)
    outer = torch.zeros(step.shape[:-1], dtype=torch.bool, device=lines.device)
    outer[:, 0, 0] = outer[:, -1, 1] = True
    return step, torch.nan_to_num(_change(step)), outer


def _beyond(step: Tensor, following: Tensor) -> Tensor:
    """Extrapolate the step to the other side of a corner from the two steps on this side, allowing for perspective.

    Along a line of evenly spaced marks, perspective puts mark t at b t / (1 + c t); steps 0 to 1 and 1 to 2 give c.
    c is the median over all lines, because a single line amplifies the corners' noise. The sideways bend by the lens
    continues. Without a second step, the result is the mirror image of the first.
    """
    square = step.square().sum(-1, keepdim=True)
    ratio = (following * step).sum(-1, keepdim=True) / square
    c = (0.5 * (1.0 / ratio.clamp(0.5, 2.0) - 1.0)).nanmedian(0).values.nan_to_num()
    sideways = (following - ratio * step).nan_to_num()
    return sideways - step * (1.0 + c) / (1.0 - c)


def _change(values: Tensor) -> Tensor:
    """Change from one to the next along dim 0, central where both neighbors are known, else one-sided."""
    after = torch.full_like(values, float("nan"))
    before = after.clone()
    after[:-1] = values.diff(dim=0)
    before[1:] = after[:-1]
    return torch.stack([before, after]).nanmean(0)


def _curvature(lines: Tensor) -> Tensor:
    """Curvature vectors (L, N, 2) along lines of corners (L, N, 2)."""
    bend = torch.full_like(lines, float("nan"))
    if lines.shape[1] >= 3:
        before, after = lines[:, 1:-1] - lines[:, :-2], lines[:, 2:] - lines[:, 1:-1]
        chord = before + after
        area = before[..., 0] * after[..., 1] - before[..., 1] * after[..., 0]
        lengths = (torch.linalg.vector_norm(side, dim=-1) for side in (before, after, chord))
        product = torch.stack(list(lengths)).prod(0)
        normal = torch.stack([-chord[..., 1], chord[..., 0]], -1) / torch.linalg.vector_norm(chord, dim=-1)[..., None]
        bend[:, 1:-1] = (2.0 * area / product)[..., None] * normal
    return bend


# Check that a detected grid of corners is the board: all of it, and no more.

MAX_BEND = 0.25  # of a square: distance of a corner from its neighbors' homography; a wrong grid is off by 1
MAX_RATIO = 1.7  # of one square's side to the next along a row; perspective reaches it only 3 squares from the board
# The same where four squares meet at every corner: fisheyes reach 0.9 and 2.6 two squares from the board.
_LENS_BEND, _LENS_RATIO = 1.0, 2.7
_FOUR_MEET = 0.5  # of the median contrast, which is left 0.3 of a square beside a corner
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
    * Near a fisheye both change faster. That is accepted where four squares meet at every corner.
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
    if false_sides(image, grid).any():
        return f"the outer line of {columns}x{rows} corners lies on the board's edge: the board has fewer inner corners"
    if goes_on(image, grid):
        return f"the squares go on beyond {columns}x{rows}: the board has more inner corners than that"
    if skips(image, grid):
        return f"lines of corners lie between those of {columns}x{rows}: the board has more inner corners than that"
    return None


def uneven(image: npt.NDArray[np.generic], grid: Tensor) -> str | None:
    """Why corners (rows, columns, 2) are no grid of squares that alternate, or None."""
    areas = _corner_areas(grid)
    if not (bool((areas > 0).all()) or bool((areas < 0).all())):
        return "the grid found is folded: not the board"
    bend, ratio = float(_bend(grid)), float(_ratio(grid))
    if (bend > MAX_BEND or ratio > MAX_RATIO) and not (
        bend < _LENS_BEND and ratio < _LENS_RATIO and _four_meet(image, grid)
    ):
        return "the grid found is uneven: not the board, or another number of corners"
    if first_square_dark(image, grid)[1] < MIN_ALTERNATING:
        return "the squares of the grid found do not alternate between dark and light"
    return None


def goes_on(image: npt.NDArray[np.generic], grid: Tensor) -> bool:
    """Whether the grid is only a part of a larger board.

    Detectors do return parts: asked for 8x6, OpenCV finds such a part on most views of a 9x6 board, and not the same
    part for each camera. One step beyond each side, four squares meet only if there is another row of corners; on the
    board's outer edge three of the four places have one color.
    """
    return any(_goes_on_above(image, side) for side in sides(grid) if len(side) >= 3)


def false_sides(image: npt.NDArray[np.generic], grid: Tensor) -> Tensor:
    """Which sides of the grid are no lines of corners: top, bottom, left and right, (4,) bool.

    Asked for 9x6, OpenCV's sector detector takes the paper's edge of an 8x6 board for a ninth column where the ground
    is dark. Outside such a line squares do not alternate. A side that glare hides, or the image cuts, counts as true.
    """
    return torch.tensor([_alternates_less_outside(image, side) for side in sides(grid)])


def without_false_sides(image: npt.NDArray[np.generic], grid: Tensor) -> Tensor | None:
    """A grid (rows, columns, 2) without the outer lines that are no corners; None if fewer than 3 lines remain."""
    while min(grid.shape[:2]) >= 3:
        top, bottom, left, right = (int(side) for side in false_sides(image, grid))
        if not top + bottom + left + right:
            return grid
        grid = grid[top : len(grid) - bottom, left : grid.shape[1] - right]
    return None


def sound_grid(image: npt.NDArray[np.generic], grid: Tensor) -> Tensor | None:
    """A grid without such lines, if its squares alternate and it leaves out no line of a larger board."""
    whole = without_false_sides(image, grid)
    return None if whole is None or uneven(image, whole) is not None or skips(image, whole) else whole


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
    ways = torch.stack([down + along, down - along])[..., None, :]
    return levels_at(image, places[..., None, :] + share * ways).mean(-1)


def skips(image: npt.NDArray[np.generic], grid: Tensor) -> bool:
    """Whether the grid leaves out every other line of a larger board.

    Asked for 5x4, OpenCV finds every other row of a 9x6 board in some views; squares seen from the side look the same.
    In the middle of a square's side two colors meet; in the middle between corners that are two squares apart, four do.
    """
    return any(_skips_rows(image, side) for side in (grid, grid.transpose(0, 1)))


def _skips_rows(image: npt.NDArray[np.generic], grid: Tensor) -> bool:
    along = torch.gradient(grid, dim=1)[0]
    down = torch.gradient(grid, dim=0)[0]
    middle = 0.5 * (grid[1:] + grid[:-1])
    between = contrast(image, middle, 0.5 * (along[1:] + along[:-1]), 0.5 * (grid[1:] - grid[:-1]))
    own = contrast(image, grid, along, 0.5 * down)
    return float(between.abs().median() / own.abs().median().clamp_min(1e-9)) > _FOUR_COLORS


def contrast(image: npt.NDArray[np.generic], places: Tensor, along: Tensor, down: Tensor) -> Tensor:
    """Twice how much lighter two opposite quadrants around places (..., 2) are than the other two."""
    ahead, back = step_along(image, places, along, torch.stack([down, -down]))
    return ahead - back


def _four_meet(image: npt.NDArray[np.generic], grid: Tensor) -> bool:
    """Whether four squares meet at every corner of a grid (rows, columns, 2), in the order of a checkerboard."""
    along, down = torch.gradient(grid, dim=1)[0], torch.gradient(grid, dim=0)[0]
    found = contrast(image, grid, along, down) * checkered(grid)
    return float((found / found.median()).min()) > _FOUR_MEET


def _goes_on_above(image: npt.NDArray[np.generic], grid: Tensor) -> bool:
    along = torch.gradient(grid, dim=1)[0][0]
    # Extrapolated quadratically, because perspective would shift a linear step by a good part of a square.
    beyond = 3 * grid[0] - 3 * grid[1] + grid[2]
    out = beyond - grid[0]
    inside = in_image(image, beyond + 0.5 * out) & torch.isfinite(beyond + along).all(-1)
    if 2 * int(inside.sum()) < max(len(inside), 6):
        return False
    own = contrast(image, grid[0], along, (grid[0] - grid[1] + out) / 2)[inside]
    own = torch.where(own.abs() < 1e-9, 1e-9, own)
    beyond, along, out = (each[inside, None] for each in (beyond, along, out))
    # Near a fisheye the next corners are up to a quarter of a square from there. No place on an outer edge has more
    # than half of a corner's contrast.
    step = torch.tensor([-0.24, -0.12, 0.0, 0.12, 0.24], dtype=torch.float64)
    a, b = (each[:, None] for each in torch.cartesian_prod(step, step).unbind(-1))
    there = -contrast(image, beyond + a * along + b * out, along, out) / own[:, None]
    return float(there.amax(1).nanmedian()) > GOES_ON


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
    shortest = (torch.linalg.vector_norm(blocks.diff(dim=dim), dim=1).amin((1, 2)) for dim in (2, 3))
    side = torch.minimum(*shortest)
    flat = blocks.flatten(2).transpose(1, 2)
    center = flat.mean(1, keepdim=True)
    u, v = ((flat - center) / side[:, None, None]).unbind(-1)
    y, x = torch.meshgrid(torch.arange(high).double() - 1, torch.arange(wide).double() - 1, indexing="ij")
    x, y = x.reshape(1, -1).expand_as(u), y.reshape(1, -1).expand_as(u)
    # With the last element fixed: its plane at infinity never crosses a block.
    equations = direct_equations(torch.stack([x, y], -1), torch.stack([u, v], -1))
    solution = torch.linalg.lstsq(equations[..., :8], -equations[..., 8:], driver="gelsd").solution[..., 0]
    a = solution[:, None]
    w = a[..., 6] * x + a[..., 7] * y + 1
    across = (a[..., 0] * x + a[..., 1] * y + a[..., 2]) / w - u
    down = (a[..., 3] * x + a[..., 4] * y + a[..., 5]) / w - v
    return torch.hypot(across, down).max()
