"""Boards: their prior, bending, and fleets of cameras that saw one."""

import functools
import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch
from standing_views import quadratic, standing
from torch import Tensor

from kcal import Board, Observations, calibrate_camera
from kcal.calibrate.camera.result import CalibrationOptions, CameraCalibrationResult
from kcal.calibrate.hybrid.board_modes import board_modes, find_turns, mode_turn, turned, turned_corners
from kcal.calibrate.hybrid.cameras_fit import fleet_priors, hyper_likelihood
from kcal.calibrate.hybrid.evidence import Amplitudes, maximize_evidence, negative_log_evidence
from kcal.calibrate.hybrid.families import BOARD, Hyperprior, PriorFamilies, typical_hyperprior
from kcal.calibrate.hybrid.measured_board import BoardPrior, evidence, printed_board, printed_prior
from kcal.gaussian import Gaussian, numbered
from kcal.lens.information import BOARD_SLOT
from scripts.shared.captures import error_at_infinity
from scripts.shared.simulated import Simulated, bends, simulated, terms

# Messages about a board: products, evidence and turns are those of dense Gaussians.


F64 = torch.float64

BOARD_86 = Board(columns=8, rows=6, square=0.03)

MODES = board_modes(BOARD_86.points)


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def log_normal(x: Tensor, covariance: Tensor) -> float:
    return -0.5 * float(x @ torch.linalg.solve(covariance, x) + torch.logdet(2 * math.pi * covariance))


def about_board(rows: Tensor, target: Tensor) -> Gaussian:
    """A message: rows (R, B) of the amplitudes, and what they come to."""
    slots = numbered(BOARD_SLOT, rows.shape[1])
    return Gaussian(slots, rows.new_zeros(len(slots)), torch.cat([rows, -target[:, None]], 1))


def test_evidence_is_the_density_of_the_targets() -> None:
    """Of messages under a prior, against the dense covariance of what they say."""
    half = normal(5, 5, seed=3)
    covariance, at = half.T @ half, normal(5, seed=2)
    prior = Gaussian.from_covariance(numbered(BOARD_SLOT, 5), at, covariance)
    A, d = normal(11, 5, seed=7), normal(11, seed=16)
    messages = [about_board(A[:7], d[:7]), about_board(A[7:], d[7:])]
    density = log_normal(d - A @ at, torch.eye(11, dtype=F64) + A @ covariance @ A.T)
    assert evidence(prior, messages) == pytest.approx(density + 0.5 * 11 * math.log(2 * math.pi), rel=1e-9)
    assert evidence(prior, []) == 0.0


def test_amplitudes_of_largest_evidence() -> None:
    """Boards with known spreads, seen well: the families' amplitudes come back, and no neighbor is better."""
    spread = torch.tensor([1e-3, 1e-4, 3e-4, 2e-4], dtype=F64)
    a = MODES.unit * spread[MODES.family] * normal(28, seed=4)
    message = about_board(1e6 * torch.eye(28, dtype=F64), 1e6 * a)
    prior, value = printed_board(MODES, [message])
    typical = typical_hyperprior()
    mean, sd = typical.mean[BOARD:], typical.sd[BOARD:]
    h = torch.stack(
        [(1.0 / prior.rows.diagonal() / MODES.unit)[MODES.family == k][0].log() for k in range(4)] + [mean[4]]
    )

    def at(h: Tensor) -> float:
        hyper = 0.5 * float(((h - mean) / sd).square().sum())
        return evidence(printed_prior(MODES, h), [message]) - hyper

    assert value == pytest.approx(at(h), rel=1e-9)
    for k in range(4):
        for sign in (-0.3, 0.3):
            assert at(h + sign * torch.eye(5, dtype=F64)[k]) < value
    # Twelve draws determine a spread to 20 %; two, as of stretch and trapezoid, to half.
    assert (h[[0, 2]] - spread[[0, 2]].log()).abs().max() < 0.6


def test_a_change_of_variables_is_the_same_board() -> None:
    told = about_board(1e4 * normal(40, 28, seed=6), normal(40, seed=5))
    prior = BoardPrior(printed_prior(MODES, torch.full((4,), -8.0, dtype=F64)), told)
    z = normal(28, seed=7)
    points, modes = prior.applied(BOARD_86.points, MODES)
    there = points + torch.einsum("b,bkn->nk", z, modes.shapes)
    mean, half = prior.whole.mean_and_half()
    a = mean + z @ half
    torch.testing.assert_close(there, BOARD_86.points + torch.einsum("b,bkn->nk", a, MODES.shapes))
    torch.testing.assert_close(prior.in_units(a), z)


@pytest.mark.parametrize(
    ("board", "turns"),
    [
        (Board(columns=9, rows=6, square=0.02), (0,)),
        (Board(columns=8, rows=6, square=0.02), (0, 2)),
        (Board(columns=9, rows=7, square=0.02), (0, 2)),
        (Board(columns=7, rows=7, square=0.02), (0, 2)),
        (Board(columns=6, rows=6, square=0.02), (0, 1, 2, 3)),
        (Board(columns=6, rows=6, square=0.02, dictionary="4x4_50", marker=0.01), (0,)),
    ],
    ids=str,
)
def test_a_turned_board_has_turned_amplitudes(board: Board, turns: tuple[int, ...]) -> None:
    """Corners in another order are those of the turned modes, after the best-fit rotation, shift and scale."""
    assert board.quarter_turns == turns
    modes = board_modes(board.points)
    a = 1e-5 * modes.unit / modes.unit.max() * normal(28, seed=8)
    for turn in turns:
        read, expected = (
            board.points + torch.einsum("b,bkn->nk", amplitudes, modes.shapes)
            for amplitudes in (a, mode_turn(turn) @ a)
        )
        read = turned_corners(read[None], board, torch.tensor([turn]))[0]
        read, expected = read - read.mean(0), expected - expected.mean(0)
        u, s, vh = torch.linalg.svd(read.T @ expected)
        best = float((s * torch.tensor([1.0, 1.0, torch.linalg.det(u @ vh)])).sum() / read.square().sum())
        flip = torch.diag(torch.tensor([1.0, 1.0, float(torch.linalg.det(u @ vh))], dtype=F64))
        # Scale and stretch mix to second order.
        torch.testing.assert_close(best * read @ u @ flip @ vh, expected, rtol=0, atol=2e-9)


def test_a_message_turns_with_its_board() -> None:
    turn = mode_turn(1)
    message = about_board(normal(30, 28, seed=9), normal(30, seed=10))
    a = normal(28, seed=11)
    there = turned(message, 1)
    residuals = [one.placed(one.slots, at).rows[:, -1] for one, at in ((there, turn @ a), (message, a))]
    torch.testing.assert_close(residuals[0], residuals[1])


def linear_views(a: Tensor, turns: Tensor, seed: int) -> Tensor:
    """Rows (V, S + 1, R) of a camera with 4 unknowns whose views see amplitudes turned back by `turns`."""
    rows = normal(len(turns), 4 + 28, 60, seed=seed)
    rows[:, 4:] /= MODES.unit[:, None] * 1e-4
    lens = normal(4, seed=seed + 1)
    own = torch.stack([torch.linalg.solve(mode_turn(int(k)), a) for k in turns])
    target = torch.einsum("l,vlr->vr", lens, rows[:, :4]) + torch.einsum("vb,vbr->vr", own, rows[:, 4:])
    return torch.cat([rows, (target + normal(*target.shape, seed=seed + 2))[:, None]], 1)


@pytest.mark.parametrize("count", [1, 9])
def test_turned_views_are_found(count: int) -> None:
    """Also if nearly half of them are turned; of a board without print errors none is."""
    turns = 2 * (torch.randperm(20, generator=torch.Generator().manual_seed(3)) < count).long()
    lens = torch.full((4,), 10.0, dtype=F64)
    prior = printed_prior(MODES, torch.full((4,), math.log(5e-4), dtype=F64))
    a = normal(28, seed=12) / prior.rows.diagonal()
    assert torch.equal(find_turns(linear_views(a, turns, 20), BOARD_86, prior, lens, 1.0), turns)
    assert not bool(find_turns(linear_views(0.0 * a, turns, 20), BOARD_86, prior, lens, 1.0).any())


def test_views_are_turned_to_a_known_board() -> None:
    """If most are turned against the measured board, most are turned."""
    turns = 2 * (torch.arange(12) > 2).long()
    lens = torch.full((4,), 10.0, dtype=F64)
    a = 5e-4 * MODES.unit * normal(28, seed=13)
    known = Gaussian.independent(numbered(BOARD_SLOT, 28), a, 1e-5 * MODES.unit)
    assert torch.equal(find_turns(linear_views(a, turns, 30), BOARD_86, known, lens, 1.0), turns)


# A board that bends from view to view: found where it does, told from motion, and named.


SIGMA = 0.08

# Seed, whether by hand, millimeters by which the board bends, and in what share of the views.
CASES = {
    "stand": (1, False, 0.0, 1.0),
    "bent": (1, False, 1.0, 1.0),
    "few": (1, False, 3.0, 0.2),
    "both": (2, True, 1.0, 1.0),
    "hand": (2, True, 0.0, 1.0),
}


@functools.cache
def case(name: str) -> Simulated:
    seed, by_hand, bent, share = CASES[name]
    return simulated(seed, 20, SIGMA, by_hand, bent=1e-3 * bent, share=share)


@functools.cache
def found(name: str, bending: bool = True) -> CameraCalibrationResult:
    return calibrate_camera(case(name).seen, CalibrationOptions(bending=bending))


def said(result: CameraCalibrationResult) -> list[str]:
    return [text for text in result.warnings if "the board bends" in text]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("stand", []), ("bent", ["bending"]), ("few", ["bending"]), ("both", ["motion", "bending", "corners"]),
        ("hand", ["motion", "corners"]),
    ],
)  # fmt: skip
def test_what_views_do_is_told_by_the_evidence(name: str, wanted: list[str]) -> None:
    """Errors of 0.02 mm that the print of the board by hand has beside its modes are found, too."""
    fit = found(name).hybrid
    assert terms(fit) == wanted
    assert len(said(found(name))) == ("bending" in wanted)
    assert fit.sigma == pytest.approx(SIGMA, rel=0.1 if name != "both" else 0.6)


@pytest.mark.slow
def test_bending_is_taken_out() -> None:
    """The camera is nearer the truth than that of a board that is held to be stiff; heights are those of the views."""
    fit, stiff = found("bent").hybrid, found("bent", bending=False).hybrid
    assert fit.bends is not None
    assert stiff.bends is None
    off, other = (error_at_infinity(one.camera, case("bent").lens).rms for one in (fit, stiff))
    assert off < 0.7 * other
    true = bends(20, 1e-3, 1.0, torch.Generator().manual_seed(9001))
    # A shape that all views share, and a plane in each, are no bending by view.
    flat = torch.cat([case("bent").seen.board.points[:, :2], torch.ones(true.shape[1], 1).double()], 1)
    basis, _ = torch.linalg.qr(flat)
    ours, theirs = (
        (one - one.mean(0)) @ (torch.eye(len(basis)).double() - basis @ basis.T) for one in (fit.bends, true)
    )
    assert float((ours - theirs).square().mean().sqrt()) < 0.2 * float(theirs.square().mean().sqrt())
    again = fit.residuals_of(case("bent").seen.pixels())
    torch.testing.assert_close(again, fit.residuals, rtol=0, atol=1e-9, equal_nan=True)


@pytest.mark.slow
def test_a_few_views_do_not_loosen_the_others() -> None:
    """They have large factors of their own, and are named."""
    result = found("few")
    fit = result.hybrid
    bent = bends(20, 3e-3, 0.2, torch.Generator().manual_seed(9001)).abs().amax(1) > 0.0
    assert int(bent.sum()) == 4
    assert float(fit.relative[bent].min()) > 2.0
    assert float(fit.relative[~bent].max()) < 1.0
    (text,) = said(result)
    assert f"most in {int(bent.sum())} of 20 views" in text
    assert all(result.observations.names[i] in text for i in bent.nonzero()[:, 0].tolist())
    # Views are refitted as they were: a part of them keeps its own factors.
    torch.testing.assert_close(fit.only([3, 5]).own_stillness, fit.own_stillness[[3, 5]])


def real(name: str) -> Observations:
    path = Path(os.environ.get("KCAL_DATA", "")) / f"captures/{name}.obs.json"
    if not path.exists():
        pytest.skip("KCAL_DATA has no such capture")
    return Observations.load(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "wanted", "noise"),
    [
        ("camodocal", ["motion", "bending", "corners"], 0.034),
        ("carnd18", ["bending", "corners"], 0.26),
        ("st1_r", ["motion", "corners"], 0.047),
    ],
)
def test_captures_of_strangers(name: str, wanted: list[str], noise: float) -> None:
    """Boards that bend, of a car's fisheye and on a wall: no second camera is blamed for it, nor a shutter alone."""
    result = calibrate_camera(real(name))
    assert terms(result.hybrid) == wanted
    assert result.hybrid.sigma < noise
    assert len(said(result)) == ("bending" in wanted)
    assert not any("not of one camera" in text for text in result.warnings)


# What cameras of one type have in common is learned from them.


TYPICAL = Hyperprior(torch.tensor([0.0, -7.0], dtype=F64), torch.tensor([1.5, 2.0], dtype=F64))


def cameras(count: int, information: float, seed: int) -> tuple[list[Gaussian], torch.Tensor]:
    """Cameras whose h scatter by .2 about (2, -9), each known to 1 / √information."""
    generator = torch.Generator().manual_seed(seed)
    true = torch.tensor([2.0, -9.0], dtype=F64) + 0.2 * torch.randn(count, 2, generator=generator, dtype=F64)
    seen = true + torch.randn(count, 2, generator=generator, dtype=F64) / math.sqrt(information)
    sigma = torch.full((2,), 1.0 / math.sqrt(information), dtype=F64)
    return [Gaussian.independent((0, 1), h, sigma) for h in seen], true


def test_many_cameras_tell_their_type() -> None:
    told, true = cameras(100, 25.0, 1)
    found, each = fleet_priors(told, TYPICAL)
    torch.testing.assert_close(found.mean, true.mean(0), rtol=0, atol=0.1)
    # The spread of the cameras (.2), not that of their noisy estimates (.28).
    assert bool((found.sd > 0.16).all() & (found.sd < 0.25).all())
    # Without itself each knows nearly as much.
    assert bool((torch.stack([prior.mean for prior in each]) - found.mean).abs().max() < 0.01)


def test_blind_cameras_tell_nothing() -> None:
    blind = Gaussian((0, 1), torch.zeros(2, dtype=F64), torch.zeros(0, 3, dtype=F64))
    found, _ = fleet_priors([blind] * 6, TYPICAL)
    torch.testing.assert_close(found.mean, TYPICAL.mean, rtol=0, atol=1e-6)
    torch.testing.assert_close(found.sd, TYPICAL.sd, rtol=1e-6, atol=0)


def test_likelihood_of_hyperparameters() -> None:
    """At the maximum of the posterior the likelihood's slope is against the hyperprior's, and its Hessian is right."""
    generator = torch.Generator().manual_seed(3)
    count = 40
    index = torch.arange(count) % 2
    none = torch.full((count,), -1)
    zero = torch.zeros(count, dtype=F64)
    families = PriorFamilies(zero, zero, index, none, zero)
    x = torch.exp(TYPICAL.mean + 1.0)[index] * torch.randn(count, generator=generator, dtype=F64)
    A = 100.0 * torch.randn(300, count, generator=generator, dtype=F64)
    data = quadratic(A, A @ x + 0.1 * torch.randn(300, generator=generator, dtype=F64), zero)
    h, variance = TYPICAL.mean, 0.02
    for _ in range(3):
        h, variance, *_ = maximize_evidence(standing(data), families, Amplitudes(h, variance), TYPICAL)
    found = hyper_likelihood(data, families, h, variance)
    # Of a spread known from n draws the log has information 2 n.
    told = found.placed(found.slots, h).products
    torch.testing.assert_close(told.diagonal()[:2], torch.full((2,), 40.0, dtype=F64), rtol=0.35, atol=0)
    slope = told[:2, 2]
    torch.testing.assert_close(slope, (TYPICAL.mean - h) / TYPICAL.sd.square(), rtol=0, atol=0.05)
    at = np.append(h.numpy(), math.log(variance))
    value = negative_log_evidence(data, families, at)[0]
    there = negative_log_evidence(data, families, at + np.array([0.1, 0.0, 0.0]))[0]
    predicted = 0.1 * float(slope[0]) + 0.005 * float(told[0, 0])
    assert abs(there - value - predicted) < 0.05
