"""Say which other board an image shows, where the one that was asked for is not found."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
import numpy.typing as npt

from kcal.corners.aprilgrid import BORDERS
from kcal.corners.board import TAGS, Board
from kcal.corners.board_text import DICTIONARIES
from kcal.corners.circles import round_blobs
from kcal.corners.markers import opencv_dictionary

# Larger dictionaries contain the smaller ones of their family, and take seconds to search.
_FAMILIES = (
    TAGS, "4x4_250", "5x5_250", "6x6_250", "7x7_250", "aruco_original", "aruco_mip_36h12", "apriltag_25h9",
    "apriltag_16h5",
)  # fmt: skip
_ENOUGH = 8  # markers of one dictionary, after which no other is searched
_MIN_MARKERS = 4  # fewer are found in pictures without any: markers of 16 cells have few errors to correct
_MIN_CIRCLES = 12
_ROUND = 0.83  # 4 pi area / perimeter²: squares have 0.79, circles seen from 45 degrees 0.94
_SIZES = (0.6, 1.6)  # of the median: sizes of circles of one grid, seen from aside


def seen_instead(
    image: npt.NDArray[np.uint8],
    board: Board,
    seen_size: Callable[[npt.NDArray[np.uint8]], tuple[int, int] | None],
) -> str:
    """Which board an image shows that is not the one asked for; empty if it shows none.

    Args:
        image: (H, W).
        board: that was asked for.
        seen_size: `kcal.corners.detect.seen_size`.
    """
    if markers := seen_markers(image, board):
        return markers
    if has_own_markers(image, board):
        return ""
    circles = seen_circles(image, board)
    if circles is not None:
        return circles
    found = seen_size(image)
    own = (max(board.columns, board.rows), min(board.columns, board.rows))
    plain = board.pattern == "checkerboard"
    if found is None or (found == own and plain and board.dictionary is None):
        return ""
    squares = found == (own[0] - 1, own[1] - 1) and plain
    advice = "count inner corners, not squares" if squares else f"give --board {found[0]}x{found[1]}"
    return f"a board of {found[0]}x{found[1]} was found: {advice}"


def seen_markers(image: npt.NDArray[np.uint8], board: Board) -> str:
    """Which markers an image shows that are not the board's; empty if it shows none.

    Example:
        >>> page = np.full((200, 200), 255, np.uint8)
        >>> for k in range(4):
        ...     x, y = 20 + 90 * (k % 2), 20 + 90 * (k // 2)
        ...     page[y : y + 70, x : x + 70] = opencv_dictionary("5x5_50").generateImageMarker(k, 70)
        >>> seen_markers(page, Board(columns=9, rows=6, square=0.025))
        'markers 0 to 3 of dictionary 5x5_50 were found: give --board charuco:COLUMNSxROWS:5x5_50'
    """
    name, border, numbers = _most_markers(image)
    if numbers:
        own = (name == board.dictionary and border == 1) or (name == TAGS and board.pattern == "aprilgrid")
        if own and any(board.first <= number < board.first + board.markers for number in numbers):
            return ""  # it may be this board, and the image's own reason says what is wrong
        found = f"markers {numbers[0]} to {numbers[-1]} of dictionary {name} were found"
        if name == TAGS and border == BORDERS[0]:
            return f"{found}: give --board aprilgrid:COLUMNSxROWS"
        return f"{found}: give --board charuco:COLUMNSxROWS:{name}"
    return ""


def seen_circles(image: npt.NDArray[np.uint8], board: Board) -> str | None:
    """What to say of a grid of circles in an image; None if there is none, empty if it may be the board's own."""
    count = _like_sized(image)
    if count < _MIN_CIRCLES:
        return None
    if board.pattern not in ("circles", "asymmetric"):
        return f"some {count} circles were found: give --board circles:COLUMNSxROWS or asymmetric:COLUMNSxROWS"
    if count == board.corners:
        return ""
    return (
        f"some {count} circles were found, the board has {board.corners}: check its columns and rows, and whether they "
        "are asymmetric"
    )


def has_own_markers(image: npt.NDArray[np.uint8], board: Board) -> bool:
    """Whether an image shows any marker of a ChArUco board or tag of an AprilGrid."""
    name = TAGS if board.pattern == "aprilgrid" else board.dictionary
    own = {*range(board.first, board.first + board.markers)}
    borders = BORDERS if board.pattern == "aprilgrid" else (1,)
    return name is not None and any(own & set(_read(image, name, border)) for border in borders)


def _most_markers(image: npt.NDArray[np.uint8]) -> tuple[str, int, list[int]]:
    """The dictionary of which most markers are seen, their border in cells, and their numbers."""
    best: tuple[str, int, list[int]] = ("", 1, [])
    for family in _FAMILIES:
        for border in BORDERS if family == TAGS else (1,):
            numbers = _read(image, family, border)
            if len(numbers) >= max(_MIN_MARKERS, len(best[2]) + 1):
                best = _smallest(family, numbers[-1]), border, numbers
            if len(numbers) >= _ENOUGH:
                return best
    return best


def _read(image: npt.NDArray[np.uint8], name: str, border: int) -> list[int]:
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits = border
    _, numbers, _ = cv2.aruco.ArucoDetector(opencv_dictionary(name), options).detectMarkers(image)
    return [] if numbers is None else sorted({int(number) for number in numbers.reshape(-1).tolist()})


def _smallest(family: str, highest: int) -> str:
    """The smallest dictionary of a family that contains a number."""
    stem = family.removesuffix("_250")
    sizes = [name for name in DICTIONARIES if name.startswith(f"{stem}_") and name[3:4] == "_"]
    return min((name for name in sizes if DICTIONARIES[name] > highest), key=DICTIONARIES.__getitem__, default=family)


def _like_sized(image: npt.NDArray[np.uint8]) -> int:
    """How many round spots of like size are seen, dark or light; a checkerboard has as many of both."""
    counts = []
    for picture in (image, 255 - image):
        sizes = np.array([blob.size for blob in round_blobs(picture, _ROUND)])
        middle = float(np.median(sizes)) if len(sizes) else 0.0
        counts.append(int(((sizes > _SIZES[0] * middle) & (sizes < _SIZES[1] * middle)).sum()))
    return max(counts) if min(counts) < max(counts) / 3 else 0
