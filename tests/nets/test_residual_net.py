"""Eq. 11 read literally: a constant offset, with no more to fit than the parameters have."""

from __future__ import annotations

import pytest
import torch
from calibrate_scenes import BOARD, camera, motions, pixels_of
from torch import Tensor

from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.errors import InputError
from kcal.lens.camera import Camera
from kcal.nets.mlp import initial_weights
from kcal.solve.lm import LMOptions, minimize
from scripts.paper.residual_net import ResidualNet, ResidualProblem, train_residual


def scene(model: str = "opencv5", free_warp: bool = True) -> tuple[BoardProblem, BoardState, Camera]:
    """A noisy capture, the state at the true poses, and a camera that is some pixels wrong: A* and K*."""
    truth = camera(model)
    poses = motions(truth, 12, 5)
    pixels = pixels_of(truth, poses, noise=0.1, seed=2)
    start = truth.params.detach().clone()
    start[:4] += torch.tensor([3.0, -2.0, 1.5, 2.5])
    start[5] += 0.01
    wrong = Camera(start, size=truth.size, model=model)
    residual = ResidualNet(wrong)
    problem = BoardProblem(BOARD.points, pixels, truth.model, residual.corrected, free_board=free_warp)
    return problem, BoardState.flat(start, *poses), wrong


def random_weights(residual: ResidualNet, seed: int) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 0.3 * torch.randn(residual.weights.shape, generator=generator, dtype=torch.float64)


def test_a_new_one_corrects_nothing_and_leaves_skew_alone() -> None:
    _, _, start = scene()
    residual = ResidualNet(start)
    assert torch.equal(residual(), start.params)
    residual.weights.copy_(random_weights(residual, 0))
    moved = residual() - start.params
    assert float(moved[4]) == 0.0
    assert int((moved != 0).sum()) == 4 + start.model.size
    assert torch.equal(residual.camera().params, residual())


def test_slopes_are_those_of_autograd_and_numeric_ones() -> None:
    _, _, start = scene("opencv14")
    residual = ResidualNet(start, hidden=3)
    weights = random_weights(residual, 1)
    wanted = torch.func.jacrev(residual.parameters_at)(weights)[list(residual.corrected)]
    torch.testing.assert_close(residual.slopes(weights), wanted)
    assert torch.autograd.gradcheck(residual.parameters_at, (weights.requires_grad_(),), atol=1e-5)


@pytest.mark.parametrize("model", ["opencv5", "ext20"])
def test_it_has_no_capacity_beyond_the_parameters(model: str) -> None:
    """However many weights: what they can do to pixels is what the parameters can."""
    _, _, start = scene(model)
    residual = ResidualNet(start, hidden=16)
    weights = random_weights(residual, 2)
    rays, valid = start.unproject(start.grid(9, 7).reshape(-1, 2))
    assert bool(valid.all())

    def pixels(parameters: Tensor) -> Tensor:
        return torch.func.functional_call(start, {"params": parameters}, (rays,))[0]

    by_weights = torch.func.jacrev(residual.parameters_at)(weights)
    at = residual.parameters_at(weights)
    by_parameters = torch.func.jacfwd(pixels)(at).flatten(0, 1)[:, list(residual.corrected)]
    through = torch.func.jacrev(lambda w: pixels(residual.parameters_at(w)))(weights).flatten(0, 1)
    count = 4 + start.model.size
    assert residual.weights.numel() > 10 * count
    assert int(torch.linalg.matrix_rank(by_weights)) == count
    # The same column space: each is a combination of the other's columns.
    scaled = by_parameters / torch.linalg.vector_norm(by_parameters, dim=0)
    basis, _, _ = torch.linalg.svd(scaled, full_matrices=False)
    beside = through - basis @ (basis.T @ through)
    assert float(beside.abs().max()) < 1e-9 * float(through.abs().max())


@pytest.mark.parametrize("model", ["opencv4", "opencv5"])
def test_it_ends_where_the_parameters_end(model: str) -> None:
    problem, state, start = scene(model)
    exact = LMOptions(max_iterations=500, tolerance=1e-14)
    plain = minimize(problem, state, exact)
    for seed in (0, 1):
        residual = ResidualNet(start, seed=seed)
        result = train_residual(residual, problem, state, exact)
        assert float(result.cost) == pytest.approx(float(plain.cost), rel=1e-9)
        assert torch.equal(residual.weights, result.state[0])
        fitted = Camera(plain.state.parameters, size=start.size, model=model)
        rays, _ = fitted.unproject(fitted.grid(9, 7).reshape(-1, 2))
        # 1e-3 px: corners of 0.1 px determine the camera to some hundredths of a pixel.
        torch.testing.assert_close(residual.camera().project(rays)[0], fitted.project(rays)[0], rtol=0, atol=1e-3)


def test_derivatives_of_the_problem_are_numeric_ones() -> None:
    problem, state, start = scene()
    residual = ResidualNet(start, hidden=2)
    residual.weights.copy_(random_weights(residual, 3) * 0.1)
    whole = ResidualProblem(problem, residual)
    at = whole.start(state)
    count, views = residual.weights.numel() + 2, len(state.translation)

    def cost(step: Tensor) -> Tensor:
        return whole.cost(whole.retract(at, (step[:count], step[count:].reshape(views, 6))))

    rows = whole.rows(at)
    assert rows.shape[-2] == 6 + count + 1
    torch.testing.assert_close(whole.gram(at), rows @ rows.transpose(-1, -2), rtol=1e-9, atol=1e-9)

    generator = torch.Generator().manual_seed(8)
    linear = whole.linearize(at)
    assert float(linear.cost) == pytest.approx(float(whole.cost(at)), rel=1e-12)
    damping = torch.tensor(1e-3, dtype=torch.float64)
    (shared, local), _ = linear.step(damping)
    # Along its own step: slope -(δᵀ(H + λD)δ) of the model is that of the cost.
    step = torch.cat([shared, local.flatten()])
    h = 1e-4
    slope = float((cost(h * step) - cost(-h * step)) / (2 * h))
    _, predicted = linear.step(damping)
    assert slope < 0
    assert float(predicted) == pytest.approx(-0.5 * slope, rel=0.02)
    other = torch.randn(len(step), generator=generator, dtype=torch.float64) * 1e-6
    assert float(cost(other)) == pytest.approx(float(cost(torch.zeros_like(other))), rel=1e-2)


def test_bad_input_is_refused() -> None:
    _, _, start = scene()
    with pytest.raises(InputError, match="single"):
        ResidualNet(Camera(start.params.expand(2, -1), size=start.size, model=start.model))
    with pytest.raises(InputError, match="distortion vector"):
        ResidualNet(Camera.build(focal=(100, 100), center=(50, 50), size=(100, 100), model="pinhole"))


def test_state_and_precision() -> None:
    _, _, start = scene()
    residual, other = ResidualNet(start), ResidualNet(start, seed=1)
    residual.weights.copy_(random_weights(residual, 4))
    other.load_state_dict(residual.state_dict())
    assert torch.equal(other.half()(), residual())
    assert torch.equal(residual.weights, other.weights)
    assert residual.weights.numel() == len(initial_weights(residual.widths))
