"""Messages about a board: products, evidence and turns are those of dense Gaussians."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from kcal.calibrate.hybrid.board_modes import board_modes
from kcal.calibrate.hybrid.board_orders import find_turns, mode_turn, quarter_turns, turned_corners
from kcal.calibrate.hybrid.board_prior import (
    BoardMessage,
    BoardPrior,
    message_from_rows,
    multiplied,
    printed_board,
    printed_prior,
)
from kcal.calibrate.hybrid.families import BOARD, typical_hyperprior
from kcal.corners.board import Board

F64 = torch.float64
BOARD_86 = Board(columns=8, rows=6, square=0.03)
MODES = board_modes(BOARD_86.points)


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def log_normal(x: Tensor, covariance: Tensor) -> float:
    return -0.5 * float(x @ torch.linalg.solve(covariance, x) + torch.logdet(2 * math.pi * covariance))


def test_lens_is_integrated_out() -> None:
    """The message is the Schur complement of the lens in the information matrix."""
    rows, deviation, variance = normal(200, 12, seed=1), torch.tensor([0.5, 2.0, 0.1, 1.0], dtype=F64), 0.3
    K, g = rows[:, :-1].T @ rows[:, :-1] / variance, rows[:, :-1].T @ rows[:, -1] / variance
    lens = K[:4, :4] + torch.diag(deviation**-2)
    message = message_from_rows(rows, deviation, variance)
    schur = K[4:, 4:] - K[4:, :4] @ torch.linalg.solve(lens, K[:4, 4:])
    torch.testing.assert_close(message.root.T @ message.root, schur)
    torch.testing.assert_close(message.root.T @ message.target, g[4:] - K[4:, :4] @ torch.linalg.solve(lens, g[:4]))


def test_products_and_evidence() -> None:
    """Messages with a prior: the posterior, and the density of the targets under the prior."""
    prior = BoardPrior(normal(5, seed=2), normal(5, 5, seed=3))
    messages = [BoardMessage(normal(rows, 5, seed=rows), normal(rows, seed=rows + 9)) for rows in (7, 4)]
    A, d = torch.cat([m.root for m in messages]), torch.cat([m.target for m in messages])
    covariance = prior.half.T @ prior.half
    after = torch.linalg.inv(torch.linalg.inv(covariance) + A.T @ A)
    found = multiplied(prior, messages)
    torch.testing.assert_close(found.board.half.T @ found.board.half, after, rtol=1e-7, atol=1e-9)
    mean = prior.mean + after @ A.T @ (d - A @ prior.mean)
    torch.testing.assert_close(found.board.mean, mean, rtol=1e-7, atol=1e-9)
    density = log_normal(d - A @ prior.mean, torch.eye(11, dtype=F64) + A @ covariance @ A.T)
    assert found.log_evidence == pytest.approx(density + 0.5 * 11 * math.log(2 * math.pi), rel=1e-9)
    nothing = multiplied(prior, [])
    assert nothing.log_evidence == 0.0
    torch.testing.assert_close(nothing.board.mean, prior.mean)


def test_amplitudes_of_largest_evidence() -> None:
    """Boards with known spreads, seen well: the families' amplitudes come back, and no neighbor is better."""
    spread = torch.tensor([1e-3, 1e-4, 3e-4, 2e-4], dtype=F64)
    a = MODES.unit * spread[MODES.family] * normal(28, seed=4)
    message = BoardMessage(1e6 * torch.eye(28, dtype=F64), 1e6 * a)
    prior, value = printed_board(MODES, [message])
    typical = typical_hyperprior()
    mean, sd = typical.mean[BOARD:], typical.sd[BOARD:]
    h = torch.stack([(prior.half.diagonal() / MODES.unit)[MODES.family == k][0].log() for k in range(4)])

    def evidence(h: Tensor) -> float:
        hyper = 0.5 * float(((h - mean) / sd).square().sum())
        return multiplied(printed_prior(MODES, h), [message]).log_evidence - hyper

    assert value == pytest.approx(evidence(h), rel=1e-9)
    for k in range(4):
        for sign in (-0.3, 0.3):
            assert evidence(h + sign * torch.eye(4, dtype=F64)[k]) < value
    # Twelve draws determine a spread to 20 %; two, as of stretch and trapezoid, to half.
    assert (h[[0, 2]] - spread[[0, 2]].log()).abs().max() < 0.6


def test_a_change_of_variables_is_the_same_board() -> None:
    prior = BoardPrior(1e-4 * normal(28, seed=5), 1e-5 * normal(28, 28, seed=6))
    z = normal(28, seed=7)
    points, modes = prior.applied(BOARD_86.points, MODES)
    there = points + torch.einsum("b,bkn->nk", z, modes.shapes)
    a = prior.mean + prior.half.T @ z
    torch.testing.assert_close(there, BOARD_86.points + torch.einsum("b,bkn->nk", a, MODES.shapes))


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
    assert quarter_turns(board) == turns
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
    message = BoardMessage(normal(30, 28, seed=9), normal(30, seed=10))
    a = normal(28, seed=11)
    there = message.turned(turn)
    torch.testing.assert_close(there.root @ (turn @ a), message.root @ a)


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
    a = prior.half.diagonal() * normal(28, seed=12)
    found = find_turns(linear_views(a, turns, 20), BOARD_86, prior, lens, 1.0)
    assert torch.equal(found, turns)
    flat = find_turns(linear_views(0.0 * a, turns, 20), BOARD_86, prior, lens, 1.0)
    assert not bool(flat.any())


def test_views_are_turned_to_a_known_board() -> None:
    """If most are turned against the measured board, most are turned."""
    turns = 2 * (torch.arange(12) > 2).long()
    lens = torch.full((4,), 10.0, dtype=F64)
    a = 5e-4 * MODES.unit * normal(28, seed=13)
    known = BoardPrior(a, torch.diag(1e-5 * MODES.unit))
    assert torch.equal(find_turns(linear_views(a, turns, 30), BOARD_86, known, lens, 1.0), turns)
