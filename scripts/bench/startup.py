"""CPU seconds and large libraries of a command, and how long it is silent on a terminal, at first and at most.

Seconds are those of user and system of the child process, because wall time depends on what else the machine does.
"""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from kcal.cli.main import app
from scripts.shared.timing import children_seconds

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
