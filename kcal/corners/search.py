"""Search an image for a checkerboard: OpenCV's detectors, in the order that measurement found best, then its parts."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.grid import local_side
from kcal.corners.grid_check import grid_trouble
from kcal.corners.images import Gray
from kcal.corners.order import canonical_order
from kcal.corners.part import find_part
from kcal.corners.refine import refine_corners
from kcal.corners.saddle import CornerStatus

SEARCH_SIDES = (1200, 2400)  # pixels: longer sides of the searched image, small first
MIN_REFINED_SIDE = 8.0  # pixels: smaller squares in a reduced image are not refined there

_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_LOCAL_CONTRAST, _TILES = 4.0, (8, 8)  # of the adaptive histogram equalization


class FoundBoard(NamedTuple):
    """What a search found.

    Args:
        pixels: (corners, 2) in the board's order, good to about a pixel of the searched image; NaN where a corner was
            not found. None if the board was not found.
        factor: how many times smaller the searched image was.
        reason: why the board was not found.
        rejected: (N, 2) corners of a grid that is not the board, or that could not be told to be.
    """

    pixels: Tensor | None
    factor: float = 1.0
    reason: str = ""
    rejected: Tensor | None = None


def find_board(image: npt.NDArray[np.uint8], board: Board) -> FoundBoard:
    """Find a checkerboard's corners to about a pixel of the searched size.

    `findChessboardCorners` goes first: it is the fastest and finds most boards. `findChessboardCornersSB` (A. Duda and
    U. Frese, BMVC 2018) finds blurred ones that the first does not; on an image of equalized local contrast, shadowed
    ones. Where none finds the whole board, a part is sought whose place in the board is certain
    (`kcal.corners.part.find_part`). Images above 1200 px are searched at that size, then at 2400 px.

    Args:
        image: (H, W) uint8.
        board: a checkerboard of at least 3x3 inner corners.
    """
    missing = FoundBoard(None, reason=f"no board of {board.columns}x{board.rows} inner corners found")
    sizes = [(factor, *_reduced_8bit(image, factor)) for factor in _factors(image)]
    for factor, small, scale in sizes:
        for find in (_find_classic, find_sector, _find_shadowed):
            corners = find(small, board)
            if corners is None:
                continue
            trouble = grid_trouble(small, corners, board.columns, board.rows)
            if trouble is None:
                return FoundBoard(to_full_size(canonical_order(small, corners, board), scale), factor)
            if missing.rejected is None:
                missing = FoundBoard(None, reason=trouble, rejected=to_full_size(corners, scale))
    factor, small, scale = sizes[0]
    part = find_part(small, board, _seeds(small))
    if part.pixels is not None:
        return FoundBoard(to_full_size(part.pixels, scale), factor)
    if part.rejected is not None and (part.other or missing.rejected is None):
        return FoundBoard(None, reason=part.reason, rejected=to_full_size(part.rejected, scale))
    return missing


def refine_through_sizes(image: Gray, pixels: Tensor, board: Board, factor: float) -> Tensor:
    """Refine corners found on an image `factor` times smaller until refinement at full size can start from them.

    The first steps use images four and two times smaller still: where OpenCV's own refinement failed, it leaves single
    corners 3 px off, too far for full size. Squares too small for refinement are left as they are.
    """
    whole = image.shape[1], image.shape[0]
    factors = []
    factor = 4 * factor
    while factor > 1:
        factors.append(factor)
        factor = factor / 2
    # Each is reduced from the one twice as large, because reducing the largest image takes the time.
    steps, source = [], image
    for factor in reversed(factors):
        source, scale = reduced(source, factor, whole)
        steps.append((source, scale))
    for small, scale in reversed(steps):
        start = (pixels + 0.5) / scale - 0.5
        side = local_side(start, board.columns, board.rows)
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
    found, corners, meta = _in_new_thread(
        cv2.findChessboardCornersSBWithMeta, image, (3, 3), flags | cv2.CALIB_CB_LARGER
    )
    if not found:
        return None
    return torch.from_numpy(corners.reshape(*meta.shape[:2], 2).astype(np.float64))


def _seeds(image: npt.NDArray[np.uint8]) -> Iterator[Tensor]:
    """Grids of corners, of which some are right where others have glare or an edge of paper among them."""
    equalized = _equalized(image)
    thorough = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_NORMALIZE_IMAGE
    for source, flags in ((image, cv2.CALIB_CB_EXHAUSTIVE), (equalized, 0), (image, thorough), (equalized, thorough)):
        grid = largest_grid(source, flags)
        if grid is not None:
            yield grid


def _reduced_8bit(image: npt.NDArray[np.uint8], factor: float) -> tuple[npt.NDArray[np.uint8], Tensor]:
    small, scale = reduced(image, factor, (image.shape[1], image.shape[0]))
    return small.astype(np.uint8, copy=False), scale


def _factors(image: Gray) -> list[float]:
    longest = max(image.shape)
    return sorted({max(1.0, longest / side) for side in SEARCH_SIDES}, reverse=True)


def _find_classic(image: Gray, board: Board) -> Tensor | None:
    found, corners = cv2.findChessboardCorners(image, (board.columns, board.rows), flags=_CLASSIC)
    return torch.from_numpy(corners.reshape(-1, 2).astype(np.float64)) if found else None


def find_sector(image: Gray, board: Board, flags: int = 0) -> Tensor | None:
    """The corners that `findChessboardCornersSB` finds, (corners, 2), or None."""
    found, corners = _in_new_thread(cv2.findChessboardCornersSB, image, (board.columns, board.rows), flags=flags)
    return torch.from_numpy(corners.reshape(-1, 2).astype(np.float64)) if found else None


def _find_shadowed(image: npt.NDArray[np.uint8], board: Board) -> Tensor | None:
    return find_sector(_equalized(image), board, cv2.CALIB_CB_EXHAUSTIVE)


def _equalized(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    return np.asarray(cv2.createCLAHE(_LOCAL_CONTRAST, _TILES).apply(image), dtype=np.uint8)


def _in_new_thread(detector: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Call a detector in a new thread.

    OpenCV's random numbers have one state per thread. In a new thread the same image always gives the same corners,
    and the caller's state does not change.
    """
    with ThreadPoolExecutor(1) as fresh:
        return fresh.submit(detector, *arguments, **options).result()
