"""Count what is left over to check where each camera of a rig stands."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from kcal.calibrate.rig.blocks import Block, FeatureBlock
from kcal.calibrate.rig.landmark_block import LandmarkBlock
from kcal.calibrate.rig.problem import RigProblem
from kcal.errors import DegenerateError


def redundancy(problem: RigProblem) -> list[int | None]:
    """How many residuals more than unknowns each camera adds to the others; None for one that stands still.

    With 0 a camera is determined exactly, and no residual would tell that it stands elsewhere.
    """
    added = torch.zeros(len(problem.cameras), dtype=torch.long)
    for block in problem.blocks:
        added += _added(block)
    for term in problem.terms:
        added[list(term.cameras)] += term.count
    unknown = [
        0 if (turn, shift) == (None, None) else 3 * (turn is not None) + 3 * (shift is not None)
        for turn, shift in zip(problem.turn, problem.shift, strict=True)
    ]
    return [count - own if own else None for count, own in zip(added.tolist(), unknown, strict=True)]


def least_redundancy(problem: RigProblem) -> int:
    """The smallest `redundancy` of a camera."""
    return min(count for count in redundancy(problem) if count is not None)


def _added(block: Block) -> torch.Tensor:
    """(C,) residuals that a block's items have more with each camera than without it."""
    seen = block.seen.sum(-1)
    by_others = seen.sum(1, keepdim=True) - seen
    if isinstance(block, LandmarkBlock):
        return 2 * seen.sum(0)
    if isinstance(block, FeatureBlock):
        # What nobody else sees tells a camera nothing; what one other sees has a direction from it.
        beyond = (block.counts - 2 * seen.sum(1) - block.size)[:, None]
        before, after = (2 * count + beyond for count in (by_others, by_others + seen))
        return torch.where(seen > 0, after.clamp_min(0) - before.clamp_min(0), 0).sum(0)
    return (2 * seen * (by_others > 0)).sum(0)


def refuse_exact(problem: RigProblem, names: Sequence[str], freedom: int) -> None:
    """Raise `DegenerateError` where nothing is left over to check a camera with.

    Args:
        problem: of what agrees.
        names: of the cameras.
        freedom: degrees of freedom of all of it.
    """
    exact = [name for name, count in zip(names, redundancy(problem), strict=True) if count is not None and count <= 0]
    if not exact and freedom > 0:
        return
    marks = [block.seen.any(-1).sum(0).tolist() for block in problem.blocks if isinstance(block, LandmarkBlock)]
    counted = [f"{marks[0][c]} landmarks" for c, name in enumerate(names) if marks and name in exact]
    who = " and ".join(exact) or "the cameras"
    why = f" ({', '.join(counted)}; three fit up to four places)" if counted else ""
    raise DegenerateError(
        f"the data determine where {who} stand{'s' if len(exact) == 1 else ''} exactly{why}: nothing is left over to "
        "check it with, and a wrong measurement, or another place that fits as well, could not be noticed. Mark at "
        "least one more surveyed landmark in both images (six or more are good), or add boards or features seen by "
        "both, a measured baseline or measured positions"
    )
