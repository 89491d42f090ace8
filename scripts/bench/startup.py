"""CPU seconds and large libraries of each command: `python -m scripts.bench.startup [FOLDER COMMAND...]`.

`--help` of every command, and commands on small files that compute little. Seconds are those of user and system of the
child process, because wall time depends on what else the machine does.

With a folder and commands, each in quotation marks: how long each is silent on a terminal, at first and at most.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import kcal
from kcal.cli.main import app
from scripts.shared.timing import children_seconds

LARGE = ("torch", "kornia", "cv2", "scipy", "scipy.stats", "skimage", "matplotlib", "pyproj", "jinja2")
ROOT = Path(kcal.__file__).parents[1]
SAMPLE = ROOT / "assets" / "sample-rig.json"
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


def commands(folder: Path) -> list[list[str]]:
    """Commands on files that this writes into the folder."""
    from kcal import Camera, load_rig, save_camera, save_rig

    rig = load_rig(SAMPLE)
    save_rig(rig, folder / "rig.json")
    save_camera(rig.left, folder / "left.json")
    save_camera(rig.right, folder / "right.json")
    plain = Camera.build(focal=(1600, 1600), center=(959.5, 539.5), size=(1920, 1080), coefficients=[-0.1, 0.01, 0, 0])
    save_camera(plain, folder / "plain.json")
    return [
        ["show", "plain.json"],
        ["show", "left.json"],
        ["show", "rig.json"],
        ["diff", "left.json", "right.json"],
        ["diff", "plain.json", "plain.json"],
        ["export", "plain.json", "-o", "plain.yaml"],
        ["show", "plain.yaml"],
        ["import", "plain.yaml", "-o", "back.json"],
        ["budget"],
        ["budget", "rig.json"],
        ["report", "left.json"],
        ["report", "rig.json"],
        ["locate", "rig.json", str(ROOT / "assets" / "sample-points.csv")],
        ["board", "--board", "9x6", "--square", "25mm", "-o", "board.svg"],
    ]


def main() -> None:
    """Print the table."""
    if len(sys.argv) > 2:
        print("first character, longest silence, end: CPU s  exit  command")
        for line in sys.argv[2:]:
            found = on_terminal(shlex.split(line), Path(sys.argv[1]))
            print(f"{found.first:5.2f}  {found.silent:5.2f}  {found.seconds:6.2f}  {found.code:4}  {line}", flush=True)
        return
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        print("CPU s  exit  command  (large libraries that it loaded)")
        for arguments in [*helps(), *commands(folder)]:
            seconds, code, loaded = measure(arguments, folder)
            print(f"{seconds:5.2f}  {code:4}  {' '.join(map(str, arguments))}  ({', '.join(loaded)})", flush=True)


if __name__ == "__main__":
    main()
