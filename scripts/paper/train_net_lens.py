"""Calibration with a pure network lens by gradient descent, Adam and Levenberg-Marquardt.

The paper (Section 4.3.1, Fig. 5) put a network of four layers in the place of the distortion vector, trained it with
Adam, and found that it diverges. Here gradient descent, Adam and Levenberg-Marquardt get the same residuals, views,
starts and exact gradients, with the network as in the figure and with a skip connection. First-order methods take steps
in units of the columns of the Jacobian at the start (as `scripts/check/first_order.py` does, where that helps most),
with the best of many learning rates. Each lens is then judged on views that it has not seen, whose poses alone are
solved.
"""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from torch import Tensor

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.hybrid.base_fit import fit_projection
from kcal.calibrate.problem.views import Views, poses_under
from kcal.solve.lm import LMOptions, State, minimize
from scripts.paper.pure_lens import PureLensNet, PureLensProblem, train_pure_lens
from scripts.shared.page import Lines
from scripts.shared.sections import section
from scripts.shared.timing import median, spread
from scripts.shared.views import NOISE, SIZE, observed, simulate

# Half the image's width in focal lengths, a little more.
REACH = 0.65
RATES = [10.0**e for e in range(-4, 6)]
TRIAL = 0.1
METHODS = {"gradient descent": torch.optim.SGD, "Adam": torch.optim.Adam}
LM = "Levenberg-Marquardt"


class Run(NamedTuple):
    """RMS (pixels) after each step, the start first; CPU seconds; and the last state."""

    rms: np.ndarray
    seconds: float
    state: State
    rate: float | None = None


def rms_of(problem: PureLensProblem, cost: Tensor) -> np.ndarray:
    return torch.sqrt(4.0 * cost / problem.residual_count).numpy()


def by_lm(lens: PureLensNet, board: Tensor, pixels: Tensor, poses: tuple[Tensor, Tensor], most: int) -> Run:
    clock = time.process_time()
    result = train_pure_lens(lens, board, pixels, poses, LMOptions(max_iterations=most, tolerance=1e-9))
    return Run(rms_of(PureLensProblem(board, pixels, lens), result.history), time.process_time() - clock, result.state)


def descend(problem: PureLensProblem, start: State, method: str, rate: float, steps: int) -> Run:
    """First-order steps of mean squared error, in units of the Jacobian's columns at the start."""
    length = torch.linalg.vector_norm(problem.rows(start), dim=-1)
    by_local = 1.0 / length[:, :6]
    by_shared = 1.0 / torch.linalg.vector_norm(length[:, 6:-1], dim=0).clamp_min(1e-9)
    shared = torch.zeros(problem.shared_size, dtype=torch.float64, requires_grad=True)
    local = torch.zeros(len(start[-1]), 6, dtype=torch.float64, requires_grad=True)
    optimizer = METHODS[method]([shared, local], lr=rate)
    costs, clock = [], time.process_time()
    best, state = math.inf, start
    for _ in range(steps + 1):
        optimizer.zero_grad()
        here = problem.retract(start, (shared * by_shared, local * by_local))
        cost = problem.cost(here)
        costs.append(cost.detach())
        if not bool(cost.isfinite()):
            break
        if float(cost.detach()) < best:
            best, state = float(cost.detach()), tuple(value.detach() for value in here)
        if len(costs) <= steps:
            (4.0 * cost / problem.residual_count).backward()
            optimizer.step()
    return Run(rms_of(problem, torch.stack(costs)), time.process_time() - clock, state, rate)


def best_rate(problem: PureLensProblem, start: State, method: str, steps: int) -> float:
    """The learning rate whose short run ends lowest; divergence counts as infinite."""
    tried = [descend(problem, start, method, rate, max(1, int(TRIAL * steps))) for rate in RATES]
    ends = [float(np.nan_to_num(run.rms[-1], nan=np.inf)) for run in tried]
    return RATES[int(np.argmin(ends))]


def held_out(board: Tensor, pixels: Tensor, lens: PureLensNet, state: State, poses: tuple[Tensor, Tensor]) -> float:
    """RMS on other views, the lens held and their poses solved, from the true ones."""
    with torch.no_grad():
        lens.weights.copy_(state[0])
        lens.intrinsics.copy_(state[1])
    # Each view by itself: one that goes wrong must not decide about the damping of the others.
    total = 0.0
    for view, rotation, translation in zip(pixels, *poses, strict=True):
        problem = PureLensProblem(board, view[None], lens, fixed=True)
        start = problem.start(rotation[None], translation[None])
        total += float(minimize(problem, start, LMOptions(max_iterations=100)).cost)
    return math.sqrt(4.0 * total / pixels.numel())


def reference(board: Tensor, pixels: Tensor, others: Tensor) -> list[str]:
    """What the formula of 14 coefficients makes of the same views."""
    observations = observed(pixels.tolist())
    clock = time.process_time()
    result = calibrate_camera(observations, CalibrationOptions(model="opencv14"))
    seconds = time.process_time() - clock
    views = Views(board_points=board, pixels=others)
    poses, _ = poses_under(result.camera, views, LMOptions(max_iterations=100))
    points = board @ poses.rotation.transpose(-1, -2) + poses.translation[:, None]
    error = (result.camera.project(points)[0] - others).norm(dim=-1).square().mean().sqrt()
    return ["14 coefficients", LM, "", f"{seconds:.1f}", f"{result.rms:.4f}", f"{error:.4f}"]


def draw(runs: dict[str, dict[str, list[Run]]], path: Path) -> None:
    figure = Figure(figsize=(11, 4.4), layout="constrained")
    FigureCanvasAgg(figure)
    colors = {LM: "#111111", "gradient descent": "#1f77b4", "Adam": "#d62728"}
    for axes, (form, of) in zip(figure.subplots(1, 2, sharey=True), runs.items(), strict=True):
        for method, repeats in of.items():
            for i, run in enumerate(repeats):
                label = method if i == 0 else None
                steps = np.arange(1, len(run.rms) + 1)
                axes.plot(steps, run.rms, color=colors[method], label=label, linewidth=1.4, alpha=0.8)
        axes.axhline(NOISE * math.sqrt(2), color="#2ca02c", linestyle=":", label="noise of the corners")
        axes.set(xscale="log", yscale="log", xlabel="step (the start is 1)", title=f"network {form}")
        axes.grid(True, which="major", alpha=0.3)
    figure.axes[0].set_ylabel("RMS on the training views, px")
    handles, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), fontsize=9)
    figure.savefig(path, dpi=90)


@section("paper.md", "net lens", steps=1, lm_steps=3, seeds=1, views=4)
def net_lens(
    steps: int = 2000, lm_steps: int = 1000, seeds: int = 3, views: int = 20, picture: Path | None = None
) -> Lines:
    """`views`: fitted, and as many held out. `picture`: draw RMS over steps into this file."""
    data, more = simulate(views), simulate(views, seed=1000)
    board, pixels, others = (torch.from_numpy(a) for a in (data["board"], data["pixels"], more["pixels"]))
    true_poses = torch.from_numpy(more["rotation"]), torch.from_numpy(more["translation"])
    base = fit_projection(board, pixels, SIZE, torch.ones_like(pixels[..., 0])).state
    intrinsics, poses = base.parameters[:4], (base.rotation, base.translation)
    yield ["network", "method", "learning rate", "CPU s", "RMS px", "held-out RMS px"]
    yield reference(board, pixels, others)
    runs: dict[str, dict[str, list[Run]]] = {}
    for form, skip in (("as in the figure", False), ("with a skip", True)):
        runs[form] = {}
        for method in (*METHODS, LM):
            repeats, outside = [], []
            rate: float | None = None
            for seed in range(seeds):
                lens = PureLensNet(intrinsics, reach=REACH, skip=skip, seed=seed)
                problem = PureLensProblem(board, pixels, lens)
                start = problem.start(*poses)
                if method == LM:
                    repeats.append(by_lm(lens, board, pixels, poses, lm_steps))
                else:
                    rate = best_rate(problem, start, method, steps) if rate is None else rate
                    repeats.append(descend(problem, start, method, rate, steps))
                outside.append(held_out(board, others, lens, repeats[-1].state, true_poses))
            runs[form][method] = repeats
            yield [
                form, method, "" if rate is None else f"{rate:.0e}", median([run.seconds for run in repeats]),
                spread([float(np.nanmin(run.rms)) for run in repeats], 4), spread(outside, 4),
            ]  # fmt: skip
    if picture:
        draw(runs, picture)
