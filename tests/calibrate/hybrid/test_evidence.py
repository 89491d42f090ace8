"""Evidence, amplitudes and unknowns of the default lens."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from hybrid_views import views_of
from scipy import integrate, stats

from kcal.calibrate.hybrid.board_modes import BoardModes
from kcal.calibrate.hybrid.evidence import (
    Amplitudes,
    EvidenceLoss,
    ViewData,
    evidence_of_motion,
    expected_amplitudes,
    hyper_bounds,
    maximize_evidence,
    relative_bends,
    steps_of_amplitudes,
    view_data,
)
from kcal.calibrate.hybrid.families import Hyperprior, PriorFamilies
from kcal.calibrate.hybrid.fitted_views import hybrid_unknowns
from kcal.calibrate.problem.state import AMPLITUDES, HAND, HAND_SPREAD, MEDIAN, MOTION, SPREAD, usual_motion
from kcal.corners.board import Board
from kcal.lens.model import HybridForm, LensModel
from kcal.lens.zernike import ZernikeModes
from kcal.solve.schur import Products

# The evidence of lens, board and motions against the density of the residuals, written out; its gradient.


F64 = torch.float64

VIEWS, ROWS, UNKNOWNS = 3, 20, 5

PRIOR = Hyperprior(torch.tensor([0.2, -0.5], dtype=F64), torch.tensor([1.5, 2.0], dtype=F64))

# Two unknowns of one amplitude, one of the other with a decay, one that is given.
FAMILIES = PriorFamilies(
    mean=torch.zeros(UNKNOWNS, dtype=F64),
    log_unit=torch.tensor([0.0, 0.1, -0.2, 0.3, 0.0], dtype=F64),
    amplitude=torch.tensor([0, 0, 1, -1, 1]),
    decay=torch.tensor([-1, -1, 0, -1, -1]),
    degree=torch.tensor([0.0, 0.0, 0.7, 0.0, 0.0], dtype=F64),
)

# h, logarithms of the ratios, ln σ².
AT = np.array([0.4, -0.3, 0.2, -0.4, 0.1, 0.5, -0.6])


def rows(moving: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """U (V, M, R), A (V, S, R), residuals (V, R), and where they were taken: x (S,) and motions (V, M)."""
    generator = np.random.default_rng(5)
    motions = MOTION if moving else 0
    shapes = (VIEWS, motions, ROWS), (VIEWS, UNKNOWNS, ROWS), (VIEWS, ROWS), (UNKNOWNS,), (VIEWS, motions)
    return tuple(generator.normal(size=shape) for shape in shapes)  # type: ignore[return-value]


def data(moving: bool) -> ViewData:
    U, A, residual, x, motion = (torch.from_numpy(part) for part in rows(moving))
    products = Products.of_rows(torch.cat([U, A, residual[:, None]], 1), U.shape[1])
    return view_data(products, x, motion, float(VIEWS * ROWS))


def density(moving: bool, still: bool = False) -> float:
    """-ln p of the residuals, without (rows / 2) ln 2 pi."""
    U, A, residual, x, motion = rows(moving)
    offset = (residual - np.einsum("s,vsr->vr", x, A) - np.einsum("vm,vmr->vr", motion, U)).ravel()
    deviation = FAMILIES.deviation(torch.from_numpy(AT[:2])).numpy()
    flat = A.transpose(0, 2, 1).reshape(-1, UNKNOWNS) * deviation
    variance = math.exp(AT[-1])
    covariance = variance * np.eye(len(offset)) + flat @ flat.T
    for view in range(VIEWS if moving and not still else 0):
        ratio = np.repeat(np.exp(AT[2:6]), MOTION // AMPLITUDES)
        own = slice(view * ROWS, (view + 1) * ROWS)
        covariance[own, own] += variance * (U[view].T * ratio**2) @ U[view]
    return -float(stats.multivariate_normal.logpdf(offset, cov=covariance)) - 0.5 * len(offset) * math.log(2 * math.pi)


def vector(moving: bool) -> np.ndarray:
    return AT if moving else AT[[0, 1, 6]]


@pytest.mark.parametrize("moving", [False, True])
def test_value_is_the_density_of_the_residuals(moving: bool) -> None:
    z = (AT[:2] - PRIOR.mean.numpy()) / PRIOR.sd.numpy()
    # The motions' standard deviations themselves are log-normal, not their ratios to the noise.
    w = (AT[2:6] + 0.5 * AT[-1] - math.log(MEDIAN)) / SPREAD if moving else np.zeros(0)
    wanted = density(moving) + 0.5 * float(z @ z + w @ w)
    loss = EvidenceLoss(data(moving), FAMILIES, PRIOR, 1.0)
    assert loss.value(vector(moving)) == pytest.approx(wanted, rel=1e-10)
    assert loss(vector(moving))[0] == pytest.approx(wanted, rel=1e-10)


def check_derivatives(loss: EvidenceLoss, at: np.ndarray) -> None:
    steps = 1e-5 * np.eye(len(at))
    slopes = [(loss.value(at + step) - loss.value(at - step)) / 2e-5 for step in steps]
    _, found, bend = loss(at)
    np.testing.assert_allclose(found, slopes, rtol=1e-6, atol=1e-6)
    bends = [(loss(at + step)[1] - loss(at - step)[1]) / 2e-5 for step in steps]
    np.testing.assert_allclose(bend, bends, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("tempering", [1.0, 1.7])
@pytest.mark.parametrize("moving", [False, True])
def test_derivatives(moving: bool, tempering: float) -> None:
    check_derivatives(EvidenceLoss(data(moving), FAMILIES, PRIOR, tempering), vector(moving))


def test_views_too_few_to_tell_whether_they_moved() -> None:
    """Their motions' amplitudes are about those of a hand; the board's bending stays as it is."""
    hand = EvidenceLoss(data(True), FAMILIES, PRIOR._replace(by_hand=True), 1.0)
    log_sigma = AT[2:6] + 0.5 * AT[-1]
    other, typical = (log_sigma - np.log(HAND)) / HAND_SPREAD, (log_sigma - math.log(MEDIAN)) / SPREAD
    change = hand(AT)[0] - EvidenceLoss(data(True), FAMILIES, PRIOR, 1.0)(AT)[0]
    assert change == pytest.approx(0.5 * float(other @ other - typical @ typical))
    check_derivatives(hand, AT)
    mean, sd = usual_motion(5, True)
    assert (mean[4], sd[4]) == (math.log(MEDIAN), SPREAD)


@pytest.mark.parametrize("amplitudes", [[4], [0, 1, 2, 3, 4]])
def test_derivatives_where_the_board_bends(amplitudes: list[int]) -> None:
    """By one amplitude of twelve numbers, whose deviations differ by view; of its own, and beside motion."""
    U, A, residual, x, motion = (torch.from_numpy(part) for part in rows(True))
    relative = torch.tensor([0.5, 3.0, 1.0], dtype=F64)
    both, numbers = torch.cat([U, U.flip(-1)], 1), torch.cat([motion, -motion], 1)
    products = Products.of_rows(torch.cat([both, A, residual[:, None]], 1), both.shape[1])
    found = view_data(products, x, numbers, float(VIEWS * ROWS))._replace(relative=relative).only(amplitudes)
    assert found.own.shape[-1] == 12 * (1 + (len(amplitudes) > 1))
    at = np.concatenate([AT[:2], np.array([0.2, -0.4, 0.1, 0.5, 0.3])[amplitudes], AT[-1:]])
    check_derivatives(EvidenceLoss(found, FAMILIES, PRIOR, 1.3), at)
    # 1/w² has a gamma prior of three degrees of freedom and mean one.
    precision = relative**-2
    assert found.unequal == pytest.approx(1.5 * float((precision - 1.0 - precision.log()).sum()))


def test_factors_of_views_are_the_most_likely() -> None:
    """-ln p of residuals, factors and their amplitude, lens and board held, does not fall by a small change of any."""
    U, A, residual, x, motion = (torch.from_numpy(part) for part in rows(True))
    products = Products.of_rows(torch.cat([U, A, residual[:, None]], 1), MOTION)
    begun = view_data(products, x, motion, float(VIEWS * ROWS))._replace(relative=torch.ones(VIEWS, dtype=F64))
    # No prior lets lens and board move.
    held = FAMILIES._replace(log_unit=torch.full((UNKNOWNS,), -30.0, dtype=F64))
    relative, best = begun.relative, Amplitudes(torch.from_numpy(AT[:2]), 0.5, np.array([0.4]))
    for _ in range(10):
        relative, best = relative_bends(begun._replace(relative=relative), best, held)
    assert float(relative.std()) > 0.05

    def loss(factors: torch.Tensor, times: float = 1.0) -> float:
        whole = begun._replace(relative=factors)
        at = [*AT[:2], best.log_ratio[0] + math.log(times), math.log(0.5)]
        return EvidenceLoss(whole, held, PRIOR, 1.0).value(np.array(at))

    here = loss(relative)
    for factor in (0.98, 1.02):
        assert loss(relative, factor) > here
        for k in range(VIEWS):
            assert loss(torch.where(torch.arange(VIEWS) == k, factor * relative, relative)) > here


def test_derivatives_of_a_single_view() -> None:
    """It has fewer motions of an order than there are unknowns of lens and board."""
    U, A, residual, x, motion = (torch.from_numpy(part) for part in rows(True))
    products = Products.of_rows(torch.cat([U, A, residual[:, None]], 1)[:1], U.shape[1])
    one = view_data(products, x, motion[:1], float(ROWS))
    check_derivatives(EvidenceLoss(one, FAMILIES, PRIOR, 1.2), vector(True))


def test_beyond_numbers_is_worse_than_anything() -> None:
    loss, at = EvidenceLoss(data(False), FAMILIES, PRIOR, 1.0), vector(False)
    beyond = at + np.array([0.0, 0.0, 400.0])
    assert loss.value(beyond) == math.inf
    assert loss(beyond)[0] == math.inf


@pytest.mark.parametrize("noise", [-6.0, -1.0, 5.0])
def test_maximum_is_found_from_afar(noise: float) -> None:
    """Where the gradient is zero and the Hessian positive."""
    at = data(True)
    start = torch.tensor([-4.0, 4.0], dtype=F64), math.exp(noise)
    best = maximize_evidence(at, FAMILIES, Amplitudes(*start, np.zeros(AMPLITUDES)), PRIOR)
    v = best.vector
    value, slope, bend = EvidenceLoss(at, FAMILIES, PRIOR, 1.0)(v)
    bounds = hyper_bounds(PRIOR, AMPLITUDES, noise)
    inside = [high is None or low < x < high for x, (low, high) in zip(v, bounds, strict=True)]
    # The logarithm of the noise is rounded.
    assert value == pytest.approx(best.loss, rel=1e-14)
    assert float(np.abs(slope[inside]).max()) < 1e-3
    assert float(np.linalg.eigvalsh(bend[np.ix_(inside, inside)]).min()) > 0.0


@pytest.mark.parametrize("moving", [False, True])
def test_lens_and_board_move_with_amplitudes(monkeypatch: pytest.MonkeyPatch, moving: bool) -> None:
    """By the slopes of the best ones, where the posterior is so narrow that nothing else counts."""
    at, loss = vector(moving).copy(), EvidenceLoss(data(moving), FAMILIES, PRIOR, 1.0)
    ratios = at[len(PRIOR.mean) : -1]
    ratios -= 4.0  # within their bounds
    best = Amplitudes(torch.from_numpy(at[: len(PRIOR.mean)]), math.exp(at[-1]), ratios)
    bend = loss(at)[2]
    covariance = np.linalg.inv(bend @ bend)
    monkeypatch.setattr("kcal.calibrate.hybrid.evidence._inverse", lambda _: 1e-8 * covariance)
    slopes = np.array([(loss.step(at + one) - loss.step(at - one)) / 2e-5 for one in 1e-5 * np.eye(len(at))])
    found = steps_of_amplitudes(data(moving), FAMILIES, best, PRIOR).numpy()
    np.testing.assert_allclose(1e8 * found.T @ found, slopes.T @ covariance @ slopes, rtol=1e-4, atol=1e-12)


def test_worth_of_motions() -> None:
    """The logarithm of the evidence with them less that without, all else the same."""
    best = Amplitudes(torch.from_numpy(AT[:2]), math.exp(AT[-1]), AT[2:6])
    found = evidence_of_motion(data(True), best, FAMILIES, 1.0)
    assert found == pytest.approx(density(True, still=True) - density(True), rel=1e-9)


def test_bounds_of_hyperparameters() -> None:
    """Five standard deviations, or the most that there may be; the noise is open above."""
    bounds = hyper_bounds(PRIOR._replace(most=torch.tensor([1.0, 100.0], dtype=F64)), 1, -3.0)
    assert bounds[:2] == [(0.2 - 7.5, 1.0), (-10.5, 9.5)]
    assert bounds[2] == pytest.approx((math.log(1e-6) + 1.5, math.log(0.03) + 1.5))
    assert bounds[3] == (-11.0, None)
    assert hyper_bounds(PRIOR, 0, -3.0)[0] == (0.2 - 7.5, 0.2 + 7.5)
    # No noise below a thousandth of a pixel.
    assert hyper_bounds(PRIOR, 0, -8.0)[-1] == pytest.approx((2.0 * math.log(1e-3), None))


# The mean square of an amplitude, over what views leave of it, is the variance of modes that they do not tell.


WIDE: list[tuple[float, float | None]] = [(-12.0, 12.0), (-12.0, 12.0), (-40.0, None)]

Loss = Callable[[np.ndarray], tuple[float, np.ndarray]]


def bend(loss: Loss, at: np.ndarray) -> np.ndarray:
    """The Hessian."""
    steps = 1e-4 * np.eye(len(at))
    return np.stack([loss(at + step)[1] - loss(at - step)[1] for step in steps]) / 2e-4


def weights_seen(sizes: list[float], sigma: float) -> Loss:
    """-ln p of ln A where modes of weights ~ N(0, A²) were each seen with an error of σ, under a broad prior."""
    squares = float(np.square(sizes).sum())

    def loss(v: np.ndarray) -> tuple[float, np.ndarray]:
        variance = math.exp(2.0 * v[0]) + sigma**2
        value = 0.5 * (len(sizes) * math.log(variance) + squares / variance) + 0.5 * float(v @ v) / 4.0
        slope = v / 4.0
        slope[0] += math.exp(2.0 * v[0]) * (len(sizes) / variance - squares / variance**2)
        return value, slope

    return loss


def value_of(loss: Loss) -> Callable[[np.ndarray], float]:
    return lambda v: loss(v)[0]


def smallest(loss: Loss) -> np.ndarray:
    best = min(np.linspace(-8.0, 4.0, 4001), key=lambda x: loss(np.array([x, 0.0, 0.0]))[0])
    return np.array([best, 0.0, 0.0])


@pytest.mark.parametrize(
    ("sizes", "within"),
    [([1.0, -0.8, 1.2, 0.7, -1.1] * 6, 0.002), ([1.0, -0.8, 1.2, 0.7, -1.1], 0.15), ([0.3, -0.1, 0.2], 0.15),
     ([0.01, 0.02], 0.15)],
)  # fmt: skip
def test_mean_square_is_that_of_the_integral(sizes: list[float], within: float) -> None:
    """Where the amplitude is known surely, well, hardly, and where nothing but an upper bound is known."""
    loss = weights_seen(sizes, 0.2)
    at = smallest(loss)
    found = expected_amplitudes(bend(loss, at), value_of(loss), at, [0], WIDE)

    def density(x: float, power: float) -> float:
        return math.exp(loss(at)[0] - loss(np.array([x, 0.0, 0.0]))[0] + power * x)

    total, square = (integrate.quad(density, -12.0, 8.0, args=(p,), limit=200)[0] for p in (0.0, 2.0))
    # Nine places along a skewed density: the smallest case is the widest.
    assert found[0] == pytest.approx(0.5 * math.log(square / total), abs=within)
    assert found[0] > at[0]
    assert found[1:].tolist() == at[1:].tolist()


def test_others_follow() -> None:
    """Two amplitudes of which only the sum of the logarithms is known well: the trial of one takes the other along."""
    precision = np.linalg.inv(np.array([[1.0, -0.9], [-0.9, 1.0]]))

    def loss(v: np.ndarray) -> tuple[float, np.ndarray]:
        return 0.5 * float(v @ precision @ v), precision @ v

    found = expected_amplitudes(precision, value_of(loss), np.zeros(2), [0, 1], WIDE[:2])
    # ln A has a variance of 1 each: ½ ln <A²> = 1.
    assert found == pytest.approx([1.0, 1.0], abs=0.02)


def test_bounds_hold() -> None:
    loss = weights_seen([0.01, 0.02], 0.2)
    at = smallest(loss)
    top = float(at[0]) + 0.4
    found = expected_amplitudes(bend(loss, at), value_of(loss), at, [0], [(-12.0, top), *WIDE[1:]])
    assert at[0] - 1.0 < found[0] <= top


# Which parameters are one unknown, and that priors stand where these unknowns do.


MODEL = LensModel(hybrid=HybridForm(shape=0.5, radius=0.6, modes=ZernikeModes()))

SIZE = MODEL.size


def test_square_pixels_have_one_focal_length() -> None:
    """fx and fy are the first unknown; the principal point, the coefficients follow; a second focal length is last."""
    square, others = hybrid_unknowns(MODEL), hybrid_unknowns(MODEL, square=False)
    names = [0, 1, 2, 3, *range(5, 5 + SIZE)]  # without the skew
    assert list(square.indices) == list(others.indices) == names
    assert list(square.slots) == [0, 0, *range(1, 3 + SIZE)]
    assert list(others.slots) == [0, 3 + SIZE, *range(1, 3 + SIZE)]


def test_priors_are_of_the_unknowns_that_are_not_held() -> None:
    board = Board(columns=4, rows=3, square=0.1)
    modes = BoardModes(torch.zeros(2, 3, board.corners).double(), torch.ones(2).double(), torch.zeros(2).long())
    pixels = torch.zeros(1, board.corners, 2, dtype=torch.float64)
    count = 3 + SIZE + 2
    mean = torch.arange(count, dtype=torch.float64)
    precision = torch.full((count,), 4.0, dtype=torch.float64)
    precision[[1, -1]] = torch.inf
    (prior,) = views_of(board.points, modes, pixels).problem_under(MODEL, mean, precision).terms
    # cx is held, and the last mode of the board.
    assert prior.index.tolist() == [0, 3, *range(5, 5 + SIZE), 5 + SIZE]  # type: ignore[attr-defined]
    assert prior.mean.tolist() == [0.0, *mean[2:-1].tolist()]  # type: ignore[attr-defined]
    assert prior.weight.tolist() == [2.0] * (count - 2)  # type: ignore[attr-defined]
