"""The page of `kcal capture`: its address is told on one line and opened, and a capture without a board is an error."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import ClassVar

import pytest
from typer.testing import CliRunner, Result

from kcal.cli.main import app

ADDRESS = "http://127.0.0.1:8348/#" + 60 * "t"


class Server:
    """In place of the one that answers browsers: it runs until it is told to stop."""

    made: ClassVar[list[tuple[int, bool]]] = []

    def __init__(self, make_app: Callable[..., object], port: int, *, fallback: bool) -> None:
        self.address, self._stopped = ADDRESS, threading.Event()
        self.made.append((port, fallback))

    def run(self) -> None:
        self._stopped.wait()

    def stop(self) -> None:
        self._stopped.set()


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Addresses that were opened, of captures whose source shows nothing."""
    found: list[str] = []

    def nothing(*_: object) -> Iterator[None]:
        return iter(())

    monkeypatch.setattr("kcal.capture.session.shots", nothing)
    monkeypatch.setattr("kcal.web.serving.LocalServer", Server)
    monkeypatch.setattr("webbrowser.open", found.append)
    monkeypatch.setattr("time.sleep", lambda seconds: None)
    monkeypatch.setattr(Server, "made", [])
    return found


def capture(folder: Path, *options: str) -> Result:
    words = ["capture", "camera:0", "--board", "9x6", "--square", "25mm", "-o", str(folder / "left.obs.json"), *options]
    return CliRunner().invoke(app, words, env={"COLUMNS": "40"})


def test_the_address_is_on_one_line_and_opened(tmp_path: Path, opened: list[str]) -> None:
    """A wrapped one cannot be clicked; the usual port may be taken, and a port that was asked for may not."""
    done = capture(tmp_path)
    assert f"capture page: {ADDRESS}\n" in done.output
    assert opened == [ADDRESS]
    assert done.exit_code != 0
    assert "no frame showed the board" in str(done.exception)
    capture(tmp_path, "--no-browser", "--port", "9000")
    assert opened == [ADDRESS]
    assert Server.made == [(8348, True), (9000, False)]


def test_no_page(tmp_path: Path, opened: list[str]) -> None:
    done = capture(tmp_path, "--no-page")
    assert "capture page" not in done.output
    assert opened == []
    assert Server.made == []


def test_an_interruption_before_all_has_started(
    tmp_path: Path, opened: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What has started ends: a thread that was left behind would keep the command alive."""
    start, begun, ended, given_up = threading.Thread.start, [], threading.Event(), threading.Event()

    def endless(source: str, stopped: Callable[[], bool], tell: object) -> Iterator[None]:
        while not (stopped() or given_up.wait(0.01)):
            pass
        ended.set()
        return iter(())

    def interrupted(thread: threading.Thread) -> None:
        begun.append(thread)
        if len(begun) == 2:
            raise KeyboardInterrupt
        start(thread)

    monkeypatch.setattr("kcal.capture.session.shots", endless)
    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", interrupted)
        done = capture(tmp_path, "--no-page")
    try:
        assert done.exit_code == 130
        assert ended.is_set()
    finally:
        given_up.set()
