"""The paper's training of residual nets (Eq. 12) beside joint least squares, on a real wide lens; docs/hybrid.md.

    KCAL_DATA=... python scripts/train_eq12.py [--steps 2000] [--folds 5] [--write]

The paper adds a residual net to a calibrated model of 20 coefficients and trains it by Adam on

    MSE(y3, y3*) + λ MSE(y1, y4)                                                          (Eq. 12)

with A*, K* and the poses held: y3 are corners and y3* their projections, y1 positions before the lens and y4 what an
inverse net, trained along with it, makes of the projections. Both residuals get that here, the global one of Eq. 11
and a field as in Fig. 8, and both are also fitted jointly with warp and poses by Levenberg-Marquardt.

Data, splits and measure are those of `scripts/bench_hybrid.py`: whole blocks of views held out, poses solved again.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from page import write_section
from timing import row, show
from torch import Tensor

from kcal.calibrate.align import pose_alone
from kcal.calibrate.global_fit import train_global
from kcal.calibrate.mono import CalibrationOptions, calibrate_camera
from kcal.calibrate.problem import BoardProblem
from kcal.corners.board import Board
from kcal.corners.observations import Observations, View
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.lens.global_residual import GlobalResidual
from kcal.lens.hybrid import HybridCamera
from kcal.lens.inverse_net import InverseNet
from kcal.lens.net import evaluate
from kcal.lens.projection import from_pixels, project_components
from kcal.lens.residual import FieldGrid, FieldResidual, field_basis
from kcal.solve.lm import LMOptions, minimise
from kcal.solve.result import State

PAGE = "hybrid.md"
MODEL = "ext20"
# Units of the field, in half widths of the image.
WIDTHS = (1.2, 0.6, 0.3, 0.15)
# λ of Eq. 12, both errors in focal lengths.
LAMBDA = 1.0
# Adam's learning rates of the residual's weights, tried; and of the inverse net's.
RATES, INVERSE_RATE = [10.0**e for e in range(-9, 0)], 1e-2
TRIAL = 0.1
REFIT = LMOptions(max_iterations=100, tolerance=1e-10, flatness=1e-7)
POSES = LMOptions(max_iterations=60, tolerance=1e-12)


class Data(NamedTuple):
    """Board points (N, 3), corners (V, N, 2), weights (V, N) that are 0 where a corner does not count, image size."""

    board: Board
    corners: Tensor
    weight: Tensor
    size: tuple[int, int]

    def some(self, index: np.ndarray) -> Data:
        """Some of the views."""
        return self._replace(corners=self.corners[index], weight=self.weight[index])

    @property
    def pixels(self) -> Tensor:
        """(V, N, 2), NaN where a corner does not count."""
        return torch.where(self.weight[..., None] > 0, self.corners, torch.nan)

    @property
    def whitening(self) -> Tensor:
        """(V, 1, N, 2, 2)."""
        return self.weight[:, None, :, None, None] * torch.eye(2, dtype=torch.float64)


class Fitted(NamedTuple):
    """A camera, the board's warp with it, and what training came to."""

    camera: Camera
    warp: Tensor
    seconds: float


def load() -> Data:
    folder = os.environ.get("KCAL_DATA")
    if not folder:
        raise SystemExit("set KCAL_DATA to the folder that holds wide_lens_corners.npz")
    with np.load(Path(folder, "wide_lens_corners.npz")) as file:
        columns, rows = (int(n) for n in file["board_size"])
        width, height = (int(n) for n in file["image_size"])
        board = Board(columns=columns, rows=rows, square=float(file["square_m"]))
        weight = torch.from_numpy(np.maximum(file["weight"], 0.0)).double()
        return Data(board, torch.from_numpy(file["corners"]).double(), weight, (width, height))


def folds(views: int) -> list[np.ndarray]:
    """20 contiguous blocks of views, shuffled with seed 0, dealt to 5 folds."""
    blocks = np.array_split(np.arange(views), 20)
    order = np.random.default_rng(0).permutation(len(blocks))
    return [np.sort(np.concatenate([blocks[i] for i in order[k::5]])) for k in range(5)]


def observations(data: Data) -> Observations:
    views = []
    for i, (points, weights) in enumerate(zip(data.corners.tolist(), data.weight.tolist(), strict=True)):
        pixels = tuple(tuple(p) if w > 0 else None for p, w in zip(points, weights, strict=True))
        covariance = tuple((1 / w**2, 0.0, 1 / w**2) if w > 0 else None for w in weights)
        views.append(View(name=f"{i:03d}", pixels=pixels, covariance=covariance))
    return Observations(board=data.board, image_size=data.size, views=tuple(views))


def board_state(parameters: Tensor, warp: Tensor, rotation: Tensor, translation: Tensor) -> State:
    none = torch.zeros(0, 3, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.float64)
    return (parameters, warp, *none, rotation, translation)


def held_out(fitted: Fitted, data: Data) -> tuple[float, float]:
    """Sum of w² |r|² over views whose poses are solved again, and how many corners."""
    camera, count = fitted.camera, len(data.corners)
    alone, _ = pose_alone(data.board.points, data.pixels, camera, POSES)
    problem = BoardProblem(
        data.board.points, data.pixels[:, None, None], [camera.model], [()],
        whitening=data.whitening[:, None], fields=[camera.field], batch=(count,),
    )  # fmt: skip
    parameters, *shared, rotation, translation = board_state(
        camera.parameters_vector.detach(), fitted.warp, alone.rotation, alone.translation
    )
    start = (*(t.expand(count, *t.shape) for t in (parameters, *shared)), rotation[:, None], translation[:, None])
    cost = minimise(problem, start, POSES).cost
    return 2.0 * float(torch.nan_to_num(cost, nan=math.inf).sum()), float((data.weight > 0).sum())


class Views(NamedTuple):
    """What Eq. 12 is trained on: points (3, M) in the camera, corners (2, M), weights (M,)."""

    points: Tensor
    corners: Tensor
    weight: Tensor


def views_of(data: Data, problem: BoardProblem, state: State) -> Views:
    _, points = problem.points(problem.unpack(state))
    seen = data.weight > 0
    return Views(points.transpose(-1, -2)[seen].T, data.corners[seen].T, data.weight[seen])


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
    optimiser = torch.optim.Adam([{"params": [weights], "lr": rate}, {"params": [other], "lr": INVERSE_RATE}])
    share = views.weight / views.weight.square().mean().sqrt()
    seen = torch.zeros(())
    for _ in range(steps):
        optimiser.zero_grad()
        pixels = project(weights)
        distorted = torch.stack(from_pixels(pixels[0], pixels[1], camera.parameters_vector))
        undone = distorted + evaluate(distorted, other, inverse.widths)
        seen = (share * (pixels - views.corners) / focal).square().mean()
        loss = seen + LAMBDA * (undone - before).square().mean()
        if not bool(loss.isfinite()):
            return start, math.inf
        loss.backward()
        optimiser.step()
    return weights.detach(), float(seen.detach())


def best_rate(train: Callable[[float, int], tuple[Tensor, float]], steps: int) -> float:
    ends = [train(rate, max(1, int(TRIAL * steps)))[1] for rate in RATES]
    return RATES[int(np.argmin(ends))]


def parametric(data: Data) -> tuple[Fitted, BoardProblem, State]:
    """20 coefficients, by the calibration and then to the end on the weights of the file alone."""
    clock = time.process_time()
    result = calibrate_camera(observations(data), CalibrationOptions(model=MODEL, board_warp=True))
    camera = result.camera
    free = GlobalResidual(camera).corrected
    problem = BoardProblem(
        data.board.points, data.pixels[:, None], [camera.model], [free], free_warp=True, whitening=data.whitening
    )
    assert result.board_warp is not None
    start = board_state(
        camera.parameters_vector.detach(),
        result.board_warp,
        result.cam_from_board_rotation,
        result.cam_from_board_translation,
    )
    state = minimise(problem, start, REFIT).state
    camera = Camera(state[0], size=data.size, model=MODEL)
    return Fitted(camera, state[1], time.process_time() - clock), problem, state


def fit_all(data: Data, steps: int, rates: dict[str, float]) -> dict[str, Fitted]:
    """Every way of training on one training set."""
    plain, problem, state = parametric(data)
    camera, warp = plain.camera, plain.warp
    out = {"20 coefficients, least squares": plain}

    clock = time.process_time()
    residual = GlobalResidual(camera)
    result = train_global(problem, state, residual, REFIT)
    out["Eq. 11 (global), joint least squares"] = Fitted(
        residual.camera(), result.state[2], time.process_time() - clock
    )

    views = views_of(data, problem, state)
    residual = GlobalResidual(camera)

    def by_global(weights: Tensor) -> Tensor:
        return project_components(views.points, residual.parameters_at(weights), camera.model).pixels

    still = project_components(views.points, camera.parameters_vector, camera.model).pixels
    x, y = from_pixels(still[0], still[1], camera.parameters_vector)
    half = 0.5 * data.size[0] / float(camera.focal[0])
    grid = FieldGrid.covering(
        (float(x.min()), float(y.min())), (float(x.max()), float(y.max())), [width * half for width in WIDTHS]
    )
    basis, focal = field_basis(x, y, grid), camera.focal[:, None]

    def by_field(weights: Tensor) -> Tensor:
        return still + focal * (weights @ basis)

    names = {"Eq. 11 (global), Adam on Eq. 12": (by_global, residual.weights.detach())}
    names["Fig. 8 (field), Adam on Eq. 12"] = (by_field, torch.zeros(2, grid.count, dtype=torch.float64))
    for name, (project, start) in names.items():

        def train(rate: float, count: int) -> tuple[Tensor, float]:
            return eq12(views, camera, project, start, rate, count)  # noqa: B023

        if name not in rates:
            rates[name] = best_rate(train, steps)
        clock = time.process_time()
        weights, _ = train(rates[name], steps)
        seconds = time.process_time() - clock
        try:
            if project is by_global:
                trained: Camera = Camera(residual.parameters_at(weights), size=data.size, model=MODEL)
            else:
                trained = HybridCamera.of(camera, FieldResidual(grid, weights))
        except InputError as error:
            show([f"{name}: {error}"])
            continue
        out[name] = Fitted(trained, warp, seconds)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--folds", type=int, default=5)
    parser.add_argument("--write", action="store_true", help=f"also write the section of docs/{PAGE}")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    data = load()
    sums: dict[str, list[tuple[float, float, float, float, float]]] = {}
    rates: dict[str, float] = {}
    apart = 0.0
    for out in folds(len(data.corners))[: arguments.folds]:
        train, test = data.some(np.setdiff1d(np.arange(len(data.corners)), out)), data.some(out)
        found = fit_all(train, arguments.steps, rates)
        first, second, *_ = found.values()
        pixels = first.camera.grid(33, 23).reshape(-1, 2)
        rays, seen = first.camera.unproject(pixels)
        apart = max(apart, float((second.camera.project(rays)[0] - pixels).norm(dim=-1)[seen].max()))
        for name, fitted in found.items():
            sums.setdefault(name, []).append((*held_out(fitted, train), *held_out(fitted, test), fitted.seconds))
            s = sums[name][-1]
            print(f"  {name}: {math.sqrt(s[0] / s[1]):.4f} {math.sqrt(s[2] / s[3]):.4f} {s[4]:.1f} s", flush=True)
    lines = [
        "## The paper's way of training",
        "",
        f"Made by `scripts/train_eq12.py` on the real wide lens (93 views, {arguments.folds} folds of whole blocks of "
        f"views, poses of held-out views solved again, RMS by the file's weights). A residual is added to {MODEL} (20 "
        f"coefficients). *Adam on Eq. 12*: {arguments.steps} steps over the weights of the residual and of an inverse "
        "net, A*, K*, warp and poses held, λ = 1 with both errors in focal lengths, the "
        f"learning rate of the residual the best of {len(RATES)} decades by MSE(y3, y3*) after short runs on the first "
        f"fold ({', '.join(f'{rate:.0e}' for rate in rates.values())}), that of the inverse net {INVERSE_RATE:.0e}. "
        "*Joint*: Levenberg-Marquardt over weights, warp and poses. CPU seconds are those of the added step alone, "
        "median over folds; the first row is the calibration that all others start from. Eq. 11 read literally, fitted "
        "jointly, and the calibration itself "
        f"project rays of the whole image at most {apart:.1e} px apart.",
        "",
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
