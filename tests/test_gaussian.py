"""Gaussians as square roots of information agree with dense covariances, however they are stacked, cut and ordered."""

import math
from collections.abc import Sequence

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from kcal.gaussian import Gaussian, numbered, posterior_half, stacked, triangular

F64 = torch.float64
SLOTS = ("fx", "cx", ("board", 0), ("board", 1), "k1")


def normal(*shape: int, seed: int) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


def drawn(slots: Sequence[object], rows: int, seed: int) -> Gaussian:
    return Gaussian(tuple(slots), normal(len(slots), seed=seed), normal(rows, len(slots) + 1, seed=seed + 1))


def dense(known: Gaussian, slots: Sequence[object] = SLOTS) -> tuple[Tensor, Tensor]:
    """Information (U, U) and pull (U,) at zero, of all of these unknowns in their order."""
    products = known.placed(tuple(slots), torch.zeros(len(slots), dtype=F64)).products
    return products[:-1, :-1], products[:-1, -1]


def same(one: Gaussian, other: Gaussian, slots: Sequence[object] = SLOTS) -> None:
    for a, b in zip(dense(one, slots), dense(other, slots), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-12, atol=1e-12 * float(a.abs().max() + 1e-300))


seeds = st.integers(0, 10**6)


@given(seeds, st.permutations(SLOTS))
@settings(max_examples=25, deadline=None)
def test_order_and_grouping_are_irrelevant(seed: int, order: list[object]) -> None:
    """(a + b) + c = a + (b + c) = c + b + a, with names in any order and some of them missing."""
    a, b, c = drawn(SLOTS[:3], 4, seed), drawn(order, 7, seed + 2), drawn(order[:2], 3, seed + 4)
    whole = (a + b) + c
    for other in (a + (b + c), c + b + a, stacked([b, a, c])):
        assert set(other.slots) == set(SLOTS)
        same(whole, other)
    same(whole, whole.compressed())
    same(whole, whole.placed(tuple(order), normal(5, seed=seed + 6)))


@given(seeds, st.sets(st.sampled_from(SLOTS), min_size=1, max_size=4))
@settings(max_examples=25, deadline=None)
def test_marginal_and_conditional_are_those_of_the_dense_covariance(seed: int, kept: set[object]) -> None:
    """The marginal's covariance is a block of the covariance; the conditional's information one of the information."""
    known = drawn(SLOTS, 9, seed)
    slots = tuple(slot for slot in reversed(SLOTS) if slot in kept)
    own = [SLOTS.index(slot) for slot in slots]
    part = known.marginal(slots)
    information, _ = dense(known)
    covariance = torch.linalg.inv(information)
    scale = covariance.diagonal().sqrt()[own]
    half = part.half()
    unit = (half.T @ half - covariance[own][:, own]) / scale / scale[:, None]
    assert float(unit.abs().max()) < 1e-12 * float(torch.linalg.cond(information))
    torch.testing.assert_close(part.mean, known.mean[own], rtol=1e-9, atol=1e-9)
    rest = tuple(slot for slot in SLOTS if slot not in kept)
    if rest:
        held = known.conditioned(rest)
        same(held.placed(slots, held.at[[held.slots.index(slot) for slot in slots]]), held, slots)
        torch.testing.assert_close(dense(held, slots)[0], information[own][:, own], rtol=1e-12, atol=1e-12)
        # The best of the others while these stay where they are.
        best = known.at[own] - torch.linalg.lstsq(known.rows[:, own], known.rows[:, -1:]).solution[:, 0]
        torch.testing.assert_close(held.placed(slots, known.at[own]).mean, best, rtol=1e-9, atol=1e-9)


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_marginal_of_a_sum(seed: int) -> None:
    """What says nothing of an unknown may be added before or after that is integrated out."""
    a, b = drawn(SLOTS, 8, seed), drawn(SLOTS[1:3], 4, seed + 2)
    same((a + b).marginal(SLOTS[:4]), a.marginal(SLOTS[:4]) + b, SLOTS[:4])


def test_rank_deficient_rows_keep_what_they_say() -> None:
    """Rows about an unknown that nothing determines, or about two that only their sum does, tell of the rest."""
    # k1 has no column of its own; fx + cx is seen, not each.
    at = torch.zeros(3, dtype=F64)
    rows = torch.tensor([[1.0, 1.0, 0.0, 0.0], [2.0, 2.0, 3.0, 1.0], [0.0, 0.0, 4.0, 2.0]], dtype=F64)
    known = Gaussian(("fx", "cx", "k1"), at, rows)
    # With s = fx + cx: rows s, 2 s + 3 k + 1, 4 k + 2; s integrated out.
    column, rest = torch.tensor([1.0, 2.0, 0.0], dtype=F64), rows[:, 2:]
    off = rest - torch.outer(column, column @ rest) / (column @ column)
    same(known.marginal(("k1",)), Gaussian(("k1",), at[:1], off), ("k1",))
    blind = Gaussian(("cx", "fx"), at[:2], torch.tensor([[0.0, 2.0, 1.0], [0.0, 1.0, 3.0]], dtype=F64))
    same(blind.marginal(("fx",)), blind.conditioned(("cx",)), ("fx",))
    nothing = Gaussian(("fx",), at[:1], torch.zeros(0, 2, dtype=F64))
    assert not (nothing + nothing).marginal(("fx",)).rows.any()
    half = (known + nothing).half()
    sigma = half.norm(dim=0)
    assert bool((sigma[:2] > 1e10).all())
    assert float(sigma[2]) < 1.0
    # Their sum is known.
    assert float((half[:, 0] + half[:, 1]).norm()) < 10.0


def test_covariances_come_back() -> None:
    root, mean = normal(7, 5, seed=2), normal(5, seed=3)
    matrix = root.T @ root
    known = Gaussian.from_covariance(SLOTS, mean, matrix)
    half = known.half()
    torch.testing.assert_close(half.T @ half, matrix, rtol=1e-12, atol=1e-12)
    found, triangle = known.mean_and_half()
    torch.testing.assert_close(found, mean)
    torch.testing.assert_close(triangle.T @ triangle, matrix, rtol=1e-12, atol=1e-12)
    assert torch.equal(triangle, triangle.tril())
    sigma = torch.tensor([1e-6, 2.0], dtype=F64)
    apart = Gaussian.independent(("a", "b"), mean[:2], sigma)
    torch.testing.assert_close(apart.half().norm(dim=0), sigma, rtol=1e-12, atol=0)


def test_other_variables() -> None:
    """Old = begin + change z: the same residuals at the same place."""
    known, change, begin = drawn(SLOTS, 8, 1), normal(2, 3, seed=5), normal(2, seed=6)
    found = known.replaced(("cx", ("board", 1)), begin, change, numbered("z", 3))
    assert found.slots == ("fx", ("board", 0), "k1", *numbered("z", 3))
    z, rest = normal(3, seed=7), normal(3, seed=8)
    x = torch.stack([rest[0], *(begin + change @ z)[:1], rest[1], *(begin + change @ z)[1:], rest[2]])
    there = found.placed(found.slots, torch.cat([rest, z])).rows[:, -1]
    torch.testing.assert_close(there, known.placed(SLOTS, x).rows[:, -1])


def test_log_integral() -> None:
    """That of a normalized density is zero, and weights do what exponents do."""
    covariance = torch.diag(torch.tensor([4.0, 9.0], dtype=F64))
    known = Gaussian.from_covariance(("a", "b"), normal(2, seed=1), covariance)
    assert known.log_integral() == pytest.approx(0.5 * float(covariance.logdet()))
    off = Gaussian(("a",), torch.zeros(1, dtype=F64), torch.tensor([[1.0, 0.0], [0.0, 2.0]], dtype=F64))
    # ∫ exp(-½ (x² + 2²)) dx.
    assert off.log_integral() == pytest.approx(-2.0)
    assert off.weighted(0.5).log_integral() == pytest.approx(math.log(2.0) - 0.5)


def test_refused() -> None:
    with pytest.raises(ValueError, match="twice"):
        drawn(("a", "a"), 3, 1)
    with pytest.raises(ValueError, match="2 unknowns"):
        Gaussian(("a", "b"), torch.zeros(2), torch.zeros(4, 2))


def test_nearly_undetermined_directions_survive() -> None:
    """Columns of units 1e-4 apart and a valley 1e-10 wide: normal equations would lose it."""
    half = posterior_half(torch.tensor([[1.0, 1.0], [0.0, 1e-10]]).double())
    # x = (1, -1) / 1e-10 moves the rows by one.
    sigma = torch.linalg.vector_norm(half, dim=0)
    torch.testing.assert_close(sigma, torch.full((2,), 1e10).double(), rtol=1e-5, atol=0)


def test_undetermined_is_large() -> None:
    """What no row determines gets a very large variance, not NaN."""
    half = posterior_half(torch.tensor([[1.0, 0.0]]).double())
    sigma = torch.linalg.vector_norm(half, dim=0)
    assert float(sigma[0]) == pytest.approx(1.0)
    assert 1e10 < float(sigma[1]) < math.inf


def test_triangular_keeps_products() -> None:
    """Also of fewer rows than columns."""
    for count in (2, 9):
        rows = torch.randn(count, 4, generator=torch.Generator().manual_seed(count), dtype=torch.float64)
        found = triangular(rows)
        assert found.shape == (4, 4)
        torch.testing.assert_close(found.T @ found, rows.T @ rows, rtol=1e-12, atol=1e-13)
