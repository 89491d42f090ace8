"""The covariance of all parameters and of projections: algebra, OpenCV's figures, and repeated captures."""

from __future__ import annotations

import math

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, motions, observe, pixels_of
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.calibrate.bundle.covariance import Covariance, covariance, projection_covariance, uncertainty_of
from kcal.calibrate.bundle.views import free_parameters
from kcal.calibrate.camera import assess
from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.camera.determined import check_directions
from kcal.errors import DegenerateError, InputError
from kcal.lens.model import LensModel
from kcal.lens.pose import rotation_from_vector, vector_from_rotation
from kcal.lens.projection import project_components
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.schur import SchurLinearization

TIGHT = LMOptions(max_iterations=300, tolerance=1e-13)


def problem_of(pixels: Tensor, model: str, *, warp: bool = False) -> BoardProblem:
    lens = camera(model).model
    return BoardProblem(BOARD.points, pixels, lens, free_parameters(lens), free_warp=warp)


def true_state(model: str, poses: tuple[Tensor, Tensor]) -> BoardState:
    return BoardState.flat(camera(model).params.detach().clone(), *poses)


def solved(pixels: Tensor, model: str, poses: tuple[Tensor, Tensor]) -> tuple[BoardState, Covariance]:
    problem = problem_of(pixels, model)
    result = minimize(problem, true_state(model, poses), TIGHT)
    assert bool(result.converged)
    count = problem.shared_size + 6 * len(pixels)
    return result.state, covariance(problem.linearize(result.state), problem.residual_count, count)


@pytest.mark.parametrize("missing", [False, True])
def test_blocks_are_those_of_the_whole_inverse(missing: bool) -> None:
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

    linear = problem.linearize(state)
    found = covariance(linear, problem.residual_count, count)
    rows = [torch.cat([found.shared, *[found.block(v).T for v in range(4)]], 1)]
    for v in range(4):
        rows.append(torch.cat([found.block(v), *[found.block(v, w) for w in range(4)]], 1))
    sigma = expected.diagonal().sqrt()
    # As correlations, so that small parameters count; the inverse has a condition number near 1e6.
    scale = sigma * sigma[:, None]
    torch.testing.assert_close(torch.cat(rows) / scale, expected / scale, rtol=0, atol=1e-8)
    torch.testing.assert_close(found.poses, torch.stack([found.block(v, v) for v in range(4)]))
    sigmas = uncertainty_of(linear, problem.residual_count, count)
    torch.testing.assert_close(sigmas.sigma, found.shared.diagonal().sqrt())
    assert bool(found.determined.all())


def test_what_no_view_determines_is_not_small() -> None:
    """Boards parallel to the image leave the focal length to the distance."""
    flat = torch.eye(3).double().expand(4, 3, 3).clone()
    shift = torch.tensor([[-0.15, -0.1, 1.0], [-0.3, -0.1, 1.0], [-0.1, -0.2, 1.0], [0.0, 0.0, 1.0]]).double()
    lens = camera("pinhole")
    state = true_state("pinhole", (flat, shift))
    pixels = pixels_of(lens, (flat, shift), noise=0.1)
    problem = problem_of(pixels, "pinhole")
    found = covariance(problem.linearize(state), problem.residual_count, problem.shared_size + 24)
    assert not bool(found.determined[:2].any())
    assert float(found.shared.diagonal()[:2].min().sqrt()) > 1e3


def test_pose_sigma_is_opencvs() -> None:
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
    # OpenCV's pose is a rotation vector and t; a step (ω, v) changes it by this derivative.
    vectors = vector_from_rotation(state.rotation)

    def vector_after(turn: Tensor, vector: Tensor) -> Tensor:
        return vector_from_rotation(rotation_from_vector(turn) @ rotation_from_vector(vector))

    by_step = torch.eye(6).double().repeat(8, 1, 1)
    for i in range(8):
        by_step[i, :3, :3] = torch.func.jacfwd(vector_after)(torch.zeros(3).double(), vectors[i])
    sigma = (by_step @ found.poses @ by_step.transpose(-1, -2)).diagonal(dim1=-2, dim2=-1).sqrt()
    expected = torch.from_numpy(out[6]).reshape(8, 6)
    # OpenCV's board corners are float32, 1e-5 px of 0.28 px residuals.
    torch.testing.assert_close(sigma, expected, rtol=1e-4, atol=0)
    torch.testing.assert_close(found.shared.diagonal().sqrt(), torch.from_numpy(out[5])[:9, 0], rtol=1e-4, atol=0)


class TestProjection:
    def test_shapes_that_do_not_fit(self) -> None:
        lens = camera()
        point, free = torch.ones(1, 3).double(), free_parameters(lens.model)
        with pytest.raises(InputError, match="at least"):
            projection_covariance(torch.eye(3).double(), point, lens.params, lens.model, free)
        with pytest.raises(InputError, match="points"):
            projection_covariance(torch.eye(9).double(), point[0], lens.params, lens.model, free)

    def test_no_image_no_number(self) -> None:
        lens, points = camera(), torch.tensor([[0.1, 0.1, 1.0], [0.1, 0.1, -1.0]]).double()
        free = free_parameters(lens.model)
        found = projection_covariance(torch.eye(9).double(), points, lens.params, lens.model, free)
        assert bool(found[0].isfinite().all())
        assert bool(found[1].isnan().all())


@pytest.mark.slow
def test_monte_carlo_of_projections_and_a_pose() -> None:
    """80 repetitions of one capture: scatter against prediction, by χ².

    For each of four image places and one pose, d² = eᵀ Σ⁻¹ e with the error e against the truth sums to χ² with
    80 x 2 (or x 6) degrees of freedom, but for the noise being estimated from 600 spare residuals, which adds less than
    1 %. With the Wilson-Hilferty bounds of 4.5 standard deviations, 7e-6 of captures fall outside each. Standard 95 %
    ellipses: of 80, at least 66 hold the truth but in 1e-5 of captures (binomial), for each place.
    """
    repeats, model = 80, "opencv5"
    truth = camera(model)
    poses = motions(truth, 8, 33)
    places = torch.tensor([[320.0, 240.0], [60.0, 50.0], [590.0, 60.0], [80.0, 420.0]]).double()
    rays, valid = truth.normalize(places)
    assert bool(valid.all())
    points = torch.cat([rays, torch.ones(4, 1).double()], 1)
    free = free_parameters(truth.model)
    squared, pose_squared = [], []
    for seed in range(repeats):
        state, found = solved(pixels_of(truth, poses, noise=0.2, seed=seed + 500), model, poses)
        seen = project_components(points.T, state.parameters, truth.model).pixels.T
        error = seen - places
        spot = projection_covariance(found.shared, points, state.parameters, truth.model, free)
        squared.append((error * torch.linalg.solve(spot, error)).sum(-1))
        turn = vector_from_rotation(state.rotation[0] @ poses[0][0].T)
        error = torch.cat([turn, state.translation[0] - poses[1][0]])
        pose_squared.append(error @ torch.linalg.solve(found.poses[0], error))
    distances = torch.stack(squared)
    for k in range(4):
        low, high = chi_square_bounds(2 * repeats, 4.5)
        assert low < float(distances[:, k].sum()) < high, k
        assert int((distances[:, k] < 5.991).sum()) >= 66, k
    low, high = chi_square_bounds(6 * repeats, 4.5)
    assert low < float(torch.stack(pose_squared).sum()) < high


def chi_square_bounds(freedom: int, deviations: float) -> tuple[float, float]:
    """Wilson and Hilferty's: (χ² / n)^(1/3) is normal about 1 - 2 / (9 n) with variance 2 / (9 n)."""
    share = 2.0 / (9.0 * freedom)
    low, high = (freedom * (1.0 - share + sign * deviations * share**0.5) ** 3 for sign in (-1.0, 1.0))
    return low, high


class TestWhatCannotBeComputed:
    """A corner on a fold has an image but no derivative: σ is unknown then, not an error and no number."""

    def test_no_derivatives_no_covariance(self) -> None:
        gram = torch.eye(8, dtype=torch.float64)[None].clone()
        assert uncertainty_of(SchurLinearization.of_gram(gram, 6), 9, 7).computed
        gram[0, 3, 6] = gram[0, 6, 3] = torch.nan
        found = uncertainty_of(SchurLinearization.of_gram(gram, 6), 9, 7)
        assert not found.computed
        assert bool(found.covariance.isnan().all())
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
        _uncertainty = assess._uncertainty
        monkeypatch.setattr(assess, "_uncertainty", count)
        monkeypatch.setattr(BoardProblem, "linearize", folded)
        result = calibrate_camera(seen, CalibrationOptions(weak_prior=None, model="opencv14"))
        assert calls
        assert set(result.sigma.values()) == {None}
        assert bool(result.covariance.diagonal()[:4].isnan().all())
        assert any("no error bars" in text for text in result.warnings)
        assert not any("do not determine" in text for text in result.warnings)
        assert result.file(name="left", source="left.json").covariance is None
