"""The paper's training of residual nets (Eq. 12) beside joint least squares (docs/measured/paper.md).

    KCAL_DATA=... python -m scripts.paper.train_eq12 [--steps 2000] [--folds 5] [--write]

The paper adds a residual net to a calibrated model of 20 coefficients and trains it by Adam on

    MSE(y3, y3*) + λ MSE(y1, y4)                                                          (Eq. 12)

with A*, K* and the poses held: y3 are corners and y3* their projections, y1 positions before the lens and y4 what an
inverse net, trained along with it, makes of the projections. The residual of Eq. 11 gets that here, and is also fitted
jointly with warp and poses by Levenberg-Marquardt. A field as in Fig. 8 is that of the hybrid lens.

Data, splits and measure are those of `scripts/shared/wide_lens.py`: whole blocks of views held out, poses solved again.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.hybrid.fit import fit_hybrid
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.corners.observations import Observations
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.projection import from_pixels, project_components
from kcal.nets.inverse import InverseNet
from kcal.nets.mlp import evaluate
from kcal.solve.lm import LMOptions, minimize
from scripts.paper.residual_net import ResidualNet, train_residual
from scripts.shared.page import write_section
from scripts.shared.timing import row, show
from scripts.shared.wide_lens import folds, held_out, load, subset, warped

PAGE = "paper.md"
MODEL = "ext20"
# λ of Eq. 12, both errors in focal lengths.
LAMBDA = 1.0
# Adam's learning rates of the residual's weights, tried; and of the inverse net's.
RATES, INVERSE_RATE = [10.0**e for e in range(-9, 0)], 1e-2
TRIAL = 0.1
REFIT = LMOptions(max_iterations=100, tolerance=1e-10, flatness=1e-7)


class Data(NamedTuple):
    """Views of the board, and the weight (V, N) of each corner, 0 where it does not count."""

    seen: Observations
    weight: np.ndarray

    def some(self, index: np.ndarray) -> Data:
        """Some of the views."""
        return Data(subset(self.seen, index), self.weight[index])

    @property
    def whitening(self) -> Tensor:
        """(V, 1, N, 2, 2)."""
        return torch.from_numpy(self.weight)[:, None, :, None, None] * torch.eye(2, dtype=torch.float64)


class Fitted(NamedTuple):
    """A camera, the board's corners (N, 3) with it, and CPU seconds."""

    camera: Camera
    points: Tensor
    seconds: float


def judged(fitted: Fitted, data: Data) -> tuple[float, float]:
    """Sum of w² |r|² over views whose poses are solved again, and how many corners."""
    total, count = held_out(fitted.camera, fitted.points, data.seen, torch.from_numpy(data.weight))
    return total, float(count)


class Views(NamedTuple):
    """What Eq. 12 is trained on: points (3, M) in the camera, corners (2, M), weights (M,)."""

    points: Tensor
    corners: Tensor
    weight: Tensor


def views_of(data: Data, problem: BoardProblem, state: BoardState) -> Views:
    _, points = problem.points(state)
    weight = torch.from_numpy(data.weight)
    seen = weight > 0
    return Views(points.transpose(-1, -2)[seen].T, data.seen.pixels()[seen].T, weight[seen])


def eq12(
    views: Views, camera: Camera, project: Callable[[Tensor], Tensor], start: Tensor, rate: float, steps: int
) -> tuple[Tensor, float]:
    """Adam on Eq. 12 over the weights of a residual and of an inverse net: the weights, and MSE(y3, y3*) at the end.

    Args:
        views: the training data.
        camera: A* and K*.
        project: weights to pixels (2, M).
        start: weights.
        rate: of Adam for the residual.
        steps: how many.
    """
    inverse = InverseNet(camera, radial=False)
    X, Y, Z = views.points
    before = torch.stack(inverse.to_chart(X / Z, Y / Z))
    focal = camera.focal.mean()
    weights, other = start.clone().requires_grad_(), inverse.weights.detach().clone().requires_grad_()
    optimizer = torch.optim.Adam([{"params": [weights], "lr": rate}, {"params": [other], "lr": INVERSE_RATE}])
    share = views.weight / views.weight.square().mean().sqrt()
    seen = torch.zeros(())
    for _ in range(steps):
        optimizer.zero_grad()
        pixels = project(weights)
        distorted = torch.stack(from_pixels(pixels[0], pixels[1], camera.params))
        undone = distorted + evaluate(distorted, other, inverse.widths)
        seen = (share * (pixels - views.corners) / focal).square().mean()
        loss = seen + LAMBDA * (undone - before).square().mean()
        if not bool(loss.isfinite()):
            return start, math.inf
        loss.backward()
        optimizer.step()
    return weights.detach(), float(seen.detach())


def best_rate(train: Callable[[float, int], tuple[Tensor, float]], steps: int) -> float:
    ends = [train(rate, max(1, int(TRIAL * steps)))[1] for rate in RATES]
    return RATES[int(np.argmin(ends))]


def parametric(data: Data) -> tuple[Fitted, BoardProblem, BoardState]:
    """20 coefficients, by the calibration and then to the end on the weights of the file alone."""
    clock = time.process_time()
    result = calibrate_camera(data.seen, CalibrationOptions(model=MODEL, board_warp=True))
    camera = result.camera
    free = ResidualNet(camera).corrected
    problem = BoardProblem(
        data.seen.board.points, data.seen.pixels(), camera.model, free,
        free_board=True, weights=data.whitening,
    )  # fmt: skip
    assert result.board_warp is not None
    start = BoardState.still(
        camera.params.detach(),
        result.board_warp,
        result.cam_from_board_rotation,
        result.cam_from_board_translation,
    )
    state = minimize(problem, start, REFIT).state
    camera = Camera(state.parameters, size=camera.size, model=MODEL)
    return Fitted(camera, warped(data.seen, state.board), time.process_time() - clock), problem, state


def fit_all(data: Data, steps: int, rates: dict[str, float]) -> dict[str, Fitted]:
    """Every way of training on one training set."""
    plain, problem, state = parametric(data)
    camera = plain.camera
    out = {"20 coefficients, least squares": plain}

    clock = time.process_time()
    residual = ResidualNet(camera)
    joint = train_residual(residual, problem, state, REFIT)
    out["Eq. 11 (global), joint least squares"] = Fitted(
        residual.camera(), warped(data.seen, joint.state[2]), time.process_time() - clock
    )

    views = views_of(data, problem, state)
    residual = ResidualNet(camera)

    def project(weights: Tensor) -> Tensor:
        return project_components(views.points, residual.parameters_at(weights), camera.model).pixels

    def train(rate: float, count: int) -> tuple[Tensor, float]:
        return eq12(views, camera, project, residual.weights.detach(), rate, count)

    name = "Eq. 11 (global), Adam on Eq. 12"
    if name not in rates:
        rates[name] = best_rate(train, steps)
    clock = time.process_time()
    weights, _ = train(rates[name], steps)
    seconds = time.process_time() - clock
    try:
        trained = Camera(residual.parameters_at(weights), size=camera.size, model=MODEL)
        out[name] = Fitted(trained, plain.points, seconds)
    except InputError as error:
        show([f"{name}: {error}"])

    clock = time.process_time()
    hybrid = fit_hybrid(data.seen.board.points, data.seen.pixels(), data.seen.image_size, torch.from_numpy(data.weight))
    out["hybrid lens, field by evidence"] = Fitted(hybrid.camera, hybrid.board_points, time.process_time() - clock)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--write", action="store_true", help=f"also write the section of docs/{PAGE}")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    data = Data(*load())
    every = np.arange(len(data.weight))
    sums: dict[str, list[tuple[float, float, float, float, float]]] = {}
    rates: dict[str, float] = {}
    apart = 0.0
    for out in folds("blocks20", len(every))[: arguments.folds]:
        train, test = data.some(np.setdiff1d(every, out)), data.some(out)
        found = fit_all(train, arguments.steps, rates)
        first, second, *_ = found.values()
        pixels = first.camera.grid(33, 23).reshape(-1, 2)
        rays, seen = first.camera.unproject(pixels)
        apart = max(apart, float((second.camera.project(rays)[0] - pixels).norm(dim=-1)[seen].max()))
        for name, fitted in found.items():
            sums.setdefault(name, []).append((*judged(fitted, train), *judged(fitted, test), fitted.seconds))
            s = sums[name][-1]
            print(f"  {name}: {math.sqrt(s[0] / s[1]):.4f} {math.sqrt(s[2] / s[3]):.4f} {s[4]:.1f} s", flush=True)
    tried = ", ".join(f"{rate:.0e}" for rate in rates.values())
    print(f"Learning rates: {tried}. Eq. 11 read literally and fitted jointly is {apart:.1e} px from the calibration.")
    lines = [
        "| model | folds | training RMS px | held-out RMS px | CPU s |",
        "|---|---|---|---|---|",
    ]
    for name, parts in sums.items():
        inside, count, outside, others, seconds = (list(column) for column in zip(*parts, strict=True))
        cells = (f"{math.sqrt(sum(inside) / sum(count)):.4f}", f"{math.sqrt(sum(outside) / sum(others)):.4f}")
        lines.append(row(name, len(parts), *cells, f"{float(np.median(seconds)):.1f}"))
    show(lines)
    if arguments.write:
        write_section(PAGE, "eq 12", "\n".join(lines))


if __name__ == "__main__":
    main()
