"""Find AprilGrids, the boards of Kalibr: tags of family 36h11, with small black squares that touch their corners.

A visible part is enough. OpenCV's `aruco.ArucoDetector` finds the tags. Where a tag and a small square touch, four
quadrants meet as on a checkerboard, so that kcal's own refinement finds the corner; a board without the small squares
has no such points and is refused.

Geometry after https://github.com/ethz-asl/kalibr, its wiki page "Calibration targets" and its class
`GridCalibrationTargetAprilgrid`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from kcal.corners.board import TAGS, Board
from kcal.corners.charuco import MIN_CORNERS, enough, opencv_dictionary
from kcal.corners.erf_fit import SHARE
from kcal.corners.layout import agreeing, board_homography

BORDERS = (2, 1)  # cells: Kalibr's own tags, and those of other makers
_CELLS = 6  # of a tag of this family, without its border
_FREE_SHARE = 0.85  # of the distance from a corner to what else is printed; the rest is left for blur
_TOLERANCE = 0.3  # of a tag: distance from where its neighbors put it; a wrong tag is 1.3 off
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.05)
_MOST_ENLARGED = 3_000_000  # pixels: larger images are not searched twice
_NEIGHBORS = 4  # tags that tell where one should be: few, because lenses bend the board
# Quarter turns of the tags against OpenCV's dictionary: those of the AprilTag library are turned by half a turn.
_TURNS = (2, 0, 1, 3)


class FoundTags(NamedTuple):
    """An AprilGrid in an image.

    Args:
        pixels: (corners, 2) in the board's order to about a pixel, NaN where not seen; None if too few are.
        side: (corners,) the side of squares to pass to refinement, so that its window contains nothing else.
        reason: why too few were found.
    """

    pixels: Tensor | None
    side: Tensor
    reason: str = ""


def find_aprilgrid(image: npt.NDArray[np.uint8], board: Board) -> FoundTags:
    """The corners of an AprilGrid's tags; two tags at least.

    Example:
        >>> find_aprilgrid(np.full((100, 100), 200, np.uint8), Board.parse("aprilgrid:6x6", "25mm")).reason
        'fewer than 2 tags of the AprilGrid found'
    """
    assert board.gap is not None
    nothing = torch.full((board.corners,), float("nan"), dtype=torch.float64)
    border, tags, others = _most_tags(image, board)
    if others and not tags:
        return FoundTags(
            None,
            nothing,
            f"tags {min(others)} to {max(others)} are seen, the board has {board.first} to "
            f"{board.first + board.markers - 1}: another board, or give its first number (:idFIRST)",
        )
    twice = [number for number, found in tags.items() if len(found) > 1]
    if twice:
        return FoundTags(
            None, nothing, f"tag {twice[0]} is seen twice: two boards need different numbers (:idFIRST), or hide one"
        )
    if len(tags) < 2:
        return FoundTags(None, nothing, "fewer than 2 tags of the AprilGrid found")
    seen = {number: found[0] for number, found in tags.items()}
    counts = {turn: _agreement(seen, board, turn) for turn in _TURNS}
    turn = max(_TURNS, key=lambda turn: counts[turn])
    placed = _in_place(seen, board, turn)
    # Two tags agree with any place of them that only shifts and scales; a third must as well.
    if counts[turn] < min(3, len(seen)) or 2 * len(placed) < len(seen):
        return FoundTags(
            None,
            nothing,
            f"the {len(seen)} tags found do not lie as on this board: check how many it has in a row; numbers must "
            "grow to the right and upward from the lower left",
        )
    pixels = torch.full((board.corners, 2), float("nan"), dtype=torch.float64)
    side = nothing.clone()
    share = _FREE_SHARE / SHARE * min(math.sqrt(2.0) * border / (_CELLS + 2 * border), board.gap / board.square)
    for number, corners in placed.items():
        places = _tag_places(number, board, turn)
        edge = float(np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).min())
        pixels[places] = torch.from_numpy(_nearer(image, corners, edge))
        side[places] = share * edge
    if not enough(pixels, board):
        return FoundTags(None, nothing, f"fewer than {MIN_CORNERS} corners of the AprilGrid's tags found")
    return FoundTags(pixels, side)


def _most_tags(
    image: npt.NDArray[np.uint8], board: Board
) -> tuple[int, dict[int, list[npt.NDArray[np.float64]]], list[int]]:
    """The border with which most tags are read, the board's tags by number, and other numbers that were seen."""
    best: tuple[int, dict[int, list[npt.NDArray[np.float64]]], list[int]] = (BORDERS[0], {}, [])
    for border in BORDERS:
        tags, others = _read_tags(image, board, border)
        if (len(tags), len(others)) > (len(best[1]), len(best[2])):
            best = border, tags, others
    border, tags, others = best
    if image.size <= _MOST_ENLARGED and len(tags) < board.markers:
        # OpenCV reads tags of 20 px and less in an image twice as large only.
        # More wrong bits are corrected there: a tag that is read wrongly does not lie where it should.
        double = np.asarray(cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), np.uint8)
        large, more = _read_tags(double, board, border, correction=1.0)
        tags |= {n: [(found[0] + 0.5) / 2 - 0.5] for n, found in large.items() if n not in tags and len(found) == 1}
        others += more
    return border, tags, others


def _read_tags(
    image: npt.NDArray[np.uint8], board: Board, border: int, correction: float = 0.6
) -> tuple[dict[int, list[npt.NDArray[np.float64]]], list[int]]:
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits, options.errorCorrectionRate = border, correction
    options.perspectiveRemovePixelPerCell = 8
    found, numbers, _ = cv2.aruco.ArucoDetector(opencv_dictionary(TAGS), options).detectMarkers(image)
    tags: dict[int, list[npt.NDArray[np.float64]]] = {}
    others: list[int] = []
    for corners, number in zip(found, [] if numbers is None else map(int, numbers.reshape(-1)), strict=True):
        if board.first <= number < board.first + board.markers:
            tags.setdefault(number, []).append(np.asarray(corners, np.float64).reshape(4, 2))
        else:
            others.append(number)
    return tags, others


def _nearer(image: npt.NDArray[np.uint8], corners: npt.NDArray[np.float64], edge: float) -> npt.NDArray[np.float64]:
    """Corners moved near enough for kcal's refinement, in windows that reach no cell inside the tag."""
    half = int(np.clip(0.12 * edge, 2, 5))
    start = np.ascontiguousarray(corners, np.float32).reshape(-1, 1, 2)
    moved = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), _STOP).reshape(-1, 2).astype(np.float64)
    near = np.linalg.norm(moved - corners, axis=1, keepdims=True) < half
    return np.where(near, moved, corners)


def _tag_places(number: int, board: Board, turn: int) -> list[int]:
    """Where on the board the four corners of a tag are, as OpenCV gives them: clockwise from the tag's left upper."""
    row, column = divmod(number - board.first, board.columns // 2)
    first = 2 * row * board.columns + 2 * column  # the lower left
    around = [first + board.columns, first + board.columns + 1, first + 1, first]
    return around[turn:] + around[:turn]


def _agreement(seen: dict[int, npt.NDArray[np.float64]], board: Board, turn: int) -> int:
    points = board.points[:, :2].numpy()
    placed = np.stack([points[_tag_places(number, board, turn)] for number in seen])
    return agreeing(placed, np.stack(list(seen.values())), _TOLERANCE * board.square)


def _in_place(seen: dict[int, npt.NDArray[np.float64]], board: Board, turn: int) -> dict[int, npt.NDArray[np.float64]]:
    """Those tags that lie where the tags next to them put them."""
    points = board.points[:, :2].numpy()
    kept = {}
    for number, corners in seen.items():
        near = sorted(
            (other for other in seen if other != number),
            key=lambda other: float(np.linalg.norm(seen[other].mean(0) - corners.mean(0))),
        )[:_NEIGHBORS]
        own = points[_tag_places(number, board, turn)]
        placed = np.stack([points[_tag_places(other, board, turn)] for other in near])
        around = np.stack([seen[other] for other in near])
        board_from_image = board_homography(placed.reshape(-1, 2), around.reshape(-1, 2))
        if board_from_image is None:
            continue
        there = cv2.perspectiveTransform(corners[None], board_from_image)[0]
        if np.linalg.norm(there - own, axis=1).mean() > _TOLERANCE * board.square:
            continue
        # OpenCV finds tags too small by up to 4 px at each corner; their neighbors correct that.
        both = board_homography(
            np.concatenate([placed, own[None]]).reshape(-1, 2), np.append(around, corners).reshape(-1, 2)
        )
        kept[number] = corners if both is None else cv2.perspectiveTransform(own[None], np.linalg.inv(both))[0]
    return kept
