"""Search an image for a checkerboard: OpenCV's detectors, in the order that measurement found best, then its parts."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

import kcal.corners.grid as grids
from kcal.corners.board import Board
from kcal.corners.images import Gray
from kcal.corners.refine import refine_corners
from kcal.corners.saddle import CornerStatus, saddle
from kcal.errors import KcalError
from kcal.opencv import cv2


class NotFoundError(KcalError):
    """Why an image does not show a board, in words that a person can act on."""


# Put detected corners into the board's order, however the board was held.


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
    grid = grids.as_grid(pixels, board.columns, board.rows)
    if handedness(grid) < 0:
        grid = grid.flip(1)
    turns = [grid, grid.flip(0, 1)]
    if board.columns == board.rows:
        quarter = grid.transpose(0, 1).flip(1)
        turns += [quarter, quarter.flip(0, 1)]
    dark = [turn for turn in turns if grids.first_square_dark(image, turn)[0]]
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


# Grow a grid of checkerboard corners: predict the next ones from those beside them, and see whether they are there.

MAX_MISS = 0.25  # of the square: distance of a corner from where its neighbors predict it
MIN_CONTRAST = 0.15  # of the corners beside it; a hard shadow leaves a quarter


def grown_grid(image: npt.NDArray[np.generic], grid: Tensor, most: int) -> Tensor:
    """Extend a grid of corners (rows, columns, 2) to its neighbors in the image, up to `most` lines each way.

    Each neighbor is predicted from the corners beside it and refined; squares must alternate on all its four sides.
    """
    light = torch.from_numpy(image.astype(np.float32))
    while True:
        before = torch.nn.functional.pad(grid, (0, 0, 1, 1, 1, 1), value=torch.nan)
        grid = _extended(image, light, before)
        known = torch.isfinite(grid).all(-1)
        rows, columns = known.any(1).nonzero()[:, 0], known.any(0).nonzero()[:, 0]
        grid = grid[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
        if int(known.sum()) == int(torch.isfinite(before).all(-1).sum()) or max(grid.shape[:2]) > most:
            return grid


def filled_grid(image: npt.NDArray[np.generic], grid: Tensor, free: float) -> Tensor:
    """Find the corners that a board's grid (rows, columns, 2) lacks.

    Args:
        image: (H, W).
        grid: corners; NaN where missing.
        free: how far around a corner, as a share of its squares, nothing else is printed; at most 0.5.
    """
    light = torch.from_numpy(image.astype(np.float32))
    while True:
        before, grid = grid, _extended(image, light, grid, min(1.0, 2.0 * free))
        if int(torch.isfinite(grid).sum()) == int(torch.isfinite(before).sum()):
            return grid


def _extended(image: npt.NDArray[np.generic], light: Tensor, grid: Tensor, free: float = 1.0) -> Tensor:
    """The grid with the neighbors of its corners; only `free` of the half squares around them is looked at."""
    known = torch.isfinite(grid).all(-1)
    predicted, (along, down) = _predicted(grid), local_steps(grid)
    new = ~known & torch.isfinite(predicted + along + down).all(-1)
    if not bool(new.any()):
        return grid
    places, along, down = predicted[new], along[new], down[new]
    side = torch.minimum(torch.linalg.vector_norm(along, dim=-1), torch.linalg.vector_norm(down, dim=-1))
    refined = saddle(light, places, (free * side).clamp_min(1.0))
    apart = torch.linalg.vector_norm(refined.pixels - places, dim=-1)
    good = (refined.status == CornerStatus.GOOD) & (side >= grids.MIN_SQUARE) & (apart < MAX_MISS * side)
    good &= _are_corners(image, grid, refined.pixels, free * along, free * down, new, free)
    grid = grid.clone()
    grid[new] = torch.where(good[:, None], refined.pixels, torch.nan)
    return grid


def local_steps(grid: Tensor) -> tuple[Tensor, Tensor]:
    """Mean steps along rows and down columns near each corner (rows, columns, 2), NaN where none is known nearby."""
    steps = []
    for dim in (1, 0):
        step = grid.diff(dim=dim)
        pad = (0, 0, 1, 1, 0, 0) if dim == 1 else (0, 0, 0, 0, 1, 1)
        step = torch.nn.functional.pad(step, pad, value=torch.nan)
        both = torch.stack([step.narrow(dim, 0, grid.shape[dim]), step.narrow(dim, 1, grid.shape[dim])]).nanmean(0)
        around = torch.nn.functional.pad(both, (0, 0, 1, 1, 1, 1), value=torch.nan)
        near = [around[i : i + grid.shape[0], j : j + grid.shape[1]] for i in range(3) for j in range(3)]
        steps.append(torch.stack(near).nanmean(0))
    return steps[0], steps[1]


def _predicted(grid: Tensor) -> Tensor:
    """Where the corners beside each place predict it: by quadratics along lines, or straight ones where too few are."""
    third: list[Tensor] = []
    second: list[Tensor] = []
    for side in range(4):
        turned = grids.sides(grid)[side]
        padded = torch.nn.functional.pad(turned, (0, 0, 0, 0, 0, 3), value=torch.nan)
        one, two, three = (padded[k : k + len(turned)] for k in (1, 2, 3))
        for values, guess in ((third, 3 * one - 3 * two + three), (second, 2 * one - two)):
            guess = guess if side in (0, 2) else guess.flip(0)
            values.append(guess if side < 2 else guess.transpose(0, 1))
    straight = torch.stack(second).nanmean(0)
    curved = torch.stack(third).nanmean(0)
    return torch.where(torch.isfinite(curved), curved, straight)


def _are_corners(
    image: npt.NDArray[np.generic], grid: Tensor, places: Tensor, along: Tensor, down: Tensor, new: Tensor, free: float
) -> Tensor:
    """Whether squares alternate on all four sides of new places (N, 2), in step with the corners known in `grid`."""
    known = grids.contrast(image, grid, *(free * step for step in local_steps(grid))) / 2 * grids.checkered(grid)
    around = torch.nn.functional.pad(known, (2, 2, 2, 2), value=torch.nan)
    near = [around[i : i + known.shape[0], j : j + known.shape[1]] for i in range(5) for j in range(5)]
    typical = torch.stack(near).nanmedian(0).values[new] * grids.checkered(grid)[new]
    ways = ((along, down), (down, along))
    steps = [sign * grids.step_along(image, places, way, sign * beside) for way, beside in ways for sign in (1, -1)]
    four = torch.stack(steps) / torch.where(typical == 0, torch.nan, typical)
    return (four.amin(0) > grids.MIN_OUTER * four.amax(0)) & (four.mean(0) > MIN_CONTRAST)


# Find a part of a checkerboard, where it is certain which part it is.
#
# A grid of corners is grown from the largest one that OpenCV finds, over what glare or a shadow left out. Its place in
# the board follows from the board's ends, beyond which squares no longer alternate, and from which squares are dark.
# Where several places remain possible, there is no result: a wrong place would be a wrong lens.

MIN_CORNERS = 12
MIN_FILLED = 0.5  # share of the places of the grown grid at which corners were found
MIN_LINES = 3  # each way
MIN_END, MIN_END_SHARE = 3, 0.8  # corners that must show the board's end on one side, and their share
OUTER_SQUARE = 0.5  # of its contrast at the corner that the outer square must have up to the board's end


class FoundBoard(NamedTuple):
    """A board or a part of it, or why there is none.

    Args:
        pixels: (corners, 2) in the board's order, good to about a pixel of the searched image; NaN where a corner was
            not found. None if the board was not found.
        reason: why.
        rejected: (N, 2) corners of a grid that is not the board, or that could not be told to be.
        other: whether they are certainly those of another board.
        factor: how many times smaller the searched image was.
    """

    pixels: Tensor | None
    reason: str = ""
    rejected: Tensor | None = None
    other: bool = False
    factor: float = 1.0


def find_part(
    image: npt.NDArray[np.uint8], board: Board, seeds: Iterable[Tensor], best: FoundBoard | None = None
) -> FoundBoard:
    """Find the visible corners of a board that is cut by the image's edge, covered or glaring in places.

    Args:
        image: (H, W) uint8.
        board: the board.
        seeds: grids of corners (rows, columns, 2) in the image, such as detectors find; they are tried in turn.
        best: what other seeds gave.

    Returns:
        The corners; without a reason if there is no grid at all.
    """
    best = best or FoundBoard(None)
    for seed in seeds:
        whole = grids.sound_grid(image, seed)
        if whole is None:
            continue
        part = _grown(image, whole.flip(1) if handedness(whole) < 0 else whole, board)
        if part.pixels is not None:
            return part
        if best.rejected is None or (part.rejected is not None and len(part.rejected) > len(best.rejected)):
            best = part
    return best


def _grown(image: npt.NDArray[np.uint8], seed: Tensor, board: Board) -> FoundBoard:
    """Grow a part of the board from a seed."""
    longer, shorter = max(board.columns, board.rows), min(board.columns, board.rows)
    grid = grown_grid(image, seed, longer + 1)
    known = torch.isfinite(grid).all(-1)
    seen = grid[known]
    high, wide = grid.shape[:2]
    if len(seen) < max(MIN_CORNERS, MIN_FILLED * known.numel()) or min(high, wide) < MIN_LINES:
        return FoundBoard(None)
    asked, size = f"{board.columns}x{board.rows}", f"{max(high, wide)}x{min(high, wide)}"
    ends = board_ends(image, grid)
    if all(ends) and (max(high, wide), min(high, wide)) != (longer, shorter):
        return FoundBoard(
            None, f"a board of {size} inner corners was found, not {asked}: give --board {size}", seen, True
        )
    if max(high, wide) > longer or min(high, wide) > shorter:
        return FoundBoard(None, f"a grid of {size} inner corners was found, larger than {asked}", seen, other=True)
    if grids.goes_on(image, grid):
        return FoundBoard(None, f"the squares go on beyond the {size} inner corners that were found", seen)
    places = _placements(image, grid, ends, board)
    if not places:
        return FoundBoard(None, f"a grid of {size} inner corners was found, which is no part of {asked}", seen)
    if len(places) > len(board.quarter_turns) or not _is_anchored(image, grid, ends):
        where = _hidden_sides(image, grid, ends)
        return FoundBoard(
            None,
            f"{len(seen)} of {board.corners} corners found, but not which ones: {where}; show two sides that meet",
            seen,
        )
    return FoundBoard(max(places, key=uprightness).reshape(-1, 2))


def _is_anchored(image: npt.NDArray[np.uint8], grid: Tensor, ends: tuple[bool, bool, bool, bool]) -> bool:
    """Whether both ends of the board are visible in each direction, or one of them with paper beyond."""
    sure = board_ends(image, grid, paper=True)
    return all((ends[i] and ends[i + 1]) or sure[i] or sure[i + 1] for i in (0, 2))


def board_ends(image: npt.NDArray[np.generic], grid: Tensor, paper: bool = False) -> tuple[bool, bool, bool, bool]:
    """At which sides (top, bottom, left, right) of a grid (rows, columns, 2) the board's end is visible.

    The outer squares must alternate up to one step outside the outer corners, and nothing may alternate beyond. With
    `paper` it must be light there as well: what covers a board along a straight line seldom is.
    """
    top, bottom, left, right = (_is_end(image, side, paper) for side in grids.sides(grid))
    return top, bottom, left, right


def _is_end(image: npt.NDArray[np.generic], grid: Tensor, paper: bool) -> bool:
    beyond, out, along = _next_line(grid)
    own, inner, outer = (
        grids.step_along(image, places, along, down) for places, down in ((grid[0], out), (beyond, -out), (beyond, out))
    )
    usable = grids.in_image(image, beyond + 0.5 * out) & torch.isfinite(own + inner + outer)
    ends = (inner / own > OUTER_SQUARE) & (outer.abs() < grids.MIN_OUTER * inner.abs())
    if paper:
        square, ground = (grids.levels_beside(image, beyond, along, down) for down in (-out, out))
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
    places: list[Tensor] = []
    inverted: list[Tensor] = []
    for _ in range(4):
        high, wide = grid.shape[:2]
        lighter = grids.contrast(image, grid, *local_steps(grid)) * grids.checkered(grid)
        dark = bool(lighter.nanmedian() < 0)  # the square diagonally outside the grid's first corner
        for row, column in itertools.product(range(board.rows - high + 1), range(board.columns - wide + 1)):
            beyond = row, board.rows - high - row, column, board.columns - wide - column
            if not any(lines and end for lines, end in zip(beyond, ends, strict=True)):
                whole = torch.full((board.rows, board.columns, 2), torch.nan, dtype=torch.float64)
                whole[row : row + high, column : column + wide] = grid
                (places if dark == ((row + column) % 2 == 0) else inverted).append(whole)
        grid = grid.transpose(0, 1).flip(1)
        top, bottom, left, right = ends
        ends = left, right, bottom, top
    # A whole board that is printed white on black has the other colors.
    return places or (inverted if all(ends) else [])


def _hidden_sides(image: npt.NDArray[np.generic], grid: Tensor, ends: tuple[bool, bool, bool, bool]) -> str:
    """Where in the image the board's end is not visible, in words."""
    middle = grid.nanmean((0, 1))
    cut: list[str] = []
    unclear: list[str] = []
    for side, end in zip(grids.sides(grid), ends, strict=True):
        if end:
            continue
        beyond, out, _ = _next_line(side)
        x, y = (side[0].nanmean(0) - middle).tolist()
        name = ("right" if x > 0 else "left") if abs(x) > abs(y) else ("bottom" if y > 0 else "top")
        known = torch.isfinite(beyond + out).all(-1)
        outside = known & ~grids.in_image(image, beyond + 0.5 * out)
        (cut if 2 * int(outside.sum()) >= int(known.sum()) else unclear).append(name)
    texts = []
    if cut:
        texts.append(f"the board is cut by the image's edge at the {' and '.join(dict.fromkeys(cut))}")
    if unclear:
        texts.append(f"its end at the {' and '.join(dict.fromkeys(unclear))} is covered, glaring or unclear")
    return ", ".join(texts)


# Search an image for a checkerboard: OpenCV's detectors, in the order that measurement found best, then its parts.

SEARCH_SIDES = (1200, 2400)  # pixels: longer sides of the searched image, small first
MIN_REFINED_SIDE = 8.0  # pixels: smaller squares in a reduced image are not refined there

_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_LOCAL_CONTRAST, _TILES = 4.0, (8, 8)  # of the adaptive histogram equalization


def find_board(image: npt.NDArray[np.uint8], board: Board) -> FoundBoard:
    """Find a checkerboard's corners to about a pixel of the searched size.

    `findChessboardCorners` goes first: it is the fastest and finds most boards. `findChessboardCornersSB` (A. Duda and
    U. Frese, BMVC 2018) finds blurred ones that the first does not; on an image of equalized local contrast, shadowed
    ones. Before these two, a part is sought whose place in the board is certain (`find_part`): they are left out where
    the image shows all of the board or another one for certain, or cuts it; otherwise the part is what they leave.
    Images above 1200 px are searched at that size, then at 2400 px.

    Args:
        image: (H, W) uint8.
        board: a checkerboard of at least 3x3 inner corners.
    """
    sizes = list(search_sizes(image))
    factor, small, scale = sizes[0]
    searches = [(size, find) for size in sizes for find in (_find_classic, find_sector, _find_shadowed)]
    whole = _find_whole(searches[:1], board)
    if whole.pixels is not None:
        return whole
    candidates = seeds(small)
    part = find_part(small, board, itertools.islice(candidates, 1))
    if not _is_all(small, part, board):
        found = _find_whole(searches[1:], board)
        if found.pixels is not None:
            return found
        whole = found if whole.rejected is None else whole
        part = part if part.pixels is not None else find_part(small, board, candidates, part)
    if part.pixels is not None:
        return FoundBoard(to_full_size(part.pixels, scale), factor=factor)
    if part.rejected is not None and (part.other or whole.rejected is None):
        return FoundBoard(None, reason=part.reason, rejected=to_full_size(part.rejected, scale))
    return whole


_Size = tuple[float, npt.NDArray[np.uint8], Tensor]  # how many times smaller, the image, and the exact scale back
_Search = tuple[_Size, Callable[[npt.NDArray[np.uint8], Board], Tensor | None]]


def _find_whole(searches: Sequence[_Search], board: Board) -> FoundBoard:
    """The first grid that is the whole board, by one detector at one size after the other."""
    missing = FoundBoard(None, reason=f"no board of {board.columns}x{board.rows} inner corners found")
    for (factor, small, scale), find in searches:
        corners = find(small, board)
        if corners is None:
            continue
        trouble = grids.grid_trouble(small, corners, board.columns, board.rows)
        if trouble is None:
            return FoundBoard(to_full_size(canonical_order(small, corners, board), scale), factor=factor)
        if missing.rejected is None:
            missing = FoundBoard(None, reason=trouble, rejected=to_full_size(corners, scale))
    return missing


def _is_all(image: npt.NDArray[np.uint8], part: FoundBoard, board: Board) -> bool:
    """Whether no detector of whole boards finds more: another board is there, all of this one, or some is outside."""
    if part.pixels is None:
        return part.other
    seen = torch.isfinite(part.pixels).all(-1).numpy()
    plane, places = board.points[:, :2].numpy() / board.square, part.pixels.numpy()
    image_from_board, _ = cv2.findHomography(plane[seen], places[seen])
    if seen.all() or image_from_board is None:
        return bool(seen.all())
    there = torch.from_numpy(cv2.perspectiveTransform(plane[None, ~seen], image_from_board)[0])
    return not bool(grids.in_image(image, there).all())


def refine_through_sizes(image: Gray, pixels: Tensor, board: Board, factor: float) -> Tensor:
    """Refine corners found on an image `factor` times smaller until refinement at full size can start from them.

    The first steps use images four and two times smaller still: where OpenCV's own refinement failed, it leaves single
    corners 3 px off, too far for full size. Squares too small for refinement are left as they are.
    """
    whole = image.shape[1], image.shape[0]
    factors = [smaller for n in range(12) if (smaller := 4 * factor / 2**n) > 1]
    # Each is reduced from the one twice as large, because reducing the largest image takes the time.
    steps, source = [], image
    for factor in reversed(factors):
        source, scale = reduced(source, factor, whole)
        steps.append((source, scale))
    for small, scale in reversed(steps):
        start = (pixels + 0.5) / scale - 0.5
        side = grids.local_side(start, board.columns, board.rows)
        refined = refine_corners(small, start, side, "saddle")
        good = ((refined.status == CornerStatus.GOOD) & (side >= MIN_REFINED_SIDE))[:, None]
        pixels = to_full_size(torch.where(good, refined.pixels, start), scale)
    return pixels


def reduced(image: Gray, factor: float, whole: tuple[int, int]) -> tuple[Gray, Tensor]:
    """An image of the original size `whole` made `factor` times smaller by averaging, and the exact scale back."""
    width, height = whole
    if factor <= 1:
        return image, torch.ones(2, dtype=torch.float64)
    size = round(width / factor), round(height / factor)
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(image.dtype, copy=False)
    return small, torch.tensor([width / size[0], height / size[1]], dtype=torch.float64)


def to_full_size(pixels: Tensor, scale: Tensor) -> Tensor:
    """Convert pixels of a reduced image to the original's: edges coincide at -0.5, not centers of the first pixels."""
    return (pixels + 0.5) * scale - 0.5


def largest_grid(image: Gray, flags: int = cv2.CALIB_CB_EXHAUSTIVE) -> Tensor | None:
    """The corners of the largest checkerboard grid in an image, (rows, columns, 2), at least 3x3; None without one."""
    found, corners, meta = in_new_thread(
        cv2.findChessboardCornersSBWithMeta, image, (3, 3), flags | cv2.CALIB_CB_LARGER
    )
    if not found:
        return None
    return torch.from_numpy(corners.reshape(*meta.shape[:2], 2).astype(np.float64))


def seeds(image: npt.NDArray[np.uint8]) -> Iterator[Tensor]:
    """Grids of corners, of which some are right where others have glare or an edge of paper among them."""
    equalized = _equalized(image)
    thorough = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    for source, flags in ((image, cv2.CALIB_CB_EXHAUSTIVE), (equalized, 0), (image, thorough), (equalized, thorough)):
        grid = largest_grid(source, flags)
        if grid is not None:
            yield grid


def search_sizes(image: npt.NDArray[np.uint8]) -> Iterator[_Size]:
    """The image at the sizes at which boards are sought, smallest first, each size once."""
    for factor in sorted({max(1.0, max(image.shape) / side) for side in SEARCH_SIDES}, reverse=True):
        small, scale = reduced(image, factor, (image.shape[1], image.shape[0]))
        yield factor, np.asarray(small, np.uint8), scale


def _find_classic(image: Gray, board: Board) -> Tensor | None:
    found, corners = cv2.findChessboardCorners(image, (board.columns, board.rows), flags=_CLASSIC)
    return torch.from_numpy(corners.reshape(-1, 2).astype(np.float64)) if found else None


def find_sector(image: Gray, board: Board, flags: int = 0) -> Tensor | None:
    """The corners that `findChessboardCornersSB` finds, (corners, 2), or None."""
    found, corners = in_new_thread(cv2.findChessboardCornersSB, image, (board.columns, board.rows), flags=flags)
    return torch.from_numpy(corners.reshape(-1, 2).astype(np.float64)) if found else None


def _find_shadowed(image: npt.NDArray[np.uint8], board: Board) -> Tensor | None:
    return find_sector(_equalized(image), board, cv2.CALIB_CB_EXHAUSTIVE)


def _equalized(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    return np.asarray(cv2.createCLAHE(_LOCAL_CONTRAST, _TILES).apply(image), dtype=np.uint8)


def in_new_thread(detector: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Call a detector in a new thread.

    OpenCV's random numbers have one state per thread. In a new thread the same image always gives the same corners,
    and the caller's state does not change.
    """
    with ThreadPoolExecutor(1) as fresh:
        return fresh.submit(detector, *arguments, **options).result()
