"""Ports of this machine that no other test takes meanwhile."""

import contextlib
import itertools
import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager


def free_port() -> int:
    """A port that nobody uses now, and that no system gives to those who ask for any."""
    # Other processes of this run begin elsewhere.
    for port in itertools.chain(range(20_000 + os.getpid() % 12_000, 32_000), range(20_000, 32_000)):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.bind(("127.0.0.1", port))
            return port
    raise AssertionError("no port is free")


@contextmanager
def deaf_port() -> Iterator[int]:
    """A port that refuses every connection."""
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        yield bound.getsockname()[1]
