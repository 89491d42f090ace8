"""What joining two cameras costs each pair of views, beyond what each camera fits alone: pairs that do not belong."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardState
from kcal.calibrate.bundle.views import Views
from kcal.calibrate.rig.adjustment import chi2_quantile, typical_excess
from kcal.calibrate.rig.board_consensus import Poses
from kcal.lens.camera import Camera

# Two poses of a board become one: so many numbers fewer a pair.
_TIES = 6
# Chance that any good pair of a rig at all is taken for a wrong one.
_FALSE_ALARM = 1e-3
# px²; below, it is rounding.
_LEAST_VARIANCE = 1e-6
# Of fewer pairs nobody can say which one is wrong.
FEWEST = 4


def alone_squares(
    board: Tensor, pixels: Tensor, cameras: Sequence[Camera], views: Sequence[Poses]
) -> tuple[Tensor, float]:
    """Sum of squares (P,) in px² of pairs whose cameras each have a board pose of their own, and a residual's variance.

    Args:
        board: (N, 3) meters.
        pixels: (P, C, N, 2), NaN where not seen.
        cameras: C.
        views: each camera's own board poses.
    """
    total, freedom = torch.zeros(len(pixels), dtype=torch.float64), 0
    for c, (camera, poses) in enumerate(zip(cameras, views, strict=True)):
        problem = Views(board_points=board, pixels=pixels[:, c]).problem(camera.model, field=camera.field)
        state = BoardState.flat(camera.params.detach(), poses.rotation, poses.translation)
        total = total + 2.0 * problem.view_cost(state)
        freedom += 2 * int(torch.isfinite(pixels[:, c]).all(-1).sum()) - 6 * len(pixels)
    return total, float(total.sum()) / max(freedom, 1)


def disagreement(joined: Tensor, alone: Tensor, variance: float) -> Tensor:
    """How far beyond the limit each pair is (P,): above 1, noise does not explain what joining it costs.

    Noise alone makes the cost of joining, over the variance, χ² with six degrees of freedom. Where lenses are not
    exactly their models all pairs cost more, and each is compared with the typical one.

    Args:
        joined: (P,) sums of squares with one board pose a pair.
        alone: (P,) as `alone_squares`.
        variance: of a residual.

    Example:
        >>> alone = torch.full((8,), 100.0).double()
        >>> cost = torch.tensor([4.0, 5, 6, 7, 5, 6, 4, 90]).double()
        >>> disagreement(alone + cost, alone, 1.0).argmax().item(), bool(disagreement(alone + cost, alone, 1.0)[-1] > 1)
        (7, True)
    """
    cost = (joined - alone).clamp_min(0.0) / max(variance, _LEAST_VARIANCE)
    freedom = torch.full((len(cost),), _TIES)
    limit = chi2_quantile(freedom.double(), 1.0 - _FALSE_ALARM / len(cost))
    return cost / (limit * max(1.0, typical_excess(cost, freedom)))
