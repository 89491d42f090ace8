"""Items that are eliminated before a system is damped: the same solution, and what their own unknowns do after."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from kcal.solve.schur import EliminatedItems, PartlyEliminated, SchurLinearization, without_local

ITEMS, OWN, SHARED, RESIDUALS = 6, 3, 4, 5


def rows_of(items: int, own: int, residuals: int, seed: int) -> Tensor:
    """(V, L + S + 1, R) whose columns differ in size."""
    generator = torch.Generator().manual_seed(seed)
    rows = torch.randn(items, own + SHARED + 1, residuals, generator=generator, dtype=torch.float64)
    sizes = 10.0 ** torch.linspace(-2.0, 2.0, own + SHARED + 1, dtype=torch.float64)
    sizes[-1] = 1.0
    return rows * sizes[:, None]


ROWS = rows_of(ITEMS, OWN, RESIDUALS, 1)


def test_residuals_that_are_left_are_what_own_unknowns_cannot_change() -> None:
    """Products of what is left are those of rows off the own ones, by pseudo-inverse as by QR."""
    items = EliminatedItems(ROWS, OWN)
    assert items.rows.shape == (ITEMS, SHARED + 1, RESIDUALS - OWN)
    off = ROWS[:, OWN:] - ROWS[:, OWN:] @ torch.linalg.pinv(ROWS[:, :OWN]) @ ROWS[:, :OWN]
    torch.testing.assert_close(items.rows @ items.rows.mT, off @ off.mT, rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(items.gram, (off @ off.mT).sum(0), rtol=1e-10, atol=1e-12)
    torch.testing.assert_close(without_local(ROWS, OWN), off, rtol=1e-9, atol=1e-11)


def test_an_unknown_without_effect_is_no_reason_to_fail() -> None:
    rows = ROWS.clone()
    rows[2, 1] = 0.0
    off = without_local(rows, OWN)
    assert bool(off.isfinite().all())
    kept = rows[2, [0, 2]]
    # What two columns can do is out of the rows; the third takes out one direction more, whichever it is.
    torch.testing.assert_close(off[2] @ kept.mT, torch.zeros(SHARED + 1, 2).double(), rtol=0, atol=1e-9)


@pytest.mark.parametrize("damping", [1e-9, 0.3, 50.0])
def test_own_steps_solve_the_damped_equations(damping: float) -> None:
    """With the shared step held; what they gain beyond `rows` makes up the fall of all squares."""
    items = EliminatedItems(ROWS, OWN)
    shared = torch.tensor([3.0, -0.2, 0.05, 0.01], dtype=torch.float64)
    step, gain = items.step(shared, torch.tensor(damping, dtype=torch.float64))
    own, moved = ROWS[:, :OWN], ROWS[:, -1] + shared @ ROWS[:, OWN:-1]
    normal = own @ own.mT
    normal = normal + damping * torch.diag_embed(normal.diagonal(dim1=-2, dim2=-1))
    expected = -torch.linalg.solve(normal, (own @ moved[..., None])[..., 0])
    torch.testing.assert_close(step, expected, rtol=1e-7, atol=1e-12)
    after = moved + (step[:, None] @ own)[:, 0]
    left = items.rows[:, -1] + shared @ items.rows[:, :-1]
    fall = ROWS[:, -1].square().sum() - after.square().sum()
    beside = items.rows[:, -1].square().sum() - left.square().sum()
    torch.testing.assert_close(gain, 0.5 * (fall - beside), rtol=1e-9, atol=1e-12)


def test_own_unknowns_follow_the_shared_ones() -> None:
    follow, inverse = EliminatedItems(ROWS, OWN).response()
    gram = ROWS @ ROWS.mT
    own = torch.linalg.inv(gram[:, :OWN, :OWN])
    torch.testing.assert_close(follow, -own @ gram[:, :OWN, OWN:-1], rtol=1e-7, atol=1e-12)
    torch.testing.assert_close(inverse, own, rtol=1e-7, atol=1e-14)


@pytest.mark.parametrize("first", [0, 2, 4])
def test_a_step_is_that_of_all_items_together(first: int) -> None:
    """Others have four unknowns each; items with three come after the first so many of them, with a zero before."""
    rest = rows_of(4, 4, 9, 2)
    padded = torch.nn.functional.pad(ROWS @ ROWS.mT, (1, 0, 1, 0))
    padded[:, 0, 0] = 1.0
    grams = rest @ rest.mT
    whole = SchurLinearization.of_gram(torch.cat([grams[:first], padded, grams[first:]]), 4)
    items = EliminatedItems(ROWS, OWN)
    others = SchurLinearization.of_gram(grams, 4, items.gram)
    cost = torch.tensor(7.0).double()
    partly = PartlyEliminated(others, items, first, cost)
    assert partly.cost is cost
    (shared, local), predicted = partly.step(torch.tensor(1e-13, dtype=torch.float64))
    (expected, own), decrease = whole.step(torch.tensor(1e-13, dtype=torch.float64))
    torch.testing.assert_close(shared, expected, rtol=1e-7, atol=1e-12)
    torch.testing.assert_close(local, own, rtol=1e-6, atol=1e-11)
    torch.testing.assert_close(predicted, decrease, rtol=1e-8, atol=0)
    for part, other in zip(partly.information(), others.information(), strict=True):
        assert torch.equal(part, other)
    second = PartlyEliminated(others, items, first, cost)
    assert partly.blend(torch.tensor(True), second) is second
    assert partly.blend(torch.tensor(False), second) is partly
