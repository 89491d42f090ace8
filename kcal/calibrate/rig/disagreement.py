"""Find parts of a rig's data that contradict each other beyond their sigmas, and widen what they share."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.problem import RigProblem
from kcal.calibrate.rig.source import ItemSource, RigState
from kcal.calibrate.rig.uncertainty import SharedCovariance, turn_rows
from kcal.finding import Finding
from kcal.gaussian import triangular

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


def widen_for_parts(
    work: Adjustment, mask: Tensor, problem: RigProblem, state: RigState, covariance: SharedCovariance, variance: float
) -> list[Finding]:
    """Compare parts of each source with the rest; widen the covariance for what they contradict, and tell of it.

    Args:
        work: at the solution.
        mask: what took part.
        problem: of that.
        state: its solution.
        covariance: of the solution; its root grows.
        variance: by which the normal matrix' inverse was multiplied to make the covariance.
    """
    directions = _shared_directions(problem, state, work.data.names)
    partitions = list(_partitions(work, mask, state))
    if not partitions or not directions:
        return []
    onto = torch.block_diag(torch.stack([one.step for one in directions], 1), torch.ones(1, 1).double())
    products = problem.item_products(state, onto)
    inverse = covariance.root / math.sqrt(variance)
    summed = []
    for part in partitions:
        own = products[part.block]
        summed.append(own.new_zeros(len(part.names), *own.shape[1:]).index_add(0, part.group, own))
    told, added = list[tuple[float, _Direction, _Partition, _Effect]](), list[Tensor]()
    for axis, direction in enumerate(directions):
        found = [_offsets_evidence(sums, axis, direction.step, inverse, variance) for sums in summed]
        both = [(part, one) for part, one in zip(partitions, found, strict=True) if one is not None]
        factor = sum(one.factor for _, one in both) / max(len(both), 1)
        if factor < _TOLD:
            continue
        added += [math.sqrt(one.factor / len(both) / factor) * one.tau * one.pull for _, one in both]
        told.append((factor, direction, *max(both, key=lambda one: one[1].factor)))
    if not told:
        return []
    before = covariance.root
    covariance.root = triangular(torch.cat([before, *added], 1).T).T
    _, direction, part, one = max(told, key=lambda each: each[0])
    old, new = (float((direction.row @ root).norm()) for root in (before, covariance.root))
    return [
        Finding(
            "contradiction",
            "doubt",
            f"{part.names[one.worst]} disagree with the other {part.kind} by {direction.text(one.offset)} in "
            f"{direction.words} ({one.sigmas:.1f} sigma): its sigma was widened from {direction.text(old)} to "
            f"{direction.text(new)}",
            part.cure,
        )
    ]


def _offsets_evidence(sums: Tensor, axis: int, step: Tensor, inverse: Tensor, variance: float) -> _Effect | None:
    """The evidence of offsets along a direction, by products (G, S + 1, Q + 1) of the groups; None without any."""
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


def _shared_directions(problem: RigProblem, state: RigState, names: Sequence[str]) -> list[_Direction]:
    """Turns of each camera about its axes, and its distance from the first."""
    found = list[_Direction]()
    for c, name in enumerate(names):
        if problem.turn[c] is not None:
            turns = turn_rows(problem, c)
            found += [
                _Direction(f"the {word} of {name}", turn, turn, True)
                for word, turn in zip(("pitch", "yaw", "roll"), turns, strict=True)
            ]
        slot = problem.shift[c]
        if c and slot is not None:
            away = torch.nn.functional.normalize(state.center[c] - state.center[0], dim=0)
            step = away.new_zeros(problem.shared_size)
            step[slot], row = away, step.clone()
            row[slot] = away
            if problem.shift[0] is not None:
                row[problem.shift[0]] = -away
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
