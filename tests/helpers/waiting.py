"""Wait for what happens in another thread, process or browser; a deadline only ends a test that has failed."""

from __future__ import annotations

import time
from collections.abc import Callable

PATIENCE = 300.0  # seconds: the slowest machine is faster


def wait_for(true: Callable[[], bool], pause: Callable[[float], object] = time.sleep) -> None:
    """Wait until something is true.

    Args:
        true: looked at again and again.
        pause: what is done for some seconds between two looks.
    """
    until = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < until, "waited in vain"
        pause(0.02)
