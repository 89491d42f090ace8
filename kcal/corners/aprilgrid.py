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
from kcal.corners.charuco import FEW, MIN_CORNERS, Markers, enough, read_enlarged, read_markers
from kcal.corners.erf_fit import SHARE
from kcal.corners.layout import agreeing, board_homography
from kcal.corners.saddle import CornerStatus, inside_image, saddle

BORDERS = (2, 1)  # cells: Kalibr's own tags, and those of other makers
_CELLS = 6  # of a tag of this family, without its border
_FREE_SHARE = 0.85  # of the distance from a corner to what else is printed; the rest is left for blur
_TOLERANCE = 0.3  # of a tag: distance from where its neighbors put it; a wrong tag is 1.3 off
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.05)
_SHARPEN = 1.5  # small and blurred tags are read where what blur takes away is added so many times
_MIN_SEEN = 3, 2  # corners that must be where its neighbors put them: of a tag inside the image, and of one cut by it
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
    for number, corners in _with_unread(image, placed, board, turn, share).items():
        places = _tag_places(number, board, turn)
        edge = float(np.linalg.norm(corners - np.roll(corners, 1, 0), axis=1).min())
        moved = torch.from_numpy(_nearer(image, corners, edge))
        # Corners whose window leaves the image would spoil what the others tell of the light.
        inside = inside_image(moved, torch.full((4,), SHARE * share * edge), image.shape[1], image.shape[0])
        pixels[places] = torch.where(inside[:, None], moved, torch.nan)
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
        tags, others = read_markers(image, board, TAGS, border)
        if (len(tags), len(others)) > (len(best[1]), len(best[2])):
            best = border, tags, others
    border, tags, others = best
    for sharpen, enough_tags in ((0.0, 1.0), (_SHARPEN, FEW)):
        if len(tags) >= enough_tags * board.markers:
            break
        large, more = read_enlarged(image, board, TAGS, border, sharpen)
        tags |= {number: [corners] for number, corners in large.items() if number not in tags}
        others += more
    return border, tags, others


def _nearer(image: npt.NDArray[np.uint8], corners: npt.NDArray[np.float64], edge: float) -> npt.NDArray[np.float64]:
    """Corners moved near enough for kcal's refinement, in windows that reach no cell inside the tag; NaN outside."""
    limit = np.array(image.shape[::-1]) - 1.0
    inside = ((corners >= 0) & (corners <= limit)).all(1, keepdims=True)
    half = int(np.clip(0.12 * edge, 2, 5))
    start = np.ascontiguousarray(corners.clip(0, limit), np.float32).reshape(-1, 1, 2)
    moved = cv2.cornerSubPix(image, start.copy(), (half, half), (-1, -1), _STOP).reshape(-1, 2).astype(np.float64)
    near = np.linalg.norm(moved - corners, axis=1, keepdims=True) < half
    return np.where(inside, np.where(near, moved, corners), np.nan)


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


def _with_unread(image: npt.NDArray[np.uint8], placed: Markers, board: Board, turn: int, share: float) -> Markers:
    """Tags, and those that were not read but have corners where the tags beside them put them.

    Args:
        image: (H, W).
        placed: tags by number.
        board: an AprilGrid.
        turn: of the tags.
        share: of a tag's edge, the side to pass to refinement.
    """
    points, light = board.points[:, :2].numpy(), torch.from_numpy(image)
    cells = {board.first + n: np.array(divmod(n, board.columns // 2)) for n in range(board.markers)}
    tags = dict(placed)
    while True:
        guessed = {}
        for number in cells.keys() - tags:
            away = {other: float(np.abs(cells[other] - cells[number]).max()) for other in tags}
            near = sorted(tags, key=lambda other: away[other])[:_NEIGHBORS]
            if away[near[0]] > 1:
                continue
            board_from_image = board_homography(
                np.concatenate([points[_tag_places(other, board, turn)] for other in near]),
                np.concatenate([tags[other] for other in near]),
            )
            if board_from_image is not None:
                own = points[_tag_places(number, board, turn)]
                guessed[number] = cv2.perspectiveTransform(own[None], np.linalg.inv(board_from_image))[0]
        if not guessed:
            return tags
        starts = torch.from_numpy(np.stack(list(guessed.values())))
        edges = torch.linalg.vector_norm(starts - starts.roll(1, 1), dim=-1).amin(1).clamp_min(1.0)
        found = saddle(light, starts.reshape(-1, 2), (share * edges).repeat_interleave(4))
        good = (found.status == CornerStatus.GOOD).reshape(-1, 4)
        corners = torch.where(good[..., None], found.pixels.reshape(-1, 4, 2), starts)
        whole = inside_image(starts, torch.zeros(starts.shape[:2]), image.shape[1], image.shape[0]).all(-1)
        enough_seen = good.sum(-1) >= torch.where(whole, *_MIN_SEEN)
        new = {n: c.numpy() for n, c, is_there in zip(guessed, corners, enough_seen.tolist(), strict=True) if is_there}
        if not new:
            return tags
        tags |= new
