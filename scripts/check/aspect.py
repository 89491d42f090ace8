"""Is it said that pixels are not square, where they are and where they are not?

`--stretch 1.01`: rows longer or shorter by 1 %, in turn; 1 shows false alarms. Truth: traced lenses in turn and printed
boards, as in `scripts.check.captures_that_move`; 8 to 20 views, 0.05 to 0.2 px of noise; boards upright (within 2
degrees) in half of the captures, turned by up to 90 degrees in the others; a quarter of the captures by hand. A camera
is said to have pixels that are not square if a warning of its calibration contains "pixels are not square".
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import torch

from kcal import KcalError, calibrate_camera
from scripts.shared.page import table
from scripts.shared.sections import NOT_KEPT, Kept, Record, section
from scripts.shared.simulated import simulated

SAID = "pixels are not square"
VIEWS, NOISE, UPRIGHT, ROLLED = (8, 20), (0.05, 0.2), math.radians(2.0), math.radians(90.0)


def judged(stretch: float, seed: int) -> Record:
    """One capture: what it was, and what was said."""
    draw = torch.rand(2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed + 40_000)).tolist()
    views = VIEWS[0] + int(draw[0] * (VIEWS[1] - VIEWS[0] + 1))
    sigma = NOISE[0] * (NOISE[1] / NOISE[0]) ** draw[1]
    # Lenses and what is held go round with 3 and 6; 2 and 8 mix all with all.
    upright, by_hand = seed % 2 == 0, seed // 2 % 4 == 0
    factor = stretch if seed // 8 % 2 == 0 else 1.0 / stretch
    case = simulated(seed, views, sigma, by_hand, max_roll=UPRIGHT if upright else ROLLED, stretch=factor)
    record: Record = {"views": views, "sigma": sigma, "upright": upright, "hand": by_hand, "factor": factor}
    start = time.process_time()
    try:
        result = calibrate_camera(case.seen)
    except KcalError as refusal:
        return record | {"refused": str(refusal)}
    focal = result.camera.focal.tolist()
    said = [text for text in result.warnings if SAID in text]
    return record | {"said": said, "aspect": focal[1] / focal[0], "cpu_s": time.process_time() - start}


def lines(records: list[Record]) -> Iterator[str]:
    """A row for each stretch and kind of capture."""
    rows = []
    for stretch in sorted({record["key"][0] for record in records}):
        own = [record for record in records if record["key"][0] == stretch]
        kinds = {"by hand": [r for r in own if r["hand"]], "on a stand": [r for r in own if not r["hand"]]}
        for name, part in kinds.items():
            known = [record for record in part if "refused" not in record]
            said = [record for record in known if record["said"]]
            off = [abs(record["aspect"] / record["factor"] - 1.0) for record in said]
            rows.append(
                [
                    f"{stretch:g}", name, len(part), len(said),
                    f"{100 * len(said) / len(known):.1f} %" if known else "–", f"{max(off):.4f}" if off else "–",
                ]
            )  # fmt: skip
    head = ["stretch", "captures", "number", "said not to be square", "share", "largest error of f_y/f_x"]
    return table(head, rows)


@section("ordinary.md", "aspect", seeds=range(1))
def of_pixels(kept: Kept = NOT_KEPT, seeds: range = range(1000), stretch: float = 1.0) -> Iterator[str]:
    return lines(kept.records([(stretch, seed) for seed in seeds], judged))
