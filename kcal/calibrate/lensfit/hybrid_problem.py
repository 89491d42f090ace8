"""Bundle adjustment of one camera with a learned lens, its entrance pupil and the shape of the board."""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor

from kcal.calibrate.bundle.parameters import FreeParameters
from kcal.calibrate.bundle.twist import apply_twist
from kcal.calibrate.lensfit.readout import MOTION, Readout
from kcal.lens.model import LensModel
from kcal.lens.pose import step_rows
from kcal.lens.projection import project_components
from kcal.solve.result import State
from kcal.solve.schur import SchurLinearization, without_local

_POSE = 6
# Rows of derivatives that are formed at a time: as many as the cache of one core holds.
_CHUNK = 2_000_000


class HybridState(NamedTuple):
    """Camera, board, poses and motions: what is solved for.

    Attributes:
        params: (5 + P,) of the camera.
        board: (B,) amplitudes of the board's modes, meters.
        rotation: (V, 3, 3) cam_from_board.
        translation: (V, 3) meters.
        motion: (V, 12) of each view while it is read (`kcal.calibrate.lensfit.readout`); (V, 0) or empty: they stand
            still.

    Example:
        >>> state = HybridState(torch.zeros(9), torch.zeros(28), torch.eye(3).expand(4, 3, 3), torch.zeros(4, 3))
        >>> len(state.rotation)
        4
    """

    params: Tensor
    board: Tensor
    rotation: Tensor
    translation: Tensor
    motion: Tensor = torch.empty(0, 0)


def hybrid_unknowns(model: LensModel, square: bool = True) -> FreeParameters:
    """What is free of a hybrid camera: focal length, principal point, and all coefficients; no skew.

    Square pixels have one focal length; others have that of the rows as the last of the camera's unknowns.
    """
    rest = range(5, 5 + model.size)
    rows = 0 if square else 3 + model.size
    return FreeParameters((0, 1, 2, 3, *rest), (0, rows, 1, 2, *(i - 2 for i in rest)))


def unknown_values(params: Tensor, square: bool) -> Tensor:
    """The camera's unknowns in the order of `hybrid_unknowns`, from its parameters (5 + P,)."""
    own = [0, 2, 3, *range(5, len(params)), *([] if square else [1])]
    return params[own]


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
        readout: how views move while they are read; None: they stand still.
        stillness: (12,) the squared noise over the variance of each number of a motion.
        square: whether pixels are square; others have two focal lengths.
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
        readout: Readout | None = None,
        stillness: Tensor | None = None,
        square: bool = True,
    ) -> None:
        self.seen = torch.isfinite(pixels).all(-1) & (weights > 0)
        self.weights = torch.where(self.seen, weights, 0.0)[:, None]
        self.target = torch.where(self.seen[..., None], pixels, 0.0).transpose(-1, -2)
        self.points, self.shapes, self.model = points.T, shapes, model
        self.unknowns, self.square = hybrid_unknowns(model, square), square
        self.readout = readout
        self.local_size = _POSE + (MOTION if readout else 0)
        if readout is not None:
            self._time = readout.time(pixels)
            self._still = torch.zeros(MOTION, dtype=points.dtype) if stillness is None else stillness
        self.mean = mean
        self.free = torch.isfinite(precision)
        self.precision = torch.where(self.free, precision, 0.0)
        self.residual_count = 2 * int(self.seen.sum())
        self.shared_size = int(self.free.sum())

    def with_weights(self, weights: Tensor) -> HybridProblem:
        """The same problem with other weights (V, N) of its corners."""
        changed = copy.copy(self)
        changed.weights = torch.where(self.seen, weights, 0.0)[:, None]
        return changed

    def shared(self, state: HybridState) -> Tensor:
        """(S,) unknowns of the camera and the board, relative to the prior's mean."""
        return torch.cat([unknown_values(state.params, self.square), state.board]) - self.mean

    def _board(self, state: HybridState, views: slice = slice(None)) -> _Placed:
        flat = self.points + torch.einsum("b,bkn->kn", state.board, self.shapes)
        rotation, translation = state.rotation[views], state.translation[views, :, None]
        if self.readout is None:
            rotated = rotation @ flat
            return _Placed(flat, rotated, rotated + translation, None)
        moved = self.readout.moved(state.motion[views], self._time[views], flat)
        rotated = rotation @ moved.points
        return _Placed(flat, rotated, rotated + translation + moved.shift, moved.turn)

    def errors(self, state: HybridState) -> Tensor:
        """(V, 2, N) projected minus seen, pixels; NaN where a seen corner has no image, 0 where none was seen."""
        seen = project_components(self._board(state).points, state.params, self.model)
        bad = torch.where(seen.regular, 0.0, torch.nan)[:, None]
        return torch.where(self.seen[:, None], seen.pixels - self.target + bad, 0.0)

    def residuals(self, state: HybridState) -> Tensor:
        """(V, 2, N); NaN where a corner of any weight has no image."""
        return torch.where(self.weights > 0, self.errors(state) * self.weights, 0.0)

    def cost(self, state: HybridState) -> Tensor:
        """See `Problem.cost`."""
        x = self.shared(state)
        total = self.residuals(state).square().sum() + (self.precision * x * x).sum()
        if self.readout is not None:
            total = total + (self._still * state.motion.square()).sum()
        return 0.5 * total

    def rows(self, state: HybridState, views: slice = slice(None)) -> Tensor:
        """(V, L + S + 1, 2 N): derivatives by pose and motion, lens and board; last the residuals."""
        flat, rotated, points, turn = self._board(state, views)
        seen = project_components(points, state.params, self.model, self.unknowns.indices)
        by_camera = self.unknowns.collapse(seen.by_camera, -3)
        by_board = torch.einsum("vkun,vkl->vlun", seen.by_point, state.rotation[views])
        local = [step_rows(seen.by_point, rotated)]
        if self.readout is not None and turn is not None:
            local.append(self.readout.columns_of(seen.by_point, state.rotation[views], self._time[views], flat))
            # What displaces a corner of the board turns with it.
            by_board = by_board + torch.linalg.cross(by_board, turn[:, :, None].expand_as(by_board), dim=1)
        board = torch.einsum("vlun,bln->vbun", by_board, self.shapes)
        error = (seen.pixels - self.target[views])[:, None]
        rows = torch.cat([*local, by_camera, board, error], 1)
        return torch.where(self.weights[views, None] > 0, rows * self.weights[views, None], 0.0).flatten(-2)

    def _rows_with_stillness(self, state: HybridState, views: slice) -> Tensor:
        """(V, L + S + 1, R): `rows`, and those of the prior of motions."""
        rows = self.rows(state, views)
        rows[:, self.local_size : -1] = torch.where(self.free[:, None], rows[:, self.local_size : -1], 0.0)
        if self.readout is None:
            return rows
        prior = rows.new_zeros(*rows.shape[:2], MOTION)
        prior[:, _POSE : self.local_size] = torch.diag(self._still.sqrt())
        prior[:, -1] = self._still.sqrt() * state.motion[views]
        return torch.cat([rows, prior], -1)

    def _chunks(self) -> list[slice]:
        size = max(1, _CHUNK // ((len(self.mean) + self.local_size + 1) * 2 * self.points.shape[-1]))
        return [slice(start, start + size) for start in range(0, len(self.target), size)]

    def linearize(self, state: HybridState) -> SchurLinearization:
        """See `Problem.linearize`; by the unknowns that are not held."""
        chosen, L = self.free.nonzero()[:, 0], self.local_size
        S, columns = len(chosen), [*(L + chosen).tolist(), -1]
        local, right, total = [], [], state.params.new_zeros(S + 1, S + 1)
        for views in self._chunks():
            rows = self._rows_with_stillness(state, views)
            own, others = rows[:, :L], rows[:, L:] if len(self.free) == S else rows[:, columns]
            local.append(own @ own.transpose(-1, -2))
            right.append(own @ others.transpose(-1, -2))
            flat = others.transpose(0, 1).flatten(1)
            total = total + flat @ flat.T
        x, precision = self.shared(state)[chosen], self.precision[chosen]
        prior = torch.diag(torch.cat([precision, (precision * x * x).sum()[None]]))
        prior[:-1, -1] = prior[-1, :-1] = precision * x
        return SchurLinearization(torch.cat(local), torch.cat(right), total + prior)

    def retract(self, state: HybridState, step: State) -> HybridState:
        """See `Problem.retract`."""
        free, local = step
        count = len(self.unknowns)
        shared = torch.zeros_like(self.mean).masked_scatter(self.free, free)
        params = state.params.index_add(0, torch.tensor(self.unknowns.indices), self.unknowns.expand(shared[:count]))
        rotation, translation = apply_twist(state.rotation, state.translation, local[:, :_POSE])
        motion = state.motion if self.readout is None else state.motion + local[:, _POSE:]
        return HybridState(params, state.board + shared[count:], rotation, translation, motion)

    def select(self, elements: Tensor) -> None:
        """See `Problem.select`: there is one element only."""
        return

    def without_poses(self, state: HybridState) -> Tensor:
        """(V, S + 1, R): derivatives by the shared unknowns, and residuals, off what poses and motions can do (QR)."""
        return torch.cat(
            [without_local(self._rows_with_stillness(state, views), self.local_size) for views in self._chunks()]
        )

    def motion_without_poses(self, state: HybridState) -> Tensor:
        """(V, M + S + 1, 2 N): derivatives by motion and the shared unknowns, and residuals, off what poses can do."""
        out = []
        for views in self._chunks():
            rows = self.rows(state, views)
            rows[:, self.local_size : -1] = torch.where(self.free[:, None], rows[:, self.local_size : -1], 0.0)
            out.append(without_local(rows, _POSE))
        return torch.cat(out)


class _Placed(NamedTuple):
    """The board (3, N) in its frame; in each view (V, 3, N) rotated, and in the camera's frame; turns while read."""

    flat: Tensor
    rotated: Tensor
    points: Tensor
    turn: Tensor | None
