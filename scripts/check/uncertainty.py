"""Whether predicted standard deviations are those of repeated captures.

One camera, one set of poses, fresh normal noise for each capture; every capture is calibrated from nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.lens.camera import Camera
from kcal.lens.model import LensModel
from kcal.lens.pose import step_rows
from kcal.lens.projection import project_components
from scripts.shared.page import table
from scripts.shared.sections import section
from scripts.shared.views import MODELS, NOISE, SIZE, WEAK, observed, simulate

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
def predicted_and_repeated(refits: int = 300, coefficients: tuple[int, ...] = (5, 8, 14)) -> Iterator[str]:
    heads = ["coefficients", "cx: error, px", "cx: σ / error", "fx: σ / error"]
    heads += ["corner of the image, turned: σ / error, medians", "in 95 %, %", "turned, %", "warned of"]
    heads += ["the others: in 95 %, %", "turned, %"]
    cases = ((count, weak) for count in coefficients for weak in ((None,) if count == 5 else (None, WEAK)))
    return table(heads, (study(count, weak, refits) for count, weak in cases))
