import pytest
import torch
from calibrate_scenes import camera, motions, observe, pixels_of

from kcal.calibrate.camera.calibrate import CalibrationOptions, calibrate_camera
from kcal.calibrate.problem.board_problem import BoardProblem
from kcal.calibrate.problem.state import BoardState
from kcal.calibrate.problem.views import whitening
from kcal.corners.observations import Observations
from kcal.lens.pose import rotation_from_vector


def with_covariance(seen, sigma):
    """The observations with a covariance of sigma² (V,) for each view's corners."""
    views = []
    for view, value in zip(seen.views, sigma.tolist(), strict=True):
        spread = tuple(None if pixel is None else (value**2, 0.0, value**2) for pixel in view.pixels)
        views.append(view.model_copy(update={"covariance": spread}))
    return Observations.model_validate(seen.model_copy(update={"views": tuple(views)}).model_dump())


def mixed(seed):
    """Views of which every second one is ten times as blurred, and what is known about that."""
    truth = camera()
    poses = motions(truth, 12, seed)
    sigma = torch.where(torch.arange(12) % 2 == 0, 0.02, 0.3).double()
    exact = pixels_of(truth, poses)
    noise = torch.randn(exact.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return truth, with_covariance(observe(exact + sigma[:, None, None] * noise), sigma)


def test_weights_follow_the_covariances():
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(3, 5, 2, 2, generator=generator, dtype=torch.float64)
    covariances = root @ root.mT + 0.1 * torch.eye(2, dtype=torch.float64)
    own = float(covariances.diagonal(dim1=-2, dim2=-1).mean())
    W = whitening(covariances, own + 0.3)
    product = W @ (covariances + 0.3 * torch.eye(2, dtype=torch.float64)) @ W.mT
    scale = product[0, 0, 0, 0]
    torch.testing.assert_close(product, scale * torch.eye(2).double().expand_as(product), rtol=1e-12, atol=1e-12)
    assert float((W.mT @ W).diagonal(dim1=-2, dim2=-1).mean()) == pytest.approx(1.0, abs=1e-12)


def test_equal_covariances_change_nothing():
    truth = camera()
    seen = observe(pixels_of(truth, motions(truth, 6, 1), noise=0.1))
    plain = calibrate_camera(seen, CalibrationOptions(model="opencv5"))
    weighted = calibrate_camera(with_covariance(seen, torch.full((6,), 0.05)), CalibrationOptions(model="opencv5"))
    # Both stop at a minimum found to 1e-12 of its cost, which is flat: parameters to 1e-6 of their σ.
    torch.testing.assert_close(weighted.camera.params, plain.camera.params, rtol=1e-6, atol=1e-6)
    assert weighted.rms == pytest.approx(plain.rms, rel=1e-12)
    assert weighted.weighted_rms == pytest.approx(plain.rms, rel=1e-9)
    assert plain.weighted_rms is None


def test_weights_beat_no_weights_and_know_their_error():
    error = {True: [], False: []}
    pull = []
    for seed in range(4):
        truth, seen = mixed(seed)
        for weighted in (True, False):
            result = calibrate_camera(seen, CalibrationOptions(model="opencv5", weighted=weighted))
            away = result.camera.params[:4] - truth.params[:4]
            error[weighted].append(away)
            if weighted:
                pull.append(away / torch.tensor([result.sigma[name] for name in ("fx", "fy", "cx", "cy")]))
                # The plain RMS stays OpenCV's: 0.3 px in half of the views, two axes.
                assert result.rms == pytest.approx(0.3, rel=0.15)
                assert result.weighted_rms < 0.5 * result.rms
    good, bad = (torch.stack(error[key]).square().mean().sqrt() for key in (True, False))
    assert float(good) < 0.4 * float(bad)
    # 16 numbers, of which four at a time depend on each other.
    assert 0.4 < float(torch.stack(pull).square().mean().sqrt()) < 1.8


def test_rows_are_the_derivatives_of_weighted_residuals():
    truth = camera()
    rotation, translation = motions(truth, 3, 2)
    pixels = pixels_of(truth, (rotation, translation), noise=0.2)
    pixels[1, 4] = torch.nan
    root = torch.randn(*pixels.shape, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    weights = torch.where(torch.isnan(pixels)[..., None], torch.nan, root)
    board = observe(pixels).board.points
    free = [0, 1, 2, 3, 5, 6]
    problem = BoardProblem(board, pixels, truth.model, free, weights=weights)
    state = BoardState.flat(
        truth.params.detach() + 0.01,
        rotation_from_vector(torch.full((3, 3), 1e-3, dtype=torch.float64)) @ rotation,
        translation + 1e-3,
    )
    errors = problem.pixel_errors(state).mT  # (V, N, 2)
    by_hand = (torch.nan_to_num(weights) @ errors[..., None])[..., 0]
    torch.testing.assert_close(problem.residuals(state), by_hand.mT.flatten(-2), rtol=1e-12, atol=1e-12)
    rows = problem.rows(state)
    torch.testing.assert_close(rows[:, -1], problem.residuals(state), rtol=1e-12, atol=1e-12)
    step = 1e-6
    for k in range(problem.shared_size):
        shared, local = torch.zeros(problem.shared_size).double(), torch.zeros(3, 6).double()
        shared[k] = step * max(1.0, float(state.parameters[free[k]]))
        plus = problem.residuals(problem.retract(state, (shared, local)))
        minus = problem.residuals(problem.retract(state, (-shared, local)))
        difference = (plus - minus) / (2 * shared[k])
        # Central differences: 1e-16 x residuals of 1 over steps of 1e-6.
        torch.testing.assert_close(rows[:, 6 + k], difference, rtol=1e-6, atol=1e-6 * float(difference.abs().max()))
