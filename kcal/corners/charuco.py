"""Find ChArUco boards: checkerboards with markers in their light squares, so that a visible part is enough.

Parts seen at the image's border determine the lens there. OpenCV's `aruco.CharucoDetector` finds the markers and the
corners between them; kcal refines the corners, within what the markers leave free.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.erf_fit import SHARE
from kcal.corners.grid import as_grid, local_side
from kcal.errors import InputError

MIN_CORNERS = 6
_FREE_SHARE = 0.85  # of the distance from a corner to the nearest marker; the rest is left for blur


def find_charuco(image: npt.NDArray[np.uint8], board: Board) -> Tensor | None:
    """The corners of a ChArUco board, (corners, 2) in the board's order, NaN where not seen; None if too few.

    At least 6 corners are needed, two each on two rows and on two columns, so that they determine a pose.

    Raises:
        InputError: the board has no markers.
    """
    detector = cv2.aruco.CharucoDetector(_opencv_board(board))
    corners, ids, _, _ = detector.detectBoard(image)
    if ids is None or len(ids) == 0:
        return None
    pixels = torch.full((board.corners, 2), float("nan"), dtype=torch.float64)
    places = torch.from_numpy(np.asarray(ids, np.int64).reshape(-1))
    pixels[places] = torch.from_numpy(np.asarray(corners, np.float64).reshape(-1, 2))
    return pixels if enough(pixels, board) else None


def enough(pixels: Tensor, board: Board) -> bool:
    """Whether the seen corners determine a pose."""
    seen = torch.isfinite(as_grid(pixels, board.columns, board.rows)).all(-1)
    spread = min(int((seen.sum(side) >= 2).sum()) for side in (0, 1))
    return int(seen.sum()) >= MIN_CORNERS and spread >= 2


def free_side(pixels: Tensor, board: Board) -> Tensor:
    """The side of the squares (corners,) to pass to refinement, so that its window contains no marker.

    Raises:
        InputError: the board has no markers.
    """
    if board.marker is None:
        raise InputError(f"{board}: not a ChArUco board")
    side = local_side(pixels, board.columns, board.rows)
    # A corner without a neighbor gets the median side of the others.
    known = torch.isfinite(side)
    side = torch.where(known, side, side[known].median() if bool(known.any()) else 1.0)
    free = (board.square - board.marker) / board.square / math.sqrt(2.0)
    return side * min(1.0, _FREE_SHARE * free / SHARE)


def marker_cells(board: Board) -> list[npt.NDArray[np.bool_]]:
    """Which cells of each marker are black, border included, in the order of the light squares.

    Raises:
        InputError: the board has no markers.
    """
    dictionary = _opencv_board(board).getDictionary()
    cells = dictionary.markerSize + 2
    count = (board.columns + 1) * (board.rows + 1) // 2
    return [dictionary.generateImageMarker(number, cells, borderBits=1) == 0 for number in range(count)]


def _opencv_board(board: Board) -> cv2.aruco.CharucoBoard:
    if board.dictionary is None or board.marker is None:
        raise InputError(f"{board}: not a ChArUco board")
    name = f"DICT_{board.dictionary.upper()}"
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    return cv2.aruco.CharucoBoard((board.columns + 1, board.rows + 1), board.square, board.marker, dictionary)
