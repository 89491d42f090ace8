"""Robust losses, and a focal length given as a hint."""

from __future__ import annotations

import pytest
import torch
from calibrate_scenes import BOARD, camera, motions, observe, pixels_of

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import free_parameters
from kcal.errors import InputError
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.problem import RobustLoss

KINDS = ("huber", "cauchy", "tukey")


@pytest.mark.parametrize("kind", KINDS)
def test_wrong_corners_hardly_matter(kind: str) -> None:
    """Two of a hundred corners are 15 px off: plain least squares is thrown off ten times as far."""
    truth = camera()
    poses = motions(truth, 12, 5)
    pixels = pixels_of(truth, poses, noise=0.1, seed=2)
    clean = calibrate_camera(observe(pixels), CalibrationOptions(model="opencv5")).camera.params
    generator = torch.Generator().manual_seed(3)
    wrong = torch.rand(pixels.shape[:2], generator=generator) < 0.02
    pixels[wrong] += torch.where(pixels[wrong] < 460.0, 15.0, -15.0)  # within the image
    spoilt = calibrate_camera(observe(pixels), CalibrationOptions(model="opencv5")).camera.params
    result = calibrate_camera(
        observe(pixels), CalibrationOptions(model="opencv5", loss=RobustLoss(kind=kind, scale=0.4))
    )
    robust = result.camera.params
    assert float((robust - clean)[:4].norm()) < 0.1 * float((spoilt - clean)[:4].norm())
    assert result.weighted_rms is not None
    assert result.weighted_rms < 0.5 * result.rms


@pytest.mark.parametrize("kind", KINDS)
def test_the_solver_stops_where_the_robust_cost_is_flat(kind: str) -> None:
    """Its gradient by autograd through the residuals, not through the rows that the solver used."""
    truth = camera()
    poses = motions(truth, 6, 5)
    pixels = pixels_of(truth, poses, noise=0.1, seed=2)
    pixels[0, 3] += 2.0
    loss = RobustLoss(kind=kind, scale=0.3)
    problem = BoardProblem(BOARD.points, pixels, truth.model, free_parameters(truth.model), loss=loss)
    start = BoardState.flat(truth.params.detach(), *poses)
    result = minimize(problem, start, LMOptions(tolerance=1e-15))
    steps = (torch.zeros(problem.shared_size).double(), torch.zeros(6, 6).double())

    def cost(*step: torch.Tensor) -> torch.Tensor:
        return problem.cost(problem.retract(result.state, step))

    gradient = torch.func.grad(cost, argnums=(0, 1))(*steps)
    before = torch.func.grad(lambda *step: problem.cost(problem.retract(start, step)), argnums=(0, 1))(*steps)
    for now, then in zip(gradient, before, strict=True):
        assert float(now.norm()) < 1e-4 * float(then.norm())


def test_a_focal_hint_is_tried_first_and_changes_nothing_else() -> None:
    truth = camera()
    seen = observe(pixels_of(truth, motions(truth, 10, 5), noise=0.1, seed=2))
    plain = calibrate_camera(seen, CalibrationOptions(model="opencv5"))
    for focal in (350.0, 500.0, 800.0):
        hinted = calibrate_camera(seen, CalibrationOptions(model="opencv5", focal=focal))
        assert hinted.rms == pytest.approx(plain.rms, rel=1e-9)
        torch.testing.assert_close(hinted.camera.focal, plain.camera.focal, rtol=1e-6, atol=0)


def test_refusals() -> None:
    with pytest.raises(InputError, match="focal must be positive"):
        CalibrationOptions(model="opencv5", focal=-3.0)
