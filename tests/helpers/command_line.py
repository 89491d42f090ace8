"""The command line, as a user types it; `command` of `tests/conftest.py` is one."""

import csv
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from unittest.mock import patch

import pytest
from typer.testing import CliRunner, Result


class Said(NamedTuple):
    """What a command printed."""

    out: str
    err: str


def ran(*words: object, **options: Any) -> Result:
    """How a command ended, with what it printed and its error."""
    from kcal.cli.main import app

    return CliRunner().invoke(app, [str(word) for word in words], **options)


def invoked(*words: object) -> str:
    """What a command prints that must end well; its error is raised."""
    done = ran(*words)
    if done.exception is not None and not isinstance(done.exception, SystemExit):
        raise done.exception
    assert done.exit_code == 0, done.output
    return done.output


class Command:
    """Runs `kcal` in the working folder. Blanks in a text separate words; a path is one word."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch, self._capsys = monkeypatch, capsys

    def __call__(self, *words: object, code: int = 0) -> Said:
        """What a command prints that must end with this exit code."""
        from kcal.cli.main import main

        given = [part for word in words for part in (word.split() if isinstance(word, str) else [str(word)])]
        self._monkeypatch.setattr(sys, "argv", ["kcal", *given])
        self._capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        said = Said(*self._capsys.readouterr())
        assert (ended.value.code or 0) == code, said
        return said

    def refuses(self, *words: object) -> str:
        """The one line that a command says which must fail. Nothing may appear or change in the working folder."""
        assert not Path("pyproject.toml").exists(), "give the test a folder of its own: every file in it is compared"
        before = contents()
        said = self(*words, code=1)
        assert said.err.startswith("error: "), said.err
        assert len(said.err.splitlines()) == 1, said.err
        assert "Traceback" not in said.out + said.err
        assert contents() == before
        return said.err


def contents() -> dict[Path, bytes]:
    """All files and folders below the working folder."""
    return {path: path.read_bytes() if path.is_file() else b"" for path in Path().rglob("*")}


def rows_of(path: str | Path) -> list[dict[str, str]]:
    """The lines of a CSV file."""
    with Path(path).open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def terminate() -> None:
    """As a service manager ends this process."""
    os.kill(os.getpid(), signal.SIGTERM)


@contextmanager
def at_moment(number: int, act: Callable[[], None] = terminate) -> Iterator[None]:
    """Do something right after `kcal live` has written so many moments."""
    from kcal.pipeline.stream import Stream

    write = Stream._write

    def written(self: Any, *what: Any) -> None:
        write(self, *what)
        if self.counts.moments == number:
            act()

    with patch.object(Stream, "_write", written):
        yield
