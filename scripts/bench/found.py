"""Which boards are found, how exactly, and at what cost.

kcal beside OpenCV's classic and sector detectors, on rendered boards that are hard to find (`hard_boards`) and on the
folders of images in KCAL_DATA. A grid is false if the median distance of its corners from the truth is above 2 px, or
where the picture shows no 9x6 board. RMS is over the corners of the others.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal.corners.board import Board
from kcal.corners.detect import detect_board, limit_threads
from kcal.corners.images import expand_images, read_gray, to_8bit
from kcal.corners.search import canonical_order
from scripts.bench.hard_boards import BOARD, HARD, NOT_THE_BOARD, Picture, pictures
from scripts.bench.hard_boards import large as huge
from scripts.shared.page import table
from scripts.shared.real_captures import data_folder
from scripts.shared.sections import section

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
        start = time.process_time()
        pixels = find(image, board)
        seconds += time.process_time() - start
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
    start = time.process_time()
    found = sum(find(image, board) is not None for image, _ in images)
    return f"{found} of {len(images)}, {(time.process_time() - start) / len(images):.2f} s"


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
