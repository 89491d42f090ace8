"""The whole chain, simulated: corners, cameras, a rig from landmarks, and ranges of targets up to 5 km.

Truth: two ray-traced surveillance lenses (`kcal.sim.raytrace`), f 1600 px, 1920 x 1080, each with errors of
assembly of its own, 10 m apart and nearly parallel. Their entrance pupils move by 0, 1 or 3 mm/rad²: with a focal
length of 6.163 mm the prescription itself has 3, and for less its movement is
scaled down, off-axis parts included (`wander` of `TruthLens`).

Cameras: each calibrated by itself from 60 views of one board of 6 x 7 corners, 5 cm apart, at 0.55 to 1.3 m, with
Gaussian noise of the corners. Boards are exact, or printed (`scripts.shared.traced.printed`: stretch 0.15 %, shear
0.02 %, bent along an oblique axis by 0.7 mm, smooth errors of 0.03 mm); each draw has its own board, which both cameras
see.

Rig: 12 landmarks 40 to 400 m away, surveyed to 2 cm along each axis, marked to 0.07 px, at other places in each draw.
Targets: 45 directions all over the image at 7 ranges, where both cameras see them, marked to 0.1 px.

Chains: kcal's camera (`default`) or kcal's parametric models, held as exact in the rig or with their calibrations as
priors; OpenCV's (`cv8`, `cv14`: cv2.calibrateCamera with 8 and 14 coefficients; `cvRO`: cv2.calibrateCameraRO with 8),
whose rig is solved by kcal too, with the cameras held, because OpenCV has no adjustment of landmarks with errors of a
survey; and the true lenses (`true`).

Seeds below 100 are for tuning.
"""

from __future__ import annotations

import functools
import itertools
import re
import statistics
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import torch

from kcal import Camera, KcalError, Observations
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.sim.captures import TrueRig
from scripts.check.chain_rig import How, judge, targets, true_rig
from scripts.shared.long_range import RANGES
from scripts.shared.page import Line, table
from scripts.shared.peer_lenses import opencv
from scripts.shared.sections import NOT_KEPT, Kept, Record, section
from scripts.shared.timing import share, show
from scripts.shared.traced import BOARD, as_camera, capture, printed

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


def tables(records: Records) -> list[Line]:
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
    return [heads, *rows, draws]


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


VIEWS = 60
# Shares of the image that put a board of 5 cm squares at 1.3 to 0.55 m before a lens of f 1600 px.
FILL = (0.40, 0.94)
FAILURES = (KcalError, RuntimeError, cv2.error)


def by_kcal(**options: Any) -> Callable[[Observations], Camera]:
    return lambda seen: calibrate_camera(seen, CalibrationOptions(**options)).camera


MODELS: dict[str, Callable[[Observations], Camera]] = {
    "default": by_kcal(),
    "opencv5": by_kcal(model="opencv5"),
    "opencv14": by_kcal(model="opencv14"),
    "opencv14-warp": by_kcal(model="opencv14", board_warp=True),
    "ext20": by_kcal(model="ext20"),
    "cv8": functools.partial(opencv, coefficients=8),
    "cv14": functools.partial(opencv, coefficients=14),
    "cvRO": functools.partial(opencv, coefficients=8, release=True),
}
HOWS: tuple[How, ...] = ("held", "prior")
# A chain's name: its model and what the rig does with its cameras.
CHAINS = {
    **{f"{m}-{h}": (m, h) for m in MODELS if not m.startswith("cv") for h in HOWS},
    **{m: (m, HOWS[0]) for m in ("cv8", "cv14", "cvRO", "true")},
}


def observed(rig: TrueRig, draw: int, board: str, noise: float) -> tuple[Observations, Observations]:
    """What both cameras saw of the board of this draw."""
    points = BOARD.points if board == "exact" else printed(BOARD.points, draw)
    left, right = (
        capture(lens, VIEWS, noise, 1000 + 2 * draw + side, points, FILL)
        for side, lens in enumerate((rig.left, rig.right))
    )
    return left, right


def calibrated(model: str, rig: TrueRig, seen: tuple[Observations, Observations]) -> tuple[Camera, Camera] | str:
    """Both cameras, or why there are none."""
    if model == "true":
        return as_camera(rig.left), as_camera(rig.right)
    try:
        return MODELS[model](seen[0]), MODELS[model](seen[1])
    except FAILURES as error:
        return f"{type(error).__name__}: {error}"


def cell(draw: int, board: str, pupil: float, noise: float, *, chains: Sequence[str], marks: int, exact: int) -> Record:
    """All chains on one draw of lenses, board and corners; each camera is calibrated once."""
    rig = true_rig(draw, pupil)
    seen = observed(rig, draw, board, noise)
    points, found = targets(rig), []
    for model, group in itertools.groupby(chains, lambda chain: CHAINS[chain][0]):
        cameras = calibrated(model, rig, seen)
        for chain in group:
            record: Record = {"draw": draw, "board": board, "pupil": pupil, "noise": noise, "chain": chain}
            if isinstance(cameras, str):
                record |= {"runs": 0, "failed": {cameras: marks}, "lenses_m": [], "sums": {}}
            else:
                record |= judge(cameras, CHAINS[chain][1], rig, points, 1_000_000 + 1000 * draw, marks, exact)
            found.append(record)
    return {"chains": found}


@section("chain.md", "chain", seeds=range(300, 301), boards=("exact",), pupils=(0.0,), chains=("true",), marks=1)
def whole_chain(
    kept: Kept = NOT_KEPT, seeds: range = range(300, 310), boards: tuple[str, ...] = ("exact", "printed"),
    pupils: tuple[float, ...] = (0.0, 1.0, 3.0), noise: tuple[float, ...] = (0.05,),
    chains: tuple[str, ...] = tuple(CHAINS), marks: int = 24, exact: int = 4,
) -> list[Line]:  # fmt: skip
    """So many draws of landmarks and marks for each; of these `exact` also without noise, for the lenses alone."""
    work = torch.no_grad()(functools.partial(cell, chains=chains, marks=marks, exact=exact))
    records = kept.records(itertools.product(seeds, boards, pupils, noise), work, lambda _: "done")
    found = [one for record in records for one in record["chains"]]
    show(failures(found))
    return tables(found)
