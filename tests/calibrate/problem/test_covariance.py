"""The covariance of all parameters: a block of the inverse, and unknown where it cannot be computed."""

import math
from unittest.mock import Mock

import pytest
import torch
from calibrate_scenes import BOARD, camera, motions, observe, pixels_of

from kcal.calibrate.camera import solve
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState, warp_modes
from kcal.calibrate.problem.views import (
    dispersion_of,
    free_parameters,
    information_of,
    noise_variance,
    uncertainty_of,
)
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.schur import SchurLinearization


@pytest.mark.parametrize("missing", [False, True])
def test_it_is_a_block_of_the_whole_inverse(missing: bool) -> None:
    poses = motions(camera(), 4, 3)
    pixels = pixels_of(camera(), poses, noise=0.2)
    if missing:
        pixels[1, ::3] = torch.nan
    lens = camera()
    problem = BoardProblem(BOARD.points, pixels, lens.model, free_parameters(lens.model), free_board=True)
    start, tight = BoardState.flat(lens.params.detach().clone(), *poses), LMOptions(max_iterations=300, tolerance=1e-13)
    state = minimize(problem, start, tight).state
    shared, local = torch.zeros(problem.shared_size).double(), torch.zeros(4, 6).double()
    blocks = torch.func.jacfwd(lambda *step: problem.residuals(problem.retract(state, step)).flatten(), (0, 1))(
        shared, local
    )
    jacobian = torch.cat([blocks[0], blocks[1].flatten(1)], -1)
    norm = torch.linalg.vector_norm(jacobian, dim=0)
    inverse = torch.linalg.inv((jacobian / norm).T @ (jacobian / norm)) / norm / norm[:, None]
    count = problem.shared_size + 24
    expected = inverse * float((problem.residuals(state) ** 2).sum()) / (problem.residual_count - count)
    expected = expected[: len(shared), : len(shared)]

    linear = problem.linearize(state)
    variance = float(noise_variance(linear, problem.residual_count, count))
    found = uncertainty_of(linear, variance)
    sigma = expected.diagonal().sqrt()
    # As correlations, so that small parameters count; the inverse has a condition number near 1e6.
    scale = sigma * sigma[:, None]
    torch.testing.assert_close(found.matrix / scale, expected / scale, rtol=0, atol=1e-8)
    assert bool(found.determined.all())
    # The square roots of information, by another way, say the same.
    roots = information_of(problem, state, math.sqrt(variance)).half()
    torch.testing.assert_close(roots.T @ roots / scale, expected / scale, rtol=0, atol=1e-8)


def of_copies(count: int, seed: int, copies: int) -> float:
    """The dispersion of views whose corners are there several times, with the same error each time."""
    lens, generator = camera(), torch.Generator().manual_seed(seed)
    poses = motions(lens, count, seed)
    pixels = pixels_of(lens, poses) + 0.2 * torch.randn(count, len(BOARD.points), 2, generator=generator).double()
    problem = BoardProblem(
        BOARD.points.repeat(copies, 1), pixels.repeat(1, copies, 1), lens.model, free_parameters(lens.model)
    )
    state = minimize(problem, BoardState.flat(lens.params.detach().clone(), *poses), LMOptions(max_iterations=60)).state
    freedom = problem.shared_size + 6 * count
    return dispersion_of(
        problem, state, float(noise_variance(problem.linearize(state), problem.residual_count, freedom))
    )


@pytest.mark.slow
def test_copies_of_corners_disperse_as_much_as_there_are() -> None:
    # Of independent corners chance explains the scatter as a rule: two standard deviations of a skewed distribution.
    assert sum(of_copies(12, seed, 1) > 1.0 for seed in range(20)) <= 3
    found = torch.tensor([of_copies(12, seed, 9) for seed in range(20)])
    assert float(found.mean()) == pytest.approx(9.0, rel=0.15)
    # Of that few views it is known to a third.
    assert float(found.std()) < 3.0


@pytest.mark.slow
def test_error_bars_hold_where_views_see_bent_boards() -> None:
    """A board that bends anew in each view, by 2 mm: noise of the corners alone makes intervals too small."""
    errors = []
    for seed in range(8):
        lens, generator = camera(), torch.Generator().manual_seed(100 + seed)
        rotation, translation = motions(lens, 12, seed)
        bend = 2e-3 * torch.randn(12, 2, generator=generator).double()
        points = BOARD.points + torch.einsum("vb,bcn->vnc", bend, warp_modes(BOARD.points))
        pixels = lens.project(points @ rotation.mT + translation[:, None])[0]
        pixels = pixels + 0.1 * torch.randn(pixels.shape, generator=generator).double()
        result = calibrate_camera(observe(pixels), CalibrationOptions(model=lens.model, reject=None))
        assert any(finding.name == "patterns" for finding in result.findings)
        assert result.tempering is not None
        away = (result.camera.params - lens.params)[:4].detach() / result.covariance.diagonal()[:4].sqrt()
        errors.append(torch.stack([away, away * math.sqrt(result.tempering)]))
    stated, alone = torch.stack(errors).square().mean((0, 2)).sqrt().tolist()
    assert 0.6 < stated < 1.4
    assert alone > 2.0


class TestWhatCannotBeComputed:
    """A corner on a fold has an image but no derivative: σ is unknown then, not an error and no number."""

    def test_no_derivatives_no_covariance(self) -> None:
        gram = torch.eye(8, dtype=torch.float64)[None].clone()
        assert uncertainty_of(SchurLinearization.of_gram(gram, 6), 1.0).computed
        gram[0, 3, 6] = gram[0, 6, 3] = torch.nan
        found = uncertainty_of(SchurLinearization.of_gram(gram, 6), 1.0)
        assert not found.computed
        assert bool(found.matrix.isnan().all())
        assert not bool(found.determined.any())
        assert bool(found.sigma.isinf().all())

    def test_the_calibration_is_returned_without_error_bars(self, monkeypatch: pytest.MonkeyPatch) -> None:
        seen = observe(pixels_of(camera(), motions(camera(), 8, 3), noise=0.2))
        linearize = BoardProblem.linearize

        def folded(problem: BoardProblem, state: BoardState) -> SchurLinearization:
            linear = linearize(problem, state)
            if asked.called:
                linear.cost = linear.cost * torch.nan
            return linear

        # Only after the solution was found.
        asked = Mock(wraps=solve._uncertainty)
        monkeypatch.setattr(solve, "_uncertainty", asked)
        monkeypatch.setattr(BoardProblem, "linearize", folded)
        result = calibrate_camera(seen, CalibrationOptions(weak_prior=None, model="opencv14"))
        assert asked.called
        assert set(result.sigma.values()) == {None}
        assert bool(result.covariance.diagonal()[:4].isnan().all())
        assert any("no error bars" in text for text in result.warnings)
        assert not any("do not determine" in text for text in result.warnings)
        assert result.file(name="left", source="left.json").covariance is None
