"""Bundle adjustment of one camera with a learned lens, its entrance pupil and the shape of the board."""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.bundle.parameters import FreeParameters
from kcal.calibrate.bundle.twist import apply_twist
from kcal.lens.model import LensModel
from kcal.lens.pose import step_rows
from kcal.lens.projection import project_components
from kcal.solve.result import State
from kcal.solve.schur import SchurLinearization, without_local

_LOCAL = 6
# Rows of derivatives that are formed at a time: as many as the cache of one core holds.
_CHUNK = 2_000_000


class HybridState(NamedTuple):
    """Camera, board and poses: what is solved for.

    Attributes:
        params: (5 + P,) of the camera.
        board: (B,) amplitudes of the board's modes, meters.
        rotation: (V, 3, 3) cam_from_board.
        translation: (V, 3) meters.

    Example:
        >>> state = HybridState(torch.zeros(9), torch.zeros(28), torch.eye(3).expand(4, 3, 3), torch.zeros(4, 3))
        >>> len(state.rotation)
        4
    """

    params: Tensor
    board: Tensor
    rotation: Tensor
    translation: Tensor


def hybrid_unknowns(model: LensModel) -> FreeParameters:
    """What is free of a hybrid camera: one focal length, the principal point, and all coefficients; no skew."""
    rest = range(5, 5 + model.size)
    return FreeParameters((0, 1, 2, 3, *rest), (0, 0, 1, 2, *(i - 2 for i in rest)))


class HybridProblem:
    """Residuals (pixels, by the corners' weights) of boards, and Gaussian priors on lens and board.

    Args:
        points: (N, 3) the board's corners as ordered, meters.
        shapes: (B, 3, N) modes of the board.
        pixels: (V, N, 2), NaN where not seen.
        weights: (V, N) by which residuals are multiplied.
        model: of a hybrid lens.
        mean: (S,) of the prior on the unknowns of the camera and on the board.
        precision: (S,) its weight: the squared noise over the prior's variance. Infinite: held.
    """

    batch: tuple[int, ...] = ()
    joint = False

    def __init__(
        self,
        points: Tensor,
        shapes: Tensor,
        pixels: Tensor,
        weights: Tensor,
        model: LensModel,
        mean: Tensor,
        precision: Tensor,
    ) -> None:
        self.seen = torch.isfinite(pixels).all(-1) & (weights > 0)
        self.weights = torch.where(self.seen, weights, 0.0)[:, None]
        self.target = torch.where(self.seen[..., None], pixels, 0.0).transpose(-1, -2)
        self.points, self.shapes, self.model = points.T, shapes, model
        self.unknowns = hybrid_unknowns(model)
        self.mean = mean
        self.free = torch.isfinite(precision)
        self.precision = torch.where(self.free, precision, 0.0)
        self.residual_count = 2 * int(self.seen.sum())

    def with_weights(self, weights: Tensor) -> HybridProblem:
        """The same problem with other weights (V, N) of its corners."""
        changed = copy.copy(self)
        changed.weights = torch.where(self.seen, weights, 0.0)[:, None]
        return changed

    def shared(self, state: HybridState) -> Tensor:
        """(S,) unknowns of the camera and the board, relative to the prior's mean."""
        own = state.params[[0, 2, 3, *range(5, len(state.params))]]
        return torch.cat([own, state.board]) - self.mean

    def _board(self, state: HybridState, views: slice = slice(None)) -> tuple[Tensor, Tensor]:
        flat = self.points + torch.einsum("b,bkn->kn", state.board, self.shapes)
        rotated = state.rotation[views] @ flat
        return rotated, rotated + state.translation[views, :, None]

    def errors(self, state: HybridState) -> Tensor:
        """(V, 2, N) projected minus seen, pixels; NaN where a seen corner has no image, 0 where none was seen."""
        _, points = self._board(state)
        seen = project_components(points, state.params, self.model)
        bad = torch.where(seen.regular, 0.0, torch.nan)[:, None]
        return torch.where(self.seen[:, None], seen.pixels - self.target + bad, 0.0)

    def residuals(self, state: HybridState) -> Tensor:
        """(V, 2, N); NaN where a corner of any weight has no image."""
        return torch.where(self.weights > 0, self.errors(state) * self.weights, 0.0)

    def cost(self, state: HybridState) -> Tensor:
        """See `Problem.cost`."""
        x = self.shared(state)
        return 0.5 * (self.residuals(state).square().sum() + (self.precision * x * x).sum())

    def rows(self, state: HybridState, views: slice = slice(None)) -> Tensor:
        """(V, 6 + S + 1, 2 N): derivatives by pose, lens and board, and residuals."""
        rotated, points = self._board(state, views)
        seen = project_components(points, state.params, self.model, self.unknowns.indices)
        by_camera = self.unknowns.collapse(seen.by_camera, -3)
        board = torch.einsum("vkun,vkl,bln->vbun", seen.by_point, state.rotation[views], self.shapes)
        error = (seen.pixels - self.target[views])[:, None]
        rows = torch.cat([step_rows(seen.by_point, rotated), by_camera, board, error], 1)
        return torch.where(self.weights[views, None] > 0, rows * self.weights[views, None], 0.0).flatten(-2)

    def linearize(self, state: HybridState) -> SchurLinearization:
        """See `Problem.linearize`."""
        S = len(self.mean)
        size = max(1, _CHUNK // ((S + _LOCAL + 1) * 2 * self.points.shape[-1]))
        local, right, total = [], [], state.params.new_zeros(S + 1, S + 1)
        for start in range(0, len(state.rotation), size):
            rows = self.rows(state, slice(start, start + size))
            rows[:, _LOCAL:-1] = torch.where(self.free[:, None], rows[:, _LOCAL:-1], 0.0)
            pose, others = rows[:, :_LOCAL], rows[:, _LOCAL:]
            local.append(pose @ pose.transpose(-1, -2))
            right.append(pose @ others.transpose(-1, -2))
            flat = others.transpose(0, 1).flatten(1)
            total = total + flat @ flat.T
        x = self.shared(state)
        prior = torch.diag(torch.cat([self.precision, (self.precision * x * x).sum()[None]]))
        prior[:-1, -1] = prior[-1, :-1] = self.precision * x
        return SchurLinearization(torch.cat(local), torch.cat(right), total + prior)

    def retract(self, state: HybridState, step: State) -> HybridState:
        """See `Problem.retract`."""
        shared, local = step
        count = len(self.unknowns)
        params = state.params.index_add(0, torch.tensor(self.unknowns.indices), self.unknowns.expand(shared[:count]))
        rotation, translation = apply_twist(state.rotation, state.translation, local)
        return HybridState(params, state.board + shared[count:], rotation, translation)

    def select(self, elements: Tensor) -> None:
        """See `Problem.select`: there is one element only."""
        return

    def without_poses(self, state: HybridState) -> Tensor:
        """(V, S + 1, 2 N): derivatives by the shared unknowns, and residuals, off what poses can do (by QR)."""
        out = []
        size = max(1, _CHUNK // ((len(self.mean) + _LOCAL + 1) * 2 * self.points.shape[-1]))
        for start in range(0, len(state.rotation), size):
            out.append(without_local(self.rows(state, slice(start, start + size)), _LOCAL))
        return torch.cat(out)
