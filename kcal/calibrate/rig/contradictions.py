"""Find what contradicts the rest of a rig's data, and allow for it: items of a source, parts of it, or all of it.

What says of the cameras other than the rest, beyond its sigmas, is compared with what the rest says without it. All of
it follows from products of the rows at the solution, without solving again.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.problem import GoodnessOfFit, RigProblem, RigSolution, least
from kcal.calibrate.rig.source import RigState
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
    """Multiply the sigmas of each kind of items by what its fit to itself tells, never below 1.

    What bends or moves a board moves all of its corners alike, so that they tell less than their noise and number say.

    Returns:
        the largest relative change.
    """
    change, problem, state = 0.0, work.problem(mask), work.part(mask)
    fits: dict[str, tuple[float, float]] = {**own_fits(problem, state)}
    if "boards" in work.widened:
        fits["boards"] = problem.scatter(state)
    for kind, (chi2, freedom) in fits.items():
        before = work.widened[kind]
        if before > 1.0 or beyond_chance(chi2, freedom):
            after = max(1.0, before * math.sqrt(chi2 / freedom))
            work.widened = {**work.widened, kind: after}
            change = max(change, abs(after / before - 1.0))
    return change


def sigmas_findings(work: Adjustment, fit: GoodnessOfFit) -> list[Finding]:
    """Doubts of sigmas that were multiplied: of sources, and of all together by their fit."""
    whose = {"boards": "corners' "}
    texts = [
        f"the {kind} differ from each other by {times:.1f} times what their {whose.get(kind, '')}sigmas say: "
        f"their sigmas were multiplied by {times:.1f}"
        for kind, times in work.widened.items()
        if times > 1.0
    ]
    if fit.variance > 1.0:
        times = math.sqrt(fit.variance)
        texts.append(f"residuals are {times:.1f} times as large as their sigmas say; the covariance was widened")
    return [Finding("sigmas", "doubt", text) for text in texts]


# Errors of pixels that neighbors share.
#
# A lens that is no longer what its calibration says, or matching that errs by place, moves what is near each other in
# an image alike, so it does not average out as noise does, and parts of the image say different things of the cameras.
# So each image may have a smooth field of errors beside all unknowns: a Gaussian process of variance τ² whose
# correlation falls as exp(-d² / 2ℓ²) (Rasmussen and Williams 2006). All that a camera sees has the same field: what
# matches and landmarks say of a lens counts once.
#
# Nothing is solved again. With rows F of the field's amplitudes, B of the shared unknowns and residuals e at the
# solution, the score Fᵀ e has the covariance K = Fᵀ F - Fᵀ B N⁻¹ Bᵀ F (Rao 1948); amplitudes of variance τ² add τ² K K
# to it. The solution moves by -N⁻¹ Bᵀ F for each unit of an amplitude, so it is off by that times the amplitudes; the
# second moments of these under all that is seen are what its covariance gains.
#
# The mean of the Bayes factors of all τ exceeds `_TOLD` in less than one of `_TOLD` good rigs (Markov's inequality), on
# simulated ones in one of 500. Below that nothing is widened.

# Of the images' sides, and how many places along them: closer ones add nothing to a field of that length.
_LENGTH, _PLACES = 0.35, (5, 4)
# τ² times the information about what is known best of a field: 1 to 4096, each power of four as likely.
_RATIOS = 4.0 ** torch.arange(7, dtype=torch.float64)
# Mean Bayes factor from which a field is told, and by how many times it then widens a turn at least.
_TOLD, _MATTERS = 10.0, 1.1


def _all_over(*counts: int) -> Tensor:
    """(P, 2) places all over an image, whose sides are -½ and ½."""
    across, down = ((torch.arange(count, dtype=torch.float64) + 0.5) / count - 0.5 for count in counts)
    return torch.cartesian_prod(across, down)


def _field_modes(places: Tensor) -> Tensor:
    """(V, K) values at places (V, 2) of functions whose sum with standard normal amplitudes is a field of τ = 1."""
    fixed = _all_over(*_PLACES)
    among, there = (torch.exp(-0.5 * (torch.cdist(one, fixed) / _LENGTH) ** 2) for one in (fixed, places))
    root = torch.linalg.cholesky(among + 1e-6 * torch.eye(len(fixed), dtype=torch.float64))
    return torch.linalg.solve_triangular(root, there.T, upper=False).T


def widen_for_fields(solution: RigSolution, names: Sequence[str]) -> list[Finding]:
    """Look for smooth errors in the images that no unknown explains; widen the covariance for them, and tell of it."""
    size, variance = solution.problem.shared_size, solution.variance
    if all(block.many for block in solution.problem.blocks):
        return []
    products = solution.problem.field_products(solution.state, _field_modes)
    own, right = products[size:-1, size:], products[:size, size:]
    inverse = solution.root / math.sqrt(variance)
    pull = inverse @ (inverse.T @ right[:, :-1])
    left = (own - pull.T @ right) / variance
    if not len(left) or not bool(left.isfinite().all()):
        return []
    values, vectors = torch.linalg.eigh(left[:, :-1])
    known, along = values.clamp_min(0.0), vectors.T @ left[:, -1]
    tau2 = (_RATIOS / known.max().clamp_min(1e-300))[:, None]
    spread = tau2 / (1.0 + tau2 * known)
    logs = 0.5 * (along.square() * spread - (tau2 * known).log1p()).sum(1)
    if float(logs.exp().mean()) < _TOLD:
        return []
    weight, mean = logs.softmax(0)[:, None], -along * spread
    # Second moments of the amplitudes under all τ.
    root = torch.cat([torch.diag_embed((weight * spread).sum(0).sqrt()), weight.sqrt() * mean]) @ vectors.T
    wider = triangular(torch.cat([solution.root, pull @ root.T], 1).T).T
    cameras = range(1, len(names)) if len(names) > 1 else range(1)
    turns = torch.cat([(solution.relative_rows(0, c) if c else solution.turn_rows(c))[:3] for c in cameras])
    before, after = ((turns @ one).norm(dim=1) for one in (solution.root, wider))
    worst = int((after / before).nan_to_num(0.0).argmax())
    if float(after[worst]) <= _MATTERS * float(before[worst]):
        return []
    solution.root, step = wider, vectors @ (weight * mean).sum(0)
    field = (_field_modes(_all_over(3, 3)) @ step.unflatten(0, (len(names), -1, 2))).norm(dim=-1)
    camera, place = divmod(int(field.argmax()), field.shape[1])
    across, down = ("left", "middle", "right")[place // 3], ("upper ", "", "lower ")[place % 3]
    moved, old, new = (math.degrees(float(one.abs()[worst])) for one in (turns @ pull @ step, before, after))
    turn = f"the {('pitch', 'yaw', 'roll')[worst % 3]} of {names[cameras[worst // 3]]}"
    text = (
        f"what {names[camera]} sees in the {down}{across} of its image disagrees with the rest by "
        f"{float(field.max()):.2g} px, and neighbors alike: it moves {turn} by {moved:.2g}°, whose sigma was widened "
        f"from {old:.2g}° to {new:.2g}°"
    )
    cure = "calibrate the lens with views that reach there, or check what was marked or matched there"
    return [Finding("contradiction", "doubt", text, cure)]


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
    against, cure = [parts[i].name for i in rest], "measure again, correct the value or its sigma, or leave it out"
    if _test(parts, named, everything, _of_free_lenses(problem, known)).sigmas <= _DOUBT:
        against.append("what is known of the lenses")
        cure = f"are these the lenses that were calibrated, and images of that size? If so, {cure}"
    others = " and ".join(filter(None, (", ".join(against[:-1]), against[-1])))
    text = f"{_name(parts, named)} {verb} {others}: {how} ({test.sigmas:.1f} standard deviations); {cure}"
    if equal:
        text += f"; it may as well be {' and '.join(_name(parts, group) for group in equal)} that is wrong"
    certain = test.sigmas > _CERTAIN
    # Nothing but itself supports a measured baseline or position.
    if certain and refuse and own[named] <= 0:
        raise ContradictionError(text)
    return [Finding("contradiction", "stop" if certain else "doubt", text)]


def _of_free_lenses(problem: RigProblem, known: Part) -> Part:
    """What is known beforehand of all but the lenses."""
    lenses = torch.cat(problem.unknowns.cameras).any(0).nonzero()[:, 0]
    gram = known.gram.clone()
    gram[lenses], gram[:, lenses] = 0.0, 0.0
    return known._replace(gram=gram, rows=known.rows - len(lenses))


def _sum(parts: Sequence[Part], chosen: Iterable[int], known: Part | None = None) -> Tensor:
    return torch.stack([parts[i].gram for i in chosen] + ([] if known is None else [known.gram])).sum(0)


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
