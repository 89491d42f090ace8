"""Hybrid and parametric cameras against ray-traced lenses: the error at infinity, over views, noise and lenses.

    python -m scripts.bench.hybrid_truth --out truth.jsonl            # cells that the file holds are not done again
    python -m scripts.bench.hybrid_truth --out truth.jsonl --more     # two more models for the cells that it holds
    python -m scripts.bench.hybrid_truth --out truth.jsonl --write    # the table in docs/measured/hybrid.md

Truth: three lenses of `kcal.sim.prescription`, decentered by their tolerances (`drawn_lens`, strength 1), another draw
for every seed; views of the paper's board (6 x 7 corners, 5 cm) with Gaussian corner noise. Measure: how far from
the truth each camera sees infinitely distant points, all over the image, after the best rotation; pixels, RMS and
largest. `hybrid` is what the gate returns, `field` the hybrid whether it wins or not. `global`: Eq. 11 read literally
on ext20, fitted jointly with the poses. `14 of a 14`: the error of 14
coefficients where the truth has no more, which is the lens of 14 that fits the exact corners best, with the same poses
and noise: what these views can tell, so that no model can be far below it. The gate's rule was picked on seeds from
100 on.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import math
import statistics
import time
from pathlib import Path
from typing import Any

import torch

from kcal.calibrate.bundle.board_problem import BoardProblem
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.camera.solve import solve
from kcal.calibrate.lensfit.hybrid import HybridOptions, calibrate_hybrid
from kcal.corners.board import Board
from kcal.corners.observations import Observations, View
from kcal.errors import KcalError
from kcal.lens.camera import Camera
from kcal.nets.residual import ResidualNet, train_residual
from kcal.sim.captures import capture_corners, drawn_lens
from kcal.sim.infinity import error_at_infinity
from kcal.solve.lm import LMOptions
from scripts.shared.page import write_section
from scripts.shared.timing import row, show

LENSES = ("webcam", "machine-vision", "surveillance")
BOARD = Board(columns=7, rows=6, square=0.05)
PARAMETRIC = ("opencv14", "ext20")
BOUND = "14 of a 14"
MORE = ("ext24", "global")
MODELS = (*PARAMETRIC, *MORE, "hybrid", "field", BOUND)
REFIT = LMOptions(max_iterations=100, tolerance=1e-10, flatness=1e-7)
Record = dict[str, Any]


@functools.lru_cache(maxsize=1)
def captured(name: str, views: int, seed: int) -> tuple[Any, Any]:
    """A lens, and its views with noise of one pixel, which is scaled afterwards."""
    lens = drawn_lens(name, 1.0, seed)
    capture = capture_corners(lens, views, sigma=1.0, seed=1000 + seed)
    assert torch.allclose(capture.points, BOARD.points)
    return lens, capture


def observations(pixels: torch.Tensor, size: tuple[int, int]) -> Observations:
    corners = [tuple((u, v) for u, v in view) for view in pixels.tolist()]
    return Observations(
        board=BOARD, image_size=size, views=tuple(View(name=f"{i:03d}", pixels=view) for i, view in enumerate(corners))
    )


def observed(name: str, views: int, sigma: float, seed: int) -> tuple[Observations, Any]:
    lens, capture = captured(name, views, seed)
    return observations(capture.true_pixels + sigma * (capture.pixels - capture.true_pixels), lens.size), lens


def bound(name: str, views: int, sigma: float, seed: int) -> tuple[Any, Any]:
    """14 coefficients where the truth has no more: the lens that fits the exact corners best, same poses and noise."""
    lens, capture = captured(name, views, seed)
    best = calibrate_camera(observations(capture.true_pixels, lens.size), CalibrationOptions(model="opencv14"))
    points = BOARD.points @ best.cam_from_board_rotation.mT + best.cam_from_board_translation[:, None]
    pixels, valid = best.camera.project(points)
    assert bool(valid.all())
    seen = observations(pixels + sigma * (capture.pixels - capture.true_pixels), lens.size)
    return calibrate_camera(seen, CalibrationOptions(model="opencv14")).camera, best.camera


class Cell:
    """The records of one capture."""

    def __init__(self, name: str, views: int, sigma: float, seed: int) -> None:
        self.head = {"lens": name, "views": views, "sigma": sigma, "seed": seed}
        self.records: list[Record] = []

    def note(self, model: str, camera: Any, truth: Any, start: float, **more: Any) -> None:
        """What became of a model."""
        error = error_at_infinity(camera, truth)
        record = {**self.head, "model": model, "rms": error.rms, "max": error.maximum, "valid": error.valid}
        self.records.append({**record, "cpu_s": time.process_time() - start, **more})
        print(json.dumps(self.records[-1])[:240], flush=True)

    def failed(self, model: str, error: KcalError, start: float) -> None:
        """A model that could not be fitted counts as infinitely wrong."""
        print(f"{self.head} {model}: {error}", flush=True)
        record = {**self.head, "model": model, "rms": math.inf, "max": math.inf, "valid": 0.0}
        self.records.append({**record, "cpu_s": time.process_time() - start})


def more_models(name: str, views: int, sigma: float, seed: int) -> list[Record]:
    """24 coefficients, and Eq. 11 read literally, on one capture."""
    seen, lens = observed(name, views, sigma, seed)
    out = Cell(name, views, sigma, seed)
    start = time.process_time()
    try:
        out.note("ext24", calibrate_camera(seen, CalibrationOptions(model="ext24")).camera, lens, start)
    except KcalError as error:
        out.failed("ext24", error, start)
    start = time.process_time()
    try:
        solved = solve(seen, CalibrationOptions(model="ext20"), lambda _: None)
        camera = Camera(solved.result.state.parameters, size=seen.image_size, model="ext20")
        residual = ResidualNet(camera)
        problem = BoardProblem(
            BOARD.points, seen.pixels(), camera.model, residual.corrected, terms=solved.problem.terms
        )
        train_residual(residual, problem, solved.result.state, REFIT)
        out.note("global", residual.camera(), lens, start)
    except KcalError as error:
        out.failed("global", error, start)
    return out.records


def cell(name: str, views: int, sigma: float, seed: int) -> list[Record]:
    """All other models on one capture."""
    seen, lens = observed(name, views, sigma, seed)
    out = Cell(name, views, sigma, seed)
    note, failed = out.note, out.failed
    parametric = {}
    for model in PARAMETRIC:
        start = time.process_time()
        try:
            parametric[model] = calibrate_camera(seen, CalibrationOptions(model=model)).camera
            note(model, parametric[model], lens, start)
        except KcalError as error:
            failed(model, error, start)
    start = time.process_time()
    try:
        note(BOUND, *bound(name, views, sigma, seed), start)
    except KcalError as error:
        failed(BOUND, error, start)
    start = time.process_time()
    result = calibrate_hybrid(seen, HybridOptions(groups="views", gate=False))
    more = {"inside": result.held_out, "effective": result.effective, "base": str(result.model)}
    note("field", result.calibration.camera, lens, start, **more)
    camera = result.calibration.camera
    if result.choice != "hybrid":
        camera = parametric.get(result.choice) or calibrate_camera(seen, CalibrationOptions(model=result.choice)).camera
    note("hybrid", camera, lens, start, chosen=result.choice)
    return out.records


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
        own = {r["seed"]: r["rms"] for r in of["hybrid"]}
        found = {
            m: f"{statistics.median(r['rms'] for r in of[m]):.4f} ({statistics.median(r['max'] for r in of[m]):.3f})"
            for m in MODELS
            # Of the same draws as the others, or not at all.
            if len(of[m]) == len(own)
        }
        ratio = [r["rms"] / own[r["seed"]] for r in of["opencv14"] if r["seed"] in own]
        lines.append(
            row(
                lens,
                sigma,
                views,
                len(own),
                *(found.get(m, "–") for m in MODELS),
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
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--more", action="store_true", help="24 coefficients and Eq. 11 for the cells of the file")
    parser.add_argument("--write", action="store_true", help="write docs/measured/hybrid.md from the file")
    args = parser.parse_args()
    torch.set_num_threads(1)
    done = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    have = {(r["lens"], r["views"], r["sigma"], r["seed"]) for r in done}
    seeds = range(args.first_seed, args.first_seed + (0 if args.write else args.seeds))
    cells = itertools.product(args.views, seeds, args.lenses, args.sigma)
    todo = [(lens, views, sigma, seed) for views, seed, lens, sigma in cells if (lens, views, sigma, seed) not in have]
    work = cell
    if args.more:
        known = {(r["lens"], r["views"], r["sigma"], r["seed"]) for r in done if r["model"] in MORE}
        todo, work = [which for which in sorted(have - known) if which[1] in args.views], more_models
    start, whole = time.process_time(), sum(views for _, views, *_ in todo)
    for i, which in enumerate(todo):
        records = work(*which)
        done += records
        with args.out.open("a") as file:
            file.writelines(json.dumps(record) + "\n" for record in records)
        spent, past = time.process_time() - start, sum(views for _, views, *_ in todo[: i + 1])
        left = spent * (whole / past - 1.0) / 60.0
        print(f"{i + 1} of {len(todo)} cells, {spent / (i + 1):.1f} CPU s each, some {left:.0f} min left", flush=True)
    lines = show(table(done))
    if args.write:
        about = (__doc__ or "").split("Truth: ")[1]
        note = f"Median over the seeds of the RMS, in brackets of the largest error; pixels. Truth: {about}"
        write_section("hybrid.md", "truth", "\n".join([note.replace("\n", " ").strip(), "", *lines]))


if __name__ == "__main__":
    main()
