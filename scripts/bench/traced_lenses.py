"""The default camera against ray-traced lenses: error at infinity, and whether its error bars hold.

Truth: three lenses of `kcal.sim.raytrace`, decentered by their tolerances, whose entrance pupil moves as in life
(`wander` 1); views of the paper's board (6 x 7 corners, 5 cm), exact or printed (stretch 0.15 %, shear 0.02 %,
bent along an oblique axis by 0.7 mm, smooth errors of 0.03 mm), with Gaussian corner noise. Measure: how far from the
truth each camera sees infinitely distant points, over the image, after the best-fit rotation; RMS, px. Coverage: how
often the truth lies in the hybrid's 95 % ellipses, on a grid of the image, where boards reached and beyond; and the RMS
error that its covariance predicts, over the true one. Places of one capture are in or out together, and captures of one
seed that share poses, and noise but for its size and order, nearly so: --apart gives each its own, and shares are told
with the standard error between seeds. Parametric models are fitted as `calibrate_camera` does by default, with the
board's warp. Seeds below 100 were used for tuning the hybrid.

*exact-models*: lenses with OpenCV's 5 or 14 coefficients, drawn at random about those of a surveillance camera, f 1600
px, without a moving pupil: the worst case for a camera that knows no model. Both ways to take the board: unknown (the
default; the right model with `board_warp`), and exact (`board="exact"`; the right model as `kcal calibrate --model`
fits it).
"""

from __future__ import annotations

import functools
import itertools
import math
import statistics
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from kcal import CalibrationOptions, Camera, KcalError, Observations, calibrate_camera
from kcal.sim.captures import LensLike, board_points, drawn_lens
from scripts.shared.captures import (
    BOARD,
    PAPER_BOARD,
    PRESCRIPTIONS,
    as_observations,
    capture,
    capture_corners,
    captures,
    error_at_infinity,
    printed,
)
from scripts.shared.page import NOT_KEPT, Kept, Line, Lines, Record, section, share, timed
from scripts.shared.simulated import LENSES, figures, quick
from scripts.shared.views import TRUTH

SIGMAS = (0.02, 0.05, 0.1, 0.3)
SHOWN = 0.1  # px of noise of the cells that the page shows; means are over all
VIEWS = (60, 30, 8)
BOARDS: tuple[str, ...] = ("exact", "printed")
LITTLE: Record = {"lenses": LENSES[2:], "views": (8,), "noise": (SHOWN,), "boards": BOARDS[:1]}
MODELS = {
    "hybrid": CalibrationOptions(),
    "opencv5": CalibrationOptions(model="opencv5", board_warp=True),
    "opencv14": CalibrationOptions(model="opencv14", board_warp=True),
    "ext20": CalibrationOptions(model="ext20", board_warp=True),
}


def cell(
    name: str, board: str, views: int, seed: int, *, sigmas: Sequence[float], models: Sequence[str], apart: bool
) -> Record:
    """Models on captures of one lens that differ in their noise alone, or in poses and noise."""
    lens = drawn_lens(PRESCRIPTIONS[name], 1.0, seed, wander=1.0)
    points = BOARD.points if board == "exact" else printed(BOARD.points, seed)
    drawn = (
        [capture(lens, views, s, 1000 + seed + round(1e6 * s), points, posed_by=quick(lens)) for s in sigmas]
        if apart
        else captures(lens, views, sigmas, 1000 + seed, points)
    )
    head = {"lens": name, "board": board, "views": views, "seed": seed}
    fits = [
        head | {"sigma": sigma, "model": model} | measured(lens, seen, MODELS[model])
        for sigma, seen in zip(sigmas, drawn, strict=True)
        for model in models
    ]
    return {"fits": fits}


def fits_of(
    kept: Kept, seeds: range, lenses: tuple[str, ...], views: tuple[int, ...], noise: tuple[float, ...],
    boards: tuple[str, ...], models: tuple[str, ...], apart: bool,
) -> list[Record]:  # fmt: skip
    """Every fit of every capture."""
    keys = [(name, board, count, seed) for seed, name, board, count in itertools.product(seeds, lenses, boards, views)]
    work = functools.partial(cell, sigmas=noise, models=models, apart=apart)
    return [fit for record in kept.records(keys, work) for fit in record["fits"]]


def measured(lens: LensLike, seen: Observations, options: CalibrationOptions) -> Record:
    """One calibration against the truth."""
    try:
        result, spent = timed(calibrate_camera, seen, options)
        error = error_at_infinity(result.camera, lens)
    except KcalError as refusal:
        return {"rms": math.inf, "failed": str(refusal)}
    record: Record = {"rms": error.rms, "cpu_s": spent, "valid": error.valid, "noise": result.noise}
    if result.hybrid is None:
        return record
    told = {"tempering": result.hybrid.tempering, "port": "port_x" in result.camera.names}
    return record | told | figures(result.camera, seen, error.pixels, error.errors)


@section(
    "one-camera.md", "traced", seeds=range(200, 201), lenses=LENSES[2:], views=(8,), noise=(0.1,), boards=("exact",)
)
def traced(
    kept: Kept = NOT_KEPT, seeds: range = range(200, 203), lenses: tuple[str, ...] = LENSES,
    views: tuple[int, ...] = VIEWS, noise: tuple[float, ...] = SIGMAS, boards: tuple[str, ...] = BOARDS,
) -> list[Line]:  # fmt: skip
    records = fits_of(kept, seeds, lenses, views, noise, boards, tuple(MODELS), False)
    cells: dict[tuple[Any, ...], dict[str, list[float]]] = {}
    for r in records:
        key = (r["lens"], r["board"], r["views"], r["sigma"])
        cells.setdefault(key, {}).setdefault(r["model"], []).append(r["rms"])
    means, rows = [], []
    for board in BOARDS:
        ratios = []
        for name, count, sigma in itertools.product(LENSES, VIEWS, SIGMAS):
            found = cells.get((name, board, count, sigma))
            if not found:
                continue
            typical = {model: math.exp(statistics.fmean(map(math.log, values))) for model, values in found.items()}
            ratio = typical["hybrid"] / min(value for model, value in typical.items() if model != "hybrid")
            ratios.append(ratio)
            if sigma == SHOWN:
                rows.append([board, name, count, *(f"{typical[m]:.3f}" for m in MODELS), f"{ratio:.2f}"])
        if ratios:
            mean = math.exp(statistics.fmean(map(math.log, ratios)))
            means.append(f"{board} boards: geometric mean {mean:.2f}, worst {max(ratios):.2f}")
    return [
        f"Hybrid over the best of the others in each cell: {'; '.join(means)}. Cells with {SHOWN:g} px of noise:",
        ["board", "lens", "views", *MODELS, "ratio"],
        *rows,
    ]


def between_seeds(records: list[Record], key: str) -> str:
    """Mean of a share in percent, with the standard error that its means of each seed tell."""
    seeds: dict[int, list[float]] = {}
    for r in records:
        if r[key] == r[key]:
            seeds.setdefault(r["seed"], []).append(r[key])
    return share(map(statistics.fmean, seeds.values()), " %")


@section(
    "one-camera.md", "sigmas", seeds=range(200, 202), lenses=LENSES[2:], views=(8,), noise=(0.1,), boards=("exact",)
)
def sigmas(
    kept: Kept = NOT_KEPT, seeds: range = range(200, 212), lenses: tuple[str, ...] = LENSES,
    views: tuple[int, ...] = (60, 30), noise: tuple[float, ...] = (0.03, 0.1, 0.2),
    boards: tuple[str, ...] = BOARDS, apart: bool = False,
) -> list[Line]:  # fmt: skip
    """Predicted errors of the hybrid over true ones, and how often the truth is inside its ellipses.

    With `apart` each noise has views of its own.
    """
    records = fits_of(kept, seeds, lenses, views, noise, boards, ("hybrid",), apart)
    cells: dict[tuple[Any, ...], list[Record]] = {}
    for r in records:
        if "predicted" in r:
            cells.setdefault((r["lens"], r["board"], r["views"], r["sigma"]), []).append(r)
    ratios = []
    for own in cells.values():
        predicted, true = (math.sqrt(statistics.fmean(r[key] ** 2 for r in own)) for key in ("predicted", "rms"))
        ratios.append(predicted / true)
    mean = math.exp(statistics.fmean(map(math.log, ratios)))
    rows, known = list[list[Any]](), [r for r in records if "inside" in r]
    for key in itertools.product(BOARDS, LENSES, VIEWS):
        own = [r for r in known if (r["board"], r["lens"], r["views"]) == key]
        if own:
            rows.append([*key, *(between_seeds(own, what) for what in ("inside", "beyond")), len(own)])
    return [
        f"Predicted over true RMS error at infinity: geometric mean {mean:.2f}, from {min(ratios):.2f} to "
        f"{max(ratios):.2f}, each from {len(next(iter(cells.values())))} captures.",
        "",
        f"Truth inside the 95 % ellipses of the hybrid, seeds {', '.join(map(str, seeds))}:",
        ["board", "lens", "views", "where boards reached", "beyond", "captures"],
        *rows,
    ]


EXACT_MODELS = ("opencv5", "opencv14")
NOISE = (0.05, 0.2)
# Relative scatter of the coefficients between lenses.
SCATTER = 0.3


def drawn(model: str, seed: int) -> Camera:
    """A lens of this model that is regular all over its image."""
    generator = torch.Generator().manual_seed(seed)
    count = int(model.removeprefix("opencv"))
    while True:
        factors = 1.0 + SCATTER * torch.randn(count, generator=generator, dtype=torch.float64)
        shift = 8.0 * torch.randn(2, generator=generator, dtype=torch.float64)
        camera = Camera.build(
            focal=(1600, 1600),
            center=tuple((torch.tensor([959.5, 539.5], dtype=torch.float64) + shift).tolist()),
            size=(1920, 1080),
            coefficients=(factors * torch.tensor(TRUTH[:count], dtype=torch.float64)).tolist(),
            model=model,
        )
        if bool(camera.unproject(camera.grid(33, 25).reshape(-1, 2))[1].all()):
            return camera


def errors(camera: Camera, views: int, noise: float, seed: int, model: str) -> list[float]:
    """Error at infinity on one capture, px RMS: default and right model with the board unknown, and both with it."""
    assert torch.equal(board_points(PAPER_BOARD), BOARD.points)
    pixels: Tensor = capture_corners(camera, views, sigma=noise, seed=seed).pixels
    seen = as_observations(pixels, camera.size)
    options = (
        CalibrationOptions(),
        CalibrationOptions(model=model, board_warp=True),
        CalibrationOptions(board="exact"),
        CalibrationOptions(model=model),
    )
    with torch.no_grad():
        return [error_at_infinity(calibrate_camera(seen, one).camera, camera).rms for one in options]


@section("one-camera.md", "exact-models", seeds=range(200, 201), views=(8,))
def exact_models(seeds: range = range(200, 204), views: tuple[int, ...] = VIEWS) -> Lines:
    rows, ratios = [], []
    for model, count, noise in itertools.product(EXACT_MODELS, views, NOISE):
        found = [errors(drawn(model, seed), count, noise, 1000 + seed, model) for seed in seeds]
        typical = [math.exp(statistics.fmean(map(math.log, column))) for column in zip(*found, strict=True)]
        ratios.append((typical[0] / typical[1], typical[2] / typical[3]))
        rows.append([model, count, f"{noise:g}", *(f"{v:.3f}" for v in typical[:2]), f"{ratios[-1][0]:.2f}"])
    unknown, exact = (
        f"geometric mean {math.exp(statistics.fmean(map(math.log, column))):.2f}, worst {max(column):.2f}"
        for column in zip(*ratios, strict=True)
    )
    yield f"Default camera over the right model: {unknown}; both with the board taken as exact: {exact}."
