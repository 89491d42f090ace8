"""Hybrid and parametric cameras against ray-traced lenses: the error at infinity, over views, noise and lenses.

    python scripts/bench_hybrid_truth.py --out truth.jsonl            # cells that the file holds are not done again
    python scripts/bench_hybrid_truth.py --out truth.jsonl --write    # the table in docs/hybrid.md, from the file alone

Truth: three lenses of `kcal.sim.prescription`, decentred by their tolerances (`drawn_lens`, strength 1), another draw
for every seed; views of the paper's board (6 x 7 corners, 5 cm) with Gaussian corner noise. Measure: how far from
the truth each camera sees infinitely distant points, all over the image, after the best rotation; pixels, RMS and
largest. `hybrid` is what the gate returns, `field` the hybrid whether it wins or not.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import statistics
import time
from pathlib import Path
from typing import Any

import torch
from page import write_section
from timing import row, show

from kcal.calibrate.hybrid import HybridOptions, calibrate_hybrid
from kcal.calibrate.mono import CalibrationOptions, calibrate_camera
from kcal.corners.board import Board
from kcal.corners.observations import Observations, View
from kcal.errors import KcalError
from kcal.sim.captures import capture_corners, drawn_lens
from kcal.sim.infinity import error_at_infinity

LENSES = ("webcam", "machine-vision", "surveillance")
BOARD = Board(columns=7, rows=6, square=0.05)
PARAMETRIC = ("opencv14", "ext20", "ext24")
MODELS = (*PARAMETRIC, "hybrid", "field")
Record = dict[str, Any]


def observed(name: str, views: int, sigma: float, seed: int) -> tuple[Observations, Any]:
    lens = drawn_lens(name, 1.0, seed)
    capture = capture_corners(lens, views, sigma=sigma, seed=1000 + seed)
    assert torch.allclose(capture.points, BOARD.points)
    pixels = [tuple((u, v) for u, v in view) for view in capture.pixels.tolist()]
    seen = tuple(View(name=f"{i:03d}", pixels=view) for i, view in enumerate(pixels))
    return Observations(board=BOARD, image_size=lens.size, views=seen), lens


def cell(name: str, views: int, sigma: float, seed: int) -> list[Record]:
    """All models on one capture."""
    seen, lens = observed(name, views, sigma, seed)
    out: list[Record] = []

    def note(model: str, camera: Any, start: float, **more: Any) -> None:
        error = error_at_infinity(camera, lens)
        record = {"lens": name, "views": views, "sigma": sigma, "seed": seed, "model": model, "rms": error.rms}
        record |= {"max": error.maximum, "valid": error.valid, "cpu_s": time.process_time() - start, **more}
        out.append(record)
        print(json.dumps(record)[:240], flush=True)

    parametric = {}
    for model in PARAMETRIC:
        start = time.process_time()
        try:
            parametric[model] = calibrate_camera(seen, CalibrationOptions(model=model)).camera
        except KcalError as error:
            print(f"{name} {views} {sigma} {seed} {model}: {error}", flush=True)
            failed = {"lens": name, "views": views, "sigma": sigma, "seed": seed, "model": model}
            out.append({**failed, "rms": math.inf, "max": math.inf, "valid": 0.0, "cpu_s": time.process_time() - start})
            continue
        note(model, parametric[model], start)
    start = time.process_time()
    result = calibrate_hybrid(seen, HybridOptions(groups="views", rivals=("opencv8", "opencv14", "ext20"), gate=False))
    note("field", result.calibration.camera, start, inside=result.held_out, effective=result.effective)
    best = min((name for name in result.held_out if name != "hybrid"), key=lambda name: result.held_out[name])
    if result.held_out["hybrid"] < result.held_out[best]:
        note("hybrid", result.calibration.camera, start, chosen="hybrid")
    else:
        camera = parametric.get(best) or calibrate_camera(seen, CalibrationOptions(model=best)).camera
        note("hybrid", camera, start, chosen=best)
    return out


def table(done: list[Record]) -> list[str]:
    cells = sorted({(r["lens"], r["sigma"], r["views"]) for r in done})
    lines = [
        row("lens", "noise, px", "views", "seeds", *MODELS, "gate kept", "14 / hybrid"),
        row("---", "---:", "---:", "---:", *["---:"] * len(MODELS), "---:", "---:"),
    ]
    for lens, sigma, views in cells:
        of = {
            m: [r for r in done if (r["lens"], r["sigma"], r["views"], r["model"]) == (lens, sigma, views, m)]
            for m in MODELS
        }
        rms = {m: statistics.median(r["rms"] for r in of[m]) for m in MODELS}
        most = {m: statistics.median(r["max"] for r in of[m]) for m in MODELS}
        own = {r["seed"]: r["rms"] for r in of["hybrid"]}
        ratio = [r["rms"] / own[r["seed"]] for r in of["opencv14"] if r["seed"] in own]
        lines.append(
            row(
                lens,
                sigma,
                views,
                len(own),
                *(f"{rms[m]:.4f} ({most[m]:.3f})" for m in MODELS),
                f"{sum(r.get('chosen') == 'hybrid' for r in of['hybrid'])} of {len(own)}",
                f"{statistics.median(ratio):.2f} ({min(ratio):.2f} to {max(ratio):.2f})",
            )
        )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON lines, one a camera")
    parser.add_argument("--lenses", nargs="*", default=list(LENSES))
    parser.add_argument("--views", type=int, nargs="*", default=[60, 30, 120])
    parser.add_argument("--sigma", type=float, nargs="*", default=[0.02, 0.05, 0.1, 0.2])
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--write", action="store_true", help="write docs/hybrid.md from the file")
    args = parser.parse_args()
    torch.set_num_threads(1)
    done = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    have = {(r["lens"], r["views"], r["sigma"], r["seed"]) for r in done}
    cells = itertools.product(args.views, range(0 if args.write else args.seeds), args.lenses, args.sigma)
    for views, seed, lens, sigma in cells:
        if (lens, views, sigma, seed) not in have:
            records = cell(lens, views, sigma, seed)
            done += records
            with args.out.open("a") as file:
                file.writelines(json.dumps(record) + "\n" for record in records)
    lines = show(table(done))
    if args.write:
        about = (__doc__ or "").split("Truth: ")[1]
        note = f"Median over the seeds of the RMS, in brackets of the largest error; pixels. Truth: {about}"
        write_section("hybrid.md", "truth", "\n".join([note.replace("\n", " ").strip(), "", *lines]))


if __name__ == "__main__":
    main()
