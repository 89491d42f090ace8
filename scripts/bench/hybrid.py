"""The hybrid on a real wide lens, on views that were held out: which model predicts them, at what cost in time.

    python -m scripts.bench.hybrid --out hybrid.jsonl            # fits that the file holds already are not done again
    python -m scripts.bench.hybrid --out hybrid.jsonl --write    # the table in docs/measured/hybrid.md, from the file
    python -m scripts.bench.hybrid --points --write              # what a point costs: another table there

Data: `wide_lens_corners.npz` in $KCAL_DATA: 93 views of a 10 x 10 board through a lens of some 150 degrees (mrcal's
tour). A lens is fitted to the training views; on each held-out view only its pose is solved again, lens and board warp
as fitted. Measure: sqrt(sum w² |r|² / count), w the file's weights, pooled over all folds.

`field`, `field-views`: the field alone on opencv8, its priors chosen likewise, but with no other model fitted and
nothing compared. SPLINED: mrcal's lens of that many knots by `peer_mrcal.py`, where $KCAL_PEERS is a Python that has
mrcal; it is regularized by a constant, and chooses nothing.

Splits: `blocks20`: 20 contiguous blocks of 4 or 5 views, shuffled with seed 0, dealt to 5 folds; `evenodd`: every
second view. The hybrid chooses its priors, its lens and whether it is kept inside each training set alone: `hybrid` on
blocks of its views, `hybrid-views` on interleaved views.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import math
import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.lensfit.hybrid import HybridOptions, calibrate_hybrid
from kcal.corners.observations import Observations
from kcal.lens.camera import Camera
from kcal.lens.hybrid import HybridCamera
from kcal.lens.residual import FieldGrid, FieldResidual
from scripts.shared.page import write_section
from scripts.shared.timing import ratios, row, show, spread, times
from scripts.shared.wide_lens import folds, held_out, load, subset

PARAMETRIC = ("opencv5", "opencv8", "opencv12", "opencv14", "ext18", "ext20", "ext24")
HYBRID = ("hybrid", "hybrid-views")
# Their fields alone, on the plain lens: nothing is compared.
FIELD = ("field", "field-views")
PEERS = ("SPLINED11x8", "SPLINED16x11")
Record = dict[str, Any]


def measure(seen: Observations, weight: np.ndarray, split: str, fold: int, model: str) -> list[Record]:
    out = folds(split, len(seen.views))[fold] if split != "none" else np.zeros(0, int)
    train = np.setdiff1d(np.arange(len(seen.views)), out)
    data, test = subset(seen, train), subset(seen, out) if len(out) else None
    start, wall = time.process_time(), time.perf_counter()
    found = []
    if model in PEERS:
        return [{"split": split, "fold": fold, "model": model, **mrcal_splined(seen, weight, train, out, model)}]
    if model in (*HYBRID, *FIELD):
        groups: Literal["views", "blocks"] = "views" if model.endswith("-views") else "blocks"
        options = HybridOptions(board_warp=True, groups=groups, gate=False)
        if model in FIELD:
            options = dataclasses.replace(options, models=("opencv8",), rivals=())
        result = calibrate_hybrid(data, options)
        note = {
            "inside": result.held_out,
            "chosen": result.choice,
            "base": str(result.model),
            "effective": result.effective,
            "units": result.units,
            "largest": result.largest,
            "shares": [[p.strength if math.isfinite(p.strength) else None, p.smoothness, s] for p, s in result.shares],
        }
        solved = result.calibration
        found.append((model, solved, note))
    else:
        solved = calibrate_camera(data, CalibrationOptions(model=model, board_warp=True))
        found.append((model, solved, {}))
    cpu, wall = time.process_time() - start, time.perf_counter() - wall
    records: list[Record] = []
    for name, solved, note in found:
        record: Record = {"split": split, "fold": fold, "model": name, "cpu_s": cpu, "wall_s": wall, **note}
        if test is not None:
            warp = solved.board_warp
            assert warp is not None
            record["sum"], record["count"] = held_out(solved.camera, warp, test, weight[out])
        records.append(record)
        print(json.dumps(record)[:300], flush=True)
    return records


def mrcal_splined(
    seen: Observations, weight: np.ndarray, train: np.ndarray, out: np.ndarray, model: str
) -> dict[str, float]:
    """Mrcal's splined lens on the same training set, in the interpreter of $KCAL_PEERS, with one thread."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "problem.npz")
        np.savez(
            path,
            corners=seen.pixels().numpy(),
            weight=weight,
            train=train,
            held=out,
            image_size=seen.image_size,
            board_size=(seen.board.columns, seen.board.rows),
            square_m=seen.board.square,
            # A rough one is enough: that of a lens of 120 degrees.
            focal=seen.image_size[0] / (2.0 * math.tan(math.radians(60.0))),
        )
        script = Path(__file__).with_name("peer_mrcal.py")
        told = subprocess.run(
            [os.environ["KCAL_PEERS"], script, path, model],
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": ""},
            capture_output=True,
            text=True,
            check=False,
        )
    if told.returncode:
        raise SystemExit(f"{model}: {told.stderr[-2000:]}")
    print(model, told.stdout.strip().splitlines()[-1], flush=True)
    found: dict[str, float] = json.loads(told.stdout.strip().splitlines()[-1])
    return found


def gated(record: Record, done: list[Record]) -> Record:
    """Of a hybrid that its own held-out views refuse, the parametric model that is returned in its place."""
    if record["model"] not in HYBRID or record["chosen"] == "hybrid":
        return record
    place = record["split"], record["fold"], record["chosen"]
    found = next(r for r in done if (r["split"], r["fold"], r["model"]) == place)
    return {**record, "sum": found["sum"], "count": found["count"]}


def rms(records: list[Record]) -> float:
    return math.sqrt(sum(r["sum"] for r in records) / sum(r["count"] for r in records))


def points_table(count: int = 10_000, rounds: int = 15) -> list[str]:
    """Million points a second of 14 coefficients, and of a hybrid with all its default units in use."""
    lens = [-0.1, 0.02, 1e-4, -2e-4, 0.001, 0.01, 0.002, 0.001, 1e-4, 2e-4, -1e-4, 1e-4, 0.002, -0.001]
    size, half = (1920, 1080), 0.6
    plain = Camera.build(focal=(1600, 1600), center=(960, 540), size=size, coefficients=lens, model="opencv14")
    base = Camera.build(focal=(1600, 1600), center=(960, 540), size=size, coefficients=lens[:8], model="opencv8")
    grid = FieldGrid.covering((-0.6, -0.35), (0.6, 0.35), widths=[half * width for width in HybridOptions().widths])
    weights = 1e-4 * torch.randn(2, grid.count, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    cameras = (plain, HybridCamera.of(base, FieldResidual(grid, weights)))
    pixels = torch.rand(count, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    pixels = pixels * torch.tensor([1919.0, 1079.0], dtype=torch.float64)
    rays = [camera.unproject(pixels)[0] for camera in cameras]
    worst = float((cameras[1].project(rays[1])[0] - pixels).abs().max())
    lines = [
        f"{grid.count} units, {count} points, one thread, eager, {rounds} rounds; million points a second, median "
        f"(smallest to largest). Round trip of the hybrid: {worst:.1e} px.",
        "",
        row("direction", "14 coefficients", "hybrid", "hybrid's time over 14's"),
        row("---", "---:", "---:", "---:"),
    ]
    for direction, given in (("project", rays), ("unproject", [pixels, pixels])):
        calls = [functools.partial(getattr(c, direction), x) for c, x in zip(cameras, given, strict=True)]
        first, second = times(calls, rounds)
        rates = [spread([count / 1e6 / t for t in found], 2) for found in (first, second)]
        lines.append(row(direction, *rates, ratios(first, second, 1)))
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="JSON lines, one a fit")
    parser.add_argument("--points", action="store_true", help="what a point costs, instead of the fits")
    parser.add_argument("--splits", nargs="*", default=["blocks20", "evenodd"])
    peers = PEERS if os.environ.get("KCAL_PEERS") else ()
    parser.add_argument("--models", nargs="*", default=[*PARAMETRIC, *HYBRID, *FIELD, *peers])
    parser.add_argument("--write", action="store_true", help="write docs/measured/hybrid.md from the file")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.points:
        lines = show(points_table())
        if args.write:
            write_section("hybrid.md", "points", "\n".join(lines))
        return
    if args.out is None:
        raise SystemExit("--out is needed")
    seen, weight = load()
    done: list[Record] = []
    if args.out.exists():
        done = [json.loads(line) for line in args.out.read_text().splitlines()]
    have = {(r["split"], r["fold"], r["model"]) for r in done}
    if not args.write:
        for split in args.splits:
            for model in args.models:
                for fold in range(len(folds(split, len(seen.views)))):
                    if (split, fold, model) in have:
                        continue
                    records = measure(seen, weight, split, fold, model)
                    done += records
                    with args.out.open("a") as file:
                        file.writelines(json.dumps(record) + "\n" for record in records)
    lines = [row("model", *args.splits, "s (CPU) a fit"), row("---", *["---:"] * (len(args.splits) + 1))]
    # From the file alone, peers too where it has them.
    shown = [(model, gate) for model in dict.fromkeys([*args.models, *PEERS]) for gate in (True, False)]
    for model, gate in shown:
        if not gate and model not in HYBRID:
            continue
        cells, spent = [], []
        for split in args.splits:
            of = [r for r in done if r["split"] == split and r["model"] == model]
            if gate:
                of = [gated(record, done) for record in of]
            whole = len(of) == len(folds(split, len(seen.views)))
            worst = [math.sqrt(r["sum"] / r["count"]) for r in of]
            cells.append(f"{rms(of):.4f} ({min(worst):.3f} to {max(worst):.3f})" if whole else "")
            spent += [r["cpu_s"] for r in of]
        if any(cells):
            name = model if gate else f"{model}, whether it wins or not"
            lines.append(row(name, *cells, f"{sum(spent) / len(spent):.1f}"))
    show(lines)
    if args.write:
        write_section("hybrid.md", "held out", "\n".join(lines))


if __name__ == "__main__":
    main()
