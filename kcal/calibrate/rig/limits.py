"""When an item of a joint adjustment does not belong: its χ² against what noise, and lenses, explain.

A board's χ² has two parts. What each camera alone leaves over, with a board pose of its own, is corners and lens: a
lens that is not quite its model misfits one board more than another, which no noise explains and no rig can mend. The
rest, six degrees of freedom for every further camera, is what the board says about the rig; only that tells of a board
that moved between two exposures.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.parameters import FreeParameters
from kcal.calibrate.rig.adjustment import Adjustment, chi2_quantile, typical_excess
from kcal.calibrate.rig.blocks import LOCAL_SIZE, BoardGroup
from kcal.calibrate.rig.problem import RigProblem
from kcal.solve.lm import LMOptions, minimize

# Chance that any good item at all is taken for a wrong one.
_FALSE_ALARM = 1e-3
# px along an axis, RMS of a board, that lenses which are not quite their models may add to each of the two parts. Five
# coefficients on ray-traced wide lenses, ordinarily put together, add 0.04 and 0.017 (simulated).
_LENS, _BETWEEN = 0.1, 0.02
# Of fewer boards nobody can say what is typical; one does not belong then if its residuals are so many times as large
# as their noise.
_FEW_BOARDS, _WORSE_BOARD = 4, 3.0
# A pose needs that many corners.
_CORNERS = 4
_POSES = LMOptions(max_iterations=30, tolerance=1e-8, residual_floor=1e-8)


def excess(
    work: Adjustment, masks: Sequence[Tensor], values: Sequence[Tensor], probability: float | None = None
) -> list[Tensor]:
    """χ² of every item over what it may be; 0 outside the masks.

    Args:
        work: the adjustment as it stands.
        masks: the items.
        values: their χ², or by how much it would fall without them.
        probability: that a good item stays below 1, where it is judged by its sigmas as they are; left out: all items
            together nearly always, and where all of a kind fit worse than stated, they are judged by that.
    """
    squares, freedom = work.squares(masks), work.freedom(masks)
    level = probability or 1.0 - _FALSE_ALARM / max(sum(int((f > 0).sum()) for f in freedom), 1)
    found = []
    for kind, (value, square, dof) in enumerate(zip(values, squares, freedom, strict=True)):
        if kind == 0 and len(value):
            found.append(_boards(work, masks[0], value, square, dof, level, typical=probability is None))
            continue
        scale = max(1.0, typical_excess(square, dof)) if probability is None else 1.0
        found.append(torch.where(masks[kind], value / (scale * chi2_quantile(dof.double(), level)), 0.0))
    return found


def _boards(
    work: Adjustment, mask: Tensor, value: Tensor, square: Tensor, dof: Tensor, level: float, *, typical: bool
) -> Tensor:
    """The larger excess of each board's two parts."""
    alone, further = _alone(work, mask)
    lens, between = (share**2 * dof / work.sigma_corner**2 for share in (_LENS, _BETWEEN))
    own = (dof - further).clamp_min(0)
    scales = (typical_excess(alone, own), typical_excess(square - alone, further)) if typical else (1.0, 1.0)
    first = max(1.0, scales[0]) * chi2_quantile(own.double(), level) + lens
    second = max(1.0, scales[1]) * chi2_quantile(further.double(), level) + between
    if int((dof > 0).sum()) < _FEW_BOARDS:
        first, second = (torch.maximum(limit, _WORSE_BOARD**2 * dof) for limit in (first, second))
    return torch.where(mask, torch.maximum(alone / first, (value - alone) / second), 0.0)


def _alone(work: Adjustment, mask: Tensor) -> tuple[Tensor, Tensor]:
    """χ² of every board with a pose of its own for each camera, and what degrees of freedom that costs."""
    boards = work.data.boards
    assert boards is not None
    squares = torch.full(mask.shape, math.nan, dtype=torch.float64)
    squares[mask] = 0.0
    further = torch.zeros(mask.shape, dtype=torch.int64)
    cameras = work.data.cameras
    whitening = boards.whitening(work.sigma_corner)
    for c in range(len(cameras)):
        seen = torch.isfinite(boards.pixels[:, c]).all(-1).sum(-1)
        some = mask & (seen >= _CORNERS)
        if not bool(some.any()):
            continue
        pixels = torch.full_like(boards.pixels[some], math.nan)
        pixels[:, c] = boards.pixels[some][:, c]
        held = [False] * len(cameras)
        problem = RigProblem(
            [camera.model for camera in cameras],
            [camera.field for camera in cameras],
            [(BoardGroup(pixels, whitening[some], boards.board.points), 2)],
            (),
            [FreeParameters((), ())] * len(cameras),
            held,
            held,
        )
        start = (*work.state[:3], *(tensor[some] for tensor in work.state[3:5]))
        squares[some] += problem.block_squares(minimize(problem, start, _POSES).state)[0]
        further[some] += LOCAL_SIZE
    return squares, (further - LOCAL_SIZE).clamp_min(0)
