"""The markers and tags that a board is printed with: apart from their detection, because torch takes long to load."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from kcal.corners.board import DICTIONARIES, Board
from kcal.errors import InputError
from kcal.opencv import cv2


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
