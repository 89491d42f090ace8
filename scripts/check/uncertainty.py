"""Whether predicted standard deviations are those of repeated captures.

One camera, one set of poses, fresh normal noise for each capture; every capture is calibrated from nothing.

Whether richer models end above poorer ones on real views, which must not be: 5 to 24 coefficients.

Corners count alike (`weighted=False`), so that the RMS is what is minimized.

Gradient descent and Adam on a calibration problem, beside Levenberg-Marquardt.

The paper (Section 4.3.1) found that first-order optimizers fail on camera calibration. Here all three get the same
residuals, the same start (base projection, no distortion) and exact gradients. The first-order methods run twice: on
the parameters as they are (pixels, radians, meters, coefficients), and on parameters scaled by the columns of the
Jacobian at the start, as Levenberg-Marquardt scales them. Each gets the best of many learning rates, judged by short
runs.

Gradients through a calibration: time, and what Gauss and Newton's matrix would get wrong.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from kcal import CalibrationOptions, Camera, Observations, calibrate_camera
from kcal.calibrate.camera.layer import CalibratedViews, calibrate_views
from kcal.calibrate.hybrid.base_fit import fit_projection
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import free_parameters
from kcal.lens.model import LensModel
from kcal.lens.pose import step_rows
from kcal.lens.projection import INTRINSICS, project_components
from kcal.solve.lm import LMOptions, SolverStatus, minimize
from scripts.shared.page import Lines, section, table, times
from scripts.shared.real_captures import load, stereo_images
from scripts.shared.views import MODELS, NOISE, SIZE, WEAK, observed, simulate

DESCENDED = 15
RATES = [10.0**e for e in range(-8, 5)]
# Share of the steps that each learning rate gets on trial.
TRIAL = 0.1
METHODS = {"gradient descent": torch.optim.SGD, "Adam": torch.optim.Adam}
LM = "Levenberg-Marquardt"
COLORS = {LM: "#111111", "gradient descent": "#1f77b4", "Adam": "#d62728"}
Problem = Any  # a `SchurProblem` that says how many parameters views share


class Run(NamedTuple):
    """RMS (pixels) after each step, the start first; the seconds since the start; and the best state."""

    rms: np.ndarray
    seconds: np.ndarray
    state: Any = None
    rate: float | None = None


def set_up(coefficients: int) -> tuple[BoardProblem, BoardState]:
    """The simulated views, and the start that all methods share."""
    data = simulate(DESCENDED)
    board, pixels = torch.from_numpy(data["board"]), torch.from_numpy(data["pixels"])
    model = LensModel.named(MODELS[coefficients])
    base = fit_projection(board, pixels, SIZE, torch.ones_like(pixels[..., 0])).state
    parameters = torch.zeros(len(INTRINSICS) + model.size, dtype=torch.float64)
    parameters[:4] = base.parameters[:4]
    problem = BoardProblem(board, pixels, model, free_parameters(model))
    return problem, BoardState.flat(parameters, base.rotation, base.translation)


def rms_of(problem: Problem, cost: Tensor) -> np.ndarray:
    return torch.sqrt(4.0 * cost / problem.residual_count).numpy()


def levenberg_marquardt(problem: BoardProblem, start: BoardState) -> Run:
    clock, ticks = time.perf_counter(), [0.0]

    def tick(_: int, __: Tensor) -> None:
        ticks.append(time.perf_counter() - clock)

    result = minimize(problem, start, LMOptions(max_iterations=1000), tick)
    return Run(rms_of(problem, result.history), np.array(ticks))


def units(problem: Problem, start: Any) -> tuple[Tensor, Tensor]:
    """One over the length of each column of the Jacobian: of the shared parameters, and of each pose."""
    length = torch.linalg.vector_norm(problem.rows(start), dim=-1)
    shared = torch.linalg.vector_norm(length[:, 6:-1], dim=0)
    return 1.0 / shared.clamp_min(1e-9), 1.0 / length[:, :6]


def descend(
    problem: Problem, start: Any, method: str, rate: float, scaled: bool, steps: int,
    clock: Callable[[], float] = time.perf_counter,
) -> Run:  # fmt: skip
    """First-order steps of mean squared error; ends early where it is no longer finite."""
    shared = torch.zeros(problem.shared_size, dtype=torch.float64, requires_grad=True)
    local = torch.zeros(len(start[-1]), 6, dtype=torch.float64, requires_grad=True)
    optimizer = METHODS[method]([shared, local], lr=rate)
    by_shared, by_local = units(problem, start) if scaled else (torch.ones(()).double(), torch.ones(()).double())
    costs, ticks, begin = [], [], clock()
    best, state = math.inf, start
    for _ in range(steps + 1):
        optimizer.zero_grad()
        here = problem.retract(start, (shared * by_shared, local * by_local))
        cost = problem.cost(here)
        costs.append(cost.detach())
        if float(costs[-1]) < best:
            best, state = float(costs[-1]), tuple(value.detach() for value in here)
        ticks.append(clock() - begin)
        if not bool(cost.isfinite()) or len(costs) > steps:
            break
        (4.0 * cost / problem.residual_count).backward()
        optimizer.step()
    return Run(rms_of(problem, torch.stack(costs)), np.array(ticks), state, rate)


def best_rate(problem: Problem, start: Any, method: str, scaled: bool, steps: int, rates: Sequence[float]) -> float:
    """The learning rate whose short run ends lowest; divergence counts as infinite."""
    tried = [descend(problem, start, method, rate, scaled, max(1, int(TRIAL * steps))) for rate in rates]
    return rates[int(np.argmin([np.nan_to_num(run.rms[-1], nan=np.inf) for run in tried]))]


@contextlib.contextmanager
def drawn(path: Path, width: float, height: float) -> Iterator[Figure]:
    """A figure with one legend above it, which is then saved."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    yield figure
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=9)
    figure.savefig(path, dpi=90)


def draw(runs: dict[int, dict[str, Run]], figure: Figure) -> None:
    grid = figure.subplots(len(runs), 2, squeeze=False)
    for row, (coefficients, of) in zip(grid, runs.items(), strict=True):
        for axes, by_time in zip(row, (False, True), strict=True):
            for name, run in of.items():
                color = next(c for key, c in COLORS.items() if name.startswith(key))
                along = 1e3 * run.seconds if by_time else np.arange(len(run.rms))
                style = "--" if name.endswith("scaled") else "-"
                axes.plot(along[1:], run.rms[1:], style, color=color, label=name, linewidth=1.8)
            axes.set(
                xscale="log",
                yscale="log",
                ylabel="RMS, px",
                title=f"{coefficients} coefficients, {DESCENDED} views",
            )
            axes.set_xlabel("time, ms (one thread)" if by_time else "step")
            axes.grid(True, which="major", alpha=0.3)


def rows_of(coefficients: int, runs: dict[str, Run]) -> Iterator[list[object]]:
    bottom = float(runs[LM].rms[-1])
    for name, run in runs.items():
        reached = np.flatnonzero(run.rms <= 1.01 * bottom)
        near = f"{reached[0]} ({1e3 * run.seconds[reached[0]]:.0f} ms)" if len(reached) else "never"
        yield [
            coefficients, name, len(run.rms) - 1, f"{run.seconds[-1]:.2f}", f"{run.rms[-1]:.4f}",
            f"{run.rms[-1] / bottom:.2f}", near,
        ]  # fmt: skip


@section("solver.md", "first-order methods", coefficients=(5,), steps=2)
def first_order(
    coefficients: tuple[int, ...] = (5, 14), steps: int = 1500, picture: Path | None = None
) -> Iterator[str]:
    """`picture`: draw RMS over steps and time into this file."""
    runs: dict[int, dict[str, Run]] = {}
    for count in coefficients:
        problem, start = set_up(count)
        levenberg_marquardt(problem, start)  # what is compiled or cached at the first call counts for nobody
        runs[count] = {LM: levenberg_marquardt(problem, start)}
        for method, scaled in itertools.product(METHODS, (False, True)):
            name = f"{method}, scaled" if scaled else method
            rate = best_rate(problem, start, method, scaled, steps, RATES)
            runs[count][name] = descend(problem, start, method, rate, scaled, steps)
    if picture:
        with drawn(picture, 11, 4.2 * len(runs)) as figure:
            draw(runs, figure)
    heads = ["coefficients", "method", "steps", "s", "RMS px", "over the lowest", "within 1 %"]
    return table(heads, (cells for count, of in runs.items() for cells in rows_of(count, of)))


COUNTS, REPEATS, STEP = (30, 200, 800), 3, 1e-3
LENSES = {
    "5": CalibrationOptions(model=MODELS[5]), "14": CalibrationOptions(model=MODELS[14]),
    "default": CalibrationOptions(),
}  # fmt: skip
MOST_DEFAULT = 200  # views


def timed(call: Callable[[], object]) -> float:
    """Median of the CPU seconds of some calls."""
    return statistics.median(times([call], REPEATS, time.process_time)[0])


def linear_gradient(found: CalibratedViews, pixels: Tensor, board: Tensor, options: CalibrationOptions) -> Tensor:
    """What Gauss and Newton's matrix in place of the Hessian makes of the derivative of fx by the corners."""
    free = options.constraints(found.size).free_parameters(found.model)
    problem = BoardProblem(board, pixels, found.model, free)
    rows, size = problem.rows(found.state()), len(free)
    whole = rows.new_zeros(size + 6 * len(rows), len(rows), rows.shape[-1])
    whole[:size] = rows[:, 6:-1].transpose(0, 1)
    for view in range(len(rows)):
        whole[size + 6 * view : size + 6 * view + 6, view] = rows[view, :6]
    flat = whole.flatten(1)
    scale = flat.norm(dim=1, keepdim=True)
    gradient = torch.linalg.lstsq((flat / scale).T, torch.eye(flat.shape[1], dtype=flat.dtype)).solution[0]
    return (gradient / scale[0]).unflatten(0, (len(rows), 2, -1)).transpose(-1, -2)


def study_gradients(views: int, lens: str) -> list[object]:
    """A row of the table."""
    drawn = simulate(views)
    board, pixels = torch.from_numpy(drawn["board"]), torch.from_numpy(drawn["pixels"])
    options = LENSES[lens]
    first = calibrate_views(pixels, board, SIZE, options, backward="none")
    again = pixels.clone().requires_grad_(True)
    found = calibrate_views(again, board, SIZE, options, start=first)
    (exact,) = torch.autograd.grad(found.parameters[0], again, retain_graph=True)

    generator = torch.Generator().manual_seed(views)
    along = torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
    ends = [
        calibrate_views(pixels + sign * STEP * along, board, SIZE, options, start=first, backward="none").parameters[0]
        for sign in (1.0, -1.0)
    ]
    resolved = float(ends[0] - ends[1]) / (2.0 * STEP)
    error = abs(float((exact * along).sum()) - resolved) / abs(resolved)
    linear = "-"
    if lens == "5" and views == COUNTS[0]:
        off = linear_gradient(first, pixels, board, options) - exact
        linear = f"{100.0 * float(off.norm() / exact.norm()):.2f} %"
    cells = (
        timed(lambda: calibrate_views(pixels, board, SIZE, options, backward="none")),
        timed(lambda: calibrate_views(again, board, SIZE, options, start=first)),
        timed(lambda: torch.autograd.grad(found.parameters[0], again, retain_graph=True)),
    )
    return [views, lens, *(f"{value:.3f}" for value in cells), f"{error:.1e}", linear]


@section("solver.md", "gradients", most=COUNTS[0], lenses=("5",))
def gradients(most: int = COUNTS[-1], lenses: tuple[str, ...] = tuple(LENSES)) -> Lines:
    heads = ["views", "lens", "from nothing, s", "again, s", "gradient, s", "error", "Gauss-Newton"]
    wanted = [(n, lens) for n in COUNTS if n <= most for lens in lenses if lens != "default" or n <= MOST_DEFAULT]
    return table(heads, (study_gradients(n, lens) for n, lens in wanted))


VIEWS = 30
# The middle, half way to a corner, and near two corners.
PLACES = ((960.0, 540.0), (1440.0, 810.0), (100.0, 80.0), (1820.0, 100.0))
ELLIPSE = -2.0 * math.log(0.05)  # the 95 % quantile of χ² with two degrees of freedom
MEDIAN = 0.674490  # of |x| of a normal variable
# Of each model; mild enough to be regular all over the image.
LENS = (-0.25, 0.08, 5e-4, -3e-4, -0.02, 0.03, -0.01, 0.003, 4e-4, -2e-4, -3e-4, 2e-4, 0.004, -0.003)


class Fit(NamedTuple):
    """One capture: errors of fx, cx, of the places and of the places after the best rotation, with covariances.

    Args:
        parameters: (2,) fx and cx.
        variances: (2,).
        errors: (2, P, 2) pixels, as they are and turned; infinite where the camera has no image of the place.
        covariances: (2, P, 2, 2).
        warned: whether anything was said about the model.
    """

    parameters: Tensor
    variances: Tensor
    errors: Tensor
    covariances: Tensor
    warned: bool


def refit(pixels: Tensor, options: CalibrationOptions, truth: Camera, rays: Tensor) -> Fit:
    """Calibrate one capture; `rays` (P + G, 3) are those of the places, then of a grid over the image."""
    # Some corners of the benchmark's poses are outside the image of this lens.
    pixels = torch.where(truth.inside(pixels)[..., None], pixels, torch.nan)
    result = calibrate_camera(observed(pixels.tolist()), options)
    wanted, _ = truth.project(rays)
    names, model = list(range(len(result.camera.names))), result.camera.model
    seen = project_components(rays.T, result.camera.params, model, names)
    regular = seen.regular[:, None]
    error = torch.where(regular, seen.pixels.T - wanted.detach(), 0.0)
    by_lens = seen.by_camera.movedim(-1, 0).transpose(-1, -2).flatten(1)
    by_lens = torch.where(regular, by_lens, 0.0).unflatten(1, (2, -1))
    turns = torch.where(regular, step_rows(seen.by_point, rays.T)[:3].movedim(-1, 0).transpose(-1, -2).flatten(1), 0.0)
    turns = turns.unflatten(1, (2, 3))
    # The turn of the camera that brings the grid closest, and how it follows the parameters.
    grid = turns[len(PLACES) :].flatten(0, 1)
    target = torch.cat([error[..., None], by_lens], -1)[len(PLACES) :].flatten(0, 1)
    turned = torch.cat([error[..., None], by_lens], -1) - turns @ torch.linalg.lstsq(grid, target).solution
    slopes = torch.stack([by_lens, turned[..., 1:]])[:, : len(PLACES)]
    errors = torch.stack([error, turned[..., 0]])[:, : len(PLACES)]
    return Fit(
        result.camera.params[[0, 2]],
        result.covariance.diagonal()[[0, 2]],
        torch.where(regular[: len(PLACES)], errors, torch.inf),
        slopes @ result.covariance @ slopes.transpose(-1, -2),
        any("farther off than noise" not in text for text in result.warnings),
    )


def study(coefficients: int, weak: float | None, refits: int) -> list[object]:
    """The row of one model."""
    model = LensModel.named(MODELS[coefficients])
    truth = Camera.build(
        focal=(1600, 1600), center=(963, 536), size=SIZE, coefficients=LENS[:coefficients], model=model
    )
    places = torch.cat([torch.tensor(PLACES, dtype=torch.float64), truth.grid(16, 9).reshape(-1, 2)])
    rays, valid = truth.unproject(places)
    assert bool(valid.all()), "a place that the true lens does not see"
    # The poses of the benchmark's views; what its lens shows of them is not used.
    drawn = simulate(VIEWS)
    board = torch.from_numpy(drawn["board"])
    rotation, translation = torch.from_numpy(drawn["rotation"]), torch.from_numpy(drawn["translation"])
    clean, valid = truth.project(board @ rotation.transpose(-1, -2) + translation[:, None])
    assert bool(valid.all()), "a corner that the true lens does not see"
    generator = torch.Generator().manual_seed(1000 + coefficients)
    options = CalibrationOptions(model=model, weak_prior=weak)
    fits = []
    for _ in range(refits):
        noise = NOISE * torch.randn(clean.shape, generator=generator, dtype=torch.float64)
        fits.append(refit(clean + noise, options, truth, rays))
    found = torch.stack([fit.parameters for fit in fits]) - torch.cat([truth.focal[:1], truth.center[:1]])
    variances = torch.stack([fit.variances for fit in fits])
    errors, covariances = torch.stack([fit.errors for fit in fits]), torch.stack([fit.covariances for fit in fits])
    named = f"{coefficients}{', weak prior' if weak else ''}"
    focal, center = (ratios(found[:, k, None], variances[:, k, None]) for k in (0, 1))
    inside = torch.zeros(2, len(fits), len(PLACES), dtype=torch.bool)
    for turned in (0, 1):
        for k in range(len(PLACES)):
            error, spread = errors[:, turned, k], covariances[:, turned, k]
            seen = torch.isfinite(error).all(-1)
            distance = (error[seen] * torch.linalg.solve(spread[seen], error[seen])).sum(-1)
            inside[turned, seen, k] = distance < ELLIPSE
    last = errors[:, 1, -1]
    seen = torch.isfinite(last).all(-1)
    corner = ratios(last[seen], covariances[seen, 1, -1].diagonal(dim1=-2, dim2=-1))
    warned = torch.tensor([fit.warned for fit in fits])
    shares = [
        f"{100.0 * float(part.double().mean()):.1f}" if len(part) else "-"
        for part in (inside[0], inside[1], inside[0][~warned], inside[1][~warned])
    ]
    cells = [f"{center[0]:.3f}", f"{center[1]:.2f}", f"{focal[1]:.2f}", f"{corner[2]:.2f}"]
    return [named, *cells, *shares[:2], int(warned.sum()), *shares[2:]]


def ratios(error: Tensor, variance: Tensor) -> tuple[float, float, float]:
    """RMS error over captures and axes, the predicted σ over it, and the same of medians; of (captures, axes)."""
    predicted, repeated = float(variance.mean().sqrt()), float(error.square().mean().sqrt())
    usual = MEDIAN * float((variance.median(0).values.mean() / error.square().median(0).values.mean()).sqrt())
    return repeated, predicted / repeated, usual


@section("solver.md", "predicted and repeated", refits=3, coefficients=(5,))
def predicted_and_repeated(refits: int = 300, coefficients: tuple[int, ...] = (5, 8, 14)) -> Lines:
    heads = ["coefficients", "cx: error, px", "cx: σ / error", "fx: σ / error"]
    heads += ["corner of the image, turned: σ / error, medians", "in 95 %, %", "turned, %", "warned of"]
    heads += ["the others: in 95 %, %", "turned, %"]
    cases = ((count, weak) for count in coefficients for weak in ((None,) if count == 5 else (None, WEAK)))
    return table(heads, (study(count, weak, refits) for count, weak in cases))


LADDER = {5: "opencv5", 8: "opencv8", 12: "opencv12", 14: "opencv14", 16: "ext16", 18: "ext18", 20: "ext20"} | {
    22: "ext22", 24: "ext24"
}  # fmt: skip
SETS = ("left", "right", "wide")


# Relative, of the RMS: what counts as not rising.
SAME_RMS = 1e-6


def real_sets(names: tuple[str, ...]) -> Iterator[tuple[str, Observations]]:
    """The real views by name: both cameras of OpenCV's sample, and a very wide lens."""
    for name in names:
        seen = load("wide").seen if name == "wide" else stereo_images(name)
        yield name, seen


@section("solver.md", "richer models", sets=("left",), most=8)
def ladder(sets: tuple[str, ...] = SETS, most: int = 24) -> Iterator[str]:
    """RMS over the models, rises marked."""
    models = [count for count in LADDER if count <= most]

    def rows() -> Iterator[list[str]]:
        for name, seen in real_sets(sets):
            cells, rises, before = [], [], np.inf
            for coefficients in models:
                options = CalibrationOptions(model=LADDER[coefficients], weighted=False, weak_prior=None)
                result = calibrate_camera(seen, options)
                mark = {SolverStatus.AT_BOUND: "ᵇ", SolverStatus.FLAT: "ᶠ"}.get(result.status, "")
                cells.append(f"{result.rms:.6f}{mark}")
                if result.rms > before * (1 + SAME_RMS):
                    rises.append(f"{coefficients}: {result.rms / before - 1:+.1e}")
                before = min(before, result.rms)
            yield [name, *cells, ", ".join(rises) or "none"]

    return table(["views", *models, "rises"], rows())
