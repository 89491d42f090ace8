"""The best robust solution of a rig from several initial poses."""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import Adjustment
from kcal.calibrate.rig.blocks import PerKind
from kcal.calibrate.rig.board_consensus import evenly
from kcal.calibrate.rig.initial_poses import InitialPoses
from kcal.calibrate.rig.mixups import cost_of_features_behind
from kcal.calibrate.rig.outliers import LOSS, ROUGHLY, possible
from kcal.calibrate.rig.unknowns import SharedUnknowns, held
from kcal.solve.lm import LMOptions

# px: a corner's noise before the boards themselves tell it.
_CORNER_SIGMA = 0.2
# Enough steps, and features, to tell which of several starts is best.
_SCREENING, _SCREENED = LMOptions(max_iterations=25, tolerance=1e-6, residual_floor=1e-8), 300


def robust_solution(initial: InitialPoses, masks: PerKind, unknowns: SharedUnknowns) -> Adjustment:
    """The best robust solution from all starts."""
    boards = initial.data.boards
    sigma = _CORNER_SIGMA if boards is None or boards.sigma is None else boards.sigma
    best: tuple[float, Adjustment] | None = None
    some = masks._replace(features=_evenly_taken(masks.features, _SCREENED))
    for start in initial.starts:
        work = Adjustment(initial.data, start, unknowns, sigma)
        if unknowns.refine_lenses:
            # From poses that are far off, lenses would bend towards them, beyond their folds even.
            work.unknowns = held(initial.data.cameras)
        here = possible(work, some)
        work.fit_corners(here, robust=True)
        problem, result = work.solve(here, _SCREENING, LOSS)
        cost = float(result.cost) + cost_of_features_behind(problem, work.part(here))
        cost += 1e6 * sum(int((a & ~b).sum()) for a, b in zip(some, here, strict=True))
        if best is None or cost < best[0]:
            best = (cost, work)
    assert best is not None
    work, here = best[1], possible(best[1], masks)
    work.unknowns = unknowns
    work.fit_corners(here, robust=True)
    work.solve(here, ROUGHLY, LOSS)
    return work


def _evenly_taken(mask: Tensor, most: int) -> Tensor:
    """The mask with `most` of its items at most, evenly taken."""
    chosen, out = mask.nonzero()[:, 0], torch.zeros_like(mask)
    out[chosen[evenly(len(chosen), most)]] = True
    return out
