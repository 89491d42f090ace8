"""Models compared on held-out views: the true one predicts to the noise, a poorer one does not, and errors are told."""

from __future__ import annotations

import functools
import math

import pytest
import torch
from torch import Tensor

from kcal.calibrate.camera.at_setting import ComparisonResult, compare_models
from kcal.calibrate.camera.result import CalibrationOptions
from kcal.corners.board import Board
from kcal.corners.observations import Observations, View
from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.pose import rotation_from_vector

BOARD = Board(columns=8, rows=6, square=0.04)
SIZE = (640, 480)
NOISE = 0.05


@functools.cache
def capture(count: int = 12, bend: float = 0.0, spread: bool = False) -> Observations:
    """Views through a lens of opencv5; a board that is bent obliquely by so many meters."""
    camera = Camera.build(focal=(500, 500), center=(322, 238), size=SIZE, coefficients=[-0.25, 0.08])
    points = BOARD.points.clone()
    middle = points.mean(0)
    a, b = ((points - middle) / (points.amax(0) - middle).clamp_min(1e-9))[:, :2].T
    points[:, 2] = bend * a * b
    generator = torch.Generator().manual_seed(3)
    views: list[View] = []
    while len(views) < count:
        u = 2.0 * torch.rand(6, dtype=torch.float64, generator=generator) - 1.0
        turn = rotation_from_vector(torch.stack([0.6 * u[0], 0.6 * u[1], math.pi * u[2]]))
        shift = torch.stack([0.25 * u[3], 0.18 * u[4], 0.5 + 0.1 * u[5]])
        pixels, valid = camera.project((points - middle) @ turn.T + shift)
        if bool((valid & camera.inside(pixels)).all()):
            noise: Tensor = torch.randn(pixels.shape, dtype=torch.float64, generator=generator)
            covariance = tuple((NOISE**2, 0.0, NOISE**2) for _ in pixels) if spread else None
            views.append(View(name=f"{len(views)}", pixels=(pixels + NOISE * noise).tolist(), covariance=covariance))
    return Observations(board=BOARD, image_size=SIZE, views=tuple(views))


def test_the_true_model_predicts_to_the_noise() -> None:
    result = compare_models(capture(), ["pinhole", "opencv5"], groups="views", parts=4)
    # Of each held-out view six numbers are fitted again, the poses.
    wanted = NOISE * math.sqrt(2.0 - 6.0 / len(BOARD.points))
    assert result.rms["opencv5"] == pytest.approx(wanted, rel=0.1)
    assert result.rms["pinhole"] > 10 * wanted
    more, error = result.difference("pinhole", "opencv5")
    assert more > 3 * error > 0
    assert result.failures == {}
    assert result.corners.tolist() == [48] * 12


def test_the_board_is_the_measured_one() -> None:
    """An oblique bend of 1.5 mm: with the ordered board, or a warp that cannot follow it, held-out views show it."""
    seen = capture(bend=1.5e-3)
    result = compare_models(seen, ["hybrid", "opencv5"], groups="views", parts=2)
    wanted = NOISE * math.sqrt(2.0 - 6.0 / len(BOARD.points))
    assert result.rms["hybrid"] < 1.3 * wanted
    assert result.rms["opencv5"] > 2 * wanted


def test_equal_covariances_change_nothing() -> None:
    plain, weighted = (
        compare_models(capture(spread=spread), ["opencv5"], groups="views", parts=3) for spread in (False, True)
    )
    assert weighted.rms["opencv5"] == pytest.approx(plain.rms["opencv5"], rel=1e-6)


def test_groups() -> None:
    told: list[str] = []
    result = compare_models(capture(), ["opencv4"], groups=list("aabbccddeeff"), parts=2, progress=told.append)
    assert result.corners.tolist() == [96] * 6
    assert told == ["opencv4, part 1 of 2", "opencv4, part 2 of 2"]
    assert compare_models(capture(), ["opencv4"], parts=2).corners.tolist() == [288] * 2
    with pytest.raises(InputError, match="a label for each of the 12 views"):
        compare_models(capture(), ["opencv4"], groups="everything")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="2 groups of views cannot be held out in 3 parts"):
        compare_models(capture(), ["opencv4"], groups=[0] * 6 + [1] * 6, parts=3)


def test_models_that_cannot_be_fitted_are_infinite_and_named() -> None:
    few = capture().subset(["0", "1", "2", "3"])
    with pytest.raises(DegenerateError):
        compare_models(few, ["opencv5"], groups="views", parts=2)
    for names in ([], ["opencv5", "opencv5"]):
        with pytest.raises(InputError, match="different models"):
            compare_models(capture(), names)
    camera = Camera.build(focal=(500, 500), center=(322, 238), size=SIZE)
    with pytest.raises(InputError, match="known camera"):
        compare_models(capture(), ["opencv5"], options=CalibrationOptions(camera=camera))


def test_errors_of_differences() -> None:
    """The delta method, against draws of whole groups."""
    generator = torch.Generator().manual_seed(0)
    corners = torch.full((400,), 40)
    common = torch.rand(400, dtype=torch.float64, generator=generator) * 5
    costs = torch.stack([common, common * 1.1 + 0.3 * torch.rand(400, dtype=torch.float64, generator=generator)])
    result = ComparisonResult(models=("a", "b"), costs=costs, corners=corners)
    more, error = result.difference("b", "a")
    draws = []
    for _ in range(300):
        some = torch.randint(400, (400,), generator=generator)
        one, other = (costs[:, some].sum(-1) / corners[some].sum()).sqrt()
        draws.append(float(other - one))
    assert error == pytest.approx(float(torch.tensor(draws).std()), rel=0.15)
    assert more == pytest.approx(result.rms["b"] - result.rms["a"])
    broken = ComparisonResult(
        models=("a", "b"), costs=costs.index_fill(1, torch.tensor([3]), math.inf), corners=corners
    )
    assert broken.rms == {"a": math.inf, "b": math.inf}
    assert all(map(math.isnan, broken.difference("a", "b")))
