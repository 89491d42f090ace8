"""Gradient descent and Adam on a calibration problem, beside Levenberg-Marquardt.

The paper (Section 4.3.1) found that first-order optimizers fail on camera calibration. Here all three get the same
residuals, the same start (base projection, no distortion) and exact gradients. The first-order methods run twice: on
the parameters as they are (pixels, radians, meters, coefficients), and on parameters scaled by the columns of the
Jacobian at the start, as Levenberg-Marquardt scales them. Each gets the best of many learning rates, judged by short
runs.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from kcal.calibrate.hybrid.base_fit import fit_projection
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import free_parameters
from kcal.lens.model import LensModel
from kcal.lens.projection import INTRINSICS
from kcal.solve.lm import LMOptions, minimize
from scripts.shared.page import table
from scripts.shared.sections import section
from scripts.shared.views import MODELS, SIZE, simulate

VIEWS = 15
RATES = [10.0**e for e in range(-8, 5)]
# Share of the steps that each learning rate gets on trial.
TRIAL = 0.1
METHODS = {"gradient descent": torch.optim.SGD, "Adam": torch.optim.Adam}


class Run(NamedTuple):
    """RMS (pixels) after each step, the start first, and the seconds since the start."""

    rms: np.ndarray
    seconds: np.ndarray
    rate: float | None = None


def set_up(coefficients: int) -> tuple[BoardProblem, BoardState]:
    """The simulated views, and the start that all methods share."""
    data = simulate(VIEWS)
    board, pixels = torch.from_numpy(data["board"]), torch.from_numpy(data["pixels"])
    model = LensModel.named(MODELS[coefficients])
    base = fit_projection(board, pixels, SIZE, torch.ones_like(pixels[..., 0])).state
    parameters = torch.zeros(len(INTRINSICS) + model.size, dtype=torch.float64)
    parameters[:4] = base.parameters[:4]
    problem = BoardProblem(board, pixels, model, free_parameters(model))
    return problem, BoardState.flat(parameters, base.rotation, base.translation)


def rms_of(problem: BoardProblem, cost: Tensor) -> np.ndarray:
    return torch.sqrt(4.0 * cost / problem.residual_count).numpy()


def levenberg_marquardt(problem: BoardProblem, start: BoardState) -> Run:
    clock, ticks = time.perf_counter(), [0.0]

    def tick(_: int, __: Tensor) -> None:
        ticks.append(time.perf_counter() - clock)

    result = minimize(problem, start, LMOptions(max_iterations=1000), tick)
    return Run(rms_of(problem, result.history), np.array(ticks))


def units(problem: BoardProblem, start: BoardState) -> tuple[Tensor, Tensor]:
    """One over the length of each column of the Jacobian: of the shared parameters, and of each pose."""
    length = torch.linalg.vector_norm(problem.rows(start), dim=-1)
    shared = torch.linalg.vector_norm(length[:, 6:-1], dim=0)
    return 1.0 / shared.clamp_min(1e-12), 1.0 / length[:, :6]


def descend(problem: BoardProblem, start: BoardState, method: str, rate: float, scaled: bool, steps: int) -> Run:
    """First-order steps of mean squared error; ends early where it is no longer finite."""
    shared = torch.zeros(problem.shared_size, dtype=torch.float64, requires_grad=True)
    local = torch.zeros(len(start.translation), 6, dtype=torch.float64, requires_grad=True)
    optimizer = METHODS[method]([shared, local], lr=rate)
    by_shared, by_local = units(problem, start) if scaled else (torch.ones(()).double(), torch.ones(()).double())
    costs, ticks, clock = [], [], time.perf_counter()
    for _ in range(steps + 1):
        optimizer.zero_grad()
        cost = problem.cost(problem.retract(start, (shared * by_shared, local * by_local)))
        costs.append(cost.detach())
        ticks.append(time.perf_counter() - clock)
        if not bool(cost.isfinite()) or len(costs) > steps:
            break
        (4.0 * cost / problem.residual_count).backward()
        optimizer.step()
    return Run(rms_of(problem, torch.stack(costs)), np.array(ticks), rate)


def best_descent(problem: BoardProblem, start: BoardState, method: str, scaled: bool, steps: int) -> Run:
    """The learning rate whose short run ends lowest, run in full; divergence counts as infinite."""
    tried = [descend(problem, start, method, rate, scaled, max(1, int(TRIAL * steps))) for rate in RATES]
    ends = [float(np.nan_to_num(run.rms[-1], nan=np.inf)) for run in tried]
    return descend(problem, start, method, RATES[int(np.argmin(ends))], scaled, steps)


def draw(runs: dict[int, dict[str, Run]], path: Path) -> None:
    figure = Figure(figsize=(11, 4.2 * len(runs)), layout="constrained")
    FigureCanvasAgg(figure)
    grid = figure.subplots(len(runs), 2, squeeze=False)
    colors = {"Levenberg-Marquardt": "#111111", "gradient descent": "#1f77b4", "Adam": "#d62728"}
    for row, (coefficients, of) in zip(grid, runs.items(), strict=True):
        for axes, by_time in zip(row, (False, True), strict=True):
            for name, run in of.items():
                color = next(c for key, c in colors.items() if name.startswith(key))
                along = 1e3 * run.seconds if by_time else np.arange(len(run.rms))
                style = "--" if name.endswith("scaled") else "-"
                axes.plot(along[1:], run.rms[1:], style, color=color, label=name, linewidth=1.8)
            axes.set(xscale="log", yscale="log", ylabel="RMS, px", title=f"{coefficients} coefficients, {VIEWS} views")
            axes.set_xlabel("time, ms (one thread)" if by_time else "step")
            axes.grid(True, which="major", alpha=0.3)
    handles, labels = grid[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=9)
    figure.savefig(path, dpi=90)


def rows_of(coefficients: int, runs: dict[str, Run]) -> Iterator[list[object]]:
    bottom = float(runs["Levenberg-Marquardt"].rms[-1])
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
        runs[count] = {"Levenberg-Marquardt": levenberg_marquardt(problem, start)}
        for method, scaled in itertools.product(METHODS, (False, True)):
            name = f"{method}, scaled" if scaled else method
            runs[count][name] = best_descent(problem, start, method, scaled, steps)
    if picture:
        draw(runs, picture)
    heads = ["coefficients", "method", "steps", "s", "RMS px", "over the lowest", "within 1 %"]
    return table(heads, (cells for count, of in runs.items() for cells in rows_of(count, of)))
