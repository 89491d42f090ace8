"""Accuracy of corner refinement on rendered boards with known truth, and on real images.

Boards of 9x6 corners are seen through a distorting lens at tilts up to 45 degrees; light is blurred, vignetted, encoded
with a gamma of 2.2, given noise, rounded and compressed as JPEG (quality 95). Refiners start 0.3 px from the truth;
detectors start from nothing. Errors beyond 2 px count as lost and are shown as a share.

How fast boards are found and refined, alone and in batches.

Detection and refinement apart, beside OpenCV's detectors, on rendered images of 12 megapixels and on the images in
KCAL_DATA. Then `kcal batch` on N images of 12 megapixels: images a second and memory with one process and with two, and
whether a run that is killed half way and continued gives the same table. A few images are rendered once; the N files
are copies that differ in a comment, so that none is taken for another.
"""

from __future__ import annotations

import contextlib
import csv
import itertools
import math
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import get_args

import cv2
import numpy as np
import psutil
import torch
from numpy.typing import NDArray
from torch import Tensor

from kcal import Board, Camera
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.corners.detect import detect_board, limit_threads
from kcal.corners.grid import local_side
from kcal.corners.images import expand_images, read_gray
from kcal.corners.refine import Refinement, refine_corners
from kcal.corners.saddle import saddle
from kcal.lens import rotation_from_vector
from kcal.sim.captures import BoardSize, project_board, sample_board_poses
from kcal.sim.scene import RenderOptions, render_board, render_light
from scripts.bench.found import by_classic, by_sector
from scripts.shared.page import Lines, section, table
from scripts.shared.real_captures import data_folder, stereo_images

BOARD = Board(columns=9, rows=6, square=0.025)
SQUARES, BLURS, NOISES = (8, 10, 20, 40), (0.5, 1.0, 2.0), (0, 2, 5)
SHOWN = 2  # gray levels of noise in the table; the summary is about all
LOST = 2.0  # pixels
GAMMA = 2.2
QUALITY = 95
Image = NDArray[np.uint8]


@dataclass
class Errors:
    """Errors of one method in one cell, px, with predicted covariances where the method has them."""

    error: list[Tensor] = field(default_factory=list)
    covariance: list[Tensor] = field(default_factory=list)

    def row(self) -> tuple[float, float, float, float, float]:
        """RMS per axis, bias in x and y, share lost, sqrt of predicted over true variance."""
        error = torch.cat(self.error)
        good = torch.linalg.vector_norm(error, dim=-1) < LOST
        lost = 1.0 - float(good.double().mean())
        kept = error[good]
        if not len(kept):
            return math.nan, math.nan, math.nan, lost, math.nan
        ratio = math.nan
        if self.covariance:
            predicted = torch.cat(self.covariance)[good].diagonal(dim1=-2, dim2=-1)
            ratio = float((predicted.mean() / kept.square().mean()).sqrt())
        return float(kept.square().mean().sqrt()), float(kept[:, 0].mean()), float(kept[:, 1].mean()), lost, ratio


def scenes(square: int, blur: float, noise: float, count: int) -> Iterator[tuple[Image, Tensor, Tensor, Tensor]]:
    """Image, true corners, starts and local sides of `count` boards whose squares are about `square` pixels."""
    generator = torch.Generator().manual_seed(1000 * square + int(100 * blur))
    width, height = 16 * square + 40, 13 * square + 40
    focal = 0.9 * width
    camera = Camera.build(
        focal=(focal, focal),
        center=((width - 1) / 2 + 1.3, (height - 1) / 2 - 0.7),
        size=(width, height),
        coefficients=[-0.25, 0.08, 0.0006, -0.0004],
    )
    size = BoardSize(BOARD.columns, BOARD.rows, BOARD.square)
    options = RenderOptions(black=12, white=175, background=80, blur=blur, noise=0.0, vignetting=0.3)
    middle = BOARD.points.mean(0)
    while count:
        tilt, turn, roll = torch.rand(3, generator=generator, dtype=torch.float64).tolist()
        tilt, turn, roll = math.radians(45 * tilt), 2 * math.pi * turn, math.radians(50 * roll - 25)
        lean = rotation_from_vector(torch.tensor([[tilt * math.cos(turn), tilt * math.sin(turn), 0.0]]).double())[0]
        spin = rotation_from_vector(torch.tensor([[0.0, 0.0, roll]]).double())[0]
        rotation = lean @ spin
        depth = focal * BOARD.square / square
        shift = (torch.rand(2, generator=generator, dtype=torch.float64) - 0.5) * 3 * BOARD.square
        place = torch.cat([shift, torch.tensor([depth], dtype=torch.float64)])
        pose = rotation, place - rotation @ middle
        truth, visible = project_board(camera, pose, size)
        edge = torch.minimum(truth, torch.tensor([width - 1.0, height - 1.0]) - truth).min()
        if not bool(visible.all()) or float(edge) < 1.2 * square:
            continue
        count -= 1
        light = render_light(camera, pose, size, options)
        encoded = 255.0 * (light / 255.0) ** (1.0 / GAMMA)
        encoded += noise * torch.randn(encoded.shape, generator=generator, dtype=torch.float64)
        raw = encoded.round().clamp(0, 255).to(torch.uint8).numpy()
        packed = cv2.imencode(".jpg", raw, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1]
        image = np.asarray(cv2.imdecode(packed, cv2.IMREAD_GRAYSCALE), dtype=np.uint8)
        away = 0.3 * torch.randn(truth.shape, generator=generator, dtype=torch.float64)
        yield image, truth, truth + away.clamp(-0.8, 0.8), local_side(truth, BOARD.columns, BOARD.rows)


def fixed_window(half: int) -> Callable[[Image, Tensor, Tensor], Tensor]:
    def refine(image: Image, start: Tensor, side: Tensor) -> Tensor:
        corners = np.ascontiguousarray(start.numpy(), dtype=np.float32)
        found = cv2.cornerSubPix(image, corners, (half, half), (-1, -1), (3, 100, 1e-4))
        return torch.from_numpy(found.reshape(-1, 2).astype(np.float64))

    return refine


def sector(image: Image, start: Tensor, side: Tensor) -> Tensor:
    """`findChessboardCornersSB` from nothing, its corners in the order of the starts."""
    if (corners := by_sector(image, BOARD)) is None:
        return torch.full_like(start, math.nan)
    pixels = torch.from_numpy(corners.reshape(-1, 2).astype(np.float64))
    nearest = torch.cdist(start, pixels).argmin(1)
    return pixels[nearest]


def run_cell(square: int, blur: float, noise: float, count: int) -> dict[str, Errors]:
    """Every method on the same images."""
    peers: dict[str, Callable[[Image, Tensor, Tensor], Tensor]] = {
        "cornerSubPix 5": fixed_window(5),
        "cornerSubPix 11": fixed_window(11),
        "cornerSubPix adaptive": lambda image, start, side: refine_corners(image, start, side, "opencv").pixels,
        "scikit-image": lambda image, start, side: refine_corners(image, start, side, "skimage").pixels,
        "SB": sector,
    }
    cell = {name: Errors() for name in ("kcal saddle", "kcal erf", *peers)}
    for image, truth, start, side in scenes(square, blur, noise, count):
        light = torch.from_numpy(image).double()
        first = saddle(light, start, side).pixels
        cell["kcal saddle"].error.append(_lost(first, truth))
        fit = refine_corners(image, start, side, "erf", (BOARD.columns, BOARD.rows))
        cell["kcal erf"].error.append(_lost(fit.pixels, truth))
        assert fit.covariance is not None
        cell["kcal erf"].covariance.append(fit.covariance)
        for name, refine in peers.items():
            cell[name].error.append(_lost(refine(image, start, side), truth))
    return cell


def _lost(pixels: Tensor, truth: Tensor) -> Tensor:
    return torch.nan_to_num(pixels - truth, nan=1e3)


def summary(cells: dict[tuple[int, float, int], dict[str, Errors]]) -> str:
    """What the table says of the erf fit, in a sentence or two."""
    ratios = {key: cell["kcal erf"].row()[4] for key, cell in cells.items()}
    noisy = [ratio for (_, _, noise), ratio in ratios.items() if noise > 0]
    clean = [ratio for (_, _, noise), ratio in ratios.items() if noise == 0]
    bias = max(max(map(abs, cell["kcal erf"].row()[1:3])) for cell in cells.values())
    worse = [
        f"{square} px, blur {blur:g}, noise {noise:g} ({name})"
        for (square, blur, noise), cell in cells.items()
        for name, errors in cell.items()
        if name != "kcal erf" and errors.row()[0] < cell["kcal erf"].row()[0]
    ]
    return (
        f"Predicted over true σ is {min(noisy):.2f} to {max(noisy):.2f} where there is noise and {min(clean):.2f} to "
        f"{max(clean):.2f} where there is none but rounding and JPEG. The largest mean error is {bias:.4f} px. Cells "
        f"in which another method has a smaller RMS than the erf fit: {', '.join(worse) or 'none'}."
    )


@section("corners.md", "refinement", squares=(40,), boards=1)
def refinement(squares: tuple[int, ...] = SQUARES, boards: int = 20) -> Lines:
    """RMS per axis of every method at the usual noise, then the predicted over the true standard deviation of erf."""
    places = itertools.product(squares, BLURS, NOISES)
    cells = {place: run_cell(*place, boards) for place in places}
    names = list(next(iter(cells.values())))
    yield ["square", "blur", *names, "predicted/true σ"]
    for (square, blur, noise), cell in cells.items():
        if noise == SHOWN:
            shown = [errors.row() for errors in cell.values()]
            lost = [f" ({100 * row[3]:.1f} %)" if 5e-4 < row[3] < 1 else "" for row in shown]
            rms = [f"{row[0]:.4f}{more}".replace("nan", "lost") for row, more in zip(shown, lost, strict=True)]
            yield [square, f"{blur:g}", *rms, f"{cell['kcal erf'].row()[4]:.2f}"]
    yield summary(cells)


@section("corners.md", "real", refinements=("saddle",))
def real(refinements: tuple[Refinement, ...] = get_args(Refinement)) -> Iterator[str]:
    """RMS of a 5-coefficient calibration of OpenCV's sample images, all corners alike, for every refinement."""

    def cell(side: str, refine: Refinement) -> str:
        seen = stereo_images(side, refine)
        result = calibrate_camera(seen, CalibrationOptions(weighted=False))
        unseen = sum(view.pixels.count(None) for view in seen.views)
        lost = f" ({unseen} of {BOARD.corners * len(seen.views)} corners rejected as glaring)" if unseen else ""
        return f"{result.rms:.4f}{lost}"

    sides = ("left", "right")
    return table(["refinement", *sides], ([refine, *(cell(side, refine) for side in sides)] for refine in refinements))


SLOWEST = "findChessboardCornersSB"
SLOW = 1  # image of 12 megapixels on which the sector detector is timed: minutes


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
