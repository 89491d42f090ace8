"""The default camera where a parametric model is exactly right: error at infinity over that model's.

Truth: lenses with OpenCV's 5 or 14 coefficients, drawn at random about those of a surveillance camera, f 1600 px,
1920 x 1080 px, without a moving pupil; views of an exact board with Gaussian noise. This is the worst case for a camera
that knows no model. Both ways to take the board: unknown (the default; the right model with `board_warp`), and exact
(`board="exact"`; the right model as `kcal calibrate --model` fits it).
"""

from __future__ import annotations

import itertools
import math
import statistics

import torch
from torch import Tensor

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.lens.camera import Camera
from kcal.sim.captures import board_points
from scripts.shared.captures import PAPER_BOARD, capture_corners
from scripts.shared.infinity import error_at_infinity
from scripts.shared.page import Lines
from scripts.shared.sections import section
from scripts.shared.traced import BOARD, as_observations
from scripts.shared.views import TRUTH

MODELS = ("opencv5", "opencv14")
VIEWS = (60, 30, 8)
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
    for model, count, noise in itertools.product(MODELS, views, NOISE):
        found = [errors(drawn(model, seed), count, noise, 1000 + seed, model) for seed in seeds]
        typical = [math.exp(statistics.fmean(map(math.log, column))) for column in zip(*found, strict=True)]
        ratios.append((typical[0] / typical[1], typical[2] / typical[3]))
        rows.append([model, count, f"{noise:g}", *(f"{v:.3f}" for v in typical[:2]), f"{ratios[-1][0]:.2f}"])
    unknown, exact = (
        f"geometric mean {math.exp(statistics.fmean(map(math.log, column))):.2f}, worst {max(column):.2f}"
        for column in zip(*ratios, strict=True)
    )
    yield f"Default camera over the right model: {unknown}; both with the board taken as exact: {exact}."
    yield ""
