"""Boards with markers, found under hard conditions.

kcal beside OpenCV's ArUco module and AprilTag's own library (`marker_peers`), on rendered ChArUco boards and Kalibr's
AprilGrid in the scenes of `hard_boards`. An image is found if 6 corners are right, as many as a pose needs. A corner is
wrong if it is more than 2 px from the truth, or where no corner is visible. RMS is over the others.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.detect import detect_board, limit_threads
from kcal.corners.marker_boards import MIN_CORNERS
from scripts.bench.hard_boards import (
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
from scripts.bench.hard_scenes import Marked
from scripts.bench.marker_peers import (
    HAS_APRILTAG,
    Detector,
    apriltag_grid,
    aruco_grid,
    charuco,
    charuco_of_apriltag,
    kalibr_grid,
)
from scripts.shared.page import table
from scripts.shared.sections import section

WRONG = 2.0  # pixels
KINDS = (plain, blurred, moving, overexposed, noisy, small, cut, covered, glaring, shaded)


def own(image: NDArray[np.uint8], board: Board) -> Tensor:
    """The default of kcal."""
    pixels = detect_board(image, board).pixels
    return torch.full((board.corners, 2), torch.nan, dtype=torch.float64) if pixels is None else pixels


CHARUCO: dict[str, Detector] = {
    "kcal": own,
    "CharucoDetector, tryRefineMarkers, SUBPIX": charuco(cv2.aruco.CORNER_REFINE_SUBPIX, again=True),
}
GRID: dict[str, Detector] = {
    "kcal": own,
    "ArucoDetector, APRILTAG": aruco_grid(cv2.aruco.CORNER_REFINE_APRILTAG),
}
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
def marked_boards(images: int = 10, kinds: int = len(KINDS)) -> Iterator[str]:
    """Rendered images of each kind."""
    limit_threads(1)
    if not HAS_APRILTAG:
        yield "AprilTag's own library is left out: `pip install --target DIR pupil-apriltags`, DIR in PYTHONPATH."
    for name, detectors in BOARDS:
        board = Board.parse(name, "30mm")
        yield from ["", f"`{name}`:", ""]
        yield from table(["", *detectors], _rows(board, detectors, images, kinds))


def _rows(board: Board, detectors: dict[str, Detector], images: int, kinds: int) -> Iterator[list[str]]:
    for kind in KINDS[:kinds]:
        some = list(pictures(kind, images, Marked(board)))
        yield [kind.__name__, *(score(find, some, board) for find in detectors.values())]
