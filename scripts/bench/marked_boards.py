"""Boards with markers, found under hard conditions.

kcal beside OpenCV's ArUco module and AprilTag's own library, on rendered ChArUco boards and Kalibr's
AprilGrid in the scenes of `hard_boards`. An image is found if 6 corners are right, as many as a pose needs. A corner is
wrong if it is more than 2 px from the truth, or where no corner is visible. RMS is over the others.

AprilTag's library is a peer, never a dependency: `pip install --target DIR pupil-apriltags`, and DIR in PYTHONPATH.
"""

from __future__ import annotations

import functools
import importlib.util
import math
import time
from collections.abc import Callable, Iterable
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.corners.board import TAGS, Board
from kcal.corners.detect import detect_board, limit_threads
from kcal.corners.marker_boards import MIN_CORNERS
from kcal.corners.markers import opencv_dictionary
from kcal.corners.print_board import TAG_BORDER
from scripts.bench.hard_boards import (
    Marked,
    Picture,
    blurred,
    covered,
    cut,
    glaring,
    moving,
    noisy,
    overexposed,
    pictures,
    plain,
    shaded,
    small,
)
from scripts.shared.page import Lines
from scripts.shared.sections import section

HAS_APRILTAG = importlib.util.find_spec("pupil_apriltags") is not None
Detector = Callable[[NDArray[np.uint8], Board], Tensor]  # (corners, 2), NaN where not found
Tags = dict[int, NDArray[np.float64]]  # the corners (4, 2) of each
_STOP = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 0.01)
_HALF = 2  # pixels: Kalibr's window of cornerSubPix


def charuco(image: NDArray[np.uint8], board: Board) -> Tensor:
    """`CharucoDetector`; markers that were not read are looked for where the others put them."""
    places, numbers, _, _ = _charuco_detector(board, cv2.aruco.CORNER_REFINE_SUBPIX, True).detectBoard(image)
    return _by_number(places, numbers, board)


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


def aruco_grid(image: NDArray[np.uint8], board: Board) -> Tensor:
    """The tags of an AprilGrid by `ArucoDetector`."""
    options = cv2.aruco.DetectorParameters()
    options.markerBorderBits, options.cornerRefinementMethod = TAG_BORDER, cv2.aruco.CORNER_REFINE_APRILTAG
    found, numbers, _ = cv2.aruco.ArucoDetector(opencv_dictionary(TAGS), options).detectMarkers(image)
    seen = [] if numbers is None else map(int, numbers.reshape(-1))
    # OpenCV's dictionary has these tags turned by half a turn.
    return _placed({n: np.roll(tag.reshape(4, 2), 2, 0) for n, tag in zip(seen, found, strict=True)}, board)


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
    found = _apriltag_detector(border).detect(image)
    # From the left lower corner on; pixel centers lie at halves.
    return {int(tag.tag_id): np.asarray(tag.corners[[3, 2, 1, 0]]) - 0.5 for tag in found}


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


WRONG = 2.0  # pixels
KINDS = (plain, blurred, moving, overexposed, noisy, small, cut, covered, glaring, shaded)


def own(image: NDArray[np.uint8], board: Board) -> Tensor:
    """The default of kcal."""
    pixels = detect_board(image, board).pixels
    return torch.full((board.corners, 2), torch.nan, dtype=torch.float64) if pixels is None else pixels


CHARUCO: dict[str, Detector] = {
    "kcal": own,
    "CharucoDetector, tryRefineMarkers, SUBPIX": charuco,
}
GRID: dict[str, Detector] = {"kcal": own, "ArucoDetector, APRILTAG": aruco_grid}
TAGGED: dict[str, Detector] = dict(CHARUCO)
if HAS_APRILTAG:
    TAGGED["AprilTag, CharucoDetector"] = charuco_of_apriltag
    GRID |= {"AprilTag": apriltag_grid, "AprilTag, cornerSubPix 2 (Kalibr's)": kalibr_grid}
BOARDS = (("charuco:9x6", CHARUCO), ("charuco:9x6:apriltag_36h11", TAGGED), ("aprilgrid:6x6", GRID))


def score(find: Detector, images: Iterable[Picture], board: Board) -> str:
    """A cell: images found, share of the visible corners found rightly, wrong corners, RMS in px, CPU seconds."""
    count = found = visible = right = wrong = 0
    seconds, squares = 0.0, []
    for image, truth in images:
        assert truth is not None
        start = time.process_time()
        pixels = find(image, board)
        seconds += time.process_time() - start
        away = torch.linalg.vector_norm(pixels - truth, dim=-1)
        good = away <= WRONG  # False for NaN
        count += 1
        found += int(good.sum()) >= MIN_CORNERS
        visible += int(torch.isfinite(truth).all(-1).sum())
        right += int(good.sum())
        wrong += int((torch.isfinite(pixels).all(-1) & ~good).sum())
        squares.append((pixels - truth)[good].square().reshape(-1))
    mean = torch.cat(squares).mean()
    parts = [f"{found}", f"{100 * right / visible:.0f} %"]
    parts += [f"**{wrong} wrong**"] * bool(wrong) + [f"{float(mean.sqrt()):.4f} px"] * bool(right)
    return ", ".join([*parts, f"{seconds / count:.2f} s"])


@section("corners.md", "marked boards", images=1, kinds=1)
def marked_boards(images: int = 10, kinds: int = len(KINDS)) -> Lines:
    """Rendered images of each kind."""
    limit_threads(1)
    if not HAS_APRILTAG:
        yield "AprilTag's own library is left out: `pip install --target DIR pupil-apriltags`, DIR in PYTHONPATH."
    for name, detectors in BOARDS:
        board = Board.parse(name, "30mm")
        yield f"`{name}`:"
        yield ["", *detectors]
        for kind in KINDS[:kinds]:
            some = list(pictures(kind, images, Marked(board)))
            yield [kind.__name__, *(score(find, some, board) for find in detectors.values())]
