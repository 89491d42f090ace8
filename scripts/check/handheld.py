"""The default camera on simulated captures by hand and on a stand: do its error bars contain the truth?

    python -m scripts.check.handheld --out FILE --seeds 0-99                    # 8 views
    python -m scripts.check.handheld --out FILE --seeds 0-199 --views 3 4 5 6   # few views
    python -m scripts.check.handheld --out FILE --seeds 0-99 --fit still        # without the terms for motion
    python -m scripts.check.handheld --out FILE --seeds 0-99 --kinds bent "few bent" "bent, hand"   # boards that flex
    python -m scripts.check.handheld --out FILE [OTHER ...] --write             # the tables in docs/measured

Captures that FILE has are not made again, so that a run can be interrupted, and split over several files.

Truth: three traced lenses in turn, decentered, whose entrance pupils move; printed boards (7 x 6 corners, 5 cm), noise
of 0.08 px. By hand (`scripts.shared.moving_captures`): the camera or the board is held, in turn; a rolling shutter with
a readout of 10 to 30 ms; rates of 0.1 to 1 rad/s and 0.05 to 0.3 m/s (standard deviation along each axis, drawn for
each capture), half of their variance tremor of 2 to 10 Hz; exposures of 5 to 20 ms, pictures with more than 12 px of
blur taken again; noise grows along the blur, as the views' covariances say. Measure: as in
`scripts.bench.traced_lenses`, where the camera sees infinitely distant points, all over the image, after the best
turn.
"""

from __future__ import annotations

import argparse
import itertools
import math
import statistics
import time
from pathlib import Path

import torch

from scripts.shared.page import table, write_section
from scripts.shared.records import Record, finish, read, seeds
from scripts.shared.simulated import against_truth, default_options, simulated
from scripts.shared.timing import show

PAGE = "ordinary.md"
SIGMA = 0.08
TERMS = ("motion", "bending")
# Whether the capture is by hand, and by how many meters the board bends in what share of the views.
KINDS = {
    "hand": (True, 0.0, 1.0),
    "stand": (False, 0.0, 1.0),
    "bent": (False, 1e-3, 1.0),
    "few bent": (False, 3e-3, 0.2),
    "bent, hand": (True, 1e-3, 1.0),
}
FITS = {"default": {}, "still": {"motion": False}, "stiff": {"bending": False}}


def captured(kind: str, views: int, seed: int, fit: str) -> Record:
    """One capture and its calibration."""
    by_hand, bent, share = KINDS[kind]
    case = simulated(seed, views, SIGMA, by_hand, bent=bent, share=share)
    start = time.process_time()
    found = against_truth(case, default_options(**FITS[fit]))
    spent = time.process_time() - start
    moved = {name: getattr(case.truth, name) for name in ("readout", "exposure", "turning", "speed")}
    return found | moved | {"cpu_s": spent, "blur": float(case.truth.blur.norm(dim=-1).square().nanmean().sqrt())}


def line(record: Record) -> str:
    """One line to print."""
    if "refused" in record:
        return f"refused: {record['refused'][:90]}"
    return (
        f"error {record['rms']:.3f} px, stated {record['predicted']:.3f}, {100 * record['everywhere']:.0f} % in the "
        f"ellipses, {record['terms']}, {record['cpu_s']:.1f} s"
    )


def share(records: list[Record], key: str) -> str:
    """Mean of a share in percent, with its standard error; captures count alike, for the places of one go together."""
    values = [100.0 * record[key] for record in records if math.isfinite(record[key])]
    if len(values) < 2:
        return "–"
    return f"{statistics.fmean(values):.1f} ± {statistics.stdev(values) / math.sqrt(len(values)):.1f}"


def rms(values: list[float]) -> float:
    return math.sqrt(statistics.fmean(value**2 for value in values))


def lines(records: list[Record]) -> list[str]:
    """One row for each number of views, kind and fit."""
    cells: dict[tuple[int, str, str], list[Record]] = {}
    for record in records:
        kind, views, _, fit = record["key"]
        cells.setdefault((views, kind, fit), []).append(record)
    rows = []
    for (views, kind, fit), own in sorted(cells.items()):
        known = [record for record in own if "refused" not in record]
        refused = f"{100 * (1 - len(known) / len(own)):.1f} %"
        if not known:
            rows.append([views, kind, fit, len(own), refused, *["–"] * 6])
            continue
        true, stated = [r["rms"] for r in known], [r["predicted"] for r in known]
        rows.append(
            [
                views, kind, fit, len(own), refused, share(known, "everywhere"),
                f"{statistics.median(true):.3f}", f"{rms(true):.3f}", f"{rms(stated):.3f}",
                *(f"{100 * statistics.fmean(term in r.get('terms', ()) for r in known):.0f} %" for term in TERMS),
            ]
        )  # fmt: skip
    head = [
        "views", "held by", "fit", "captures", "refused", "in 95 %, whole image", "median error, px",
        "RMS error", "RMS stated", "motion found", "bending found",
    ]  # fmt: skip
    return table(head, rows)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", nargs="+", type=Path, required=True, help="JSON lines; the first is written to")
    parser.add_argument("--seeds", type=seeds, help="for example 0-99")
    parser.add_argument("--views", nargs="+", type=int, default=[8])
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=["hand", "stand"])
    parser.add_argument("--fit", choices=FITS, default="default", help="still: no motion; stiff: no bending")
    parser.add_argument("--write", action="store_true", help="write the tables into the page")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    if arguments.seeds is not None:
        default_options(**FITS[arguments.fit])
        keys = [
            (k, n, s, arguments.fit) for s, n, k in itertools.product(arguments.seeds, arguments.views, arguments.kinds)
        ]
        finish(arguments.out[0], keys, captured, line)
    records = read(arguments.out)
    for section, bent in (("handheld", False), ("bent", True)):
        own = [record for record in records if (KINDS[record["key"][0]][1] > 0.0) is bent]
        text = show(lines(own)) if own else []
        if arguments.write and own:
            write_section(PAGE, section, text)


if __name__ == "__main__":
    main()
