"""Boards with markers as other libraries find them: OpenCV's ArUco module, and AprilTag's own library if it is there.

AprilTag's library is a peer, never a dependency: `pip install --target DIR pupil-apriltags`, and DIR in PYTHONPATH.
"""

from __future__ import annotations

import functools
import importlib.util
import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.corners.board import TAGS, Board
from kcal.corners.markers import opencv_dictionary
from kcal.corners.print_board import TAG_BORDER

HAS_APRILTAG = importlib.util.find_spec("pupil_apriltags") is not None
Detector = Callable[[NDArray[np.uint8], Board], Tensor]  # (corners, 2), NaN where not found
Tags = dict[int, NDArray[np.float64]]  # the corners (4, 2) of each
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
_HALF = 2  # pixels: Kalibr's window of cornerSubPix


def charuco(refine: int = cv2.aruco.CORNER_REFINE_NONE, again: bool = False) -> Detector:
    """`CharucoDetector`; with `again`, markers that were not read are looked for where the others put them."""

    def find(image: NDArray[np.uint8], board: Board) -> Tensor:
        places, numbers, _, _ = _charuco_detector(board, refine, again).detectBoard(image)
        return _by_number(places, numbers, board)

    return find


def charuco_of_apriltag(image: NDArray[np.uint8], board: Board) -> Tensor:
    """Markers of AprilTag's library, and `CharucoDetector` for the corners between them."""
    tags = apriltags(image, border=1)
    if not tags:
        return _nothing(board)
    corners = [np.roll(tag, 2, 0).astype(np.float32)[None] for tag in tags.values()]
    numbers = np.array(list(tags), np.int32)[:, None]
    detector = _charuco_detector(board, cv2.aruco.CORNER_REFINE_NONE, False)
    places, found, _, _ = detector.detectBoard(image, markerCorners=corners, markerIds=numbers)
    return _by_number(places, found, board)


def aruco_grid(refine: int) -> Detector:
    """The tags of an AprilGrid by `ArucoDetector`."""

    def find(image: NDArray[np.uint8], board: Board) -> Tensor:
        options = cv2.aruco.DetectorParameters()
        options.markerBorderBits, options.cornerRefinementMethod = TAG_BORDER, refine
        found, numbers, _ = cv2.aruco.ArucoDetector(opencv_dictionary(TAGS), options).detectMarkers(image)
        seen = [] if numbers is None else map(int, numbers.reshape(-1))
        # OpenCV's dictionary has these tags turned by half a turn.
        return _placed({n: np.roll(tag.reshape(4, 2), 2, 0) for n, tag in zip(seen, found, strict=True)}, board)

    return find


def apriltag_grid(image: NDArray[np.uint8], board: Board) -> Tensor:
    """The tags of an AprilGrid by AprilTag's library."""
    return _placed(apriltags(image, TAG_BORDER), board)


def kalibr_grid(image: NDArray[np.uint8], board: Board) -> Tensor:
    """The same, and `cornerSubPix` in Kalibr's window."""
    pixels = apriltag_grid(image, board)
    seen = torch.isfinite(pixels).all(-1)
    if bool(seen.any()):
        start = np.ascontiguousarray(pixels[seen].numpy()[:, None], np.float32)
        moved = cv2.cornerSubPix(image, start, (_HALF, _HALF), (-1, -1), _STOP)
        pixels[seen] = torch.from_numpy(moved.reshape(-1, 2).astype(np.float64))
    return pixels


def apriltags(image: NDArray[np.uint8], border: int) -> Tags:
    """Tags of family 36h11: left upper, right upper, right lower and left lower corner of each."""
    out = {}
    for tag in _apriltag_detector(border).detect(image):
        # From the left lower corner on; pixel centers lie at halves.
        out[int(tag.tag_id)] = np.asarray(tag.corners[[3, 2, 1, 0]]) - 0.5
    return out


@functools.cache
def _apriltag_detector(border: int) -> Any:
    from pupil_apriltags import Detector as AprilTag

    detector = AprilTag(families="tag36h11", nthreads=1, quad_decimate=1.0)
    detector.tag_detector_ptr.contents.decode_sharpening = 0.25  # the library's default, which the wheel cuts to 0
    family = detector.tag_families["tag36h11"].contents
    family.width_at_border += 2 * (border - 1)
    family.total_width += 2 * (border - 1)
    for bit in range(family.nbits):
        family.bit_x[bit] += border - 1
        family.bit_y[bit] += border - 1
    detector.tag_families.clear()  # or the wheel frees them twice
    return detector


@functools.cache
def _charuco_detector(board: Board, refine: int, again: bool) -> cv2.aruco.CharucoDetector:
    assert board.dictionary is not None
    assert board.marker is not None
    size = (board.columns + 1, board.rows + 1)
    made = cv2.aruco.CharucoBoard(size, board.square, board.marker, opencv_dictionary(board.dictionary))
    options, charuco_options = cv2.aruco.DetectorParameters(), cv2.aruco.CharucoParameters()
    options.cornerRefinementMethod, charuco_options.tryRefineMarkers = refine, again
    return cv2.aruco.CharucoDetector(made, charuco_options, options)


def _nothing(board: Board) -> Tensor:
    return torch.full((board.corners, 2), math.nan, dtype=torch.float64)


def _by_number(places: Any, numbers: Any, board: Board) -> Tensor:
    pixels = _nothing(board)
    if numbers is not None and len(numbers):
        order = torch.from_numpy(np.asarray(numbers, np.int64).reshape(-1))
        pixels[order] = torch.from_numpy(np.asarray(places, np.float64).reshape(-1, 2))
    return pixels


def _placed(tags: Tags, board: Board) -> Tensor:
    """The tags' corners in the order of an AprilGrid; numbers that it does not have are left out."""
    pixels, across = _nothing(board), board.columns // 2
    for number, corners in tags.items():
        if number < board.markers:
            row, column = divmod(number, across)
            low = 2 * row * board.columns + 2 * column
            pixels[[low + board.columns, low + board.columns + 1, low + 1, low]] = torch.from_numpy(
                np.asarray(corners, np.float64)
            )
    return pixels
