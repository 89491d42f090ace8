"""Processor time and memory of the default camera, beside OpenCV, 14 coefficients, Ceres and mrcal's splines.

KCAL_PEERS names an interpreter that has pyceres, KCAL_MRCAL one that has mrcal. Views as in `scripts.bench.solver`:
6 x 7 corners, 0.2 px of noise. Each run is a process of its own, warmed up on eight views; runs alternate. Ceres begins
at a good start that is not timed.

CPU seconds and large libraries of a command, how long it is silent on a terminal, and what users wait for.

Seconds are those of user and system of the child process, because wall time depends on what else the machine does;
`waits` tells both, of an idle machine.
"""

from __future__ import annotations

import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from kcal.cli.main import app
from kcal.corners.observations import Observations
from kcal.errors import KcalError
from scripts.bench import solver
from scripts.shared.children import ALONE, answer, interpreter, or_failure, timed_process
from scripts.shared.page import Lines, median, peak_megabytes, section, table
from scripts.shared.peer_lenses import calibrated, splined
from scripts.shared.real_captures import load, names
from scripts.shared.views import observed, simulate

SPLINE, FEWER = "SPLINED13x9", "SPLINED11x8"
DEFAULT, MANY, SINGLE = "default camera", "one call", "single calls"
TYPED = "kcal calibrate, with picture and page"
OPENCV = "OpenCV, 8 coefficients"


def work(way: str, views: int | str, cameras: int) -> None:
    """In a process of its own: calibrate, and print processor seconds and peak memory."""
    from kcal.calibrate.camera.calibrate import calibrate_camera, calibrate_cameras

    if isinstance(views, str):
        sets = [load(views).seen]
    else:
        sets = [observed(simulate(views, seed=50_000 + i)["pixels"].tolist()) for i in range(cameras)]
    calibrate_camera(observed(simulate(8)["pixels"].tolist()))
    before, start = peak_megabytes(), time.process_time()
    if way == MANY:
        calibrate_cameras(sets)
    for seen in sets * (way != MANY):
        if way == OPENCV:
            calibrated(seen, 8)
            continue
        with contextlib.suppress(KcalError):
            calibrate_camera(seen)
    print(json.dumps({"seconds": time.process_time() - start, "megabytes": peak_megabytes(), "before": before}))


def own(way: str, views: int | str, cameras: int = 1) -> dict[str, Any]:
    code = f"from scripts.bench.hybrid_time import work; work({way!r}, {views!r}, {cameras})"
    return answer(sys.executable, "-c", code)


def typed(seen: Observations) -> dict[str, Any]:
    """`kcal calibrate` with picture and page, start-up included."""
    with tempfile.TemporaryDirectory() as folder:
        views, camera, picture, page = (str(Path(folder, name)) for name in ("obs.json", "c.json", "c.png", "c.html"))
        seen.save(views)
        words = ["calibrate", views, "-o", camera, "--picture", picture, "--report", page]
        _, seconds = timed_process(sys.executable, "-m", "kcal", *words, env=os.environ | ALONE)
    return {"seconds": seconds}


def spline(lens: str, seen: Observations, focal: float, timeout: float) -> dict[str, Any]:
    """Mrcal's splined lens, with no view held out."""
    pixels, none = seen.pixels().numpy(), np.arange(0)
    weight = np.isfinite(pixels).all(-1).astype(float)
    about: Any = {"size": seen.image_size, "board": seen.board, "focal": focal, "timeout": timeout}
    found = or_failure(lambda: splined(lens, pixels, weight, none, **about))
    return found if "failed" in found else {"seconds": found["cpu_s"]}


def compare(views: int, repeats: int, timeout: float) -> list[Any]:
    """A row of the table."""
    others = ["kcal, weak prior", *(["Ceres"] if interpreter("peers") else [])]
    runs: dict[str, list[dict[str, Any]]] = {}
    data = simulate(views)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "views.npz"
        np.savez(path, **data)  # type: ignore[arg-type]
        for _ in range(repeats):
            runs.setdefault(DEFAULT, []).append(own(DEFAULT, views))
            for name in others:
                runs.setdefault(name, []).append(solver.run(name, path, 14, timeout))
            if interpreter("mrcal"):
                seen = observed(data["pixels"].tolist())
                runs.setdefault(SPLINE, []).append(spline(SPLINE, seen, 1500.0, timeout))
    cells: list[Any] = [views]
    first = [run["seconds"] for run in runs[DEFAULT]]
    for found in runs.values():
        if "failed" in found[-1]:
            cells.append(found[-1]["failed"])
            continue
        seconds = [run["seconds"] for run in found]
        ratios = [a / b for a, b in zip(first, seconds, strict=True)]
        spread = "" if found is runs[DEFAULT] else f" ({statistics.median(ratios):.2f})"
        cells.append(f"{statistics.median(seconds):.2f} s{spread}")
    return [*cells, f"{runs[DEFAULT][-1]['megabytes']:.0f} MB"]


@section("one-camera.md", "time", views=(6,), repeats=1)
def time_of_fits(views: tuple[int, ...] = (6, 15, 30, 60, 200, 800), repeats: int = 3, timeout: float = 120.0) -> Lines:
    header = ["views", DEFAULT, "14 coefficients, weak prior"]
    header += ["Ceres, 14 coefficients"] if interpreter("peers") else []
    header += [f"mrcal, {SPLINE}"] if interpreter("mrcal") else []
    return table([*header, "peak memory of the default"], (compare(count, repeats, timeout) for count in views))


@section("one-camera.md", "captures", captures=("ch1280",))
def time_of_captures(captures: tuple[str, ...] = ("all",), timeout: float = 300.0) -> Lines:
    """Captures by strangers; in brackets the default camera's time over the other's."""
    mrcal = interpreter("mrcal")
    yield ["capture", "views", "corners", DEFAULT, TYPED, OPENCV, *[f"mrcal, {FEWER}"] * bool(mrcal)]
    ratios, sums = dict[str, list[float]](), [0.0, 0.0]
    for name in names() if captures == ("all",) else captures:
        seen = load(name).seen
        found = {DEFAULT: own(DEFAULT, name), TYPED: typed(seen), OPENCV: own(OPENCV, name)}
        if mrcal and seen.board.pattern == "checkerboard":
            found[FEWER] = spline(FEWER, seen, 0.7 * seen.image_size[0], timeout)
        first = found[DEFAULT]["seconds"]
        sums = [sums[0] + first, sums[1] + found[TYPED]["seconds"]]
        cells = [f"{first:.2f} s", f"{found[TYPED]['seconds']:.1f} s"]
        for other in [OPENCV, *[FEWER] * bool(mrcal)]:
            spent = found.get(other, {"failed": "–"})
            if "failed" not in spent:
                ratios.setdefault(other, []).append(first / spent["seconds"])
            cells.append(spent.get("failed") or f"{spent['seconds']:.3f} s ({ratios[other][-1]:.0f})")
        yield [name, len(seen.views), int(seen.pixels().isfinite().all(-1).sum()), *cells]
    middle = [f"median {statistics.median(ratios[each]):.0f}" for each in ratios]
    yield ["all", "", "", f"{sums[0]:.1f} s", f"{sums[1]:.1f} s", *middle]


@section("one-camera.md", "many", cameras=2, each=6)
def many(cameras: int = 64, each: int = 30) -> Lines:
    """Many cameras in one call, and in calls of their own."""
    yield f"{cameras} cameras of {each} views each. One call also finds which of them saw one board."
    yield ["way", "processor time", "memory, more than before"]
    for way in (MANY, SINGLE):
        one = own(way, each, cameras)
        yield [way, f"{one['seconds']:.1f} s", f"{one['megabytes'] - one['before']:.0f} MB"]


_SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"

LARGE = ("torch", "kornia", "cv2", "scipy", "scipy.stats", "skimage", "matplotlib", "pyproj", "jinja2")
_BEGIN = "import sys; from kcal.__main__ import main\n"
_END = "\nprint(*{names} & sys.modules.keys(), file=sys.stderr)"


def measure(arguments: list[str], folder: Path, code: str = "try: main()") -> tuple[float, int, list[str]]:
    """CPU seconds of a command, its exit code, and which of the large libraries it loaded."""
    end = _END.format(names=set(LARGE))
    code = f"{_BEGIN}{code}\nfinally:{end.replace(chr(10), ' ')}" if code.startswith("try") else _BEGIN + code + end
    done, seconds = timed_process(sys.executable, "-c", code, *arguments, cwd=folder)
    return seconds, done.returncode, sorted(done.stderr.splitlines()[-1].split())


class Terminal(NamedTuple):
    """What a command wrote on a terminal; CPU seconds to the first character, between two of them, and in all."""

    code: int
    text: str
    first: float
    silent: float
    seconds: float


def on_terminal(words: list[str], folder: Path) -> Terminal:
    """Run a command on a terminal of its own (Linux)."""
    import pty

    terminal, inside = pty.openpty()
    child = subprocess.Popen(
        [sys.executable, "-m", "kcal", *words],
        cwd=folder,
        env=os.environ | {"TERM": "xterm", "COLUMNS": "120", "LINES": "40"},
        stdin=inside,
        stdout=inside,
        stderr=inside,
        start_new_session=True,
    ).pid
    os.close(inside)
    times, text = [0.0], b""
    with contextlib.suppress(OSError):  # the terminal of a process that has ended
        while data := os.read(terminal, 2**16):
            used = Path(f"/proc/{child}/stat").read_text().rpartition(")")[2].split()
            times.append(sum(map(int, used[11:15])) / os.sysconf("SC_CLK_TCK"))
            text += data
    os.close(terminal)
    _, status, used_in_all = os.wait4(child, 0)
    seconds = used_in_all.ru_utime + used_in_all.ru_stime
    gaps = [after - before for before, after in zip(times, [*times[1:], seconds], strict=True)]
    return Terminal(os.waitstatus_to_exitcode(status), text.decode(errors="replace"), gaps[0], max(gaps), seconds)


def helps() -> list[list[str]]:
    """`--help` of every command and of subcommands."""
    import typer

    found = []
    for name, command in typer.main.get_command(app).commands.items():  # type: ignore[attr-defined]
        found += [[name, "--help"], *([name, part, "--help"] for part in getattr(command, "commands", {}))]
    return [["--help"], *found]


@section("one-camera.md", "waits", captures=("sq1280",), rounds=1)
def waits(captures: tuple[str, ...] = ("camodocal", "fish_l", "sq1280", "st1_l"), rounds: int = 3) -> Lines:
    """Commands as waited, nothing set; medians."""
    yield ["command", "on the clock, s", "CPU, s"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for capture in (*captures, "stereo_left", "stereo_right"):
            load(capture).seen.save(folder / f"{capture}.obs.json")
            words = ["calibrate", f"{capture}.obs.json", "-o", f"{capture}.json"]
            if capture in captures:
                words += ["--picture", "picture.png", "--report", "page.html"]
            cells = waited(words, folder, rounds)
            if capture in captures:
                yield [f"calibrate --picture --report, {capture}", *cells]
        first, pair = captures[-1], ["stereo_left.json", "stereo_right.json"]
        views = ["stereo_left.obs.json", "stereo_right.obs.json"]
        words = ["report", f"{first}.json", "--observations", f"{first}.obs.json", "-o", "page.html"]
        yield [f"report of a camera, {first}", *waited(words, folder, rounds)]
        words = ["rig", "solve", *pair, "--pairs", *views, "-o", "rig.json"]
        yield ["rig --pairs, 13 pairs", *waited(words, folder, rounds)]
        words = ["report", "rig.json", "--observations", *views, "-o", "page.html"]
        yield ["report of that rig", *waited(words, folder, rounds)]
        words = ["locate", str(_SAMPLE), str(_SAMPLE.with_name("sample-points.csv"))]
        yield ["locate, a few rows", *waited(words, folder, rounds)]
        yield ["show", *waited(["show", str(_SAMPLE)], folder, rounds)]
        first_lines = [on_terminal(words, folder).first for _ in range(rounds)]
        yield ["first line of locate on a terminal", "", median(first_lines, 2)]


def waited(words: list[str], folder: Path, rounds: int) -> list[str]:
    """Seconds on the clock and of the CPU of a command, medians; an answer may be no."""
    clock, cpu = list[float](), list[float]()
    for _ in range(rounds):
        start = time.perf_counter()
        done, seconds = timed_process(sys.executable, "-m", "kcal", *words, cwd=folder)
        assert done.returncode in (0, 3), done.stderr
        clock.append(time.perf_counter() - start)
        cpu.append(seconds)
    return [median(clock, 2), median(cpu, 2)]
