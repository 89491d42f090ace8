"""Processor time and peak memory at steps of ten: long tables, large images, many points, many views.

Each size is a process of its own with one thread, whose input is made before by this one; processor time and the
memory's peak are those of that whole process, start included. `--largest` adds the sizes that take minutes. Peaks are
of `/proc/self/status`, so Linux is needed.

A fleet on Dask while its workers are killed, and its scheduler once: the results of an undisturbed run.

Photographs of a board are drawn for each camera, which has a focal length, center and distortion of its own. The same
`kcal batch` is run three times on them: by processes of this machine; by a Dask cluster of this machine, of which a
worker is killed (SIGKILL) after every so many finished pieces of work; and by one whose scheduler is killed as well,
after half of the work, and which a new cluster continues. A piece is an image or a camera. Shown for each: how many
observations differ from the first run in any byte, how far cameras differ, cameras that are missing or there twice,
pieces of work that were kept, processor time of all processes, and the largest peak of memory of one process: the
command, the scheduler, a worker (Linux).
"""

from __future__ import annotations

import contextlib
import csv
import itertools
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import psutil

from kcal import Camera, load_rig, save_camera, save_rig
from kcal.rig import Mounting
from scripts.bench.locate import write_table
from scripts.shared.children import ALONE, answer
from scripts.shared.long_range import ORIGIN, rig
from scripts.shared.page import Lines, children_seconds, peak_megabytes, section, table
from scripts.shared.small_photographs import COLUMNS, HEIGHT, ROWS, WIDTH, photographs
from scripts.shared.views import simulate

SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"
_HEAD = """
import sys, time, torch
from pathlib import Path
folder, size = Path(sys.argv[1]), int(sys.argv[2])
"""
_TAIL = """
import json
from scripts.shared.page import peak_megabytes
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
    def measure(largest: bool = False, sizes: tuple[int, ...] = (0,)) -> Lines:
        rows = (
            measured(step, size)
            for step in STEPS[name]
            for size in (sizes if any(sizes) else (*step.sizes, *(step.largest if largest else ())))
        )
        return table(["what", "size", "CPU s", "peak MB", "result"], rows)


for _name in STEPS:
    _registered(_name)


# In σ: fits of the same corners in two processes can differ in their last digits.
_SAME = 1e-4
_BEGINS = 60.0  # seconds that a scheduler and its workers have to begin
HEAD = [
    "run", "workers killed", "observations that differ", "largest difference, σ", "missing or twice", "pieces kept",
    "CPU s", "peak MB: command", "scheduler", "worker",
]  # fmt: skip


class Run(NamedTuple):
    """What is known of one run of the command: exit code, what it said, processor time, peaks of memory by role."""

    code: int
    said: str
    seconds: float
    peaks: dict[str, float]
    kills: int


class Cluster:
    """A Dask scheduler and workers under nannies, each a process; `kill_worker` ends one worker, not its nanny."""

    def __init__(self, folder: Path, workers: int) -> None:
        self._where = folder / f"scheduler-{time.time_ns()}.json"
        self._turn = itertools.count()
        self.parts = {"scheduler": self._start("scheduler", "--port", "0")}
        until = time.monotonic() + _BEGINS
        while not self._where.exists() and time.monotonic() < until:
            time.sleep(0.1)
        for number in range(workers):
            self.parts[f"nanny {number}"] = self._start(
                "worker", "--nthreads", "1", "--nworkers", "1", "--local-directory", str(folder)
            )

    def _start(self, kind: str, *options: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.dask_{kind}", *options, "--host", "127.0.0.1",
                   "--no-dashboard", "--scheduler-file", str(self._where)]  # fmt: skip
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=os.environ | ALONE)

    @property
    def address(self) -> str:
        """Of the scheduler."""
        return next(word for word in self._where.read_text().split('"') if word.startswith("tcp://"))

    def workers(self) -> list[psutil.Process]:
        """The processes that do the work."""
        found = []
        for name, nanny in self.parts.items():
            if name != "scheduler":
                with contextlib.suppress(psutil.Error):
                    found += [child for child in psutil.Process(nanny.pid).children(recursive=True) if _works(child)]
        return found

    def kill_worker(self) -> int:
        """How many workers were killed: one, in turn, or none where none is there."""
        there = self.workers()
        if not there:
            return 0
        with contextlib.suppress(psutil.Error):
            there[next(self._turn) % len(there)].kill()
            return 1
        return 0

    def close(self) -> None:
        """End all processes."""
        for part in self.parts.values():
            part.send_signal(signal.SIGINT)
        for part in self.parts.values():
            try:
                part.wait(20)
            except subprocess.TimeoutExpired:
                part.kill()
                part.wait()


def _works(process: psutil.Process) -> bool:
    with contextlib.suppress(psutil.Error):
        return "spawn_main" in " ".join(process.cmdline())
    return False


def batch(
    source: Path, output: Path, *options: str, on: Cluster | None = None, every: int = 0, stop_after: int = 0
) -> Run:
    """`kcal batch`, while a worker is killed after `every` pieces, and the scheduler after `stop_after`."""
    command = [sys.executable, "-m", "kcal", "batch", str(source), "--board", f"{COLUMNS}x{ROWS}", "--square", "20mm",
               "-o", str(output), *options]  # fmt: skip
    if on is not None:
        command += ["--scheduler", on.address]
    before, peaks, kills = children_seconds(), defaultdict[str, float](float), 0
    next_kill = pieces_kept(output) + every
    with tempfile.TemporaryFile("w+") as said:
        running = subprocess.Popen(command, stdout=said, stderr=said, env=os.environ | ALONE)
        while running.poll() is None:
            time.sleep(0.2)
            _note_peaks(peaks, running.pid, on)
            kept = pieces_kept(output)
            if on is not None and every and kept >= next_kill:
                kills += on.kill_worker()
                next_kill = kept + every
            if on is not None and stop_after and kept >= stop_after:
                on.parts["scheduler"].kill()
                stop_after = 0
        said.seek(0)
        text = said.read()
    return Run(running.returncode, text, children_seconds() - before, dict(peaks), kills)


def pieces_kept(output: Path) -> int:
    """Finished pieces of work in a batch's folder."""
    work = output / ".work"
    return sum(1 for path in work.iterdir() if path.suffix == ".json") if work.exists() else 0


def _note_peaks(peaks: dict[str, float], command: int, on: Cluster | None) -> None:
    pids = {"command": [command]}
    if on is None:
        with contextlib.suppress(psutil.Error):
            pids["worker"] = [child.pid for child in psutil.Process(command).children() if _works(child)]
    else:
        pids |= {"scheduler": [on.parts["scheduler"].pid], "worker": [process.pid for process in on.workers()]}
    for role, of_role in pids.items():
        for pid in of_role:
            with contextlib.suppress(OSError, StopIteration):
                peaks[role] = max(peaks[role], peak_megabytes(pid))


def differing(found: Path, expected: Path) -> int:
    """How many files of observations differ in any byte from those of another run, or are in one of both only."""
    names = {path.name for folder in (found, expected) for path in folder.glob("*.obs.json")}
    return sum(1 for name in names if _bytes(found / name) != _bytes(expected / name))


def farthest(found: Path, expected: Path) -> float:
    """Largest difference of focal lengths and centers in the tables of two runs, in σ of the focal length."""
    if not (found / "summary.csv").exists():
        return float("inf")
    one, two = (list(csv.DictReader((folder / "summary.csv").open())) for folder in (found, expected))
    return max(
        abs(float(a[name] or "nan") - float(b[name] or "nan")) / float(b["sigma_fx"] or "nan")
        for a, b in zip(one, two, strict=True)
        for name in ("fx", "fy", "cx", "cy", "focal")
    )


def _bytes(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


def missing_or_twice(output: Path, names: list[str]) -> int:
    """Cameras that are not exactly once, and calibrated, in the table."""
    if not (output / "summary.csv").exists():
        return len(names)
    with (output / "summary.csv").open() as file:
        rows = Counter(row["camera"] for row in csv.DictReader(file) if row["status"] == "ok")
    return sum(rows[name] != 1 for name in names) + sum(name not in names for name in rows)


@section("precision.md", "fleet", cameras=2, views=3, every=3)
def fleet(
    cameras: int = 1000, views: int = 6, every: int = 100, workers: int = 2, model: str = "opencv5",
    refine: str = "saddle",
) -> Lines:  # fmt: skip
    """A worker is killed after every so many pieces of work."""
    rows, failed = [], False
    with tempfile.TemporaryDirectory(prefix="kcal-fleet-") as name:
        folder = Path(name)
        names = [f"camera-{number:05d}" for number in range(cameras)]
        for number, camera in enumerate(names):
            photographs(folder / "images" / camera, number, views)
        source, options = folder / "images", ("--model", model, "--refine", refine)

        def add(title: str, output: Path, runs: list[Run], seconds: float) -> None:
            nonlocal failed
            differ, wrong = differing(output, folder / "whole"), missing_or_twice(output, names)
            away = farthest(output, folder / "whole")
            failed |= bool(differ or wrong or runs[-1].code) or not away < _SAME
            peaks = {role: max(run.peaks.get(role, 0.0) for run in runs) for role in ("command", "scheduler", "worker")}
            kills = str(sum(run.kills for run in runs))
            memory = [f"{peak:.0f}" if peak else "–" for peak in peaks.values()]
            counts = [f"{differ:,} of {len(names):,}", f"{away:.0e}", f"{wrong}", f"{pieces_kept(output):,}"]
            rows.append([title, kills, *counts, f"{seconds:.0f}", *memory])

        whole = batch(source, folder / "whole", "--workers", str(workers), *options)
        add("processes, undisturbed", folder / "whole", [whole], whole.seconds)

        before = children_seconds()
        with contextlib.closing(Cluster(folder, workers)) as dask:
            run = batch(source, folder / "killed", *options, on=dask, every=every)
        add("Dask, workers killed", folder / "killed", [run], children_seconds() - before)

        before = children_seconds()
        half = len(names) * (views + 1) // 2
        with contextlib.closing(Cluster(folder, workers)) as dask:
            first = batch(source, folder / "resumed", *options, on=dask, every=every, stop_after=half)
        assert first.code == 1, first
        assert "the same command" in first.said, first
        with contextlib.closing(Cluster(folder, workers)) as dask:
            second = batch(source, folder / "resumed", *options, on=dask, every=every)
        add(
            "Dask, also its scheduler, then continued", folder / "resumed", [first, second], children_seconds() - before
        )
    yield from [HEAD, *rows]
    yield (
        f"{cameras:,} cameras of {views} images of {WIDTH} x {HEIGHT}, {model}, {workers} workers of one thread, "
        f"a kill after every {every} pieces of work."
    )
    if failed:
        raise RuntimeError("a run differs from the undisturbed one")
