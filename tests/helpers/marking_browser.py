"""Start `kcal mark` as a user does, and drive its page in Chromium."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from waiting import PATIENCE


class Server:
    """A running `kcal mark`, or another program with a page."""

    def __init__(self, arguments: list[str], port: int, folder: Path, program: str = "mark") -> None:
        command = [sys.executable, "-m", "kcal", program, *arguments, "--port", str(port), "--no-browser"]
        self.errors = (folder / "server.err").open("w+")
        self.process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=self.errors, text=True, env={**os.environ, "PYTHONUNBUFFERED": "1"}
        )
        self.address = self._address()

    def _address(self) -> str:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if found := re.search(r"http://127\.0\.0\.1:\d+/#\S+", line):
                return found.group()
        self.errors.seek(0)
        raise AssertionError(f"the server did not start: {self.errors.read()[-2000:]}")

    def kill(self) -> None:
        """As when the power fails."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def stop(self) -> None:
        """As with Ctrl+C."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
            self.process.wait(timeout=PATIENCE)


def settled(page: Any) -> None:
    """Wait until all actions are answered and the rig is solved."""
    page.wait_for_function(
        "() => window.kcal && kcal.actions.waiting.length === 0 && document.documentElement.dataset.pending === 'false'"
    )


def on_screen(page: Any, side: str, u: float, v: float) -> tuple[float, float]:
    """Where on the screen the view of one side shows an image position."""
    x, y = page.evaluate(
        "([side, u, v]) => { const view = kcal.views[side], box = view.canvas.getBoundingClientRect();"
        " const [x, y] = view.screen(u, v); return [box.left + x / view.ratio, box.top + y / view.ratio]; }",
        [side, float(u), float(v)],
    )
    return x, y


def click_at(page: Any, side: str, u: float, v: float) -> None:
    """Click where the view of one side shows an image position."""
    page.mouse.click(*on_screen(page, side, u, v))


def look_at(page: Any, side: str, u: float, v: float, scale: float = 6.0) -> None:
    """Show an image position in the middle of one side."""
    page.evaluate("([side, u, v, scale]) => kcal.views[side].look(u, v, scale)", [side, u, v, scale])


def choose(page: Any, name: str) -> None:
    """Select a thing in the list."""
    page.evaluate("name => kcal.select(name, false)", name)
