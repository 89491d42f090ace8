"""What benchmarks and checks share: calls timed in turn, so that ratios are taken within a round; statistics."""

from __future__ import annotations

import math
import resource
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

# A call faster than this is repeated within a round until it takes as long.
SHORTEST_S = 0.003


def times(
    calls: Sequence[Callable[[], object]], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> list[list[float]]:
    """Seconds of each call in each round; some runs of each first, not counted, settle how often it is repeated."""
    repeats = []
    for call in calls:
        call()
        start = clock()
        call()
        repeats.append(max(1, math.ceil(SHORTEST_S / max(clock() - start, 1e-7))))
    found: list[list[float]] = [[] for _ in calls]
    for _ in range(rounds):
        for which, call in enumerate(calls):
            start = clock()
            for _ in range(repeats[which]):
                call()
            found[which].append((clock() - start) / repeats[which])
    return found


def spread(values: Sequence[float], digits: int = 1) -> str:
    """`median (smallest to largest)`."""
    return f"{statistics.median(values):.{digits}f} ({min(values):.{digits}f} to {max(values):.{digits}f})"


def median(values: Sequence[float], digits: int = 1) -> str:
    return f"{statistics.median(values):.{digits}f}"


def ratio(own: Sequence[float], other: Sequence[float], digits: int = 2) -> str:
    """Median of one's own time over the other's, round by round: below 1, one's own is faster."""
    return median([a / b for a, b in zip(own, other, strict=True)], digits)


def row(*cells: object) -> str:
    """A row of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |"


def show(lines: list[str]) -> list[str]:
    """Print lines and return them."""
    print("\n".join(lines), flush=True)
    return lines


def rms(values: Any) -> float:
    """Root mean square of numbers, an array or a tensor."""
    return float(np.sqrt(np.square(np.asarray(values, dtype=float)).mean()))


def share(values: Iterable[float], unit: str = "") -> str:
    """Mean of shares in percent, with its standard error if draws are independent; NaN is left out."""
    known = [100.0 * value for value in values if math.isfinite(value)]
    if len(known) < 2:
        return "–"
    return f"{statistics.fmean(known):.1f} ± {statistics.stdev(known) / math.sqrt(len(known)):.1f}{unit}"


def children_seconds() -> float:
    """Processor time of the processes that this one has started and that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
