"""Find ChArUco boards: checkerboards with markers in their light squares, so that a visible part is enough.

Parts seen at the image's border determine the lens there. OpenCV's `aruco.CharucoDetector` finds the markers and the
corners between them; kcal refines the corners, within what the markers leave free.

OpenCV before 4.6 drew boards with an even number of rows of squares with a light square, and marker 0, at the left
upper end; since then it is a dark one. Which of the two an image shows follows from its markers.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.board_text import DICTIONARIES
from kcal.corners.erf_fit import SHARE
from kcal.corners.grid import as_grid, local_side
from kcal.corners.layout import inliers
from kcal.errors import InputError

MIN_CORNERS = 6
_FREE_SHARE = 0.85  # of the distance from a corner to the nearest marker; the rest is left for blur
# Of a square: distance of a marker's corner from the homography of all of them. Wide lenses stay below in the middle
# of the image, markers of the other numbering are a square off.
_TOLERANCE = 0.35
_MOST = 0.7  # of the markers: if so many lie as on one board or the other, the image shows both
_MIN_MARKERS = 3  # that agree on one numbering; two of them fit any


class FoundCharuco(NamedTuple):
    """A ChArUco board in an image.

    Args:
        pixels: (corners, 2) in the board's order, NaN where not seen; None if too few are.
        reason: why.
        legacy: whether the numbering is that of OpenCV before 4.6; None where both are the same or too little is seen
            to tell.
    """

    pixels: Tensor | None
    reason: str = ""
    legacy: bool | None = None


def find_charuco(image: npt.NDArray[np.uint8], board: Board, legacy: bool | None = None) -> FoundCharuco:
    """The corners of a ChArUco board.

    At least 6 corners are needed, two each on two rows and on two columns, so that they determine a pose.

    Args:
        image: (H, W).
        board: with markers.
        legacy: the numbering to assume where the image does not tell; None is that of today.

    Raises:
        InputError: the board has no markers.
    """
    _, _, markers, numbers = cv2.aruco.CharucoDetector(_opencv_board(board)).detectBoard(image)
    found = [] if numbers is None else [int(number) for number in numbers.reshape(-1).tolist()]
    corners = [np.asarray(marker, np.float64).reshape(4, 2) for marker in markers] if found else []
    seen = [(n, c) for n, c in zip(found, corners, strict=True) if _is_own(n, board)]
    own = [number for number, _ in seen]
    twice = sorted({number for number in own if own.count(number) > 1})
    if twice:
        return FoundCharuco(
            None, f"marker {twice[0]} is seen twice: two boards need different numbers (:idFIRST), or hide one of them"
        )
    told: bool | None = None
    if board.rows % 2 and len(own) >= _MIN_MARKERS:
        today, before = (_fitting_markers(dict(seen), board, old) for old in (False, True))
        several = min(len(today - before), len(before - today)) >= _MIN_MARKERS
        if several and len(today | before) >= _MOST * len(own):
            return FoundCharuco(
                None,
                f"{len(today - before)} markers lie as on boards of today only, {len(before - today)} as on those of "
                "OpenCV before 4.6 only: two boards; hide one",
            )
        # Markers in the middle of some boards lie alike in both but for a shift.
        told = None if len(today) == len(before) else len(before) > len(today)
    detector = cv2.aruco.CharucoDetector(_opencv_board(board, bool(legacy if told is None else told)))
    places, ids, _, _ = detector.detectBoard(image)
    pixels = torch.full((board.corners, 2), float("nan"), dtype=torch.float64)
    if ids is not None and len(ids):
        order = torch.from_numpy(np.asarray(ids, np.int64).reshape(-1))
        pixels[order] = torch.from_numpy(np.asarray(places, np.float64).reshape(-1, 2))
    if enough(pixels, board):
        return FoundCharuco(pixels, legacy=told)
    reason = f"fewer than {MIN_CORNERS} corners of the ChArUco board found, or all on one line"
    fitting = [_fitting_markers(dict(seen), board, old) for old in (False, True)] if seen else []
    if len(own) >= _MIN_MARKERS and 2 * max(map(len, fitting)) < len(own):
        reason = "the markers do not lie as on this board: check its columns, rows, dictionary and first number"
    elif found and not own:
        reason += f"; markers {min(found)} to {max(found)} of {board.dictionary} are another board's"
    return FoundCharuco(None, reason)


def _fitting_markers(seen: dict[int, npt.NDArray[np.float64]], board: Board, legacy: bool) -> set[int]:
    """Numbers of the markers that lie as one of the two numberings has them."""
    corners = _opencv_board(board, legacy).getObjPoints()
    placed = np.stack([np.asarray(corners[number - board.first])[:, :2] for number in seen])
    good = inliers(placed, np.stack(list(seen.values())), _TOLERANCE * board.square)
    return {number for number, fits in zip(seen, good.tolist(), strict=True) if fits}


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
    if board.dictionary is None:
        raise InputError(f"{board}: not a ChArUco board")
    dictionary = opencv_dictionary(board.dictionary)
    cells = dictionary.markerSize + 2
    numbers = range(board.first, board.first + board.markers)
    return [dictionary.generateImageMarker(number, cells, borderBits=1) == 0 for number in numbers]


def opencv_dictionary(name: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a name in `DICTIONARIES`.

    Raises:
        InputError: an unknown name.
    """
    if name not in DICTIONARIES:
        raise InputError(f"dictionary {name!r}: choose one of {', '.join(DICTIONARIES)}")
    dictionary: cv2.aruco.Dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name.upper()}"))
    return dictionary


def _is_own(number: int, board: Board) -> bool:
    return board.first <= number < board.first + board.markers


def _opencv_board(board: Board, legacy: bool = False) -> cv2.aruco.CharucoBoard:
    if board.dictionary is None or board.marker is None:
        raise InputError(f"{board}: not a ChArUco board")
    numbers = np.arange(board.first, board.first + board.markers, dtype=np.int32)
    made = cv2.aruco.CharucoBoard(
        (board.columns + 1, board.rows + 1), board.square, board.marker, opencv_dictionary(board.dictionary), numbers
    )
    made.setLegacyPattern(legacy)
    return made
