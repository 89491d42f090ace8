"""What docs/measured/paper.md shows first: what the error at 5 km is made of."""

from __future__ import annotations

import math

from scripts.paper.numbers import (
    MIXED,
    SHOWN,
    Results,
    calibration,
    everywhere,
    lens_share,
    median,
    middle,
    number,
    over_bound,
    rig_share,
)
from scripts.shared.page import table

FAR_M = 5003.0  # range of the farthest target
LIMIT = 0.01 * FAR_M
LANDMARKS = 12


def split(results: Results) -> list[str]:
    """What the error at 5 km is made of."""
    rows, limits = [], []
    for name, runs in results.items():
        for label in (*SHOWN, MIXED):
            parts: list[list[float]] = [
                [lens_share(run, label) for run in runs],
                [rig_share(run, label) for run in runs],
                [calibration(run, label) for run in runs],
                [run["bound"][-1] for run in runs],
                [everywhere(run, label) for run in runs],
            ]
            lens, rig, both, marks, far = parts
            over = number(median(over_bound(run, label) for run in runs), 2)
            cells = [number(median(lens), 0), number(median(rig), 0), middle(both, 0), number(median(marks), 0)]
            rows.append([name, label, *cells, over, middle(far, 0)])
        limits += ["", _limits(name, runs)]
    heads = ["camera", "model", "lenses", "rig", "calibration", "marks", "total / marks", "all over the image"]
    return [*table(heads, rows), *limits]


def _limits(name: str, runs: list[dict]) -> str:
    """What an error of 1 % would need: which landmarks, or which lens."""
    lens, rig, both = (median(value(run, "hybrid") for run in runs) for value in (lens_share, rig_share, calibration))
    if not math.isfinite(both):
        return f"*{name}*: half of the draws or more have no rig."
    larger = "its lenses" if lens > rig else "the landmarks' noise"
    text = (
        f"*{name}*: the larger part of the hybrid's {both:.0f} m is {larger} ({lens:.0f} m of lenses, {rig:.0f} m of "
        "rig). "
    )
    if lens >= LIMIT:
        text += f"More landmarks cannot bring it to {LIMIT:.0f} m: that takes better corners or more views."
    else:
        # Independent landmarks as good as these, spread likewise.
        needed = math.ceil(LANDMARKS * rig**2 / (LIMIT**2 - lens**2))
        word = "are enough" if needed <= LANDMARKS else "would be needed"
        text += f"For {LIMIT:.0f} m (1 %), {needed} landmarks like these {word}, as noise averages."
    return text
