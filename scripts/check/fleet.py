"""A fleet on Dask while its workers are killed, and its scheduler once: the results of an undisturbed run.

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
from pathlib import Path
from typing import NamedTuple

import psutil

from scripts.shared.children import ALONE
from scripts.shared.memory import peak_megabytes
from scripts.shared.page import Lines
from scripts.shared.sections import section
from scripts.shared.small_photographs import COLUMNS, HEIGHT, ROWS, WIDTH, photographs
from scripts.shared.timing import children_seconds

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
