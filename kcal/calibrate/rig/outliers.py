"""Finding what contradicts the rest of a joint adjustment: worst first, and back in what does not after all."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor

from kcal.calibrate.rig.adjustment import KINDS, Adjustment, typical_excess
from kcal.calibrate.rig.limits import excess
from kcal.errors import InputError
from kcal.solve.lm import LMOptions
from kcal.solve.robust import RobustLoss

# Of the root of an item's mean square: what is three times worse than stated counts half.
LOSS = RobustLoss(kind="cauchy", scale=3.0)
# Robust solutions only sort out what is wrong.
ROUGHLY = LMOptions(max_iterations=100, tolerance=1e-6, residual_floor=1e-8)
# More than this share of a source is not a few wrong ones.
_MOST_WRONG = 0.4
# A source whose typical item is off by this many times its sigma has no wrong items but is wrong.
_WHOLE = 20.0
_ROUNDS = 30


def reject_wrong(work: Adjustment, masks: list[Tensor], reasons: list[dict[int, str]], solver: LMOptions) -> None:
    """Take out of the masks what contradicts the rest, worst first, and back in what does not after all."""
    possible = [mask.clone() for mask in masks]
    squares, freedom = work.squares(possible), work.freedom(possible)
    for word, square, dof in zip(KINDS, squares, freedom, strict=True):
        if (times := math.sqrt(typical_excess(square, dof))) > _WHOLE:
            raise InputError(
                f"the {word} contradict each other or the rest: typically they are {times:.0f} times as far off as "
                "their sigmas say; check names, units, heights, sigmas and that the cameras are these"
            )
    for mask, over in zip(masks, excess(work, masks, squares), strict=True):
        mask &= ~(over > 1.0)
    _refuse_many(work, masks, possible)
    returned: set[tuple[int, int]] = set()
    for _ in range(_ROUNDS):
        work.solve(masks, solver)
        work.fit_corners(masks)
        # What is typical is told by the items' own squares: leverage is no misfit.
        found = excess(work, masks, work.deletions(masks))
        kind = max(range(3), key=lambda k: float(found[k].max()) if len(found[k]) else 0.0)
        if len(found[kind]) and float(found[kind].max()) > 1.0:
            masks[kind][int(found[kind].argmax())] = False
            _refuse_many(work, masks, possible)
            continue
        # Cameras stay where they are now; what was left out is asked again.
        outside = [p & ~m for p, m in zip(possible, masks, strict=True)]
        work.solve(outside, solver, held=True)
        again = False
        for k, over in enumerate(excess(work, outside, work.squares(outside), 0.999)):
            for i in (outside[k] & (over < 1.0)).nonzero()[:, 0].tolist():
                if (k, i) not in returned:
                    returned.add((k, i))
                    masks[k][i] = again = True
        if not again:
            break
    for k, (before, after) in enumerate(zip(possible, masks, strict=True)):
        for i in (before & ~after).nonzero()[:, 0].tolist():
            reasons[k].setdefault(i, "")


def _refuse_many(work: Adjustment, masks: Sequence[Tensor], possible: Sequence[Tensor]) -> None:
    for kind, mask, before in zip(KINDS, masks, possible, strict=True):
        gone, total = int((before & ~mask).sum()), int(before.sum())
        if gone > max(1, _MOST_WRONG * total):
            names = [getattr(work.data, kind).names[i] for i in (before & ~mask).nonzero()[:, 0].tolist()]
            raise InputError(
                f"{gone} of {total} {kind} contradict the rest ({', '.join(names[:6])}{' ...' if gone > 6 else ''}): "
                "these are not a few wrong ones; check names, units, heights, sigmas and that the cameras are these"
            )
