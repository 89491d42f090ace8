"""What processes of their own answer; and children that start at once, as copies of a server without threads.

The server has imported what takes long. A process with threads (torch, OpenCV, videos) must not fork: its child would
wait forever for threads and locks that it does not have. The server of `multiprocessing` is a fresh interpreter, and
libraries are held to one thread there.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from pathlib import Path
from typing import Any
from unittest import mock

from scripts.shared.page import children_seconds

ALONE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
# Interpreters of other programs that were asked for; a page's comment tells what they have.
ASKED: dict[str, str] = {}


def interpreter(peer: str) -> str:
    """The Python that has another program, by the variable KCAL_ and the program's name in capitals; else nothing."""
    if python := os.environ.get(f"KCAL_{peer.upper()}", ""):
        ASKED[peer] = python
    return python


def answered(*command: object, timeout: float | None = None) -> dict[str, Any]:
    """The last line that a process with one thread prints, which is JSON.

    Raises:
        subprocess.SubprocessError: it failed, or took longer.
    """
    words, alone = list(map(str, command)), os.environ | ALONE
    done = subprocess.run(words, capture_output=True, text=True, timeout=timeout, check=True, env=alone)
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def or_failure(work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """What work gives that asks processes; or {"failed": why}."""
    try:
        return work()
    except subprocess.TimeoutExpired as error:
        return {"failed": f"> {error.timeout:.0f} s"}
    except subprocess.CalledProcessError as error:
        return {"failed": (error.stderr.strip().splitlines() or ["killed"])[-1][:60]}


def answer(*command: object, timeout: float | None = None) -> dict[str, Any]:
    """The same as `answered`; or {"failed": why}."""
    return or_failure(lambda: answered(*command, timeout=timeout))


def timed_process(*command: object, **options: Any) -> tuple[subprocess.CompletedProcess[str], float]:
    """A process that has ended, and CPU seconds, those of what it started included."""
    before = children_seconds()
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, **options)
    return done, children_seconds() - before


@contextlib.contextmanager
def marking_server(folder: Path, *words: str, **options: Any) -> Iterator[tuple[str, int]]:
    """`kcal mark` of left.png and right.png in a folder: the address of its page, and the number of its process."""
    command = [sys.executable, "-m", "kcal", "mark", "left.png", "right.png", *words, "--port", "0", "--no-browser"]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder, **options)
    try:
        assert server.stdout is not None
        yield server.stdout.readline().split()[-1], server.pid
    finally:
        server.kill()
        server.wait()


def children(*imported: str) -> ForkServerContext:
    """Start children here; the first call of a process decides which modules these have imported already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(imported or ("scripts.fuzz.harnesses", "pytest")))
    with mock.patch.dict(os.environ, ALONE | {"PYTHONPATH": os.pathsep.join(sys.path)}):
        forkserver.ensure_running()
    return context
