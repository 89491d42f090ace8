"""Find ChArUco boards: checkerboards with markers in their light squares, so that a visible part is enough.

Parts seen at the image's border determine the lens there. OpenCV's `aruco.ArucoDetector` reads the markers and its
`aruco.CharucoDetector` finds the corners beside them; kcal adds the corners of markers that were not read, which follow
from those beside them, and refines all within what the markers leave free.

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
from kcal.corners.erf_fit import SHARE
from kcal.corners.grid import as_grid, local_side
from kcal.corners.grow import filled_grid
from kcal.corners.layout import in_place
from kcal.corners.markers import opencv_dictionary
from kcal.errors import InputError

MIN_CORNERS = 6
_FREE_SHARE = 0.85  # of the distance from a corner to the nearest marker; the rest is left for blur
# Of a square: distance of a marker's corner from the homography of all of them. Wide lenses stay below in the middle
# of the image, markers of the other numbering are a square off.
_TOLERANCE = 0.35
_MOST = 0.7  # of the markers: if so many lie as on one board or the other, the image shows both
_MIN_MARKERS = 3  # that agree on one numbering; two of them fit any
_MIN_UNSURE = 5  # the same where wrong bits had to be corrected
FEW = 0.6  # of the markers: if fewer are read, more effort is made
MOST_ENLARGED = 3_000_000  # pixels: larger images are not searched twice
Markers = dict[int, npt.NDArray[np.float64]]  # the corners (4, 2) of each


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
    if board.dictionary is None:
        raise InputError(f"{board}: not a ChArUco board")
    found, others = read_markers(image, board, board.dictionary)
    own = _single(found)
    twice = sorted(found.keys() - own)
    if twice:
        return FoundCharuco(
            None, f"marker {twice[0]} is seen twice: two boards need different numbers (:idFIRST), or hide one of them"
        )
    seen = own
    if len(own) < FEW * board.markers:
        # Markers with wrong bits as well, and small ones. Those that are read wrongly do not lie where they should.
        more, _ = read_markers(image, board, board.dictionary, correction=1.0)
        seen = read_enlarged(image, board, board.dictionary)[0] | _single(more) | own
    today, before = ({} if len(seen) < _MIN_MARKERS else _fitting_markers(seen, board, old) for old in (False, True))
    told: bool | None = None
    if board.rows % 2 and len(seen) >= _MIN_MARKERS:
        several = min(len(today.keys() - before), len(before.keys() - today)) >= _MIN_MARKERS
        if several and len(today | before) >= _MOST * len(seen):
            return FoundCharuco(
                None,
                f"{len(today.keys() - before)} markers lie as on boards of today only, "
                f"{len(before.keys() - today)} as on those of OpenCV before 4.6 only: two boards; hide one",
            )
        # Markers in the middle of some boards lie alike in both but for a shift.
        told = None if len(today) == len(before) else len(before) > len(today)
    old = bool(legacy if told is None else told)
    markers = before if old else today
    sure = len(markers.keys() & own)
    if 2 * sure >= len(own) and (sure >= _MIN_MARKERS or len(markers) >= _MIN_UNSURE):
        pixels = _between(image, markers, board, old)
        if enough(pixels, board):
            return FoundCharuco(pixels, legacy=told)
    reason = f"fewer than {MIN_CORNERS} corners of the ChArUco board found, or all on one line"
    if len(own) >= _MIN_MARKERS and 2 * max(len(fitting.keys() & own) for fitting in (today, before)) < len(own):
        reason = "the markers do not lie as on this board: check its columns, rows, dictionary and first number"
    elif others and not own:
        reason += f"; markers {min(others)} to {max(others)} of {board.dictionary} are another board's"
    return FoundCharuco(None, reason)


def read_markers(
    image: npt.NDArray[np.uint8], board: Board, dictionary: str, border: int = 1, correction: float = 0.6
) -> tuple[dict[int, list[npt.NDArray[np.float64]]], list[int]]:
    """The board's markers by number, and other numbers that were seen.

    Args:
        image: (H, W).
        board: with markers or tags.
        dictionary: their name.
        border: cells.
        correction: share of the wrong bits that the dictionary allows to correct.
    """
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits, options.errorCorrectionRate = border, correction
    options.perspectiveRemovePixelPerCell = 8
    found, numbers, _ = cv2.aruco.ArucoDetector(opencv_dictionary(dictionary), options).detectMarkers(image)
    markers: dict[int, list[npt.NDArray[np.float64]]] = {}
    others: list[int] = []
    for corners, number in zip(found, [] if numbers is None else map(int, numbers.reshape(-1)), strict=True):
        if board.first <= number < board.first + board.markers:
            markers.setdefault(number, []).append(np.asarray(corners, np.float64).reshape(4, 2))
        else:
            others.append(number)
    return markers, others


def read_enlarged(
    image: npt.NDArray[np.uint8], board: Board, dictionary: str, border: int = 1, sharpen: float = 0.0
) -> tuple[Markers, list[int]]:
    """The same in an image twice as large, where OpenCV reads markers of 20 px and less.

    More wrong bits are corrected: a marker that is read wrongly does not lie where it should. `sharpen` adds a share of
    what a blur of 1.5 px takes away.
    """
    if image.size > MOST_ENLARGED:
        return {}, []
    double = np.asarray(cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), np.uint8)
    if sharpen:
        soft = cv2.GaussianBlur(double, (0, 0), 3.0)
        double = np.asarray(cv2.addWeighted(double, 1.0 + sharpen, soft, -sharpen, 0.0), np.uint8)
    found, others = read_markers(double, board, dictionary, border, correction=1.0)
    return {number: (corners + 0.5) / 2 - 0.5 for number, corners in _single(found).items()}, others


def _single(found: dict[int, list[npt.NDArray[np.float64]]]) -> Markers:
    """Those that were seen once."""
    return {number: corners[0] for number, corners in found.items() if len(corners) == 1}


def _between(image: npt.NDArray[np.uint8], markers: Markers, board: Board, legacy: bool) -> Tensor:
    """The corners beside markers, and those that can be grown from them; NaN for others."""
    pixels = torch.full((board.corners, 2), torch.nan, dtype=torch.float64)
    options = cv2.aruco.CharucoParameters()
    options.minMarkers = 1
    corners = [corners.astype(np.float32)[None] for corners in markers.values()]
    numbers = np.array(list(markers), np.int32)[:, None]
    detector = cv2.aruco.CharucoDetector(_opencv_board(board, legacy), options)
    places, ids, _, _ = detector.detectBoard(image, markerCorners=corners, markerIds=numbers)
    if ids is None or not len(ids):
        return pixels
    order = torch.from_numpy(np.asarray(ids, np.int64).reshape(-1))
    pixels[order] = torch.from_numpy(np.asarray(places, np.float64).reshape(-1, 2))
    grid = as_grid(pixels, board.columns, board.rows)
    return filled_grid(image, grid, _FREE_SHARE * _white_border(board)).reshape(-1, 2)


def _fitting_markers(seen: Markers, board: Board, legacy: bool) -> Markers:
    """The markers that lie as one of the two numberings has them."""
    corners = _opencv_board(board, legacy).getObjPoints()
    placed = np.stack([np.asarray(corners[number - board.first])[:, :2] for number in seen])
    good = in_place(placed, np.stack(list(seen.values())), _TOLERANCE * board.square)
    return {number: seen[number] for number, fits in zip(seen, good.tolist(), strict=True) if fits}


def _white_border(board: Board) -> float:
    """The white between a marker and its square's edge, as a share of the square."""
    assert board.marker is not None
    return 0.5 * (board.square - board.marker) / board.square


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
    return side * min(1.0, _FREE_SHARE * math.sqrt(2.0) * _white_border(board) / SHARE)


def _opencv_board(board: Board, legacy: bool = False) -> cv2.aruco.CharucoBoard:
    if board.dictionary is None or board.marker is None:
        raise InputError(f"{board}: not a ChArUco board")
    numbers = np.arange(board.first, board.first + board.markers, dtype=np.int32)
    made = cv2.aruco.CharucoBoard(
        (board.columns + 1, board.rows + 1), board.square, board.marker, opencv_dictionary(board.dictionary), numbers
    )
    made.setLegacyPattern(legacy)
    return made
