"""Test each source of a rig against all the others, and name the one that contradicts.

A source that is stated too precisely bends the solution towards itself, and its error shows as slightly larger
residuals of everything. So it is compared with what the others say without it: the least χ² of all together exceeds
the sum of the least χ² of the source alone and of the others alone by χ² with as many degrees of freedom as both
determine. All three follow from the normal matrices of the sources at the solution, without solving again.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.blocks import RigState
from kcal.calibrate.rig.own_fit import least
from kcal.calibrate.rig.problem import RigProblem
from kcal.chance import variance_factor

# Standard deviations of a normal variable as unlikely as what is found: a doubt, and beyond reasonable doubt.
_DOUBT, CERTAIN = 3.5, 4.5


class Contradiction(NamedTuple):
    """A source that contradicts the others.

    Attributes:
        text: one sentence with numbers.
        sigmas: standard deviations of a normal variable that is as unlikely.
        stated: whether it is a measured baseline or position, which nothing but itself supports.
    """

    text: str
    sigmas: float
    stated: bool


class _Part(NamedTuple):
    """A source, or a single baseline or position.

    Attributes:
        name: of it.
        gram: (S + 1, S + 1) products of its rows, residuals last.
        rows: how many residuals it has beyond its items' own unknowns.
        term: its index among the problem's terms; None for boards, landmarks and features.
    """

    name: str
    gram: Tensor
    rows: int
    term: int | None


class _Test(NamedTuple):
    """One source against the others: χ² of their difference, its freedom, and how unlikely it is."""

    chi2: float
    freedom: int
    sigmas: float


def contradictions(work: Adjustment, problem: RigProblem, state: RigState) -> list[Contradiction]:
    """The source that contradicts the others, or both of two that contradict each other; empty where all agree."""
    prior = problem.prior_rows(state)
    known = _Part("", prior @ prior.T, prior.shape[1], None)
    parts = _parts(work, problem, state)
    groups: list[tuple[int, ...]] = [(i,) for i in range(len(parts))]
    placed = tuple(i for i, part in enumerate(parts) if part.name.startswith("the position"))
    if len(placed) > 1:
        groups.append(placed)
    if len(parts) < 2:
        return []
    everything = tuple(range(len(parts)))
    tests = {group: _test(parts, group, everything, known) for group in groups if len(group) < len(parts)}
    found = {group: test for group, test in tests.items() if test.sigmas > _DOUBT}
    if not found:
        return []
    suspects = [group for group in found if not _quarrel(parts, set(everything) - set(group), known)]
    own = {group: sum(parts[i].rows for i in group) - least(_sum(parts, group)).rank for group in found}
    suspects = suspects or [max(found, key=lambda group: found[group].sigmas)]
    suspects.sort(key=lambda group: (own[group], len(group), -found[group].sigmas))
    named = suspects[0]
    # What supports itself no more, or no less, is as likely to be wrong.
    equal = [other for other in suspects[1:] if not set(other) & set(named) and (own[other] <= 0 or own[named] > 0)]
    rest = [part.name for i, part in enumerate(parts) if i not in named]
    text = _what_contradicts(parts, named, found[named], problem, state, known, rest)
    if equal:
        names = " and ".join(_name(parts, group) for group in equal)
        text += f"; it may as well be {names} that is wrong"
    return [Contradiction(text, found[named].sigmas, own[named] <= 0)]


def still_determined(problem: RigProblem, state: RigState) -> list[bool]:
    """For each of the problem's terms whether the others determine as much without it."""
    whole = torch.stack([*problem.block_grams(state), *_term_grams(problem, state)]).sum(0)
    return [least(whole - gram).rank == least(whole).rank for gram in _term_grams(problem, state)]


def _term_grams(problem: RigProblem, state: RigState) -> list[Tensor]:
    posed = problem.posed(state)
    return [rows @ rows.T for rows in (term.rows(posed, problem.shared_size) for term in problem.terms)]


def _parts(work: Adjustment, problem: RigProblem, state: RigState) -> list[_Part]:
    counted = [int((block.counts - block.size).sum()) for block in problem.blocks]
    parts = [
        _Part(f"the {block.kind}", gram, rows, None)
        for block, gram, rows in zip(problem.blocks, problem.block_grams(state), counted, strict=True)
    ]
    labels = [label for i, label in enumerate(work.term_labels) if i not in work.without]
    for number, (label, gram) in enumerate(zip(labels, _term_grams(problem, state), strict=True)):
        parts.append(_Part(label, gram, problem.terms[number].count, number))
    return parts


def _sum(parts: list[_Part], chosen: tuple[int, ...] | set[int], known: _Part | None = None) -> Tensor:
    grams = [parts[i].gram for i in chosen] + ([] if known is None else [known.gram])
    return torch.stack(grams).sum(0)


def _test(parts: list[_Part], group: tuple[int, ...], within: tuple[int, ...], known: _Part) -> _Test:
    """A group of parts against the rest of `within` and what is known beforehand."""
    rest = tuple(i for i in within if i not in group)
    own, others = _sum(parts, group), _sum(parts, rest, known)
    alone, without, together = least(own), least(others), least(own + others)
    freedom = alone.rank + without.rank - together.rank
    if freedom <= 0:
        return _Test(0.0, 0, 0.0)
    rows = sum(parts[i].rows for i in within) + known.rows
    inner, left = alone.chi2 + without.chi2, rows - alone.rank - without.rank
    # Where stated sigmas are too small throughout, a difference counts by what residuals really are.
    chi2 = max(together.chi2 - inner, 0.0) / variance_factor(inner, left)
    if freedom == 1:
        return _Test(chi2, 1, math.sqrt(chi2))
    # Wilson and Hilferty (1931).
    spread = 2.0 / (9.0 * freedom)
    return _Test(chi2, freedom, ((chi2 / freedom) ** (1 / 3) - 1.0 + spread) / math.sqrt(spread))


def _quarrel(parts: list[_Part], within: set[int], known: _Part) -> bool:
    """Whether some parts contradict each other."""
    some = tuple(sorted(within))
    return len(some) > 1 and any(_test(parts, (i,), some, known).sigmas > _DOUBT for i in some)


def _name(parts: list[_Part], group: tuple[int, ...]) -> str:
    return parts[group[0]].name if len(group) == 1 else "the measured positions"


def _what_contradicts(
    parts: list[_Part],
    group: tuple[int, ...],
    test: _Test,
    problem: RigProblem,
    state: RigState,
    known: _Part,
    rest: list[str],
) -> str:
    """What contradicts what, with numbers, and what to do."""
    others = f"{', '.join(rest[:-1])} and {rest[-1]}" if len(rest) > 1 else rest[0]
    verb = "contradicts" if parts[group[0]].term is not None and len(group) == 1 else "contradict"
    term = parts[group[0]].term
    apart = f"what they say of the cameras differs by {math.sqrt(test.chi2 / test.freedom):.1f} times what their"
    how = f"{apart} sigmas explain"
    if term is not None and len(group) == 1:
        without = least(_sum(parts, set(range(len(parts))) - set(group), known))
        rows = problem.terms[term].rows(problem.posed(state), problem.shared_size)
        off = rows[-1] + without.step @ rows[:-1]
        how = problem.terms[term].against(off, (rows[:-1].T @ without.root).square().sum(1).sqrt())
    return (
        f"{_name(parts, group)} {verb} {others}: {how} ({test.sigmas:.1f} standard deviations); measure again, correct "
        "the value or its sigma, or leave it out"
    )
