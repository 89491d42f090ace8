"""Find what contradicts the rest of a rig's data, and allow for it: items of a source, parts of it, or all of it.

What says of the cameras other than the rest, beyond its sigmas, is compared with what the rest says without it. All of
it follows from products of the rows at the solution, without solving again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.problem import GoodnessOfFit, RigProblem, RigSolution, least
from kcal.calibrate.rig.source import ItemSource, RigState
from kcal.checks import beyond_chance, variance_factor
from kcal.errors import ContradictionError
from kcal.finding import Finding
from kcal.gaussian import triangular


class Part(NamedTuple):
    """What a source says, a single baseline or position, or what is known beforehand.

    Attributes:
        name: of it.
        gram: (S + 1, S + 1) products of its rows, residuals last.
        rows: how many residuals it has beyond its items' own unknowns.
        term: its index among the problem's terms; None for boards, landmarks and features.
    """

    name: str
    gram: Tensor
    rows: int
    term: int | None = None


def known_part(problem: RigProblem, state: RigState) -> Part:
    """What is known beforehand."""
    prior = problem.prior_rows(state)
    return Part("", prior @ prior.T, prior.shape[1])


def parts_of(work: Adjustment, problem: RigProblem, state: RigState) -> list[Part]:
    """All sources, and each of what was measured of the cameras."""
    grams = zip(problem.blocks, problem.block_grams(state), strict=True)
    parts = [Part(f"the {block.kind}", gram, int(block.freedom.sum())) for block, gram in grams]
    labels, posed = [label for i, label in enumerate(work.term_labels) if i not in work.without], problem.posed(state)
    for number, (label, term) in enumerate(zip(labels, problem.terms, strict=True)):
        rows = term.rows_at(posed, problem.shared_size)
        parts.append(Part(label, rows @ rows.T, term.count, number))
    return parts


# Items of a source that contradict each other.
#
# Marks by hand are often worse than their sigmas say. Beside a thousand good matches that hardly shows in the χ² of
# all, yet the marks pull at the cameras as if they were right, and what they contradict then looks wrong. So each
# source is asked alone, with what is known of the lenses: what the others say of the cameras, right or wrong, does not
# enter. Its sigmas are multiplied by what its own residuals tell (a variance component, Förstner 1979, of each source
# by itself).


def own_fits(problem: RigProblem, state: RigState) -> dict[str, GoodnessOfFit]:
    """The fit of each kind of items alone, with what is known beforehand, from their rows at a solution of all."""
    known, found = known_part(problem, state), dict[str, GoodnessOfFit]()
    for block, gram in zip(problem.blocks, problem.block_grams(state), strict=True):
        # The noise of boards' corners is estimated as it is.
        if not block.many:
            alone = least(gram + known.gram)
            found[block.kind] = GoodnessOfFit(alone.chi2, int(block.freedom.sum()) + known.rows - alone.rank)
    return found


def widen_sources(work: Adjustment, mask: Tensor) -> float:
    """Multiply the stated sigmas of each kind of items by what its fit to itself tells, never below 1.

    Returns:
        the largest relative change.
    """
    change = 0.0
    for kind, fit in own_fits(work.problem(mask), work.part(mask)).items():
        before = work.widened[kind]
        if before > 1.0 or beyond_chance(fit.chi2, fit.freedom):
            after = max(1.0, before * math.sqrt(fit.chi2 / fit.freedom))
            work.widened = {**work.widened, kind: after}
            change = max(change, abs(after / before - 1.0))
    return change


def sigmas_findings(work: Adjustment, fit: GoodnessOfFit) -> list[Finding]:
    """Doubts of stated sigmas that were multiplied: of sources, and of all together by their fit."""
    texts = [
        f"the {kind} differ from each other by {times:.1f} times what their sigmas say: their sigmas were multiplied "
        f"by {times:.1f}"
        for kind, times in work.widened.items()
        if times > 1.0
    ]
    if fit.variance > 1.0:
        times = math.sqrt(fit.variance)
        texts.append(f"residuals are {times:.1f} times as large as their sigmas say; the covariance was widened")
    return [Finding("sigmas", "doubt", text) for text in texts]


# Parts of a source that contradict the others of it.
#
# An error of a lens, of matching or of a board that bends is alike for items that are near each other, so it does not
# average out as noise does. Items are put into groups, by place in the image or by range, and each group may have an
# offset of its own in one of the quantities that the rig shares: a random effect of variance τ².
#
# No group is solved by itself. At the solution, the score of an offset of group g along the direction d is
# u_g = dᵀ Σ B e over the rows B and residuals e of its items, and all scores together have the covariance
# K = diag(dᵀ N_g d) - [dᵀ N_g] N⁻¹ [N_g d], with N_g the group's information and N that of everything (Rao 1948).
# Offsets add τ² K K to it. In the eigenvectors of K each score is independent, and the evidence of τ² is a product.
# The solution moves by N⁻¹ N_g d for each unit of a group's offset, which is what the covariance of the rig gains.
#
# The mean of the Bayes factors of all ways to make groups exceeds `_TOLD` in less than one of `_TOLD` good rigs, for
# each direction, however many ways are tried (Markov's inequality). Below that nothing is widened:
# `scripts/check/contradictions.py` measured that σ would grow by half without a reason.

# Items of a group, at least; groups along a line, and along each side of a grid, at most.
_MEMBERS, _LINE, _SIDE = 5, 4, 3
# τ² times the mean information about an offset: a quarter to 256, each power of two as likely.
_RATIOS = 2.0 ** torch.arange(-2, 9, dtype=torch.float64)
# Mean Bayes factor from which a contradiction is told, and its groups' offsets widen the covariance.
_TOLD = 20.0
# Information below this share of a group's is rounding.
_ROUNDING = 1e-9


class _Direction(NamedTuple):
    """Something that parts may disagree about: its words, its step (S,), and the function (S,) whose sigma is told."""

    words: str
    step: Tensor
    row: Tensor
    degrees: bool

    def text(self, value: float) -> str:
        """An amount of it."""
        return f"{math.degrees(value):.2g}°" if self.degrees else f"{value:.2g} m"


class _Partition(NamedTuple):
    """One way to put the items of a block into groups: the group (V,) of each, and a name for each group."""

    block: int
    kind: str
    group: Tensor
    names: tuple[str, ...]
    cure: str


class _Effect(NamedTuple):
    """Evidence of offsets of a partition's groups along one direction.

    Attributes:
        factor: Bayes factor against no offsets.
        tau: posterior mean of the offsets' standard deviation, if there are any.
        worst: the group that stands out most.
        offset: of it, from all together.
        sigmas: how many of its standard deviations that is.
        pull: (S, G) how the solution moves by an offset of each group.
    """

    factor: float
    tau: float
    worst: int
    offset: float
    sigmas: float
    pull: Tensor


def widen_for_parts(work: Adjustment, mask: Tensor, solution: RigSolution) -> list[Finding]:
    """Compare parts of each source with the rest; widen the covariance for what they contradict, and tell of it."""
    directions = _shared_directions(solution, work.data.names)
    partitions = list(_partitions(work, mask, solution.state))
    if not partitions or not directions:
        return []
    onto = torch.block_diag(torch.stack([one.step for one in directions], 1), torch.ones(1, 1).double())
    products, summed = solution.problem.item_products(solution.state, onto), []
    for part in partitions:
        own = products[part.block]
        summed.append(own.new_zeros(len(part.names), *own.shape[1:]).index_add(0, part.group, own))
    told, added = list[tuple[float, _Direction, _Partition, _Effect]](), list[Tensor]()
    for axis, direction in enumerate(directions):
        found = [_offsets_evidence(sums, axis, direction.step, solution) for sums in summed]
        both = [(part, one) for part, one in zip(partitions, found, strict=True) if one is not None]
        factor = sum(one.factor for _, one in both) / max(len(both), 1)
        if factor < _TOLD:
            continue
        added += [math.sqrt(one.factor / len(both) / factor) * one.tau * one.pull for _, one in both]
        told.append((factor, direction, *max(both, key=lambda one: one[1].factor)))
    if not told:
        return []
    before = solution.root
    solution.root = triangular(torch.cat([before, *added], 1).T).T
    _, direction, part, one = max(told, key=lambda each: each[0])
    old, new = (direction.text(float((direction.row @ root).norm())) for root in (before, solution.root))
    text = (
        f"{part.names[one.worst]} disagree with the other {part.kind} by {direction.text(one.offset)} in "
        f"{direction.words} ({one.sigmas:.1f} sigma): its sigma was widened from {old} to {new}"
    )
    return [Finding("contradiction", "doubt", text, part.cure)]


def _offsets_evidence(sums: Tensor, axis: int, step: Tensor, solution: RigSolution) -> _Effect | None:
    """The evidence of offsets along a direction, by products (G, S + 1, Q + 1) of the groups; None without any."""
    variance = solution.variance
    inverse = solution.root / math.sqrt(variance)
    along, score = sums[:, :-1, axis].T, sums[:, -1, axis]
    known, thrown = step @ along, inverse.T @ along
    K = torch.diag(known) - thrown.T @ thrown
    values, vectors = torch.linalg.eigh(K)
    kept = values > _ROUNDING * known.max().clamp_min(1e-300)
    if not bool(kept.any()):
        return None
    information = values[kept]
    squares = (vectors[:, kept].T @ score).square() / information / variance
    tau2 = _RATIOS / information.mean()
    times = tau2[:, None] * information
    logs = 0.5 * (squares * times / (1.0 + times) - times.log1p()).sum(1)
    own = K.diagonal().clamp_min(_ROUNDING * known.max())
    sigmas = score / (own * variance).sqrt()
    worst = int(sigmas.abs().argmax())
    return _Effect(
        float(logs.exp().mean()),
        math.sqrt(variance) * float(logs.softmax(0) @ tau2.sqrt()),
        worst,
        abs(float(score[worst] / own[worst])),
        abs(float(sigmas[worst])),
        inverse @ thrown,
    )


def _shared_directions(solution: RigSolution, names: Sequence[str]) -> list[_Direction]:
    """Turns of each camera about its axes, and its distance from the first."""
    found, problem, center = list[_Direction](), solution.problem, solution.state.center
    for c, name in enumerate(names):
        if problem.turn[c] is not None:
            words = zip(("pitch", "yaw", "roll"), solution.turn_rows(c), strict=True)
            found += [_Direction(f"the {word} of {name}", turn, turn, True) for word, turn in words]
        if c and problem.shift[c] is not None:
            away = torch.nn.functional.normalize(center[c] - center[0], dim=0)
            step = away @ solution.shift_rows(c)
            row = step - away @ solution.shift_rows(0)
            found.append(_Direction(f"the baseline of {name}", step, row, False))
    return found


def _partitions(work: Adjustment, mask: Tensor, state: RigState) -> Iterator[_Partition]:
    """All ways to put items that took part into groups."""
    used = [(source, at) for source, at in work.sources if bool(mask[at].any())]
    for block, (source, at) in enumerate(used):
        if source.least > 1:
            # One wrong board among few is told otherwise, and would widen what the others say.
            continue
        chosen = mask[at]
        yield from _by_place(block, source, work, chosen)
        where = source.places(work.state.items[at], work.anchor)
        if where is not None and (lines := min(_LINE, int(chosen.sum()) // _MEMBERS)) > 1:
            far = (where[chosen] - state.center[0]).norm(dim=-1)
            group, text = _ranked(far, lines), "check whether near ones moved, and what is known of their ranges"
            ends = [(float(far[group == g].min()), float(far[group == g].max())) for g in range(lines)]
            words = tuple(f"{source.kind} at {near:.3g} to {end:.3g} m" for near, end in ends)
            yield _Partition(block, source.kind, group, words, text)


def _by_place(block: int, source: ItemSource, work: Adjustment, chosen: Tensor) -> Iterator[_Partition]:
    """Groups by columns, by rows and by a grid of the image of the first camera that sees each item."""
    pixels = source.pixels[chosen]
    spot = torch.full((len(pixels), 2), math.nan, dtype=torch.float64)
    for c, camera in enumerate(work.data.cameras):
        size = torch.tensor(camera.size, dtype=torch.float64)
        spot = torch.where(spot.isnan(), (pixels[:, c] + 0.5) / size - 0.5, spot)
    count, text = len(spot), "calibrate the lens with views that reach there, or leave these out"
    lines, side = min(_LINE, count // _MEMBERS), min(_SIDE, math.isqrt(count // _MEMBERS))
    ways = [_ranked(spot[:, 0], lines), _ranked(spot[:, 1], lines)] if lines > 1 else []
    if side > 1:
        columns = _ranked(spot[:, 0], side)
        grid = columns * side
        for column in range(side):
            grid[columns == column] += _ranked(spot[columns == column, 1], side)
        ways.append(grid)
    for group in ways:
        middles = [spot[group == g].mean(0).tolist() for g in range(int(group.max()) + 1)]
        words = tuple(f"{source.kind} in the {_place_words(*middle)} of the image" for middle in middles)
        yield _Partition(block, source.kind, group, words, text)


def _ranked(values: Tensor, groups: int) -> Tensor:
    """(V,) the group of each value, so that all have as many, in order."""
    rank = values.argsort().argsort()
    return rank * groups // max(len(values), 1)


def _place_words(across: float, down: float) -> str:
    """Where a place is in the image, whose sides are -½ and ½."""
    third = 1.0 / 6.0
    level = "left" if across < -third else "right" if across > third else ""
    height = "upper" if down < -third else "lower" if down > third else ""
    return f"{height} {level}".strip() if level else f"{height} middle".strip()


# A source that contradicts all the others.
#
# A source that is stated too precisely bends the solution towards itself, and its error shows as slightly larger
# residuals of everything. So it is compared with what the others say without it: the least χ² of all together exceeds
# the sum of the least χ² of the source alone and of the others alone by χ² with as many degrees of freedom as both
# determine.

# Standard deviations of a normal variable as unlikely as what is found: a doubt, and beyond reasonable doubt.
_DOUBT, _CERTAIN = 3.5, 4.5


class _Test(NamedTuple):
    """One source against the others: χ² of their difference, its freedom, and how unlikely it is."""

    chi2: float
    freedom: int
    sigmas: float


def contradicting_source(work: Adjustment, solution: RigSolution, *, refuse: bool) -> list[Finding]:
    """The source that contradicts the others, or both of two that contradict each other; nothing where all agree.

    Raises:
        InputError: a measured baseline or position that does so beyond reasonable doubt; unless `refuse` is False.
    """
    problem, state = solution.problem, solution.state
    known, parts = known_part(problem, state), parts_of(work, problem, state)
    everything = tuple(range(len(parts)))
    groups: list[tuple[int, ...]] = [(i,) for i in everything]
    placed = tuple(i for i, part in enumerate(parts) if part.name.startswith("the position"))
    if len(placed) > 1:
        groups.append(placed)
    tests = {group: _test(parts, group, everything, known) for group in groups if len(group) < len(parts)}
    found = {group: test for group, test in tests.items() if test.sigmas > _DOUBT}
    if not found:
        return []

    def quarrel(within: tuple[int, ...]) -> bool:
        """Whether some parts contradict each other."""
        return len(within) > 1 and any(_test(parts, (i,), within, known).sigmas > _DOUBT for i in within)

    suspects = [group for group in found if not quarrel(tuple(i for i in everything if i not in group))]
    own = {group: sum(parts[i].rows for i in group) - least(_sum(parts, group)).rank for group in found}
    suspects = suspects or [max(found, key=lambda group: found[group].sigmas)]
    suspects.sort(key=lambda group: (own[group], len(group), -found[group].sigmas))
    named = suspects[0]
    # A source that is supported no better by its own data is as likely to be the wrong one.
    equal = [other for other in suspects[1:] if not set(other) & set(named) and (own[other] <= 0 or own[named] > 0)]
    test, term, rest = found[named], parts[named[0]].term, [i for i in everything if i not in named]
    if term is None or len(named) > 1:
        times = math.sqrt(test.chi2 / test.freedom)
        verb, how = "contradict", f"what they say of the cameras differs by {times:.1f} times what their sigmas explain"
    else:
        without = least(_sum(parts, rest, known))
        rows = problem.terms[term].rows_at(problem.posed(state), problem.shared_size)
        off = rows[-1] + without.step @ rows[:-1]
        sigma = (rows[:-1].T @ without.root).square().sum(1).sqrt()
        verb, how = "contradicts", problem.terms[term].against(off, sigma)
    others = " and ".join(filter(None, (", ".join(parts[i].name for i in rest[:-1]), parts[rest[-1]].name)))
    text = (
        f"{_name(parts, named)} {verb} {others}: {how} ({test.sigmas:.1f} standard deviations); measure again, correct "
        "the value or its sigma, or leave it out"
    )
    if equal:
        text += f"; it may as well be {' and '.join(_name(parts, group) for group in equal)} that is wrong"
    certain = test.sigmas > _CERTAIN
    # Nothing but itself supports a measured baseline or position.
    if certain and refuse and own[named] <= 0:
        raise ContradictionError(text)
    return [Finding("contradiction", "stop" if certain else "doubt", text)]


def _sum(parts: Sequence[Part], chosen: Iterable[int], known: Part | None = None) -> Tensor:
    grams = [parts[i].gram for i in chosen] + ([] if known is None else [known.gram])
    return torch.stack(grams).sum(0)


def _name(parts: Sequence[Part], group: tuple[int, ...]) -> str:
    return parts[group[0]].name if len(group) == 1 else "the measured positions"


def _test(parts: Sequence[Part], group: tuple[int, ...], within: tuple[int, ...], known: Part) -> _Test:
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
