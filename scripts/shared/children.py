"""Child processes that start at once: copies of a server that has imported what takes long, and that has no thread.

A process with threads (torch, OpenCV, videos) must not fork: its child would wait forever for threads and locks that it
does not have. The server of `multiprocessing` is a fresh interpreter, and libraries are held to one thread there.
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext
from unittest import mock


def children(*imported: str) -> ForkServerContext:
    """Start children here; the first call of a process decides which modules these have imported already."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(list(imported or ("scripts.fuzz.harnesses", "pytest")))
    alone = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    with mock.patch.dict(os.environ, alone):
        forkserver.ensure_running()
    return context
