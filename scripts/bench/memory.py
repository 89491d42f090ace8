"""Processor time and peak memory at steps of ten: long tables, large images, many points, many views.

Each size is a process of its own with one thread, whose input is made before by this one; processor time and the
memory's peak are those of that whole process, start included. `--largest` adds the sizes that take minutes. Peaks are
of `/proc/self/status`, so Linux is needed.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from kcal import Camera, load_rig, save_camera, save_rig
from kcal.rig import Mounting
from scripts.bench.locate import write_table
from scripts.shared.children import answer
from scripts.shared.long_range import ORIGIN, rig
from scripts.shared.page import table
from scripts.shared.sections import section
from scripts.shared.views import simulate

SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"
_HEAD = """
import sys, time, torch
from pathlib import Path
folder, size = Path(sys.argv[1]), int(sys.argv[2])
"""
_TAIL = """
import json
from scripts.shared.memory import peak_megabytes
print(json.dumps([f"{time.process_time():.1f}", f"{peak_megabytes():,.0f}", said]))
"""
_TABLE = """
from kcal.cli.main import main
sys.argv = ["kcal", "locate", str(folder / "rig.json"), str(folder / "marks.csv"), "-o", str(folder / "out.csv")]
try:
    main()
except SystemExit as end:
    assert not end.code, end.code
with (folder / "out.csv").open() as file:
    said = f"{sum(1 for _ in file) - 1:,} rows written"
"""
_POINTS = """
from kcal.io.camera_file import load_camera
camera = load_camera(folder / "camera.json")
width, height = camera.size
generator = torch.Generator().manual_seed(0)
pixels = torch.rand(size, 2, generator=generator, dtype=torch.float64) * torch.tensor([width - 1.0, height - 1.0])
"""
_UNPROJECT = f"""{_POINTS}
with torch.no_grad():
    rays, valid = camera.unproject(pixels)
said = f"{{int(valid.sum()):,}} valid"
"""
_PROJECT = f"""{_POINTS}
points = torch.cat([(pixels - pixels.new_tensor([width / 2, height / 2])) / width, torch.ones(size, 1)], -1)
del pixels
with torch.no_grad():
    found, valid = camera.project(points)
said = f"{{int(valid.sum()):,}} valid"
"""
_IMAGE = """
import cv2
from kcal.io.camera_file import load_camera
from kcal.lens.images import Undistort
camera = load_camera(folder / "camera.json")
image = torch.from_numpy(cv2.imread(str(folder / "image.png"), cv2.IMREAD_GRAYSCALE))[None]
new, mask = Undistort(camera)(image)
said = f"{float(mask.double().mean()):.1%} of the new pixels valid"
"""
_DETECT = """
from kcal.corners.board import Board
from kcal.corners.detect import detect
from kcal.errors import KcalError
from scripts.bench.memory import board_in
import numpy as np
try:
    found = detect([folder / "image.png"], Board(columns=9, rows=6, square=0.03))
    true = board_in(*found.image_size)[1]
    error = np.linalg.norm(np.array(found.views[0].pixels) - true, axis=-1).max()
    said = f"54 corners, at most {error:.3f} px off"
except KcalError as error:
    said = str(error).splitlines()[0]
"""
_VIEWS = """
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from scripts.shared.views import observed
import numpy as np
options = CalibrationOptions() if "MODEL" == "default" else CalibrationOptions(model="MODEL")
found = calibrate_camera(observed(np.load(folder / "views.npy").tolist()), options)
said = f"RMS {found.rms:.4f} px; the noise is 0.2828"
"""
_FLEET = """
from kcal.calibrate.batch.jobs import BatchOptions, Calibrated, CameraJob, Detected
from kcal.calibrate.batch.results import Results, Task
from kcal.corners.board import Board
from kcal.io.camera_file import CameraFile
board = Board(columns=9, rows=6, square=0.03)
images = tuple(folder / f"{i}.png" for i in range(6))
jobs = [CameraJob(name=f"camera-{n}", images=images, board=board, model="opencv5") for n in range(size)]
results = Results(folder, jobs, BatchOptions())
for _ in results.tasks(lambda text: None):
    break
camera = CameraFile.load(folder / "camera.json")
for n in range(size):
    for i in range(6):
        pixels = tuple((float(u), float(v)) for u, v in torch.rand(54, 2).tolist())
        found = Detected(size=(640, 480), pixels=pixels, covariance=tuple((u, 0.0, v) for u, v in pixels))
        for task in results.done(Task(("image", n, i, f"{n}-{i}"), None, ()), found):
            results.done(task, Calibrated(camera=camera))
said = f"{len(results.rows()):,} lines of the table"
"""


class Step(NamedTuple):
    """What is measured: title, code of the process, its input, sizes, and those added by `--largest`."""

    title: str
    code: str
    prepare: Callable[[Path, int], object]
    sizes: tuple[int, ...]
    largest: tuple[int, ...] = ()


def board_in(width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Gray image (H, W) uint8 of a tilted board of 9x6 inner corners that fills it, and the corners (54, 2)."""
    square = 100
    page = np.full((9 * square, 12 * square), 230, np.uint8)
    for row in range(7):
        for column in range(row % 2, 10, 2):
            top, left = (row + 1) * square, (column + 1) * square
            page[top : top + square, left : left + square] = 30
    inner = np.array([(2 + c, 2 + r) for r in range(6) for c in range(9)], dtype=float) * square - 0.5
    corners = np.array([(0.02, 0.03), (0.97, 0.08), (0.93, 0.96), (0.05, 0.9)]) * (width, height)
    ends = np.array([(0, 0), (1200, 0), (1200, 900), (0, 900)]) - 0.5
    turn = cv2.getPerspectiveTransform(ends.astype(np.float32), corners.astype(np.float32))
    image = cv2.warpPerspective(page, turn, (width, height), flags=cv2.INTER_LINEAR, borderValue=128)
    image = cv2.GaussianBlur(image, (0, 0), max(1.0, width / 4000))
    noise = np.random.default_rng(0).normal(0, 2, (min(height, 1000), width))
    for top in range(0, height, len(noise)):
        part = image[top : top + len(noise)]
        part[:] = np.clip(part + noise[: len(part)], 0, 255)
    return image, cv2.perspectiveTransform(inner[None], turn)[0]


def large_camera(megapixels: int) -> Camera:
    """A distorted camera of an image of 4 : 3."""
    width = round((megapixels * 1e6 * 4 / 3) ** 0.5)
    height = round(width * 3 / 4)
    return Camera.build(
        focal=(0.8 * width, 0.8 * width), center=((width - 1) / 2, (height - 1) / 2), size=(width, height),
        coefficients=[-0.2, 0.05, 1e-3, -5e-4, 0.0],
    )  # fmt: skip


def _tables(folder: Path, count: int) -> None:
    mounted = rig()
    mounted.mounting = Mounting(origin=ORIGIN, heading_deg=35.0)
    save_rig(mounted, folder / "rig.json")
    write_table(folder / "marks.csv", count)


def _image(folder: Path, megapixels: int) -> None:
    camera = large_camera(megapixels)
    save_camera(camera, folder / "camera.json")
    cv2.imwrite(str(folder / "image.png"), board_in(*camera.size)[0], [cv2.IMWRITE_PNG_COMPRESSION, 1])


def _views(folder: Path, count: int) -> None:
    """Distinct views up to 1,000; more of them repeat those with noise of their own."""
    pixels = simulate(min(count, 1000), noise=0.0, seed=0)["pixels"]
    pixels = np.tile(pixels, (-(-count // len(pixels)), 1, 1))[:count]
    np.save(folder / "views.npy", pixels + np.random.default_rng(1).normal(0, 0.2, pixels.shape))


def _fleet(folder: Path, _: int) -> None:
    """A camera file, and what stands for images."""
    save_camera(large_camera(1), folder / "camera.json")
    for i in range(6):
        (folder / f"{i}.png").write_bytes(b"")


def _default_camera(folder: Path, _: int) -> None:
    save_camera(load_rig(SAMPLE).left, folder / "camera.json")


def _parametric_camera(folder: Path, _: int) -> None:
    save_camera(large_camera(2), folder / "camera.json")


STEPS = {
    "table": [Step("`kcal locate`, rows of a CSV file", _TABLE, _tables, (10_000, 100_000, 1_000_000), (10_000_000,))],
    "points": [
        Step(f"`Camera.{name}`, points, {lens}", code, prepare, (1_000_000, 10_000_000))
        for name, code in (("project", _PROJECT), ("unproject", _UNPROJECT))
        for lens, prepare in (("opencv5", _parametric_camera), ("default lens", _default_camera))
    ],
    "image": [Step("`Undistort`, megapixels, uint8", _IMAGE, _image, (1, 10, 100))],
    "detect": [Step("`detect`, megapixels, 9x6 board", _DETECT, _image, (1, 10, 100))],
    "fleet": [Step("what `kcal batch` keeps, cameras of 6 views", _FLEET, _fleet, (100, 1_000), (10_000,))],
    "views": [
        Step(f"`calibrate_camera`, views, {lens}", _VIEWS.replace("MODEL", model), _views, (100, 1_000), (10_000,))
        for lens, model in (("default lens", "default"), ("opencv8", "opencv8"))
    ],
}


def measured(step: Step, size: int) -> list[str]:
    """One row of the table."""
    with tempfile.TemporaryDirectory() as name:
        step.prepare(Path(name), size)
        found = answer(sys.executable, "-c", _HEAD + step.code + _TAIL, name, size)
    return [step.title, f"{size:,}", *(["–", "–", found["failed"]] if "failed" in found else found)]


# Megapixels and views of a quick run.
IN_LITTLE = {"image": 1, "detect": 1, "views": 8}


def _registered(name: str) -> None:
    @section("precision.md", "fleet memory" if name == "fleet" else name, sizes=(IN_LITTLE.get(name, 100),))
    def measure(largest: bool = False, sizes: tuple[int, ...] = (0,)) -> Iterator[str]:
        rows = (
            measured(step, size)
            for step in STEPS[name]
            for size in (sizes if any(sizes) else (*step.sizes, *(step.largest if largest else ())))
        )
        return table(["what", "size", "CPU s", "peak MB", "result"], rows)


for _name in STEPS:
    _registered(_name)
