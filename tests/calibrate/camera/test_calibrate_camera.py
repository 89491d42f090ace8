"""One camera, simulated: truth comes back, error bars mean what they say, and bad data are refused."""

import dataclasses
import itertools

import pytest
import torch
from calibrate_scenes import BOARD, SIZE, camera, corner_pixels, motions, observe, pixels_of
from torch import Tensor

from kcal import Camera, DegenerateError, InputError
from kcal.calibrate.camera.calibrate import CalibrationOptions, CameraCalibrationResult, calibrate_camera
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState, warp_modes
from kcal.calibrate.problem.views import free_parameters, noise_variance, uncertainty_of
from kcal.solve import SolverStatus
from kcal.solve.lm import LMOptions, minimize


def solve(pixels: Tensor, model: str = "opencv5", **options: object) -> CameraCalibrationResult:
    return calibrate_camera(observe(pixels), CalibrationOptions(**{"model": model, "weak_prior": None, **options}))


def fitted(result: CameraCalibrationResult) -> dict[str, float]:
    return dict(zip(result.camera.names, result.camera.params.tolist(), strict=True))


def far_apart(a: Camera, b: Camera) -> float:
    """Largest distance in pixels between two cameras' images of the rays that `b` sees."""
    rays, valid = b.unproject(b.grid(33, 25).reshape(-1, 2))
    assert bool(valid.all())
    return float((a.project(rays)[0] - b.project(rays)[0]).norm(dim=-1).max())


class TestNoiseFree:
    # Where the residual is zero to 1e-12 px, what is left is that times the condition of the coefficients; the image
    # of every ray is the same to nearly all digits.
    @pytest.mark.parametrize(
        ("model", "digits"),
        [("pinhole", 1e-9), ("opencv4", 1e-9), ("opencv5", 1e-9), ("opencv8", 1e-6), ("opencv12", 1e-6)],
    )
    def test_truth_comes_back(self, model: str, digits: float) -> None:
        truth = camera(model)
        poses = motions(truth, 8, 1)
        result = solve(pixels_of(truth, poses), model)
        assert result.status == SolverStatus.EXACT
        assert result.rms < 1e-11
        assert result.warnings == ()
        assert far_apart(result.camera, truth) < 1e-8
        torch.testing.assert_close(result.camera.params.detach(), truth.params.detach(), rtol=digits, atol=digits)
        torch.testing.assert_close(result.cam_from_board_rotation, poses[0], rtol=0, atol=1e-9)
        torch.testing.assert_close(result.cam_from_board_translation, poses[1], rtol=0, atol=1e-9)
        assert float(result.camera.params[4]) == 0.0

    @pytest.mark.parametrize("model", ["opencv14", "ext20"])
    def test_truth_comes_back_as_a_mapping_where_coefficients_hardly_differ(self, model: str) -> None:
        truth = camera(model)
        pixels = pixels_of(truth, motions(truth, 8, 1))
        result = calibrate_camera(
            observe(pixels),
            # Residuals below 1e-7 px tell nothing more, and the last steps of 20 coefficients are endless.
            CalibrationOptions(weak_prior=None, model=model, solver=LMOptions(max_iterations=150, residual_floor=1e-7)),
        )
        assert result.rms < 1e-4
        # Within the outermost corner: beyond it a few corners of eight boards do not determine 20 coefficients.
        rays, _ = truth.unproject(truth.grid(33, 25).reshape(-1, 2))
        corners, _ = truth.unproject(pixels.reshape(-1, 2))
        rays = rays[rays[:, 2] > 1.01 * corners[:, 2].min()]
        assert len(rays) > 400
        assert float((result.camera.project(rays)[0] - truth.project(rays)[0]).norm(dim=-1).max()) < 1e-2

    @pytest.mark.slow
    def test_board_warp_comes_back(self) -> None:
        truth = camera()
        rotation, translation = motions(truth, 8, 1)
        bent = BOARD.points.clone()
        bent[:, 2] = torch.tensor([0.002, -0.001], dtype=torch.float64) @ warp_modes(BOARD.points)[:, 2]
        pixels, _ = truth.project(bent @ rotation.transpose(-1, -2) + translation[:, None])
        result = solve(pixels, board_warp=True)
        assert result.board_warp is not None
        assert result.status == SolverStatus.EXACT
        expected = torch.tensor([0.002, -0.001], dtype=torch.float64)
        torch.testing.assert_close(result.board_warp, expected, rtol=0, atol=1e-9)
        assert far_apart(result.camera, truth) < 1e-8
        flat = solve(pixels)
        assert flat.board_warp is None
        assert flat.rms > 0.1

    @pytest.mark.parametrize("focal", [180.0, 4000.0])
    @pytest.mark.parametrize("model", ["pinhole", "opencv5"])
    def test_strong_wide_angle_and_telephoto(self, focal: float, model: str) -> None:
        """A third and six times the image's width, far from the guesses; all coefficients small or zero."""
        truth = Camera.build(focal=(focal, 1.01 * focal), center=(325.8, 235.3), size=SIZE, model=model)
        result = solve(pixels_of(truth, motions(truth, 12, 3, tilt=45)), model)
        assert result.status == SolverStatus.EXACT
        # A telephoto lens leaves some digits of its principal point to the poses.
        assert far_apart(result.camera, truth) < 1e-5
        assert float(result.camera.focal[0]) == pytest.approx(focal, rel=1e-7)

    def test_corners_that_were_not_seen(self) -> None:
        truth = camera()
        pixels = pixels_of(truth, motions(truth, 8, 1))
        hidden = torch.rand(pixels.shape[:-1], generator=torch.Generator().manual_seed(1)) < 0.4
        hidden[3, 21:] = True
        pixels[hidden] = torch.nan
        result = solve(pixels)
        assert result.status == SolverStatus.EXACT
        assert far_apart(result.camera, truth) < 1e-8
        assert torch.equal(torch.isnan(result.residuals[..., 0]), hidden)
        assert bool(torch.isfinite(result.per_view_rms).all())


class TestNumbers:
    """What is reported about a noisy fit follows from its residuals."""

    def test_rms_and_residuals(self) -> None:
        pixels = corner_pixels(8, 2, noise=0.3, seed=4)
        pixels[2, 5:11] = torch.nan
        result = solve(pixels)
        rotation, translation = result.cam_from_board_rotation, result.cam_from_board_translation
        projected, _ = result.camera.project(BOARD.points @ rotation.transpose(-1, -2) + translation[:, None])
        torch.testing.assert_close(result.residuals, projected - pixels, rtol=0, atol=1e-9, equal_nan=True)
        squared = (projected - pixels).pow(2).sum(-1)
        assert result.rms == pytest.approx(float(squared.nanmean().sqrt()), rel=1e-12)
        torch.testing.assert_close(result.per_view_rms, squared.nanmean(-1).sqrt(), rtol=1e-10, atol=0)
        # Noise of 0.3 px an axis, less what the parameters took: E rms² = 2 σ² (1 - p / n), within 4 standard errors.
        count = int(torch.isfinite(pixels).sum())
        assert result.rms == pytest.approx(0.3 * (2 * (1 - (9 + 48) / count)) ** 0.5, rel=4 / (2 * count) ** 0.5)

    @pytest.mark.slow
    def test_nested_models_never_end_higher(self) -> None:
        pixels = corner_pixels(8, 20, "opencv14", noise=0.2)
        rms = [solve(pixels, model).rms for model in ("opencv5", "opencv8", "opencv12", "opencv14")]
        # The last bits of a sum of squares.
        assert all(rich <= poor * (1 + 1e-12) for poor, rich in itertools.pairwise(rms)), rms

    @pytest.mark.slow
    @pytest.mark.parametrize("model", ["opencv5", "opencv8"])
    def test_sigma_is_opencvs(self, model: str) -> None:
        cv2 = pytest.importorskip("cv2")
        truth = camera(model)
        pixels = pixels_of(truth, motions(truth, 14, 9), noise=0.2, seed=3).float()
        # To the bottom: σ is steep about the minimum with eight coefficients.
        result = solve(pixels.double(), model, solver=LMOptions(max_iterations=1000, tolerance=1e-13))
        assert result.warnings == ()
        lens = torch.zeros(14).double()
        lens[: truth.model.size] = result.camera.coefficients
        # From kcal's solution, because OpenCV's own start ends in another minimum with eight coefficients.
        flags = cv2.CALIB_USE_INTRINSIC_GUESS | (cv2.CALIB_RATIONAL_MODEL if model == "opencv8" else 0)
        out = cv2.calibrateCameraExtended(
            [BOARD.points.float().numpy()] * len(pixels), list(pixels.numpy()), SIZE,
            result.camera.matrix.numpy().copy(), (lens if model == "opencv8" else lens[:5]).numpy().copy(),
            flags=flags, criteria=(3, 300, 1e-15),
        )  # fmt: skip
        # OpenCV's board corners are float32: 1e-5 px.
        assert result.rms == pytest.approx(out[0], rel=1e-6)
        names = ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"]
        known = dict(zip(names, out[5][:, 0].tolist(), strict=False))
        problem = BoardProblem(BOARD.points, pixels.double(), truth.model, free_parameters(truth.model))
        linear = problem.linearize(as_state(result))
        variance = noise_variance(linear, problem.residual_count, problem.shared_size + 6 * len(pixels))
        for name, sigma in zip(result.sigma, uncertainty_of(linear, float(variance)).sigma.tolist(), strict=True):
            # As above.
            assert sigma == pytest.approx(known[name], rel=1e-5 if model == "opencv5" else 1e-3), name
            # What is reported is no less: of eight coefficients it includes the difference to a weak prior's solution.
            reported = result.sigma[name] or 0.0
            assert reported == pytest.approx(sigma, rel=1e-6) if model == "opencv5" else reported > 0.95 * sigma


def as_state(result: CameraCalibrationResult) -> BoardState:
    poses = result.cam_from_board_rotation, result.cam_from_board_translation
    return BoardState.flat(result.camera.params.detach().clone(), *poses)


class TestSigmaTells:
    @pytest.mark.slow
    def test_monte_carlo(self) -> None:
        """60 repetitions of one capture: spread and predicted σ agree, and the mean is the truth.

        59 s² / σ² follows χ² with 59 degrees of freedom: s² / σ² lies in 0.423 to 1.915 but for 6e-5 of all
        repetitions (4 standard deviations, Wilson-Hilferty); nine parameters, so that one in 2000 test suites with
        other seeds would fail. The mean lies within 4.5 σ / sqrt(60) but for 7e-6.
        """
        truth = camera()
        poses = motions(truth, 8, 21)
        results = [solve(pixels_of(truth, poses, noise=0.2, seed=seed)) for seed in range(60)]
        for name, true in zip(truth.names, truth.params.tolist(), strict=True):
            if name == "skew":
                continue
            values = torch.tensor([fitted(result)[name] for result in results], dtype=torch.float64)
            predicted = torch.tensor([result.sigma[name] or torch.nan for result in results], dtype=torch.float64)
            variance = float((predicted**2).mean())
            assert 0.423 < float(values.var()) / variance < 1.915, name
            assert abs(float(values.mean()) - true) < 4.5 * (variance / 60) ** 0.5, name

    @pytest.mark.slow
    def test_more_coefficients_than_the_lens_has(self) -> None:
        """Trap 2: 8 and 14 coefficients on a lens of five fit better and know less, and σ or a warning says so.

        4 σ holds but for 6e-5 of all captures, for each of four parameters.
        """
        truth = camera()
        pixels = pixels_of(truth, motions(truth, 14, 1), noise=0.2, seed=1)
        for model in ("opencv5", "opencv8", "opencv14"):
            result = solve(pixels, model)
            off = {
                name: abs(fitted(result)[name] - float(truth.params[i])) / (result.sigma[name] or torch.inf)
                for i, name in enumerate(("fx", "fy", "cx", "cy"))
            }
            if model == "opencv5":
                assert result.warnings == ()
            assert max(off.values()) < 4.0 or result.warnings, off


class TestFlips:
    @pytest.mark.parametrize("seed", [1, 2])
    def test_many_small_boards(self, seed: int) -> None:
        """A hundred boards of a tenth of the image: no view stays in the mirrored tilt."""
        truth = camera()
        poses = motions(truth, 100, seed, fill=0.12, tilt=20)
        pixels = pixels_of(truth, poses, noise=0.3, seed=seed)
        result = solve(pixels)
        problem = BoardProblem(BOARD.points, pixels, truth.model, free_parameters(truth.model))
        start = dataclasses.replace(
            result, camera=truth, cam_from_board_rotation=poses[0], cam_from_board_translation=poses[1]
        )
        reached = (2.0 * float(minimize(problem, as_state(start)).cost) / (100 * BOARD.corners)) ** 0.5
        # A flip left standing raises the RMS of its own view by some percent; at 1e-3 of a view's cost a twin is not
        # worth the change.
        assert result.rms <= reached * (1 + 1e-4)


def _left_out(result: CameraCalibrationResult) -> dict[str, str]:
    """Views left out, with their reasons; a warning names each of them."""
    found = {view.view: view.reason for view in result.rejected_views}
    assert all(any(name in text and why in text for text in result.warnings) for name, why in found.items())
    return found


class TestDegenerate:
    def test_no_view(self) -> None:
        with pytest.raises(InputError, match="no view with a board"):
            calibrate_camera(observe(torch.zeros(0, BOARD.corners, 2).double()), CalibrationOptions(model="opencv5"))

    @pytest.mark.parametrize("views", [1, 2])
    def test_too_few_views(self, views: int) -> None:
        with pytest.raises(DegenerateError, match=rf"^{views} views? of the board: at least 3 at different tilts"):
            solve(corner_pixels(views, 1))

    @pytest.mark.slow
    @pytest.mark.parametrize(("model", "noise"), [("pinhole", 0.5), ("opencv5", 0.0)])
    def test_all_parallel_to_the_image(self, model: str, noise: float) -> None:
        """Trap 9: focal length and distance cannot be told apart, however small the residuals are."""
        truth = camera(model)
        rotation = torch.eye(3, dtype=torch.float64).expand(8, 3, 3)
        shift = torch.arange(8, dtype=torch.float64)
        translation = torch.stack([-0.15 + 0.02 * shift, -0.12 - 0.01 * shift, 0.5 + 0.05 * shift], -1)
        with pytest.raises(DegenerateError, match=r"determine the focal length.* tilted by 30 to 45 degrees"):
            solve(pixels_of(truth, (rotation, translation), noise=noise), model)

    @pytest.mark.parametrize("noise", [0.2, 0.5])
    def test_the_same_view_again_and_again(self, noise: float) -> None:
        truth = camera()
        rotation, translation = motions(truth, 1, 5)
        poses = (rotation.expand(8, 3, 3), translation.expand(8, 3))
        with pytest.raises(DegenerateError, match="too similar"):
            solve(pixels_of(truth, poses, noise=noise))

    def test_too_few_corners_in_a_view(self) -> None:
        """Such a view is left out, with a warning; the others give the camera that they give alone."""
        pixels = corner_pixels(5, 1)
        alone = solve(pixels[[0, 1, 2, 4]])
        for count in (5, 0):
            pixels[3, count:] = torch.nan
            found = solve(pixels)
            assert _left_out(found) == {"v03": f"it has {count} corners, and at least 6 are needed"}
            # The same minimization; where memory lies decides the order of its sums.
            torch.testing.assert_close(found.camera.params, alone.camera.params, rtol=1e-7, atol=1e-9)
            assert found.per_view_rms.isnan().tolist() == [False, False, False, True, False]

    def test_corners_on_one_line(self) -> None:
        """The pose of such a view is open, and would spoil all others."""
        pixels = corner_pixels(5, 1, noise=0.1)
        pixels[3, [i for i in range(BOARD.corners) if i % 7]] = torch.nan
        assert "lie on one line" in _left_out(solve(pixels))["v03"]

    @pytest.mark.slow
    def test_too_few_corners_in_all(self) -> None:
        pixels = corner_pixels(3, 1, "opencv14")
        keep = [0, 6, 35, 41, 20, 16]
        pixels[:, [i for i in range(BOARD.corners) if i not in keep]] = torch.nan
        with pytest.raises(DegenerateError, match="18 corners in 3 views cannot determine 36 parameters"):
            solve(pixels, "opencv14")

    def test_corners_in_one_point_and_edge_on(self) -> None:
        pixels = corner_pixels(5, 1)
        pixels[2] = 100.0
        assert _left_out(solve(pixels)) == {"v02": "its corners coincide, or the board is seen edge-on"}
        pixels[2, :, 0] = torch.linspace(50, 500, BOARD.corners).double()
        assert _left_out(solve(pixels)) == {"v02": "its corners coincide, or the board is seen edge-on"}


class TestWarnings:
    def test_one_bad_view_is_named(self) -> None:
        pixels = corner_pixels(8, 2, noise=0.1)
        assert solve(pixels).warnings == ()
        pixels[5] += torch.randn(BOARD.corners, 2, generator=torch.Generator().manual_seed(3)).double()
        warnings = solve(pixels).warnings
        assert len(warnings) == 1
        assert warnings[0].startswith("view v05: RMS 1.")

    def test_high_rms(self) -> None:
        warnings = solve(corner_pixels(10, 2, noise=1.0)).warnings
        assert any("px is high" in text for text in warnings)
        assert not any("view v" in text for text in warnings)

    def test_lens_that_folds_inside_the_image(self) -> None:
        """Small boards in the middle say nothing of the border, and k1 = -0.5 folds before it."""
        truth = Camera.build(focal=(300, 303), center=(319.5, 239.5), size=SIZE, coefficients=[-0.5], model="opencv4")
        wide = Camera.build(focal=(900, 900), center=(319.5, 239.5), size=SIZE, model="opencv4")
        rotation, translation = motions(wide, 10, 2, fill=0.5)
        result = solve(pixels_of(truth, (rotation, translation), noise=0.05), "opencv4")
        folded = [text for text in result.warnings if "folds inside the image" in text]
        assert folded
        assert "has no ray" in folded[0]

    def test_steps_run_out(self) -> None:
        result = solve(corner_pixels(8, 2, noise=0.1), solver=LMOptions(max_iterations=1))
        assert result.status == SolverStatus.ITERATION_LIMIT
        assert any("iteration limit" in text for text in result.warnings)

    def test_not_determined(self) -> None:
        """All corners near one radius: numerator and denominator cannot be told apart."""
        truth = camera("pinhole")
        result = solve(pixels_of(truth, motions(truth, 8, 2)), "opencv8")
        lost = [name for name, sigma in result.sigma.items() if sigma is None]
        assert {"k1", "k4"} <= set(lost)
        assert any(f"do not determine {', '.join(lost)}" in text for text in result.warnings)
        # What the data do determine is still the truth.
        assert far_apart(result.camera, truth) < 1e-6


def test_progress_is_told() -> None:
    told: list[str] = []
    seen = observe(corner_pixels(6, 2, "opencv8"))
    calibrate_camera(seen, CalibrationOptions(weak_prior=None, model="opencv8"), told.append)
    assert told == ["base projection", "opencv8"]


def test_order_of_views_does_not_matter() -> None:
    pixels = corner_pixels(7, 2, noise=0.2)
    a, b = solve(pixels), solve(pixels.flip(0))
    # Both stop where the cost is flat to 1e-12 of itself.
    assert far_apart(a.camera, b.camera) < 1e-4
    assert a.rms == pytest.approx(b.rms, rel=1e-11)
