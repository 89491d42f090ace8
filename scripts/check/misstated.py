"""Rigs from landmarks whose marks are worse than stated, beside many good matches and a tape, repeated by simulation.

    python -m scripts.check.misstated [--draws 40] [--write]

Twelve surveyed landmarks are marked with some times the error that is stated; 300 matches of unknown range and a tape
of ± 5 mm are as stated. In the last rows the tape is wrong instead, which must be named whatever the marks are. Seeds
are fixed. With --write the table of docs/measured/rig.md is made.
"""

from __future__ import annotations

import argparse
import dataclasses
import math

import torch

from kcal import Baseline, Features, InputError, RigData, solve_rig
from kcal.calibrate.rig.result import RigResult
from kcal.lens import vector_from_rotation
from scripts.check.rig import (
    BASELINE,
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
)
from scripts.shared.page import table, tell

MATCHES, TAPE = 300, 0.005


def data(times: float, tape: float, seed: int) -> RigData:
    """The sources of one rig: marks worse by a factor, a tape that is wrong by another."""
    draw = generator(seed)
    marked = landmarks(draw)
    points = spread(MATCHES, 300.0, 8000.0, draw)
    matches = Features(
        names=tuple(map(str, range(MATCHES))),
        pixels=seen(points) + MARK * normal((MATCHES, 2, 2), draw),
        inverse_range=torch.zeros(MATCHES, dtype=torch.float64),
        inverse_range_sigma=torch.full((MATCHES,), math.inf, dtype=torch.float64),
        pixel_sigma=MARK,
    )
    length = BASELINE * tape + TAPE * float(normal((1,), draw))
    worse = marked.pixels + math.sqrt(times**2 - 1.0) * MARK * normal((len(marked.names), 2, 2), draw)
    return RigData(
        cameras=(TRUTH.left, TRUTH.right),
        names=NAMES,
        landmarks=dataclasses.replace(marked, pixels=worse),
        features=matches,
        baselines=(Baseline(first=0, second=1, length=length, sigma=TAPE),),
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
    rms, factor = float(each.square().mean().sqrt()), math.sqrt(sum(t * t for t in told) / len(told))
    return [*what, str(draws), str(refused), str(blamed), f"{factor:.2f}", f"{rms:.2f}", f"{inside:.0f} %"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--write", action="store_true", help="write the table of docs/measured/rig.md")
    options = parser.parse_args()
    heads = [
        "marks worse than stated, times", "tape", "rigs", "refused", "the tape blamed", "the landmarks' residuals / σ",
        "error of attitude / σ", "inside 95 %",
    ]  # fmt: skip
    cases = [(1.0, 1.0), (2.0, 1.0), (3.0, 1.0), (5.0, 1.0), (1.0, 1.02), (3.0, 1.02), (3.0, 1.1)]
    rows = [judged(times, tape, options.draws) for times, tape in cases]
    tell("rig.md", "misstated", table(heads, rows), write=options.write)


if __name__ == "__main__":
    main()
