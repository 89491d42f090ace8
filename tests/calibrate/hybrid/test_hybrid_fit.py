"""The hybrid camera by evidence: simulated truth with a wandering pupil and a printed board comes back."""

import functools
import math

import numpy as np
import pytest
import torch
from hybrid_views import views_of
from printed_boards import WIDE, middle_error, printed_views
from standing_views import quadratic, standing
from torch import Tensor

from kcal import Board, Camera, InputError
from kcal.calibrate.hybrid.board_modes import board_modes
from kcal.calibrate.hybrid.evidence import (
    Amplitudes,
    Quadratic,
    maximize_evidence,
    negative_log_evidence,
    with_tempering,
)
from kcal.calibrate.hybrid.families import PriorFamilies, prior_families, typical_hyperprior
from kcal.calibrate.hybrid.fit import FitOptions, HybridFit, fit_hybrid
from kcal.calibrate.problem.state import BoardState
from kcal.lens import LensModel, rotation_from_vector
from kcal.lens.model import HybridForm
from kcal.lens.zernike import ZernikeModes
from kcal.sim.captures import drawn_lens
from scripts.shared.captures import MACHINE_VISION, capture_corners

BOARD = Board(columns=9, rows=7, square=0.04)
SIZE = (1280, 960)
NOISE = 0.05


def views(count: int, seed: int, points: Tensor = BOARD.points, pupil: float = 0.0) -> Tensor:
    return printed_views(WIDE, BOARD, points, count, seed, noise=NOISE, pupil=pupil)


@functools.cache
def printed() -> HybridFit:
    """A capture with a wandering pupil of a board that is bent and stretched, fitted."""
    middle = BOARD.points.mean(0)
    a, b, _ = ((BOARD.points - middle) / middle.clamp_min(1.0 / 32)).unbind(-1)
    bent = (BOARD.points - middle) * torch.tensor([1.0015, 1.0, 1.0]) + torch.stack([0 * a, 0 * a, 0.8e-3 * a * b], 1)
    return fit_hybrid(BOARD.points, views(25, 1, bent + middle, 3e-3), SIZE)


def test_noise_and_far_directions_come_back() -> None:
    """Where boards were seen, the camera is good to twice the noise of one corner at infinity too."""
    found = printed()
    assert middle_error(found.camera, WIDE, 0.75) < 0.1
    assert found.sigma == pytest.approx(NOISE, rel=0.05)
    assert found.rms == pytest.approx(NOISE * math.sqrt(2.0), rel=0.08)
    assert found.tempering < 1.3


def test_pupil_and_board_come_back() -> None:
    found = printed()
    deviation = found.half.square().sum(0).sqrt()
    names = found.camera.names
    pupil = float(found.camera.params[names.index("pupil1")])
    # Unknowns: focal length, principal point, coefficients, board; parameters have fx, fy, cx, cy, skew first.
    sigma = float(deviation[names.index("pupil1") - 2])
    assert abs(pupil - 3e-3) < 4.0 * sigma
    assert sigma < 1e-3
    measured, ordered = found.board_points, BOARD.points
    assert float(measured[0, 2] - measured[BOARD.columns - 1, 2]) == pytest.approx(1.6e-3, abs=2e-4)
    width = (measured[BOARD.columns - 1, 0] - measured[0, 0]) / (ordered[BOARD.columns - 1, 0] - ordered[0, 0])
    height = (measured[-1, 1] - measured[0, 1]) / (ordered[-1, 1] - ordered[0, 1])
    assert float(width / height) == pytest.approx(1.0015, abs=3e-4)


def test_an_exact_board_and_few_views() -> None:
    pixels = views(6, 3)
    free, exact = (
        fit_hybrid(BOARD.points, pixels, SIZE, options=FitOptions(board=kind)) for kind in ("printed", "exact")
    )
    torch.testing.assert_close(exact.board_points, BOARD.points, rtol=0, atol=0)
    assert middle_error(exact.camera, WIDE, 0.75) < 1.0
    assert middle_error(free.camera, WIDE, 0.75) < 2.0
    assert float(exact.half[:, -28:].abs().max()) == 0.0


def test_weights_and_missing_corners() -> None:
    """A corner of weight zero counts as little as one that was not seen."""
    pixels = views(8, 4)
    wrong, missing, weights = pixels.clone(), pixels.clone(), torch.ones_like(pixels[..., 0])
    wrong[2, 5] += 40.0
    missing[2, 5] = torch.nan
    weights[2, 5] = 0.0
    one, other = fit_hybrid(BOARD.points, wrong, SIZE, weights), fit_hybrid(BOARD.points, missing, SIZE)
    torch.testing.assert_close(one.camera.params, other.camera.params, rtol=0, atol=0)


def linear_case() -> tuple[Quadratic, PriorFamilies]:
    form = HybridForm(shape=0.4, radius=1.1)
    families = prior_families(form, 800.0, board_modes(BOARD.points), SIZE, 0.6)
    generator = torch.Generator().manual_seed(5)
    rows = torch.randn(400, len(families.mean), generator=generator, dtype=torch.float64)
    rows = rows / families.deviation(typical_hyperprior().mean)
    target = 0.3 * torch.randn(400, generator=generator, dtype=torch.float64)
    assert len(families.mean) == 3 + LensModel(hybrid=form).size + 28
    return quadratic(rows, target, torch.zeros_like(families.mean)), families


def test_evidence_is_found_where_a_trial_cannot_be_factorized() -> None:
    """Data that determine few directions very well: at the bounds the matrix cannot be factorized."""
    _, families = linear_case()
    h = typical_hyperprior().mean
    generator = torch.Generator().manual_seed(2)
    wide = families.deviation(h)
    few = 1e2 * torch.randn(400, 5, generator=generator, dtype=torch.float64)
    rows = few @ torch.randn(5, len(wide), generator=generator, dtype=torch.float64) / wide
    truth = 30.0 * wide * torch.randn(len(wide), generator=generator, dtype=torch.float64)
    data = quadratic(rows, 0.3 * torch.randn(400, generator=generator, dtype=torch.float64), truth)
    prior = typical_hyperprior()
    mean, sd = prior.mean.numpy(), prior.sd.numpy()
    far = families.deviation(torch.from_numpy(mean + 5 * sd)) / 1e-3
    _, failed = torch.linalg.cholesky_ex(data.K * far[:, None] * far + torch.eye(len(far), dtype=far.dtype))
    assert int(failed)

    def value(v: np.ndarray) -> float:
        z = (v[:-1] - mean) / sd
        return negative_log_evidence(data, families, v)[0] + 0.5 * float(z @ z)

    assert math.isinf(value(np.append(mean + 5 * sd, math.log(1e-6))))
    found, variance, _, loss = maximize_evidence(standing(data), families, Amplitudes(h, 100.0))
    best = np.append(found.numpy(), math.log(variance))
    # At a condition of 1e14, values at places that differ in their last digit differ by up to half a nat (measured).
    rounding = 0.5
    assert loss == pytest.approx(value(best), abs=rounding)
    assert loss < value(np.append(h.numpy(), math.log(100.0))) - 3000.0
    for step in 0.3 * np.vstack([np.eye(len(best)), -np.eye(len(best))]):
        assert value(best + step) > loss - rounding
    # Of 395 squares: 7 %.
    assert variance == pytest.approx(0.3**2, rel=0.2)
    again = maximize_evidence(standing(data), families, Amplitudes(found, variance)).loss
    assert loss == pytest.approx(again, abs=rounding)


@pytest.mark.parametrize("unit", [1.0, 100.0])
def test_losses_of_unequal_tempering_are_brought_to_one(unit: float) -> None:
    """Whatever the unit of residuals, as if the maximum had been looked for at the other tempering."""
    (_, families), generator = linear_case(), torch.Generator().manual_seed(7)
    h = typical_hyperprior().mean
    wide = families.deviation(typical_hyperprior().mean)
    rows = 1e3 * torch.randn(2000, len(wide), generator=generator, dtype=torch.float64)
    noise = 0.1 * torch.randn(2000, generator=generator, dtype=torch.float64)
    truth = wide * torch.randn(len(wide), generator=generator, dtype=torch.float64)
    data = standing(quadratic(unit * rows, unit * noise, truth))
    one, other = (
        maximize_evidence(data, families, Amplitudes(h, (0.1 * unit) ** 2), tempering=tempering)
        for tempering in (1.1, 1.0)
    )
    found = with_tempering(one.loss, data.still.freedom, one.variance, 1.1, 1.0)
    assert abs(one.loss - other.loss) > 100.0
    assert found == pytest.approx(other.loss, abs=0.5)


def test_evidence_has_no_rounding_of_squares() -> None:
    """Residuals of 1e-7 of what the unknowns explain: value and slope agree with the linear model's, solved by QR."""
    _, families = linear_case()
    generator = torch.Generator().manual_seed(4)
    size = len(families.mean)
    rows = torch.randn(400, size, generator=generator, dtype=torch.float64) / families.deviation(
        typical_hyperprior().mean
    )
    at = torch.full((size,), 1e4, dtype=torch.float64) / rows.sum(1).std()
    data = quadratic(rows, 1e-3 * torch.randn(400, generator=generator, dtype=torch.float64), at)
    v = np.append(typical_hyperprior().mean.numpy(), 2.0 * math.log(1e-3))
    slope = negative_log_evidence(data, families, v)[1]
    for k in range(len(v)):
        step = 1e-4 * np.eye(len(v))[k]
        ahead, behind = (negative_log_evidence(data, families, v + sign * step)[0] for sign in (1, -1))
        assert slope[k] == pytest.approx((ahead - behind) / 2e-4, rel=1e-4, abs=1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [60, 63])
def test_the_start_of_a_narrow_lens(seed: int) -> None:
    """Five views of 60 degrees: projections of 160 degrees, whose angles hardly differ, must not win the start."""
    lens = drawn_lens(MACHINE_VISION, 1.0, seed)
    capture = capture_corners(lens, 5, sigma=0.1, seed=seed)
    modes = ZernikeModes(radial=7, decentered=4, astigmatic=3, other=3)
    found = fit_hybrid(capture.points, capture.pixels, lens.size, options=FitOptions(modes=modes))
    assert float(found.camera.focal[0]) == pytest.approx(1600.0, rel=0.03)
    assert found.sigma == pytest.approx(0.1, rel=0.15)


def test_a_start_may_have_corners_beyond_the_disc() -> None:
    """Steps lead from there to states where all have an image; a state without one is never accepted."""
    found = printed()
    pixels = views(4, 7)
    model = LensModel(hybrid=HybridForm(shape=0.4, radius=0.2))
    count = 3 + model.size + 28
    held = torch.full((count,), torch.inf, dtype=torch.float64)
    problem = views_of(BOARD.points, found.board_shapes, pixels).problem_under(model, torch.zeros_like(held), held)
    params = torch.zeros(5 + model.size, dtype=torch.float64)
    params[:4] = found.camera.params.detach()[:4]
    state = BoardState.still(params, 0 * found.state.board, found.state.rotation[:4], found.state.translation[:4])
    assert math.isnan(float(problem.cost(state)))
    assert math.isfinite(float(problem.linearize(state).cost))


def test_a_fit_begins_where_another_has_settled() -> None:
    pixels = views(12, 3)
    weights = torch.ones(pixels.shape[:2], dtype=torch.float64)
    weights[2, 5] = 0.0
    whole = fit_hybrid(BOARD.points, pixels, SIZE, weights)
    assert bool(whole.residuals[2, 5].isnan().all())
    again = fit_hybrid(BOARD.points, pixels, SIZE, weights, start=whole)
    spread = whole.covariance.diagonal().sqrt().clamp_min(1e-12)
    assert float(((again.camera.params - whole.camera.params) / spread).abs().max()) < 0.1
    # It begins at the end of the rounds, and not at the base projection.
    assert again.iterations < 2 * whole.iterations
    with pytest.raises(InputError, match="no start explains"):
        fit_hybrid(BOARD.points, torch.full_like(pixels, torch.nan), SIZE, weights)


def tilted_views(count: int, seed: int) -> Tensor:
    """Corners (V, N, 2) of a flat board, tilted by any angles up to 0.6 rad."""
    generator, middle, out = torch.Generator().manual_seed(seed), BOARD.points.mean(0), list[Tensor]()
    while len(out) < count:
        u = 2.0 * torch.rand(6, generator=generator, dtype=torch.float64) - 1.0
        tilt, roll = u.new_tensor([0.6, 0.6, 0.0]) * u[:3], u.new_tensor([0.0, 0.0, math.pi]) * u[2]
        center = torch.stack([0.35 * u[3], 0.25 * u[4], torch.ones_like(u[0])]) * (0.55 + 0.15 * u[5])
        turn = rotation_from_vector(tilt) @ rotation_from_vector(roll)
        pixels, valid = WIDE.project((BOARD.points - middle) @ turn.T + center)
        if bool(valid.all()) and bool((pixels > 5).all()) and bool((pixels < torch.tensor(SIZE) - 6).all()):
            out.append(pixels + NOISE * torch.randn(pixels.shape, generator=generator, dtype=torch.float64))
    return torch.stack(out)


def test_weights_follow_residuals_of_the_first_rounds() -> None:
    pixels = tilted_views(12, 3)
    given = torch.ones(pixels.shape[:2], dtype=torch.float64)
    given[:, ::2] = 0.3
    stiff = FitOptions(bending=False, corners=False)
    known, seen = fit_hybrid(BOARD.points, pixels, SIZE, given, stiff), []

    def weigh(residuals: torch.Tensor) -> torch.Tensor:
        seen.append(float(residuals.square().sum(-1).nanmean().sqrt()))
        return given

    found = fit_hybrid(BOARD.points, pixels, SIZE, options=stiff, weigh=weigh)
    assert torch.equal(found.weights, given)
    assert found.weighted_rms == pytest.approx(known.weighted_rms, rel=1e-3)
    spread = known.covariance.diagonal().sqrt().clamp_min(1e-12)
    assert float(((found.camera.params - known.camera.params) / spread).abs().max()) < 0.1
    plain = fit_hybrid(BOARD.points, pixels, SIZE, options=stiff)
    assert seen == [pytest.approx(plain.rms, rel=5e-3)]
    assert float(((plain.camera.params - known.camera.params) / spread).abs().max()) > 0.2


def test_a_lens_seen_in_a_ring_alone_comes_to_rest() -> None:
    """As through a mirror: focal length, shape and field stand for each other, and the rounds drifted to their end."""
    generator = torch.Generator().manual_seed(2)
    camera = Camera.build(
        focal=(82, 82), center=(323, 248), size=(640, 480), coefficients=[0.02, -0.01, 0, 0], model="fisheye4"
    )
    points = Board(columns=11, rows=7, square=0.03).points
    middle, seen = points.mean(0), []
    while len(seen) < 12:
        u = torch.rand(6, generator=generator, dtype=torch.float64)
        around, away = 2.0 * math.pi * u[0], 0.7 + 1.05 * u[1]
        face = rotation_from_vector(away * torch.stack([-around.sin(), around.cos(), 0.0 * around]))
        rotation = face @ rotation_from_vector((u[2:5] - 0.5) * torch.tensor([1.2, 1.2, 0.8], dtype=torch.float64))
        pixels, valid = camera.project((points - middle) @ rotation.T + (0.25 + 0.25 * u[5]) * face[:, 2])
        off = (pixels - camera.center).norm(dim=-1)
        valid &= (off > 60) & (off < 200)
        if int(valid.sum()) >= 40:
            noise = NOISE * torch.randn(pixels.shape, generator=generator, dtype=torch.float64)
            seen.append(torch.where(valid[:, None], pixels + noise, torch.nan))
    fit = fit_hybrid(points, torch.stack(seen), (640, 480))
    assert fit.converged
    assert float(fit.state.parameters[0] / fit.families.mean[0]) < 1.5
    assert fit.sigma == pytest.approx(NOISE, rel=0.1)
