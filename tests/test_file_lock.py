"""One process at a time: who has a file is said, and what a process leaves behind locks nothing."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from kcal.errors import FileError
from kcal.files import FileLock, try_lock

OTHER = (
    "import sys\nfrom pathlib import Path\nfrom kcal.errors import FileError\nfrom kcal.files import FileLock\n"
    "try: lock = FileLock([Path(part) for part in sys.argv[1:]], 'the other')\n"
    "except FileError as error: print(error)\n"
    "else: print('locked')\n"
)


def other(*paths: Path) -> str:
    done = subprocess.run([sys.executable, "-c", OTHER, *map(str, paths)], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_another_process_is_told_who_has_it(tmp_path: Path) -> None:
    a, b, link = tmp_path / "a.csv", tmp_path / "b.csv", tmp_path / "link.csv"
    link.symlink_to(a)
    with FileLock([a, link, b], "the first"):
        assert sorted(os.listdir(tmp_path)) == [".a.csv.lock", ".b.csv.lock", "link.csv"]
        written = (tmp_path / ".a.csv.lock").read_text()
        assert written.startswith(f"the first, process {os.getpid()}, since 20")
        assert written.endswith("\n")
        said = other(b)
        assert said.startswith(f"{b}: the first, process {os.getpid()}, since 20")
        assert said.endswith("writes it; end that first, or choose another output")
        # What it got before it was refused it lets go.
        assert other(tmp_path / "c.csv", link).startswith(f"{a}: the first")
        assert not (tmp_path / ".c.csv.lock").exists()
    assert os.listdir(tmp_path) == ["link.csv"]
    assert other(a, b) == "locked"


def test_what_a_process_left_behind_locks_nothing(tmp_path: Path) -> None:
    left = tmp_path / ".a.csv.lock"
    left.write_text("a long text of a process that was killed long ago\n" * 9)
    with FileLock([tmp_path / "a.csv"], "x"):
        assert left.read_text().startswith("x, process ")
        assert left.read_text().count("\n") == 1


def test_a_lock_that_says_nothing(tmp_path: Path) -> None:
    path = tmp_path / ".a.csv.lock"
    handle = os.open(path, os.O_RDWR | os.O_CREAT)
    assert try_lock(handle)
    again = os.open(path, os.O_RDWR)
    assert not try_lock(again)
    with pytest.raises(FileError, match="another process writes it"):
        FileLock([tmp_path / "a.csv"], "x")
    os.close(handle)
    assert try_lock(again)
    os.close(again)


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"cannot lock it with .*\.a\.csv\.lock: No such file"):
        FileLock([tmp_path / "none" / "a.csv"], "x")
