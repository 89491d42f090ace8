"""Views in groups that are held out together, and how well a model predicts groups that it has not seen."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Hashable, Sequence
from typing import Literal

import torch
from torch import Tensor

from kcal.calibrate.poses import refine_poses
from kcal.calibrate.problem import BoardProblem
from kcal.calibrate.single import Solved
from kcal.calibrate.terms import Term
from kcal.calibrate.views import free_parameters
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError, InputError
from kcal.lens.model import LensModel
from kcal.lens.residual import Field
from kcal.solve.lm import LMOptions, minimise
from kcal.solve.result import State

# Into so many parts the groups are dealt, each held out once.
PARTS = 5
# Of poses under a lens that is held, and of a fit to a part of the views from that to all of them.
_POSES = LMOptions(max_iterations=30, tolerance=1e-10)
REFIT = LMOptions(max_iterations=100, tolerance=1e-9, flatness=1e-6)
_LARGEST_GROUPS, _FEWEST_GROUPS, _RUN = 20, 5, 5


@dataclasses.dataclass(frozen=True, kw_only=True)
class GroupedViews:
    """All views of one camera, with the weights by which every model is judged.

    Args:
        board_points: (N, 3) metres.
        pixels: (V, 1, N, 2), NaN where not seen.
        weights: (V, 1, N, 2, 2) whitening of the corners, or None: all count alike.
        groups: indices of the views of each group.
        free_warp: whether the board's warp is estimated.
    """

    board_points: Tensor
    pixels: Tensor
    weights: Tensor | None
    groups: list[list[int]]
    free_warp: bool

    def problem(
        self, model: LensModel, views: Sequence[int], field: Field | None = None, terms: Sequence[Term] = ()
    ) -> BoardProblem:
        """The least-squares problem of some views, in that order."""
        chosen = list(views)
        return BoardProblem(
            self.board_points,
            self.pixels[chosen],
            [model],
            [free_parameters(model)],
            free_warp=self.free_warp,
            whitening=None if self.weights is None else self.weights[chosen],
            terms=terms,
            fields=[field],
        )

    def held_out(self, model: LensModel, state: State, views: Sequence[int], field: Field | None) -> float:
        """Sum of squared residuals of views whose poses are solved again, all else held; infinite without a lens."""
        chosen = list(views)
        weights = None if self.weights is None else self.weights[chosen]
        _, cost = refine_poses(
            self.board_points, self.pixels[chosen], [model], some_views(state, chosen), _POSES, [field], weights
        )
        return float(torch.nan_to_num(2.0 * cost, nan=math.inf).sum())

    @property
    def count(self) -> int:
        """Corners seen."""
        return int(torch.isfinite(self.pixels).all(-1).sum())


def some_views(state: State, views: Sequence[int]) -> State:
    """The state of some views only."""
    *shared, rotation, translation = state
    return (*shared, rotation[list(views)], translation[list(views)])


def group_views(observations: Observations, groups: Literal["blocks", "views"] | Sequence[Hashable]) -> list[list[int]]:
    """Indices of the views that are held out together, see `kcal.calibrate.hybrid_options.HybridOptions.groups`.

    At most twenty groups; runs of five views or more where there are views enough.

    Raises:
        InputError: labels that do not fit the views.
        DegenerateError: fewer than five groups.
    """
    views = len(observations.views)
    if groups == "blocks":
        count = min(_LARGEST_GROUPS, max(views // _RUN, min(views, _FEWEST_GROUPS)))
        found = [part.tolist() for part in torch.arange(views).tensor_split(count)]
    elif groups == "views":
        count = min(_LARGEST_GROUPS, views)
        found = [list(range(i, views, count)) for i in range(count)]
    else:
        labels = list(groups)
        if isinstance(groups, str) or len(labels) != views:
            raise InputError(f"groups: 'blocks', 'views' or a label for each of the {views} views, got {groups!r}")
        found = [[i for i, label in enumerate(labels) if label == one] for one in dict.fromkeys(labels)]
    if len(found) < _FEWEST_GROUPS:
        raise DegenerateError(f"{len(found)} groups of views: at least {_FEWEST_GROUPS} are needed to hold some out")
    return found


def judge_parametric(setting: GroupedViews, model: LensModel, solved: Solved, parts: Sequence[Tensor]) -> float:
    """RMS (pixels) of a parametric model on each part of the groups, fitted without that part.

    Every fit starts from the solution for all views, which can only favour the model.

    Args:
        setting: the views.
        model: the lens model.
        solved: its solution for all views.
        parts: numbers of the groups of each part.
    """
    total = 0.0
    start = solved.result.state
    for part in parts:
        out = set(part.tolist())
        train = [i for g, group in enumerate(setting.groups) if g not in out for i in group]
        problem = setting.problem(model, train, terms=solved.minimum.terms)
        *shared, _, _ = minimise(problem, some_views(start, train), REFIT).state
        views = [i for g in out for i in setting.groups[g]]
        total += setting.held_out(model, (*shared, *start[-2:]), views, None)
    return math.sqrt(total / setting.count)
