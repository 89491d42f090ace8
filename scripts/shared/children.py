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
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from typing import Any
from unittest import mock

ALONE = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def answer(*command: object, timeout: float | None = None) -> dict[str, Any]:
    """The last line that a process with one thread prints, which is JSON; or {"failed": why}."""
    words, alone = list(map(str, command)), os.environ | ALONE
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=timeout, check=True, env=alone)
    except subprocess.TimeoutExpired:
        return {"failed": f"> {timeout:.0f} s"}
    except subprocess.CalledProcessError as error:
        return {"failed": (error.stderr.strip().splitlines() or ["killed"])[-1][:60]}
    found: dict[str, Any] = json.loads(done.stdout.strip().splitlines()[-1])
    return found


def children(*imported: str) -> ForkServerContext:
    """Start children here; the first call of a process decides which modules these have imported already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(imported or ("scripts.fuzz.harnesses", "pytest")))
    with mock.patch.dict(os.environ, ALONE | {"PYTHONPATH": os.pathsep.join(sys.path)}):
        forkserver.ensure_running()
    return context
