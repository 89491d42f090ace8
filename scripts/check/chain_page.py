"""The tables of `scripts.check.chain`, and its table of docs/measured/chain.md."""

from __future__ import annotations

import itertools
import re
import statistics
from collections.abc import Sequence
from typing import Any

from scripts.shared.long_range import RANGES
from scripts.shared.page import table
from scripts.shared.timing import share

Records = Sequence[dict[str, Any]]


def pooled(records: Records, name: str, index: Sequence[int] = range(len(RANGES))) -> float:
    """Root of the mean over ranges of what a sum is for each target; all draws count by their targets."""
    means = []
    for i in index:
        count = sum(r["sums"]["count"][i] for r in records)
        means.append(sum(r["sums"][name][i] for r in records) / count)
    return statistics.fmean(means) ** 0.5


def inside(records: Records, i: int | None) -> str:
    """Coverage at a range or at all, percent, ± its standard error by draws of the cameras."""
    index = range(len(RANGES)) if i is None else [i]
    shares = [sum(r["sums"]["inside"][k] for k in index) / sum(r["sums"]["count"][k] for k in index) for r in records]
    return share(shares) if len(shares) > 1 else f"{100 * shares[0]:.1f}"


def tables(records: Records) -> list[str]:
    """Errors and coverage of all chains, and what failed."""
    rows: list[list[str]] = []
    chains = _values(records, "chain", sort=False)
    keys = [_values(records, key) for key in ("board", "pupil", "noise")]
    for board, pupil, noise in itertools.product(*keys):
        for chain in chains:
            wanted = (board, pupil, noise, chain)
            own = [r for r in records if (r["board"], r["pupil"], r["noise"], r["chain"]) == wanted]
            if own:
                corners = [f"{noise:g}"] if len(keys[2]) > 1 else []
                rows.append([board, f"{pupil:g}", *corners, chain, *_cells(own)])
    heads = [
        "board", "pupil, mm/rad²", *(["corners, px"] if len(keys[2]) > 1 else []), "chain", "lenses alone, m",
        "calibration, m", "total / bound", "in 95 %, %", "at each range, %", "without ray", "failed",
    ]  # fmt: skip
    draws = "Draws of lenses, boards and corners, by seed: " + ", ".join(map(str, _values(records, "draw"))) + "."
    return [*table(heads, rows), "", draws]


def _cells(records: Records) -> list[str]:
    """Of one chain: errors, coverage, targets without a ray, runs that failed."""
    good = [r for r in records if r["runs"]]
    runs, failed = sum(r["runs"] for r in records), sum(sum(r["failed"].values()) for r in records)
    if not good:
        return [*["–"] * 6, f"{failed} of {failed}"]
    alone = [value**2 for r in good for value in r["lenses_m"]]
    lost, counted = (sum(sum(r["sums"][name]) for r in good) for name in ("lost", "count"))
    by_range = [float(inside(good, i).split(" ")[0]) for i in range(len(RANGES))]
    return [
        f"{statistics.fmean(alone) ** 0.5:.0f}" if alone else "–",
        f"{pooled(good, 'meters', (len(RANGES) - 1,)):.0f}",
        f"{pooled(good, 'total'):.2f}",
        inside(good, None),
        f"{min(by_range):.1f} to {max(by_range):.1f}",
        f"{100 * lost / (lost + counted):.1f} %",
        f"{failed} of {runs + failed}",
    ]


def failures(records: Records) -> list[str]:
    """A table of the messages of runs that failed."""
    rows = []
    for chain in _values(records, "chain", sort=False):
        found: dict[str, int] = {}
        own = [r for r in records if r["chain"] == chain]
        for record in own:
            for message, count in record["failed"].items():
                kind = re.sub(r"\d[\d.e+-]*", "#", message)
                found[kind] = found.get(kind, 0) + count
        total = sum(r["runs"] for r in own) + sum(found.values())
        rows += [[chain, f"{count} of {total}", message[:200]] for message, count in found.items()]
    if not rows:
        return ["No run failed."]
    return [*table(["chain", "runs", "message"], rows)]


def _values(records: Records, key: str, *, sort: bool = True) -> list[Any]:
    """What a key has for values, in order or as they come."""
    found = dict.fromkeys(r[key] for r in records)
    return sorted(found) if sort else list(found)
