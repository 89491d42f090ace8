"""The covariance of all parameters and of projections: algebra, and OpenCV's figures."""

from __future__ import annotations

import math

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, observe, pixels_of
from torch import Tensor

from kcal.calibrate.camera import solve
from kcal.calibrate.camera.advice import check_directions
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import free_parameters, information_of, noise_variance, uncertainty_of
from kcal.errors import DegenerateError
from kcal.gaussian import Covariance
from kcal.lens.model import LensModel
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.schur import SchurLinearization

TIGHT = LMOptions(max_iterations=300, tolerance=1e-13)


def problem_of(pixels: Tensor, model: str, *, warp: bool = False) -> BoardProblem:
    lens = camera(model).model
    return BoardProblem(BOARD.points, pixels, lens, free_parameters(lens), free_board=warp)


def true_state(model: str, poses: tuple[Tensor, Tensor]) -> BoardState:
    return BoardState.flat(camera(model).params.detach().clone(), *poses)


def solved(pixels: Tensor, model: str, poses: tuple[Tensor, Tensor]) -> tuple[BoardState, Covariance]:
    problem = problem_of(pixels, model)
    result = minimize(problem, true_state(model, poses), TIGHT)
    assert bool(result.converged)
    count = problem.shared_size + 6 * len(pixels)
    return result.state, uncertainty_of(problem.linearize(result.state), problem.residual_count, count)


@pytest.mark.parametrize("missing", [False, True])
def test_it_is_a_block_of_the_whole_inverse(missing: bool) -> None:
    poses = motions(camera(), 4, 3)
    pixels = pixels_of(camera(), poses, noise=0.2)
    if missing:
        pixels[1, ::3] = torch.nan
    problem = problem_of(pixels, "opencv5", warp=True)
    state = minimize(problem, true_state("opencv5", poses), TIGHT).state
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

    found = uncertainty_of(problem.linearize(state), problem.residual_count, count)
    sigma = expected.diagonal().sqrt()
    # As correlations, so that small parameters count; the inverse has a condition number near 1e6.
    scale = sigma * sigma[:, None]
    torch.testing.assert_close(found.matrix / scale, expected / scale, rtol=0, atol=1e-8)
    assert bool(found.determined.all())
    # The square roots of information, by another way, say the same.
    noise = math.sqrt(float(noise_variance(problem.linearize(state), problem.residual_count, count)))
    roots = information_of(problem, state, noise).half()
    torch.testing.assert_close(roots.T @ roots / scale, expected / scale, rtol=0, atol=1e-8)


def test_what_no_view_determines_is_not_small() -> None:
    """Boards parallel to the image leave the focal length to the distance."""
    flat = torch.eye(3).double().expand(4, 3, 3).clone()
    shift = torch.tensor([[-0.15, -0.1, 1.0], [-0.3, -0.1, 1.0], [-0.1, -0.2, 1.0], [0.0, 0.0, 1.0]]).double()
    lens = camera("pinhole")
    state = true_state("pinhole", (flat, shift))
    pixels = pixels_of(lens, (flat, shift), noise=0.1)
    problem = problem_of(pixels, "pinhole")
    found = uncertainty_of(problem.linearize(state), problem.residual_count, problem.shared_size + 24)
    assert not bool(found.determined[:2].any())
    assert float(found.sigma[:2].min()) > 1e3


def test_sigma_is_opencvs() -> None:
    cv2 = pytest.importorskip("cv2")
    poses = motions(camera(), 8, 9)
    pixels = pixels_of(camera(), poses, noise=0.2, seed=3).float().double()
    state, found = solved(pixels, "opencv5", poses)
    lens = state.parameters.numpy()
    matrix = camera().matrix.numpy().copy()
    matrix[[0, 1, 0, 1], [0, 1, 2, 2]] = lens[:4]
    out = cv2.calibrateCameraExtended(
        [BOARD.points.float().numpy()] * 8, list(pixels.float().numpy()), SIZE, matrix, lens[5:].copy(),
        flags=cv2.CALIB_USE_INTRINSIC_GUESS, criteria=(3, 300, 1e-15),
    )  # fmt: skip
    # OpenCV's board corners are float32, 1e-5 px of 0.28 px residuals.
    torch.testing.assert_close(found.sigma, torch.from_numpy(out[5])[:9, 0], rtol=1e-4, atol=0)


class TestWhatCannotBeComputed:
    """A corner on a fold has an image but no derivative: σ is unknown then, not an error and no number."""

    def test_no_derivatives_no_covariance(self) -> None:
        gram = torch.eye(8, dtype=torch.float64)[None].clone()
        assert uncertainty_of(SchurLinearization.of_gram(gram, 6), 9, 7).computed
        gram[0, 3, 6] = gram[0, 6, 3] = torch.nan
        found = uncertainty_of(SchurLinearization.of_gram(gram, 6), 9, 7)
        assert not found.computed
        assert bool(found.matrix.isnan().all())
        assert not bool(found.determined.any())
        assert bool(found.sigma.isinf().all())

    def test_the_focal_length_counts_as_unknown(self) -> None:
        parameters = torch.tensor([500.0, 500.0, 320.0, 240.0, 0.0], dtype=torch.float64)
        rotation, translation = motions(camera("pinhole"), 4, 3)
        points = BOARD.points @ rotation.mT + translation[:, None]
        seen = torch.ones(points.shape[:2], dtype=torch.bool)
        for unknown in (math.nan, math.inf):
            spread = torch.diag(torch.tensor([1.0, unknown, 1.0, 1.0, 0.0], dtype=torch.float64))
            with pytest.raises(DegenerateError, match="not at all"):
                check_directions(parameters, LensModel(), points, seen, spread, rotation)

    def test_the_calibration_is_returned_without_error_bars(self, monkeypatch: pytest.MonkeyPatch) -> None:
        poses = motions(camera(), 8, 3)
        seen = observe(pixels_of(camera(), poses, noise=0.2))
        linearize = BoardProblem.linearize
        calls: list[Tensor] = []

        def folded(problem: BoardProblem, state: BoardState) -> SchurLinearization:
            linear = linearize(problem, state)
            if calls:
                linear.cost = linear.cost * torch.nan
            return linear

        def count(*given: object, **named: object) -> object:
            calls.append(torch.ones(()))
            return _uncertainty(*given, **named)  # type: ignore[arg-type]

        # Only after the solution was found.
        _uncertainty = solve._uncertainty
        monkeypatch.setattr(solve, "_uncertainty", count)
        monkeypatch.setattr(BoardProblem, "linearize", folded)
        result = calibrate_camera(seen, CalibrationOptions(weak_prior=None, model="opencv14"))
        assert calls
        assert set(result.sigma.values()) == {None}
        assert bool(result.covariance.diagonal()[:4].isnan().all())
        assert any("no error bars" in text for text in result.warnings)
        assert not any("do not determine" in text for text in result.warnings)
        assert result.file(name="left", source="left.json").covariance is None
