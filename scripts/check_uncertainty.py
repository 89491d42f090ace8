"""Whether predicted standard deviations are those of repeated captures; writes a section of docs/solver.md.

    python scripts/check_uncertainty.py                  300 captures with 5, 8 and 14 coefficients
    python scripts/check_uncertainty.py --refits 50 --coefficients 5 --dry

One camera, one set of poses, fresh normal noise for each capture; every capture is calibrated from nothing.
"""

from __future__ import annotations

import argparse
import math
from typing import NamedTuple

import torch
from bench_solver import COLUMNS, MODELS, NOISE, ROWS, SIZE, SQUARE, simulate
from page import write_section
from timing import show
from torch import Tensor

from kcal.calibrate.covariance import covariance, projection_covariance
from kcal.calibrate.mono import CalibrationOptions, calibrate_camera
from kcal.calibrate.problem import BoardProblem
from kcal.calibrate.views import free_parameters
from kcal.corners.board import Board
from kcal.corners.observations import Observations, View
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel

VIEWS = 30
# The middle, half way to a corner, and near two corners.
PLACES = ((960.0, 540.0), (1440.0, 810.0), (100.0, 80.0), (1820.0, 100.0))
ELLIPSE = -2.0 * math.log(0.05)  # the 95 % quantile of χ² with two degrees of freedom
# Of each model; mild enough to be regular all over the image.
LENS = (-0.25, 0.08, 5e-4, -3e-4, -0.02, 0.03, -0.01, 0.003, 4e-4, -2e-4, -3e-4, 2e-4, 0.004, -0.003)


class Fit(NamedTuple):
    """One capture: values and predicted variances of fx and cx, of the places (u, v), and their ellipses."""

    values: Tensor
    variances: Tensor
    inside: Tensor


def refit(pixels: Tensor, model: LensModel, points: Tensor, places: Tensor) -> Fit | None:
    """Calibrate one capture; None where it was refused."""
    board = Board(columns=COLUMNS, rows=ROWS, square=SQUARE)
    views = tuple(View(name=f"{i:04}", pixels=tuple(map(tuple, v))) for i, v in enumerate(pixels.tolist()))
    seen = Observations(board=board, image_size=SIZE, views=views)
    result = calibrate_camera(seen, CalibrationOptions(model=model))
    free, parameters = free_parameters(model), result.camera.parameters_vector.detach()
    problem = BoardProblem(board.points, seen.pixels()[:, None], [model], [free])
    none = torch.zeros(0, 3, 3).double(), torch.zeros(0, 3).double()
    poses = result.cam_from_board_rotation, result.cam_from_board_translation
    linear = problem.linearise((parameters, torch.zeros(2).double(), *none, *poses))
    found = covariance(linear, problem.residual_count, problem.shared_size + 6 * len(views))
    spots = projection_covariance(found.shared, points, parameters, model, free)
    images, valid = result.camera.project(points)
    if not bool(valid.all()):
        return None
    error = images.detach() - places
    distance = (error * torch.linalg.solve(spots, error)).sum(-1)
    sigma = found.shared.diagonal()
    return Fit(
        torch.cat([parameters[[0, 2]], images.detach().flatten()]),
        torch.cat([sigma[[0, 2]], spots.diagonal(dim1=-2, dim2=-1).flatten()]),
        distance < ELLIPSE,
    )


def study(coefficients: int, refits: int) -> list[str]:
    """The rows of one model."""
    model = LensModel.named(MODELS[coefficients])
    truth = Camera.build(
        focal=(1600, 1600), center=(963, 536), size=SIZE, coefficients=LENS[:coefficients], model=model
    )
    places = torch.tensor(PLACES, dtype=torch.float64)
    rays, valid = truth.normalize(places)
    assert bool(valid.all()), "a place that the true lens does not see"
    points = torch.cat([rays, torch.ones(len(rays), 1).double()], 1)
    # The poses of the benchmark's views; what its lens shows of them is not used.
    drawn = simulate(VIEWS)
    board = torch.from_numpy(drawn["board"])
    rotation, translation = torch.from_numpy(drawn["rotation"]), torch.from_numpy(drawn["translation"])
    clean, valid = truth.project(board @ rotation.transpose(-1, -2) + translation[:, None])
    assert bool(valid.all()), "a corner that the true lens does not see"
    generator = torch.Generator().manual_seed(1000 + coefficients)
    fits = []
    for _ in range(refits):
        noise = NOISE * torch.randn(clean.shape, generator=generator, dtype=torch.float64)
        fits.append(refit(clean + noise, model, points, places))
    good = [fit for fit in fits if fit is not None]
    values, variances, inside = (torch.stack(list(part)) for part in zip(*good, strict=True))
    empirical, predicted = values.std(0), variances.mean(0).sqrt()
    ratio = (predicted / empirical).tolist()
    bias = ((values.mean(0) - torch.cat([truth.focal[:1], truth.center[:1], places.flatten()])) / empirical).tolist()
    hits = 100.0 * inside.double().mean(0)
    names = ["fx", "cx", *(f"{axis} at ({u:.0f}, {v:.0f})" for u, v in PLACES for axis in "uv")]
    rows = []
    for k, name in enumerate(names):
        cover = f"{float(hits[(k - 2) // 2]):.1f}" if k >= 2 and k % 2 == 0 else ""
        rows.append(
            f"| {coefficients} | {name} | {float(predicted[k]):.4f} | {float(empirical[k]):.4f} | {ratio[k]:.3f} | "
            f"{bias[k]:+.2f} | {cover} |"
        )
    failed = f", {len(fits) - len(good)} captures gave no image of a place" if len(good) < len(fits) else ""
    rows.append(
        f"| {coefficients} | **all** | | | **{min(ratio):.3f} to {max(ratio):.3f}** | | **{float(hits.mean()):.1f}** |"
    )
    return show([*rows, *([f"| {coefficients} | {failed[2:]} | | | | | |"] if failed else [])])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--refits", type=int, default=300)
    parser.add_argument("--coefficients", type=int, nargs="*", default=[5, 8, 14], choices=[5, 8, 14])
    parser.add_argument("--dry", action="store_true", help="print only")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    error, cover = 100.0 / math.sqrt(2 * (arguments.refits - 1)), 100 * math.sqrt(0.95 * 0.05 / arguments.refits)
    lines = [
        "## Predicted and repeated",
        "",
        f"Made by `scripts/check_uncertainty.py`: {VIEWS} views of a {COLUMNS}x{ROWS} board, {SIZE[0]}x{SIZE[1]} px, "
        f"noise {NOISE} px an axis, captured and calibrated {arguments.refits} times with fresh noise. Pixels: the "
        "standard deviation that kcal predicts (root of the mean variance), the one of the repetitions, their ratio "
        f"(its own standard error {error:.1f} %), the mean error in standard deviations, and how many of the 95 % "
        f"ellipses hold the true place (standard error {cover:.1f} % for one place). Places are images of fixed "
        "directions in the camera's frame.",
        "",
        "| coefficients | of | predicted σ | repeated σ | ratio | mean error / σ | in 95 % ellipse, % |",
        "|---|---|---|---|---|---|---|",
    ]
    show(lines[-2:])
    for coefficients in arguments.coefficients:
        lines += study(coefficients, arguments.refits)
    if not arguments.dry:
        write_section("solver.md", "predicted and repeated", "\n".join(lines))


if __name__ == "__main__":
    main()
