"""What docs/measured/paper.md says first: whether the aims are met, and what the error at 5 km is made of."""

from __future__ import annotations

import math
from collections.abc import Callable

from scripts.paper.locate import DRAWS
from scripts.paper.numbers import (
    ALIKE,
    MIXED,
    SHOWN,
    Results,
    below,
    calibration,
    everywhere,
    lens_share,
    median,
    middle,
    number,
    over_bound,
    relative,
    reprojection,
    rig_share,
)
from scripts.paper.site import MARK_SIGMA, SURVEY_SIGMA
from scripts.shared.page import table

FAR_M = 5003.0  # range of the farthest target
LIMIT = 0.01 * FAR_M
TIMES, OVER = 5.0, 1.25
LANDMARKS = 12


def aims(results: Results) -> list[str]:
    """The aims that were set, and whether the medians meet them."""
    every = {**results, "all": [run for runs in results.values() for run in runs]}

    def line(title: str, value: Callable[[dict], float], met: Callable[[float], bool], digits: int) -> list[str]:
        cells = []
        for runs in every.values():
            values = [value(run) for run in runs]
            cells.append(f"{middle(values, digits)}: {'**met**' if met(median(values)) else 'missed'}")
        return [title, *cells]

    def ratio(run: dict) -> float:
        return calibration(run, "OpenCV") / calibration(run, "hybrid")

    def share(run: dict) -> float:
        return 100 * calibration(run, "hybrid") / FAR_M

    rows = [
        line("hybrid: range error by calibration at 5 km ≤ 1 %", share, lambda v: v <= 1.0, 2),
        line("times below OpenCV's pipeline at 5 km, ≥ 5", ratio, lambda v: v >= TIMES, 1),
        line(
            "times below OpenCV's pipeline, RMS of seven points in %, ≥ 5",
            lambda run: relative(run, "OpenCV") / relative(run, "hybrid"),
            lambda v: v >= TIMES,
            1,
        ),
        line(
            "times below OpenCV's pipeline at 5 km all over the image, ≥ 5",
            lambda run: everywhere(run, "OpenCV") / everywhere(run, "hybrid"),
            lambda v: v >= TIMES,
            1,
        ),
        line(
            "the same, lenses alone (landmarks without noise), ≥ 5",
            lambda run: run["located"]["OpenCV"]["lens_far"] / run["located"]["hybrid"]["lens_far"],
            lambda v: v >= TIMES,
            1,
        ),
        line(
            "hybrid: total error at 5 km over the marks' bound ≤ 1.25",
            lambda run: over_bound(run, "hybrid"),
            lambda v: v <= OVER,
            2,
        ),
        [f"order of Fig. 9: hybrid ≤ 20 ≤ 14 (to {100 * ALIKE:g} %), draws", *(order(runs) for runs in every.values())],
    ]
    return [
        "## The aims",
        "",
        "Medians over the draws, with the smallest and the largest; the verdict is the median's.",
        "",
        *table(["", *every], rows),
        "",
        f"*By calibration*: RMS over {DRAWS} draws of the landmarks' survey and marks, because a single draw can be "
        "near zero at 5 km by luck. *All over the image*: at 5 km on a grid of everything that both cameras see, "
        "because a single direction can be lucky too.",
    ]


def order(runs: list[dict]) -> str:
    """In how many draws the largest reprojection error of the seven points is in the paper's order."""
    found = 0
    for run in runs:
        a, b, c = (max(reprojection(run, label)) for label in ("hybrid", "20", "14"))
        found += not below(b, a) and not below(c, b) and math.isfinite(c)
    return f"{found} of {len(runs)}"


def split(results: Results) -> list[str]:
    """What the error at 5 km is made of."""
    lines = [
        "## What the error at 5 km is made of",
        "",
        "![Range error at 5 km by source](paper-split.png)",
        "",
        f"Meters, one sigma or RMS, at the target at 5 km. *Lenses*: landmarks without noise. *Rig*: what the "
        f"{LANDMARKS} landmarks' noise ({100 * SURVEY_SIGMA:g} cm, {MARK_SIGMA:g} px) adds. *Calibration*: both. "
        f"*Marks*: the target's own marks ({MARK_SIGMA:g} px), with all else exact. *All over the image*: by "
        f"calibration, of points 5 km away on a grid. *{MIXED}*: the cameras of `cv2.calibrateCamera`, oriented by "
        "`solve_rig` and triangulated by kcal, so that nothing but corners and lens is OpenCV's. *Failed*: somewhere a "
        "lens has no ray for a pixel; kcal says so, where OpenCV returns a number.",
        "",
    ]
    for name, runs in results.items():
        rows = []
        for label in (*SHOWN, MIXED):
            parts: list[list[float]] = [
                [lens_share(run, label) for run in runs],
                [rig_share(run, label) for run in runs],
                [calibration(run, label) for run in runs],
                [run["bound"][-1] for run in runs],
                [run["located"][label]["total"][-1] for run in runs],
                [everywhere(run, label) for run in runs],
            ]
            lens, rig, both, marks, total, far = parts
            over = number(median(over_bound(run, label) for run in runs), 2)
            cells = [middle(lens, 0), number(median(rig), 0), middle(both, 0), number(median(marks), 0)]
            rows.append([label, *cells, middle(total, 0), over, middle(far, 0)])
        heads = [name, "lenses", "rig", "calibration", "marks", "total", "total / marks", "all over the image"]
        lines += [*table(heads, rows), "", _limits(name, runs), "", _pipeline(name, runs), ""]
    return lines[:-1]


def _limits(name: str, runs: list[dict]) -> str:
    """What the first aim would need: which landmarks, or which lens."""
    lens, rig, both, theirs = (
        median(value(run, label) for run in runs)
        for value, label in (
            (lens_share, "hybrid"),
            (rig_share, "hybrid"),
            (calibration, "hybrid"),
            (calibration, "OpenCV"),
        )
    )
    if not math.isfinite(both + theirs):
        return f"*{name}*: half of the draws or more have no rig."
    larger = "its lenses" if lens > rig else "the landmarks' noise"
    text = (
        f"*{name}*: the larger part of the hybrid's {both:.0f} m is {larger} ({lens:.0f} m of lenses, {rig:.0f} m of "
        "rig). "
    )
    if lens >= LIMIT:
        text += f"More landmarks cannot bring it to {LIMIT:.0f} m: that takes better corners or more views. "
    else:
        # Independent landmarks as good as these, spread likewise.
        needed = math.ceil(LANDMARKS * rig**2 / (LIMIT**2 - lens**2))
        word = "are enough" if needed <= LANDMARKS else "would be needed"
        text += f"For {LIMIT:.0f} m, {needed} landmarks like these {word}, as noise averages. "
    return text + (
        f"With these {LANDMARKS} landmarks even perfect lenses would be only {theirs / rig:.1f} times below the "
        f"{theirs:.0f} m of OpenCV's pipeline at this target."
    )


def _pipeline(name: str, runs: list[dict]) -> str:
    """Step by step from OpenCV's pipeline to kcal's default."""
    both, mixed, own = (median(everywhere(run, label) for run in runs) for label in ("OpenCV", MIXED, "14"))
    default = median(everywhere(run, "hybrid") for run in runs)
    lost = "some points have no place in half of the draws"
    parts = [
        f"{title}: {number(value, 0)} m" if math.isfinite(value) else f"{title}: {lost}"
        for title, value in (
            ("OpenCV's pipeline", both),
            ("its cameras in kcal's rig", mixed),
            ("kcal's cameras of as many coefficients", own),
            ("kcal's default", default),
        )
    ]
    return f"*{name}*, all over the image: {'; '.join(parts)}."
