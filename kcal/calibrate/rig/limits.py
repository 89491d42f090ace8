"""Tell which items of a joint adjustment do not belong: compare their χ² with what noise, and lenses, explain.

A board's χ² has two parts. What each camera alone leaves over, with a board pose of its own, is due to corners and
lens: a lens that is not quite its model fits one board worse than another, which no noise explains and no rig can mend.
The rest, six degrees of freedom for every further camera, is what the board says about the rig. Only that part tells of
a board that moved between two exposures.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kcal.calibrate.rig.adjustment import Adjustment, typical_ratio
from kcal.calibrate.rig.blocks import LOCAL_SIZE, BoardBlock, PerKind, RigState
from kcal.calibrate.rig.problem import RigProblem
from kcal.calibrate.rig.unknowns import held
from kcal.chance import chi2_quantile
from kcal.solve.lm import LMOptions, minimize

# Probability that any good item at all is taken for a wrong one.
FALSE_ALARM = 1e-3
# px along an axis, RMS of a board, that lenses which are not quite their models may add to each of the two parts.
# Measured: five coefficients on simulated ray-traced wide lenses, ordinarily put together, add 0.04 and 0.017.
_LENS, _BETWEEN = 0.1, 0.02
# With fewer boards nobody can say what is typical: one does not belong if its residuals are so many times as large as
# their noise.
_FEW_BOARDS, _WORSE_BOARD = 4, 3.0
# A board pose needs that many corners.
_CORNERS = 4
_POSES = LMOptions(max_iterations=30, tolerance=1e-8, residual_floor=1e-8)


def over_limit(work: Adjustment, masks: PerKind, values: PerKind, probability: float | None = None) -> PerKind:
    """χ² of every item over the largest that noise and lenses explain; 0 outside the masks.

    Args:
        work: the adjustment as it stands.
        masks: the items.
        values: their χ², or by how much it would fall without them.
        probability: that a good item stays below 1, judged by the sigmas as they are. Left out: all items together
            nearly always do, and where a kind as a whole fits worse than stated, its items are judged by that.
    """
    squares, freedom = work.squares(masks), work.freedom(masks)
    level = probability or 1.0 - FALSE_ALARM / max(sum(int((dof > 0).sum()) for dof in freedom), 1)
    boards = _boards_over_limit(work, masks.boards, values.boards, squares.boards, freedom.boards, level, probability)
    found = [boards]
    for mask, value, square, dof in list(zip(masks, values, squares, freedom, strict=True))[1:]:
        scale = 1.0 if probability else max(1.0, typical_ratio(square, dof))
        found.append(torch.where(mask, value / (scale * chi2_quantile(dof, level)), 0.0))
    return PerKind(*found)


def _boards_over_limit(
    work: Adjustment, mask: Tensor, value: Tensor, square: Tensor, dof: Tensor, level: float, probability: float | None
) -> Tensor:
    """Each board by the part of its χ² that is farther over its limit."""
    if not bool(mask.any()):
        return torch.zeros(mask.shape, dtype=torch.float64)
    alone, further = _each_camera_alone(work, mask)
    lens, between = (share**2 * dof / work.sigma_corner**2 for share in (_LENS, _BETWEEN))
    own = (dof - further).clamp_min(0)
    scales = (1.0, 1.0) if probability else (typical_ratio(alone, own), typical_ratio(square - alone, further))
    first = max(1.0, scales[0]) * chi2_quantile(own, level) + lens
    second = max(1.0, scales[1]) * chi2_quantile(further, level) + between
    if int((dof > 0).sum()) < _FEW_BOARDS:
        first, second = (torch.maximum(limit, _WORSE_BOARD**2 * dof) for limit in (first, second))
    return torch.where(mask, torch.maximum(alone / first, (value - alone) / second), 0.0)


def _each_camera_alone(work: Adjustment, mask: Tensor) -> tuple[Tensor, Tensor]:
    """χ² of every board with a pose of its own for each camera, and how many degrees of freedom that costs."""
    boards, cameras = work.data.boards, work.data.cameras
    assert boards is not None
    squares = torch.full(mask.shape, torch.nan, dtype=torch.float64)
    squares[mask] = 0.0
    further = torch.zeros(mask.shape, dtype=torch.int64)
    whitening, still = work.corner_whitening(), [False] * len(cameras)
    for c in range(len(cameras)):
        some = mask & (torch.isfinite(boards.pixels[:, c]).all(-1).sum(-1) >= _CORNERS)
        if not bool(some.any()):
            continue
        pixels = torch.full_like(boards.pixels[some], torch.nan)
        pixels[:, c] = boards.pixels[some, c]
        block = BoardBlock(pixels, whitening[some], boards.points, work.unknowns.shapes)
        problem = RigProblem(cameras, [block], (), held(cameras), still, still)
        start = work.part(work.none()._replace(boards=some))
        found = RigState(*minimize(problem, start, _POSES).state)
        squares[some] += problem.item_squares(found)[0]
        further[some] += LOCAL_SIZE
    return squares, (further - LOCAL_SIZE).clamp_min(0)
