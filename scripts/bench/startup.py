"""CPU seconds and large libraries of a command, how long it is silent on a terminal, and what users wait for.

Seconds are those of user and system of the child process, because wall time depends on what else the machine does;
`waits` tells both, of an idle machine.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from kcal.cli.main import app
from scripts.shared.page import Lines
from scripts.shared.real_captures import load
from scripts.shared.sections import section
from scripts.shared.timing import children_seconds, median

_SAMPLE = Path(__file__).parents[2] / "assets" / "sample-rig.json"

LARGE = ("torch", "kornia", "cv2", "scipy", "scipy.stats", "skimage", "matplotlib", "pyproj", "jinja2")
_BEGIN = "import sys; from kcal.__main__ import main\n"
_END = "\nprint(*{names} & sys.modules.keys(), file=sys.stderr)"


def measure(arguments: list[str], folder: Path, code: str = "try: main()") -> tuple[float, int, list[str]]:
    """CPU seconds of a command, its exit code, and which of the large libraries it loaded."""
    end = _END.format(names=set(LARGE))
    code = f"{_BEGIN}{code}\nfinally:{end.replace(chr(10), ' ')}" if code.startswith("try") else _BEGIN + code + end
    before = children_seconds()
    done = subprocess.run([sys.executable, "-c", code, *arguments], cwd=folder, capture_output=True, text=True)
    seconds = children_seconds() - before
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
    """Commands as typed, nothing set; medians."""
    yield ["command", "on the clock, s", "CPU, s"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for capture in (*captures, "stereo_left", "stereo_right"):
            load(capture).seen.save(folder / f"{capture}.obs.json")
            words = ["calibrate", f"{capture}.obs.json", "-o", f"{capture}.json"]
            if capture in captures:
                words += ["--picture", "picture.png", "--report", "page.html"]
            cells = typed(words, folder, rounds)
            if capture in captures:
                yield [f"calibrate --picture --report, {capture}", *cells]
        first, pair = captures[-1], ["stereo_left.json", "stereo_right.json"]
        views = ["stereo_left.obs.json", "stereo_right.obs.json"]
        words = ["report", f"{first}.json", "--observations", f"{first}.obs.json", "-o", "page.html"]
        yield [f"report of a camera, {first}", *typed(words, folder, rounds)]
        words = ["rig", "solve", *pair, "--pairs", *views, "-o", "rig.json"]
        yield ["rig --pairs, 13 pairs", *typed(words, folder, rounds)]
        words = ["report", "rig.json", "--observations", *views, "-o", "page.html"]
        yield ["report of that rig", *typed(words, folder, rounds)]
        words = ["locate", str(_SAMPLE), str(_SAMPLE.with_name("sample-points.csv"))]
        yield ["locate, a few rows", *typed(words, folder, rounds)]
        yield ["show", *typed(["show", str(_SAMPLE)], folder, rounds)]
        first_lines = [on_terminal(words, folder).first for _ in range(rounds)]
        yield ["first line of locate on a terminal", "", median(first_lines, 2)]


def typed(words: list[str], folder: Path, rounds: int) -> list[str]:
    """Seconds on the clock and of the CPU of a command, medians; an answer may be no."""
    clock, cpu = list[float](), list[float]()
    for _ in range(rounds):
        before, start = children_seconds(), time.perf_counter()
        done = subprocess.run([sys.executable, "-m", "kcal", *words], cwd=folder, capture_output=True, text=True)
        assert done.returncode in (0, 3), done.stderr
        clock.append(time.perf_counter() - start)
        cpu.append(children_seconds() - before)
    return [median(clock, 2), median(cpu, 2)]
