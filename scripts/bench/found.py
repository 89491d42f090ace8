"""Which boards are found, how exactly, and at what cost.

kcal beside OpenCV's classic and sector detectors, on rendered boards that are hard to find (`hard_boards`) and on the
folders of images in KCAL_DATA. A grid is false if the median distance of its corners from the truth is above 2 px, or
where the picture shows no 9x6 board. RMS is over the corners of the others.

Boards with markers, found under hard conditions.

kcal beside OpenCV's ArUco module and AprilTag's own library, on rendered ChArUco boards and Kalibr's
AprilGrid in the scenes of `hard_boards`. An image is found if 6 corners are right, as many as a pose needs. A corner is
wrong if it is more than 2 px from the truth, or where no corner is visible. RMS is over the others.

AprilTag's library is a peer, never a dependency: `pip install --target DIR pupil-apriltags`, and DIR in PYTHONPATH.
"""

from __future__ import annotations

import functools
import importlib.util
import math
import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.corners.board import TAGS, Board
from kcal.corners.detect import detect_board, limit_threads
from kcal.corners.images import expand_images, read_gray, to_8bit
from kcal.corners.marker_boards import MIN_CORNERS
from kcal.corners.markers import opencv_dictionary
from kcal.corners.print_board import TAG_BORDER
from kcal.corners.search import canonical_order
from scripts.bench.hard_boards import (
    BOARD,
    HARD,
    NOT_THE_BOARD,
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
from scripts.bench.hard_boards import large as huge
from scripts.shared.page import Lines, section, table, timed
from scripts.shared.real_captures import data_folder

FALSE = 2.0  # pixels
FOLDERS = (
    ("opencv_stereo", Board(columns=9, rows=6, square=0.025)),
    ("captures/pi640", Board(columns=7, rows=7, square=0.0254)),
    ("captures/gloworm960", Board(columns=8, rows=6, square=0.025)),
)
_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_SECTOR = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
Detector = Callable[[NDArray[Any], Board], Tensor | None]


def by_classic(gray: NDArray[np.uint8], board: Board, refine: bool = True) -> NDArray[Any] | None:
    """OpenCV's own answer."""
    found, corners = cv2.findChessboardCorners(gray, (board.columns, board.rows), flags=_CLASSIC)
    if not found:
        return None
    return cv2.cornerSubPix(gray, corners, (5, 5), (-1, -1), (3, 100, 1e-4)) if refine else corners


def by_sector(gray: NDArray[np.uint8], board: Board) -> NDArray[Any] | None:
    """OpenCV's own answer."""
    found, corners = cv2.findChessboardCornersSB(gray, (board.columns, board.rows), flags=_SECTOR)
    return corners if found else None


def by_opencv(find: Callable[[NDArray[np.uint8], Board], NDArray[Any] | None]) -> Detector:
    """OpenCV's corners in the board's order."""

    def detect(image: NDArray[Any], board: Board) -> Tensor | None:
        gray = to_8bit(image)
        if (corners := find(gray, board)) is None:
            return None
        return canonical_order(gray, torch.from_numpy(corners.reshape(-1, 2).astype(np.float64)), board)

    return detect


DETECTORS: dict[str, Detector] = {
    "kcal": lambda image, board: detect_board(image, board).pixels,
    "classic, cornerSubPix 5": by_opencv(by_classic),
    "SB, exhaustive, accurate, normalized": by_opencv(by_sector),
}


def score(find: Detector, images: Iterable[Picture], board: Board) -> str:
    """A cell: images found, false grids, RMS in px, CPU seconds an image."""
    count = found = false = 0
    seconds, squares = 0.0, []
    for image, truth in images:
        pixels, spent = timed(find, image, board)
        seconds += spent
        count += 1
        if pixels is None:
            continue
        found += 1
        if truth is None:
            false += 1
            continue
        error = torch.linalg.vector_norm(pixels - truth, dim=-1)
        seen = torch.isfinite(pixels).all(-1)
        if bool(error[seen].nan_to_num(math.inf).median() > FALSE):
            false += 1
        else:
            squares.append(error[torch.isfinite(error)].square())
    rms = f", {float((torch.cat(squares).mean() / 2).sqrt()):.4f} px" if squares else ""
    return f"{found - false}" + (f", **{false} false**" if false else "") + f"{rms}, {seconds / max(count, 1):.2f} s"


def real(folder: str) -> list[Picture]:
    """The images of a folder, without truth."""
    paths = expand_images([str(data_folder() / folder / "*.jpg")])
    return [Picture(read_gray(path), None) for path in paths]


def found_only(find: Detector, images: list[Picture], board: Board) -> str:
    found = [timed(find, image, board) for image, _ in images]
    seconds = sum(spent for _, spent in found) / len(images)
    return f"{sum(pixels is not None for pixels, _ in found)} of {len(images)}, {seconds:.2f} s"


@section("corners.md", "found", images=1, large=0, folders=0)
def found(images: int = 10, large: int = 1, folders: int = len(FOLDERS)) -> Iterator[str]:
    """Rendered images of each kind, those of 100 megapixels, and folders of real ones."""
    limit_threads(1)
    heads = ["", *DETECTORS]
    kinds = [*((kind, images, kind.__name__) for kind in HARD), *([(huge, large, f"large ({large})")] if large else [])]
    kinds += [(kind, images, f"{kind.__name__} (none is right)") for kind in NOT_THE_BOARD]

    def rows() -> Iterator[list[str]]:
        for kind, count, name in kinds:
            some = list(pictures(kind, count))
            slow = "SB, exhaustive, accurate, normalized" if kind is huge else ""
            yield [
                name, *("not run: minutes" if n == slow else score(find, some, BOARD) for n, find in DETECTORS.items())
            ]  # fmt: skip

    yield from table(heads, rows())
    if folders and "KCAL_DATA" in os.environ:
        yield ""
        of_folders = (
            [f"{folder}, {board.columns}x{board.rows}"]
            + [found_only(find, real(folder), board) for find in DETECTORS.values()]
            for folder, board in FOLDERS[:folders]
        )
        yield from table(heads, of_folders)


HAS_APRILTAG = importlib.util.find_spec("pupil_apriltags") is not None
MarkerDetector = Callable[[NDArray[np.uint8], Board], Tensor]  # (corners, 2), NaN where not found
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
    from pupil_apriltags import MarkerDetector as AprilTag

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


CHARUCO: dict[str, MarkerDetector] = {
    "kcal": own,
    "CharucoDetector, tryRefineMarkers, SUBPIX": charuco,
}
GRID: dict[str, MarkerDetector] = {"kcal": own, "ArucoDetector, APRILTAG": aruco_grid}
TAGGED: dict[str, MarkerDetector] = dict(CHARUCO)
if HAS_APRILTAG:
    TAGGED["AprilTag, CharucoDetector"] = charuco_of_apriltag
    GRID |= {"AprilTag": apriltag_grid, "AprilTag, cornerSubPix 2 (Kalibr's)": kalibr_grid}
BOARDS = (("charuco:9x6", CHARUCO), ("charuco:9x6:apriltag_36h11", TAGGED), ("aprilgrid:6x6", GRID))


def marker_score(find: MarkerDetector, images: Iterable[Picture], board: Board) -> str:
    """A cell: images found, share of the visible corners found rightly, wrong corners, RMS in px, CPU seconds."""
    count = found = visible = right = wrong = 0
    seconds, squares = 0.0, []
    for image, truth in images:
        assert truth is not None
        pixels, spent = timed(find, image, board)
        seconds += spent
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
            yield [kind.__name__, *(marker_score(find, some, board) for find in detectors.values())]
