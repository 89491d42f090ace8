"""Calibration with a pure network lens by gradient descent, Adam and Levenberg-Marquardt.

The paper (Section 4.3.1, Fig. 5) put a network of four layers in the place of the distortion vector, trained it with
Adam, and found that it diverges. Here gradient descent, Adam and Levenberg-Marquardt get the same residuals, views,
starts and exact gradients, with the network as in the figure and with a skip connection. First-order methods take steps
in units of the columns of the Jacobian at the start (as `scripts/check/uncertainty.py` does, where that helps most),
with the best of many learning rates. Each lens is then judged on views that it has not seen, whose poses alone are
solved.
"""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.hybrid.base_fit import fit_projection
from kcal.calibrate.problem.views import Views, poses_under
from kcal.solve.lm import LMOptions, State, minimize
from scripts.check.uncertainty import COLORS, LM, METHODS, Run, best_rate, descend, drawn, rms_of
from scripts.paper.pure_lens import PureLensNet, PureLensProblem, train_pure_lens
from scripts.shared.page import Lines, median, section, spread, timed
from scripts.shared.views import NOISE, SIZE, observed, simulate

# Half the image's width in focal lengths, a little more.
REACH = 0.65
RATES = [10.0**e for e in range(-4, 6)]


def by_lm(lens: PureLensNet, board: Tensor, pixels: Tensor, poses: tuple[Tensor, Tensor], most: int) -> Run:
    options = LMOptions(max_iterations=most, tolerance=1e-9)
    result, seconds = timed(train_pure_lens, lens, board, pixels, poses, options)
    return Run(rms_of(PureLensProblem(board, pixels, lens), result.history), np.array([seconds]), result.state)


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
    options = CalibrationOptions(model="opencv14")
    result, seconds = timed(calibrate_camera, observed(pixels.tolist()), options)
    views = Views(board_points=board, pixels=others)
    poses, _ = poses_under(result.camera, views, LMOptions(max_iterations=100))
    points = board @ poses.rotation.transpose(-1, -2) + poses.translation[:, None]
    error = (result.camera.project(points)[0] - others).norm(dim=-1).square().mean().sqrt()
    return ["14 coefficients", LM, "", f"{seconds:.1f}", f"{result.rms:.4f}", f"{error:.4f}"]


def draw(runs: dict[str, dict[str, list[Run]]], figure: Figure) -> None:
    for axes, (form, of) in zip(figure.subplots(1, 2, sharey=True), runs.items(), strict=True):
        for method, repeats in of.items():
            for i, run in enumerate(repeats):
                label = method if i == 0 else None
                steps = np.arange(1, len(run.rms) + 1)
                axes.plot(steps, run.rms, color=COLORS[method], label=label, linewidth=1.4, alpha=0.8)
        axes.axhline(NOISE * math.sqrt(2), color="#2ca02c", linestyle=":", label="noise of the corners")
        axes.set(xscale="log", yscale="log", xlabel="step (the start is 1)", title=f"network {form}")
        axes.grid(True, which="major", alpha=0.3)
    figure.axes[0].set_ylabel("RMS on the training views, px")


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
                    rate = best_rate(problem, start, method, True, steps, RATES) if rate is None else rate
                    repeats.append(descend(problem, start, method, rate, True, steps, time.process_time))
                outside.append(held_out(board, others, lens, repeats[-1].state, true_poses))
            runs[form][method] = repeats
            yield [
                form, method, "" if rate is None else f"{rate:.0e}", median([run.seconds[-1] for run in repeats]),
                spread([float(np.nanmin(run.rms)) for run in repeats], 4), spread(outside, 4),
            ]  # fmt: skip
    if picture:
        with drawn(picture, 11, 4.4) as figure:
            draw(runs, figure)
