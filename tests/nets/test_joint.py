"""Eq. 12: both terms of the loss, its derivatives, and which method ends lower."""

from __future__ import annotations

import functools

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, pixels_of
from lenses import hybrid_camera
from torch import Tensor

from kcal.errors import DegenerateError, InputError
from kcal.lens.camera import Camera
from kcal.lens.projection import from_pixels, plane_from_points
from kcal.nets.inverse import InverseNet, train_inverse
from kcal.nets.joint import JointFit, JointOptions, ResidualNet, _JointProblem, train_jointly
from kcal.solve.problem import SolverStatus

BALANCE = 0.7


@functools.cache
def corners(model: str = "opencv5") -> tuple[Camera, Tensor, Tensor]:
    """A camera that is some pixels wrong, corners (V, N, 3) in the camera frame, and their noisy pixels."""
    truth = camera(model)
    rotation, translation = poses = motions(truth, 12, 5)
    start = truth.params.detach().clone()
    start[:4] += torch.tensor([3.0, -2.0, 1.5, 2.5])
    points = BOARD.points @ rotation.transpose(-1, -2) + translation[:, None]
    return Camera(start, size=SIZE, model=model), points, pixels_of(truth, poses, noise=0.1, seed=2)


def problem_of(model: str) -> tuple[_JointProblem, tuple[Tensor, Tensor]]:
    start, points, pixels = corners(model)
    residual, inverse = ResidualNet(start, hidden=2), InverseNet(start, hidden=3, radial=False)
    weight = torch.linspace(0.5, 1.5, pixels.shape[0] * pixels.shape[1], dtype=torch.float64)
    problem = _JointProblem(residual, inverse, points.reshape(-1, 3).T, pixels.reshape(-1, 2).T, weight, BALANCE)
    generator = torch.Generator().manual_seed(1)
    state = tuple(
        0.3 * torch.randn(net.weights.shape, generator=generator, dtype=torch.float64) for net in (residual, inverse)
    )
    return problem, state  # type: ignore[return-value]


@functools.cache
def fitted(method: str) -> JointFit:
    steps = {"lm": 60, "adam": 300}[method]
    return train_jointly(*corners(), JointOptions(method=method, steps=steps, hidden=(4, 6)))  # type: ignore[arg-type]


@pytest.mark.parametrize("model", ["opencv5", "ext20", "fisheye4"])
def test_derivatives_are_those_of_autograd(model: str) -> None:
    problem, state = problem_of(model)
    rows = problem.rows(state)
    wanted = torch.func.jacrev(lambda *weights: problem.residuals(weights)[0], argnums=(0, 1))(*state)
    torch.testing.assert_close(rows[:-1].T, torch.cat(wanted, 1), rtol=1e-8, atol=1e-10)
    torch.testing.assert_close(rows[-1], problem.residuals(state)[0])
    torch.testing.assert_close(problem.gram(state)[0], rows @ rows.T, rtol=1e-9, atol=1e-9)


def test_the_loss_is_that_of_the_paper() -> None:
    """Both mean squares from the nets themselves, corner by corner."""
    fit = fitted("lm")
    _, points, pixels = corners()
    seen = fit.camera.project(points)[0] - pixels
    assert fit.rms == pytest.approx(float(seen.square().sum(-1).mean().sqrt()), rel=1e-9)
    distorted = torch.stack(from_pixels(*fit.camera.project(points)[0].unbind(-1), fit.camera.params), -1)
    before = torch.stack(fit.inverse.net.to_chart(*plane_from_points(*points.unbind(-1), fit.camera.model)), -1)
    after = torch.stack(fit.inverse.net.to_chart(*fit.inverse.net(distorted).unbind(-1)), -1)
    undone = float(corners()[0].focal.mean()) * (after - before)
    assert fit.inverse_rms == pytest.approx(float(undone.square().sum(-1).mean().sqrt()), rel=1e-9)
    assert float(fit.losses[-1]) == pytest.approx(fit.rms**2 + fit.inverse_rms**2, rel=1e-9)
    assert float(fit.losses[0]) > fit.start_rms**2


def test_both_methods_lower_it_and_least_squares_more() -> None:
    lm, adam = fitted("lm"), fitted("adam")
    assert float(lm.losses[0]) == pytest.approx(float(adam.losses[0]), rel=1e-12)
    assert bool((lm.losses.diff() <= 0).all())
    assert bool((adam.losses.diff() <= 0).all())
    assert lm.start_rms > 3.0
    assert lm.rms < 0.16  # the noise is 0.1 px along each axis
    assert float(lm.losses[-1]) < 0.01 * float(adam.losses[-1]) < 0.01 * float(adam.losses[0])
    assert adam.inverse.status == SolverStatus.ITERATION_LIMIT
    assert (lm.inverse.iterations, adam.inverse.iterations) == (len(lm.losses) - 1, 300)


def test_the_inverse_over_the_image_is_worse_than_one_trained_there() -> None:
    joint, alone = fitted("lm").inverse, train_inverse(fitted("lm").camera)
    assert joint.rms < 0.2 * joint.start_rms
    assert alone.rms < 0.2 * joint.rms


def test_corners_that_do_not_count_change_nothing() -> None:
    start, points, pixels = corners()
    options = JointOptions(steps=3, hidden=(2, 2))
    wanted = train_jointly(start, points[1:], pixels[1:], options)
    torn, weights = pixels.clone(), torch.ones(pixels.shape[:-1])
    torn[0, ::2], weights[0, 1::2] = torch.nan, 0.0
    found = train_jointly(start, points, torn, options, weights=weights)
    assert found.rms == pytest.approx(wanted.rms, rel=1e-9)
    doubled = train_jointly(start, points, torn, options, weights=weights + weights)
    torch.testing.assert_close(doubled.losses, found.losses)


@pytest.mark.parametrize("method", ["lm", "adam"])
def test_progress_may_end_it(method: str) -> None:
    told: list[tuple[int, float]] = []

    def progress(step: int, loss: float) -> bool:
        told.append((step, loss))
        return step == 2

    options = JointOptions(method=method, hidden=(2, 2))  # type: ignore[arg-type]
    fit = train_jointly(*corners(), options, progress=progress)
    assert [step for step, _ in told] == [1, 2]
    assert fit.inverse.status == SolverStatus.INTERRUPTED
    assert float(fit.losses[-1]) == pytest.approx(min(float(fit.losses[0]), *(loss for _, loss in told)))


def test_a_rate_that_is_too_large_ends_honestly() -> None:
    """The lowest loss is kept, whatever came later."""
    fit = train_jointly(*corners(), JointOptions(method="adam", rates=(1e3, 1e3), steps=30, hidden=(2, 2)))
    assert bool(fit.losses.isfinite().all())
    assert fit.rms <= fit.start_rms * (1 + 1e-12)


def test_bad_input_is_refused() -> None:
    start, points, pixels = corners()
    with pytest.raises(InputError, match="hybrid"):
        train_jointly(hybrid_camera("webcam"), points, pixels)
    with pytest.raises(InputError, match="same corners"):
        train_jointly(start, points, pixels[1:])
    with pytest.raises(DegenerateError, match="too few"):
        train_jointly(start, points[0, :4], pixels[0, :4])
    with pytest.raises(DegenerateError, match="no image"):
        train_jointly(start, -points, pixels)
    for wrong in ({"method": "sgd"}, {"steps": 0}, {"hidden": (0, 2)}, {"inverse_weight": -1.0}):
        with pytest.raises(InputError, match="JointOptions"):
            JointOptions(**wrong)  # type: ignore[arg-type]
