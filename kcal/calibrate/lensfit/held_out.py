"""Views in groups that are held out together, and how well a model predicts groups that it has not seen."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Literal

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem
from kcal.calibrate.bundle.poses import refine_poses
from kcal.calibrate.bundle.priors import Term
from kcal.calibrate.bundle.views import free_parameters
from kcal.calibrate.camera.solve import Solved
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError, InputError
from kcal.lens.model import LensModel
from kcal.lens.residual import Field
from kcal.solve.lm import LMOptions, minimize
from kcal.solve.result import State

# Into so many parts the groups are dealt, each held out once.
PARTS = 5
# Of poses under a lens that is held, and of a fit to a part of the views from that to all of them.
_POSES = LMOptions(max_iterations=30, tolerance=1e-10)
REFIT = LMOptions(max_iterations=100, tolerance=1e-9, flatness=1e-6)
_LARGEST_GROUPS, _FEWEST_GROUPS, _RUN = 20, 5, 5
# Of a view's corners so many are left inside the border, at least; fewer would hardly hold its pose.
_SHARE, _FEWEST_LEFT = 0.4, 12


@dataclasses.dataclass(frozen=True, kw_only=True)
class GroupedViews:
    """All views of one camera, with the weights by which every model is judged.

    Args:
        board_points: (N, 3) meters.
        pixels: (V, 1, N, 2), NaN where not seen.
        inner: (V, 1, N, 2) likewise without the corners next to the border, see `without_border`.
        weights: (V, 1, N, 2, 2) whitening of the corners, or None: all count alike.
        groups: indices of the views of each group.
        free_warp: whether the board's warp is estimated.
    """

    board_points: Tensor
    pixels: Tensor
    inner: Tensor
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

    def held_out(self, model: LensModel, state: State, field: Field | None, views: Sequence[int]) -> Tensor:
        """(V,) squared residuals of views whose poses are solved again, all else held; infinite without a lens."""
        chosen = list(views)
        weights = None if self.weights is None else self.weights[chosen]
        _, cost = refine_poses(
            self.board_points, self.pixels[chosen], [model], some_views(state, chosen), _POSES, [field], weights
        )
        return torch.nan_to_num(2.0 * cost, nan=math.inf)

    def judge(self, parts: Sequence[Tensor], fit: Fit) -> Tensor:
        """(G,) squared residuals (pixels²) of each group under what was fitted without its part.

        Args:
            parts: numbers of the groups of each part.
            fit: see `Fit`.
        """
        out = torch.zeros(len(self.groups), dtype=torch.float64)
        for part in parts:
            held = torch.zeros(len(self.groups), dtype=torch.bool)
            held[part] = True
            out[held] = self._by_group(self.held_out(*fit(~held), self.views(held)), held)
        return out

    def views(self, chosen: Tensor) -> list[int]:
        """Indices of the views of the groups in a mask (G,), in the order of the groups."""
        return [i for g in chosen.nonzero()[:, 0].tolist() for i in self.groups[g]]

    def _by_group(self, values: Tensor, chosen: Tensor) -> Tensor:
        """Sums over the views of each group in a mask, from values in the order of `views`."""
        sizes = [len(self.groups[g]) for g in chosen.nonzero()[:, 0].tolist()]
        return torch.stack([own.sum() for own in values.split(sizes)])

    @property
    def count(self) -> int:
        """Corners seen."""
        return int(torch.isfinite(self.pixels).all(-1).sum())

    @property
    def within(self) -> GroupedViews:
        """The same without the corners next to the border."""
        return dataclasses.replace(self, pixels=self.inner)


# From a mask (G,) of the groups to fit to: the lens, a state with the poses of all views, from which those held out are
# solved, and the field.
Fit = Callable[[Tensor], tuple[LensModel, State, Field | None]]


def without_border(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Corners (..., V, N, 2) without those next to the border of what was seen, which become NaN.

    That border lies within the image's, as no board is seen in part. What is taken away is as deep as what nobody saw,
    on each side, so that predicting it is like predicting the image's edge. Views of which too little would be left
    stay whole.
    """
    seen = torch.isfinite(pixels).all(-1)
    corners = pixels[seen]
    low, high = corners.amin(0), corners.amax(0)
    first = torch.full_like(low, -0.5)
    last = torch.tensor(size, dtype=pixels.dtype) - 0.5
    inside = ((pixels > 2.0 * low - first) & (pixels < 2.0 * high - last)).all(-1)
    enough = (seen & inside).sum(-1, keepdim=True) >= torch.clamp(_SHARE * seen.sum(-1, keepdim=True), min=_FEWEST_LEFT)
    return torch.where((inside | ~enough)[..., None], pixels, torch.nan)


def some_views(state: State, views: Sequence[int]) -> State:
    """The state of some views only."""
    *shared, rotation, translation = state
    return (*shared, rotation[list(views)], translation[list(views)])


def group_views(observations: Observations, groups: Literal["blocks", "views"] | Sequence[Hashable]) -> list[list[int]]:
    """Indices of the views that are held out together, see `kcal.calibrate.lensfit.options.HybridOptions.groups`.

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


def judge_parametric(setting: GroupedViews, model: LensModel, solved: Solved, parts: Sequence[Tensor]) -> Tensor:
    """(G,) squared residuals (pixels²) of each group under a parametric model that was fitted without its part.

    Every fit starts from the solution for all views, which can only favor the model.

    Args:
        setting: the views.
        model: the lens model.
        solved: its solution for all views.
        parts: numbers of the groups of each part.
    """
    start = solved.result.state

    def fit(chosen: Tensor) -> tuple[LensModel, State, None]:
        train = setting.views(chosen)
        problem = setting.problem(model, train, terms=solved.minimum.terms)
        *shared, _, _ = minimize(problem, some_views(start, train), REFIT).state
        return model, (*shared, *start[-2:]), None

    return setting.judge(parts, fit)
