"""Wide-angle lenses: found without any guess of the focal length."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from calibrate_scenes import BOARD, motions, observe, pixels_of

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.search.starts import rational_curve
from kcal.corners.board import Board
from kcal.corners.observations import Observations, View
from kcal.lens.camera import Camera
from kcal.lens.distortion import distort
from kcal.lens.model import LensModel


def equidistant(angle: torch.Tensor) -> torch.Tensor:
    return angle


def stereographic(angle: torch.Tensor) -> torch.Tensor:
    return 2.0 * torch.tan(0.5 * angle)


@pytest.mark.parametrize("curve", [equidistant, stereographic])
@pytest.mark.parametrize("model", ["opencv8", "opencv14"])
def test_a_rational_lens_follows_the_curve(model: str, curve) -> None:
    lens = rational_curve(curve, LensModel.named(model), math.radians(80))
    angle = torch.linspace(0.01, math.radians(80), 50, dtype=torch.float64)
    point = torch.stack([torch.tan(angle), torch.zeros_like(angle)], -1)
    radius = distort(point, lens, model)[:, 0]
    # Three orders each way: a start, good to a few thousandths of the focal length.
    assert float((radius - curve(angle)).abs().max()) < 5e-3
    assert LensModel.named(model).size == len(lens)


@pytest.mark.parametrize("weak_prior", [None, 0.3])
def test_a_simulated_wide_lens_without_a_guess(weak_prior: float | None) -> None:
    lens = rational_curve(equidistant, LensModel.named("opencv8"), math.radians(84))
    truth = Camera.build(
        focal=(330, 331), center=(318, 243), size=(640, 480), coefficients=lens.tolist(), model="opencv8"
    )
    pixels = pixels_of(truth, motions(truth, 20, 3, fill=0.7), noise=0.1, seed=3)
    result = calibrate_camera(observe(pixels, board=BOARD), CalibrationOptions(model="opencv8", weak_prior=weak_prior))
    # 0.1 px an axis is 0.141 px as RMS over points.
    assert result.rms < 0.15
    assert float(result.camera.focal[0]) == pytest.approx(330, rel=0.01)


def test_a_real_lens_of_150_degrees(kcal_data: Path) -> None:
    data = np.load(kcal_data / "wide_lens_corners.npz")
    views = []
    for number in range(0, 93, 3):
        corners, weight = data["corners"][number], data["weight"][number]
        pixels = tuple((float(u), float(v)) if w > 0 else None for (u, v), w in zip(corners, weight, strict=True))
        views.append(View(name=str(number), pixels=pixels))
    board = Board(columns=10, rows=10, square=0.077)
    seen = Observations(board=board, image_size=(6016, 4016), views=tuple(views))
    result = calibrate_camera(seen, CalibrationOptions(weak_prior=None, model="opencv8", board_warp=True))
    known = data["seed_intrinsics_fx_fy_cx_cy"]
    # Another program's solution of twice the views; the data's own spread is a few tenths of a percent.
    assert result.camera.focal.tolist() == pytest.approx(known[:2].tolist(), rel=5e-3)
    # Other programs end at 0.77 to 1.6 px, with all views and corners weighted by their quality.
    assert result.rms < 1.2
