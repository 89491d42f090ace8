"""Groups of views that are held out together, and how well a model predicts groups to which it was not fitted."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Hashable, Sequence
from typing import Literal

import torch
from torch import Tensor

from kcal.calibrate.bundle.board_problem import BoardProblem, BoardState
from kcal.calibrate.bundle.poses import refine_poses
from kcal.calibrate.bundle.priors import Term
from kcal.calibrate.bundle.views import Views, free_parameters
from kcal.calibrate.camera.solve import Solution
from kcal.corners.observations import Observations
from kcal.errors import DegenerateError, InputError
from kcal.lens.model import LensModel
from kcal.lens.residual import Field
from kcal.solve.lm import LMOptions, minimize

# The groups are divided into this many parts, each held out once.
PARTS = 5
# For poses under a lens that is held, and for a fit to some views that starts at the fit to all of them.
_POSES = LMOptions(max_iterations=30, tolerance=1e-10)
REFIT = LMOptions(max_iterations=100, tolerance=1e-9, flatness=1e-6)
_LARGEST_GROUPS, _FEWEST_GROUPS, _RUN = 20, 5, 5
# Smallest share and number of a view's corners inside the border; fewer would hardly determine its pose.
_SHARE, _FEWEST_LEFT = 0.4, 12


@dataclasses.dataclass(frozen=True, kw_only=True)
class GroupedViews:
    """All views of one camera, with the weights with which all models are compared.

    Args:
        every: the views.
        inner: (V, N, 2) their pixels without the corners next to the border, see `without_border`.
        groups: indices of the views of each group.
    """

    every: Views
    inner: Tensor
    groups: list[list[int]]

    def problem(
        self, model: LensModel, views: Sequence[int], field: Field | None = None, terms: Sequence[Term] = ()
    ) -> BoardProblem:
        """The least-squares problem of some views, in that order."""
        return self.every.some(list(views)).problem(model, free_parameters(model), terms=terms, field=field)

    def held_out_cost(self, model: LensModel, state: BoardState, field: Field | None, views: Sequence[int]) -> Tensor:
        """(V,) squared residuals of views with their poses solved again, all else held; infinite without an image."""
        chosen = list(views)
        _, cost = refine_poses(self.every.some(chosen), model, state.views(chosen), _POSES, field)
        return torch.nan_to_num(2.0 * cost, nan=math.inf)

    def cross_validate(self, parts: Sequence[Tensor], fit: Fit) -> Tensor:
        """(G,) squared residuals (pixels²) of each group under what was fitted without its part.

        Args:
            parts: numbers of the groups of each part.
            fit: see `Fit`.
        """
        out = torch.zeros(len(self.groups), dtype=torch.float64)
        for part in parts:
            held = torch.zeros(len(self.groups), dtype=torch.bool)
            held[part] = True
            out[held] = self._by_group(self.held_out_cost(*fit(~held), self.views(held)), held)
        return out

    def views(self, chosen: Tensor) -> list[int]:
        """Indices of the views of the groups in a mask (G,), in the order of the groups."""
        return [i for g in chosen.nonzero()[:, 0].tolist() for i in self.groups[g]]

    def _by_group(self, values: Tensor, chosen: Tensor) -> Tensor:
        """Sums over the views of each group in a mask, from values in the order of `views`."""
        sizes = [len(self.groups[g]) for g in chosen.nonzero()[:, 0].tolist()]
        return torch.stack([own.sum() for own in values.split(sizes)])

    @property
    def within(self) -> GroupedViews:
        """The same without the corners next to the border."""
        return dataclasses.replace(self, every=dataclasses.replace(self.every, pixels=self.inner))


# From a mask (G,) of the groups to fit to: the lens, a state with initial poses of all views, and the field.
Fit = Callable[[Tensor], tuple[LensModel, BoardState, Field | None]]


def without_border(pixels: Tensor, size: tuple[int, int]) -> Tensor:
    """Corners (..., V, N, 2) without those next to the border of the area with corners, which become NaN.

    That border lies within the image's, as boards must be seen whole. On each side a margin as wide as the area without
    corners is removed, so that predicting it is like predicting the image's edge. Views that would lose too many
    corners stay whole.
    """
    seen = torch.isfinite(pixels).all(-1)
    corners = pixels[seen]
    low, high = corners.amin(0), corners.amax(0)
    first = torch.full_like(low, -0.5)
    last = torch.tensor(size, dtype=pixels.dtype) - 0.5
    inside = ((pixels > 2.0 * low - first) & (pixels < 2.0 * high - last)).all(-1)
    enough = (seen & inside).sum(-1, keepdim=True) >= torch.clamp(_SHARE * seen.sum(-1, keepdim=True), min=_FEWEST_LEFT)
    return torch.where((inside | ~enough)[..., None], pixels, torch.nan)


def group_views(observations: Observations, groups: Literal["blocks", "views"] | Sequence[Hashable]) -> list[list[int]]:
    """Indices of the views that are held out together, see `kcal.calibrate.lensfit.options.HybridOptions.groups`.

    At most twenty groups, and runs of at least five views where there are enough.

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


def cross_validate_parametric(
    grouped: GroupedViews, model: LensModel, solution: Solution, parts: Sequence[Tensor]
) -> Tensor:
    """(G,) squared residuals (pixels²) of each group under a parametric model that was fitted without its part.

    Every fit starts from the solution for all views, which can only favor the model.

    Args:
        grouped: the views.
        model: the lens model.
        solution: for all views.
        parts: numbers of the groups of each part.
    """
    start = solution.result.state

    def fit(chosen: Tensor) -> tuple[LensModel, BoardState, None]:
        train = grouped.views(chosen)
        problem = grouped.problem(model, train, terms=solution.minimum.terms)
        found = minimize(problem, start.views(train), REFIT).state
        return model, start._replace(parameters=found.parameters, warp=found.warp), None

    return grouped.cross_validate(parts, fit)
