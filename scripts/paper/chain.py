"""The paper's chain beside kcal's default camera, on its simulated site and on real captures.

Lenses: 20 coefficients (Eq. 10); the same with the residual net as written (Eq. 11, trained on Eq. 12 by least
squares); kcal's lens with a network as its field, which depends on the position as Fig. 8 draws it, with its first
layer fixed and trained; and the default. Each is fitted to all views, and to the first and the second half of them. A
half judges the camera of the other half, which has seen none of its views, by its projection alone, with poses and
board refitted (`scripts.shared.held_out`), without and with each view's own motion. Error bars are honest where these
two cameras differ by no more than both state (`kcal.lens.camera_difference`).
"""

from __future__ import annotations

import functools
import statistics
from collections.abc import Sequence
from pathlib import Path

from kcal import CalibrationOptions, Camera, KcalError, Observations, calibrate_camera
from kcal.lens import camera_difference
from scripts.paper.locate import KINDS, observe, paper_scene
from scripts.paper.train_eq12 import by_least_squares
from scripts.shared.captures import error_at_infinity
from scripts.shared.held_out import of_halves
from scripts.shared.page import NOT_KEPT, Kept, Record, section, table, timed
from scripts.shared.real_captures import load, names

SITE, VIEWS = "site ", 30
RESIDUAL = "ext20 + Eq. 11"
LENSES = {
    "ext20": CalibrationOptions(model="ext20"),
    RESIDUAL: CalibrationOptions(model="ext20"),
    "network, first layer fixed": CalibrationOptions(model="network", training=None),
    "network, trained": CalibrationOptions(model="network"),
    "default": CalibrationOptions(),
}
HEADS = ["views of", "lens", "RMS, px", "held out, px", "moving, px", "halves: ratio (p)", "at infinity, px", "CPU s"]


def fitted(seen: Observations, lens: str) -> tuple[Camera, float]:
    """A camera and its RMS, pixels."""
    result = calibrate_camera(seen, LENSES[lens])
    if lens != RESIDUAL:
        return result.camera, result.rms
    fit = by_least_squares(result)
    return fit.camera, fit.rms


def observed(capture: str, work: Path, views: int = VIEWS) -> Observations:
    """The views of a real capture, or of the left camera of a kind of the paper's site."""
    if not capture.startswith(SITE):
        return load(capture).seen
    name, folder = capture.removeprefix(SITE), work / capture.replace(" ", "-")
    path = folder / "left.kcal.json"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        observe(folder, name, paper_scene(KINDS[name], 0), "left", views)
    return Observations.load(path)


def measured(capture: str, lens: str, work: Path, views: int = VIEWS) -> Record:
    """One lens on one capture."""
    seen, record = observed(capture, work, views), Record()
    try:
        (camera, record["rms"]), record["cpu_s"] = timed(fitted, seen, lens)
    except KcalError as error:
        return record | {"refused": str(error)}
    if capture.startswith(SITE):
        truth = paper_scene(KINDS[capture.removeprefix(SITE)], 0).rig.left
        record["infinity"] = error_at_infinity(camera, truth).rms
    middle = len(seen.names) // 2
    halves = [seen.subset(list(part)) for part in (seen.names[:middle], seen.names[middle:])]
    try:
        cameras = [fitted(half, lens)[0] for half in halves]
    except KcalError as error:
        return record | {"half_refused": str(error)}
    found = camera_difference(*cameras)
    judged = of_halves(cameras, [(half, None) for half in halves])
    return record | judged | {"ratio": found.ratio, "probability": found.probability}


def cells(record: Record) -> list[str]:
    """A row of the table."""
    if "rms" not in record:
        return ["refused", "", "", "", "", ""]
    infinity = f"{record['infinity']:.3f}" if "infinity" in record else ""
    head, tail = f"{record['rms']:.4f}", [infinity, f"{record['cpu_s']:.1f}"]
    if "still" not in record:
        return [head, "a half is refused", "", "", *tail]
    lost = f", {record['lost']} lost" if record["lost"] else ""
    honest = "none stated" if record["ratio"] is None else f"{record['ratio']:.2f} ({record['probability']:.2g})"
    return [head, f"{record['still']:.4f}{lost}", f"{record['moved']:.4f}", honest, *tail]


def summary(records: Sequence[Record]) -> list[str]:
    """Medians over the real captures on which a lens and the default were both judged."""
    by_key = {tuple(record["key"]): record for record in records}
    real = sorted({capture for capture, _ in by_key if not capture.startswith(SITE)})
    base = {c: by_key[c, "default"] for c in real if "still" in by_key.get((c, "default"), {})}
    rows = []
    for lens in LENSES:
        tried = {c: by_key[c, lens] for c in base if (c, lens) in by_key}
        of = {c: record for c, record in tried.items() if "still" in record}
        if not of:
            continue
        over = [record["moved"] / base[c]["moved"] for c, record in of.items()]
        chances = [record["probability"] for record in of.values() if record["probability"] is not None]
        honest = f"{sum(p >= 0.01 for p in chances)} of {len(chances)}" if chances else "none stated"
        cells = [f"{len(of)} of {len(tried)}", f"{statistics.median(over):.2f} ({min(over):.2f} to {max(over):.2f})"]
        cpu = f"{statistics.median(record['cpu_s'] for record in of.values()):.1f}"
        rows.append([lens, *cells, sum(record["lost"] for record in of.values()), honest, cpu])
    heads = ["lens", "captures", "held out over the default's", "corners lost", "halves with p ≥ 0.01", "CPU s"]
    return [*table(heads, rows), ""]


def lines(records: Sequence[Record]) -> list[str]:
    """The section of the page."""
    order = list(LENSES)
    ordered = sorted(records, key=lambda record: (record["key"][0], order.index(record["key"][1])))
    return [*summary(records), *table(HEADS, [[*record["key"], *cells(record)] for record in ordered])]


@section("paper.md", "chain", captures=("sq1280",), lenses=("default",))
def whole_chain(
    kept: Kept = NOT_KEPT, captures: tuple[str, ...] = ("all",), lenses: tuple[str, ...] = tuple(LENSES),
    work: Path = Path("build/paper"),
) -> list[str]:  # fmt: skip
    """Names of captures, or 'site glass' and so on; images of the site stay in a folder."""
    wanted = [*(SITE + kind for kind in KINDS), *names()] if captures == ("all",) else captures
    keys = [(capture, lens) for capture in wanted for lens in lenses]
    return lines(kept.records(keys, functools.partial(measured, work=work), lambda r: " | ".join(cells(r))))
