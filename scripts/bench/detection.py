"""How fast boards are found and refined, alone and in batches: section "Speed" of docs/measured/corners.md.

Detection and refinement apart, beside OpenCV's detectors, on rendered images of 12 megapixels and on the images in
KCAL_DATA. Then `kcal batch` on N images of 12 megapixels: images a second and memory with one process and with two, and
whether a run that is killed half way and continued gives the same table. A few images are rendered once; the N files
are copies that differ in a comment, so that none is taken for another.

    python -m scripts.bench.detection --images 20
    KCAL_DATA=DATA python -m scripts.bench.detection --write
"""

from __future__ import annotations

import argparse
import csv
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from kcal import Board, Camera
from kcal.corners.detect import detect_board, limit_threads
from kcal.corners.grid import local_side
from kcal.corners.images import expand_images, read_gray
from kcal.corners.refine import refine_corners
from kcal.sim.captures import BoardSize, sample_board_poses
from kcal.sim.scene import render_board
from scripts.shared.page import table, write_section

BOARD = Board(columns=9, rows=6, square=0.025)
SLOW = 1  # image of 12 megapixels on which the sector detector is timed: minutes
CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
SECTOR = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE
Image = NDArray[np.uint8]


def render(count: int) -> list[Image]:
    """Images of 4000 x 3000 pixels, the board over all of the image and at several distances."""
    camera = Camera.build(
        focal=(3600, 3600), center=(2003.0, 1495.0), size=(4000, 3000), coefficients=[-0.12, 0.05, 0.0005, -0.0003]
    )
    generator = torch.Generator().manual_seed(1)
    size = BoardSize(BOARD.columns, BOARD.rows, BOARD.square)
    poses = sample_board_poses(camera, size, count, generator)
    return [render_board(camera, pose, size, generator=generator).numpy() for pose in poses]


def classic(image: Image) -> NDArray[Any] | None:
    found, corners = cv2.findChessboardCorners(image, (BOARD.columns, BOARD.rows), flags=CLASSIC)
    return corners if found else None


def sector(image: Image) -> NDArray[Any] | None:
    found, corners = cv2.findChessboardCornersSB(image, (BOARD.columns, BOARD.rows), flags=SECTOR)
    return corners if found else None


def opencv(image: Image) -> NDArray[Any] | None:
    corners = classic(image)
    if corners is None:
        return None
    return cv2.cornerSubPix(image, corners, (5, 5), (-1, -1), (3, 100, 1e-4))


def rate(images: list[Image], work: Callable[[Image], object | None]) -> tuple[float, int]:
    """Images a second, and how many gave something."""
    start = time.perf_counter()
    found = sum(work(image) is not None for image in images)
    return len(images) / (time.perf_counter() - start), found


def single(images: list[Image]) -> list[str]:
    """Rows of a table: images a second on one thread."""
    starts = {id(image): detect_board(image, BOARD, "none").pixels for image in images}

    def refine(image: Image) -> object | None:
        start = starts[id(image)]
        if start is None:
            return None
        side = local_side(start, BOARD.columns, BOARD.rows)
        return refine_corners(image, start, side, "erf", (BOARD.columns, BOARD.rows))

    methods: dict[str, Callable[[Image], object | None]] = {
        "kcal, detection alone": lambda image: detect_board(image, BOARD, "none").pixels,
        "kcal, erf refinement alone": refine,
        "kcal, both": lambda image: detect_board(image, BOARD).pixels,
        "findChessboardCorners": classic,
        "findChessboardCorners and cornerSubPix 5": opencv,
        "findChessboardCornersSB, exhaustive and accurate": sector,
    }
    rows = []
    for name, work in methods.items():
        some = images[:SLOW] if work is sector and images[0].size > 1e6 else images
        if work is not sector:
            work(some[0])  # what is loaded at the first call
        speed, found = rate(some, work)
        rows.append(f"{name} | {speed:.3g} | {found} of {len(some)}")
        print(rows[-1], flush=True)
    return rows


def lay_out(folder: Path, images: list[Image], count: int) -> None:
    """`count` distinct JPEG files in folders of 100: a comment block makes each file's bytes its own."""
    packed = [cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes() for image in images]
    for k in range(count):
        data = packed[k % len(packed)]
        comment = f"{k:06d}".encode()
        block = b"\xff\xfe" + (len(comment) + 2).to_bytes(2, "big") + comment
        camera = folder / f"camera{k // 100:02d}"
        camera.mkdir(parents=True, exist_ok=True)
        (camera / f"{k:06d}.jpg").write_bytes(data[:2] + block + data[2:])


def tree_memory(pid: int) -> int:
    """Resident bytes of a process and its descendants (Linux)."""
    total, queue = 0, [pid]
    while queue:
        one = queue.pop()
        try:
            pages = int(Path(f"/proc/{one}/statm").read_text().split()[1])
            for task in Path(f"/proc/{one}/task").iterdir():
                queue += [int(child) for child in (task / "children").read_text().split()]
        except (OSError, ValueError):
            continue  # it has just ended
        total += pages * os.sysconf("SC_PAGE_SIZE")
    return total


def run_batch(folder: Path, output: Path, workers: int, stop_at: int | None = None) -> tuple[float, float]:
    """Seconds and peak GiB of `kcal batch`; killed with all its processes once `stop_at` pieces are finished."""
    what = ["--board", "9x6", "--square", "25mm", "--workers", str(workers), "-o", str(output)]
    start, peak = time.perf_counter(), 0
    running = subprocess.Popen(
        [sys.executable, "-m", "kcal", "batch", str(folder), *what], stdout=subprocess.DEVNULL, start_new_session=True
    )
    while running.poll() is None:
        peak = max(peak, tree_memory(running.pid))
        if stop_at is not None and len(list(output.glob(".work/*.json"))) >= stop_at:
            os.killpg(running.pid, signal.SIGKILL)
            running.wait()
            return time.perf_counter() - start, peak / 2**30
        time.sleep(0.2)
    if running.returncode != 0 or stop_at is not None:
        raise SystemExit(f"kcal batch ended with {running.returncode} where that was not expected")
    return time.perf_counter() - start, peak / 2**30


def same_table(one: Path, two: Path) -> str:
    """How two summaries compare: the same bytes, or the largest relative difference of their numbers."""
    if one.read_bytes() == two.read_bytes():
        return "the identical table, byte for byte"
    worst = 0.0
    with one.open() as first, two.open() as second:
        for left, right in zip(csv.reader(first), csv.reader(second), strict=True):
            for a, b in zip(left, right, strict=True):
                if a != b:
                    worst = max(worst, abs(float(a) - float(b)) / max(abs(float(a)), 1e-300))
    return f"a table whose numbers differ by {worst:.1e} at most, relatively"


def batches(images: list[Image], count: int) -> list[str]:
    """Sentences on batches of `count` images."""
    lines = []
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        lay_out(work / "images", images, count)
        seconds = {}
        for workers in (1, 2):
            seconds[workers], peak = run_batch(work / "images", work / f"out{workers}", workers)
            lines.append(
                f"* {workers} process{'es' * (workers > 1)}: {seconds[workers]:.1f} s, "
                f"{count / seconds[workers]:.2f} images/s, at most {peak:.2f} GiB resident in all processes together."
            )
            print(lines[-1], flush=True)
        lines.append(f"* From 1 to 2 processes: {seconds[1] / seconds[2]:.2f} times as fast.")
        run_batch(work / "images", work / "killed", 2, stop_at=max(1, count // 2))
        kept = len(list((work / "killed").glob(".work/*.json")))
        run_batch(work / "images", work / "killed", 2)
        verdict = same_table(work / "out2" / "summary.csv", work / "killed" / "summary.csv")
        lines.append(f"* Killed after {kept} finished pieces and run again: {verdict}.")
        print(*lines[-2:], sep="\n", flush=True)
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description="Speed of detection, refinement and batches.")
    parser.add_argument("--images", type=int, default=1000, help="images of 12 megapixels in the batch")
    parser.add_argument("--rendered", type=int, default=10, help="of these so many are different")
    parser.add_argument("--write", action="store_true", help="write the section of docs/measured/corners.md")
    arguments = parser.parse_args()
    limit_threads(1)
    images = render(arguments.rendered)
    heads, rows = ["", "4000 x 3000, images/s", "found"], [row.split(" | ") for row in single(images)]
    data = os.environ.get("KCAL_DATA")
    if data:
        real = [read_gray(path) for path in expand_images([str(Path(data) / "opencv_stereo" / "*.jpg")])]
        eight_bits = [image.astype(np.uint8) for image in real]
        heads += ["640 x 480, images/s", "found"]
        rows = [[*row, *more.split(" | ")[1:]] for row, more in zip(rows, single(eight_bits), strict=True)]
    text = [
        *table(heads, rows),
        "",
        f"`kcal batch` on {arguments.images} JPEG files of 12 megapixels in folders of 100 a camera:",
        "",
    ]
    text += batches(images, arguments.images)
    write_section("corners.md", "speed", text, write=arguments.write)


if __name__ == "__main__":
    main()
