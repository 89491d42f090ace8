"""How fast boards are found and refined, alone and in batches.

Detection and refinement apart, beside OpenCV's detectors, on rendered images of 12 megapixels and on the images in
KCAL_DATA. Then `kcal batch` on N images of 12 megapixels: images a second and memory with one process and with two, and
whether a run that is killed half way and continued gives the same table. A few images are rendered once; the N files
are copies that differ in a comment, so that none is taken for another.
"""

from __future__ import annotations

import contextlib
import csv
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import psutil
import torch
from numpy.typing import NDArray

from kcal import Board, Camera
from kcal.corners.detect import detect_board, limit_threads
from kcal.corners.grid import local_side
from kcal.corners.images import expand_images, read_gray
from kcal.corners.refine import refine_corners
from kcal.sim.captures import BoardSize, sample_board_poses
from kcal.sim.scene import render_board
from scripts.bench.found import by_classic, by_sector
from scripts.shared.page import table
from scripts.shared.real_captures import data_folder
from scripts.shared.sections import section

BOARD = Board(columns=9, rows=6, square=0.025)
SLOWEST = "findChessboardCornersSB"
SLOW = 1  # image of 12 megapixels on which the sector detector is timed: minutes
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


def rate(images: list[Image], work: Callable[[Image], object | None]) -> tuple[float, int]:
    """Images a second, and how many gave something."""
    start = time.perf_counter()
    found = sum(work(image) is not None for image in images)
    return len(images) / (time.perf_counter() - start), found


def single(images: list[Image]) -> Iterator[list[str]]:
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
        "findChessboardCorners": lambda image: by_classic(image, BOARD, refine=False),
        "findChessboardCorners and cornerSubPix 5": lambda image: by_classic(image, BOARD),
        "findChessboardCornersSB, exhaustive and accurate": lambda image: by_sector(image, BOARD),
    }
    for name, work in methods.items():
        some = images[:SLOW] if name.startswith(SLOWEST) and images[0].size > 1e6 else images
        if not name.startswith(SLOWEST):
            work(some[0])  # what is loaded at the first call
        speed, found = rate(some, work)
        yield [name, f"{speed:.3g}", f"{found} of {len(some)}"]


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
    """Resident bytes of a process and its descendants."""
    total = 0
    with contextlib.suppress(psutil.Error):  # one that has just ended
        for one in (psutil.Process(pid), *psutil.Process(pid).children(recursive=True)):
            total += one.memory_info().rss
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


def batches(images: list[Image], count: int) -> Iterator[str]:
    """Sentences on batches of `count` images."""
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        lay_out(work / "images", images, count)
        seconds = {}
        for workers in (1, 2):
            seconds[workers], peak = run_batch(work / "images", work / f"out{workers}", workers)
            yield (
                f"* {workers} process{'es' * (workers > 1)}: {seconds[workers]:.1f} s, "
                f"{count / seconds[workers]:.2f} images/s, at most {peak:.2f} GiB resident in all processes together."
            )
        yield f"* From 1 to 2 processes: {seconds[1] / seconds[2]:.2f} times as fast."
        run_batch(work / "images", work / "killed", 2, stop_at=max(1, count // 2))
        kept = len(list((work / "killed").glob(".work/*.json")))
        run_batch(work / "images", work / "killed", 2)
        verdict = same_table(work / "out2" / "summary.csv", work / "killed" / "summary.csv")
        yield f"* Killed after {kept} finished pieces and run again: {verdict}."


@section("corners.md", "speed", images=2, rendered=1)
def speed(images: int = 1000, rendered: int = 10) -> Iterator[str]:
    """Images of 12 megapixels in the batch, of which so many are different."""
    limit_threads(1)
    made = render(rendered)
    heads, rows = ["", "4000 x 3000, images/s", "found"], [*single(made)]
    if "KCAL_DATA" in os.environ:
        paths = expand_images([str(data_folder() / "opencv_stereo" / "*.jpg")])
        real = single([read_gray(path).astype(np.uint8) for path in paths])
        heads += ["640 x 480, images/s", "found"]
        rows = [[*row, *more[1:]] for row, more in zip(rows, real, strict=True)]
    yield from table(heads, rows)
    yield from ["", f"`kcal batch` on {images} JPEG files of 12 megapixels in folders of 100 a camera:", ""]
    yield from batches(made, images)
