"""Run a command in a process of its own and interrupt it, as Ctrl-C of a terminal does, at a moment that is exact.

`python interrupted.py KIND:VALUE COMMAND...`, where the moment is

* `import:NAME`: when that module is imported;
* `lost:NAME`: likewise, but an extension module makes another error of it;
* `search:N`: during the N-th search of an image by OpenCV;
* `step:N`: at the N-th step of a progress bar;
* `write:N`, `written:N`: right before and right after the N-th file comes into its place;
* `killed:N`: right after that, but killed, as when the power fails.
"""

import builtins
import os
import runpy
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import rich.progress
from waiting import wait_for


def interrupt_at(moment: str) -> None:
    """Send SIGINT, or SIGKILL, to all processes of this command at that moment."""
    # Where tests run in the background of a shell, it was ignored.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    kind, _, value = moment.partition(":")
    left = [1 if kind in ("import", "lost") else int(value)]
    sent = signal.SIGKILL if kind == "killed" else signal.SIGINT

    def strike() -> None:
        left[0] -= 1
        if left[0] == 0:
            os.killpg(0, sent)
            # The main thread hears it, at some time; until then another one goes no further.
            if threading.current_thread() is not threading.main_thread():
                wait_for(_awaited)

    def struck(call: Callable[..., Any], *, after: bool = False) -> Callable[..., Any]:
        def run(*arguments: Any, **options: Any) -> Any:
            if not after:
                strike()
            found = call(*arguments, **options)
            if after:
                strike()
            return found

        return run

    if kind in ("import", "lost"):
        load = builtins.__import__

        def imported(name: str, *arguments: Any, **options: Any) -> Any:
            if name == value:
                try:
                    strike()
                except KeyboardInterrupt:
                    raise KeyboardInterrupt if kind == "import" else ImportError("initialization failed") from None
            return load(name, *arguments, **options)

        builtins.__import__ = imported
    elif kind == "search":
        import cv2

        search = cv2.findChessboardCorners

        def searched(*arguments: Any, **options: Any) -> Any:
            left[0] -= 1
            if left[0] == 0:
                os.killpg(0, sent)
                for _ in range(100):
                    search(*arguments, **options)
            return search(*arguments, **options)

        cv2.findChessboardCorners = searched
    elif kind == "step":
        rich.progress.Progress.update = struck(rich.progress.Progress.update)  # type: ignore[method-assign]
    else:
        os.replace = struck(os.replace, after=kind != "write")


def _awaited() -> bool:
    """Whether the main thread waits for this one to end."""
    frame = sys._current_frames()[threading.main_thread().ident or 0]
    while frame is not None:
        if frame.f_code is threading.Thread.join.__code__ and frame.f_locals["self"] is threading.current_thread():
            return True
        frame = frame.f_back
    return False


def interrupt(folder: Path, moment: str, line: str) -> str:
    """The last line on the error stream of a command that was interrupted; nothing else may have been said."""
    before, words = set(folder.rglob("*")), line.split()
    if moment.startswith(("import:", "lost:")) or words[0] == "batch":  # loads for itself; has workers in its group
        words = [sys.executable, __file__, moment, *words]
        done = subprocess.run(words, cwd=folder, capture_output=True, text=True, start_new_session=True, timeout=1800)
        code, said = done.returncode, done.stderr
    else:
        from scripts.shared.children import children  # which this file as a script would not find

        with tempfile.TemporaryDirectory() as place:
            there = Path(place, "said")
            child = children().Process(target=_command, args=(moment, words, folder, there, dict(os.environ)))
            child.start()
            child.join()
            code, said = child.exitcode, there.read_text()
    assert code == 130, said
    assert "Traceback" not in said
    left = [path.name for path in set(folder.rglob("*")) - before]
    assert not [name for name in left if name.startswith(".kcal-") or name.endswith((".part", ".lock"))]
    return said.splitlines()[-1]


def _command(moment: str, words: list[str], folder: Path, said: Path, environment: dict[str, str]) -> None:
    """A command as a process of its own, in a copy of one that has loaded what takes long."""
    os.setsid()
    os.chdir(folder)
    os.environ |= environment
    sys.argv = ["kcal", *words]
    with said.open("w") as sys.stderr, open(os.devnull, "w") as sys.stdout:
        interrupt_at(moment)
        runpy.run_module("kcal", run_name="__main__")


# Processes that the command starts run this file again.
if __name__ == "__main__":
    interrupt_at(sys.argv.pop(1))
    sys.argv[0] = "kcal"
    runpy.run_module("kcal", run_name="__main__")
