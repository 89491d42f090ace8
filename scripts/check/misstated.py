"""Rigs from landmarks whose marks are worse than stated, beside many good matches and a tape, repeated by simulation.

Twelve surveyed landmarks are marked with some times the error that is stated; 300 matches of unknown range and a tape
of ± 5 mm are as stated. In the last rows the tape is wrong instead, which must be named whatever the marks are. Seeds
are fixed.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator

import torch

from kcal import InputError, RigData, solve_rig
from kcal.calibrate.rig.result import RigResult
from kcal.lens import vector_from_rotation
from scripts.check.rig import (
    MARK,
    NAMES,
    ROTATION,
    STRAIGHT,
    TRUTH,
    generator,
    landmarks,
    normal,
    seen,
    spread,
    tape,
)
from scripts.shared.long_range import matches_of
from scripts.shared.page import table
from scripts.shared.sections import section
from scripts.shared.timing import rms

MATCHES = 300


def data(times: float, length: float, seed: int) -> RigData:
    """The sources of one rig: marks worse by a factor, a tape that is wrong by another."""
    draw = generator(seed)
    marked = landmarks(draw)
    points = spread(MATCHES, 300.0, 8000.0, draw)
    matches = matches_of(seen(points) + MARK * normal((MATCHES, 2, 2), draw), pixel_sigma=MARK)
    measured = tape(draw, length)
    worse = marked.pixels + math.sqrt(times**2 - 1.0) * MARK * normal((len(marked.names), 2, 2), draw)
    return RigData(
        cameras=(TRUTH.left, TRUTH.right),
        names=NAMES,
        landmarks=dataclasses.replace(marked, pixels=worse),
        features=matches,
        baselines=(measured,),
    )


def errors(found: RigResult) -> torch.Tensor:
    """(3,) errors of the left camera's attitude on the Earth in standard deviations."""
    error = vector_from_rotation(found.rotation[0] @ ROTATION[0].T)
    return error / found._solution.variances(found._solution.turn_rows(0)).sqrt()


@torch.no_grad()
def judged(times: float, tape: float, draws: int) -> list[str]:
    """One row."""
    off, told, refused, blamed = [], [], 0, 0
    for seed in range(draws):
        try:
            found = solve_rig(data(times, tape, 70_000 + seed), STRAIGHT)
        except InputError as error:
            refused += 1
            blamed += "baseline" in str(error)
            continue
        blamed += any("the baseline" in text and "contradicts" in text for text in found.warnings)
        off.append(errors(found))
        told.append(next(one.sigmas or math.nan for one in found.sources if one.name == "landmarks"))
    what = [f"{times:g}", "right" if tape == 1.0 else f"wrong by {100 * (tape - 1.0):.0f} %"]
    if not off:
        return [*what, str(draws), str(refused), str(blamed), "–", "–", "–"]
    each = torch.stack(off)
    inside = 100 * float((each.abs() < 1.96).double().mean())
    off_by, factor = rms(each), rms(told)
    return [*what, str(draws), str(refused), str(blamed), f"{factor:.2f}", f"{off_by:.2f}", f"{inside:.0f} %"]


@section("rig.md", "misstated", draws=1)
def misstated(draws: int = 40) -> Iterator[str]:
    heads = [
        "marks worse than stated, times", "tape", "rigs", "refused", "the tape blamed", "the landmarks' residuals / σ",
        "error of attitude / σ", "inside 95 %",
    ]  # fmt: skip
    cases = [(1.0, 1.0), (2.0, 1.0), (3.0, 1.0), (5.0, 1.0), (1.0, 1.02), (3.0, 1.02), (3.0, 1.1)]
    return table(heads, (judged(times, tape, draws) for times, tape in cases))
