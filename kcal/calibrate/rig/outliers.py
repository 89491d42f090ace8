"""Find what contradicts the rest of a joint adjustment: worst first, and back in what does not after all."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from kcal.calibrate.rig.adjustment import Adjustment, typical_ratio
from kcal.calibrate.rig.blocks import KINDS, PerKind
from kcal.calibrate.rig.limits import over_limit
from kcal.errors import InputError
from kcal.solve.lm import LMOptions
from kcal.solve.robust import RobustLoss

# Of the root of an item's mean square: an item three times worse than stated counts half.
LOSS = RobustLoss(kind="cauchy", scale=3.0)
# Robust solutions only tell what is wrong; they need no digits.
ROUGHLY = LMOptions(max_iterations=100, tolerance=1e-6, residual_floor=1e-8)
# If more than this share of a source is wrong, it is not a few items that are.
MOST_WRONG = 0.4
# A source whose typical item is off by so many times its sigma is wrong as a whole.
WRONG_AS_A_WHOLE = 20.0
_ROUNDS = 30


def without_wrong(work: Adjustment, masks: PerKind, solver: LMOptions) -> PerKind:
    """Solve without the items that contradict the rest: the worst is left out first; what fits after all returns.

    Args:
        work: at a robust solution; it is left at the solution without the wrong items.
        masks: items that may take part.
        solver: options of the solver.

    Returns:
        masks of the items that agree.

    Raises:
        InputError: not a few items are wrong but a source as a whole.
    """
    squares, freedom = work.squares(masks), work.freedom(masks)
    for kind, square, dof in zip(KINDS, squares, freedom, strict=True):
        if (times := math.sqrt(typical_ratio(square, dof))) > WRONG_AS_A_WHOLE:
            more = ", and time, zone and place of the night images" if kind == "stars" else ""
            raise InputError(
                f"the {kind} contradict each other or the rest: typically they are {times:.0f} times as far off as "
                f"their sigmas say; check names, units, heights, sigmas and that the cameras are these{more}"
            )
    over = over_limit(work, masks, squares)
    kept = PerKind(*(mask & ~(ratio > 1.0) for mask, ratio in zip(masks, over, strict=True)))
    _refuse_many(work, kept, masks)
    returned: set[tuple[int, int]] = set()
    for _ in range(_ROUNDS):
        work.solve(kept, solver)
        work.fit_corners(kept)
        # Each item by the fall of χ² without it, which sees leverage, but against what is typical of the plain χ².
        found = over_limit(work, kept, work.deletions(kept))
        worst = max(range(len(found)), key=lambda k: float(found[k].max()) if len(found[k]) else 0.0)
        if len(found[worst]) and float(found[worst].max()) > 1.0:
            kept[worst][int(found[worst].argmax())] = False
            _refuse_many(work, kept, masks)
            continue
        # With the cameras held where they are now, try again what was left out.
        outside = PerKind(*(before & ~after for before, after in zip(masks, kept, strict=True)))
        work.solve(outside, solver, held=True)
        again = False
        for k, ratio in enumerate(over_limit(work, outside, work.squares(outside), 0.999)):
            for i in (outside[k] & (ratio < 1.0)).nonzero()[:, 0].tolist():
                if (k, i) not in returned:
                    returned.add((k, i))
                    kept[k][i] = again = True
        if not again:
            break
    return kept


def possible(work: Adjustment, masks: PerKind) -> PerKind:
    """Masks without what has no projection at the present state: behind a camera, or beyond what its lens shows."""
    return PerKind(*(mask & torch.isfinite(square) for mask, square in zip(masks, work.squares(masks), strict=True)))


def _refuse_many(work: Adjustment, kept: PerKind, masks: PerKind) -> None:
    for kind, after, before in zip(KINDS, kept, masks, strict=True):
        gone, total = int((before & ~after).sum()), int(before.sum())
        if gone > max(1, MOST_WRONG * total):
            names: Sequence[str] = [work.names(kind)[i] for i in (before & ~after).nonzero()[:, 0].tolist()]
            raise InputError(
                f"{gone} of {total} {kind} contradict the rest ({', '.join(names[:6])}{' ...' if gone > 6 else ''}): "
                "these are not a few wrong ones; check names, units, heights, sigmas and that the cameras are these"
            )
