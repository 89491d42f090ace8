"""What processes of their own answer; and children that start at once, as copies of a server without threads.

The server has imported what takes long. A process with threads (torch, OpenCV, videos) must not fork: its child would
wait forever for threads and locks that it does not have. The server of `multiprocessing` is a fresh interpreter, and
libraries are held to one thread there.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Callable
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from typing import Any
from unittest import mock

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


def children(*imported: str) -> ForkServerContext:
    """Start children here; the first call of a process decides which modules these have imported already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(imported or ("scripts.fuzz.harnesses", "pytest")))
    with mock.patch.dict(os.environ, ALONE | {"PYTHONPATH": os.pathsep.join(sys.path)}):
        forkserver.ensure_running()
    return context
