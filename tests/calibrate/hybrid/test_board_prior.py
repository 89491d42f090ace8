"""Messages about a board: products, evidence and turns are those of dense Gaussians."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import board_modes, find_turns, mode_turn, turned, turned_corners
from kcal.calibrate.hybrid.families import BOARD, typical_hyperprior
from kcal.calibrate.hybrid.measured_board import BoardPrior, evidence, printed_board, printed_prior
from kcal.corners.board import Board
from kcal.gaussian import Gaussian, numbered
from kcal.lens.information import BOARD_SLOT

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
    h = torch.stack([(1.0 / prior.rows.diagonal() / MODES.unit)[MODES.family == k][0].log() for k in range(4)])

    def at(h: Tensor) -> float:
        hyper = 0.5 * float(((h - mean) / sd).square().sum())
        return evidence(printed_prior(MODES, h), [message]) - hyper

    assert value == pytest.approx(at(h), rel=1e-9)
    for k in range(4):
        for sign in (-0.3, 0.3):
            assert at(h + sign * torch.eye(4, dtype=F64)[k]) < value
    # Twelve draws determine a spread to 20 %; two, as of stretch and trapezoid, to half.
    assert (h[[0, 2]] - spread[[0, 2]].log()).abs().max() < 0.6


def test_a_change_of_variables_is_the_same_board() -> None:
    told = about_board(1e4 * normal(40, 28, seed=6), normal(40, seed=5))
    prior = BoardPrior(printed_prior(MODES, torch.full((4,), -8.0, dtype=F64)), told)
    z = normal(28, seed=7)
    points, modes = prior.applied(BOARD_86.points, MODES)
    there = points + torch.einsum("b,bkn->nk", z, modes.shapes)
    a = prior.in_amplitudes(z)
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
    """Corners in another order are those of the turned modes, after the best turn, shift and scale."""
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
    found = find_turns(linear_views(a, turns, 20), BOARD_86, prior, lens, 1.0)
    assert torch.equal(found, turns)
    flat = find_turns(linear_views(0.0 * a, turns, 20), BOARD_86, prior, lens, 1.0)
    assert not bool(flat.any())


def test_views_are_turned_to_a_known_board() -> None:
    """If most are turned against the measured board, most are turned."""
    turns = 2 * (torch.arange(12) > 2).long()
    lens = torch.full((4,), 10.0, dtype=F64)
    a = 5e-4 * MODES.unit * normal(28, seed=13)
    known = Gaussian.independent(numbered(BOARD_SLOT, 28), a, 1e-5 * MODES.unit)
    assert torch.equal(find_turns(linear_views(a, turns, 30), BOARD_86, known, lens, 1.0), turns)
