"""The tables of `scripts.check.chain`, and its page."""

from __future__ import annotations

import re
import statistics
from collections.abc import Sequence
from typing import Any

from scripts.shared.long_range import RANGES
from scripts.shared.page import CONCLUSIONS, DOCS, table

PAGE = "chain.md"
Records = Sequence[dict[str, Any]]
HEAD = """# The whole chain, measured

{conclusion}

Made by `scripts/check/chain.py`, which says what is simulated: two ray-traced lenses 10 m apart, calibrated one by one
from 60 views of a board at 0.55 to 1.3 m, a rig solved from 12 landmarks at 40 to 400 m (2 cm, 0.07 px), and targets
all over the common image at 100 m to 5 km, marked to 0.1 px. *Held*: the rig takes the cameras as exact. *Prior*: it
takes what their calibrations know, and refines them. *cv8*, *cv14*: `cv2.calibrateCamera` with 8 and 14 coefficients;
*cvRO*: `cv2.calibrateCameraRO` with 8. Their rig is kcal's with cameras held, because OpenCV has none from landmarks
with errors of a survey. *true*: the lenses themselves.

The *bound* is the standard deviation of the range that noise in the marks leaves when everything else is exact. All
errors are those of the inverse range, which is Gaussian at any range; meters are such errors times the squared range.
"""


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
    if len(shares) == 1:
        return f"{100 * shares[0]:.1f}"
    return f"{100 * statistics.fmean(shares):.1f} ± {100 * statistics.stdev(shares) / len(shares) ** 0.5:.1f}"


def tables(records: Records) -> list[str]:
    """All tables: errors, coverage, failures."""
    lines = ["Draws of lenses, boards and corners, by seed: " + ", ".join(map(str, _values(records, "draw"))) + ".", ""]
    chains = _values(records, "chain", sort=False)
    for board in _values(records, "board"):
        for noise in _values(records, "noise"):
            part = [r for r in records if r["board"] == board and r["noise"] == noise]
            if part:
                lines += [f"## {board.capitalize()} boards, corners of {noise:g} px", "", *_errors(part, chains)]
    return [*lines, *_failures(records, chains)]


def _errors(records: Records, chains: Sequence[str]) -> list[str]:
    lines = []
    for pupil in _values(records, "pupil"):
        rows, coverage = [], []
        for chain in chains:
            own = [r for r in records if r["pupil"] == pupil and r["chain"] == chain]
            good = [r for r in own if r["runs"]]
            if not own:
                continue
            runs = sum(r["runs"] for r in own)
            failed = sum(sum(r["failed"].values()) for r in own)
            if not good:
                rows.append([chain, *["–"] * 7, f"{failed} of {failed}"])
                continue
            alone = [value**2 for r in good for value in r["lenses_m"]]
            far = (len(RANGES) - 1,)
            lost, counted = (sum(sum(r["sums"][name]) for r in good) for name in ("lost", "count"))
            share, total, expected = (pooled(good, name) for name in ("share", "total", "expected"))
            rows.append(
                [
                    chain,
                    f"{statistics.fmean(alone) ** 0.5:.0f}" if alone else "–",
                    f"{pooled(good, 'meters', far):.0f}",
                    f"{share:.2f}",
                    f"{total:.2f}",
                    f"{expected:.2f}",
                    f"{pooled(good, 'total', far):.2f}",
                    f"{100 * lost / (lost + counted):.1f} %",
                    f"{failed} of {runs + failed}",
                ]
            )
            coverage.append([chain, *(inside(good, i) for i in range(len(RANGES))), inside(good, None), runs])
        heads = [
            "chain", "lenses alone, m", "calibration, m", "share / bound", "total / bound", "expected / bound",
            "total / bound at 5 km", "without ray", "failed",
        ]  # fmt: skip
        lines += [
            f"Pupil {pupil:g} mm/rad². Range error at 5 km, RMS over the common image, of lenses alone (landmarks "
            "without noise) and of calibration (with it); RMS over all seven ranges of calibration's share, of the "
            "total error, and of the error that the localizer expects, over the bound. *Without ray*: targets at which "
            "a lens model folds, left out of all else. *Failed*: rigs that ended with an error.",
            "",
            *table(heads, rows),
            "",
            "True range inside the 95 % interval, percent ± one standard error over draws of the cameras:",
            "",
            *table(["chain", *(f"{r:g} m" for r in RANGES), "all", "runs"], coverage),
            "",
        ]
    return lines


def _failures(records: Records, chains: Sequence[str]) -> list[str]:
    rows = []
    for chain in chains:
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
    return ["## Failed runs", "", *table(["chain", "runs", "message"], rows)]


def conclude(records: Records) -> None:
    """Write the page."""
    text = HEAD.format(conclusion=CONCLUSIONS[PAGE])
    (DOCS / PAGE).write_text("\n".join([text, *tables(records)]).rstrip() + "\n", encoding="utf-8")


def _values(records: Records, key: str, *, sort: bool = True) -> list[Any]:
    """What a key has for values, in order or as they come."""
    found = dict.fromkeys(r[key] for r in records)
    return sorted(found) if sort else list(found)
