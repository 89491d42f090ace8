"""The black shapes of a board's pattern, in millimeters."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from kcal.corners.board import TAGS, Board
from kcal.corners.drawing import Circle, Rectangle
from kcal.corners.markers import marker_cells, opencv_dictionary

CIRCLE_SHARE = 0.5  # of the least distance of two centers: the diameter of circles that are printed without one
TAG_BORDER = 2  # cells: Kalibr draws tags with a border of two cells, other makers of tags one


class PatternShapes(NamedTuple):
    """A pattern from its left upper end on.

    Args:
        width, height: millimeters.
        margin: white that detectors need around it, millimeters.
        origin: where the origin of `Board.points` lies, millimeters.
        rectangles, circles: what is black.
    """

    width: float
    height: float
    margin: float
    origin: tuple[float, float]
    rectangles: tuple[Rectangle, ...] = ()
    circles: tuple[Circle, ...] = ()


def pattern_shapes(board: Board) -> PatternShapes:
    """The pattern of a board, as it is printed.

    Example:
        >>> shapes = pattern_shapes(Board.parse("circles:7x6:10mm", "20mm"))
        >>> shapes.width, shapes.origin, len(shapes.circles)
        (130.0, (5.0, 5.0), 42)
    """
    if board.pattern == "aprilgrid":
        return _april_shapes(board)
    return _square_shapes(board) if board.pattern == "checkerboard" else _circle_shapes(board)


def _square_shapes(board: Board) -> PatternShapes:
    square = board.square * 1000
    shapes = [
        Rectangle(x=column * square, y=row * square, width=square, height=square)
        for row in range(board.rows + 1)
        for column in range(board.columns + 1)
        if (row + column) % 2 == 0
    ]
    if board.marker is not None:
        side = board.marker * 1000
        light = [(r, c) for r in range(board.rows + 1) for c in range(board.columns + 1) if (r + c) % 2 == 1]
        for (row, column), cells in zip(light, marker_cells(board), strict=True):
            shapes += _marker_shapes(
                column * square + (square - side) / 2, row * square + (square - side) / 2, side, cells
            )
    width, height = (board.columns + 1) * square, (board.rows + 1) * square
    return PatternShapes(width, height, square, (square, square), tuple(shapes))


def _circle_shapes(board: Board) -> PatternShapes:
    diameter = 1000 * (board.diameter or CIRCLE_SHARE * board.spacing)
    width, height = (1000 * side + diameter for side in board.extent)
    places = (1000 * board.points[:, :2] + diameter / 2).tolist()
    circles = tuple(Circle(x=x, y=y, diameter=diameter) for x, y in places)
    margin = max(1000 * board.spacing - diameter / 2, diameter / 2)
    return PatternShapes(width, height, margin, (diameter / 2, diameter / 2), circles=circles)


def _april_shapes(board: Board) -> PatternShapes:
    """Tags, and squares as wide as the gap that touch their corners, so that four quadrants meet there."""
    assert board.gap is not None
    side, gap = 1000 * board.square, 1000 * board.gap
    across, down = board.columns // 2, board.rows // 2
    width, height = across * (side + gap) + gap, down * (side + gap) + gap
    pitch = side + gap
    shapes = [
        Rectangle(x=column * pitch, y=row * pitch, width=gap, height=gap)
        for row in range(down + 1)
        for column in range(across + 1)
    ]
    for number in range(board.markers):
        row, column = divmod(number, across)  # rows of tags count upward
        shapes += _marker_shapes(
            gap + column * pitch, gap + (down - 1 - row) * pitch, side, tag_cells(board.first + number)
        )
    return PatternShapes(width, height, gap, (gap, height - gap), tuple(shapes))


def tag_cells(number: int) -> npt.NDArray[np.bool_]:
    """Which cells of a tag of family 36h11 are black, (10, 10) with Kalibr's border of two cells.

    OpenCV's dictionary has the tags turned by half a turn against those of the AprilTag library and of Kalibr.
    """
    count = int(math.sqrt(36)) + 2 * TAG_BORDER
    dictionary = opencv_dictionary(TAGS)
    upright = cv2.rotate(dictionary.generateImageMarker(number, count, borderBits=TAG_BORDER), cv2.ROTATE_180)
    return np.asarray(upright == 0)


def _marker_shapes(x: float, y: float, side: float, cells: npt.NDArray[np.bool_]) -> list[Rectangle]:
    """The black cells of a marker, each run along a row as one rectangle."""
    cell = side / len(cells)
    shapes = []
    for i, line in enumerate(cells.tolist()):
        begin = 0
        for black, run in itertools.groupby(line):
            length = len(list(run))
            if black:
                shapes.append(Rectangle(x=x + begin * cell, y=y + i * cell, width=length * cell, height=cell))
            begin += length
    return shapes
