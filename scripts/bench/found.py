"""Which boards are found, how exactly, and at what cost: section "Found" of docs/measured/corners.md.

kcal beside OpenCV's classic and sector detectors, on rendered boards that are hard to find (`hard_boards`) and on the
folders of images in KCAL_DATA. A grid is false if the median distance of its corners from the truth is above 2 px, or
where the picture shows no 9x6 board. RMS is over the corners of the others.

    python -m scripts.bench.found --images 10 --write
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable, Iterable
from pathlib import Path
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
from scripts.bench.hard_boards import BOARD, HARD, NOT_THE_BOARD, Picture, large, pictures
from scripts.shared.page import table, write_section
from scripts.shared.timing import row, show

FALSE = 2.0  # pixels
FOLDERS = (
    ("opencv_stereo", Board(columns=9, rows=6, square=0.025)),
    ("captures/pi640", Board(columns=7, rows=7, square=0.0254)),
    ("captures/gloworm960", Board(columns=8, rows=6, square=0.025)),
)
_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_SECTOR = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
Detector = Callable[[NDArray[Any], Board], Tensor | None]


def classic(image: NDArray[Any], board: Board) -> Tensor | None:
    """`findChessboardCorners` and `cornerSubPix`."""
    gray = to_8bit(image)
    found, corners = cv2.findChessboardCorners(gray, (board.columns, board.rows), flags=_CLASSIC)
    if found:
        corners = cv2.cornerSubPix(gray, corners, (5, 5), (-1, -1), (3, 100, 1e-4))
    return _ordered(gray, corners, board) if found else None


def sector(flags: int) -> Detector:
    """`findChessboardCornersSB`."""

    def find(image: NDArray[Any], board: Board) -> Tensor | None:
        gray = to_8bit(image)
        found, corners = cv2.findChessboardCornersSB(gray, (board.columns, board.rows), flags=flags)
        return _ordered(gray, corners, board) if found else None

    return find


def _ordered(gray: NDArray[np.uint8], corners: NDArray[Any], board: Board) -> Tensor:
    return canonical_order(gray, torch.from_numpy(corners.reshape(-1, 2).astype(np.float64)), board)


DETECTORS: dict[str, Detector] = {
    "kcal": lambda image, board: detect_board(image, board).pixels,
    "classic, cornerSubPix 5": classic,
    "SB, exhaustive, accurate, normalized": sector(_SECTOR),
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


def real(folder: str, board: Board) -> Callable[[], list[Picture]]:
    """The images of a folder, without truth."""
    paths = expand_images([str(Path(os.environ["KCAL_DATA"]) / folder / "*.jpg")])
    return lambda: [Picture(read_gray(path), None) for path in paths]


def found_only(find: Detector, images: list[Picture], board: Board) -> str:
    start = time.process_time()
    found = sum(find(image, board) is not None for image, _ in images)
    return f"{found} of {len(images)}, {(time.process_time() - start) / len(images):.2f} s"


def main() -> None:
    parser = argparse.ArgumentParser(description="Which boards are found, how exactly, and at what cost.")
    parser.add_argument("--images", type=int, default=10, help="rendered images of each kind")
    parser.add_argument("--large", type=int, default=1, help="rendered images of 100 megapixels")
    parser.add_argument("--write", action="store_true", help="write the section of docs/measured/corners.md")
    arguments = parser.parse_args()
    limit_threads(1)
    heads = ["", *DETECTORS]
    rows: list[list[str]] = []
    for kind in HARD:
        some = list(pictures(kind, arguments.images))
        rows.append([kind.__name__, *(score(find, some, BOARD) for find in DETECTORS.values())])
        show([row(*rows[-1])])
    if arguments.large:
        some = list(pictures(large, arguments.large))
        cells = [score(find, some, BOARD) for name, find in DETECTORS.items() if not name.startswith("SB, ")]
        rows.append([f"large ({arguments.large})", *cells, "not run: minutes"])
        show([row(*rows[-1])])
    for kind in NOT_THE_BOARD:
        some = list(pictures(kind, arguments.images))
        cells = [score(find, some, BOARD) for find in DETECTORS.values()]
        rows.append([f"{kind.__name__} (none is right)", *cells])
        show([row(*rows[-1])])
    text = table(heads, rows)
    if os.environ.get("KCAL_DATA"):
        real_rows = []
        for folder, board in FOLDERS:
            images = real(folder, board)()
            cells = [found_only(find, images, board) for find in DETECTORS.values()]
            real_rows.append([f"{folder}, {board.columns}x{board.rows}", *cells])
            show([row(*real_rows[-1])])
        text += ["", *table(heads, real_rows)]
    write_section("corners.md", "found", text, write=arguments.write)


if __name__ == "__main__":
    main()
